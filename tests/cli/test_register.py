import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import torch

from curvireg_torch import Registrar, camera_matrix
from curvireg_torch.cli import main, parse
from curvireg_torch.cli.printing import _advice, _print_rivals, print_result
from curvireg_torch.cli.registering import _write_pose
from curvireg_torch.errors import LostObjectError
from curvireg_torch.geometry import rotation_error, up_rotation, viewpoint_from_rotation
from curvireg_torch.jobs import photograph
from curvireg_torch.pipeline import DEFAULT, PRESETS, Pipeline, ViewPolicy
from curvireg_torch.synthetic import example_mesh
from tests._support import bank_of, double, scene, slow_after, truck_bank
from tests._support.lists import CAMERA, box_of, check_pose
from tests._support.small import SMALL
from tests._support.tables import text_table


@pytest.mark.usefixtures("drawn")
def test_register_writes_result_and_overlay(registered, tmp_path, capsys):
    result = registered("--camera", *CAMERA, "--hypotheses", "3", mesh="learned.safetensors")
    # swapped CX and CY would move it by 30 px of 260: 0.16 of its distance
    check_pose(result, scene(0)[2], 15.0, 0.05)
    assert len(result["hypotheses"]) == 2  # of three, one merged with another
    assert cv2.imread(str(tmp_path / "out" / "overlay.png")).std() > 20
    assert (np.shape(result["covariance"]), len(result["probabilities"])) == ((6, 6), 2)
    assert sum(result["probabilities"]) + result["no_match_probability"] == pytest.approx(1.0)
    printed = capsys.readouterr().out
    assert "viewpoint" in printed
    assert "(about and along the camera's axes)" in printed


def test_register_is_told_that_a_box_is_that_of_the_visible_part(registered):
    for words, box_is in (((), "whole"), (("--box-is", "visible"), "visible")):
        assert registered("--no-refine", *words)["pipeline"]["box_is"] == box_is


def test_register_without_box_and_camera(folder, registered, capsys, monkeypatch):
    files = [str(folder / name) for name in ("photos/0.png", "truck.safetensors")]
    words = ["register", *files, "--no-refine", "--json"]
    assert main([*words, "--box", *box_of(0)]) == 0
    assert "detecting" not in capsys.readouterr().err
    with monkeypatch.context() as patch:
        patch.setattr(photograph, "_results_of", Mock(side_effect=LostObjectError("nowhere")))
        assert main(words) == 2
    assert "0.png: detecting the object" in capsys.readouterr().err
    found = registered("--no-refine", "--mesh-is", "similar")
    assert capsys.readouterr().err == ""
    keys = ("translation", "covariance", "standard_deviations", "camera", "camera_source")
    assert {found[key] for key in keys} == {None}
    assert found["pipeline"]["contours"] is False


@pytest.mark.parametrize(
    ("name", "options", "up"), slow_after(1, [("x.ply", ["--up=-x"], "-x"), ("y.glb", [], "y")])
)
def test_register_upright_mesh_with_another_up_axis(
    folder, registered, monkeypatch, name, options, up
):
    views = ViewPolicy(azimuth_step=15.0, elevations=(0.0, 15.0, 30.0, 45.0))
    pipeline = replace(PRESETS["classical"], views=views, bank=truck_bank().settings)
    monkeypatch.setitem(PRESETS, DEFAULT, pipeline)
    monkeypatch.setenv("CURVIREG_CACHE", str(folder / "cache"))
    T = np.eye(4)
    T[:3, :3] = up_rotation(up).numpy().T
    example_mesh().apply_transform(T).export(folder / name)
    result = registered("--pose", "upright", "--no-refine", *options, mesh=name)
    found = double(result["rotation"])
    assert rotation_error(found, scene(0)[2][:3, :3] @ up_rotation(up)) < 15


def test_an_upright_mesh_that_is_not_recognised_is_told_which_axis_was_taken_as_up(
    folder, registered, capsys, monkeypatch
):
    """OBJ names no axis; many programs write y up, and z is assumed."""
    monkeypatch.setitem(PRESETS, DEFAULT, SMALL)
    mesh = example_mesh()
    mesh.vertices = mesh.vertices[:, [0, 2, 1]] * (1, 1, -1)
    mesh.export(folder / "y.obj")
    hint = "--pose upright: z of the mesh is taken as up; --up names another"
    words = ("--pose", "upright", "--unit", "m")
    assert not registered(*words, mesh="y.obj")["reliable"]
    assert hint in capsys.readouterr().out
    registered(*words, "--up", "y", mesh="y.obj")
    assert hint not in capsys.readouterr().out


def test_register_checks_box_and_camera_before_it_opens_a_bank(register_one, refused, monkeypatch):
    monkeypatch.setattr(
        "curvireg_torch.cli.registering.open_registrar", lambda *_: pytest.fail("opened")
    )
    refused(register_one(box=["900", "5", "950", "90"]), "0.png: box", "entirely outside")
    refused(register_one("--camera", "exif"), "0.png", "no focal length")


def test_register_warns_of_a_questionable_camera(registered, capsys):
    found = registered("--no-refine", "--camera", "119", "119", "260", "260")
    (line,) = found["warnings"]
    assert "FX FY and CX CY seem to be swapped" in line
    assert f"0.png: {line}" in capsys.readouterr().err
    assert found["reliable"] is False


def test_register_takes_views_from_the_bank_unless_a_pipeline_file_is_given(
    folder, register_one, registered, capsys
):
    views = ViewPolicy(pose="upright", azimuth_step=120.0, elevations=(10.0,))
    bank = bank_of(example_mesh(), pipeline=replace(PRESETS["fast"], views=views))
    bank.save(folder / "upright.safetensors")
    found = registered("--preset", "fast", mesh="upright.safetensors")
    assert found["pipeline"]["views"]["azimuth_step"] == 120.0
    (folder / "pipeline.json").write_text(PRESETS["fast"].to_json())
    assert register_one("--pipeline", folder / "pipeline.json", mesh="upright.safetensors") == 2
    assert "pose upright, " in capsys.readouterr().err


@pytest.mark.parametrize("preset", slow_after(1, sorted(PRESETS, reverse=True)))
def test_register_equals_registrar_bit_by_bit(folder, registered, monkeypatch, preset):
    monkeypatch.setenv("CURVIREG_CACHE", str(folder / "equal"))
    # The views of every preset, thinned out: 12 instead of 7200.
    views = ViewPolicy(directions=12, theta_step=360.0)
    (folder / "pipeline.json").write_text(replace(PRESETS[preset], views=views).to_json())
    written = registered(
        "--pipeline", folder / "pipeline.json", "--camera", *CAMERA, mesh="truck.ply"
    )
    registrar = Registrar(
        str(folder / "truck.ply"), pipeline=Pipeline.read(folder / "pipeline.json")
    )
    photo = folder / "photos/0.png"
    box = torch.tensor([[float(v) for v in box_of(0)]])
    result = registrar([photo], box, camera_matrix(*map(float, CAMERA)))[0]
    for name in ("rotation", "translation"):
        assert written[name] == getattr(result, name).tolist()
    assert (written["score"], written["confidence"]) == (result.score, result.confidence)
    assert [one["rotation"] for one in written["hypotheses"]] == [
        h.rotation.tolist() for h in result.hypotheses
    ]
    assert written["pipeline"] == registrar.pipeline.describe()


def test_register_limits_the_pose(registered):
    azimuth = viewpoint_from_rotation(scene(0)[2][:3, :3])[0]
    low = float(azimuth + 140) % 360
    high = float(azimuth + 220) % 360
    result = registered("--no-refine", "--azimuth", f"{low},{high}", "--elevation", "-90", "90")
    assert result["prior"] == {
        "azimuth": [low, high],
        "elevation": [-90, 90],
        "contradiction": "better outside",
    }
    for pose in result["hypotheses"]:
        assert (pose["viewpoint"]["azimuth"] - low) % 360 <= 80 + 1e-6


def test_a_bank_has_the_unit_and_the_axis_that_the_options_name(
    folder, register_one, registered, refused
):
    mesh = example_mesh()
    mesh.units = "mm"
    bank_of(mesh, pipeline=SMALL).save(folder / "mm.safetensors")
    bank = {"mesh": "mm.safetensors"}
    refused(
        register_one("--unit", "m", "--no-refine", **bank),
        "mm.safetensors: built with unit mm, not m; leave the unit out, or build it again "
        "(leave --unit out, or curvireg bank)",
    )
    refused(
        register_one("--up=-x", "--no-refine", **bank), "mm.safetensors: built with z up, not -x"
    )
    words = ["--unit", "mm", "--up", "z", "--no-refine"]
    assert registered(*words, **bank)["unit"] == "mm"
    assert register_one("--no-refine", **bank) == 0
    mesh.units = None
    bank_of(mesh, pipeline=SMALL).save(folder / "mm.safetensors")
    refused(
        register_one("--unit", "mm", "--no-refine", **bank), "mm.safetensors: built without a unit"
    )


def test_options_of_videos_and_processes_are_taken():
    for words in (
        "a.png v.mp4 m.ply --every 2",
        "shots/* m.ply --jobs 2",
        "a.png m.ply --every 1 --jobs 1",
    ):
        assert parse(["register", *words.split(), "--out", "out"]).every in (1, 2)
    words = ["--list", "l.csv", "m.ply", "--front", "x", "--out", "out"]
    assert parse(["register", *words]).front == "x", "of the limits in its rows"


def test_the_pose_in_the_world_of_a_rig_is_no_start(folder, register_one, refused):
    pose = {"frame": "world", "rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "translation": [0, 0, 3]}
    (folder / "rig.json").write_text(json.dumps(pose))
    words = "--start", str(folder / "rig.json"), "--camera", *CAMERA
    refused(
        register_one(*words, box=()),
        "rig.json: a result of several photographs, whose pose is in the world",
    )


def test_starts_of_other_tools_have_their_convention_and_unit(
    folder, register_one, registered, refused
):
    T = scene(0)[2].double()
    flip = torch.diag(double([1.0, -1.0, -1.0, 1.0]))
    path = folder / "gl.json"
    words = "--start", str(path), "--camera", *CAMERA
    path.write_text(json.dumps({"T_cam_from_model": (flip @ T).tolist()}))
    message = (
        "a pose of OpenGL's camera? Then turn y and z around; or give --start-convention opengl"
    )
    refused(register_one(*words, box=()), f"behind the camera: {message}")
    turned = registered(*words, "--start-convention", "opengl", box=())
    assert rotation_error(double(turned["rotation"]), T[:3, :3]) < 3.0
    entry = {
        "cam_R_m2c": T[:3, :3].flatten().tolist(),
        "cam_t_m2c": (1000.0 * T[:3, 3]).tolist(),
        "obj_id": 1,
    }
    path.write_text(json.dumps({"4": [entry]}))  # mm, of a mesh in m
    of_bop = registered("--start", f"{path}:4", "--camera", *CAMERA, box=())
    torch.testing.assert_close(double(of_bop["translation"]), T[:3, 3], rtol=0.1, atol=0.05)
    with pytest.raises(SystemExit):
        register_one("--start-convention", "opengl")


def test_register_refines_a_start_or_writes_that_the_object_is_lost(
    folder, register_one, registered, document, capsys
):
    T = scene(0)[2]
    path = folder / "start.json"
    pose = {"rotation": T[:3, :3].tolist(), "translation": T[:3, 3].tolist()}
    path.write_text(json.dumps(pose))
    words = "--start", str(path), "--camera", *CAMERA
    result = registered(*words, box=())
    assert rotation_error(double(result["rotation"]), scene(0)[2][:3, :3]) < 3.0
    assert set(result["confidence_features"]) == {"similarity", "edge_support"}
    pose["translation"][0] += 100.0
    path.write_text(json.dumps(pose))
    assert register_one(*words, box=()) == 2
    assert document()["verdict"] == "lost"
    assert "outside the photograph" in capsys.readouterr().err


def inputs_with(*, box=(300, 200, 500, 400), **picture):
    picture = {"width": 960, "height": 720, "orientation": 1, **picture}
    return {"inputs": {"box": box, "picture": picture}}


ADVICE = """
{"warnings": ["?"]}                                        | what the warning names
{"verdict": "unsure"}                                      | look whether its contours fit
{}                                                         | check that the box is tight, and that
{"ambiguous": "half turn"}                                 | more than one pose
{"confidence_features": {"border": 1}}                     | border of the photograph
{"translation": null}                                      | --camera
{"confidence_features": {"border": 0, "undetermined": 1.2}} | rotation open
"""


def test_advice_names_what_was_measured_or_says_less():
    document = {"warnings": [], "ambiguous": None, "translation": [0, 0, 1], "edge_support": 0.1}
    document |= {"verdict": "no match"}
    document["confidence_features"] = {"border": 0, "undetermined": 0.1}
    assert "contours" not in _advice(document), "few edges alone are no cause"
    for change, words in (
        *text_table(ADVICE),
        (inputs_with(box=[34.8, 20.3, 74, 79.7]), "of percent, multiply it by"),
        (inputs_with(box=[34.8, 20.3, 174, 79.7]), "check that the box is tight"),
        (inputs_with(width=90, box=[34, 20, 74, 79]), "check that the box is tight"),
        (inputs_with(orientation=6), "EXIF orientation 6 applied"),
    ):
        assert words in _advice({**document, **change})


POSE = {"viewpoint": {"azimuth": 10.0, "elevation": 20.0, "theta": 0.0}, "translation": None}
COPY = {**POSE, "box": [1, 2, 3, 4], "score": 0.9, "confidence": 0.64, "verdict": "unsure"}
PRINTED = {
    **POSE,
    "score": 0.5,
    "confidence": 0.999,
    "verdict": "reliable",
    "reliable": True,
    "corrected_box": None,
    "standard_deviations": None,
    "unit": "mm",
    "hypotheses": [],
    "ambiguous": None,
    "seconds": {"bank": 0.0, "register": 0.0},
}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, "theta 0.0 degrees (as seen by a camera that looks straight at it)   score 0.500"),
        ({"translation": [1.0, 2.0, 3.0]}, "theta 0.0 degrees   score 0.500   confidence 0.99,"),
        (
            {"confidence": None, "reliable": False, "warnings": [], "confidence_features": {}},
            "take the pose as a guess; look at the overlay, or leave --preset",
        ),
        ({"confidence": None}, "confidence not calibrated for other terms, fields or views"),
        (
            {
                "translation": [1.0, 2.0, 3.0],
                "detection": {
                    "instances": [
                        {**POSE, "box": [1, 2, 3, 4], "score": 0.9, "translation": [4.0, 5.5, 6.0]}
                    ]
                },
            },
            "found in box 1 2 3 4: there with probability 0.90; azimuth 10.0, elevation 20.0, "
            "theta 0.0 degrees, at 4, 5.5, 6 mm",
        ),
        (
            {"detection": {"instances": [COPY, {**COPY, "score": 0.7, "confidence": None}]}},
            "2 objects, the best first:\nin box 1 2 3 4: there with probability 0.90; confidence "
            "0.64, unsure; azimuth 10.0, elevation 20.0, theta 0.0 degrees\n"
            "in box 1 2 3 4: there with probability 0.70; azimuth",
        ),
    ],
)
def test_the_command_says_what_numbers_mean(capsys, changes, expected):
    print_result({**PRINTED, **changes}, Path("out"))
    assert expected in capsys.readouterr().out


def test_rivals_and_hidden_features_are_named(capsys):
    viewpoint = {"azimuth": 30.0, "elevation": 10.0, "theta": 0.0}
    tied = {
        "ambiguous": "half turn",
        "confidence": 0.45,
        "no_match_probability": 0.1,
        "hypotheses": [{"viewpoint": viewpoint}] * 3,
        "probabilities": [0.45, 0.44, 0.01],
        "pair_probability": None,
        "feature_is_hidden": False,
    }
    of_pair = {"confidence": 0.63, "probabilities": [0.63, 0.31, 0.01], "pair_probability": 0.94}
    for document in (tied, tied | of_pair):
        _print_rivals(document)
        printed = capsys.readouterr().out
        assert printed.count("could also be") == 1
        assert "flipped by 180 degrees" in printed
    certain = {"confidence": 0.85, "probabilities": [0.85, 0.1, 0.01], "pair_probability": 0.95}
    _print_rivals(tied | certain | {"ambiguous": "several", "feature_is_hidden": True})
    printed = capsys.readouterr().out
    assert (
        printed == "right up to turns that only a small feature tells apart, which is not in view\n"
    )
    _print_rivals(tied | {"ambiguous": None})
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("covariance", [None, np.eye(6).tolist()])
def test_a_pose_for_ros_without_a_covariance_is_named(tmp_path, capsys, covariance):
    pose = {"translation": [1.0, 2.0, 3.0], "quaternion": [1.0, 0.0, 0.0, 0.0], "unit": "m"}
    document = {**pose, "frame": "camera", "mesh": "part.stl", "covariance": covariance}
    arguments = SimpleNamespace(format="ros", out=tmp_path, stamp=None, frame=None)
    _write_pose(arguments, document, Mock())
    assert (tmp_path / "pose.yaml").is_file()
    assert (tmp_path / "pose_with_covariance.yaml").is_file() is (covariance is not None)
    said = "curvireg: no pose_with_covariance.yaml, as this pose has no covariance\n"
    assert capsys.readouterr().err == ("" if covariance else said)

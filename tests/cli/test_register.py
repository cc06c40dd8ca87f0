import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from curvireg_torch import Registrar, ViewBank, camera_matrix
from curvireg_torch.cli import main
from curvireg_torch.geometry import rotation_error, up_rotation, viewpoint_from_rotation
from curvireg_torch.pipeline import PRESETS, Pipeline, ViewPolicy
from curvireg_torch.synthetic import example_mesh
from tests._support.lists import CAMERA, box_of, check_pose
from tests._support.scenes import scene


def test_register_writes_result_and_overlay(register_one, document, tmp_path, capsys):
    assert register_one("--camera", *CAMERA, "--top", "3", mesh="learned.safetensors") == 0
    result = document()
    check_pose(result, scene(0)[2], 15.0, 0.05)  # swapped CX and CY would move it by 30 px of 260: 0.16 of its distance
    assert len(result["top"]) == 3
    assert cv2.imread(str(tmp_path / "out" / "overlay.png")).std() > 20
    assert (np.shape(result["covariance"]), len(result["probabilities"])) == ((6, 6), 3)
    assert sum(result["probabilities"]) + result["none"] == pytest.approx(1.0)
    deviations = result["standard_deviations"]
    assert deviations["translation"] == pytest.approx([result["covariance"][i][i] ** 0.5 for i in (3, 4, 5)])
    assert all(0 < v < 30 for v in deviations["rotation_deg"])
    printed = capsys.readouterr().out
    assert "viewpoint" in printed
    assert "standard deviations: " in printed


def test_register_without_box_and_camera(folder, register_one, document, capsys):
    words = ["register", str(folder / "photos/0.png"), str(folder / "truck.safetensors"), "--no-refine", "--json"]
    assert main([*words, "--box", *box_of(0)]) == 0
    assert "detecting" not in capsys.readouterr().err
    assert main(words) == 0
    assert "0.png: detecting the object" in capsys.readouterr().err
    assert register_one("--no-refine", box=()) == 0
    assert capsys.readouterr().err == ""
    keys = ("translation", "covariance", "standard_deviations")
    assert {document()[key] for key in keys} == {None}
    assert document()["pipeline"]["contours"] is False


@pytest.mark.parametrize(("name", "options", "up"), [("y.glb", [], "y"), ("x.ply", ["--up=-x"], "-x")])
def test_register_upright_mesh_with_another_up_axis(folder, register_one, document, monkeypatch, name, options, up):
    monkeypatch.setenv("CURVIREG_CACHE", str(folder / "cache"))
    T = np.eye(4)
    T[:3, :3] = up_rotation(up).numpy().T
    example_mesh().apply_transform(T).export(folder / name)
    assert register_one("--pose", "upright", "--no-refine", *options, mesh=name) == 0
    found = torch.tensor(document()["rotation"]).double()
    assert float(rotation_error(found, scene(0)[2][:3, :3] @ up_rotation(up))) < 15


def test_register_checks_box_and_camera_before_it_opens_a_bank(register_one, refused, monkeypatch):
    monkeypatch.setattr("curvireg_torch.evaluation.opening.open_registrar", lambda *_: pytest.fail("opened"))
    refused(register_one(box=["900", "5", "950", "90"]), "0.png: box", "entirely outside")
    refused(register_one("--camera", "exif"), "0.png", "no focal length")


def test_register_warns_of_a_questionable_camera(register_one, document, capsys):
    assert register_one("--no-refine", "--camera", "119", "119", "260", "260") == 0
    (line,) = document()["warnings"]
    assert "FX FY and CX CY seem to be swapped" in line
    assert f"0.png: {line}" in capsys.readouterr().err
    assert document()["reliable"] is False


def test_register_takes_views_from_the_bank_unless_a_pipeline_file_is_given(folder, register_one, document, capsys):
    views = ViewPolicy(pose="upright", azimuth_step=120.0, elevations=(10.0,))
    bank = ViewBank.build(example_mesh(), pipeline=replace(PRESETS["fast"], views=views), progress=False)
    bank.save(folder / "upright.safetensors")
    assert register_one("--preset", "fast", mesh="upright.safetensors") == 0
    assert document()["pipeline"]["views"]["azimuth_step"] == 120.0
    (folder / "pipeline.json").write_text(PRESETS["fast"].to_json())
    assert register_one("--pipeline", folder / "pipeline.json", mesh="upright.safetensors") == 2
    assert "pose upright, " in capsys.readouterr().err


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_register_equals_registrar_bit_by_bit(folder, register_one, document, monkeypatch, preset):
    monkeypatch.setenv("CURVIREG_CACHE", str(folder / "equal"))
    # The views of every preset, thinned out: 12 instead of 7200.
    views = ViewPolicy(directions=12, theta_step=360.0)
    (folder / "pipeline.json").write_text(replace(PRESETS[preset], views=views).to_json())
    assert register_one("--pipeline", folder / "pipeline.json", "--camera", *CAMERA, mesh="truck.ply") == 0
    written = document()
    registrar = Registrar(str(folder / "truck.ply"), pipeline=Pipeline.read(folder / "pipeline.json"))
    photo, box = folder / "photos/0.png", torch.tensor([[float(v) for v in box_of(0)]])
    result = registrar([photo], box, camera_matrix(*map(float, CAMERA)))[0]
    for name in ("rotation", "translation"):
        assert written[name] == getattr(result, name).tolist()
    assert (written["score"], written["confidence"]) == (result.score, result.confidence)
    assert [top["rotation"] for top in written["top"]] == [h.rotation.tolist() for h in result.hypotheses]
    assert written["pipeline"] == registrar.pipeline.describe()


def test_register_limits_the_pose(register_one, document):
    azimuth = viewpoint_from_rotation(scene(0)[2][:3, :3])[0]
    low, high = float(azimuth + 140) % 360, float(azimuth + 220) % 360
    assert register_one("--no-refine", "--azimuth", f"{low},{high}", "--elevation", "-90", "90") == 0
    result = document()
    assert result["prior"] == {"azimuth": [low, high], "elevation": [-90, 90], "contradiction": "better outside"}
    for pose in result["top"]:
        assert (pose["viewpoint"]["azimuth"] - low) % 360 <= 80 + 1e-6


def test_register_refines_a_start_or_writes_that_the_object_is_lost(folder, register_one, document, capsys):
    T, path = scene(0)[2], folder / "start.json"
    pose = {"rotation": T[:3, :3].tolist(), "translation": T[:3, 3].tolist()}
    path.write_text(json.dumps(pose))
    words = "--start", str(path), "--camera", *CAMERA
    assert register_one(*words, box=()) == 0
    result = document()
    assert float(rotation_error(torch.tensor(result["rotation"]).double(), scene(0)[2][:3, :3])) < 3.0
    assert set(result["confidence_features"]) == {"similarity", "edge_support"}
    pose["translation"][0] += 100.0
    path.write_text(json.dumps(pose))
    assert register_one(*words, box=()) == 2
    assert document()["status"] == "lost"
    assert "outside the photograph" in capsys.readouterr().err

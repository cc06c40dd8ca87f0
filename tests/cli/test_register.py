import inspect
import json
import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
import trimesh

from curvireg_torch import Registrar, ViewBank, camera_matrix
from curvireg_torch.cli import main, parse
from curvireg_torch.cli.options import register_options
from curvireg_torch.cli.report import print_result
from curvireg_torch.errors import BankError
from curvireg_torch.evaluation.opening import RegisterOptions
from curvireg_torch.geometry import rotation_error, up_rotation
from curvireg_torch.models import LearnedCurvilinearSaliency
from curvireg_torch.pipeline import DEFAULT, PRESETS, Pipeline, preset_named
from curvireg_torch.settings import BankSettings, ViewPolicy
from curvireg_torch.synthetic import example_mesh
from curvireg_torch.training import adapt
from tests._support.exif import exif, with_exif
from tests._support.scenes import scene, truck_bank, unrefined


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A photograph, a mesh and a bank of it on disk."""
    folder = tmp_path_factory.mktemp("cli")
    image, box, T = scene(0)
    picture = (image.permute(1, 2, 0).numpy()[..., ::-1] * 255).round().astype(np.uint8)
    cv2.imwrite(str(folder / "photo.png"), picture)
    cv2.imwrite(str(folder / "flat.png"), np.full((60, 80, 3), 90, np.uint8))
    (folder / "text.jpg").write_text("not a picture")
    example_mesh().export(folder / "truck.ply")
    (folder / "empty.obj").write_text("")
    (folder / "points.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    (folder / "nan.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 nan\n0 1 0\n3 0 1 2\n")
    truck_bank().save(folder / "truck.safetensors")
    (folder / "broken.safetensors").write_bytes((folder / "truck.safetensors").read_bytes()[:1000])
    return folder, [f"{v:.1f}" for v in box], T


def run(folder, photo="photo.png", mesh="truck.safetensors", *more, box=None):
    boxes = ["--box", *box] if box else []
    return main(
        ["register", str(folder / photo), str(folder / mesh), *boxes, "--out", str(folder / "out"), "--quiet", *more]
    )


def test_register_writes_result_and_overlay(files, capsys):
    folder, box, truth = files
    camera = ["--camera", "260", "260", "119.5", "89.5", "--top", "3"]
    assert run(folder, "photo.png", "truck.safetensors", *camera, box=box) == 0
    result = json.loads((folder / "out" / "result.json").read_text())
    for key in (
        "rotation",
        "translation",
        "viewpoint",
        "score",
        "confidence",
        "reliable",
        "edge_support",
        "covariance",
        "top",
        "seconds",
        "versions",
        "conventions",
    ):
        assert key in result
    R = torch.tensor(result["rotation"], dtype=torch.float64)
    assert float(rotation_error(R, truth[:3, :3])) < 15
    # CX and CY, swapped, would move the object by 30 px of 260: 0.16 of its distance.
    t = torch.tensor(result["translation"], dtype=torch.float64)
    assert float((t - truth[:3, 3]).norm() / truth[:3, 3].norm()) < 0.05
    assert len(result["top"]) == 3
    overlay = cv2.imread(str(folder / "out" / "overlay.png"))
    assert overlay is not None
    assert overlay.std() > 20
    assert np.shape(result["covariance"]) == (6, 6)
    assert set(result["squared_radius"]) == {"0.5", "0.9", "0.95"}
    deviations = result["standard_deviations"]
    assert deviations["translation"] == pytest.approx([result["covariance"][i][i] ** 0.5 for i in (3, 4, 5)])
    assert all(0 < v < 30 for v in deviations["rotation_deg"])
    printed = capsys.readouterr().out
    assert "viewpoint" in printed
    assert "standard deviations: " in printed


def test_without_box_and_camera(files, capsys):
    folder, box, _ = files
    words = ["register", str(folder / "photo.png"), str(folder / "truck.safetensors"), "--no-refine", "--json"]
    assert main([*words, "--box", *box]) == 0
    assert "localizing the object" not in capsys.readouterr().err
    assert main(words) == 0
    assert "photo.png: localizing the object" in capsys.readouterr().err
    assert run(folder, "photo.png", "truck.safetensors", "--no-refine") == 0
    assert capsys.readouterr().err == ""
    result = json.loads((folder / "out" / "result.json").read_text())
    assert result["translation"] is None
    assert result["covariance"] is None
    assert result["squared_radius"] is None
    assert result["standard_deviations"] is None


def test_a_sideways_photograph_is_registered_as_viewers_show_it(files, capsys):
    folder, box, _ = files
    options = ["--no-refine"]
    assert run(folder, "photo.png", "truck.safetensors", *options, box=box) == 0
    upright = json.loads((folder / "out" / "result.json").read_text())
    # Stored a quarter turn anticlockwise; orientation 6 has viewers turn it back.
    cv2.imwrite(str(folder / "sideways.png"), np.rot90(cv2.imread(str(folder / "photo.png"))))
    with_exif(folder / "sideways.png", exif(6))
    assert run(folder, "sideways.png", "truck.safetensors", *options, box=box) == 0
    result = json.loads((folder / "out" / "result.json").read_text())
    assert result["rotation"] == upright["rotation"]
    assert result["inputs"]["picture"]["orientation"] == 6
    assert upright["inputs"]["picture"]["orientation"] == 1
    assert "sideways.png: EXIF orientation 6 applied" in capsys.readouterr().out
    # A path given in Python is the same photograph.
    bank = ViewBank.load(folder / "truck.safetensors")
    registrar = Registrar(bank, pipeline=unrefined(bank))
    assert registrar([folder / "sideways.png"], [[float(v) for v in box]])[0].rotation.tolist() == result["rotation"]


@pytest.mark.parametrize(("name", "options", "up"), [("y.glb", [], "y"), ("x.ply", ["--up=-x"], "-x")])
def test_upright_meshes_of_another_up_axis(files, monkeypatch, name, options, up):
    folder, box, truth = files
    monkeypatch.setenv("CURVIREG_CACHE", str(folder / "cache"))
    turn = up_rotation(up)
    T = np.eye(4)
    T[:3, :3] = turn.numpy().T
    example_mesh().apply_transform(T).export(folder / name)
    assert run(folder, "photo.png", name, "--pose", "upright", "--no-refine", *options, box=box) == 0
    R = torch.tensor(json.loads((folder / "out" / "result.json").read_text())["rotation"], dtype=torch.float64)
    assert float(rotation_error(R, truth[:3, :3] @ turn)) < 15  # in the file's own frame


def test_bank_then_register(files, capsys):
    folder, box, _ = files
    out = folder / "new.safetensors"
    options = ["--pose", "upright", "--quiet"]
    assert main(["bank", str(folder / "truck.ply"), "--out", str(out), *options]) == 0
    assert "288 views" in capsys.readouterr().out
    assert run(folder, "photo.png", "new.safetensors", "--no-refine", box=box) == 0


@pytest.mark.parametrize(
    ("photo", "mesh", "more", "box", "words"),
    [
        ("photo.png", "none.obj", [], None, ["none.obj", "no such"]),
        ("none.png", "truck.safetensors", [], None, ["none.png", "no such"]),
        ("photo.png", "empty.obj", [], None, ["empty.obj"]),
        ("photo.png", "points.obj", [], None, ["points.obj", "faces"]),
        ("photo.png", "nan.off", [], None, ["nan.off", "NaN"]),
        ("photo.png", "text.jpg", [], None, ["text.jpg", "mesh"]),
        ("text.jpg", "truck.safetensors", [], None, ["text.jpg"]),
        ("flat.png", "truck.safetensors", [], None, ["flat.png", "one colour"]),
        ("photo.png", "broken.safetensors", [], None, ["broken.safetensors", "build"]),
        ("photo.png", "truck.safetensors", [], ["5", "5", "5", "9"], ["X0 < X1"]),
        ("photo.png", "truck.safetensors", [], ["900", "5", "950", "9"], ["wholly outside"]),
        ("photo.png", "truck.safetensors", ["--camera", "0", "260", "119", "89"], None, ["focal"]),
        ("photo.png", "truck.safetensors", ["--top", "0"], None, ["hypotheses"]),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(files, capsys, photo, mesh, more, box, words):
    folder, _, _ = files
    assert run(folder, photo, mesh, *more, box=box) == 2
    error = capsys.readouterr().err.strip()
    assert len(error.splitlines()) == 1
    assert "Traceback" not in error
    for word in words:
        assert word in error


def test_debug_shows_the_traceback(files):
    folder, _, _ = files
    with pytest.raises(FileNotFoundError):
        run(folder, "none.png", "truck.safetensors", "--debug")


def test_a_file_where_the_folder_should_be(files, capsys):
    folder, box, _ = files
    arguments = ["register", str(folder / "photo.png"), str(folder / "truck.safetensors"), "--box", *box, "--no-refine"]
    assert main([*arguments, "--out", str(folder / "photo.png")]) == 2
    assert "--out" in capsys.readouterr().err


def test_cache_is_listed_and_cleared(files, capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path))
    (tmp_path / "banks").mkdir()
    bank = tmp_path / "banks" / f"bank-{'0' * 32}.safetensors"
    bank.write_bytes((files[0] / "truck.safetensors").read_bytes())
    assert main(["cache"]) == 0
    assert "1 banks" in capsys.readouterr().out
    assert main(["cache", "--clear"]) == 0
    assert not bank.exists()


def test_a_bank_that_cannot_be_written(files, capsys):
    folder, _, _ = files
    arguments = ["bank", str(folder / "truck.ply"), "--pose", "upright", "--quiet"]
    assert main([*arguments, "--out", str(folder / "photo.png" / "bank.safetensors")]) == 2
    error = capsys.readouterr().err.strip()
    assert len(error.splitlines()) == 1
    assert "photo.png" in error
    assert "--out" in error


def test_help_names_the_commands(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    for command in ("register", "bank", "evaluate", "demo"):
        assert command in text


def test_demo_runs_as_a_module_and_is_right(tmp_path, monkeypatch):
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path / "cache"))
    command = [sys.executable, "-m", "curvireg_torch", "demo", "--out", str(tmp_path / "demo"), "--quiet"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    result = json.loads((tmp_path / "demo" / "result.json").read_text())
    assert result["rotation_error_deg"] < 15
    assert "error against the truth" in done.stdout
    assert trimesh.load(tmp_path / "demo" / "mesh.ply").is_empty is False
    assert (tmp_path / "demo" / "overlay.png").stat().st_size > 10_000


def test_the_demo_shows_what_it_says(tmp_path, monkeypatch, capsys):
    """Its truth projects into its box, its photograph shows the object there, its error is that of its answer."""
    asked = {}
    monkeypatch.setattr(
        "curvireg_torch.matching.cached_bank", lambda _, **options: asked.update(options) or truck_bank()
    )
    monkeypatch.setattr(RegisterOptions, "open_pipeline", lambda _: truck_bank().pipeline)
    assert main(["demo", "--out", str(tmp_path), "--quiet"]) == 0
    assert asked["progress"] is False
    result = json.loads((tmp_path / "result.json").read_text())
    R, t = (torch.tensor(result["truth"][name], dtype=torch.float64) for name in ("rotation", "translation"))
    found = torch.tensor(result["rotation"], dtype=torch.float64)
    assert result["rotation_error_deg"] == pytest.approx(float(rotation_error(found, R)))
    apart = (torch.tensor(result["translation"], dtype=torch.float64) - t).norm() / t.norm()
    assert result["translation_error"] == pytest.approx(float(apart))
    seen = torch.tensor(trimesh.load(tmp_path / "mesh.ply").vertices.copy()) @ R.T + t
    pixels = 520.0 * seen[:, :2] / seen[:, 2:] + torch.tensor([239.5, 179.5])
    box = torch.cat([pixels.amin(dim=0), pixels.amax(dim=0)])
    assert (torch.tensor(result["inputs"]["box"]) - box).abs().max() < 1.5
    photo = cv2.imread(str(tmp_path / "photo.png"))
    assert photo.shape == (360, 480, 3)
    assert photo.max() > 150
    assert result["inputs"]["seed"] == 0
    said = capsys.readouterr().out
    assert f"rotation {result['rotation_error_deg']:.1f} degrees" in said
    assert f"translation: {', '.join(f'{v:.4g}' for v in result['translation'])} m\n" in said


def test_a_camera_that_is_none_is_refused_before_anything_is_read(files, monkeypatch, capsys):
    monkeypatch.setattr("curvireg_torch.io.read_photo", lambda *_, **__: pytest.fail("it was read"))
    assert run(files[0], "photo.png", "truck.safetensors", "--camera", "0", "260", "119", "89") == 2
    assert "focal" in capsys.readouterr().err


def test_every_preset_that_shares_the_banks_settings_registers(files):
    folder, box, _ = files
    settings = truck_bank().settings
    for preset in ("learned", "classical", "fast"):
        (folder / "own.json").write_text(replace(PRESETS[preset], bank=settings).to_json())
        options = ["--pipeline", str(folder / "own.json"), "--no-refine"]
        assert run(folder, "photo.png", "truck.safetensors", *options, box=box) == 0


def test_a_bank_of_another_pipeline_is_refused(files, capsys):
    folder, box, _ = files
    assert run(folder, "photo.png", "truck.safetensors", "--preset", "paper", box=box) == 2
    assert "made with other settings" in capsys.readouterr().err
    assert run(folder, "photo.png", "truck.safetensors", "--pose", "upright", box=box) == 2
    assert "--pose" in capsys.readouterr().err


def test_a_bank_decides_the_views_unless_the_user_does(files, capsys):
    """A preset says nothing of the views; the file of a pipeline does."""
    folder, box, _ = files
    views = ViewPolicy(pose="upright", azimuth_step=120.0, elevations=(10.0,))
    bank = ViewBank.build(example_mesh(), pipeline=replace(PRESETS["fast"], views=views), progress=False)
    bank.save(folder / "upright.safetensors")
    assert run(folder, "photo.png", "upright.safetensors", "--preset", "fast", box=box) == 0
    assert json.loads((folder / "out" / "result.json").read_text())["pipeline"]["views"]["azimuth_step"] == 120.0
    (folder / "own.json").write_text(PRESETS["fast"].to_json())
    assert run(folder, "photo.png", "upright.safetensors", "--pipeline", str(folder / "own.json"), box=box) == 2
    assert "pose upright, asked for any" in capsys.readouterr().err


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_python_and_the_command_line_give_the_same_bits(files, monkeypatch, preset):
    """One source of defaults: the facade on a mesh file, and the command, for every preset."""
    folder, box, _ = files
    monkeypatch.setenv("CURVIREG_CACHE", str(folder / "doors"))
    # The views of every preset, thinned out: 12 instead of 7200.
    views = ViewPolicy(directions=12, theta_step=360.0)
    (folder / "own.json").write_text(replace(PRESETS[preset], views=views).to_json())
    camera = ["--camera", "260", "260", "119.5", "89.5"]
    assert run(folder, "photo.png", "truck.ply", "--pipeline", str(folder / "own.json"), *camera, box=box) == 0
    written = json.loads((folder / "out" / "result.json").read_text())
    registrar = Registrar(str(folder / "truck.ply"), pipeline=Pipeline.read(folder / "own.json"))
    edges = torch.tensor([[float(v) for v in box]])
    found = registrar([folder / "photo.png"], edges, camera_matrix(260, 260, 119.5, 89.5))[0]
    assert written["rotation"] == found.rotation.tolist()
    assert written["translation"] == found.translation.tolist()
    assert (written["score"], written["confidence"]) == (found.score, found.confidence)
    assert [top["rotation"] for top in written["top"]] == [h.rotation.tolist() for h in found.hypotheses]
    assert written["pipeline"] == registrar.pipeline.describe()


def test_no_option_is_the_default_pipeline_at_every_door(monkeypatch):
    from curvireg_torch.evaluation import evaluate
    from curvireg_torch.registration import registrar

    assert preset_named(DEFAULT) == Pipeline()
    parsed = parse(["register", "a.jpg", "b.stl", "--out", "c"])
    assert register_options(parsed).open_pipeline() == Pipeline()
    assert inspect.signature(evaluate).parameters["preset"].default == DEFAULT
    asked = []
    monkeypatch.setattr(registrar, "cached_bank", lambda *_, pipeline, **__: asked.append(pipeline) or truck_bank())
    with pytest.raises(BankError):  # the truck's bank is not what was asked for
        Registrar(example_mesh())
    assert asked == [Pipeline()]


def test_adapted_field_from_bank_to_register(files, monkeypatch, capsys):
    folder, box, _ = files
    called = {}

    def quick(mesh, *, upright, workers, progress):
        called["upright"] = upright
        assert workers == 1
        return adapt(mesh, scenes=16, upright=upright, progress=progress)

    monkeypatch.setattr("curvireg_torch.training.adapt", quick)
    small = Pipeline(views=ViewPolicy(azimuth_step=90, elevations=(20,)), bank=BankSettings(image_size=64))
    monkeypatch.setitem(PRESETS, DEFAULT, small)
    out, field = folder / "own.safetensors", folder / "own_field.safetensors"
    arguments = ["bank", str(folder / "truck.ply"), "--pose", "upright", "--out", str(out), "--adapt", str(field)]
    assert main([*arguments, "--quiet"]) == 0
    assert called["upright"] == 1.0
    assert "adapted field" in capsys.readouterr().out
    assert run(folder, "photo.png", "own.safetensors", "--field", str(field), "--no-refine", box=box) == 0
    told = json.loads((folder / "out" / "result.json").read_text())["pipeline"]
    assert told["weights"] == small.with_field(LearnedCurvilinearSaliency(weights=field)).weights != small.weights
    assert run(folder, "photo.png", "own.safetensors", "--field", str(folder / "none"), box=box) == 2


@pytest.mark.parametrize(
    ("pose", "more", "told", "untold"),
    [
        ("any", {}, "the box is tight and the mesh is the object's\n", "no box"),
        ("upright", {}, "(--pose upright, --up)\n", "no box"),
        ("any", {"localization": {"instances": []}}, "no box was given: add --box, and check that the mesh", "tight"),
        ("any", {"corrected_box": [1.2, 2.0, 30.6, 40.0]}, "did not fit the pose; one that does: 1 2 31 40\n", "found"),
    ],
)
def test_what_to_check_where_nothing_is_reliable(pose, more, told, untold, tmp_path, capsys):
    document = {
        "viewpoint": {"azimuth": 1.0}, "score": 0.2, "confidence": 0.1, "reliable": False, "translation": None,
        "standard_deviations": None, "seconds": {"bank": 1.0, "register": 2.0}, "corrected_box": None,
        "pipeline": Pipeline().with_pose_prior(pose).describe(), **more,
    }  # fmt: skip
    print_result(document, tmp_path)
    printed = capsys.readouterr().out
    assert told in printed
    assert untold not in printed

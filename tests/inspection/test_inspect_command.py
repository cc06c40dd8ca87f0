"""The command ``curvireg inspect``: its files, and what it says of bad input."""

import io
import json
from dataclasses import replace

import pytest
import torch
import trimesh

from curvireg_torch.cli import main
from curvireg_torch.errors import CurviregError
from curvireg_torch.pipeline import BankSettings, Pipeline, ViewPolicy
from curvireg_torch.synthetic import example_mesh
from tests._support import write_photo

QUICK = replace(
    Pipeline(),
    views=ViewPolicy(pose="upright", azimuth_step=60.0, elevations=(10.0, 40.0)),
    bank=BankSettings(image_size=64),
)


@pytest.fixture
def inspect(tmp_path, monkeypatch):
    """Runs the command on a mesh in metres, with few views; returns its exit code and the folder of
    the report."""
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("curvireg_torch.inspection.look_alikes.LOOKED_AT", 12)
    (tmp_path / "few.json").write_text(QUICK.to_json())

    def run(name, *words):
        out = tmp_path / "out"
        few = ["--unit", "m", "--pipeline", str(tmp_path / "few.json")]
        return main(["inspect", str(tmp_path / name), *few, "--out", str(out), *words]), out

    return run


def report_in(folder):
    return json.loads((folder / "inspect.json").read_text())


@pytest.mark.slow
def test_report_and_page(tmp_path, capsys, inspect, monkeypatch):
    terminal = io.StringIO()
    terminal.isatty = lambda: True
    monkeypatch.setattr("sys.stderr", terminal)
    example_mesh().export(tmp_path / "truck.ply")
    code, out = inspect("truck.ply", "--n", "2", "--clutter")
    assert code == 0
    document = report_in(out)
    expected = document["expected"]
    assert {"n", "right", "reliable", "median_deg"} <= expected.keys()
    assert (expected["n"], expected["clutter"], expected["with_camera"]) == (2, True, True)
    low, high = expected["right_interval"]
    assert 0.0 <= low <= expected["right"] <= high <= 1.0
    assert document["symmetries"] == []
    assert isinstance(document["warnings"], list)
    assert set(expected["compared"]) == {
        "without a camera",
        "with a pose prior within 45 degrees",
        "with a second photograph from another side",
        "with a print, also in the mesh: orientations that look alike without count as wrong",
    }
    assert all(pair["n"] == 1 for both in expected["compared"].values() for pair in both.values())
    page = (out / "inspect.html").read_text()
    assert page.count("data:image/jpeg") >= 4, "two pairs of views"
    assert page.count("<td>the first 1 of all</td>") == 1, "what four are compared with is one row"
    assert "other objects around it" in page
    assert "expected: right in" in capsys.readouterr().out
    stages = [line.split(":")[0] for line in terminal.getvalue().split("\r") if ":" in line]
    order = ["reading the mesh", "rendering views", "look-alikes", "photographs"]
    assert [name for name in dict.fromkeys(stages) if name in order] == order


def test_backgrounds_are_ones_own_photographs(tmp_path, inspect, monkeypatch):
    example_mesh().export(tmp_path / "truck.ply")
    (tmp_path / "places").mkdir()
    red = torch.tensor([0.8, 0.0, 0.0])[:, None, None]
    write_photo(tmp_path / "places" / "wall.png", red.expand(3, 60, 80))
    seen = []

    def trial(*arguments, **_):
        seen.append(arguments[1](0).image[:, 0, 0].tolist())
        raise CurviregError("seen")

    monkeypatch.setattr("curvireg_torch.inspection.report.run_trial", trial)
    monkeypatch.setattr("curvireg_torch.inspection.report.look_alikes", lambda *_: ())
    inspect("truck.ply", "--photo", str(tmp_path / "places"))
    red, green, blue = seen[0]
    assert red > 180
    assert green < 20
    assert blue < 20


def test_a_mesh_that_cannot_work_ends_with_code_3_if_strict(tmp_path, capsys, inspect):
    box = trimesh.creation.box((5.0, 4.0, 2.6))
    mesh = trimesh.Trimesh(box.vertices, box.faces[:, ::-1])
    mesh.export(tmp_path / "mesh.ply")
    code, out = inspect("mesh.ply", "--strict")
    assert code == 3
    assert "as a room's do" in capsys.readouterr().out
    document = report_in(out)
    assert document["hopeless"]
    assert document["expected"] is None
    assert inspect("mesh.ply")[0] == 0


def test_a_mesh_without_area_is_refused_in_one_line(tmp_path, capsys, inspect):
    (tmp_path / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
    assert inspect("flat.obj")[0] == 2
    said = capsys.readouterr().err.strip().split("\n")
    assert "flat.obj" in said[-1]
    assert "Traceback" not in "".join(said)


@pytest.mark.filterwarnings("default")
def test_a_kilometre_and_missing_textures_are_warned_of(tmp_path, capsys, inspect, monkeypatch):
    monkeypatch.setattr("curvireg_torch.inspection.report.look_alikes", lambda *_: ())
    text = example_mesh().apply_scale(4000.0).export(file_type="obj")
    (tmp_path / "truck.obj").write_text("mtllib paint.mtl\nusemtl red\n" + text)
    code, out = inspect("truck.obj", "--n", "0")
    assert code == 0
    warnings = report_in(out)["warnings"]
    assert any("m across: is its unit really m; usual would be mm" in text for text in warnings)
    assert any("paint.mtl" in text for text in warnings)
    assert "warning:" in capsys.readouterr().out


@pytest.mark.slow
def test_a_million_faces_take_bounded_time_and_are_said(tmp_path, inspect):
    mesh = trimesh.creation.icosphere(8)
    stretch = 1.0 + 0.3 * (mesh.vertices[:, :1] > 0.3) * mesh.vertices[:, 1:2]
    mesh.vertices = 0.1 * mesh.vertices * stretch * (1.0, 0.8, 0.6)
    assert len(mesh.faces) > 1_000_000
    mesh.export(tmp_path / "fine.ply")
    code, out = inspect("fine.ply", "--n", "2")
    assert code == 0
    document = report_in(out)
    assert document["expected"]["n"] == 2
    assert any("1,310,720 faces: contours use 8,000" in text for text in document["warnings"])

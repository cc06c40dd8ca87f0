"""``curvireg register --views``: rigs as CSV, COLMAP models and BOP scenes, and the files of one
pose."""

import json
from pathlib import Path

import cv2
import pytest
import torch
import trimesh

from curvireg_torch import Registration
from curvireg_torch.cli import main
from curvireg_torch.cli.register import NONE_RELIABLE
from curvireg_torch.jobs.rigs import read_rig
from tests._support.lists import (
    RIG_HEADER,
    check_pose,
    write_bop_scene,
    write_colmap,
    write_rig_photos,
    written,
)
from tests.registration.test_several import WORLD


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    """A folder with three photographs of one pose, and the rows of their rig."""
    folder = tmp_path_factory.mktemp("rig")
    return folder, write_rig_photos(folder)


def register(folder, rig, out, *words):
    files = ["--views", str(rig), str(folder / "learned.safetensors"), "--out", str(out)]
    return main(["register", *files, "--quiet", *words])


def test_views_write_one_pose_in_the_world(rig, folder, tmp_path, monkeypatch, capsys):
    place, rows = rig
    monkeypatch.setattr(Registration, "verdict", "unsure")
    path = written(place / "rig.csv", RIG_HEADER, *rows, ["none.png", *rows[0][1:]])
    assert register(folder, path, tmp_path, "--format", "ros", "--strict") == NONE_RELIABLE
    document = json.loads((tmp_path / "result.json").read_text())
    check_pose(document, WORLD, 1.5, 0.1 / float(WORLD[:3, 3].norm()))
    assert (document["frame"], document["T_cam_from_model"]) == ("world", None)
    views = document["photographs"]
    names = [row[0] for row in rows]
    assert [view["photo"] for view in views] == [str(place / name) for name in [*names, "none.png"]]
    assert [view["failure"] is None for view in views] == [True] * 3 + [False]
    assert "no such file" in views[3]["failure"]
    assert views[0]["camera"]["matrix"][0] == [260.0, 0.0, 119.5]
    printed = capsys.readouterr().out
    assert "row 1: 0.png: prefers the pose by " in printed
    assert "(about and along the world's axes)" in printed
    assert "row 4: none.png: " in printed
    # All photographs are shown; their cameras stand in the scene.
    assert cv2.imread(str(tmp_path / "overlay.png")).shape[1] == 1600
    scene = trimesh.load(tmp_path / "pose.glb")
    assert sum(name.startswith("picture") for name in scene.graph.nodes_geometry) == 3
    assert "frame_id: world" in (tmp_path / "pose.yaml").read_text()


def test_read_rig_reads_colmap_and_bop(rig, tmp_path):
    rows = rig[1]
    (tmp_path / "images").mkdir()
    for row in rows:
        (tmp_path / "images" / row[0]).touch()
    write_colmap(tmp_path, rows, points="12.0 13.0 -1")
    bop = tmp_path / "bop"
    bop.mkdir()
    write_bop_scene(bop, rows, [[7, 5]] * 3, [[1, 2, 3, 4], [5, 6, 20, 30]])
    for path, mesh, box in (
        (tmp_path, None, None),
        (bop, Path("obj_000005.ply"), (5.0, 6.0, 25.0, 36.0)),
    ):
        views = read_rig(path, mesh)
        assert [view.box for view in views] == [box] * 3
        for view, row in zip(views, rows, strict=True):
            R = torch.tensor(row[9:18]).double().view(3, 3)
            torch.testing.assert_close(view.T_cam_from_world[:3, :3], R, atol=1e-6, rtol=0)
            assert view.T_cam_from_world[:3, 3].tolist() == pytest.approx(row[18:], abs=1e-6)
            assert view.camera.matrix[:2].tolist() == [[260.0, 0.0, 119.5], [0.0, 260.0, 89.5]]
    model = tmp_path / "sparse" / "0"  # where COLMAP writes it
    model.mkdir(parents=True)
    for name in ("images.txt", "cameras.txt"):
        (model / name).write_text((tmp_path / name).read_text())
    for path in (tmp_path, model, model / "images.txt"):
        assert [view.photo.is_file() for view in read_rig(path)] == [True] * 3

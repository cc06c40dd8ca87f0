"""``curvireg register --views``: rigs as CSV, COLMAP models and BOP scenes, and the files of one pose."""

import json
from pathlib import Path

import cv2
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from curvireg_torch.cli import main
from curvireg_torch.evaluation.rigs import read_rig
from tests._support.lists import CAMERA, check_pose, written
from tests.registration.test_several import EASY, WORLD, rig_of

SHARE = 0.1 / float(WORLD[:3, 3].norm())
COLUMNS = [*("photo", "x0", "y0", "x1", "y1", "fx", "fy", "cx", "cy")]
POSE = [*(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)), "tx", "ty", "tz"]


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    """A folder with three photographs of one pose, and the rows of their rig."""
    folder = tmp_path_factory.mktemp("rig")
    rows = []
    for k, (image, box, T) in enumerate(zip(*rig_of(EASY), strict=True)):
        picture = (image.permute(1, 2, 0).flip(-1) * 255).round().byte().numpy()
        cv2.imwrite(str(folder / f"{k}.png"), picture)
        pose = [*T[:3, :3].flatten().tolist(), *T[:3, 3].tolist()]
        rows.append([f"{k}.png", *box.tolist(), *CAMERA, *pose])
    return folder, rows


def register(folder, rig, out, *words):
    command = ["register", "--views", str(rig), str(folder / "learned.safetensors"), "--quiet", "--out", str(out)]
    return main([*command, *words])


def test_views_write_one_pose_in_the_world(rig, folder, tmp_path, capsys):
    place, rows = rig
    path = written(place / "rig.csv", ",".join([*COLUMNS, *POSE]), *rows, ["none.png", *rows[0][1:]])
    assert register(folder, path, tmp_path, "--format", "ros") == 0
    document = json.loads((tmp_path / "result.json").read_text())
    check_pose(document, WORLD, 1.5, SHARE)
    assert (document["frame"], document["T_cam_from_model"]) == ("world", None)
    assert [view["photo"] for view in document["views"]] == [str(place / row[0]) for row in [*rows, ["none.png"]]]
    assert [view["failure"] is None for view in document["views"]] == [True, True, True, False]
    assert "no such file" in document["views"][3]["failure"]
    assert document["views"][0]["camera"]["matrix"][0] == [260.0, 0.0, 119.5]
    assert Rotation.from_quat([document["quaternion"][k] for k in (1, 2, 3, 0)]).as_matrix() == pytest.approx(
        torch.tensor(document["rotation"]).numpy(), abs=1e-6
    )
    printed = capsys.readouterr().out
    assert "row 1: 0.png: prefers the pose by " in printed
    assert "row 4: none.png: " in printed
    # All photographs are shown; their cameras stand in the scene.
    assert cv2.imread(str(tmp_path / "overlay.png")).shape[1] == 1600
    scene = trimesh.load(tmp_path / "pose.glb")
    assert sum(name.startswith("picture") for name in scene.graph.nodes_geometry) == 3
    assert "frame_id: world" in (tmp_path / "pose.yaml").read_text()


def test_views_of_quaternions_and_calibration_files(rig, folder, tmp_path):
    place, rows = rig
    (place / "cameras.txt").write_text("1 PINHOLE 480 360 520 520 240 180\n")  # of twice the size
    some = []
    for row in rows:
        x, y, z, w = Rotation.from_matrix(torch.tensor(row[9:18]).view(3, 3).numpy()).as_quat()
        some.append([*row[:5], "cameras.txt", w, x, y, z, *row[18:]])
    some[1][1:5] = [""] * 4  # the others say where the object is
    path = written(place / "q.csv", "photo,x0,y0,x1,y1,camera,qw,qx,qy,qz,tx,ty,tz", *some)
    assert register(folder, path, tmp_path) == 0
    check_pose(json.loads((tmp_path / "result.json").read_text()), WORLD, 1.5, SHARE)


def test_read_rig_reads_colmap_and_bop(rig, tmp_path):
    place, rows = rig
    expected = [torch.tensor(row[9:18]).double().view(3, 3) for row in rows]
    (tmp_path / "images").mkdir()
    lines = ["# Image list"]
    scene: dict = {}
    for k, row in enumerate(rows):
        x, y, z, w = Rotation.from_matrix(expected[k].numpy()).as_quat()
        lines += [f"{k + 1} {w} {x} {y} {z} {row[18]} {row[19]} {row[20]} 1 {row[0]}", "12.0 13.0 -1"]
        (tmp_path / "images" / row[0]).write_bytes((place / row[0]).read_bytes())
        K = [260.0, 0.0, 119.5, 0.0, 260.0, 89.5, 0.0, 0.0, 1.0]
        scene[str(k)] = {"cam_K": K, "cam_R_w2c": row[9:18], "cam_t_w2c": row[18:]}
    (tmp_path / "images.txt").write_text("\n".join(lines))
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 240 180 260 260 120 90\n")
    bop = tmp_path / "bop"
    bop.mkdir()
    (bop / "scene_camera.json").write_text(json.dumps(scene))
    truth = {str(k): [{"obj_id": 7 if k < 2 else 5}, {"obj_id": 5}] for k in range(3)}  # twice in the last photograph
    (bop / "scene_gt.json").write_text(json.dumps(truth))
    info = {str(k): [{"bbox_obj": [1, 2, 3, 4]}, {"bbox_obj": [5, 6, 20, 30]}] for k in range(3)}
    (bop / "scene_gt_info.json").write_text(json.dumps(info))
    for path, mesh, box in ((tmp_path, None, None), (bop, Path("obj_000005.ply"), (5.0, 6.0, 25.0, 36.0))):
        views = read_rig(path, mesh)
        assert [view.box for view in views] == [box, box, None]
        for view, R, row in zip(views, expected, rows, strict=True):
            torch.testing.assert_close(view.T_cam_from_world[:3, :3], R, atol=1e-6, rtol=0)
            assert view.T_cam_from_world[:3, 3].tolist() == pytest.approx(row[18:], abs=1e-6)
            assert view.camera.matrix[:2].flatten().tolist() == [260.0, 0.0, 119.5, 0.0, 260.0, 89.5]
    model = tmp_path / "sparse" / "0"  # where COLMAP writes it
    model.mkdir(parents=True)
    for name in ("images.txt", "cameras.txt"):
        (model / name).write_text((tmp_path / name).read_text())
    for path in (tmp_path, model, model / "images.txt"):
        assert [view.photo.is_file() for view in read_rig(path)] == [True] * 3

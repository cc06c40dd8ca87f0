"""scripts/speed/follow.py and the sequences it follows: motion, true poses, errors, and the table."""

import json
from itertools import pairwise

import cv2
import numpy as np
import pytest
import torch

import curvireg_torch as cr
from curvireg_torch.geometry import rotation_from_axis_angle
from curvireg_torch.rendering import render_depth
from curvireg_torch.synthetic import example_mesh, random_pose
from scripts import _rapid
from scripts.benchmark import sequences
from scripts.benchmark.make import Meshes
from scripts.benchmark.sequences import MAX_SHIFT, MAX_TURN, MIN_VISIBLE, camera_path, make_sequence, step_between
from scripts.speed import follow

K = cr.camera_matrix(800.0, 800.0, 319.5, 239.5, dtype=torch.float64)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A benchmark of one mesh, the truck, and one texture."""
    folder = tmp_path_factory.mktemp("bench")
    (folder / "truck").mkdir()
    mesh = example_mesh()
    mesh.export(folder / "truck" / "model.obj")
    noise = np.random.default_rng(0).integers(0, 255, (128, 128, 3), dtype=np.uint8)
    cv2.imwrite(str(folder / "truck" / "print.jpg"), noise)
    row = {"id": "truck", "path": "truck/model.obj", "half": "held-out", "kind": None, "like": 0, "faces": 500}
    row |= {"extents": mesh.extents.tolist(), "look_symmetries": [0], "shape_symmetries": [0]}
    (folder / "meshes.json").write_text(json.dumps({"turns": [np.eye(3).tolist()], "meshes": [row]}))
    return folder


@pytest.fixture(scope="module")
def made(folder):
    return make_sequence(Meshes(folder, "held-out"), 5, 1, 4)


def test_camera_path_starts_at_the_pose_and_is_smooth():
    R, centre = np.diag([1.0, -1.0, -1.0]), np.array([0.1, 0.2, 4.0])
    path = camera_path(R, centre, K.numpy(), 200, np.random.default_rng(3))
    assert np.allclose(path[0][0], R)
    assert np.allclose(path[0][1], centre)
    turns, shifts = np.array([step_between(a, b) for a, b in pairwise(path)]).T
    assert turns.max() <= MAX_TURN
    assert shifts.max() <= MAX_SHIFT
    assert turns.max() > 0.9 * MAX_TURN
    assert shifts.max() > 0.9 * MAX_SHIFT
    places = np.array([place for _, place in path])
    steps = np.diff(places, axis=0)
    assert (steps[1:] * steps[:-1]).sum() > 0.5 * (steps**2).sum()  # a velocity persists
    assert np.abs(places[:, :2] / places[:, 2:] * 800).max() < 250  # the object stays in the picture
    assert step_between((np.eye(3), centre), (np.eye(3), 1.1 * centre)) == pytest.approx((0.0, 0.1))


def test_sequence_shows_the_object_at_its_true_poses(folder, made):
    assert made.poses.shape == (4, 4, 4)
    assert made.visible.min() >= MIN_VISIBLE
    mesh = cr.load_mesh(folder / made.mesh)
    frames = list(made.frames())
    assert {(tuple(frame.shape), frame.dtype) for frame in frames} == {((3, *sequences.SIZE), torch.uint8)}
    assert torch.equal(frames[0], next(made.frames()))
    for T, step in zip(made.poses, made.scene.path, strict=True):
        _, seen, whole = made.scene.render(*step, sequences.SIZE)
        depth = render_depth(mesh, T, made.camera_matrix, sequences.SIZE)[0, 0].numpy()
        assert ((depth > 0) ^ whole).sum() < 0.03 * whole.sum()
        assert not (seen & ~whole).any()


def test_chains_follow_the_nearest_rotation():
    angles = torch.tensor([0.0, 100.0, 20.0, 10.0, 108.0, 250.0, 117.0], dtype=torch.float64)
    zero = torch.zeros_like(angles)
    rotations = cr.rotation_from_viewpoint(angles, zero, zero)
    assert follow.chains(rotations, 15.0) == [[0, 3, 2], [1, 4, 6]]


def test_follow_video_measures_each_frame_but_the_first(folder, made):
    mesh = cr.load_mesh(folder / made.mesh)
    half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64))
    symmetries = torch.stack([torch.eye(3, dtype=torch.float64), half_turn])
    frames = [torch.full((3, 4, 4), k, dtype=torch.uint8) for k in range(4)]
    video = follow.Video("truck", mesh, K, made.poses, symmetries, frames)

    def turned(frame):
        """The other symmetric pose about the centre, 10 % too far; the third frame is lost."""
        if int(frame[0, 0, 0]) == 2:
            return None
        T, centre = made.poses[int(frame[0, 0, 0])].clone(), follow.mesh_centre(mesh)
        place = 1.1 * (T[:3, :3] @ centre + T[:3, 3])
        T[:3, :3] = T[:3, :3] @ half_turn
        T[:3, 3] = place - T[:3, :3] @ centre
        return T

    found = follow.follow_video(video, {"turned": turned})["turned"]
    assert found["degrees"] == pytest.approx([0.0, None, 0.0], abs=1e-4)
    assert found["fraction"] == pytest.approx([0.1, None, 0.1])
    assert len(found["seconds"]) == 3


def test_table_of_known_rows():
    def row(kind, name, degrees, fraction, rapid=True):
        one = {"degrees": degrees, "fraction": fraction, "seconds": [0.1] * len(degrees)}
        other = {"degrees": [6.0] * len(degrees), "fraction": [0.0] * len(degrees), "seconds": [0.05] * len(degrees)}
        methods = {"curvireg": one, **({"cv2.rapid": other} if rapid else {})}
        return {"set": kind, "name": name, "threads": 2, "steps": [2.0, 3.0, 4.0], "methods": methods}

    rows = [
        row("generated", "a", [4.9, 5.1, 4.9], [0.04, 0.0, 0.06]),
        row("generated", "b", [1.0, None, 1.0], [0.01, None, 0.01], rapid=False),
    ]
    record = follow.record_of([*rows, row("dino", "c", [1.0, 1.0, 1.0], [0.0, 0.0, 0.0])])
    ours = record["sets"]["generated"]["methods"]["curvireg"]
    assert (ours["frames"], ours["right"], ours["lost"], ours["last frame right"]) == (6, 0.5, 1 / 6, 0.5)
    assert ours["frames per second"] == pytest.approx(10.0)
    rapid = record["sets"]["generated"]["methods"]["cv2.rapid"]
    assert (rapid["frames"], rapid["right"], rapid["lost"]) == (3, 0.0, 0.0)
    lines = follow.table(record).splitlines()
    assert lines[2] == "| generated | `curvireg` | 6 | 0.50 | 0.17 | 0.50 | 10.0 |"
    assert lines[5].startswith("| dino photographs | `cv2.rapid` | 3 |")
    assert "generated: 2 sequences, steps of 3.0° (median) to 4.0°" in lines[-1]
    assert "Threads of torch: 2;" in lines[-1]


def test_page_has_the_recorded_table():
    if not follow.RECORD.exists():
        pytest.skip("not measured yet")
    table = follow.table(json.loads(follow.RECORD.read_text(encoding="utf-8")))
    assert f"<!-- follow:begin -->\n{table}<!-- follow:end -->" in follow.PAGE.read_text(encoding="utf-8")


@pytest.mark.skipif(not _rapid.AVAILABLE, reason=_rapid.ABSENT)
def test_rapid_finds_a_plain_object_from_a_start_nearby():
    mesh = example_mesh()
    T = random_pose(mesh, K, (480, 640), torch.Generator().manual_seed(1))
    mask = render_depth(mesh, T, K, (480, 640))[0] > 0
    start = T.clone()
    small = torch.deg2rad(torch.tensor([2.0, -1.0, 1.0], dtype=torch.float64))
    start[:3, :3] = rotation_from_axis_angle(small) @ T[:3, :3]
    start[:3, 3] *= 1.04
    found = _rapid.Rapid(mesh)((40 + 160 * ~mask).byte().expand(3, -1, -1), K, start)
    assert float(cr.rotation_error(found[:3, :3], T[:3, :3])) < 0.7
    assert float((found[:3, 3] - T[:3, 3]).norm() / T[:3, 3].norm()) < 0.012  # its outline is a pixel too large

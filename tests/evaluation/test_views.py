"""``--protocol views=3``: which photographs are registered together, and what is scored."""

import json
from collections import Counter

import pytest
import torch
from numpy.testing import assert_allclose
from torch.testing import assert_close

from curvireg_torch.data import BOPDataset
from curvireg_torch.errors import CurviregWarning
from curvireg_torch.evaluation import BOPBenchmark, Protocol
from curvireg_torch.evaluation.bop import same_instances
from curvireg_torch.geometry import transform
from curvireg_torch.mesh import mesh_radius
from curvireg_torch.synthetic import example_mesh
from tests._support import CAMERA, write_photo
from tests._support.miniature import write_json
from tests._support.small import rows_of, run
from tests._support.tables import check_values
from tests.registration.test_several import WORLD, photograph


def photograph_in_mm(azimuth):
    """Picture, box and ``T_cam_from_model`` of the truck."""
    image, box, T = photograph(azimuth, int(azimuth), 0.0)
    return image, box, transform(T[:3, :3], 1000.0 * T[:3, 3])


@pytest.fixture
def trucks(tmp_path):
    """Two scenes of four photographs of one truck: in the first the poses of the cameras are
    known."""
    root = tmp_path / "trucks"
    azimuths = (30.0, 70.0, 110.0, 150.0)
    for scene in (1, 2):
        folder = root / "test" / f"{scene:06d}"
        gt = {}
        info = {}
        cameras = {}
        (folder / "rgb").mkdir(parents=True)
        for number, azimuth in enumerate(azimuths):
            image, box, T = photograph_in_mm(azimuth)
            write_photo(folder / "rgb" / f"{number:06d}.png", image)
            x0, y0, x1, y1 = box.tolist()
            gt[number] = [{"obj_id": 1, **in_bop(T, "m2c")}]
            info[number] = [{"bbox_obj": [x0, y0, x1 - x0, y1 - y0], "visib_fract": 1.0}]
            cameras[number] = {"cam_K": CAMERA.flatten().tolist()}
            if scene == 1:
                cameras[number] |= in_bop(T @ torch.linalg.inv(WORLD), "w2c")
        for name, content in (("gt", gt), ("gt_info", info), ("camera", cameras)):
            write_json(folder / f"scene_{name}.json", content)
    mesh = example_mesh().apply_scale(1000.0)
    models = {"1": {"diameter": 2.0 * mesh_radius(mesh)}}
    write_json(root / "models" / "models_info.json", models)
    mesh.export(root / "models" / "obj_000001.ply")
    return BOPDataset(root)


def in_bop(T, frames):
    """A rigid transform as files of BOP have it."""
    return {f"cam_R_{frames}": T[:3, :3].flatten().tolist(), f"cam_t_{frames}": T[:3, 3].tolist()}


def drawn_by(benchmark):
    """The photographs that are registered with each."""
    return [[view.photo for view in entry.views] for entry in benchmark.entries]


def test_each_photograph_is_the_first_once_and_relative_poses_are_right(trucks):
    benchmark = BOPBenchmark(trucks, Protocol(pose="any", views=3))
    truths = {
        entry.photo: transform(s["rotation"].double(), s["translation"].double())
        for entry, s in zip(benchmark.entries, benchmark.samples, strict=True)
    }
    assert len(truths) == 8
    for entry in benchmark.entries:
        photos = {view.photo for view in entry.views}
        assert len(photos | {entry.photo}) == 3
        assert {photo.parts[-3] for photo in photos} == {entry.photo.parts[-3]}, "of the same scene"
        for view in entry.views:
            relative = view.T_cam_from_world
            expected = truths[view.photo] @ torch.linalg.inv(truths[entry.photo])
            assert_close(relative, expected, atol=1e-3, rtol=0)
    drawn = drawn_by(benchmark)
    assert drawn == drawn_by(BOPBenchmark(trucks, Protocol(pose="any", views=3)))
    assert drawn != drawn_by(BOPBenchmark(trucks, Protocol(pose="any", views=3, seed=1)))
    fewer = "views=9: 8 of 8 objects are seen in fewer photographs"
    with pytest.warns(CurviregWarning, match=fewer):
        many = BOPBenchmark(trucks, Protocol(pose="any", views=9))
    assert {len(photos) for photos in drawn_by(many)} == {3}
    assert not any(drawn_by(BOPBenchmark(trucks, Protocol(pose="any"))))


def test_poses_of_the_cameras_come_first(trucks):
    """The annotated poses say how the object moved, those of the cameras do not."""
    path = trucks.root / "test" / "000001" / "scene_gt.json"
    content = json.loads(path.read_text())
    content["0"][0]["cam_t_m2c"][2] *= 1.001
    write_json(path, content)
    benchmark = BOPBenchmark(BOPDataset(trucks.root), Protocol(pose="any", views=4))
    truths = [photograph_in_mm(azimuth)[2] for azimuth in (30.0, 70.0, 110.0, 150.0)]
    for view in benchmark.entries[0].views:
        expected = truths[int(view.photo.stem)] @ torch.linalg.inv(truths[0])
        assert_close(view.T_cam_from_world, expected, atol=1e-3, rtol=0)


def sample(image, place=None, instance=0):
    """An object at a place of the world, None for an unknown camera; the camera moves with the
    image's number."""
    T = torch.eye(4)
    T[0, 3] = image
    t = torch.tensor(place or (0.0, 0.0, 0.0)) + T[:3, 3]
    known = {"translation": t, "T_cam_from_world": T * torch.nan if place is None else T}
    ids = {"scene_id": 1, "image_id": image, "obj_id": 1, "instance_index": instance}
    return {**ids, **known, "model_info": {"diameter": 20.0}}


def test_instances_are_told_apart_by_their_place():
    near = (0.0, 0.0, 100.0)
    far = (30.0, 0.0, 100.0)
    swapped = [sample(0, near), sample(0, far, 1), sample(1, far), sample(1, near, 1)]
    swapped += [sample(2, (3.0, 0.0, 100.0)), sample(3, (1.5, 0.0, 100.0))]
    assert same_instances(swapped) == [[0, 3, 5], [1, 2], [4]]
    assert same_instances([sample(0), sample(1, instance=3)]) == [[0, 1]], "one in each photograph"
    listed = [sample(0), sample(0, instance=1), sample(1, instance=1), sample(1)]
    assert same_instances(listed) == [[0, 3], [1, 2]]


@pytest.mark.slow
def test_evaluation_scores_the_pose_in_the_first_photograph(trucks, out):
    benchmark = BOPBenchmark(trucks, Protocol(pose="any", views=3))
    broken = trucks.root / "test" / "000002" / "rgb" / "000003.png"
    broken.write_bytes(b"no picture")
    summary = run(benchmark, out)
    protocol = "cad=annotated pose=any box=annotated views=3 seed=0"
    skipped = {"unreadable_image": 1}
    check_values(summary, protocol=protocol, n=7, failed=0, skipped=skipped)
    failures = Counter()
    for row in rows_of(benchmark, out).values():
        if row["verdict"] == "failed":
            continue
        first, _, _ = row["photographs"]
        assert_allclose(first["rotation"], row["rotation"])
        assert_allclose(first["translation"], row["translation"])
        failures.update(view["failure"] is not None for view in row["photographs"])
    others = [entry for entry in benchmark.entries if entry.photo != broken]
    drawn = sum(view.photo == broken for entry in others for view in entry.views)
    assert failures[True] >= drawn > 0, "a photograph that cannot be read does not spoil the others"
    assert summary["acc_30_deg"] > 0.5
    assert not run(benchmark, out)["failed"]

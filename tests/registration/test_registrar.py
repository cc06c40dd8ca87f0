import pytest
import torch

from curvireg_torch import Registrar, ViewBank, rotation_error, sample_views
from curvireg_torch.errors import ImageError, InvalidInputError
from curvireg_torch.registration import RELIABLE, distinct_views
from curvireg_torch.synthetic import example_mesh
from tests._support.scenes import CAMERA, scene, truck_bank

SEEDS = range(6)


@pytest.fixture(scope="module")
def registered() -> tuple[list, list]:
    """Six scenes of known truth, before and after refinement."""
    images, boxes = [scene(s)[0] for s in SEEDS], torch.stack([scene(s)[1] for s in SEEDS])
    coarse = Registrar(truck_bank(), refine=False)(images, boxes, CAMERA)
    return coarse, Registrar(truck_bank())(images, boxes, CAMERA)


def rotation_errors(results: list) -> torch.Tensor:
    return torch.stack([rotation_error(r.rotation, scene(s)[2][:3, :3]) for r, s in zip(results, SEEDS, strict=True)])


def test_poses_of_synthetic_scenes(registered):
    coarse, fine = registered
    assert int((rotation_errors(coarse) < 20).sum()) >= 5
    right = rotation_errors(coarse) < 20
    assert float(rotation_errors(fine)[right].median()) < 4
    assert float(rotation_errors(fine)[right].median()) <= float(rotation_errors(coarse)[right].median())
    for result, seed, is_right in zip(fine, SEEDS, right, strict=True):
        truth = scene(seed)[2][:3, 3]
        assert result.translation is not None
        if is_right:
            assert float((result.translation - truth).norm() / truth.norm()) < 0.05


def test_results_are_proper_poses(registered):
    for result in registered[1]:
        torch.testing.assert_close(result.rotation @ result.rotation.T, torch.eye(3, dtype=torch.float64))
        assert float(torch.linalg.det(result.rotation)) == pytest.approx(1.0)
        assert 0 <= result.score <= 1
        assert 0 <= result.confidence <= 1
        assert result.reliable == (result.confidence >= RELIABLE)
        assert result.iterations > 0
        azimuth, elevation, theta = result.viewpoint
        assert 0 <= azimuth < 360
        assert -90 <= elevation <= 90
        assert -180 <= theta < 180


def test_without_a_camera_there_is_no_translation():
    image, box, _ = scene(0)
    result = Registrar(truck_bank(), refine=False)(image[None], box[None])[0]
    assert result.translation is None
    assert result.transform is None
    assert result.rotation.equal(result.view_rotation)


def test_batched_equals_one_by_one(registered):
    image, box, _ = scene(1)
    alone = Registrar(truck_bank())([image], box[None], CAMERA)[0]
    torch.testing.assert_close(alone.rotation, registered[1][1].rotation)


def test_candidates_are_distinct(registered):
    result = registered[0][0]
    R = truck_bank().rotations[result.candidates]
    errors = rotation_error(R[:, None], R[None]) + 1000 * torch.eye(len(R))
    assert float(errors.min()) > 30
    assert int(result.candidates[0]) == int(result.ranking.order[0, 0])


def test_a_mesh_instead_of_a_bank_uses_the_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path))
    views = sample_views(azimuth_step=90, elevations=[20])
    first = Registrar(example_mesh(), views=views)
    assert len(list(tmp_path.iterdir())) == 1
    monkeypatch.setattr(ViewBank, "build", lambda *_, **__: pytest.fail("built again"))
    second = Registrar(example_mesh(), views=views)
    torch.testing.assert_close(first.bank.descriptors, second.bank.descriptors, atol=1e-3, rtol=0)


def test_bad_input_is_named():
    registrar = Registrar(truck_bank(), refine=False)
    image, box, _ = scene(0)
    with pytest.raises(ImageError, match="image 1: the box shows one colour"):
        registrar([image, torch.full((3, 50, 50), 0.3)], torch.stack([box, torch.tensor([5.0, 5, 40, 40])]))
    bad = CAMERA.clone()
    bad[0, 0] = 0
    with pytest.raises(InvalidInputError, match="focal"):
        registrar([image], box[None], bad)
    with pytest.raises(InvalidInputError, match="one or 1 matrices"):
        registrar([image], box[None], CAMERA.expand(2, 3, 3))
    with pytest.raises(InvalidInputError, match="belong to the bank"):
        Registrar(truck_bank(), views=sample_views())


def test_distinct_views_stop_when_the_sphere_is_used_up():
    R = sample_views(azimuth_step=90, elevations=[0]).rotations
    assert distinct_views(torch.tensor([2, 0, 1, 3]), R, count=9).tolist() == [2, 0, 1, 3]

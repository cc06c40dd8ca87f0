import pickle
from dataclasses import replace

import cv2
import pytest
import torch
import trimesh

from curvireg_torch import (
    ImageGradient,
    Registrar,
    ViewBank,
    ViewMatcher,
    project_points,
    rotation_error,
    sample_views,
)
from curvireg_torch.errors import CurviregError, InvalidInputError
from curvireg_torch.geometry import rotation_from_viewpoint, symmetry_transforms
from curvireg_torch.io.meshes.mesh import mesh_centre, mesh_radius
from curvireg_torch.pipeline import PRESETS
from curvireg_torch.registration import RELIABLE, FailedRegistration, distinct_views, fit_contours
from curvireg_torch.registration import results as results_module
from curvireg_torch.rendering import make_renderer, render_depth
from curvireg_torch.synthetic import example_mesh
from tests._support.scenes import CAMERA, SIZE, scene, truck_bank, truck_registrar, unrefined

SEEDS = range(6)


@pytest.fixture(scope="module")
def registered() -> tuple[list, list]:
    """Six scenes of known truth, before and after refinement."""
    images, boxes = [scene(s)[0] for s in SEEDS], torch.stack([scene(s)[1] for s in SEEDS])
    coarse = truck_registrar(search=False, contours=False)(images, boxes, CAMERA)
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
        azimuth, elevation, theta = result.viewpoint
        assert 0 <= azimuth < 360
        assert -90 <= elevation <= 90
        assert -180 <= theta < 180


def test_without_a_camera_there_is_no_translation():
    image, box, _ = scene(0)
    result = truck_registrar(search=False, contours=False)(image[None], box[None])[0]
    assert result.translation is None
    assert result.transform is None
    assert result.rotation.equal(result.allocentric_rotation)


def test_batched_equals_one_by_one(registered):
    image, box, _ = scene(1)
    alone = Registrar(truck_bank())([image], box[None], CAMERA)[0]
    torch.testing.assert_close(alone.rotation, registered[1][1].rotation)


def test_hypotheses_are_distinct(registered):
    for results in registered:
        for result in results:
            R = torch.stack([h.rotation for h in result.hypotheses])
            errors = rotation_error(R[:, None], R[None]) + 1000 * torch.eye(len(R))
            assert float(errors.min()) > 15
    first = registered[0][0]
    assert int(first.candidates[0]) == int(first.ranking.order[0, 0])


def test_a_rival_is_a_whole_pose(registered):
    """The truck's half turn is its strongest rival, and comes with a translation that fills the box."""
    box, points = scene(0)[1], torch.from_numpy(truck_bank().mesh.vertices.copy())
    rivals = registered[1][0].hypotheses[1:]
    assert any(abs(float(rotation_error(r.rotation, registered[1][0].rotation)) - 180) < 15 for r in rivals)
    for rival in rivals:
        uv = project_points(points, rival.transform[None], CAMERA)[0]
        seen = torch.cat([uv.amin(dim=0), uv.amax(dim=0)])
        side = float((box[2:] - box[:2]).max())
        assert float((seen - box).abs().max()) < 0.35 * side
        assert set(rival.evidence) == {"rank", "similarity", "edge_support", "appearance"}


def test_a_mesh_instead_of_a_bank_uses_the_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path))
    views = sample_views(azimuth_step=90, elevations=[20])
    first = Registrar(example_mesh(), views=views)
    assert len(list(tmp_path.iterdir())) == 1
    monkeypatch.setattr(ViewBank, "build", lambda *_, **__: pytest.fail("built again"))
    second = Registrar(example_mesh(), views=views)
    torch.testing.assert_close(first.bank.descriptors, second.bank.descriptors, atol=1e-3, rtol=0)


def test_what_is_wrong_with_one_photograph_is_its_own_failure(tmp_path):
    registrar = truck_registrar(search=False, contours=False)
    image, box, _ = scene(0)
    nan = image.clone()
    nan[1, int(box[1]) + 9, int(box[0]) + 9] = torch.nan
    grey = torch.full((3, 50, 50), 0.3)
    images = [image, grey, nan, image, tmp_path / "none.png", image * 255, torch.zeros(4, 9, 9), image]
    boxes = torch.stack([box, torch.tensor([5.0, 5, 40, 40]), box, -box, box, box, box, box])
    results = registrar(images, boxes, CAMERA)
    assert [result.ok for result in results] == [True, False, False, False, False, False, False, True]
    assert results[0].rotation.equal(results[7].rotation)
    told = {1: "one colour", 2: "NaN", 3: "X0 < X1", 4: "no such file", 5: r"\[0, 1\]", 6: "channels"}
    for i, message in told.items():
        assert isinstance(results[i], FailedRegistration)
        with pytest.raises(CurviregError, match=f"image {i}: .*{message}"):
            _ = results[i].rotation


def test_photographs_as_people_have_them(tmp_path):
    image, box, _ = scene(0)
    pixels = (image * 255).round().byte()
    array = pixels.permute(1, 2, 0).numpy()
    cv2.imwrite(str(tmp_path / "photo.png"), array[..., ::-1])
    images = [pixels, array, array.astype("float32") / 255, tmp_path / "photo.png", str(tmp_path / "photo.png")]
    results = truck_registrar(search=False, contours=False)(images, [box.tolist()] * 5)
    for result in results[1:]:
        torch.testing.assert_close(result.ranking.scores, results[0].ranking.scores, atol=1e-5, rtol=1e-4)


def test_bad_calls_are_named():
    registrar = truck_registrar(search=False, contours=False)
    image, box, _ = scene(0)
    bad = CAMERA.clone()
    bad[0, 0] = 0
    with pytest.raises(InvalidInputError, match="focal"):
        _ = registrar([image], box[None], bad)[0].rotation
    with pytest.raises(InvalidInputError, match="one or 1 matrices"):
        registrar([image], box[None], CAMERA.expand(2, 3, 3))
    with pytest.raises(InvalidInputError, match=r"shape \(1, 4\), one for each image, got \(3, 4\)"):
        registrar([image], box.expand(3, 4))
    with pytest.raises(InvalidInputError, match="put a single image into a list"):
        registrar(image, box[None])
    with pytest.raises(InvalidInputError, match="belong to the bank"):
        Registrar(truck_bank(), views=sample_views())
    with pytest.raises(InvalidInputError, match="belong to the matcher"):
        Registrar(ViewMatcher(truck_bank()), field=ImageGradient())
    assert registrar([], []) == []


def test_a_field_of_ones_own_is_used_and_noted():
    registrar = Registrar(truck_bank(), field=ImageGradient(), pipeline=unrefined(truck_bank()))
    assert registrar.pipeline.field == "custom:ImageGradient"
    image, box, _ = scene(0)
    gradient = ViewMatcher(truck_bank(), field=ImageGradient())([image], box[None])
    assert registrar([image], box[None])[0].ranking.scores.equal(gradient.scores)


def test_a_pickle_of_one_result_is_small():
    images, boxes = [scene(s)[0] for s in range(4)], torch.stack([scene(s)[1] for s in range(4)])
    results = truck_registrar(search=False, contours=False)(images, boxes)
    one = len(pickle.dumps(results[:1]))
    assert one < 1.2 * len(pickle.dumps(truck_registrar(search=False, contours=False)(images[:1], boxes[:1])))


def test_several_meshes_one_answer(tmp_path, monkeypatch):
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path))
    meshes = [trimesh.creation.box((0.1, 0.2, 0.1)), example_mesh()]
    views, (image, box, T) = sample_views(azimuth_step=15, elevations=[0, 20, 40]), scene(0)
    result = Registrar(meshes, views=views)([image], box[None], CAMERA)[0]
    assert result.model == 1
    assert float(rotation_error(result.rotation, T[:3, :3])) < 5


def test_distinct_views_stop_when_the_sphere_is_used_up():
    R = sample_views(azimuth_step=90, elevations=[0]).rotations
    assert distinct_views(torch.tensor([2, 0, 1, 3]), R, count=9).tolist() == [2, 0, 1, 3]


def test_a_turn_that_nothing_shows_has_no_standard_deviation():
    """A can from above: its turn about its axis is unknown, its lean and its place are known."""
    mesh = trimesh.creation.cylinder(0.05, 0.2, sections=96)
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = rotation_from_viewpoint(0.0, 35.0, 0.0)
    T[2, 3] = 1.0
    seen = render_depth(mesh, T, CAMERA, SIZE)[0] > 0
    image = torch.where(seen, 0.8, 0.2).expand(3, -1, -1)
    rows, columns = seen[0].any(dim=1).nonzero()[:, 0], seen[0].any(dim=0).nonzero()[:, 0]
    box = torch.tensor([[columns[0] - 0.5, rows[0] - 0.5, columns[-1] + 0.5, rows[-1] + 0.5]])
    views = sample_views(azimuth_step=90, elevations=[15, 30, 45], thetas=[-15, 0, 15])
    bank = ViewBank.build(mesh, views, pipeline=PRESETS["classical"], image_size=96, progress=False)
    turns = symmetry_transforms({"symmetries_continuous": [{"axis": [0, 0, 1], "offset": [0, 0, 0]}]})
    best = Registrar(bank, symmetries=turns)(image[None], box, CAMERA)[0].hypotheses[0]
    known = replace(best, covariance=fitted_covariance(bank, image, box[0], best))
    turn, shift = known.standard_deviations
    assert turn[1] == turn[2] == torch.inf, "the can's axis lies in the camera's y and z"
    assert float(turn[0]) < 20
    assert float(shift.max()) < 0.1
    assert replace(best, covariance=None).standard_deviations is None


@pytest.mark.parametrize("limit", [0.0, 1.01])
def test_what_is_not_reliable_has_no_covariance(monkeypatch, limit):
    monkeypatch.setattr(results_module, "RELIABLE", limit)
    image, box, _ = scene(0)
    result = truck_registrar(hypotheses=2)([image], box[None], CAMERA)[0]
    assert (result.covariance is not None) == (limit == 0.0)
    assert truck_registrar(hypotheses=2)([image], box[None])[0].covariance is None, "no camera"


def fitted_covariance(bank, image, box, pose):
    mesh = bank.mesh
    fit = fit_contours(
        make_renderer(mesh),
        image,
        box,
        CAMERA,
        pose.transform[None],
        centre=mesh_centre(mesh),
        radius=mesh_radius(mesh),
    )
    return fit.covariance[0]


def test_progress_is_told_and_may_stop():
    told = []
    views = sample_views(azimuth_step=90, elevations=[0, 30])
    pipeline = replace(PRESETS["classical"], hypotheses=1)
    bank = ViewBank.build(
        example_mesh(), views, pipeline=pipeline, image_size=64, chunk_size=3, progress=lambda *it: told.append(it)
    )
    assert told == [("bank", 3, 8), ("bank", 6, 8), ("bank", 8, 8)]
    told.clear()
    Registrar(bank, progress=lambda *it: told.append(it))([scene(0)[0]], scene(0)[1][None], CAMERA)
    assert [stage for stage, *_ in told] == ["ranking", "search", "contours"]
    told.clear()
    Registrar(bank, progress=lambda *it: told.append(it))([scene(0)[0]])
    assert [stage for stage, *_ in told][:4] == ["looking", "ranking", "search", "contours"]

    def stop(stage, *_):
        raise InvalidInputError(f"stopped in {stage}")

    with pytest.raises(InvalidInputError, match="stopped in bank"):
        ViewBank.build(example_mesh(), views, image_size=64, progress=stop)
    with pytest.raises(InvalidInputError, match="stopped in ranking"):
        Registrar(bank, progress=stop)([scene(0)[0]], scene(0)[1][None])
    with pytest.raises(InvalidInputError, match="stopped in looking"):
        Registrar(bank, progress=stop)([scene(0)[0]])

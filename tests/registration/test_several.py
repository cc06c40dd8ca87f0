"""Several photographs of the truck from a rig of cameras: one pose in the world."""

from dataclasses import replace
from functools import cache

import pytest
import torch
from torch.testing import assert_close

from curvireg_torch import Registrar, rotation_error
from curvireg_torch.geometry import rotation_from_axis_angle, transform
from curvireg_torch.mesh import mesh_radius
from curvireg_torch.registration import stages
from curvireg_torch.registration.rig import Rig
from curvireg_torch.synthetic import example_mesh, procedural_background, synthesize_photograph
from tests._support import (
    CAMERA,
    SIZE,
    answer_of,
    double,
    eye,
    learned_registrar,
    refused,
    seeded,
    seen_from,
    zeros,
)

EASY = ((100.0, 1), (135.0, 2), (175.0, 3))
# Azimuths and seeds of photographs; those of the second rig, with strong noise, are registered the
# wrong way round
IN_DOUBT = ((335.0, 100), (329.0, 105), (190.0, 107))
# True T_world_from_model
TURN = rotation_from_axis_angle(double([0.3, -0.8, 0.5]))
HALF_TURN = torch.diag(double([-1.0, 1.0, -1.0]))
WORLD = transform(TURN, double([0.2, 0.1, -0.4]))


@cache
def photograph(azimuth, seed, noise):
    """(3, H, W), its box (4,) and the true ``T_cam_from_model``, from six radii away and slightly
    above."""
    generator = seeded(seed)
    mesh = example_mesh()
    T = seen_from(mesh, azimuth, 8.0, radii=6.0)
    image, box = synthesize_photograph(mesh, T, CAMERA, SIZE, generator, texture=0.6)
    return (image + noise * torch.randn(image.shape, generator=generator)).clamp(0, 1), box, T


def rig_of(which, noise=0.1):
    """Photographs, boxes, and ``T_cam_from_world`` (V, 4, 4)."""
    images, boxes, poses = zip(*(photograph(*one, noise) for one in which), strict=True)
    return list(images), list(boxes), torch.stack(poses) @ torch.linalg.inv(WORLD)


@cache
def registrar():
    """Of boxes as they are given."""
    return Registrar(learned_registrar().bank)


def registered(images, boxes, cameras):
    return registrar().register_views(images, boxes, CAMERA, cameras)


def first_of(count):
    """The first photographs of ``EASY``, with boxes and cameras."""
    return [part[:count] for part in rig_of(EASY)]


@cache
def beside():
    """A fourth photograph, its box, and a camera that looks the other way."""
    image, box, T = photograph(60.0, 4, 0.1)
    camera = T @ torch.linalg.inv(WORLD)
    return image, box, camera, transform(HALF_TURN, zeros(3)) @ first_of(1)[2]


def check_pose(result, *, degrees=2.0, shift=0.1):
    """``T_world_from_model`` is right, ``shift`` in radii."""
    assert rotation_error(result.rotation, WORLD[:3, :3]) < degrees
    off = result.translation - WORLD[:3, 3]
    assert off.norm() < shift * mesh_radius(example_mesh())


def watched(registrar):
    """The result of the easy photographs, and what its joint fits began from and found."""
    fits = []
    fitted = Rig.fitted

    def watch(rig, problem, T, radii):
        found = fitted(rig, problem, T, radii)
        fits.append((T.clone(), found[0].clone()))
        return found

    images, boxes, cameras = rig_of(EASY)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Rig, "fitted", watch)
        return registrar.register_views(images, boxes, CAMERA, cameras), fits


@pytest.fixture(scope="module")
def easy_and_fits():
    return watched(registrar())


@pytest.fixture(scope="module")
def easy(easy_and_fits):
    return easy_and_fits[0]


@pytest.fixture(scope="module")
def first():
    """The first photograph of ``easy``, as a rig."""
    return registered(*first_of(1))


def test_pose_in_the_world_and_in_each_photograph(easy):
    check_pose(easy, degrees=1.0, shift=0.05)
    _, boxes, cameras = rig_of(EASY)
    for view, camera, box in zip(easy.views, cameras, boxes, strict=True):
        assert_close(view.T_cam_from_model, camera @ easy.transform)
        assert view.box.tolist() == box.tolist()
        assert view.failure is None
        assert view.contribution > 0
        assert view.edge_support > 0.4
        assert view.similarity > 0.6
    assert_close(easy.projection[0], easy.views[0].T_cam_from_model)
    assert easy.confidence > 0.9
    assert len(easy.probabilities) == len(easy.hypotheses) > 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("first", "wrong", "degrees"), [((335.0, 102), 3, 15.0), ((40.0, 104), 2, 3.0)]
)
def test_half_turns_in_doubt_are_decided_together(monkeypatch, first, wrong, degrees):
    """Views of the two ends differ by half a turn, but not of the same world: only the truth is
    common to all, also where each photograph alone is wrong."""
    images, boxes, cameras = rig_of((first, *IN_DOUBT[1:]), noise=0.36)
    monkeypatch.setattr(stages, "_in_box_of_pose", lambda *_: None)  # each is registered once
    alone = registrar()(images, torch.stack(boxes), CAMERA)
    errors = [
        float(rotation_error(r.rotation, (c @ WORLD)[:3, :3]))
        for r, c in zip(alone, cameras, strict=True)
    ]
    assert sum(error > 150 for error in errors) == wrong
    check_pose(registered(images, boxes, cameras), degrees=degrees, shift=0.2)


def test_the_joint_fit_begins_at_each_pose_and_where_a_coarse_fit_moves_it(easy_and_fits):
    """On full shelves the coarse fit moved right poses by 1 to 8 degrees."""
    (candidates, moved), (begun, _), *_ = easy_and_fits[1]
    assert begun.equal(torch.cat([candidates, moved]))
    assert not moved.equal(candidates)


@pytest.mark.slow
def test_photographs_that_fail_are_reported_and_change_nothing(easy, tmp_path):
    images, boxes, cameras = rig_of(EASY)
    other, box, camera, away = beside()
    empty = procedural_background(SIZE, seeded(5))
    there = photograph(220.0, 4, 0.1)[2] @ torch.linalg.inv(WORLD)
    result = registered(
        [*images, empty, tmp_path / "none.png", other],
        [*boxes, box, box, box],
        torch.cat([cameras, camera[None], there[None], away]),
    )
    assert [view.failure is None for view in result.views] == [True] * 3 + [False] * 3
    empty, unread = result.views[3:5]
    assert "not seen where" in empty.failure or "lies outside" in empty.failure
    assert "no such file" in unread.failure
    assert unread.box is None
    assert empty.contribution == unread.contribution == 0
    assert_close(result.transform, easy.transform, atol=1e-6, rtol=0)
    assert_close(unread.T_cam_from_model, there @ easy.transform, atol=1e-6, rtol=0)
    shown = registered([images[0], other], [boxes[0], box], torch.stack([cameras[0], camera]))
    assert all(view.failure is None for view in shown.views)


@pytest.mark.slow
def test_boxes_may_be_missing():
    images, boxes, cameras = rig_of(EASY)
    other, _, _, away = beside()
    some = [boxes[0], None, boxes[2], None]
    result = registered([*images, other], some, torch.cat([cameras, away]))
    check_pose(result, degrees=1.0, shift=0.05)
    assert result.views[1].failure is None
    assert (result.views[1].box - boxes[1]).abs().max() < 8
    assert "lies outside" in result.views[3].failure


@pytest.mark.slow
def test_without_any_box_the_object_is_searched_for():
    images, _, cameras = rig_of(EASY)
    check_pose(registered(images, None, cameras))


def test_one_photograph_gives_the_answer_of_the_registrar(first):
    (image,), (box,), (camera,) = first_of(1)
    alone = answer_of(registrar(), image, box)
    assert_close(camera @ first.transform, alone.transform)
    assert first.probabilities == alone.probabilities
    R = camera[:3, :3]
    assert_close(R @ first.covariance[3:, 3:] @ R.T, alone.covariance[3:, 3:])


def test_covariance_shrinks_with_photographs(first, easy):
    two = registered(*first_of(2))
    one, both, three = (
        torch.linalg.eigvalsh(r.hypotheses[0].covariance[3:, 3:]).sqrt() for r in (first, two, easy)
    )
    assert both[-1] < 0.5 * one[-1]  # the depth is seen from the side
    assert three.prod() < both.prod()


@pytest.mark.slow
def test_covariance_grows_where_photographs_contradict_each_other(easy):
    """A camera that is turned by a degree moves its picture by 5 px of 100."""
    images, boxes, cameras = rig_of(EASY)
    turn = eye(4)
    turn[:3, :3] = rotation_from_axis_angle(double([0.0, 0.0175, 0.0]))
    result = registered(images, boxes, torch.stack([cameras[0], turn @ cameras[1], cameras[2]]))
    spread = [float(r.hypotheses[0].covariance[3:, 3:].trace()) for r in (easy, result)]
    assert spread[1] > 2 * spread[0]


def test_photographs_of_two_places_are_not_believed_unless_most_show_one():
    images, boxes, cameras = rig_of(EASY)
    cameras[0, 0, 3] += 0.4 * cameras[0, 2, 3]
    assert registered(images[:2], boxes[:2], cameras[:2]).confidence < 0.5
    most = registered(images, boxes, cameras)
    assert most.views[0].failure is not None
    assert most.confidence > 0.9


@pytest.mark.slow
def test_a_motion_of_the_world_moves_the_answer(easy):
    images, boxes, cameras = rig_of(EASY)
    turn = rotation_from_axis_angle(double([0.4, 2.0, -0.7]))
    motion = transform(turn, double([3.0, -1.0, 0.5]))
    moved = registered(images, boxes, cameras @ torch.linalg.inv(motion))
    assert_close(moved.transform, motion @ easy.transform, atol=1e-5, rtol=0)
    assert moved.confidence == pytest.approx(easy.confidence, abs=1e-3)


def test_bad_rigs_name_the_photograph():
    images, boxes, cameras = rig_of(EASY)
    in_mm = transform(cameras[:, :3, :3], 1000.0 * cameras[:, :3, 3])
    larger = cameras * double([1.0, 1.1, 1.0])[:, None, None]
    missing = cameras.index_fill(0, torch.tensor([2]), torch.nan)
    for wrong, message in (
        (in_mm, "image 0: T_cam_from_world: by its size .* mesh's unit"),
        (cameras[[0, 1, 1]], "image 2 and image 1: T_cam_from_world: the same, but"),
        (larger, "image 1: T_cam_from_world: expected rigid"),
        (missing, "image 2: T_cam_from_world: expected finite"),
        (cameras[:2], r"T_cam_from_world: expected shape \(3, 4, 4\)"),
    ):
        with refused(message):
            registered(images, boxes, wrong)
    with refused(r"no photograph can be registered: image 0: .*one colour"):
        registered([torch.zeros(3, *SIZE)], boxes[:1], cameras[:1])
    with refused(r"boxes: expected shape \(3, 4\)"):
        registered(images, boxes[:2], cameras)
    with refused("needs the camera matrix"):
        registrar().register_views(images, boxes, None, cameras)


@pytest.mark.slow
def test_copies_of_a_photograph_are_no_evidence():
    images, boxes, cameras = rig_of(IN_DOUBT, noise=0.3)
    once = registered(images[:1], boxes[:1], cameras[:1])
    thrice = registered(images[:1] * 3, boxes[:1] * 3, cameras[:1].repeat(3, 1, 1))
    assert thrice.probabilities == pytest.approx(once.probabilities)
    assert torch.equal(thrice.transform, once.transform)
    assert torch.equal(thrice.hypotheses[0].covariance, once.hypotheses[0].covariance)
    copy = "a copy of an earlier photograph, which counts once"
    assert [view.failure for view in thrice.views] == [None, copy, copy]


@pytest.mark.slow
def test_rigs_compare_rivals_that_are_not_reported(easy_and_fits):
    """Of each photograph five, though one is reported."""
    easy, fits = easy_and_fits
    bank = learned_registrar().bank
    assert bank.pipeline.hypotheses == 5
    one, same_fits = watched(Registrar(bank, pipeline=replace(bank.pipeline, hypotheses=1)))
    assert (len(one.hypotheses), len(one.probabilities)) == (1, 1)
    assert len(same_fits[0][0]) == len(fits[0][0]) > len(EASY)
    assert one.confidence == pytest.approx(easy.confidence)
    assert one.confidence_features == pytest.approx(easy.confidence_features)

"""Poses that look the same: named, never believed; and small features that tell which one is
right."""

from functools import cache

import numpy as np
import pytest
import torch
import trimesh

from curvireg_torch import Registrar
from curvireg_torch.geometry import rotation_error
from curvireg_torch.mesh import mesh_symmetries
from curvireg_torch.registration.target import MAX_SIBLINGS, spread, telling_symmetries
from tests._support import (
    CAMERA,
    answer_of,
    bank_around,
    degrees_off,
    exact_registrar,
    eye,
    photograph_of,
    slow_after,
)
from tests._support.canisters import box_with_block


@cache
def hollow_box():
    """A box of 200 x 120 x 90, one half of which is hollow from below: from above it looks like a
    plain box."""
    outer = trimesh.creation.box((200, 120, 90))
    cavity = trimesh.creation.box((80, 90, 70))
    cavity.apply_translation((44, 0, -10))
    parts = []
    for part in (outer, cavity):
        below = (part.triangles[..., 2] <= part.bounds[0, 2] + 1e-6).all(axis=1)
        parts.append(trimesh.Trimesh(part.vertices, part.faces[~below], process=False))
    floor = np.array([(-100, -60, -45), (4, -60, -45), (4, 60, -45), (-100, 60, -45)], float)
    parts.append(trimesh.Trimesh(floor, [[0, 2, 1], [0, 3, 2]], process=False))
    return trimesh.util.concatenate(parts)


@cache
def marked_box():
    """A box with a cube of 11.5 % of its radius on one end of its top."""
    return box_with_block((14, 14, 14), (85, 0, 47))


@cache
def registrar_of(mesh):
    return exact_registrar(bank_around(mesh, 30, [10, 30, 50]))


@cache
def cylinder():
    """A mesh, and its 72 symmetries."""
    mesh = trimesh.creation.cylinder(40, 150, sections=72)
    return mesh, mesh_symmetries(mesh)


def registered(registrar, azimuth, elevation, seed):
    """The result and its error in degrees."""
    image, box, T = photograph_of(registrar.bank.mesh, azimuth, elevation, seed)
    result = answer_of(registrar, image, box)
    return result, float(degrees_off(result, T))


@pytest.mark.parametrize(
    ("azimuth", "elevation", "seed"),
    slow_after(1, [(35.0, 25.0, 0), (160.0, 40.0, 1), (250.0, 15.0, 2)]),
)
def test_half_turn_that_nothing_in_view_decides_is_named_and_not_reliable(azimuth, elevation, seed):
    assert len(mesh_symmetries(hollow_box())) == 1
    result, error = registered(registrar_of(hollow_box()), azimuth, elevation, seed)
    assert min(error, abs(180.0 - error)) < 5.0, "one of the two"
    assert result.ambiguous == "half turn"
    assert result.probabilities[0] == pytest.approx(result.probabilities[1], rel=0.3)
    assert result.confidence <= 0.5
    assert not result.reliable
    assert result.axis is None
    assert result.pair_probability > 0.9
    assert result.to_dict()["pair_probability"] == result.pair_probability
    turn = float(rotation_error(result.hypotheses[0].rotation, result.hypotheses[1].rotation))
    assert turn == pytest.approx(180.0, abs=5.0)


@pytest.mark.slow
def test_rig_that_sees_only_what_looks_the_same_names_the_tie():
    registrar = registrar_of(hollow_box())
    images, boxes, poses = zip(
        *(photograph_of(hollow_box(), a, 30.0, int(a)) for a in (20.0, 65.0, 110.0)), strict=True
    )
    result = registrar.register_views(list(images), list(boxes), CAMERA, torch.stack(poses))
    assert result.ambiguous == "half turn"
    assert not result.reliable


@pytest.mark.slow
def test_symmetric_mesh_without_given_symmetries_is_ambiguous():
    box = trimesh.creation.box((200, 120, 80))
    assert registered(registrar_of(box), 40.0, 30.0, 0)[0].ambiguous is None
    bank = registrar_of(box).bank
    result, _ = registered(exact_registrar(bank, symmetries=eye(4)[None]), 40.0, 30.0, 0)
    assert result.ambiguous is not None
    assert result.confidence <= 0.5


@pytest.mark.parametrize("azimuth", slow_after(1, [20.0, 140.0, 75.0, 200.0, 310.0]))
def test_poses_that_the_shape_makes_equal_are_rivals_where_a_small_feature_differs(azimuth):
    mesh = marked_box()
    assert len(mesh_symmetries(mesh)) == 4
    result, _ = registered(registrar_of(mesh), azimuth, 35.0, int(azimuth))
    turned = result.rotation @ mesh_symmetries(mesh)[1:, :3, :3]
    assert rotation_error(turned, result.hypotheses[1].rotation).min() < 10.0


@pytest.mark.parametrize(("side", "notable"), slow_after(1, [(24.0, True), (14.0, False)]))
def test_poses_that_only_a_hidden_feature_tells_apart_are_named(side, notable):
    """A block on the top of a box that is seen from below; a large one makes the answer unsure."""
    mesh = box_with_block((side, side, 14), (75, 0, 47))
    registrar = exact_registrar(bank_around(mesh, 15, [-50, -35]))
    assert registrar.telling_symmetries.notable == notable
    result, _ = registered(registrar, 30.0, -40.0, 3)
    assert result.feature_is_hidden
    assert result.to_dict()["feature_is_hidden"]
    assert result.ambiguous is not None
    if notable:
        assert result.confidence <= 0.5
        assert result.probabilities[0] == pytest.approx(result.probabilities[1], rel=0.3)
    else:
        assert result.ambiguous == "several"
        assert result.confidence > 4 * result.probabilities[1]


@cache
def block_on_top():
    """A registrar of a box that has a notable block on its top, seen from above and from below."""
    mesh = box_with_block((24, 24, 14), (75, 0, 47))
    return exact_registrar(bank_around(mesh, 30, [-50, -35, 35, 50]))


def test_a_refined_pose_does_not_gain_by_the_turn_that_looks_the_same():
    """From both turns of a box whose block is hidden, the answer is as unsure as without a start,
    and its rival is the other turn."""
    registrar = block_on_top()
    image, _, T = photograph_of(registrar.bank.mesh, 30.0, -40.0, 3)
    about_z = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0])).double()
    for start in (T, T @ about_z):
        (result,) = registrar.refine([image], CAMERA, [start])
        assert rotation_error(result.rotation, start[:3, :3]) < 2.0
        assert result.confidence <= 0.5
        assert result.feature_is_hidden
        first, second = result.probabilities[:2]
        assert second == pytest.approx(first, rel=0.3)
        other = result.rotation @ about_z[:3, :3]
        assert rotation_error(other, result.hypotheses[1].rotation) < 10.0
        assert result.verdict == "unsure"


def joint_answer(registrar, *viewpoints):
    """The joint answer of photographs from some azimuths and elevations; the world is the model's
    axes."""
    shown = [photograph_of(registrar.bank.mesh, *each, int(each[0])) for each in viewpoints]
    images, boxes, poses = zip(*shown, strict=True)
    return registrar.register_views(list(images), list(boxes), CAMERA, torch.stack(poses))


def test_photographs_of_a_rig_that_show_the_feature_decide():
    result = joint_answer(block_on_top(), (30.0, -40.0), (75.0, -40.0), (50.0, 40.0))
    assert rotation_error(result.rotation, eye(3)) < 2.0
    assert result.reliable
    assert not result.feature_is_hidden
    turned = mesh_symmetries(block_on_top().bank.mesh)[1:, :3, :3].double()
    rivals = torch.stack([each.rotation for each in result.hypotheses[1:]])
    assert min(rotation_error(turned, R).min() for R in rivals) < 5.0, "it was compared"


def test_rig_that_hides_the_feature_is_as_unsure_as_its_photographs():
    result = joint_answer(block_on_top(), (30.0, -40.0), (75.0, -40.0))
    assert result.feature_is_hidden
    assert result.ambiguous is not None
    assert result.probabilities[1] == pytest.approx(result.probabilities[0], rel=0.3)
    assert result.confidence <= 0.5


def test_given_symmetries_are_trusted():
    bank = registrar_of(marked_box()).bank
    group = mesh_symmetries(marked_box())
    result, _ = registered(exact_registrar(bank, symmetries=group), 20.0, 35.0, 20)
    turned = result.rotation @ group[1:, :3, :3].double()
    for hypothesis in result.hypotheses[1:]:
        assert rotation_error(turned, hypothesis.rotation).min() > 10.0


def test_telling_symmetries_are_those_that_a_feature_breaks():
    box = trimesh.creation.box((200, 120, 80))
    for mesh, symmetries in ((box, mesh_symmetries(box)), cylinder()):
        assert len(telling_symmetries(mesh, symmetries)) == 1, "nothing to measure"
    group = mesh_symmetries(marked_box())
    telling = telling_symmetries(marked_box(), group)
    assert torch.equal(telling.transforms[0], eye(4))
    assert len(telling) == 4
    assert torch.equal(telling.others, eye(4)[None])
    on_axis = box_with_block((24, 24, 14), (0, 0, 47))
    group = mesh_symmetries(on_axis)
    others = telling_symmetries(on_axis, group).others
    about_z = torch.diag(torch.tensor([-1.0, -1.0, 1.0])).double()
    assert rotation_error(others[:, :3, :3], eye(3)).tolist() == pytest.approx([0, 180], abs=1.0)
    assert rotation_error(others[1, :3, :3], about_z) < 1.0
    mesh, group = cylinder()
    assert torch.equal(telling_symmetries(mesh, group).others, group)


def test_no_other_symmetry_is_one_that_the_feature_breaks():
    """Of 24 turns of a cube, those about the middle of the block remain."""
    cube = trimesh.creation.box((100, 100, 100))
    block = trimesh.creation.box((24, 24, 14))
    block.apply_translation((0, 0, 57))
    mesh = trimesh.util.concatenate([cube, block])
    group = mesh_symmetries(cube)
    assert len(group) == 24
    others = telling_symmetries(mesh, group).others
    assert rotation_error(others[:, :3, :3], eye(3)).sort().values.tolist() == pytest.approx(
        [0.0, 90.0, 90.0, 180.0], abs=1.0
    )
    block.apply_translation((30, 20, 0))
    mesh = trimesh.util.concatenate([cube, block])
    assert torch.equal(telling_symmetries(mesh, group).others, eye(4)[None])


def test_symmetries_of_answers_depend_on_what_the_photograph_shows():
    def answers(target, *, is_hidden):
        return len(target.symmetries_of_answers(feature_is_hidden=is_hidden))

    registrar = block_on_top()
    assert [answers(registrar, is_hidden=one) for one in (False, True)] == [1, 1]
    small = registrar_of(marked_box())
    assert not small.telling_symmetries.notable
    assert [answers(small, is_hidden=one) for one in (False, True)] == [1, 4]
    given = exact_registrar(small.bank, symmetries=mesh_symmetries(marked_box()))
    assert [answers(given, is_hidden=one) for one in (False, True)] == [4, 4]
    similar = Registrar(small.bank, mesh_is="similar")
    assert similar.symmetries_of_answers(feature_is_hidden=True) is None


def test_spread_keeps_few_symmetries_far_apart():
    _, group = cylinder()
    some = spread(group)
    assert (len(group), len(some)) == (72, MAX_SIBLINGS)
    apart = rotation_error(some[:, None, :3, :3], some[None, :, :3, :3]) + 360.0 * torch.eye(
        MAX_SIBLINGS
    )
    assert apart.min() >= 30.0

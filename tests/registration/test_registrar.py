import pickle
from contextlib import nullcontext
from copy import copy
from dataclasses import replace
from functools import cache
from unittest.mock import Mock

import cv2
import pytest
import torch
import trimesh
from torch.nn.functional import max_pool2d

from curvireg_torch import (
    ImageGradient,
    Registrar,
    ViewBank,
    ViewMatcher,
    rotation_error,
    sample_views,
)
from curvireg_torch.errors import CurviregError, ImageError, LostObjectError
from curvireg_torch.fitting import contour_fit
from curvireg_torch.geometry import Camera, box_iou
from curvireg_torch.matching import distinct_views
from curvireg_torch.mesh import mesh_radius
from curvireg_torch.pipeline import PRESETS, FitSettings
from curvireg_torch.registration import (
    Follower,
    block,
    doubts,
    hypotheses,
    several,
    stages,
)
from curvireg_torch.registration import photograph as photograph_module
from curvireg_torch.registration.photograph import Photograph, as_photograph, check_crop
from curvireg_torch.rendering import make_renderer, render_depth
from curvireg_torch.synthetic import example_mesh
from tests._support import (
    CAMERA,
    SIZE,
    answer_of,
    answer_to,
    bank_around,
    degrees_off,
    double,
    errors,
    exact_registrar,
    first_scenes,
    learned_answer,
    learned_registrar,
    photograph_of,
    refused,
    scene,
    truck_answer,
    truck_bank,
    truck_registrar,
    unrefined,
)
from tests._support.spies import spied

IMAGE, BOX, TRUTH = scene(0)


def test_poses_of_synthetic_scenes():
    """Six scenes of known truth, before and after refinement."""
    images, boxes, truths = first_scenes(6)
    registrars = truck_registrar(contours=False), truck_registrar()
    registered = [registrar(images, boxes, CAMERA) for registrar in registrars]
    found = [torch.tensor([*map(errors, results, truths)]) for results in registered]
    coarse, fine = (degrees[:, 0] for degrees in found)
    right = coarse < 20
    assert right.sum() >= 5
    assert fine[right].median() < 4
    assert fine[right].median() <= coarse[right].median()
    assert (found[1][right, 1] < 0.05).all()


def test_registrar_of_several_meshes_reports_the_best(tmp_path, monkeypatch):
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path))
    meshes = [trimesh.creation.box((0.1, 0.2, 0.1)), example_mesh()]
    views = sample_views(azimuth_step=30, elevations=[0, 20, 40])
    both = Registrar(meshes, views=views, pipeline=truck_registrar().pipeline)
    result = answer_of(both, IMAGE, BOX)
    assert result.mesh_index == 1
    assert degrees_off(result, TRUTH) < 5
    with refused("empty list"):
        Registrar([])
    with refused("knows one mesh"):
        Registrar([truck_bank()] * 2, renderer=make_renderer(example_mesh()))
    with refused("one mesh"):
        Follower(Registrar([truck_bank()] * 2), CAMERA)


def test_flat_mesh_without_colours_warns():
    plate = trimesh.creation.box((1.0, 0.6, 1e-5))
    bank = bank_around(plate, 90, [20], image_size=64)
    assert "front and back look alike" in Registrar(bank).mesh_warnings[0]
    assert truck_registrar().mesh_warnings == ()


def test_failed_photographs_do_not_affect_others(tmp_path):
    nan = IMAGE.clone()
    nan[1, int(BOX[1]) + 9, int(BOX[0]) + 9] = torch.nan
    grey = torch.full((3, 50, 50), 0.3)
    images, boxes, messages = zip(
        (grey, torch.tensor([5.0, 5, 40, 40]), "one colour"),
        (nan, BOX, "NaN"),
        (IMAGE, -BOX, "X0 < X1"),
        (tmp_path / "none.png", BOX, "none.png: no such file"),
        (IMAGE * 255, BOX, r"\[0, 1\]"),
        (torch.zeros(4, 9, 9), BOX, "channels"),
        (IMAGE, None, "has neither box nor mask"),
        strict=True,
    )
    first, *failed, last = truck_registrar(contours=False)(
        [IMAGE, *images, IMAGE], [BOX, *boxes, BOX], CAMERA
    )
    assert first.rotation.equal(last.rotation)
    for i, (result, message) in enumerate(zip(failed, messages, strict=True), start=1):
        with refused(f"image {i}: .*{message}", CurviregError):
            _ = result.rotation


@pytest.mark.parametrize(
    ("weight", "right"), [(FitSettings().screening_weight, True), (0.0, False)]
)
def test_edge_support_makes_a_view_of_low_rank_a_hypothesis(monkeypatch, weight, right):
    """Without it, only views beyond 50 degrees are too far: from one 21 degrees off the true pose,
    which is 30 degrees from the best view, the fit ends 0.8 degrees off all the same."""
    registrar = truck_registrar(fit=FitSettings(screening_weight=weight))
    item = Photograph(IMAGE, BOX, Camera(CAMERA))
    query = registrar.matcher.query([IMAGE], BOX[None])
    ranking = registrar.matcher.rank(query)
    bank = registrar.bank
    turned = rotation_error(bank.rotations, bank.rotations[ranking.order[0, 0]])
    near = turned < 50.0 + 1e-3
    seventh = distinct_views(ranking.order[0], bank.rotations, count=7)[-1]
    scores = torch.where(near, 0.999 * ranking.scores[0, seventh], ranking.scores[0])[None] ** 0.1
    lowered = replace(
        ranking, scores=scores, order=scores.argsort(dim=1, descending=True, stable=True)
    )
    monkeypatch.setattr(type(registrar.matcher), "rank", lambda *_: lowered)
    (result,) = stages.register(registrar, [item], query)
    assert (float(degrees_off(result, TRUTH)) < 4) == right
    assert len(result.hypotheses) == registrar.pipeline.hypotheses


def test_views_have_one_short_fit_and_three_are_fitted_even_if_one_is_reported(monkeypatch):
    """The best pose is fitted twice, the second time without a short fit."""
    of_views = spied(monkeypatch, hypotheses, "short_fit")
    of_best = spied(monkeypatch, contour_fit, "short_fit")
    fits = spied(monkeypatch, block, "fit_poses")
    assert len(answer_to(0, truck_registrar(hypotheses=1)).hypotheses) == 1
    assert [len(T) for *_, T in of_views] == [FitSettings().screened_views]
    assert of_best == []
    assert [len(poses) for _, _, poses, *_ in fits] == [3, 1]


def test_an_error_inside_a_fit_fails_its_photograph_alone(monkeypatch):
    fit_poses = block.fit_poses

    def fail(describer, crops, poses, **options):
        if float(crops.crops.flatten(1).amax(dim=1).min()) <= 0.25:
            raise CurviregError("no fit")
        return fit_poses(describer, crops, poses, **options)

    monkeypatch.setattr(block, "fit_poses", fail)
    results = truck_registrar()([IMAGE, 0.25 * IMAGE, IMAGE], BOX.repeat(3, 1), CAMERA)
    assert [result.ok for result in results] == [True, False, True]
    assert str(results[1].error) == "image 1: no fit"


def test_origin_of_the_mesh_may_be_far_away():
    """A million radii, as in geographic coordinates."""
    mesh = example_mesh()
    away = double([1e6 * float(mesh_radius(example_mesh())), 0.0, 0.0])
    mesh.apply_translation(away.numpy())
    result = answer_to(0, exact_registrar(bank_around(mesh, 30, [0, 20, 40])))
    assert degrees_off(result, TRUTH) < 2.0
    position = result.rotation @ away + result.translation
    assert ((position - TRUTH[:3, 3]).norm() / TRUTH[:3, 3].norm()) < 0.02


def test_registrar_accepts_tensors_arrays_and_paths_and_rejects_bad_calls(tmp_path):
    pixels = (IMAGE * 255).round().byte()
    array = pixels.permute(1, 2, 0).numpy()
    cv2.imwrite(str(tmp_path / "photo.png"), array[..., ::-1])
    file = tmp_path / "photo.png"
    images = [pixels, array, array.astype("float32") / 255, file, str(file)]
    registrar = truck_registrar(contours=False)
    first, *others = (result.ranking.scores for result in registrar(images, [BOX.tolist()] * 5))
    for scores in others:
        torch.testing.assert_close(scores, first, atol=1e-5, rtol=1e-4)
    with refused("focal"):
        _ = answer_of(registrar, IMAGE, BOX, torch.diag(double([0.0, 1, 1]))).rotation
    for images, boxes, camera, message in (
        ([IMAGE], BOX[None], CAMERA.expand(2, 3, 3), r"expected \(3, 3\) or \(1, 3, 3\)"),
        ([IMAGE], BOX.expand(3, 4), None, r"shape \(1, 4\), one for each image, got \(3, 4\)"),
        (IMAGE, BOX[None], None, "put a single image into a list"),
        # not in the order of the boxes: a column of a table is indexed by labels
        ({1: IMAGE, 0: IMAGE}, BOX.expand(2, 4), None, r"got dict; .*list\(images\)"),
        (iter([IMAGE]), BOX[None], None, r"got list_iterator; .*list\(images\)"),
    ):
        with refused(message):
            registrar(images, boxes, camera)
    with refused("belong to the bank"):
        Registrar(truck_bank(), views=sample_views())
    for option in ({"field": ImageGradient()}, {"renderer": "embree"}, {"device": "cpu"}):
        with refused("belong to the matcher"):
            Registrar(ViewMatcher(truck_bank()), **option)
    assert registrar([], []) == []


def test_registrar_uses_and_records_a_custom_field():
    registrar = Registrar(truck_bank(), field=ImageGradient(), pipeline=unrefined(truck_bank()))
    assert registrar.pipeline.field == "custom:ImageGradient"
    gradient = ViewMatcher(truck_bank(), field=ImageGradient())([IMAGE], BOX[None])
    assert answer_of(registrar, IMAGE, BOX, None).ranking.scores.equal(gradient.scores)


def test_covariance_needs_a_reliable_result_and_a_camera():
    known = learned_registrar()
    strict = replace(known.pipeline, fit=FitSettings(reliable=1.0))
    result = learned_answer()
    doubtful = answer_to(0, Registrar(known.bank, pipeline=strict))
    for one, is_reliable in ((result, True), (doubtful, False)):
        assert one.reliable == is_reliable
        for value in (one.covariance, one.standard_deviations):
            assert (value is not None) == is_reliable
    unknown = replace(result, hypotheses=(replace(result.hypotheses[0], covariance=None),))
    assert not unknown.reliable, "a fitted pose without a covariance"
    similar = Registrar(known.bank, mesh_is="similar")
    assert answer_of(similar, IMAGE, BOX, None).covariance is None


def test_progress_reports_stages_and_may_cancel(monkeypatch):
    views = sample_views(azimuth_step=90, elevations=[0, 30])
    calls = []
    classical = PRESETS["classical"]
    detection = replace(classical.detection, proposals=1, min_size=0.3)
    pipeline = replace(classical, hypotheses=1, detection=detection)
    options = {"pipeline": pipeline, "image_size": 64, "progress": lambda *call: calls.append(call)}
    with monkeypatch.context() as patch:
        patch.setattr("curvireg_torch.matching.bank.TURNS", 3)
        patch.setattr("curvireg_torch.matching.bank.PIXELS_AT_A_TIME", 1)
        bank = ViewBank.build(example_mesh(), views, **options)
    assert calls == [("bank", 3, 8), ("bank", 6, 8), ("bank", 8, 8)]
    registrar = Registrar(bank, progress=lambda stage, *_: calls.append(stage))
    for boxes, expected in ((BOX[None], []), (None, ["detection"])):
        calls.clear()
        registrar([IMAGE], boxes, CAMERA)
        assert calls[: len(expected) + 2] == [*expected, "ranking", "contours"]
        assert boxes is None or len(calls) == 2

    def cancel(stage, *_):
        raise InterruptedError(f"cancelled in {stage}")

    with refused("cancelled in bank", InterruptedError):
        ViewBank.build(example_mesh(), views, image_size=64, progress=cancel)
    for boxes, stage in ((BOX[None], "ranking"), (None, "detection")):
        with refused(f"cancelled in {stage}", InterruptedError):
            Registrar(bank, progress=cancel)([IMAGE], boxes)


WRONG = BOX + torch.tensor([-0.1, 0.2, 0.1, 0.15]) * (BOX[2:] - BOX[:2]).repeat(2)


def test_wrong_box_is_corrected():
    result = answer_of(truck_registrar(box_jitter=0.1), IMAGE, WRONG)
    before = answer_of(truck_registrar(), IMAGE, WRONG)
    assert before.corrected_box is None
    assert degrees_off(result, TRUTH) < 2
    assert result.score > before.score
    overlap = box_iou(torch.stack([result.corrected_box, WRONG.double()]), BOX[None].double())[:, 0]
    assert overlap[0] > overlap[1] + 0.1
    assert result.to_dict()["corrected_box"] == result.corrected_box.tolist()


def registered_in_boxes(monkeypatch, *results, box=WRONG):
    """The answer in a box, if registrations yield these results, and the boxes of all."""
    answers = iter(results)
    boxes = []

    def register_boxes(_, items):
        boxes.extend(item.box.tolist() for item in items)
        return [next(answers) for _ in items]

    monkeypatch.setattr(stages, "register_boxes", register_boxes)
    return answer_of(truck_registrar(box_jitter=0.1), IMAGE, box), boxes


@pytest.mark.parametrize(
    ("changed", "is_beside"),
    [
        (lambda mask: mask, False),
        (lambda mask: mask & (torch.arange(mask.shape[1]) < BOX[[0, 2]].mean()), False),
        (lambda mask: max_pool2d(mask[None].float(), 5, 1, 2)[0] > 0, False),
        (lambda mask: max_pool2d(mask[None].float(), 21, 1, 10)[0] > 0, True),
        (lambda mask: mask.roll(int(0.25 * (BOX[2] - BOX[0])), 1), True),
        (lambda mask: mask.roll(int(0.25 * (BOX[3] - BOX[1])), 0), True),
    ],
)
def test_a_pose_beside_its_mask_is_not_believed(monkeypatch, changed, is_beside):
    """A part of the object, and a mask that reaches a little beyond it, are none."""
    sure = replace(truck_answer(), probabilities=(1.0,))
    mask = changed(render_depth(example_mesh(), TRUTH, CAMERA, SIZE)[0, 0] > 0)
    monkeypatch.setattr(stages, "register_boxes", lambda _, items: [sure] * len(items))
    item = as_photograph(IMAGE, BOX, CAMERA, mask=mask)
    (result,) = stages.register_photographs(truck_registrar(), [item])
    assert (doubts.BESIDE_MASK in result.warnings) == is_beside
    assert result.reliable != is_beside
    monkeypatch.setattr(Registrar, "is_exact", False)
    (similar,) = stages.register_photographs(truck_registrar(), [item])
    assert similar.reliable, "the mask is that of another shape"


@pytest.mark.parametrize(
    ("moved", "is_beside"),
    [
        ((0.3, 0.0, 0.3, 0.0), False),
        ((0.5, 0.0, 0.5, 0.0), True),
        ((0.0, -0.5, 0.0, -0.5), True),
        ((-0.4, -0.4, 0.4, 0.4), False),  # around it
        ((0.4, 0.4, -0.3, -0.3), False),  # of a part
        ((0.6, 0.0, -0.1, 0.0), False),
        ((0.6, 0.0, 0.6, 0.0), True),
    ],
)
def test_a_pose_beside_its_box_is_not_believed(monkeypatch, moved, is_beside):
    sure = replace(truck_answer(), probabilities=(1.0,))
    box = BOX + torch.tensor(moved) * (BOX[2:] - BOX[:2]).repeat(2)
    result, _ = registered_in_boxes(monkeypatch, *[sure] * 4, box=box)
    assert (doubts.BESIDE_BOX in result.warnings) == is_beside
    assert result.reliable != is_beside


def with_evidence(result, **evidence):
    best = result.hypotheses[0]
    return replace(result, hypotheses=(replace(best, evidence=best.evidence | evidence),))


@pytest.mark.parametrize(
    ("better", "confidence", "evidence"),
    [
        (True, 0.5, {"similarity": 0.71}),
        (False, 0.5, {"similarity": 0.69}),
        (True, 0.5, {"keypoints": 2.0}),
        (True, 0.6, {}),
        (False, 0.4, {}),
        (False, 0.4, {"similarity": 0.701}),
        (True, 1.0, {"similarity": 0.69}),
    ],
)
def test_corrected_result_is_kept_if_it_agrees_better(monkeypatch, better, confidence, evidence):
    """Evidence that depends on the box, as the rank does, is not compared."""
    one = replace(truck_answer(), probabilities=(0.5,))
    first = with_evidence(one, similarity=0.7, rank=0.0)
    other = with_evidence(one, **{"similarity": 0.7, "rank": -3.0} | evidence)
    other = replace(other, probabilities=(confidence,))
    result, boxes = registered_in_boxes(monkeypatch, first, other)
    assert (result.hypotheses is first.hypotheses) != better
    assert (result.corrected_box is None) != better
    assert len(boxes) == 2


def test_doubtful_photographs_are_registered_again(monkeypatch):
    """In the boxes around the best two poses, each box once; of a reliable answer, in the first, if
    it is far from the given one."""
    plain = truck_answer()
    sure = replace(plain, probabilities=(plain.reliable_from,))
    doubtful = replace(plain, probabilities=(plain.reliable_from - 0.01,))
    right = plain.hypotheses[0]
    T, K = right.projection
    nearer = torch.eye(4, dtype=T.dtype)
    nearer[2, 3] = -0.1 * float(T[2, 3])
    other = replace(right, projection=(nearer @ T, K))
    two = replace(doubtful, hypotheses=(right, other), probabilities=(0.5, 0.3))
    rough = BOX + torch.tensor([-0.04, 0.0, 0.0, 0.0]) * (BOX[2] - BOX[0])
    for box, *answers in (
        (rough, sure),
        (rough, replace(doubtful, hypotheses=(right,)), sure),
        (WRONG, replace(two, probabilities=sure.probabilities), sure),
        (WRONG, replace(two, hypotheses=(right, right)), doubtful),
    ):
        _, boxes = registered_in_boxes(monkeypatch, *answers, box=box)
        assert len(boxes) == len(answers)
    better = registered_in_boxes(monkeypatch, two, sure, doubtful)
    torch.testing.assert_close(better[0].corrected_box, double(better[1][1]))
    result, boxes = registered_in_boxes(monkeypatch, two, doubtful, sure)
    given, first, second = (double(box) for box in boxes)
    torch.testing.assert_close(given, WRONG.double())
    torch.testing.assert_close(first, BOX.double(), atol=2.0, rtol=0.0)
    sides = torch.stack([box[2:] - box[:2] for box in (first, second)])
    torch.testing.assert_close(sides[1], sides[0] / 0.9, atol=2.0, rtol=0.0)
    torch.testing.assert_close(result.corrected_box, second)


@cache
def half_way():
    """A coarse bank, and photographs and boxes of poses half-way between two of its views, both of
    which lead there."""
    mesh = example_mesh()
    azimuths = (15.0, 45.0, 75.0, 225.0)
    shown = [photograph_of(mesh, azimuth, 20.0, 1, radii=3.5) for azimuth in azimuths]
    images, boxes, _ = zip(*shown, strict=True)
    return bank_around(mesh, 30, [20], pipeline=PRESETS["classical"]), images, torch.stack(boxes)


@pytest.mark.parametrize(("fitted", "some_return"), [(5, False), (2, True)])
def test_hypotheses_that_merge_are_left_out_unless_one_alone_is_left(fitted, some_return):
    """Then their views come last."""
    bank, images, boxes = half_way()
    settings = replace(bank.pipeline.fit, least_hypotheses=fitted)
    pipeline = replace(bank.pipeline, box_jitter=0.0, hypotheses=fitted, fit=settings)
    counts = []
    returned = 0
    for result in Registrar(bank, pipeline=pipeline)(images, boxes, CAMERA):
        starts = (bank.rotations[h.view].double() for h in result.hypotheses)
        moves = (
            rotation_error(h.allocentric_rotation, R)
            for h, R in zip(result.hypotheses, starts, strict=True)
        )
        is_moved = [float(degrees) > 0.01 for degrees in moves]
        assert is_moved[0]
        assert is_moved == sorted(is_moved, reverse=True)
        assert result.hypotheses[0].covariance is not None
        put_back = result.hypotheses[is_moved.count(True) :]
        assert all(h.covariance is None for h in put_back)
        counts.append(len(result.hypotheses))
        returned += len(put_back)
    assert (returned > 0) == some_return
    assert (min(counts) < fitted) != some_return


def test_check_crop_allows_two_grey_levels_in_any_channel_and_what_resampling_may_produce():
    outside = r"outside \[0, 1\]"
    for low, high, message in (
        (0.4, 0.4 + 0.9 / 255.0, "one colour"),
        ([0.8, 0.2, 0.1], [0.8, 0.2, 0.1], "one colour"),
        (0.2, 1.01, outside),
        (-0.01, 0.8, outside),
        (0.4, 0.4 + 2.0 / 255.0, None),
        (0.0, [0.5, 0.0, 0.0], None),
        (-0.0005, 1.0005, None),
    ):
        crop = torch.zeros(3, 8, 8) + torch.tensor(low).view(-1, 1, 1)
        crop[:, 2:5, 3] = torch.tensor(high).view(-1, 1)
        with refused(message, ImageError) if message else nullcontext():
            check_crop(crop)


def test_boxes_are_compared_inside_the_photograph():
    for size, given, box, expected in (
        # cut off by the right border
        ((100, 200), (150.0, 20.0, 199.5, 80.0), (150.0, 20.0, 260.0, 80.0), 1.0),
        ((100, 200), (150.0, 20.0, 199.5, 80.0), (130.0, 20.0, 240.0, 80.0), 0.71),
        ((80, 120), (0.0, 10.0, 100.0, 60.0), (12.0, 10.0, 112.0, 60.0), 0.79),
        # outside: not used
        ((80, 120), (-0.5, 10.0, 60.0, 79.5), (-300.0, 10.0, -20.0, 79.5), 1.0),
    ):
        item = Photograph(torch.zeros(3, *size), torch.tensor(given), Camera(CAMERA))
        assert item.overlap(double(box)) == pytest.approx(expected, abs=0.005)


def test_a_mesh_that_is_absent_does_not_hide_the_answer_of_another(monkeypatch):
    """Photographs of a rig, registered to two meshes; if both are absent, the error is that of the
    first."""
    both = Registrar([truck_bank(), truck_bank()])
    found = truck_answer()
    absent = {both}
    prepared = Mock(wraps=photograph_module.as_photograph)
    monkeypatch.setattr(photograph_module, "as_photograph", prepared)

    def register(registrar, *_):
        if registrar in absent:
            raise LostObjectError("first" if registrar is both else "second")
        return found

    monkeypatch.setattr(several, "_registered_to", register)
    rig = [IMAGE], None, CAMERA, torch.eye(4)[None]
    assert both.register_views(*rig).mesh_index == 1
    assert prepared.call_count == 1, "once for both meshes"
    absent.add(both.others[0])
    with refused("first", LostObjectError):
        both.register_views(*rig)
    absent.remove(both)
    assert both.register_views(*rig).mesh_index == 0


def test_a_registrar_that_was_used_can_be_pickled_and_copied():
    registrar = truck_registrar()
    expected = truck_answer()
    for other in (pickle.loads(pickle.dumps(registrar)), copy(registrar)):
        assert torch.equal(answer_to(0, other).rotation, expected.rotation)
    assert copy(registrar).describer is registrar.describer

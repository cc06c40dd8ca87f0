"""A missing estimate (NaN or inf) never scores as right, and a truth that is not a number is refused."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from curvireg_torch import metrics
from curvireg_torch.errors import InvalidInputError

from .helpers import poses, rotations

R, T = rotations(3, 0), poses(3, 1)
POINTS = torch.rand(20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5
K = torch.tensor([[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
SYMMETRIES = torch.eye(3, dtype=torch.float64)[None]
AXIS = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
BOXES = torch.tensor([[0.0, 0.0, 9.0, 9.0], [20.0, 0.0, 29.0, 9.0], [40.0, 0.0, 49.0, 9.0]])
OBJECTS = metrics.Objects(torch.zeros(3, dtype=torch.long), BOXES, R)
VIEWS = torch.tensor([[0.0, 0.0, 0.0, 2.0], [90.0, 0.0, 0.0, 2.0], [180.0, 0.0, 0.0, 2.0]])


def detections(rotation: Tensor = R, boxes: Tensor = BOXES) -> metrics.Detections:
    return metrics.Detections(OBJECTS.image, boxes, rotation, torch.ones(3))


def spoilt(x: Tensor, value: float, *, whole: bool) -> Tensor:
    """``x`` with the last of its three items lost, or one number of it."""
    x = x.clone()
    x[2].view(-1)[slice(None) if whole else slice(0, 1)] = value
    return x


WAYS = [(math.nan, True), (math.nan, False), (math.inf, True), (-math.inf, False)]


@pytest.mark.parametrize(("value", "whole"), WAYS)
def test_a_lost_rotation_is_infinitely_wrong(value: float, whole: bool) -> None:
    lost = spoilt(R, value, whole=whole)
    for errors in (
        metrics.symmetric_rotation_error(lost, R, SYMMETRIES),
        metrics.symmetric_rotation_error(lost, R, SYMMETRIES[:0]),
        metrics.axis_rotation_error(lost, R, AXIS),
    ):
        assert errors[2] == math.inf
        torch.testing.assert_close(errors[:2], torch.zeros(2, dtype=torch.float64), rtol=0, atol=1e-5)
    assert metrics.symmetric_rotation_error(lost[:, None], R, SYMMETRIES).isinf().tolist() == [[False] * 3] * 2 + [
        [True] * 3
    ]
    errors = metrics.symmetric_rotation_error(lost, R, SYMMETRIES)
    assert [metrics.accuracy(errors, limit) for limit in (30.0, 10.0)] == pytest.approx([2 / 3, 2 / 3])
    assert metrics.median_error(errors) == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize(("value", "whole"), WAYS)
def test_a_detection_without_a_viewpoint_is_found_and_wrong(value: float, whole: bool) -> None:
    lost = detections(spoilt(R, value, whole=whole))
    assert metrics.average_precision(lost, OBJECTS) == 1.0
    for bins in metrics.AVP_BINS:
        assert metrics.average_viewpoint_precision(lost, OBJECTS, bins) == pytest.approx(2 / 3)
    assert metrics.average_rotation_precision(lost, OBJECTS, threshold_deg=360.0) == pytest.approx(2 / 3)
    nowhere = detections(boxes=spoilt(BOXES, value, whole=whole))
    assert metrics.average_precision(nowhere, OBJECTS) == pytest.approx(2 / 3 * 2 / 3)  # two of three, ties together


@pytest.mark.parametrize("bins", metrics.AVP_BINS)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_lost_azimuth_falls_into_no_bin(bins: int, value: float) -> None:
    for truth in torch.arange(0.0, 360.0, 360.0 / bins):  # whichever bin a cast of NaN might give
        assert metrics.binned_accuracy(torch.tensor([value, 3.0]), torch.tensor([float(truth), 3.0]), bins) == 0.5
    with pytest.raises(InvalidInputError, match="azimuth: expected finite"):
        metrics.azimuth_bin(torch.tensor([0.0, value]), bins)


def test_many_turns_of_azimuth_are_no_other_bin() -> None:
    far = torch.tensor([90.0 + 360.0 * 2**60], dtype=torch.float64)  # beyond int64 in degrees; a multiple of 45
    assert metrics.azimuth_bin(far, 8).tolist() == [int(float(far) % 360.0 / 45.0)]


@pytest.mark.parametrize(("value", "whole"), WAYS)
def test_a_lost_pose_is_a_miss_in_every_recall(value: float, whole: bool) -> None:
    lost = spoilt(T, value, whole=whole)
    assert metrics.add_recall(metrics.add_error(lost, T, POINTS), 1.0) == pytest.approx(2 / 3)
    assert metrics.add_recall(metrics.adds_error(lost, T, POINTS), 1.0) == pytest.approx(2 / 3)
    assert metrics.mssd_recall(metrics.mssd_error(lost, T, POINTS), 1.0) == pytest.approx(2 / 3)
    assert metrics.mspd_recall(metrics.mspd_error(lost, T, POINTS, K), 640) == pytest.approx(2 / 3)
    assert metrics.adds_error(lost, T, POINTS)[2] == math.inf


@pytest.mark.parametrize(("value", "whole"), WAYS)
def test_a_lost_estimate_of_the_parameters_makes_the_mean_infinite(value: float, whole: bool) -> None:
    table = metrics.pose_parameter_errors(spoilt(VIEWS, value, whole=whole), VIEWS, VIEWS)
    assert set(table["est"].values()) == {math.inf}
    assert set(table["clo"].values()) == {0.0}


def _zero_matrix(T: Tensor) -> Tensor:
    T = T.clone()
    T[1] = 0.0
    return T


@pytest.mark.parametrize("bad", [_zero_matrix, lambda T: T * 1.05, lambda T: T.mT, lambda T: -T])
def test_a_pose_that_is_not_rigid_is_refused(bad: Callable[[Tensor], Tensor]) -> None:
    # A zero matrix would put every point into the origin, which for ADD-S may well lie near the surface.
    for name, arguments in (("T_est", (bad(T), T)), ("T_gt", (T, bad(T)))):
        for error in (metrics.add_error, metrics.adds_error, metrics.mssd_error):
            with pytest.raises(InvalidInputError, match=f"{name}: expected rigid"):
                error(*arguments, POINTS)


def test_rounded_poses_are_rigid_enough() -> None:
    rounded = T.clone()
    rounded[:, :3, :3] = (rounded[:, :3, :3] * 1000.0).round() / 1000.0  # three digits, as some result files have
    assert float(metrics.mssd_error(rounded, T, POINTS).max()) < 2e-3
    assert metrics.mssd_error(T.half(), T, POINTS).isfinite().all()


CALLS: dict[str, Callable[[float], object]] = {
    "R_gt": lambda bad: metrics.symmetric_rotation_error(R, spoilt(R, bad, whole=False), SYMMETRIES),
    "R_gt of axis": lambda bad: metrics.axis_rotation_error(R, spoilt(R, bad, whole=False), AXIS),
    "symmetries": lambda bad: metrics.symmetric_rotation_error(R, R, SYMMETRIES * bad),
    "axis": lambda bad: metrics.axis_rotation_error(R, R, AXIS * bad),
    "azimuth": lambda bad: metrics.binned_accuracy(torch.zeros(2), torch.tensor([0.0, bad]), 4),
    "objects.boxes": lambda bad: metrics.average_precision(
        detections(), metrics.Objects(OBJECTS.image, spoilt(BOXES, bad, whole=False), R)
    ),
    "objects.rotations": lambda bad: metrics.average_viewpoint_precision(
        detections(), metrics.Objects(OBJECTS.image, BOXES, spoilt(R, bad, whole=False)), 4
    ),
    "symmetries of poses": lambda bad: metrics.mssd_error(T, T, POINTS, symmetries=T * bad),
    "symmetries in the image": lambda bad: metrics.mspd_error(T, T, POINTS, K, symmetries=T * bad),
    "camera matrix": lambda bad: metrics.mspd_error(T, T, POINTS, K * bad),
    "points": lambda bad: metrics.add_error(T, T, POINTS * bad),
    "errors": lambda bad: metrics.rank_precision(torch.tensor([[0, 1]]), torch.tensor([[bad, bad]]), ks=(1,)),
    "views": lambda bad: metrics.closest_view(spoilt(VIEWS, bad, whole=False), VIEWS),
    "truth": lambda bad: metrics.closest_view(VIEWS, spoilt(VIEWS, bad, whole=False)),
    "truth of parameters": lambda bad: metrics.pose_parameter_errors(VIEWS, spoilt(VIEWS, bad, whole=False), VIEWS),
    "diameter": lambda bad: metrics.add_recall(torch.ones(1), bad),
}


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("name", CALLS)
def test_truth_that_is_no_number_is_refused(name: str, bad: float) -> None:
    with pytest.raises(InvalidInputError, match=name.split(" of ")[0].split(" in ")[0] + ": expected"):
        CALLS[name](bad)


def test_a_true_box_without_area_is_refused() -> None:
    # Nothing could ever claim it: recall would be too small without a word.
    for box in ([9.0, 0.0, 0.0, 9.0], [0.0, 9.0, 9.0, 9.0]):
        boxes = torch.tensor([*BOXES.tolist()[:2], box])
        with pytest.raises(InvalidInputError, match=r"objects\.boxes: expected X0 < X1 and Y0 < Y1"):
            metrics.average_precision(detections(), metrics.Objects(OBJECTS.image, boxes, R))


WRONG: dict[str, Callable[[], object]] = {
    "R_est": lambda: metrics.symmetric_rotation_error(R[0, 0], R, SYMMETRIES),
    "R_gt": lambda: metrics.axis_rotation_error(R, R.tolist(), AXIS),  # type: ignore[arg-type]
    "azimuth": lambda: metrics.azimuth_bin([3.0], 4),  # type: ignore[arg-type]
    "camera_matrix": lambda: metrics.mspd_error(T, T, POINTS, K[None].repeat(2, 1, 1)),
    "camera_matrix: expected a torch.Tensor": lambda: metrics.mspd_error(T, T, POINTS, K.tolist()),  # type: ignore[arg-type]
    "photo": lambda: metrics.intersection_percentage([[True]], torch.ones(1, 1, dtype=torch.bool)),  # type: ignore[arg-type]
    "view": lambda: metrics.intersection_percentage(torch.ones(1, 1, dtype=torch.bool), [[True]]),  # type: ignore[arg-type]
    "image": lambda: metrics.Objects([0], BOXES[:1], R[:1]),  # type: ignore[arg-type]
    "image: expected an integer": lambda: metrics.Objects(torch.ones(3, dtype=torch.bool), BOXES, R),
    "order": lambda: metrics.rank_precision([[0]], torch.ones(1, 1), ks=(1,)),  # type: ignore[arg-type]
    "a": lambda: metrics.viewpoint_differences([0.0] * 4, torch.zeros(4)),  # type: ignore[arg-type]
    "b": lambda: metrics.viewpoint_differences(torch.zeros(4), torch.zeros(3)),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_types_and_shapes_are_named(name: str) -> None:
    with pytest.raises(InvalidInputError, match=rf"^{name}"):
        WRONG[name]()


ELSEWHERE: dict[str, Callable[[Callable[[Tensor], Tensor]], object]] = {
    "R_est": lambda to: metrics.symmetric_rotation_error(to(R), R, SYMMETRIES),
    "symmetries": lambda to: metrics.symmetric_rotation_error(R, R, to(SYMMETRIES)),
    "axis": lambda to: metrics.axis_rotation_error(R, R, to(AXIS)),
    "T_gt": lambda to: metrics.add_error(T, to(T), POINTS),
    "points": lambda to: metrics.add_error(T, T, to(POINTS)),
    "camera_matrix": lambda to: metrics.mspd_error(T, T, POINTS, to(K)),
    "diameter": lambda to: metrics.add_recall(torch.ones(1), to(torch.ones(1))),
    "order": lambda to: metrics.rank_precision(to(torch.tensor([[0]])), torch.ones(1, 1), ks=(1,)),
    "view": lambda to: metrics.intersection_percentage(*(f(torch.ones(2, 2) > 0) for f in (torch.clone, to))),
    "boxes": lambda to: metrics.Objects(OBJECTS.image, to(BOXES), R),
    "rotations": lambda to: metrics.Objects(OBJECTS.image, BOXES, to(R)),
}


@pytest.mark.parametrize("name", ELSEWHERE)
def test_tensors_of_two_devices_are_named(name: str) -> None:
    with pytest.raises(InvalidInputError, match=rf"^{name}: expected device cpu, got meta"):
        ELSEWHERE[name](lambda x: x.to("meta"))


def test_of_nothing_there_is_nothing() -> None:
    nothing = torch.empty(0, dtype=torch.float64)
    assert metrics.symmetric_rotation_error(R[:0], R[:0], SYMMETRIES).shape == (0,)
    assert metrics.axis_rotation_error(R[:0], R[:0], AXIS).shape == (0,)
    assert metrics.azimuth_bin(nothing, 4).shape == (0,)
    assert metrics.closest_view(VIEWS, VIEWS[:0]).shape == (0,)
    assert metrics.viewpoint_differences(VIEWS[:0], VIEWS[:0]).shape == (0, 4)
    for share in (metrics.add_recall(nothing, 1.0), metrics.mspd_recall(nothing, 640)):
        assert math.isnan(share)

import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as mp

from curvireg_torch import metrics
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.geometry import rotation_error

from .helpers import poses, rotations

N = 9
R_GT, T_GT = rotations(N, 0), poses(N, 1)
R_EST, T_EST = rotations(N, 2), poses(N, 3, near=T_GT)
R_EST[::3] = R_GT[::3] @ torch.tensor([[1, 0, 0], [0, 0.96, -0.28], [0, 0.28, 0.96]], dtype=torch.float64)  # 16 degrees
POINTS = torch.rand(30, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5
K = torch.tensor([[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
RANK_ERRORS = 180.0 * torch.rand(N, 12, generator=torch.Generator().manual_seed(1))
ORDER = torch.rand(N, 12, generator=torch.Generator().manual_seed(2)).argsort(1)


def viewpoint(items: slice) -> metrics.ViewpointAccuracy:
    metric = metrics.ViewpointAccuracy(legacy_sqrt2=True)
    metric.update(R_EST[items], R_GT[items])
    return metric


def pose(items: slice) -> metrics.PoseRecall:
    metric = metrics.PoseRecall()
    metric.update(T_EST[items], T_GT[items], POINTS, K, diameter=1.5, image_width=480)
    return metric


def rank(items: slice) -> metrics.RankPrecision:
    metric = metrics.RankPrecision(ks=(1, 4), threshold_deg=30.0)
    metric.update(ORDER[items], RANK_ERRORS[items])
    return metric


EVERY = [viewpoint, pose, rank]


@pytest.mark.parametrize("make", EVERY)
def test_merging_equals_one_batch_and_reset_forgets(make: Callable[[slice], metrics.Metric]) -> None:
    whole, parts = make(slice(None)), make(slice(0, 2))
    parts.merge_state(make(slice(2, 2)))
    parts.merge_state(make(slice(2, N)))
    expected = whole.compute()
    assert parts.compute() == expected
    assert parts.sync().compute() == expected  # no process group: a copy
    parts.reset()
    assert whole.compute() == expected
    assert parts.compute() == pytest.approx(make(slice(0, 0)).compute(), nan_ok=True)
    assert math.isnan(list(parts.compute().values())[-1])


def test_viewpoint_class_agrees_with_the_functions() -> None:
    errors = rotation_error(R_EST, R_GT)
    assert viewpoint(slice(None)).compute() == pytest.approx(
        {
            "n": N,
            "acc_pi_6": metrics.accuracy(errors, 30.0),
            "acc_pi_18": metrics.accuracy(errors, 10.0),
            "med_err_deg": metrics.median_error(errors),
            "acc_pi_6_legacy_sqrt2": metrics.accuracy(errors, 30.0, legacy_sqrt2=True),
            "acc_pi_18_legacy_sqrt2": metrics.accuracy(errors, 10.0, legacy_sqrt2=True),
            "med_err_deg_legacy_sqrt2": metrics.median_error(errors) / math.sqrt(2.0),
        }
    )
    plain = metrics.ViewpointAccuracy()
    plain.update(R_EST, R_GT)
    assert list(plain.compute()) == ["n", "acc_pi_6", "acc_pi_18", "med_err_deg"]


def test_viewpoint_class_counts_missing_estimates_and_forgives_symmetries() -> None:
    half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64))
    est = torch.stack([R_GT[0] @ half_turn, R_GT[1] * math.nan])
    metric = metrics.ViewpointAccuracy()
    metric.update(est, R_GT[:2], symmetries=half_turn[None])
    assert metric.compute() == {"n": 2, "acc_pi_6": 0.5, "acc_pi_18": 0.5, "med_err_deg": math.inf}
    metric.reset()
    metric.update(est, R_GT[:2])
    assert metric.compute()["acc_pi_6"] == 0.0
    with pytest.raises(InvalidInputError, match="R_gt"):
        metric.update(R_GT[:2], est)


def test_pose_class_agrees_with_the_functions() -> None:
    add = metrics.add_error(T_EST, T_GT, POINTS)
    mssd, mspd = metrics.mssd_error(T_EST, T_GT, POINTS), metrics.mspd_error(T_EST, T_GT, POINTS, K)
    scores = pose(slice(None)).compute()
    assert scores == pytest.approx(
        {
            "n": N,
            "add_recall_0.1d": metrics.add_recall(add, 1.5),
            "mssd_ar": metrics.mssd_recall(mssd, 1.5),
            "mspd_ar": metrics.mspd_recall(mspd, 480),
        }
    )
    assert 0.0 < scores["mspd_ar"] < 1.0


def test_pose_class_takes_adds_for_a_symmetric_object() -> None:
    half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0], dtype=torch.float64))
    both = torch.stack([torch.eye(4, dtype=torch.float64), half_turn])
    points = torch.cat([POINTS, POINTS @ half_turn[:3, :3]])
    for symmetries, expected in ((both, 1.0), (both[:1], 0.0), (None, 0.0)):
        metric = metrics.PoseRecall()
        metric.update(T_GT @ half_turn, T_GT, points, K, diameter=1.5, image_width=640, symmetries=symmetries)
        assert metric.compute()["add_recall_0.1d"] == expected


def test_rank_class_agrees_with_the_function() -> None:
    assert rank(slice(None)).compute() == metrics.rank_precision(ORDER, RANK_ERRORS, ks=(1, 4), threshold_deg=30.0)


def test_metrics_of_another_kind_or_setting_are_not_merged() -> None:
    settings = metrics.RankPrecision(ks=(1, 3), threshold_deg=30.0), metrics.RankPrecision(ks=(1, 4))
    for other in (*settings, pose(slice(0, 1))):
        with pytest.raises(InvalidInputError, match="RankPrecision"):
            rank(slice(0, 1)).merge_state(other)  # type: ignore[arg-type]


def _process(rank_: int, folder: str) -> None:
    dist.init_process_group("gloo", init_method=f"file://{folder}/rendezvous", rank=rank_, world_size=2)
    items = slice(0, 4) if rank_ == 0 else slice(4, N)
    scores = []
    for make in EVERY:
        mine = make(items)
        mine.sync()
        scores.append(mine.sync().compute())  # twice, and nothing is counted twice
        assert mine.compute() == make(items).compute()
    torch.save(scores, f"{folder}/{rank_}.pt")
    dist.destroy_process_group()


@pytest.mark.slow
@pytest.mark.skipif(not dist.is_available(), reason="torch was built without torch.distributed")
def test_two_processes_see_the_items_of_both(tmp_path: Path) -> None:
    mp.spawn(_process, args=(str(tmp_path),), nprocs=2)
    expected = [make(slice(None)).compute() for make in EVERY]
    for rank_ in range(2):
        assert torch.load(tmp_path / f"{rank_}.pt", weights_only=True) == expected

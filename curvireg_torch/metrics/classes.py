"""Metrics that gather items batch by batch, and process by process.

They keep torchmetrics' verbs: ``update`` with a batch, ``compute`` over all of them, ``reset``, ``merge_state`` with
the metric of another worker. The state is one row of numbers per item, so that medians are exact and nothing depends on
how the items were batched. The functions of this package do the arithmetic.
"""

import copy
from collections.abc import Hashable, Sequence
from typing import Any, Self

import torch
import torch.distributed as dist
from torch import Tensor

from curvireg_torch._checks import check_tensor
from curvireg_torch.errors import InvalidInputError

from ._samples import per_item
from .pose import add_error, add_recall, adds_error, mspd_error, mspd_recall, mssd_error, mssd_recall
from .ranking import check_ranks, precision_from_rows, rank_rows
from .viewpoint import accuracy, median_error, symmetric_rotation_error

__all__ = ["Metric", "PoseRecall", "RankPrecision", "ViewpointAccuracy"]


class Metric:
    """What the metrics below have in common: rows of numbers, one per item, float64 on the CPU."""

    def __init__(self, columns: int, *settings: Hashable) -> None:
        self._settings = settings
        self._rows = torch.empty((0, columns), dtype=torch.float64)

    def reset(self) -> None:
        """Forgets every item."""
        self._rows = self._rows[:0]

    def merge_state(self, other: Self) -> None:
        """Adds the items of another metric of the same class and settings.

        Raises:
            InvalidInputError: another class or other settings.
        """
        if type(other) is not type(self) or other._settings != self._settings:
            raise InvalidInputError(f"other: expected {self!r}, got {other!r}")
        self._append(other._rows)

    def sync(self, group: "dist.ProcessGroup | None" = None) -> Self:
        """A metric with the items of all processes of a ``torch.distributed`` group, in the order of their ranks.

        This one keeps its own items alone, so gathering twice counts nothing twice: ``metric.sync().compute()``.
        All processes of the group must call it. Without an initialised group it is a copy.

        Raises:
            InvalidInputError: a process brought another class or other settings.
        """
        parts: list[Any] = [self]
        if dist.is_available() and dist.is_initialized():
            parts = [None] * dist.get_world_size(group)
            dist.all_gather_object(parts, self, group=group)
        everything = copy.copy(self)
        everything.reset()
        for part in parts:
            everything.merge_state(part)
        return everything

    def _append(self, rows: Tensor) -> None:
        self._rows = torch.cat([self._rows, rows.detach().cpu().double()])

    def __repr__(self) -> str:
        return f"{type(self).__name__}{self._settings!r}"


class ViewpointAccuracy(Metric):
    """Acc(pi/6), Acc(pi/18) and the median error of rotations.

    Args:
        legacy_sqrt2: report the literature's flawed numbers too, under ``*_legacy_sqrt2``
            (see :func:`curvireg_torch.metrics.accuracy`).

    Example:
        >>> from curvireg_torch.geometry import rotation_from_viewpoint
        >>> metric = ViewpointAccuracy()
        >>> R = rotation_from_viewpoint(torch.tensor([0.0, 20.0, 90.0]), 0.0)
        >>> metric.update(R[1:], R[[0, 0]])
        >>> {name: round(value, 3) for name, value in metric.compute().items()}
        {'n': 2, 'acc_pi_6': 0.5, 'acc_pi_18': 0.0, 'med_err_deg': 55.0}
    """

    def __init__(self, *, legacy_sqrt2: bool = False) -> None:
        super().__init__(1, legacy_sqrt2)
        self._legacy_sqrt2 = legacy_sqrt2

    def update(self, R_est: Tensor, R_gt: Tensor, *, symmetries: Tensor | None = None) -> None:
        """Adds a batch.

        Args:
            R_est, R_gt: (B, 3, 3); NaN in ``R_est`` for a missing estimate, whose error is ``inf``.
            symmetries: (S, 3, 3) of the objects of this batch, see :func:`symmetric_rotation_error`.

        Raises:
            InvalidInputError: wrong shape, dtype or device, or ``R_gt`` with NaN or inf.
        """
        check_tensor(R_gt, "R_gt", (None, 3, 3))
        check_tensor(R_est, "R_est", tuple(R_gt.shape))
        symmetries = R_gt.new_empty(0, 3, 3) if symmetries is None else symmetries
        self._append(symmetric_rotation_error(R_est, R_gt, symmetries).unsqueeze(1))

    def compute(self) -> dict[str, float]:
        """``n``, ``acc_pi_6``, ``acc_pi_18`` (shares), ``med_err_deg``; NaN where n = 0."""
        errors = self._rows[:, 0]
        scores: dict[str, float] = {"n": len(errors)}
        for legacy, suffix in ((False, ""), (True, "_legacy_sqrt2"))[: 1 + self._legacy_sqrt2]:
            scores["acc_pi_6" + suffix] = accuracy(errors, 30.0, legacy_sqrt2=legacy)
            scores["acc_pi_18" + suffix] = accuracy(errors, 10.0, legacy_sqrt2=legacy)
            scores["med_err_deg" + suffix] = median_error(errors, legacy_sqrt2=legacy)
        return scores


class PoseRecall(Metric):
    """ADD(-S) recall at a tenth of the diameter and BOP's average recalls of MSSD and MSPD.

    Example:
        >>> T = torch.eye(4)[None]; T[0, 2, 3] = 500.0
        >>> K = torch.tensor([[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]])
        >>> metric = PoseRecall()
        >>> metric.update(T, T, 50.0 * torch.rand(20, 3), K, diameter=80.0, image_width=640)
        >>> metric.compute()
        {'n': 1, 'add_recall_0.1d': 1.0, 'mssd_ar': 1.0, 'mspd_ar': 1.0}
    """

    def __init__(self) -> None:
        super().__init__(3)

    def update(
        self,
        T_est: Tensor,
        T_gt: Tensor,
        points: Tensor,
        camera_matrix: Tensor,
        *,
        diameter: Tensor | float,
        image_width: Tensor | float,
        symmetries: Tensor | None = None,
    ) -> None:
        """Adds the poses of one object.

        Args:
            T_est, T_gt: (B, 4, 4) rigid model -> camera; NaN in ``T_est`` for a missing estimate, which is a miss.
            points: (P, 3) on the model's surface, in the unit of the poses.
            camera_matrix: (B, 3, 3) or (3, 3), pixels.
            diameter: of the object, in the unit of the poses.
            image_width: px, a number or (B,).
            symmetries: (S, 4, 4) with the identity; with any other beside it ADD-S takes the place of ADD, as is usual.

        Raises:
            InvalidInputError: see :func:`mssd_error` and :func:`mspd_error`.
        """
        symmetric = symmetries is not None and len(symmetries) > 1
        add = (adds_error if symmetric else add_error)(T_est, T_gt, points)
        mssd = mssd_error(T_est, T_gt, points, symmetries=symmetries)
        mspd = mspd_error(T_est, T_gt, points, camera_matrix, symmetries=symmetries)
        size, width = per_item(diameter, add, "diameter"), per_item(image_width, add, "image_width")
        self._append(torch.stack([add / size, mssd / size, mspd / width], 1))

    def compute(self) -> dict[str, float]:
        """``n``, ``add_recall_0.1d``, ``mssd_ar``, ``mspd_ar`` (shares); NaN where n = 0."""
        add, mssd, mspd = self._rows.unbind(1)  # in diameters, diameters and image widths
        return {
            "n": len(add),
            "add_recall_0.1d": add_recall(add, 1.0),
            "mssd_ar": mssd_recall(mssd, 1.0),
            "mspd_ar": mspd_recall(mspd, 1.0),
        }


class RankPrecision(Metric):
    """Precision at rank k of the rankings of a view bank, in either definition.

    Args:
        ks, threshold_deg: see :func:`rank_precision`.

    Raises:
        InvalidInputError: ranks below 1, a threshold that is not > 0.

    Example:
        >>> metric = RankPrecision(ks=(1, 2))
        >>> metric.update(torch.tensor([[1, 0], [0, 1]]), torch.tensor([[3.0, 40.0], [3.0, 40.0]]))
        >>> metric.compute()
        {1: 0.5, 2: 1.0}
    """

    def __init__(self, *, ks: Sequence[int] = (1, 3, 5, 10, 20), threshold_deg: float | None = None) -> None:
        check_ranks(ks, threshold_deg)
        super().__init__(1 + len(ks), tuple(ks), threshold_deg)
        self._ks, self._threshold_deg = tuple(ks), threshold_deg

    def update(self, order: Tensor, errors: Tensor) -> None:
        """Adds a batch: ``order`` (B, M) and ``errors`` (B, N) as for :func:`rank_precision`."""
        self._append(rank_rows(order, errors, self._ks))

    def compute(self) -> dict[int, float]:
        """``{k: share}``, NaN where no query was added."""
        return precision_from_rows(self._rows, self._ks, self._threshold_deg)

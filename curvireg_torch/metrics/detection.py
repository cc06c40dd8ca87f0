"""Detection and viewpoint scored together: AP, AVP and ARP.

All three read one curve. Detections of a class, best score first, claim the ground-truth box of their image with which
they overlap most, if the IoU is at least 0.5 and nobody claimed it before. Recall is the share of boxes claimed;
the height of the curve is the share of the detections so far that are claims *with the right viewpoint*. That is what
PASCAL3D+'s own evaluation does, recall counting every claim, and why AVP on ground-truth boxes is the binned accuracy.

The order in which detections and objects are listed does not matter. Detections of equal score enter the curve
together; where several of them claim one box, each has an equal part of the claim, the mean over all orders. Where a
detection overlaps several true boxes equally, it claims the first of them, sorted by corners, then rotations.

A detection whose rotation has NaN in it has no viewpoint, and a wrong one therefore; one whose box has NaN claims
nothing. True objects have finite boxes and rotations.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter

import torch
from torch import Tensor

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.geometry import box_iou, viewpoint_from_rotation
from curvireg_torch.utils.checks import check_finite, check_positive, check_rotation, check_same_device, check_tensor

from ._samples import shown
from .viewpoint import same_bin, symmetric_rotation_error

__all__ = [
    "Detections",
    "Objects",
    "average_precision",
    "average_rotation_precision",
    "average_viewpoint_precision",
]

_MIN_IOU = 0.5
_INTEGERS = (torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8)


@dataclass(frozen=True)
class Objects:
    """True objects of one class, those to be found (PASCAL3D+ leaves the ones marked difficult out).

    Args:
        image: (M,) int64, which image each object is in.
        boxes: (M, 4) x0, y0, x1, y1 in pixels.
        rotations: (M, 3, 3) model -> camera.

    Raises:
        InvalidInputError: wrong shape, dtype or device, or a matrix that is no rotation.
    """

    image: Tensor
    boxes: Tensor
    rotations: Tensor

    def __post_init__(self) -> None:
        if not isinstance(self.image, Tensor) or self.image.ndim != 1 or self.image.dtype not in _INTEGERS:
            raise InvalidInputError(f"image: expected an integer tensor of shape (*), got {shown(self.image)}")
        n = len(self.image)
        check_tensor(self.boxes, "boxes", (n, 4))
        check_tensor(self.rotations, "rotations", (n, 3, 3))
        check_same_device(self.boxes, self.image, "boxes")
        check_same_device(self.rotations, self.image, "rotations")
        check_rotation(self.rotations, "rotations")


@dataclass(frozen=True)
class Detections(Objects):
    """Detected objects of one class: :class:`Objects` with ``scores`` (M,), higher = more certain."""

    scores: Tensor

    def __post_init__(self) -> None:
        super().__post_init__()
        check_tensor(self.scores, "scores", (len(self.image),))
        if not bool(self.scores.isfinite().all()):
            raise InvalidInputError("scores: expected finite numbers, got NaN or inf")


def average_precision(detections: Detections, objects: Objects) -> float:
    """Detection average precision at IoU 0.5, viewpoints ignored (VOC, area under the whole curve).

    Returns:
        [0, 1]; 0 without detections, NaN without objects.

    Raises:
        InvalidInputError: true boxes or rotations with NaN or inf, or a true box without area.

    Example:
        >>> found = Objects(torch.tensor([0]), torch.tensor([[0.0, 0.0, 9.0, 9.0]]), torch.eye(3)[None])
        >>> average_precision(Detections(found.image, found.boxes, found.rotations, torch.ones(1)), found)
        1.0
    """
    _, part = _claims(detections, objects)
    return _area(detections.scores, part, part, len(objects.image))


def average_viewpoint_precision(detections: Detections, objects: Objects, bins: int) -> float:
    """AVP of PASCAL3D+: a detection also needs the azimuth bin of the object it claims.

    Args:
        detections, objects: of one class, any number of images.
        bins: 4, 8, 16 or 24.

    Returns:
        [0, 1]; 0 without detections, NaN without objects. The order of the rows, ties among them, does not matter.

    Raises:
        InvalidInputError: another number of bins; true boxes or rotations as for :func:`average_precision`.

    Example:
        >>> found = Objects(torch.tensor([0]), torch.tensor([[0.0, 0.0, 9.0, 9.0]]), torch.eye(3)[None])
        >>> average_viewpoint_precision(Detections(found.image, found.boxes, found.rotations, torch.ones(1)), found, 24)
        1.0
    """
    claimed, part = _claims(detections, objects)
    # One lost number makes all of a rotation missing, also where the azimuth does not need it.
    lost = ~detections.rotations.isfinite().flatten(1).all(1)
    est = viewpoint_from_rotation(detections.rotations)[0].masked_fill(lost, torch.nan)
    gt = viewpoint_from_rotation(objects.rotations)[0]
    right = _right(claimed, part, lambda d, o: same_bin(est[d], gt[o], bins))
    return _area(detections.scores, part, right, len(objects.image))


def average_rotation_precision(detections: Detections, objects: Objects, *, threshold_deg: float = 30.0) -> float:
    """ARP: a detection also needs a rotation error below a threshold (Tulsiani and Malik 2015).

    Args:
        detections, objects: of one class, any number of images.
        threshold_deg: degrees > 0; an error equal to it is wrong.

    Returns:
        [0, 1]; 0 without detections, NaN without objects; ties as in :func:`average_viewpoint_precision`.

    Raises:
        InvalidInputError: a threshold that is not > 0; true boxes or rotations as for :func:`average_precision`.

    Example:
        >>> found = Objects(torch.tensor([0]), torch.tensor([[0.0, 0.0, 9.0, 9.0]]), torch.eye(3)[None])
        >>> flipped = torch.diag(torch.tensor([1.0, -1.0, -1.0]))[None]
        >>> average_rotation_precision(Detections(found.image, found.boxes, flipped, torch.ones(1)), found)
        0.0
    """
    check_positive(threshold_deg, "threshold_deg")
    claimed, part = _claims(detections, objects)
    none = objects.rotations[:0]

    def agrees(d: Tensor, o: Tensor) -> Tensor:
        return symmetric_rotation_error(detections.rotations[d], objects.rotations[o], none) < threshold_deg

    right = _right(claimed, part, agrees)
    return _area(detections.scores, part, right, len(objects.image))


def _claims(detections: Detections, objects: Objects) -> tuple[Tensor, Tensor]:
    """(N,) index of the object that each detection claims, -1 for none; and (N,) float64 its part of that claim."""
    check_finite(objects.boxes, "objects.boxes")
    check_finite(objects.rotations, "objects.rotations")
    if not bool((objects.boxes[:, 2:] > objects.boxes[:, :2]).all()):
        raise InvalidInputError("objects.boxes: expected X0 < X1 and Y0 < Y1; give corners, not width and height")
    claimed = torch.full_like(detections.image, -1, dtype=torch.int64)
    part = torch.zeros_like(claimed, dtype=torch.float64)
    by_score = torch.argsort(detections.scores, descending=True, stable=True)
    in_order = _in_order(objects)
    for image in set(detections.image.tolist()):
        mine = by_score[detections.image[by_score] == image]
        there = in_order[objects.image[in_order] == image]
        if len(there) == 0:
            continue
        # Of equal overlaps max gives the first.
        iou, best = box_iou(detections.boxes[mine], objects.boxes[there]).max(1)
        free = set(there.tolist())
        rows = zip(detections.scores[mine].tolist(), mine.tolist(), iou.tolist(), there[best].tolist(), strict=True)
        for _, tied in groupby(rows, key=itemgetter(0)):
            claims: dict[int, list[int]] = {}
            for _, d, overlap, o in tied:
                if overlap >= _MIN_IOU and o in free:
                    claims.setdefault(o, []).append(d)
            for o, claimants in claims.items():
                claimed[claimants], part[claimants] = o, 1.0 / len(claimants)
            free.difference_update(claims)
    return claimed, part


def _in_order(objects: Objects) -> Tensor:
    """(M,) indices of the objects by their boxes, then rotations, however they are listed."""
    rows = torch.cat([objects.boxes.double(), objects.rotations.flatten(1).double()], dim=1).tolist()
    return torch.tensor(sorted(range(len(rows)), key=rows.__getitem__), dtype=torch.int64, device=objects.image.device)


def _right(claimed: Tensor, part: Tensor, agrees: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """(N,) the parts of the claims for which ``agrees(detections, objects)`` holds, 0 elsewhere."""
    right = torch.zeros_like(part)
    index = torch.nonzero(claimed >= 0).flatten()
    right[index] = torch.where(agrees(index, claimed[index]), part[index], 0.0)
    return right


def _area(scores: Tensor, hits: Tensor, right: Tensor, n_objects: int) -> float:
    """Area under (recall of the hits, share of the right ones), the curve made monotone from the right as VOC does."""
    if n_objects == 0:
        return math.nan
    if len(scores) == 0:
        return 0.0
    ordered, by_score = torch.sort(scores, descending=True, stable=True)
    last_of_ties = torch.cat([ordered[1:] != ordered[:-1], ordered.new_ones(1, dtype=torch.bool)])
    rank = torch.arange(1, len(scores) + 1, device=scores.device, dtype=torch.float64)
    recall = (hits[by_score].cumsum(0) / n_objects)[last_of_ties]
    height = (right[by_score].cumsum(0) / rank)[last_of_ties]
    envelope = height.flip(0).cummax(0).values.flip(0)
    return float((torch.diff(recall, prepend=recall.new_zeros(1)) * envelope).sum())

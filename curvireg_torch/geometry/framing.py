"""How far a photograph shows an object: what lies outside it, and boxes that its border cuts."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from ..utils.aliases import Size
from .cameras import boxes_of, projected
from .crops import crop_transforms, image_transforms, square_boxes

BORDER = 1.5  # Pixels from the border within which a side of a box lies on it
# By how much an object may go on beyond the border, as fractions of what is visible of it
EXTENSIONS = (0.4, 1.2)
# By how much it may go on behind an occluder, on one side
HIDDEN_EXTENSIONS = (0.35, 1.0)
# Error that the box of a visible part is allowed, as a fraction of its longer side
VISIBLE_MARGIN = 0.05


def photograph_box(size: Size) -> Tensor:
    """(4,) float64 box of a photograph of ``size`` (H, W)."""
    height, width = size
    return torch.tensor([-0.5, -0.5, width - 0.5, height - 0.5], dtype=torch.float64)


def clipped(box: Tensor, size: Size) -> Tensor:
    """The part of a box (4,) inside a photograph of ``size`` (H, W), which it overlaps."""
    limits = photograph_box(size).to(box)
    low = torch.maximum(box[:2], limits[:2])
    high = torch.minimum(box[2:], limits[2:])
    return torch.cat([low, high])


def border_sides(box: Tensor, size: Size) -> int:
    """Number of sides of a box (4,) that lie on the border of a photograph of ``size`` (H, W), or
    beyond it.

    Example:
        >>> border_sides(torch.tensor([0.0, 10.0, 50.0, 60.0]), (480, 640))
        1
    """
    low, high = _on_border(box, size)
    return int(low.sum() + high.sum())


def _on_border(box: Tensor, size: Size) -> tuple[Tensor, Tensor]:
    """Which of the sides x0, y0 and of the sides x1, y1 of a box (4,) lie on the border of a
    photograph of ``size`` (H, W), or beyond it, each (2,) bool."""
    limits = photograph_box(size).to(box)
    return box[:2] <= limits[:2] + BORDER, box[2:] >= limits[2:] - BORDER


def whole_boxes(box: Tensor, size: Size) -> list[Tensor]:
    """Boxes that the whole object may have whose visible part has a ``box`` (4,) in a photograph of
    ``size`` (H, W): beyond the sides on its border, it goes on by ``EXTENSIONS`` of the box's width
    or height; none where no side lies there.

    Example:
        >>> box = torch.tensor([-0.5, 10.0, 99.5, 60.0]).double()
        >>> [whole.tolist() for whole in whole_boxes(box, (480, 640))]
        [[-40.5, 10.0, 99.5, 60.0], [-120.5, 10.0, 99.5, 60.0]]
    """
    low, high = _on_border(box, size)
    sides = box[2:] - box[:2]
    if not bool((low | high).any()):
        return []
    # an object that leaves the photograph on both sides is about in its middle
    share = sides / (low.to(box) + high.to(box)).clamp(min=1.0)
    return [
        torch.cat([box[:2] - extension * share * low, box[2:] + extension * share * high])
        for extension in EXTENSIONS
    ]


def hidden_boxes(box: Tensor) -> list[Tensor]:
    """Boxes that the whole object may have whose visible part has a ``box`` (4,): behind an
    occluder it goes on beyond one of the four sides, by ``HIDDEN_EXTENSIONS`` of the box's width or
    height.

    Example:
        >>> box = torch.tensor([0.0, 0.0, 40.0, 20.0])
        >>> [whole.tolist() for whole in hidden_boxes(box)][::3]
        [[-14.0, 0.0, 40.0, 20.0], [0.0, 0.0, 40.0, 27.0], [0.0, 0.0, 80.0, 20.0]]
    """
    sides = (box[2:] - box[:2]).repeat(2) * box.new_tensor([-1.0, -1.0, 1.0, 1.0])
    return [box + extension * side for extension in HIDDEN_EXTENSIONS for side in sides.diag()]


def around_visible(box: Tensor, size: Size) -> Tensor:
    """(4,) the part of a photograph of ``size`` (H, W) that shows an object whose visible part has
    a ``box`` (4,)."""
    margin = VISIBLE_MARGIN * (box[2:] - box[:2]).max()
    return clipped(torch.cat([box[:2] - margin, box[2:] + margin]), size)


def inside_boxes(shown: Tensor, boxes: Tensor, size: int, margin: float) -> Tensor:
    """(B, 1, size, size) float32: 1 where crops around (B, 4) boxes lie in the boxes ``shown`` (B,
    4), such as those of their photographs, whose border crops repeat."""
    A = image_transforms(square_boxes(boxes, margin), size)
    at = torch.arange(size, dtype=A.dtype)
    x, y = (A[:, k, k, None] * at + A[:, k, 2, None] for k in (0, 1))
    x0, y0, x1, y1 = shown.to(A).unsqueeze(-1).unbind(1)
    across = (x >= x0) & (x <= x1)
    down = (y >= y0) & (y <= y1)
    return (down[:, None, :, None] & across[:, None, None, :]).float()


@dataclass(frozen=True)
class CropFrame:
    """What the crop of a box shows. In it, poses are compared as the photograph's camera sees them,
    without what the border, or an occluder beside the box, cuts off.

    Attributes:
        transform: (3, 3) from px of the photograph to those of the crop.
        inside: (1, S, S) bool, pixels of the crop that count.
    """

    transform: Tensor
    inside: Tensor

    @classmethod
    def of(cls, box: Tensor, shown: Tensor, *, side: int, margin: float) -> "CropFrame":
        """The frame of the crop of a box (4,), with a ``margin`` around it, to ``side`` px, of
        which what lies in the box ``shown`` (4,) counts."""
        box = box.double()
        inside = inside_boxes(shown[None], box[None], side, margin)[0] > 0.0
        return cls(crop_transforms(square_boxes(box, margin), side), inside)


def shown_in(frame: CropFrame | None, field: Tensor) -> Tensor:
    """A field (..., S, S) without pixels that do not count in a frame; as it is without one."""
    return field if frame is None else field * frame.inside.to(field.device)


def outside_fraction(hull: Tensor, T: Tensor, K: Tensor, size: Size) -> float:
    """Fraction of the outline's area that lies outside a photograph of ``size`` (H, W), in [0, 1].

    Args:
        hull: (V, 3) corners of the mesh's convex hull.
        T: (4, 4) pose of the mesh.
        K: (3, 3) camera matrix in px of the photograph.

    Returns:
        The fraction of the projected hull's area; 1 for a mesh that reaches behind the camera.
    """
    depth = hull.to(T) @ T[2, :3] + T[2, 3]
    if float(depth.min()) <= 0.0:
        return 1.0
    pixels = projected(hull.to(T), T, K).numpy()
    x0, y0, x1, y1 = photograph_box(size).tolist()
    if (pixels >= (x0, y0)).all() and (pixels <= (x1, y1)).all():
        return 0.0  # not what rounding leaves of the areas' difference
    # In units of the photograph's longer side: OpenCV computes in single precision.
    scale = 1.0 / max(size)
    outline = cv2.convexHull((scale * pixels).astype(np.float32))
    frame = scale * np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    whole = cv2.contourArea(outline)
    if whole <= 0.0:
        return 0.0
    inside, _ = cv2.intersectConvexConvex(outline, frame.astype(np.float32))
    return min(max(1.0 - float(inside) / whole, 0.0), 1.0)


def boxes_at(hull: Tensor, T: Tensor, K: Tensor, size: Size) -> tuple[Tensor, Tensor]:
    """(N, 4) boxes in px around a mesh with ``hull`` (V, 3) at poses (N, 4, 4), in an image of
    ``size`` (H, W). And (N,) bool, False where the mesh lies behind the camera, or outside the
    image: there the box means nothing."""
    hull = hull.to(T)
    depth = (hull @ T[:, 2, :3].mT + T[:, 2, 3]).amin(dim=0)
    boxes = boxes_of(hull, T, K)
    limits = torch.tensor([size[1], size[0]], dtype=boxes.dtype) - 0.5
    outside = (boxes[:, :2] >= limits) | (boxes[:, 2:] <= -0.5) | (depth <= 0)[:, None]
    return boxes, ~outside.any(dim=1)

"""Photographs, boxes, masks and cameras in the forms that callers have them, checked one by one.

Boxes and cameras that are possible, but probably a mistake, give warnings: a result from them is
never reliable.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from PIL.Image import Image as Picture
from torch import Tensor

from ..data.images import Photo, photo_of_picture, read_photo
from ..errors import CurviregError, ImageError, InvalidInputError
from ..formats.masks import mask_of_values, read_mask
from ..geometry.calibration import Camera, undistorted
from ..geometry.cameras import camera_numbers
from ..geometry.crops import box_iou, check_boxes, crop_squares, square_boxes, whole_image_box
from ..geometry.framing import clipped
from ..geometry.pose_prior import PosePrior
from ..utils.aliases import Fields
from ..utils.checks import (
    are_nearly_equal,
    as_boxes,
    as_camera_matrices,
    as_numbers,
    as_tensor,
    check_finite,
    check_photograph,
    check_pixels,
    check_pose,
    check_square_pixels,
    check_tensor,
    type_and_shape,
)
from ..utils.likes import ArrayLike, BoxesLike, BoxLike, CameraLike, ImageLike, ImagesLike, MaskLike

# Pixels; a smaller box is refused. With one of 1 px, the preset "fast" reached a confidence of
# 0.98.
MIN_BOX_SIDE = 12
MAX_FRACTION = 1.5  # largest coordinate of a box that is probably meant in fractions of the picture
FRACTIONS = "box: in px, not fractions of the photograph; multiply them by its size"
SMALL_BOX_SIDE = 24  # Pixels; of a smaller box a result carries a warning
# Focal lengths of usual cameras, as multiples of the photograph's longer side: fields of view of
# 113 to 3 degrees
FOCAL_RANGE = (1 / 3, 20.0)
# Difference between the places of the principal point across and down, as fractions of the
# picture's sides, up to which they count as one fraction, and from one half, from which the matrix
# is that of another picture, and within which calibrations have it. Pictures of 2/3 and 1.6 times
# the size have it at 1/3 and 0.8
SAME_FRACTION = 0.03
OFF_MIDDLE = 0.1
NEAR_MIDDLE = 0.05
# Relative difference of poses and cameras up to which two photographs come from the same place
SAME_PLACE = 1e-4
# Correlation of small copies of two photographs from which they may come from the same place
SAME_PICTURE = 0.8
# Part of a box without pixels of the photograph, from which a result carries a warning
MISSING_SHARE = 0.2


@dataclass(frozen=True)
class Photograph:
    """One photograph to register. What strangers give is checked by ``as_photograph``, once.

    Attributes:
        image: (1 or 3, H, W) float or uint8, without distortion.
        box: (4,) of the object, or the whole photograph.
        camera: at this size, with the distortion of its lens, of which the image is free; None if
            it is unknown.
        prior: limits on the pose.
        mask: (H, W) float32 in [0, 1] of the object.
        notes: what is questionable about them, in words.
        has_box: whether a box or a mask tells where the object is.
        facts: where camera and pixels are from, for the record.
    """

    image: Tensor
    box: Tensor
    camera: Camera | None
    prior: PosePrior | None = None
    mask: Tensor | None = None
    notes: tuple[str, ...] = ()
    has_box: bool = True
    facts: Fields = field(default_factory=dict)

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of the photograph."""
        return int(self.image.shape[-2]), int(self.image.shape[-1])

    @property
    def K(self) -> Tensor:  # noqa: N802
        """(3, 3) float64 camera matrix; refuses a photograph without one."""
        if self.camera is None:
            raise InvalidInputError(
                "needs the camera: give its matrix, or a photograph whose EXIF has its focal length"
            )
        return self.camera.matrix

    @property
    def pinhole(self) -> Camera | None:
        """The camera of the pixels, without distortion."""
        return self.camera and replace(self.camera, distortion=(), model="radial-tangential")

    @property
    def focal_deviation(self) -> float:
        """See :class:`Camera`; 0 without one."""
        return 0.0 if self.camera is None else self.camera.focal_deviation

    @property
    def has_estimated_camera(self) -> bool:
        """Whether the camera is one of those that are tried where none is known."""
        return self.camera is not None and self.camera.source == "estimated"

    def by(self, matrix: Tensor, **changes: Any) -> "Photograph":
        """The photograph by a camera of another matrix (3, 3); ``changes`` are those of further
        attributes of :class:`Camera`."""
        known = {"size": self.size} if self.camera is None else vars(self.camera)
        return replace(self, camera=Camera(**{**known, **changes, "matrix": matrix}))

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is questionable about box, camera and mask; each names the likely mistake."""
        found = [] if self.camera is None else camera_warnings(self.K, self.size)
        if (side := _visible_side(self.box, self.size)) < SMALL_BOX_SIDE:
            found.append(
                f"the box shows {side:.0f} px on its shorter side; use a picture with at least "
                f"{SMALL_BOX_SIDE}"
            )
        return (*found, *self.notes)

    def overlap(self, box: Tensor) -> float:
        """IoU of a box (4,) and the item's inside the photograph; 1 for one outside, where nothing
        is to be seen."""
        H, W = self.size
        pair = torch.stack([box, self.box.to(box)]).clamp(min=-0.5)
        pair = torch.minimum(pair, torch.tensor([W, H, W, H]).to(pair) - 0.5)
        inside = bool((pair[0, 2:] > pair[0, :2]).all()) and bool(box.isfinite().all())
        return float(box_iou(pair[:1], pair[1:])) if inside else 1.0

    def mask_crop(self, size: int, margin: float) -> Tensor | None:
        """(1, 1, size, size) of the mask, as the photograph is cropped to its box."""
        return (
            None
            if self.mask is None
            else crop_squares(self.mask[None], square_boxes(self.box[None].float(), margin), size)
        )


def as_photographs(
    images: ImagesLike,
    boxes: BoxesLike | None,
    camera_matrices: CameraLike | None,
    prior: PosePrior | Sequence[PosePrior | None] | None = None,
    masks: Sequence[MaskLike | None] | Tensor | None = None,
) -> Sequence[Photograph | CurviregError]:
    """Photographs with boxes (None: those of the masks, or the whole images), cameras and masks, or
    their errors. Arguments and errors are those of ``Registrar``; each is read and checked whenever
    it is asked for, so that many large files need the memory of few. A :class:`Camera` is scaled to
    the photograph, and its distortion removed; a file without one has the camera of its EXIF data.
    A box of which less than ``MIN_BOX_SIDE`` px lie inside its photograph in a direction is
    refused."""
    is_list = isinstance(images, Sequence) and not isinstance(images, str)
    if not is_list and getattr(images, "ndim", None) != 4:
        raise InvalidInputError(
            f"images: expected a batch (B, C, H, W) or a list, got {type(images).__name__}; put a "
            f"single image into a list, and make one of other collections: list(images)"
        )
    n = len(images)
    no_box = boxes is None
    given: list[Tensor | None]
    if isinstance(boxes, list | tuple) and any(_is_missing(box) for box in boxes):
        given = [
            None if _is_missing(box) else as_boxes([box], 1)[0]
            for box in one_each(boxes, n, "boxes")
        ]
    else:
        given = [None] * n if boxes is None else list(as_boxes(boxes, n))
    cameras = _cameras(camera_matrices, n)
    masks = [None] * n if masks is None else one_each(masks, n, "masks")
    if no_box and any(m is None for m in masks) and any(m is not None for m in masks):
        raise InvalidInputError(
            f"masks: image {masks.index(None)} has neither mask nor box; register it separately"
        )
    priors = [prior] * n if prior is None or isinstance(prior, PosePrior) else list(prior)
    if len(priors) != n or not all(p is None or isinstance(p, PosePrior) for p in priors):
        raise InvalidInputError(
            f"prior: expected a PosePrior, or a list of {n} with None where there is none"
        )

    def item(i: int) -> Photograph | CurviregError:
        try:
            item = as_photograph(images[i], given[i], cameras[i], priors[i], masks[i])
            _check_side(item, given[i])
            return item
        except CurviregError as error:
            return error.of_image(i)

    return OnDemand(item, n)


def _check_side(item: Photograph, given: Tensor | None) -> None:
    """Refuse a photograph of which too little lies in its box, which was ``given``, or None."""
    side = _visible_side(item.box, item.size)
    if side >= MIN_BOX_SIDE:
        return
    if given is not None and float(given.abs().max()) <= MAX_FRACTION:
        raise InvalidInputError(FRACTIONS, kind="fractions")
    is_small = min(item.size) < MIN_BOX_SIDE
    where = "the photograph" if is_small else "the part of the photograph in the box"
    raise InvalidInputError(
        f"{where} has {side:.1f} px on its shorter side, at least {MIN_BOX_SIDE} are needed; use a "
        f"larger picture"
    )


def check_cameras(images: Any, camera_matrices: CameraLike | None, what: str) -> None:
    """Refuse photographs without a camera and without a file, whose EXIF data may have one."""
    if camera_matrices is None and not all(
        isinstance(image, str | PathLike | Picture) for image in images
    ):
        raise InvalidInputError(f"{what}: needs the camera matrix of each photograph")


def one_each(values: Any, count: int, name: str) -> list[Any]:
    """The values of ``count`` images as a list."""
    every = list(values) if isinstance(values, Iterable) else None
    if every is None or len(every) != count:
        got = type(values).__name__ if every is None else len(every)
        raise InvalidInputError(f"{name}: expected {count}, one for each image or None, got {got}")
    return every


def _is_missing(box: BoxLike | None) -> bool:
    """Whether a box is None, or all its numbers are NaN."""
    if box is None:
        return True
    numbers = as_numbers(box, "boxes")
    return numbers.numel() > 0 and bool(numbers.isnan().all())


def rig_cameras(poses: ArrayLike, count: int) -> Tensor:
    """Poses of the cameras of photographs from the world as (V, 4, 4) float64; an error names the
    photograph of a pose that is not rigid and finite."""
    T = as_numbers(poses, "T_cam_from_world", dtype=torch.float64).detach().cpu().double()
    check_tensor(T, "T_cam_from_world", (count, 4, 4))
    for i, pose in enumerate(T):
        try:
            check_pose(pose, "T_cam_from_world")
        except InvalidInputError as error:
            raise error.of_image(i) from None
    return T


def copies_of(T: Tensor, items: "Sequence[Photograph | CurviregError]") -> dict[int, int]:
    """Photographs of a rig that show what an earlier one does, by their index, and that one: those
    that the same camera took from the same place ``T`` (V, 4, 4). They are no further evidence.
    Refuses two from the very same place that show different things."""
    found: dict[int, int] = {}
    photographs = {i: item for i, item in enumerate(items) if isinstance(item, Photograph)}
    for i, one in photographs.items():
        gap = (T[:i] - T[i]).abs()
        away = float(T[i, :3, 3].abs().max())
        turned = gap[:, :3, :3].flatten(1).amax(dim=1) <= SAME_PLACE
        near = turned & (gap[:, :3, 3].amax(dim=1) <= SAME_PLACE * away)
        for j in near.nonzero()[:, 0].tolist():
            other = photographs.get(j)
            if other is None or not _are_by_same_camera(one, other):
                continue
            if float(gap[j].max()) <= 1e-9 * max(away, 1.0) and _contradict(one, other):
                raise InvalidInputError(
                    "T_cam_from_world: the same, but they show different things; give each "
                    "photograph the pose of its own camera",
                    images=(i, j),
                )
            if i not in found and j not in found:
                found[i] = j
    return found


def _are_by_same_camera(one: Photograph, other: Photograph) -> bool:
    near = SAME_PLACE * one.K.abs().max()
    return one.size == other.size and bool((one.K - other.K).abs().max() <= near)


def _contradict(one: Photograph, other: Photograph) -> bool:
    """Whether small copies of two photographs of one size are hardly correlated."""
    grey = [item.image.float().mean(dim=0).nan_to_num()[None, None] for item in (one, other)]
    a, b = (F.adaptive_avg_pool2d(picture, 32).flatten() for picture in grey)
    return float(F.cosine_similarity(a - a.mean(), b - b.mean(), dim=0)) < SAME_PICTURE


def _cameras(given: Any, count: int) -> Sequence[Tensor | Camera | None]:
    """A camera or camera matrix for all, or one for each."""
    if given is None or isinstance(given, Camera):
        return [given] * count
    if not (
        isinstance(given, list | tuple) and any(isinstance(camera, Camera) for camera in given)
    ):
        return list(as_camera_matrices(given, count).detach().cpu())
    if len(given) != count:
        raise InvalidInputError(
            f"camera_matrices: expected {count}, one for each image, got {len(given)}"
        )
    return [
        c if isinstance(c, Camera) else as_camera_matrices(c, 1)[0].detach().cpu() for c in given
    ]


def as_photograph(
    image: ImageLike,
    box: Tensor | None,
    camera: Tensor | Camera | None = None,
    prior: PosePrior | None = None,
    mask: MaskLike | None = None,
) -> Photograph:
    """One photograph in any form, with its (4,) box (None: that of the mask, or the whole image),
    however small."""
    photo = as_photo(image)
    pixels = photo.image
    notes = []
    camera = photo.camera() if camera is None else camera
    box = None if box is None else box.detach().float().cpu()
    mask = None if mask is None else _object_mask(mask, pixels)
    if mask is not None:
        white = mask >= 0.5
        border = torch.cat([white[0], white[-1], white[:, 0], white[:, -1]])
        if min(float(border.float().mean()), float(white.float().mean())) > 0.5:
            notes.append(
                "the mask covers most of the photograph and its border; the object must be white, "
                "not black"
            )
    size = (int(pixels.shape[-2]), int(pixels.shape[-1]))
    missing = torch.zeros(size, dtype=torch.bool)
    has_box = box is not None or mask is not None
    if isinstance(camera, Camera):
        camera = camera.at(size)
        pixels, box, mask, missing = undistorted(pixels, camera, box, mask)
    if mask is not None:
        box = _box_of_mask(mask, box)
    box = whole_image_box(pixels).cpu() if box is None else box
    check_boxes(box[None], [size])
    if camera is not None:
        camera = camera if isinstance(camera, Camera) else Camera(camera, size=size)
        check_square_pixels(camera.matrix)
    if (share := float(_inside(missing, box).float().mean())) > MISSING_SHARE:
        notes.append(
            f"{100 * share:.0f} % of the box lie where the distorted photograph shows nothing"
        )
    # Of an object that the border cuts, only the visible part is known.
    box = clipped(box, size)
    return Photograph(pixels, box, camera, prior, mask, tuple(notes), has_box)


def _object_mask(mask: Any, image: Tensor) -> Tensor:
    """A mask of a photograph in any form as (H, W) float32 in [0, 1] on the CPU."""
    if isinstance(mask, str | PathLike):
        mask = read_mask(mask)
    x = as_tensor(mask, "mask")
    is_mask = isinstance(x, Tensor) and (
        x.dtype in (torch.bool, torch.uint8) or x.is_floating_point()
    )
    if not is_mask:
        raise InvalidInputError(
            f"mask: expected bool, uint8 or floating (H, W), or a path, got {type_and_shape(mask)}"
        )
    if x.shape != image.shape[-2:]:
        H, W = image.shape[-2:]
        shape = tuple(x.shape)
        raise InvalidInputError(
            f"mask: expected shape ({H}, {W}), that of the photograph, got {shape}"
        )
    x = x.detach().cpu()
    x = torch.from_numpy(mask_of_values(x.numpy(), 255)) if x.dtype == torch.uint8 else x.float()
    check_finite(x, "mask")
    if float(x.min()) < 0 or float(x.max()) > 1:
        raise InvalidInputError(
            "mask: expected values from 0 to 1, the object white; divide by the largest"
        )
    return x


def _box_of_mask(mask: Tensor, box: Tensor | None) -> Tensor:
    """The box (4,) that was given, which must show some of the object, or that around its mask
    (H, W)."""
    white = mask >= 0.5
    if not bool((white if box is None else _inside(white, box)).any()):
        where = "" if box is None else " in the box"
        raise InvalidInputError(
            f"mask: no white pixel{where}; expected the object white, all else black"
        )
    if box is not None:
        return box
    y, x = white.nonzero().unbind(1)
    return torch.stack([x.min() - 0.5, y.min() - 0.5, x.max() + 0.5, y.max() + 0.5])


def _inside(pixels: Tensor, box: Tensor) -> Tensor:
    """The part of (H, W) pixels whose centres lie in a (4,) box."""
    x0, y0, x1, y1 = (max(0, math.ceil(value)) for value in box.tolist())
    return pixels[y0:y1, x0:x1]


class OnDemand(Sequence[Photograph | CurviregError]):
    """``item(0)`` to ``item(count - 1)``, computed at each access, one at a time."""

    def __init__(self, item: Callable[[int], Photograph | CurviregError], count: int) -> None:
        self._item = item
        self._indices = range(count)

    def __len__(self) -> int:
        return len(self._indices)

    def __getitem__(self, index: Any) -> Any:
        return self._item(self._indices[index])


def as_photo(image: ImageLike) -> Photo:
    """The pixels of a photograph in any form, and the metadata of its file."""
    if isinstance(image, str | PathLike):
        return read_photo(image)
    if isinstance(image, Picture):
        return photo_of_picture(image)
    x = as_tensor(image, "photograph")
    if isinstance(image, np.ndarray):
        x = x[None] if x.ndim == 2 else x.movedim(-1, 0) if x.ndim == 3 else x
    if not isinstance(x, Tensor):
        raise InvalidInputError(
            f"expected a tensor, an array or a path, got {type(image).__name__}"
        )
    check_photograph(x, "photograph")
    return Photo(x)


def check_crop(crop: Tensor) -> None:
    """Raise :class:`ImageError` for a (C, S, S) crop that shows nothing to register."""
    check_pixels(crop, "of the box")
    channels = crop.flatten(1)
    if float((channels.amax(dim=1) - channels.amin(dim=1)).max()) < 1.0 / 255.0:
        raise ImageError("the box shows one colour, nothing to register; check image and box")


def camera_warnings(K: Tensor, size: tuple[int, int]) -> list[str]:
    """What is questionable about a valid (3, 3) camera matrix of an (H, W) photograph."""
    fx, fy, cx, cy = camera_numbers(K)
    H, W = size
    found = []

    def is_inside(x: float, y: float) -> bool:  # the corner (0, 0) stands for unknown values
        return -0.5 < x < W - 0.5 and -0.5 < y < H - 0.5 and (x, y) != (0.0, 0.0)

    if not is_inside(cx, cy):
        advice = "it is near the centre, unless the picture was cropped"
        if is_inside(fx, fy) and are_nearly_equal(cx, cy):
            advice = "FX FY and CX CY seem to be swapped"
        elif cx >= W - 1 and cy >= H - 1:
            w = 2 * cx + 1
            h = 2 * cy + 1
            advice = (
                f"this camera seems to belong to a picture of about {w:.0f} x {h:.0f} px; scale it"
            )
        found.append(
            f"the principal point ({cx:g}, {cy:g}) lies outside the photograph of {W} x {H} px; "
            f"{advice}"
        )
    elif (other := _size_of_matrix(K, size)) is not None:
        is_turned = other == (W, H)
        advice = "turn one of the two by 90 degrees" if is_turned else "scale it"
        found.append(
            f"the principal point ({cx:g}, {cy:g}) is not near the middle of the photograph of "
            f"{W} x {H} px: the matrix seems to be of a picture of {other[1]} x {other[0]}; "
            f"{advice}"
        )
    low, high = FOCAL_RANGE
    focal = min(fx, fy)
    side = max(W, H)
    if not low * side <= focal <= high * side:
        degrees = 2 * math.degrees(math.atan(W / 2 / fx))
        advice = (
            "it is in px of this photograph, not in mm"
            if focal < side
            else "scale it with the photograph"
        )
        found.append(
            f"the focal length of {focal:g} px gives the photograph of {W} x {H} px a field of "
            f"view of {degrees:.3g} degrees; {advice}"
        )
    return found


def _size_of_matrix(K: Tensor, size: tuple[int, int]) -> tuple[int, int] | None:
    """(H, W) of the picture whose middle is the principal point, if that is another size of the
    photograph of ``size`` (H, W), or the photograph turned by 90 degrees; else None."""
    sides = torch.tensor(size, dtype=torch.float64)
    middle = K[:2, 2].double().cpu().flip(0) + 0.5
    aside = middle / sides - 0.5
    if float((middle / sides.flip(0) - 0.5).abs().max()) <= NEAR_MIDDLE:
        return size[::-1] if float(aside.abs().max()) >= OFF_MIDDLE else None
    down, across = aside.tolist()
    is_one_fraction = abs(across - down) <= SAME_FRACTION
    if not is_one_fraction or abs(0.5 * (across + down)) < OFF_MIDDLE:
        return None
    height, width = (2.0 * middle).round().int().tolist()
    return height, width


def _visible_side(box: Tensor, size: tuple[int, int]) -> float:
    """Pixels of the shorter side of the part of a (4,) box that lies inside an (H, W) picture."""
    H, W = size
    limits = torch.tensor([W, H], dtype=torch.float64) - 0.5
    inside = torch.minimum(box[2:].double().cpu(), limits) - box[:2].double().cpu().clamp(min=-0.5)
    return float(inside.min())

"""Cameras with lens distortion, and photographs, boxes and masks without it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..utils.aliases import Fields, Size
from ..utils.arrays import Floats
from ..utils.checks import (
    as_numbers,
    check_camera_matrix,
    check_integer,
    check_option,
    check_photograph,
    check_tensor,
)
from .cameras import boxes_around
from .crops import check_boxes

SOURCES = ("given", "exif", "estimated")
"""Where a camera may come from."""

# Numbers of coefficients of each distortion model
MODELS = {"radial-tangential": (0, 4, 5, 8, 12, 14), "fisheye": (4,)}
MAX_ANGLE = 1.55  # Radians from the optical axis up to which distortion is computed: 89 degrees
MAX_REMAPPED_SIDE = 32766  # Pixels; cv2.remap counts with 16 bits
Array = Floats


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera, accepted wherever a camera matrix is.

    Attributes:
        matrix: (3, 3) in px, as float64.
        distortion: coefficients in OpenCV's order. "radial-tangential": none, or 4, 5, 8, 12 or 14
            (k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tx, ty); "fisheye" (equidistant): the 4
            of ``cv2.fisheye``.
        model: "radial-tangential" or "fisheye".
        size: (H, W) of the photographs that it was calibrated with; None: that of any photograph.
        focal_deviation: standard deviation of the focal length, as a fraction of it; 0 of a known
            one.
        source: "given"; "exif", by the metadata of the photograph's file; or "estimated" in the
            photograph itself.

    Raises:
        InvalidInputError: an unusable matrix, a wrong number of coefficients, or a deviation that
            is not finite and >= 0.

    Example:
        >>> camera = Camera([[500.0, 0, 319.5], [0, 500, 239.5], [0, 0, 1]], (-0.3, 0.1, 0, 0),
        ...     size=(480, 640))
        >>> camera.at((240, 320)).matrix.tolist()
        [[250.0, 0.0, 159.5], [0.0, 250.0, 119.5], [0.0, 0.0, 1.0]]
    """

    matrix: Tensor
    distortion: Sequence[float] = ()
    model: str = "radial-tangential"
    size: Size | None = None
    focal_deviation: float = 0.0
    source: str = "given"

    def __post_init__(self) -> None:
        matrix = (
            as_numbers(self.matrix, "camera matrix", dtype=torch.float64).detach().cpu().double()
        )
        check_tensor(matrix, "camera matrix", (3, 3))
        check_camera_matrix(matrix)
        check_option(self.model, MODELS, "distortion model")
        check_option(self.source, SOURCES, "source")
        if not 0.0 <= self.focal_deviation < float("inf"):
            raise InvalidInputError(
                f"focal_deviation: expected a fraction >= 0, got {self.focal_deviation}"
            )
        # OpenCV's own arrays are (1, N) or (N, 1)
        given = as_numbers(self.distortion, "distortion", dtype=torch.float64).flatten()
        numbers = tuple(given.tolist())
        if len(numbers) not in MODELS[self.model] or not given.isfinite().all():
            expected = (
                f"{' or '.join(map(str, MODELS[self.model]))} finite coefficients of the model "
                f"{self.model!r}"
            )
            raise InvalidInputError(f"distortion: expected {expected}, got {[*numbers]!r:.80}")
        if self.size is not None and len(self.size) != 2:
            raise InvalidInputError(f"size: expected height and width in px, got {self.size}")
        for side in self.size or ():
            check_integer(side, "size of the image")
        object.__setattr__(self, "matrix", matrix)
        object.__setattr__(self, "distortion", numbers)

    @property
    def distorts(self) -> bool:
        """Whether straight lines become curved."""
        return self.model == "fisheye" or any(self.distortion)

    def at(self, size: Size) -> "Camera":
        """Return the camera of the same photographs, resized to (H, W); another aspect ratio is
        refused."""
        h, w = self.size or size
        H, W = size
        # sides of resized pictures are rounded
        if abs(w * H / h - W) > 1 and abs(h * W / w - H) > 1:
            turned = abs(h * H / w - W) <= 1
            advice = (
                "turn the photograph by 90 degrees"
                if turned
                else "give one of uncropped photographs of this size"
            )
            raise InvalidInputError(
                f"camera: calibrated for {w} x {h} px, but the photograph has {W} x {H} px, "
                f"another aspect ratio; {advice}"
            )
        x = W / w
        y = H / h
        scale = torch.tensor(
            [[x, 0, (x - 1) / 2], [0, y, (y - 1) / 2], [0, 0, 1]], dtype=torch.float64
        )
        return replace(self, matrix=scale @ self.matrix, size=size)

    def describe(self) -> Fields:
        """Return the attributes as plain JSON."""
        return {
            "matrix": self.matrix.tolist(),
            "distortion": list(self.distortion),
            "model": self.model,
            "size": None if self.size is None else list(self.size),
            "source": self.source,
            "focal_deviation": self.focal_deviation,
        }


class Undistorted(NamedTuple):
    """What a camera with the same matrix, but without distortion, shows: ``image`` (C, H, W);
    ``box`` (4,) around the outline of the given one; ``mask`` (H, W) float32; and ``missing`` (H,
    W) bool, pixels that were not recorded, or whose distortion is unknown: they repeat the border
    of what is known."""

    image: Tensor
    box: Tensor | None
    mask: Tensor | None
    missing: Tensor


def undistorted(
    image: Tensor, camera: Camera, box: Tensor | None = None, mask: Tensor | None = None
) -> Undistorted:
    """Remove the distortion of a photograph; box and mask move, the camera matrix remains. A
    polynomial describes a lens up to the radius at which it stops growing; what lies beyond is
    missing.

    Args:
        image: (1 or 3, H, W), floating or uint8, of the size of the camera or of another, see
            :meth:`Camera.at`.
        box: (4,) x0, y0, x1, y1 in px of the photograph.
        mask: (H, W) floating.

    Raises:
        InvalidInputError: a photograph of another aspect ratio, or a box outside what the
            undistorted one shows.

    Example:
        >>> camera = Camera([[50.0, 0, 31.5], [0, 50, 23.5], [0, 0, 1]], (-0.3, 0.1, 0, 0))
        >>> seen = undistorted(torch.rand(3, 48, 64), camera, torch.tensor([0.0, 10, 20, 30]))
        >>> seen.image.shape, seen.box.round().tolist()
        (torch.Size([3, 48, 64]), [-6.0, 8.0, 20.0, 31.0])
    """
    check_photograph(image, "photograph")
    H, W = size = int(image.shape[-2]), int(image.shape[-1])
    camera = camera.at(size)
    if not camera.distorts:
        return Undistorted(image, box, mask, torch.zeros(size, dtype=torch.bool))
    if max(size) > MAX_REMAPPED_SIDE:
        raise InvalidInputError(
            f"photograph: expected sides of at most {MAX_REMAPPED_SIDE} px, got {W} x {H}"
        )
    box = None if box is None else _undistorted_box(camera, box, size)
    maps, missing = _maps(
        tuple(camera.matrix.flatten().tolist()), tuple(camera.distortion), camera.model, size
    )

    def remapped(x: Tensor, border: int) -> Tensor:
        planes = x.detach().cpu()
        planes = planes if planes.dtype in (torch.uint8, torch.float64) else planes.float()
        moved = [
            cv2.remap(plane.numpy(), *maps, cv2.INTER_LINEAR, borderMode=border) for plane in planes
        ]
        return torch.from_numpy(np.stack(moved)).to(x)

    if mask is not None:
        mask = remapped(mask[None], cv2.BORDER_CONSTANT)[0].masked_fill(
            missing.to(mask.device), 0.0
        )
    return Undistorted(remapped(image, cv2.BORDER_REPLICATE), box, mask, missing)


@lru_cache(maxsize=2)  # photographs of one camera, or of two in turn
def _maps(
    matrix: tuple[float, ...], distortion: tuple[float, ...], model: str, size: Size
) -> tuple[tuple[Any, Any], Tensor]:
    """Maps of ``cv2.remap`` from a photograph of (H, W) to one without distortion, and (H, W) bool:
    what is missing."""
    H, W = size
    K = np.array(matrix).reshape(3, 3)
    D = np.array(distortion)
    library = cv2.fisheye if model == "fisheye" else cv2
    x, y = library.initUndistortRectifyMap(K, D, np.eye(3), K, (W, H), cv2.CV_32FC1)
    u = (np.arange(W) - K[0, 2]) / K[0, 0]
    v = (np.arange(H) - K[1, 2]) / K[1, 1]
    limit = _growing_radii(distortion, model)[2]
    beyond = u**2 + v[:, None] ** 2 > limit**2
    if beyond.any():
        rays = np.stack(np.broadcast_arrays(u, v[:, None]), axis=-1)[beyond]
        rays *= limit / np.linalg.norm(rays, axis=-1, keepdims=True)
        x[beyond], y[beyond] = _distorted(rays, K, D, model).T
    missing = beyond | ~((x >= -0.5) & (x <= W - 0.5) & (y >= -0.5) & (y <= H - 0.5))
    return cv2.convertMaps(x, y, cv2.CV_16SC2), torch.from_numpy(missing)


def _distorted(rays: Array, K: Array, D: Array, model: str) -> Array:
    """(N, 2) px that show the rays (x, y, 1) of (N, 2)."""
    if model == "fisheye":
        return np.asarray(cv2.fisheye.distortPoints(rays[None], K, D)[0])
    points = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    return np.asarray(cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, D)[0][:, 0])


def _growing_radii(distortion: Sequence[float], model: str) -> tuple[Array, Array, float]:
    """Radii of rays (x, y, 1), their radially distorted radii, as far as these grow, and where they
    stop, or inf."""
    angle = np.linspace(0.0, MAX_ANGLE, 5000)
    radius = np.tan(angle)
    k = np.zeros(8)
    k[: len(distortion)] = distortion[:8]
    with np.errstate(all="ignore"):
        if model == "fisheye":
            distorted = angle * np.polyval([*k[3::-1], 1.0], angle**2)
        else:
            above, below = ([*reversed(k[i]), 1.0] for i in ([0, 1, 4], [5, 6, 7]))
            distorted = radius * np.polyval(above, radius**2) / np.polyval(below, radius**2)
        falls = np.flatnonzero(~(np.diff(distorted) > 0))
    end = int(falls[0]) + 1 if len(falls) else len(radius)
    return radius[:end], distorted[:end], float(radius[end - 1]) if len(falls) else float("inf")


def _with_radii(points: Array, old: Array, new: Array) -> Array:
    """(N, 2) points, moved along their directions from ``old`` radii to ``new`` ones; the last are
    the largest."""
    distance = np.linalg.norm(points, axis=-1, keepdims=True)
    return np.asarray(points * np.interp(distance, old, new) / np.maximum(distance, 1e-12))


def _undistorted_box(camera: Camera, box: Tensor, size: Size) -> Tensor:
    """(4,) around the undistorted outline of a box; what extends beyond the photograph moves with
    its border."""
    H, W = size
    K = camera.matrix.numpy()
    D = np.array(camera.distortion)
    check_boxes(box[None].detach().float(), [size])
    x0, y0, x1, y1 = box.detach().cpu().double().tolist()
    around = np.linspace(0.0, 4.0, 201)
    corners = ([x0, x1, x1, x0, x0], [y0, y0, y1, y1, y0])
    outline = np.stack([np.interp(around, range(5), values) for values in corners], axis=1)
    inside = outline.clip([-0.5, -0.5], [W - 0.5, H - 0.5])
    radius, distorted, _ = _growing_radii(camera.distortion, camera.model)
    centre = K[:2, 2]
    focal = np.diag(K)[:2]
    target = (inside - centre) / focal
    rays = _with_radii(target, distorted, radius)
    # the rest of the distortion, which is small, is that of the ray found before
    for _ in range(20):
        rest = (_distorted(rays, K, D, camera.model) - centre) / focal - _with_radii(
            rays, radius, distorted
        )
        rays = _with_radii(target - rest, distorted, radius)
    moved = boxes_around(torch.from_numpy(rays * focal + centre + outline - inside)).to(box)
    if not bool(
        (moved[:2] < torch.tensor([W, H]).to(box) - 0.5).all() and (moved[2:] > -0.5).all()
    ):
        raise InvalidInputError(
            f"box ({x0:g}, {y0:g}, {x1:g}, {y1:g}): outside what the photograph shows once its "
            "distortion is removed, too far from the optical axis; turn the camera to the object"
        )
    return moved

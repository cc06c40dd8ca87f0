"""Keypoints: local features of a mesh's print, found again in photographs; where enough agree, they
give a pose.

The ranking compares whole views; print that is seen at a slant, small or half hidden still shows
some keypoints. They need colours, and the camera of the photograph.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from ..filters.operations import resized
from ..geometry.cameras import pose_around
from ..geometry.viewpoint import uniform_views
from ..matching import ViewDescriber
from ..pipeline import FitSettings
from ..utils.rows import Rows
from ..utils.threads import map_on_threads
from .least_squares import nearest_rigid

# Number of views that keypoints are taken from, and their side in px
VIEWS = 48
VIEW_SIZE = 192
VIEW_DISTANCE = 4.0  # of the camera from the object's centre in these views, in object radii
# Width in px of the rim of the silhouette, where the background has a part in the features
SILHOUETTE_BORDER = 4
# of features, SIFT's threshold: prints are fainter in photographs than in views
MIN_CONTRAST = 0.02
# px in x and y by which features lie too far right and down, since OpenCV halves the coordinates of
# a picture that it has doubled. Its option enable_precise_upscale avoids that, but an eighth fewer
# features find their keypoint.
UPSCALING_SHIFT = 0.25
# Quantiles of grey that become black and white in a crop, which the object fills, and in a whole
# photograph, where it may be brighter than all else; and the least distance of the two
TONES = (0.01, 0.99)
ALL_TONES = (0.0, 1.0)
MIN_TONES = 0.05
# Longer side in px to which crops are resized, and of the largest whole photograph
CROP_SIDE = 400
MAX_SIDE = 1920
CROP_MARGIN = 0.05  # Space around a given box, as a fraction of its longer side
SAME_PLACE = 0.1  # Distance in object radii within which keypoints may look alike
# Nearest keypoints of a feature, and Lowe's ratio of those at two places
NEIGHBOURS = 8
MAX_DISTANCE_RATIO = 0.8
# Distance in object radii, and factor between sizes, within which two matches predict the same
# object
CLUSTER_DISTANCE = 0.4
CLUSTER_FACTOR = 1.5
MAX_MATCHES = 2000  # Clearest matches of a photograph that are compared with one another
MAX_CLUSTERS = 20  # Groups of matches in a photograph that are tried
# Distance in the photograph at which they count, as a fraction of the object's radius there
REPROJECTION_ERROR = 0.03
AGREEMENT = 0.06  # The same of poses that were fitted to edges as well
RANSAC_ROUNDS = 500
FEATURES_AT_A_TIME = 1000  # of a photograph that are compared with all keypoints


@dataclass(frozen=True)
class _Features(Rows):
    """F features of a picture: ``uv`` (F, 2) in px, ``size`` (F,) in px, ``angle`` (F,) in rad, and
    unit ``vectors`` (F, 128)."""

    uv: np.ndarray
    size: np.ndarray
    angle: np.ndarray
    vectors: np.ndarray

    @staticmethod
    def of(
        picture: Tensor, mask: np.ndarray | None = None, tones: tuple[float, float] = TONES
    ) -> "_Features":
        """RootSIFT features of a picture (C, H, W) in [0, 1]; a place has one for each of its main
        orientations."""
        grey = picture.mean(dim=0).cpu().numpy()
        # SIFT's threshold is one of contrast, of which a dark photograph has little.
        low, high = np.quantile(grey, tones)
        grey = (
            (255.0 * (grey - low) / max(high - low, MIN_TONES))
            .round()
            .clip(0.0, 255.0)
            .astype(np.uint8)
        )
        sift = cv2.SIFT.create(contrastThreshold=MIN_CONTRAST, enable_precise_upscale=False)
        points, vectors = sift.detectAndCompute(grey, mask)
        if vectors is None or not len(points):
            return _Features(
                np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros((0, 128), np.float32)
            )
        vectors = np.sqrt(vectors / np.maximum(vectors.sum(axis=1, keepdims=True), 1e-9))
        values = np.array([(*p.pt, p.size, math.radians(p.angle)) for p in points])
        return _Features(
            values[:, :2] - UPSCALING_SHIFT, values[:, 2], values[:, 3], vectors.astype(np.float32)
        )


@dataclass(frozen=True)
class KeypointMatches:
    """Features of a photograph that resemble keypoints of a mesh with a ``centre`` (3,) and a
    ``radius``: pixels ``uv`` (M, 2), ``points`` (M, 3) of the mesh, and where each pair alone has
    the object: ``centres`` (M,) in px, x + iy, and ``radii`` (M,) in px. ``K`` (3, 3) is the
    camera; ``least`` must agree on a pose. A view of the mesh has ``per_view`` keypoints on
    average."""

    uv: np.ndarray
    points: np.ndarray
    centres: np.ndarray
    radii: np.ndarray
    K: np.ndarray
    centre: np.ndarray
    radius: float
    least: int
    per_view: float

    def poses(self) -> tuple[Tensor, Tensor]:
        """Poses (N, 4, 4) on which at least ``least`` agree, and how many, (N,) float32, the
        largest number first."""
        near = np.abs(self.centres[:, None] - self.centres) < CLUSTER_DISTANCE * np.sqrt(
            self.radii[:, None] * self.radii
        )
        near &= np.abs(np.log(self.radii[:, None] / self.radii)) < math.log(CLUSTER_FACTOR)
        poses = [torch.zeros(0, 4, 4, dtype=torch.float64)]
        counts: list[int] = []
        left = np.ones(len(self.uv), dtype=bool)
        for _ in range(MAX_CLUSTERS):
            votes = (near & left).sum(axis=1) * left
            if not len(votes) or votes.max() < self.least:
                break
            cluster = near[votes.argmax()] & left
            size = float(np.median(self.radii[cluster]))
            found = _pose(
                self.points[cluster] - self.centre,
                self.uv[cluster],
                self.K,
                REPROJECTION_ERROR * size,
                self.least,
            )
            left &= ~cluster
            if found is not None:  # what is left at its place has no other one
                T, count = found
                centre = torch.from_numpy(self.centre)
                poses.append(pose_around(T[:3, :3], T[:3, 3], centre)[None])
                counts.append(count)
                left &= np.abs(self.centres - self.centres[cluster].mean()) > size
        number = torch.tensor(counts, dtype=torch.float32)
        order = number.argsort(descending=True, stable=True)
        return torch.cat(poses)[order], number[order]

    def agreeing(self, T: Tensor, cameras: Tensor | None = None) -> Tensor:
        """(N,) float64 number of keypoints that agree with fitted poses (N, 4, 4); ``cameras`` (N,
        3, 3) if they have other ones."""
        counts = []
        matrices = [self.K] * len(T) if cameras is None else cameras.double().cpu().numpy()
        for pose, K in zip(T.double().cpu().numpy(), matrices, strict=True):
            cam = self.points @ pose[:3, :3].T + pose[:3, 3]
            z = float(pose[2, :3] @ self.centre + pose[2, 3])
            error = AGREEMENT * K[0, 0] * self.radius / max(z, 1e-9)
            uv = cam @ K[:2].T / np.maximum(cam[:, 2:], 1e-9)
            counts.append(_places(self.uv[np.linalg.norm(uv - self.uv, axis=1) < error], error))
        return torch.tensor(counts, dtype=torch.float64)


class Keypoints:
    """Features of the views of a mesh with colours, with their places on its surface; ``least`` of
    them must agree on a pose."""

    def __init__(
        self, describer: ViewDescriber, *, least: int = FitSettings().min_keypoints
    ) -> None:
        self._least = least
        self._centre = describer.centre.numpy()
        self._radius = describer.radius
        R = uniform_views(VIEWS).rotations.double()
        position = torch.tensor([0.0, 0.0, VIEW_DISTANCE * self._radius], dtype=torch.float64)
        T = pose_around(R, position, describer.centre)
        # the bounding sphere fills the picture
        focal = 0.5 * VIEW_SIZE * math.sqrt(VIEW_DISTANCE**2 - 1.0)
        middle = 0.5 * (VIEW_SIZE - 1)
        K = torch.tensor(
            [[focal, 0.0, middle], [0.0, focal, middle], [0.0, 0.0, 1.0]], dtype=torch.float64
        )

        def features(k: int) -> tuple[_Features, np.ndarray]:
            view = T[k : k + 1]
            size = (VIEW_SIZE, VIEW_SIZE)
            depth = describer.renderer.render(view, K[None], size)[0, 0].cpu().double().numpy()
            rim = np.ones((2 * SILHOUETTE_BORDER + 1,) * 2, np.uint8)
            found = _Features.of(
                describer.draw(view, K[None], size)[0], cv2.erode((depth > 0).astype(np.uint8), rim)
            )
            column, row = found.uv.round().astype(int).clip(0, VIEW_SIZE - 1).T
            z = depth[row, column]
            rays = (np.column_stack([found.uv, np.ones(len(z))]) @ np.linalg.inv(K.numpy()).T) * z[
                :, None
            ]
            return found[z > 0], ((rays - T[k, :3, 3].numpy()) @ T[k, :3, :3].numpy())[z > 0]

        found = map_on_threads(features, range(VIEWS))
        self._features = _Features.cat([features for features, _ in found])
        self._points = np.concatenate([points for _, points in found])
        error = AGREEMENT * focal / VIEW_DISTANCE
        self._per_view = float(np.mean([_places(features.uv, error) for features, _ in found]))
        # Of a feature of size 1 that is upright: the way to the object's centre, and the object's
        # radius, both in px.
        turn = np.exp(-1j * self._features.angle) / self._features.size
        self._to_centre = (middle * (1 + 1j) - self._features.uv @ [1, 1j]) * turn
        self._radii = focal / VIEW_DISTANCE / self._features.size

    def matches(self, image: Tensor, K: Tensor, box: Tensor | None = None) -> KeypointMatches:
        """Compare a photograph (C, H, W), floating in [0, 1] or uint8, with camera ``K`` (3, 3), or
        a box (4,) of it, with the keypoints."""
        found = self._photograph_features(image, box)
        keypoint, ratio = self._nearest(found)
        clear = np.argsort(ratio, kind="stable")[:MAX_MATCHES]
        clear = clear[ratio[clear] < MAX_DISTANCE_RATIO]
        found = found[clear]
        keypoint = keypoint[clear]
        centres = found.uv @ [1, 1j] + self._to_centre[keypoint] * found.size * np.exp(
            1j * found.angle
        )
        radii = self._radii[keypoint] * found.size
        camera = K.double().cpu().numpy()
        return KeypointMatches(
            uv=found.uv,
            points=self._points[keypoint],
            centres=centres,
            radii=radii,
            K=camera,
            centre=self._centre,
            radius=self._radius,
            least=self._least,
            per_view=self._per_view,
        )

    def _photograph_features(self, image: Tensor, box: Tensor | None) -> _Features:
        """Features in px of the photograph."""
        H, W = image.shape[-2:]
        x0 = 0
        y0 = 0
        x1 = W
        y1 = H
        if box is not None:
            margin = CROP_MARGIN * float((box[2:] - box[:2]).max())
            low = (box[:2] - margin).floor().int().tolist()
            high = (box[2:] + margin).ceil().int().tolist()
            x0 = max(low[0], 0)
            y0 = max(low[1], 0)
            x1 = min(high[0] + 1, W)
            y1 = min(high[1] + 1, H)
        crop = image[:, y0:y1, x0:x1].detach().cpu()
        longer = max(crop.shape[-2:])
        scale = min(MAX_SIDE / longer, 1.0) if box is None else CROP_SIDE / longer
        h, w = (max(1, round(scale * side)) for side in crop.shape[-2:])
        scale = max(h, w) / longer
        # keeps a quarter more features of small crops than bilinear
        small = resized(crop, (h, w), mode="bicubic")
        found = _Features.of(
            small.nan_to_num(0.0, 0.0, 0.0), tones=ALL_TONES if box is None else TONES
        )
        uv = (found.uv + 0.5) / scale - 0.5 + [x0, y0]
        return _Features(uv, found.size / scale, found.angle, found.vectors)

    def _nearest(self, found: _Features) -> tuple[np.ndarray, np.ndarray]:
        """(F,) the most similar keypoint of each feature, and its distance as a fraction of that to
        the most similar one at another place."""
        known = torch.from_numpy(self._features.vectors)
        points = torch.from_numpy(self._points)
        count = min(NEIGHBOURS, len(points))
        if count < 2 or not len(found.uv):
            return np.zeros(len(found.uv), dtype=int), np.ones(len(found.uv))
        keypoint = []
        ratio = []
        for vectors in torch.from_numpy(found.vectors).split(FEATURES_AT_A_TIME):
            similarity, index = (vectors @ known.T).topk(count, dim=1)
            distance = (2.0 - 2.0 * similarity).clamp(min=0.0)
            apart = (points[index] - points[index[:, :1]]).norm(dim=2) > SAME_PLACE * self._radius
            apart[:, -1] |= ~apart.any(dim=1)
            other = distance.masked_fill(~apart, torch.inf).amin(dim=1)
            keypoint.append(index[:, 0])
            ratio.append((distance[:, 0] / other.clamp(min=1e-9)).sqrt())
        return torch.cat(keypoint).numpy(), torch.cat(ratio).numpy()


def _pose(
    points: np.ndarray, uv: np.ndarray, K: np.ndarray, error: float, least: int
) -> tuple[Tensor, int] | None:
    """The pose (4, 4) on which most matches of points (M, 3) and pixels (M, 2) agree within
    ``error`` px, and how many; None if fewer than ``least`` do."""
    try:
        found, turn, shift, inliers = cv2.solvePnPRansac(
            points,
            uv,
            K,
            None,
            iterationsCount=RANSAC_ROUNDS,
            reprojectionError=error,
            flags=cv2.SOLVEPNP_SQPNP,
        )
    except cv2.error:  # points in one place
        return None
    if not found or inliers is None:
        return None
    count = _places(uv[inliers[:, 0]], error)
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = torch.from_numpy(cv2.Rodrigues(turn)[0])
    T[:3, 3] = torch.from_numpy(shift[:, 0])
    if count < least or not bool(T.isfinite().all()) or float(T[2, 3]) <= 0.0:
        return None
    return nearest_rigid(T[None])[0], count


def _places(uv: np.ndarray, error: float) -> int:
    """Number of places of pixels (M, 2): several features at one place are one keypoint."""
    return len(np.unique((uv / max(error, 1e-9)).round(), axis=0))

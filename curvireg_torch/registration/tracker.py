"""Tracking: the pose in the next frame, from points that move, colours beside the outline, and
edges."""

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import ImageError, LostObjectError
from ..geometry import rotation_error
from ..geometry.cameras import projected_boxes, transform
from ..rendering import DepthRenderer
from ..rendering.contours import MeshContours
from .confidence import RELIABLE, tracking_confidence
from .contour_fit import ContourProblem, ContourState
from .edges import CROP_SIZE, EdgeCrops
from .least_squares import (
    INLIER_SCALE,
    Measurements,
    PointMatches,
    fit_points,
    nearest_rigid,
    pixels,
    pose_covariance,
    project,
)
from .texture_fit import surface_corners

COLOUR_LEVELS = 8  # Levels of each colour channel in a histogram
SECTORS = 12  # Directions from the object's centre in the image, each with its own histograms
LOCAL_WEIGHT = 0.7  # Weight of a sector's own histogram; the rest is the mean of all sectors
# Added to probabilities, so that a colour never seen is not proof
MIN_PROBABILITY = 0.3 / COLOUR_LEVELS**3
MAX_LOG_RATIO = 4.0  # Largest log ratio of one pixel
LOG_RATIO_FACTOR = 0.3  # Factor of log ratios: neighbouring pixels are not independent
LEARNING_RATE = 0.2  # Weight of a new frame in the histograms
HALF_RATE_COUNT = 20.0  # Pixels of a sector with which it learns at half of the rate


def colour_bins(colours: Tensor) -> Tensor:
    """(S, S) int64 histogram bin of each pixel of (1, 3, S, S) colours in [0, 1]."""
    red, green, blue = (colours[0] * COLOUR_LEVELS).long().clamp(0, COLOUR_LEVELS - 1)
    bins: Tensor = (red * COLOUR_LEVELS + green) * COLOUR_LEVELS + blue
    return bins


def line_posterior(log_ratio: Tensor, radius: int) -> tuple[Tensor, Tensor]:
    """Mean (P,) px and variance (P,) px² of where P lines leave the object, from the colours along
    them.

    If a line leaves the object at d, its pixels before d show the object and those behind it the
    background. With r(l) = log p(colour at l | object) - log p(colour at l | background), the
    logarithm of the likelihood of d is, but for a constant, the sum of r(l) over l < d. The prior
    is uniform from -radius to radius px. ``log_ratio`` (P, L) is r at the offsets -h to h px along
    lines that point out of the object, L = 2 h + 1, h >= ``radius``.
    """
    half = log_ratio.shape[-1] // 2
    log_likelihood = log_ratio.cumsum(dim=-1)[..., half - radius : half + radius]
    d = torch.arange(-radius, radius, dtype=log_ratio.dtype) + 0.5  # between two pixels
    p = log_likelihood.softmax(dim=-1)
    mean = (p * d).sum(dim=-1)
    return mean, (p * (d - mean[..., None]).square()).sum(dim=-1)


class RegionModel:
    """Colour histograms of the object and of the background, a pair for each direction from the
    object's centre. Directions are angles in rad of the image's x, y axes; between the middles of
    two sectors both count."""

    def __init__(self) -> None:
        self._histograms = torch.zeros(2, SECTORS, COLOUR_LEVELS**3)
        self._log_ratio = torch.zeros(SECTORS * COLOUR_LEVELS**3)

    def learn(self, bins: Tensor, uv: Tensor, directions: Tensor, inside: Tensor) -> None:
        """Move the histograms towards the colours at ``uv`` (M, 2) px of ``bins`` (S, S), in
        ``directions`` (M,) rad from the object's centre, ``inside`` (M,) bool the object; empty
        histograms take all of them."""
        colour, seen = _colours_at(bins, uv)
        colour = colour[seen]
        low, high, fraction = _sectors(directions[seen])
        side = (~inside[seen]).long()
        new = torch.zeros_like(self._histograms)
        for sector, weight in ((low, 1.0 - fraction), (high, fraction)):
            new.view(-1).index_add_(
                0, (side * SECTORS + sector) * COLOUR_LEVELS**3 + colour, weight.float()
            )
        count = new.sum(dim=-1, keepdim=True)
        new = new / count.clamp(min=1e-9)
        step = LEARNING_RATE * count / (count + HALF_RATE_COUNT)
        empty = self._histograms.sum(dim=-1, keepdim=True) == 0
        self._histograms = torch.where(empty, new, (1.0 - step) * self._histograms + step * new)
        cube = self._histograms.view(-1, 1, COLOUR_LEVELS, COLOUR_LEVELS, COLOUR_LEVELS)
        for axis in range(3):  # smooth along each colour channel
            shape = [1, 1, 1]
            pad = [0] * 6
            shape[axis], pad[4 - 2 * axis], pad[5 - 2 * axis] = 3, 1, 1
            kernel = torch.tensor([0.2, 0.6, 0.2]).view(1, 1, *shape)
            cube = F.conv3d(F.pad(cube, pad, mode="replicate"), kernel)
        p = cube.view_as(self._histograms)
        p = LOCAL_WEIGHT * p + (1.0 - LOCAL_WEIGHT) * p.mean(dim=1, keepdim=True) + MIN_PROBABILITY
        self._log_ratio = LOG_RATIO_FACTOR * (p[0] / p[1]).log().clamp(
            -MAX_LOG_RATIO, MAX_LOG_RATIO
        ).view(-1)

    def log_ratio(self, bins: Tensor, uv: Tensor, directions: Tensor) -> Tensor:
        """(P, L) log p(colour | object) - log p(colour | background), times ``LOG_RATIO_FACTOR``,
        at (P, L, 2) px of lines in ``directions`` (P,); 0 outside the window."""
        colour, seen = _colours_at(bins, uv)
        low, high, fraction = (x[:, None] for x in _sectors(directions))
        of_low, of_high = (
            self._log_ratio[sector * COLOUR_LEVELS**3 + colour] for sector in (low, high)
        )
        return torch.lerp(of_low, of_high, fraction.to(of_low.dtype)) * seen


def _colours_at(bins: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Bins (...) of the pixels nearest to ``uv`` (..., 2), and whether they lie in the window."""
    side = bins.shape[-1]
    x, y = uv.round().long().unbind(-1)
    seen = (x >= 0) & (x < side) & (y >= 0) & (y < side)
    return bins[y.clamp(0, side - 1), x.clamp(0, side - 1)], seen


def _sectors(directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The two sectors beside each direction, and the weight of the second."""
    place = (directions / (2.0 * math.pi) % 1.0) * SECTORS
    low = place.floor()
    return low.long() % SECTORS, (low.long() + 1) % SECTORS, place - low


# Added around the object's box, as a fraction of its longer side: room for motion that was not
# predicted
WINDOW_MARGIN = 0.3
# Message of a LostObjectError
OUTSIDE = "at the start the mesh lies outside the photograph; check pose, unit and camera matrix"
# Search radius in px of edges and of the end of the object's colours, one a round
SEARCH_RADII = (6.0, 4.0, 2.5)
STEPS_PER_ROUND = 2  # Least-squares steps per round
# Weights, relative to edges, of colours and of points from the last frame and from a keyframe
REGION_WEIGHT = 2.0
POINT_WEIGHT = 0.3
KEYFRAME_WEIGHT = 0.5
REGION_VARIANCE = 0.5  # Variance in px² added to that of the end of the object's colours
# Nearest and farthest distance in px from the outline at which colours are learned
LEARNED_BAND = (2, 24)
# Radius in px of the posterior from which TrackedPose.features are computed
REGION_FEATURE_RADIUS = 8
# Keyframes that are kept, and the rotation in degrees from the nearest one at which a frame becomes
# another
MAX_KEYFRAMES = 30
KEYFRAME_ANGLE = 8.0
# Levels of the pyramid of optical flow from the last frame, and from a keyframe, whose points are
# nearly in place
PYRAMID_LAST = 3
PYRAMID_KEYFRAME = 1
FLOW_PATCH = 15  # Side of the patches of the optical flow in px
# Largest distance in px between a corner and where the flow back from its match ends
MAX_RETURN_ERROR = 1.5
# Scale of the weights in px in each least-squares step: at first all matches count, in the end
# those that agree
FLOW_SCALES = (24.0, 12.0, 6.0, 3.0, 2.0, 2.0, 2.0)
# Least strength of a keyframe's corners, as a fraction of the strongest one's, and their least
# distance in px from the outline: nearer to it, patches show the background
CORNER_QUALITY = 0.01
CORNER_INSET = 3


@dataclass(frozen=True)
class Frame:
    """The part of a frame around the object: its ``crops`` in three channels, their mean ``grey``
    (S, S) uint8, and the camera ``K`` (1, 3, 3) of these."""

    crops: EdgeCrops
    grey: np.ndarray
    K: Tensor
    contours: MeshContours

    @cached_property
    def bins(self) -> Tensor:
        """(S, S) histogram bins of the colours."""
        return colour_bins(self.crops.crops)

    @cached_property
    def problem(self) -> ContourProblem:
        """The fit of contours to the edges of the frame."""
        index = torch.zeros(1, dtype=torch.long)
        return ContourProblem(self.contours, self.crops.edges(1), index, self.K, CROP_SIZE)


def boxes_at(hull: Tensor, T: Tensor, K: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """(N, 4) boxes in px around a mesh with ``hull`` (V, 3) at poses (N, 4, 4), in an image of
    ``size`` (H, W). And (N,) bool, False where the mesh lies behind the camera, or outside the
    image: there the box means nothing."""
    depth = (hull.to(T) @ T[:, 2, :3].mT + T[:, 2, 3]).amin(dim=0)
    boxes = projected_boxes(hull, T, K)
    limits = torch.tensor([size[1], size[0]], dtype=boxes.dtype) - 0.5
    outside = (boxes[:, :2] >= limits) | (boxes[:, 2:] <= -0.5) | (depth <= 0)[:, None]
    return boxes, ~outside.any(dim=1)


@dataclass(frozen=True)
class Keyframe:
    """A ``grey`` picture (S, S) uint8 with a known pose ``T`` (1, 4, 4), and corners ``uv`` (P, 2)
    px, float32, at the points ``model`` (1, P, 3) of the surface."""

    grey: np.ndarray
    T: Tensor
    uv: np.ndarray
    model: Tensor


def track_points(
    keyframe: Keyframe, frame: Frame, T: Tensor, centre: Tensor, *, levels: int
) -> PointMatches:
    """Corners of a keyframe in a new frame, searched where the pose ``T`` (1, 4, 4) projects them.
    Matches from which the flow does not lead back to the corner have weight 0. A pyramid of
    ``levels`` halvings lets the search reach further."""
    if len(keyframe.uv) == 0:
        return PointMatches(
            keyframe.model, torch.zeros(1, 0, 2).double(), torch.zeros(1, 0).double()
        )
    guess = pixels(keyframe.model, T, frame.K, centre)[0].float().numpy()
    there, found = _optical_flow(keyframe.grey, frame.grey, keyframe.uv, guess, levels)
    back, returned = _optical_flow(frame.grey, keyframe.grey, there, keyframe.uv, levels)
    kept = found & returned & (np.linalg.norm(back - keyframe.uv, axis=1) < MAX_RETURN_ERROR)
    return PointMatches(
        keyframe.model,
        torch.from_numpy(there).double()[None],
        torch.from_numpy(kept).double()[None],
    )


def _optical_flow(
    before: np.ndarray, after: np.ndarray, points: np.ndarray, guess: np.ndarray, levels: int
) -> tuple[np.ndarray, np.ndarray]:
    """Where points (P, 2) of one picture are in another, searched at ``guess`` (P, 2); and (P,)
    whether found."""
    window = (FLOW_PATCH, FLOW_PATCH)
    flags = cv2.OPTFLOW_USE_INITIAL_FLOW
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        before, after, points, guess.copy(), winSize=window, maxLevel=levels, flags=flags
    )
    return there, found[:, 0] > 0


@dataclass(frozen=True)
class TrackedPose:
    """A pose (1, 4, 4) in a frame, with its contours, as ``state``. Its ``features``, all in [0,
    1]: ``edge_support`` as of a contour fit; ``region``, how clearly and how near to the outline
    the object's colours end; ``flow`` and ``keyframe``, the fraction of the corners of the last
    frame, and of a keyframe, that are found where the pose has them."""

    features: Mapping[str, float]
    frame: Frame
    state: ContourState

    @property
    def confidence(self) -> float:
        """Probability that the pose is within 10 degrees and 10 % of the distance of the truth."""
        return tracking_confidence(self.features)


class Tracker:
    """Follows an object from a known pose, by the ``contours`` of its mesh and the points ``hull``
    (V, 3) around it.

    Each frame is searched around the pose that a constant velocity predicts, and if that is not
    convincing, around the last pose. Optical flow of corners on the surface gives a first pose;
    robust least squares then fits jointly edges near the contours, the end of the object's colours
    along lines across its silhouette, and the corners of the last frame and of the keyframe that
    was seen from the most similar direction.

    A pose that is found counts as known, to predict and to learn colours from, only after
    :meth:`accept`.
    """

    def __init__(self, renderer: DepthRenderer, contours: MeshContours, hull: Tensor) -> None:
        self.renderer = renderer
        self.contours = contours
        self.hull = hull.double()
        self.centre = contours.centre
        self.radius = contours.radius
        self._poses: list[Tensor] = []
        self._keyframes: list[Keyframe] = []
        self._last: Keyframe | None = None
        self._regions = RegionModel()

    def start(self, image: Tensor, K: Tensor, T: Tensor) -> None:
        """Begin, or begin again, from the pose ``T`` (4, 4) in an image (C, H, W) with camera
        matrix ``K`` (3, 3). Raises :class:`LostObjectError` where the mesh lies behind the camera,
        or outside the image."""
        first = self.measure(image, K, T)
        self._poses = []
        self._keyframes = []
        self._regions = RegionModel()
        self.accept(first)

    def measure(self, image: Tensor, K: Tensor, T: Tensor) -> TrackedPose:
        """The pose ``T`` (4, 4) in an image (C, H, W) with camera matrix ``K`` (3, 3), as it is;
        errors as :meth:`start`."""
        start = T.detach().cpu().double()[None]
        frame = self._frame(image, K, start)
        return self._tracked(frame, frame.problem.state(start), [])

    def track(self, image: Tensor, K: Tensor) -> TrackedPose:
        """The pose in the next frame (C, H, W) with camera matrix ``K`` (3, 3);
        :class:`LostObjectError` if it left the image, or pixels around it are outside [0, 1]."""
        found: list[TrackedPose] = []
        for T in self.predictions():
            # pixels beside a wrong prediction may be unusable
            with suppress(LostObjectError, ImageError):
                found.append(self._fit(image, K, T))
                if found[-1].confidence >= RELIABLE:
                    break
        if not found:
            raise LostObjectError("the object has left the photograph")
        return max(found, key=lambda pose: pose.confidence)

    def accept(self, pose: TrackedPose) -> None:
        """Go on from a pose of :meth:`track` or :meth:`measure`, and learn from its frame."""
        self._poses = [*self._poses[-1:], pose.state.T]
        depth = self.renderer.render(pose.state.T, pose.frame.K, (CROP_SIZE, CROP_SIZE)).cpu()
        self._learn(pose.frame, pose.state, depth)
        self._remember(pose.frame, pose.state.T, depth)

    def covariance(self, pose: TrackedPose) -> Tensor:
        """(6, 6) of a pose, see :func:`curvireg_torch.registration.fit_contours`."""
        problem = pose.frame.problem
        points = pose.state.points
        measured = problem.measured_edges(pose.state, SEARCH_RADII[-1])
        return pose_covariance(
            measured, points, pose.state.T, problem.K, self.centre, radius=self.radius
        )[0][0]

    @property
    def last_pose(self) -> Tensor:
        """(1, 4, 4) of the last frame."""
        return self._poses[-1]

    def predictions(self) -> list[Tensor]:
        """Starts (1, 4, 4) for the next frame: the last pose, turned and moved on as before, and
        the last pose."""
        if len(self._poses) < 2:
            return [self.last_pose]
        (R0, c0), (R1, c1) = (
            (T[:, :3, :3], T[:, :3, :3] @ self.centre + T[:, :3, 3]) for T in self._poses
        )
        R = R1 @ R0.mT @ R1
        return [transform(R, 2.0 * c1 - c0 - R @ self.centre), self.last_pose]

    def _fit(self, image: Tensor, K: Tensor, T: Tensor) -> TrackedPose:
        """The pose around a start (1, 4, 4)."""
        assert self._last is not None
        first = self._frame(image, K, T)
        flow = track_points(self._last, first, T, self.centre, levels=PYRAMID_LAST)
        T = fit_points(flow, T, first.K, self.centre, FLOW_SCALES)
        frame = self._frame(image, K, T)
        flows = [(POINT_WEIGHT, flow.moved(first.K, frame.K))]
        keyframe = self._keyframes[int(self._angles(T).argmin())]
        if keyframe is not self._last:
            flows.append(
                (
                    KEYFRAME_WEIGHT,
                    track_points(keyframe, frame, T, self.centre, levels=PYRAMID_KEYFRAME),
                )
            )
        state = frame.problem.state(T)
        for radius in SEARCH_RADII:
            for _ in range(STEPS_PER_ROUND):
                others = self._measurements(frame, state, flows, radius)
                state = replace(state, T=frame.problem.step(state.points, state.T, radius, others))
            state = frame.problem.with_current_contours(replace(state, T=nearest_rigid(state.T)))
        return self._tracked(frame, state, [flow for _, flow in flows])

    def _measurements(
        self,
        frame: Frame,
        state: ContourState,
        flows: list[tuple[float, PointMatches]],
        radius: float,
    ) -> list[Measurements]:
        """Colours and points, beside the edges."""
        mean, variance = self._ends(frame, state, math.ceil(radius))
        flat = math.ceil(radius) ** 2 / 3.0  # variance of lines along which colours say nothing
        information = (1.0 / (variance + REGION_VARIANCE) - 1.0 / flat).clamp(min=0.0)
        model, normals = _silhouette(state)
        _, J = project(model[None], normals[None], state.T, frame.K, self.centre)
        colours = Measurements(J, mean[None, :, None], REGION_WEIGHT * information[None, :, None])
        points = [
            flow.measurements(state.T, frame.K, self.centre, INLIER_SCALE).scaled(w)
            for w, flow in flows
        ]
        return [colours, *points]

    def _ends(self, frame: Frame, state: ContourState, radius: int) -> tuple[Tensor, Tensor]:
        """Mean and variance (Q,) of where the object's colours end along the normals of its
        silhouette."""
        samples, directions = self._lines(
            frame, state, torch.arange(-radius, radius + 1, dtype=torch.float64)
        )
        return line_posterior(
            self._regions.log_ratio(frame.bins, samples, directions).double(), radius
        )

    def _lines(self, frame: Frame, state: ContourState, offsets: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels (Q, L, 2) at offsets (L,) px along the normals of the silhouette, and directions
        (Q,) rad of these lines from the object's centre."""
        model, normals = _silhouette(state)
        points = torch.cat([self.centre[None], model])[None]
        middle, uv = pixels(points, state.T, frame.K, self.centre)[0].split([1, len(model)])
        x, y = (uv - middle).unbind(-1)
        return uv[:, None] + offsets[:, None] * normals[:, None], torch.atan2(y, x)

    def _tracked(self, frame: Frame, state: ContourState, flows: list[PointMatches]) -> TrackedPose:
        """A pose with its ``flows`` from the last frame and, if that is another one, a keyframe."""
        mean, variance = self._ends(frame, state, REGION_FEATURE_RADIUS)
        clear = torch.exp(-0.125 * mean.square()) * (
            1.0 - 3.0 * variance / REGION_FEATURE_RADIUS**2
        ).clamp(min=0.0)
        ratios = [flow.inlier_ratio(state.T, frame.K, self.centre) for flow in flows] or [0.0]
        features = {
            "edge_support": float(frame.problem.edge_support(state)),
            "region": float(clear.sum()) / max(len(clear), 1),
            "flow": ratios[0],
            "keyframe": ratios[-1],
        }
        return TrackedPose(features, frame, state)

    def _learn(self, frame: Frame, state: ContourState, depth: Tensor) -> None:
        """Learn the colours beside the outline; where the mesh hides the background again, they are
        the object's."""
        distance = torch.arange(LEARNED_BAND[0], LEARNED_BAND[1] + 1, dtype=torch.float64)
        samples, directions = self._lines(frame, state, torch.cat([-distance, distance]))
        x, y = samples.round().long().clamp(0, CROP_SIZE - 1).unbind(-1)
        inside = depth[0, 0, y, x] > 0
        directions = directions[:, None].expand(inside.shape)
        self._regions.learn(
            frame.bins, samples.flatten(0, 1), directions.flatten(), inside.flatten()
        )

    def _remember(self, frame: Frame, T: Tensor, depth: Tensor) -> None:
        """Keep the frame as the last one, and if none from a similar direction is kept, as a
        keyframe."""
        uv, model = surface_corners(
            frame.grey, depth, T, frame.K, quality=CORNER_QUALITY, inside=CORNER_INSET
        )
        self._last = Keyframe(frame.grey, T, uv, model)
        if not self._keyframes or float(self._angles(T).min()) > KEYFRAME_ANGLE:
            self._keyframes = [*self._keyframes[1 - MAX_KEYFRAMES :], self._last]

    def _angles(self, T: Tensor) -> Tensor:
        """(K,) degrees between the rotations of a pose (1, 4, 4) and of the keyframes."""
        return rotation_error(
            torch.cat([keyframe.T for keyframe in self._keyframes])[:, :3, :3], T[:, :3, :3]
        )

    def _frame(self, image: Tensor, K: Tensor, T: Tensor) -> Frame:
        """The square around the mesh at ``T`` (1, 4, 4) in an image with camera matrix ``K`` (3,
        3)."""
        boxes, visible = boxes_at(
            self.hull, T, K[None], (int(image.shape[-2]), int(image.shape[-1]))
        )
        if not bool(visible):
            raise LostObjectError(OUTSIDE)
        crops = EdgeCrops.cut([image.expand(3, -1, -1)], boxes.float(), WINDOW_MARGIN)
        grey = (255.0 * crops.crops[0].mean(dim=0)).round().clamp(0, 255).to(torch.uint8).numpy()
        return Frame(crops, grey, crops.transforms @ K, self.contours)


def _silhouette(state: ContourState) -> tuple[Tensor, Tensor]:
    """Contour points (Q, 3) that have the background beside them, and unit normals (Q, 2) that
    point there."""
    return state.points.model[state.points.outline], state.points.normals[state.points.outline]

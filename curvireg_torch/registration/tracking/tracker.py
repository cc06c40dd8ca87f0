"""The pose in the next frame, from three kinds of measurement: points that move, colours beside the outline, edges."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from ...errors import LostObjectError
from ...geometry import rotation_error
from ...geometry.cameras import transform
from ...rendering import DepthRenderer
from ...rendering.contours import ContourPoints, MeshContours
from ..confidence import RELIABLE, tracking_confidence
from ..contours.covariance import pose_covariance
from ..contours.descent import STALE, ContourProblem, ContourState, pixels, project
from ..contours.points import EdgeField
from .flow import Flow, Keyframe, flow_equations, flow_share, make_keyframe, pose_from_flow, track_points
from .regions import RegionModel, colour_bins, line_posterior
from .window import SIZE, Window, cut_window

__all__ = ["TrackedPose", "Tracker"]

REACHES = (6.0, 4.0, 2.5)
"""Search distance in px of edges and of the end of the object's colours, one a round."""

STEPS = 2
"""Least-squares steps per round."""

EDGES, REGIONS, POINTS, KEYFRAME = 1.0, 2.0, 0.3, 0.5
"""Weights of the measurements: of edges, colours, and points from the last frame and from a keyframe."""

BLUR = 0.5
"""Variance in px² added to that of the end of the object's colours."""

RATE = 0.2
"""Weight of a new frame in the colour histograms."""

BESIDE = (2, 24)
"""Nearest and farthest distance in px from the outline at which colours are learned."""

NEAR = 8
"""Reach in px of the posterior from which :attr:`TrackedPose.features` are computed."""

KEYFRAMES, KEYFRAME_ANGLE = 30, 8.0
"""Keyframes that are kept, and the rotation in degrees from the nearest one at which a frame becomes another."""

LONG, SHORT = 3, 1
"""Levels of the pyramid of optical flow from the last frame, and from a keyframe, whose points are nearly in place."""


@dataclass(frozen=True)
class Frame:
    """A window of a frame and what is measured in it: histogram bins (S, S) and edges."""

    window: Window
    bins: Tensor
    problem: ContourProblem


@dataclass(frozen=True)
class Outline:
    """The contour ``points`` of the mesh at a pose ``T`` (1, 4, 4), and of those that have the background beside them,
    ``model`` (1, Q, 3) and unit ``normals`` (1, Q, 2) that point there."""

    T: Tensor
    points: ContourPoints

    @cached_property
    def model(self) -> Tensor:
        return self.points.model[self.points.outline][None]

    @cached_property
    def normals(self) -> Tensor:
        return self.points.normals[self.points.outline][None]


@dataclass(frozen=True)
class TrackedPose:
    """A pose in a frame.

    Attributes:
        T: (1, 4, 4) float64 ``T_cam_from_model``.
        features: what the confidence is computed from, all in [0, 1]: ``edge_support`` as of a contour fit; ``region``,
            how clearly and how near to the outline the object's colours end; ``flow`` and ``keyframe``, the fraction
            of the corners of the last frame, and of a keyframe, that are found where the pose has them.
        frame, outline: what the features were measured in.
    """

    T: Tensor
    features: Mapping[str, float]
    frame: Frame
    outline: Outline

    @property
    def confidence(self) -> float:
        """Probability that the pose is within 10 degrees and 10 % of the distance of the truth."""
        return tracking_confidence(self.features)


class Tracker:
    """Follows an object from a known pose.

    Each frame is searched around the pose that a constant velocity predicts, and if that is not convincing, around the
    last pose. Optical flow of corners on the surface gives a first pose; robust least squares then fits jointly edges
    near the contours, the end of the object's colours along lines across its silhouette, and the corners of the last
    frame and of the keyframe that was seen from the most similar direction.

    A pose that is found counts as known, to predict and to learn colours from, only after :meth:`accept`.

    Args:
        renderer, contours: of the mesh.
        hull: (V, 3) points of the mesh that span its convex hull.
    """

    def __init__(self, renderer: DepthRenderer, contours: MeshContours, hull: Tensor) -> None:
        self.renderer, self.contours, self.hull = renderer, contours, hull.double()
        self.centre, self.radius = contours.centre, contours.radius
        self._poses: list[Tensor] = []
        self._keyframes: list[Keyframe] = []
        self._last: Keyframe | None = None
        self._regions = RegionModel()

    def start(self, image: Tensor, K: Tensor, T: Tensor) -> None:
        """Begin, or begin again, from the pose ``T`` (4, 4) in an image (C, H, W) with camera matrix ``K`` (3, 3).

        Raises:
            LostObjectError: at that pose the mesh lies behind the camera, or outside the image.
        """
        first = self.measure(image, K, T)
        self._poses, self._keyframes, self._regions = [], [], RegionModel()
        self.accept(first)

    def measure(self, image: Tensor, K: Tensor, T: Tensor) -> TrackedPose:
        """The pose ``T`` (4, 4) in an image (C, H, W) with camera matrix ``K`` (3, 3), as it is.

        Raises:
            LostObjectError: at that pose the mesh lies behind the camera, or outside the image.
        """
        start = T.detach().cpu().double()[None]
        frame = self._frame(image, K, start)
        outline = self._outline(frame, start)
        return TrackedPose(start, self._features(frame, outline, start, []), frame, outline)

    def track(self, image: Tensor, K: Tensor) -> TrackedPose:
        """The pose in the next frame (C, H, W) with camera matrix ``K`` (3, 3).

        Raises:
            LostObjectError: the object has left the image.
        """
        found: list[TrackedPose] = []
        for T in self.predictions():
            try:
                found.append(self._fit(image, K, T))
            except LostObjectError:
                continue
            if found[-1].confidence >= RELIABLE:
                break
        if not found:
            raise LostObjectError("the object has left the photograph")
        return max(found, key=lambda pose: pose.confidence)

    def accept(self, pose: TrackedPose) -> None:
        """Go on from a pose of :meth:`track` or :meth:`measure`, and learn from its frame."""
        self._poses = [*self._poses[-1:], pose.T]
        depth = self.renderer.render(pose.outline.T, pose.frame.window.K, (SIZE, SIZE)).cpu()
        self._learn(pose.frame, pose.outline, depth, rate=RATE)
        self._remember(pose.frame, pose.outline, depth)

    def covariance(self, pose: TrackedPose) -> Tensor:
        """(6, 6) of a pose, see :func:`curvireg_torch.registration.fit_contours`."""
        frame = pose.frame
        matches = frame.problem.matches(ContourState(pose.T, pose.outline.T, pose.outline.points), REACHES[-1])
        return pose_covariance(matches, pose.outline.points, pose.T, frame.window.K, self.centre, radius=self.radius)[
            0
        ][0]

    @property
    def last_pose(self) -> Tensor:
        """(1, 4, 4) of the last frame."""
        return self._poses[-1]

    def predictions(self) -> list[Tensor]:
        """Starts (1, 4, 4) for the next frame: the last pose, turned and moved on as before, and the last pose."""
        last = self._poses[-1]
        if len(self._poses) < 2:
            return [last]
        (R0, c0), (R1, c1) = ((T[:, :3, :3], T[:, :3, :3] @ self.centre + T[:, :3, 3]) for T in self._poses)
        R = R1 @ R0.mT @ R1
        return [transform(R, 2.0 * c1 - c0 - R @ self.centre), last]

    def _fit(self, image: Tensor, K: Tensor, T: Tensor) -> TrackedPose:
        """The pose around a start (1, 4, 4)."""
        assert self._last is not None
        first = cut_window(image, K, self.hull, T)
        flow = track_points(self._last, first, T, self.centre, levels=LONG)
        T = pose_from_flow(flow, T, first.K, self.centre)
        frame = self._frame(image, K, T)
        flows = [(POINTS, flow.moved(first.K, frame.window.K))]
        keyframe = self._nearest(T)
        if keyframe is not self._last:
            flows.append((KEYFRAME, track_points(keyframe, frame.window, T, self.centre, levels=SHORT)))
        outline = self._outline(frame, T)
        for reach in REACHES:
            for _ in range(STEPS):
                others = self._equations(frame, outline, T, flows, reach)
                T = frame.problem.step(outline.points, T, reach, others)
            T = _orthonormal(T)
            if float(frame.problem.mean_shift(outline.points, outline.T, T)) > STALE:
                outline = self._outline(frame, T)
        return TrackedPose(T, self._features(frame, outline, T, [flow for _, flow in flows]), frame, outline)

    def _equations(
        self, frame: Frame, outline: Outline, T: Tensor, flows: list[tuple[float, Flow]], reach: float
    ) -> tuple[Tensor, Tensor]:
        """Normal equations (1, 6, 6) and (1, 6) of colours and points, relative to the weight of edges."""
        mean, variance = self._ends(frame, outline, T, math.ceil(reach))
        flat = math.ceil(reach) ** 2 / 3.0  # variance of lines along which colours say nothing
        information = (1.0 / (variance + BLUR) - 1.0 / flat).clamp(min=0.0)
        J = (outline.normals[..., None, :] @ project(outline.model, T, frame.window.K, self.centre)[1])[..., 0, :]
        WJ = REGIONS * information[None, :, None] * J
        A, b = WJ.mT @ J, WJ.mT @ mean
        for weight, flow in flows:
            of_points = flow_equations(flow, T, frame.window.K, self.centre)
            A, b = A + weight * of_points[0], b + weight * of_points[1]
        return A / EDGES, b / EDGES

    def _ends(self, frame: Frame, outline: Outline, T: Tensor, reach: int) -> tuple[Tensor, Tensor]:
        """Mean and variance (Q,) of where the object's colours end along the normals of its silhouette."""
        uv = pixels(outline.model, T, frame.window.K, self.centre)[0]
        offsets = torch.arange(-reach, reach + 1, dtype=torch.float64)
        samples = uv[:, None] + offsets[:, None] * outline.normals[0][:, None]
        log_ratio = self._regions.log_ratio(frame.bins, samples, self._directions(frame, T, uv))
        mean, variance = line_posterior(log_ratio.double(), reach)
        return mean, variance

    def _features(self, frame: Frame, outline: Outline, T: Tensor, flows: list[Flow]) -> dict[str, float]:
        """Features of a pose with its ``flows`` from the last frame and, if that is another one, a keyframe."""
        mean, variance = self._ends(frame, outline, T, NEAR)
        clear = torch.exp(-0.125 * mean.square()) * (1.0 - 3.0 * variance / NEAR**2).clamp(min=0.0)
        shares = [flow_share(flow, T, frame.window.K, self.centre) for flow in flows] or [0.0]
        return {
            "edge_support": float(frame.problem.edge_support(ContourState(T, outline.T, outline.points))),
            "region": float(clear.sum()) / max(len(clear), 1),
            "flow": shares[0],
            "keyframe": shares[-1],
        }

    def _learn(self, frame: Frame, outline: Outline, depth: Tensor, *, rate: float) -> None:
        """Learn the colours beside the outline; where the mesh hides the background again, they are the object's."""
        uv = pixels(outline.model, outline.T, frame.window.K, self.centre)[0]
        distance = torch.arange(BESIDE[0], BESIDE[1] + 1, dtype=torch.float64)
        samples = uv[:, None] + torch.cat([-distance, distance])[:, None] * outline.normals[0][:, None]
        x, y = samples.round().long().clamp(0, SIZE - 1).unbind(-1)
        inside = depth[0, 0, y, x] > 0
        directions = self._directions(frame, outline.T, uv)[:, None].expand(inside.shape)
        self._regions.learn(frame.bins, samples.flatten(0, 1), directions.flatten(), inside.flatten(), rate=rate)

    def _remember(self, frame: Frame, outline: Outline, depth: Tensor) -> None:
        """Keep the frame as the last one, and if none from a similar direction is kept, as a keyframe."""
        self._last = make_keyframe(frame.window, outline.T, depth)
        if not self._keyframes or float(self._angles(outline.T).min()) > KEYFRAME_ANGLE:
            self._keyframes = [*self._keyframes[1 - KEYFRAMES :], self._last]

    def _nearest(self, T: Tensor) -> Keyframe:
        return self._keyframes[int(self._angles(T).argmin())]

    def _angles(self, T: Tensor) -> Tensor:
        """(K,) degrees between the rotations of a pose (1, 4, 4) and of the keyframes."""
        return rotation_error(torch.cat([keyframe.T for keyframe in self._keyframes])[:, :3, :3], T[:, :3, :3])

    def _directions(self, frame: Frame, T: Tensor, uv: Tensor) -> Tensor:
        """(Q,) rad of pixels (Q, 2) from the object's centre."""
        x, y = (uv - pixels(self.centre[None, None], T, frame.window.K, self.centre)[0]).unbind(-1)
        return torch.atan2(y, x)

    def _frame(self, image: Tensor, K: Tensor, T: Tensor) -> Frame:
        window = cut_window(image, K, self.hull, T)
        index, edges = torch.zeros(1, dtype=torch.long), EdgeField(window.colours)
        problem = ContourProblem(self.contours, edges, index, window.K, SIZE)
        return Frame(window, colour_bins(window.colours), problem)

    def _outline(self, frame: Frame, T: Tensor) -> Outline:
        return Outline(T, self.contours.points(T, frame.window.K, SIZE))


def _orthonormal(T: Tensor) -> Tensor:
    """The poses (1, 4, 4) with the nearest rotations: predictions would let rounding grow from frame to frame."""
    U, _, V = torch.linalg.svd(T[:, :3, :3])
    return transform(U @ V, T[:, :3, 3])

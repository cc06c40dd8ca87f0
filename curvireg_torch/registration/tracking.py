"""Tracking: the pose in the next frame, from points that move, colours beside the outline, and
edges; and following an object through the frames of a video."""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ..errors import CurviregError, ImageError, InvalidInputError, LostObjectError
from ..fitting.contour_problem import ContourState
from ..fitting.edges import CROP_SIZE, EdgeCrops
from ..fitting.flow import Frame, Keyframe, track_points
from ..fitting.least_squares import (
    INLIER_SCALE,
    Measurements,
    PointMatches,
    apply_twist,
    fit_points,
    nearest_rigid,
    pixels,
    pose_covariance,
    project,
)
from ..fitting.regions import RegionModel, Silhouette
from ..fitting.texture_fit import surface_corners
from ..geometry import rotation_error
from ..geometry.calibration import Camera
from ..geometry.cameras import point_in_cameras, pose_around
from ..geometry.framing import boxes_at
from ..geometry.pose_prior import PosePrior
from ..geometry.viewpoint import angles_between
from ..matching import Ranking
from ..rendering.contours import MeshContours
from ..utils.checks import as_numbers, check_pose, check_probability, check_tensor
from ..utils.likes import ArrayLike, BoxLike, ImageLike
from ..utils.threads import map_on_threads
from .camera import SHOWN_FOCAL_LENGTH, STRETCHED
from .confidence import RELIABLE, is_calibrated, tracking_confidence
from .doubts import MIRROR_WARNING
from .hypotheses import Hypotheses, hypothesis_of
from .photograph import Photograph, as_photographs
from .refinement import OUTSIDE, refine_one
from .registrar import Registrar
from .result import FailedRegistration, Registration, kinds_of
from .target import nearest_view

# Added around the object's box, as a fraction of its longer side: room for motion that was not
# predicted
WINDOW_MARGIN = 0.3
# Difference in px between the mesh at the predicted pose and at that of the flow, up to which the
# crop of the predicted one serves
WINDOW_SHIFT = 16.0
# Size of the crops for which the mesh is simplified from which corners get their depth
DEPTH_SIZE = 128
# Search radius in px of edges and of the end of the object's colours, one a round
SEARCH_RADII = (6.0, 4.0, 2.5)
STEPS_PER_ROUND = 2  # Least-squares steps per round
# Weights, relative to edges, of colours and of points from the last frame and from a keyframe
REGION_WEIGHT = 2.0
POINT_WEIGHT = 0.3
KEYFRAME_WEIGHT = 0.5
REGION_VARIANCE = 0.5  # Variance in px² added to that of the end of the object's colours
# Distances in px from the outline at which colours are learned
LEARNED_BAND = range(2, 25, 2)
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
# Scale of the weights in px in each least-squares step: at first all matches count, in the end
# those that agree
FLOW_SCALES = (24.0, 12.0, 6.0, 3.0, 2.0)
# Least strength of a keyframe's corners, as a fraction of the strongest one's, and their least
# distance in px from the outline: nearer to it, patches show the background
CORNER_QUALITY = 0.01
CORNER_INSET = 3


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
    :meth:`accept`. One of confidence ``reliable`` is convincing.
    """

    def __init__(
        self,
        contours: MeshContours,
        hull: Tensor,
        *,
        reliable: float = RELIABLE,
    ) -> None:
        self.reliable = reliable
        self.contours = contours
        self.hull = hull.double()
        self.centre = contours.centre
        self.radius = contours.radius
        self._renderer = contours.renderer(DEPTH_SIZE)
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

    @torch.inference_mode()
    def measure(self, image: Tensor, K: Tensor, T: Tensor) -> TrackedPose:
        """The pose ``T`` (4, 4) in an image (C, H, W) with camera matrix ``K`` (3, 3), as it is;
        errors as :meth:`start`."""
        start = T.detach().cpu().double()[None]
        frame = self._frame(image, K, start)
        return self._tracked(frame, frame.problem.state(start), [])

    @torch.inference_mode()
    def track(self, image: Tensor, K: Tensor) -> TrackedPose:
        """The pose in the next frame (C, H, W) with camera matrix ``K`` (3, 3);
        :class:`LostObjectError` if it left the image, or pixels around it are outside [0, 1]."""
        found: list[TrackedPose] = []
        for T in self.predictions():
            # pixels beside a wrong prediction may be unusable
            with suppress(LostObjectError, ImageError):
                found.append(self._fit(image, K, T))
                if found[-1].confidence >= self.reliable:
                    break
        if not found:
            raise LostObjectError("the object has left the photograph")
        return max(found, key=lambda pose: pose.confidence)

    @torch.inference_mode()
    def accept(self, pose: TrackedPose) -> None:
        """Go on from a pose of :meth:`track` or :meth:`measure`, and learn from its frame."""
        self._poses = [*self._poses[-1:], pose.state.T]
        depth = self._renderer.render(pose.state.T, pose.frame.K, (CROP_SIZE, CROP_SIZE))
        self._learn(pose.frame, pose.state, depth)
        self._remember(pose.frame, pose.state.T, depth)

    @torch.inference_mode()
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

    @property
    def distance(self) -> float:
        """Distance of the object's centre in the last frame."""
        return float(point_in_cameras(self.last_pose, self.centre).norm())

    def predictions(self) -> list[Tensor]:
        """Starts (1, 4, 4) for the next frame: the last pose, turned and moved on as before, and
        the last pose."""
        if len(self._poses) < 2:
            return [self.last_pose]
        before, last = self._poses
        R = last[:, :3, :3] @ before[:, :3, :3].mT @ last[:, :3, :3]
        place = 2.0 * point_in_cameras(last, self.centre) - point_in_cameras(before, self.centre)
        return [pose_around(R, place, self.centre), self.last_pose]

    def _fit(self, image: Tensor, K: Tensor, T: Tensor) -> TrackedPose:
        """The pose around a start (1, 4, 4)."""
        assert self._last is not None
        first = self._frame(image, K, T)
        flow = track_points(self._last, first, T, levels=PYRAMID_LAST)
        predicted = pixels(self.hull, T, first.K)
        T = fit_points(flow, T, first.K, self.centre, FLOW_SCALES)
        shift = (pixels(self.hull, T, first.K) - predicted).abs().max()
        frame = first if float(shift) < WINDOW_SHIFT else self._frame(image, K, T)
        flows = [flow.moved(first.K, frame.K)]
        keyframe = self._keyframes[int(self._angles(T).argmin())]
        if keyframe is not self._last:
            flows.append(track_points(keyframe, frame, T, levels=PYRAMID_KEYFRAME))
        weights = (POINT_WEIGHT, KEYFRAME_WEIGHT)
        corners = PointMatches.cat_within(
            [flow.scaled(weight) for flow, weight in zip(flows, weights, strict=False)]
        )
        state = frame.problem.state(T)
        is_near = False  # the contours were hardly moved by the round before
        for radius in SEARCH_RADII:
            if is_near and radius > SEARCH_RADII[-1]:
                continue
            for _ in range(STEPS_PER_ROUND):
                state = replace(state, T=self._step(frame, state, corners, radius))
            current = frame.problem.with_current_contours(state)
            is_near = current is state
            state = current
        state = replace(state, T=nearest_rigid(state.T))
        return self._tracked(frame, state, flows)

    def _step(
        self, frame: Frame, state: ContourState, corners: PointMatches, radius: float
    ) -> Tensor:
        """(1, 4, 4) the pose after a least-squares step towards edges within ``radius`` px, the end
        of the object's colours, and ``corners``."""
        problem = frame.problem
        points = state.points
        uv, J = project(points.model, points.normals, state.T, frame.K, self.centre)
        colours = self._colours(frame, state, J[:, points.outline[0]], math.ceil(radius))
        matches = corners.measurements(state.T, frame.K, self.centre, INLIER_SCALE)
        others = Measurements.cat_within([colours, matches])
        step = problem.selected_step(points, uv, J, radius, [others.equations()])
        fraction = problem.step_fraction(step, state.T)
        return apply_twist(state.T, step * fraction[:, None], self.centre)

    def _colours(self, frame: Frame, state: ContourState, J: Tensor, radius: int) -> Measurements:
        """Where the object's colours end within ``radius`` px of its silhouette, whose points shift
        along their normals by ``J`` (1, Q, 6)."""
        mean, variance = self._regions.ends(frame.bins, self._silhouette(frame, state), radius)
        flat = radius**2 / 3.0  # variance of lines along which colours say nothing
        information = (1.0 / (variance + REGION_VARIANCE) - 1.0 / flat).clamp(min=0.0)
        return Measurements(J, mean[None, :, None], REGION_WEIGHT * information[None, :, None])

    def _silhouette(self, frame: Frame, state: ContourState) -> Silhouette:
        """The contour points that have the background beside them."""
        outline = state.points.outline[0]
        uv = pixels(state.points.model, state.T, frame.K)[0, outline]
        middle = frame.K[0] @ point_in_cameras(state.T, self.centre)[0]
        x, y = (uv - middle[:2] / middle[2]).unbind(-1)
        return Silhouette(uv, state.points.normals[0, outline], torch.atan2(y, x))

    def _tracked(self, frame: Frame, state: ContourState, flows: list[PointMatches]) -> TrackedPose:
        """A pose with its ``flows`` from the last frame and, if that is another one, a keyframe."""
        silhouette = self._silhouette(frame, state)
        mean, variance = self._regions.ends(frame.bins, silhouette, REGION_FEATURE_RADIUS)
        clear = torch.exp(-0.125 * mean.square()) * (
            1.0 - 3.0 * variance / REGION_FEATURE_RADIUS**2
        ).clamp(min=0.0)
        ratios = [flow.inlier_ratio(state.T, frame.K) for flow in flows] or [0.0]
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
        distance = torch.tensor(LEARNED_BAND, dtype=torch.float64)
        silhouette = self._silhouette(frame, state)
        lines = silhouette.lines(torch.cat([-distance, distance]))
        x, y = lines.round().long().clamp(0, CROP_SIZE - 1).unbind(-1)
        inside = depth[0, 0, y, x] > 0
        self._regions.learn(frame.bins, lines, silhouette.directions, inside)

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
        known = torch.cat([keyframe.T for keyframe in self._keyframes])
        return angles_between(T[:, :3, :3], known[:, :3, :3])[0]

    def _frame(self, image: Tensor, K: Tensor, T: Tensor) -> Frame:
        """The square around the mesh at ``T`` (1, 4, 4) in an image with camera matrix ``K`` (3,
        3)."""
        boxes, visible = boxes_at(
            self.hull, T, K[None], (int(image.shape[-2]), int(image.shape[-1]))
        )
        if not bool(visible):
            raise LostObjectError(OUTSIDE)
        crops = EdgeCrops.cut([image], boxes.float(), WINDOW_MARGIN)
        grey = (255.0 * crops.crops[0].mean(dim=0)).round().clamp(0, 255).to(torch.uint8).numpy()
        return Frame(crops, grey, crops.transforms @ K, self.contours)


# Confidence of a tracked pose from which it stands without a refinement, and after one that was no
# better
TRUSTED_CONFIDENCE = 0.5
KEPT_CONFIDENCE = 0.2
# Frames since the last reliable pose after which a trusted one is checked again; then after twice
# as many, and so on
FIRST_CHECK = 8
# Ratio of the distance to that of the last check from which a trusted pose is checked again: a zoom
# of the lens looks like a change of distance
CHECKED_ZOOM = 1.15
# Confidence of a registration from which its pose is followed
BELIEVED_CONFIDENCE = 0.5
# Successive registrations that agree are followed from KEPT_CONFIDENCE on
AGREEING_FRAMES = 3
AGREEING_DEGREES = 15.0
AGREEING_FRACTION = 0.1  # of the distance, by which the object's centre may have moved


class Follower:
    """Registers frames one after the other: each starts from the pose of the frame before.

    Frames are registered until a pose is believed, or three in a row agree, and tracked from then
    on (docs/method.md). Agreement does not raise the confidence: a wrong pose may repeat. Where
    tracking is not trusted, contours are fitted around its pose and the result is compared with a
    registration (:func:`refine`); the more certain pose counts. Where neither finds the object, the
    frame is registered, and that pose is used only if it is reliable.

    The ``confidence`` of a tracked frame is the probability that its pose is within 10 degrees and
    10 % of the distance of the truth: the tracker's own, times that of the last pose that a
    registration confirmed. If that registration is not reliable, the frames that follow are not
    either; they are checked again after 8 frames, 16, 32 and so on. A frame whose distance has
    changed by 15 % is checked too, as the lens may have zoomed, and reliable only if that confirms
    it. What a registration warns of camera and mesh holds for all later frames. No pose gains
    confidence from being followed, unless a further registration is reliable.

    Args:
        registrar: of one mesh, with a bank of all views; or a mesh, see :class:`Registrar`.
        camera_matrix: (3, 3) in px, or a :class:`Camera`, of all frames. Without a size, it is that
            of frames as large as the first one: it is scaled for those of other sizes, and another
            aspect ratio is refused. None estimates it, in the frames that are registered until one
            is believed, whose camera is kept; distances are then proportional to its focal length.
        prior: limits on the pose in frames that are registered.

    Example:
        >>> import curvireg_torch as cr
        >>> from curvireg_torch.synthetic import example_mesh
        >>> bank = cr.ViewBank.build(example_mesh(), cr.sample_views(azimuth_step=90),
        ...     image_size=64, progress=False)
        >>> follow = Follower(cr.Registrar(bank), cr.camera_matrix(150.0, 150.0, 79.5, 59.5))
        >>> follow(torch.rand(3, 120, 160), box=[40, 30, 120, 90]).translation.shape
        torch.Size([3])
    """

    def __init__(
        self,
        registrar: Any,
        camera_matrix: Tensor | Camera | None = None,
        *,
        prior: PosePrior | None = None,
    ) -> None:
        self.registrar = registrar if isinstance(registrar, Registrar) else Registrar(registrar)
        if self.registrar.others:
            raise InvalidInputError(
                "Follower: expected a registrar of one mesh, which is followed, got several"
            )
        if camera_matrix is None and not self.registrar.is_exact:
            raise InvalidInputError(
                "Follower: a similar mesh does not show the focal length; give the camera"
            )
        self.camera_matrix = camera_matrix
        self.prior = prior
        describer = self.registrar.describer
        self._reliable = self.registrar.pipeline.fit.reliable
        self._tracker = Tracker(describer.contours, describer.hull, reliable=self._reliable)
        # confidence of the pose that tracking goes on from, if there is one
        self._base: float | None = None
        # what registrations have warned of camera and mesh, and frames since the last reliable pose
        self._warnings: tuple[str, ...] = ()
        self._unsure = 0
        # distance of the object when it was last checked
        self._distance = math.nan
        # registrations in a row that agree, none of which is believed
        self._agreeing: list[Tensor] = []

    @property
    def _fits_camera(self) -> bool:
        """Whether registrations fit the focal length, which is then kept for tracking."""
        camera = self.camera_matrix
        return camera is None or (
            isinstance(camera, Camera) and camera.focal_deviation > 0.0 and not camera.distorts
        )

    @torch.no_grad()
    def start(
        self,
        image: ImageLike,
        pose: ArrayLike,
        *,
        confidence: float = 1.0,
        warnings: Sequence[str] = (),
    ) -> None:
        """Begin from a known pose, in place of registering the first frame. It is taken as it is,
        and not checked: :meth:`.Registrar.refine` does both.

        Args:
            image: the frame, see :class:`Registrar`.
            pose: (4, 4) rigid ``T_cam_from_model``.
            confidence: probability in [0, 1] that the pose is right; no tracked pose has more,
                unless a registration confirms it. Below 0.5 each frame is checked.
            warnings: of the answer that the pose is from, which hold for the frames that follow.

        Raises:
            InvalidInputError: ``pose`` is not rigid and finite, ``confidence`` is no probability,
                the camera is not known, or the frame cannot be used.
            LostObjectError: at ``pose`` the mesh lies behind the camera, or outside the frame.
            ImageError: pixels around the mesh are outside [0, 1].
        """
        if self.camera_matrix is None:
            raise InvalidInputError("start: a known pose needs the camera; give camera_matrix")
        T = as_numbers(pose, "pose", dtype=torch.float64)
        check_tensor(T, "pose", (4, 4))
        check_pose(T, "pose")
        confidence = check_probability(confidence, "confidence")
        item = self._read(image)
        if not isinstance(item, Photograph):
            raise item
        map_on_threads(lambda item: self._start(item, T, confidence, warnings), [item])

    def _read(
        self, image: ImageLike, box: BoxLike | None = None, prior: PosePrior | None = None
    ) -> Photograph | CurviregError:
        """A frame. A camera without a size is that of frames as large as the first."""
        boxes = None if box is None else [box]
        item = as_photographs([image], boxes, self.camera_matrix, prior)[0]
        camera = self.camera_matrix
        if isinstance(item, Photograph) and camera is not None:
            if not isinstance(camera, Camera):
                self.camera_matrix = Camera(item.K, size=item.size)
            elif camera.size is None:
                self.camera_matrix = replace(camera, size=item.size)
        return item

    def _start(
        self, item: Photograph, T: Tensor, confidence: float, warnings: Sequence[str] = ()
    ) -> None:
        self._tracker.start(item.image, item.K, T)
        self._confirm(confidence, warnings)

    def _confirm(self, confidence: float, warnings: Sequence[str] = ()) -> None:
        """Go on with the confidence of an answer, and what it warns of camera and mesh."""
        self._base = confidence
        self._distance = self._tracker.distance
        self._warn(warnings)
        if confidence >= self._reliable:
            self._unsure = 0

    def _warn(self, warnings: Sequence[str]) -> None:
        """Keep, of the warnings of an answer, those that hold for later frames too."""
        self._warnings = _each_once((*self._warnings, *filter(_is_lasting, warnings)))

    @torch.no_grad()
    def __call__(
        self, image: ImageLike, box: BoxLike | None = None
    ) -> Registration | FailedRegistration:
        """The pose in the next frame, or why there is none.

        Args:
            image: see :class:`Registrar`.
            box: x0, y0, x1, y1 in px of the object, for a frame that is registered; None detects
                it.
        """
        # All of it on one thread: rounding is always the same, and no idle threads of torch compete
        # with it.
        return map_on_threads(lambda image: self._next(image, box), [image])[0]

    def _next(self, image: ImageLike, box: BoxLike | None) -> Registration | FailedRegistration:
        if self._base is None:
            return self._registered(image, box, BELIEVED_CONFIDENCE)
        item = self._read(image)
        if not isinstance(item, Photograph):
            return FailedRegistration(item)
        tracked: TrackedPose | None = None
        with suppress(LostObjectError, ImageError):  # pixels around the last pose may be unusable
            tracked = self._tracker.track(item.image, item.K)
        found = None if tracked is None else self._registration(tracked, item)
        if tracked and found and self._is_trusted(tracked, found):
            self._tracker.accept(tracked)
            return found
        starts = (
            [self._tracker.last_pose]
            if tracked is None
            else [tracked.state.T, self._tracker.last_pose]
        )
        refined = self._refined(item, torch.cat(starts))
        own = 0.0 if found is None else _confidence(found)
        least = min(max(KEPT_CONFIDENCE, own), self._reliable)
        if isinstance(refined, Registration) and _confidence(refined) >= least:
            # track on from it, if it lies within the frame
            with suppress(LostObjectError, ImageError):
                self._tracker.accept(
                    self._tracker.measure(item.image, item.K, refined.projection[0])
                )
                self._confirm(_bounded(refined))
            return refined
        if tracked and found and _confidence(found) >= KEPT_CONFIDENCE:
            self._tracker.accept(tracked)
            # the check has not confirmed it
            self._base = min(_confidence(found), math.nextafter(self._reliable, 0.0))
            warnings = _each_once(found.warnings + self._warnings)
            return replace(found, probabilities=(self._base,), warnings=warnings)
        registered = self._registered(image, box, self._reliable)
        return (
            registered if isinstance(registered, Registration) and registered.reliable else refined
        )

    def _is_trusted(self, tracked: TrackedPose, found: Registration) -> bool:
        """Whether a tracked pose stands without a refinement; counts the frames without a reliable
        pose, and remembers the distance of the last check. In the next frame the tracker, which
        learns from it, finds even a wrong one with certainty."""
        assert self._base is not None
        if _confidence(found) < TRUSTED_CONFIDENCE:
            return False
        if not is_calibrated(self.registrar.pipeline):  # nothing can confirm it
            return True
        if not 1.0 / CHECKED_ZOOM < found.distance / self._distance < CHECKED_ZOOM:
            self._distance = found.distance
            return False
        if self._base >= self._reliable:
            return tracked.confidence >= self._reliable
        self._unsure += 1
        is_power_of_two = self._unsure & (self._unsure - 1) == 0
        return not (self._unsure >= FIRST_CHECK and is_power_of_two)

    def _registered(
        self, image: ImageLike, box: BoxLike | None, least: float
    ) -> Registration | FailedRegistration:
        """Register a frame; track from its pose if it lies within the frame, with a confidence of
        ``least``."""
        item = self._read(image, box, self.prior)
        if not isinstance(item, Photograph):
            return FailedRegistration(item)
        result = self.registrar.register_prepared([item], detects=box is None)[0]
        if isinstance(result, Registration) and (
            _confidence(result) >= least or (self._base is None and self._is_repeated(result))
        ):
            pose, K = result.projection
            with suppress(LostObjectError, ImageError):
                self._start(item.by(K), pose, _bounded(result), result.warnings)
                if self._fits_camera:
                    self.camera_matrix = result.camera
        return result

    def _is_repeated(self, result: Registration) -> bool:
        """Whether a pose that is not believed is about that of the frames before."""
        if _confidence(result) < KEPT_CONFIDENCE:
            self._agreeing = []
            return False
        pose = result.projection[0]
        centre = self.registrar.describer.centre
        if self._agreeing:
            before = self._agreeing[-1]
            at = point_in_cameras(pose, centre)
            moved = torch.linalg.vector_norm(at - point_in_cameras(before, centre))
            turned = float(rotation_error(pose[:3, :3], before[:3, :3]))
            if turned > AGREEING_DEGREES or moved > AGREEING_FRACTION * at.norm():
                self._agreeing = []
        self._agreeing.append(pose)
        return len(self._agreeing) >= AGREEING_FRAMES

    def _refined(self, item: Photograph, starts: Tensor) -> Registration | FailedRegistration:
        """Refined poses, whose warnings hold for later frames too; a registration that is not
        reliable does not raise the confidence."""
        try:
            result = refine_one(self.registrar, item, starts)
        except CurviregError as error:
            return FailedRegistration(error)
        assert self._base is not None
        bound = 1.0 if _confidence(result) >= self._reliable else self._base
        probabilities = tuple(min(p, bound) for p in result.probabilities)
        self._warn(result.warnings)
        warnings = _each_once(result.warnings + self._warnings)
        return replace(result, probabilities=probabilities, warnings=warnings)

    def _registration(self, tracked: TrackedPose, item: Photograph) -> Registration:
        """The result of a tracked pose, without ranking and without rivals."""
        describer = self.registrar.describer
        T = tracked.state.T.clone()  # a tensor like any other, not one of inference mode
        none = torch.zeros(1, dtype=torch.long)
        poses = Hypotheses.at(T, item.K[None], describer.centre, none, none)
        poses = replace(
            poses,
            view=torch.tensor([nearest_view(self.registrar, poses.rotation[0])]),
            edge_support=torch.tensor([tracked.features["edge_support"]]),
            covariance=self._tracker.covariance(tracked)[None],
        )
        hypothesis = hypothesis_of(poses, 0, tracked.features, score="region")
        assert self._base is not None
        probabilities = (self._base * tracked.confidence,)
        warnings = item.warnings + self.registrar.mesh_warnings + self._warnings
        notes = self.registrar.mesh_notes
        features = dict(tracked.features)
        ranking = Ranking.none()
        return Registration(
            (hypothesis,),
            probabilities,
            ranking,
            features,
            warnings=_each_once(warnings),
            notes=notes,
            camera=item.pinhole,
            reliable_from=self._reliable,
        )


def _is_lasting(warning: str) -> bool:
    """Whether a warning is about the camera or the mesh, and holds for other frames too."""
    return warning.startswith((SHOWN_FOCAL_LENGTH, STRETCHED, MIRROR_WARNING))


def _each_once(warnings: Sequence[str]) -> tuple[str, ...]:
    return tuple(texts[0] for texts in kinds_of(warnings).values())


def _bounded(result: Registration) -> float:
    """Confidence with which frames may follow an answer."""
    return min(_confidence(result), result.confidence_bound)


def _confidence(result: Registration) -> float:
    """0 for pipelines without calibration."""
    return result.confidence or 0.0

"""Following an object through the frames of a video."""

from contextlib import suppress
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ..errors import CurviregError, ImageError, InvalidInputError, LostObjectError
from ..geometry import rotation_error
from ..geometry.calibration import Camera
from ..geometry.cameras import point_in_cameras
from ..geometry.pose_prior import PosePrior
from ..matching import Ranking
from ..utils.checks import as_numbers, check_pose, check_probability, check_tensor
from ..utils.likes import ArrayLike, BoxLike, ImageLike
from ..utils.threads import map_on_threads
from .hypotheses import Hypotheses, hypothesis_of
from .inputs import ImageItem, image_items
from .refinement import refine_item
from .registrar import Registrar
from .result import FailedRegistration, Registration
from .target import nearest_view
from .tracker import TrackedPose, Tracker

# Confidence of a tracked pose from which it stands without a refinement, and after one that was no
# better
TRUSTED_CONFIDENCE = 0.5
KEPT_CONFIDENCE = 0.2
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
    registration confirmed. No pose gains confidence from being followed, unless a further
    registration is reliable.

    Args:
        registrar: of one mesh, with a bank of all views; or a mesh, see :class:`Registrar`.
        camera_matrix: (3, 3) in px, or a :class:`Camera`, of all frames. None estimates it, in the
            frames that are registered until one is believed, whose camera is kept; distances are
            then proportional to its focal length.
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
    def start(self, image: ImageLike, pose: ArrayLike, *, confidence: float = 1.0) -> None:
        """Begin from a known pose, in place of registering the first frame.

        Args:
            image: the frame, see :class:`Registrar`.
            pose: (4, 4) rigid ``T_cam_from_model``.
            confidence: probability in [0, 1] that the pose is right; no tracked pose has more,
                unless a registration confirms it. Below 0.5 each frame is checked.

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
        item = image_items([image], None, self.camera_matrix)[0]
        if not isinstance(item, ImageItem):
            raise item
        map_on_threads(lambda item: self._start(item, T, confidence), [item])

    def _start(self, item: ImageItem, T: Tensor, confidence: float) -> None:
        self._tracker.start(item.image, item.K, T)
        self._base = confidence

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
        item = image_items([image], None, self.camera_matrix)[0]
        if not isinstance(item, ImageItem):
            return FailedRegistration(item)
        if self._base is None:
            return self._registered(item, image, box, BELIEVED_CONFIDENCE)
        tracked: TrackedPose | None = None
        with suppress(LostObjectError, ImageError):  # pixels around the last pose may be unusable
            tracked = self._tracker.track(item.image, item.K)
        found = None if tracked is None else self._registration(tracked, item)
        if tracked and found and _confidence(found) >= TRUSTED_CONFIDENCE:
            self._tracker.accept(tracked)
            return found
        starts = (
            [self._tracker.last_pose]
            if tracked is None
            else [tracked.state.T, self._tracker.last_pose]
        )
        refined = self._refined(item, torch.cat(starts))
        if isinstance(refined, Registration) and _confidence(refined) >= (
            0.0 if found is None else _confidence(found)
        ):
            # track on from it, if it lies within the frame
            with suppress(LostObjectError, ImageError):
                self._tracker.accept(
                    self._tracker.measure(item.image, item.K, refined.projection[0])
                )
                self._base = _confidence(refined)
            return refined
        if tracked and found and _confidence(found) >= KEPT_CONFIDENCE:
            self._tracker.accept(tracked)
            self._base = _confidence(found)
            return found
        registered = self._registered(item, image, box, self._reliable)
        return (
            registered if isinstance(registered, Registration) and registered.reliable else refined
        )

    def _registered(
        self, item: ImageItem, image: ImageLike, box: BoxLike | None, least: float
    ) -> Registration | FailedRegistration:
        """Register a frame; track from its pose if it lies within the frame, with a confidence of
        ``least``."""
        result = self.registrar(
            [image], None if box is None else [box], self.camera_matrix, prior=self.prior
        )[0]
        if isinstance(result, Registration) and (
            _confidence(result) >= least or (self._base is None and self._is_repeated(result))
        ):
            pose, K = result.projection
            with suppress(LostObjectError, ImageError):
                self._start(replace(item, camera_matrix=K), pose, _confidence(result))
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

    def _refined(self, item: ImageItem, starts: Tensor) -> Registration | FailedRegistration:
        """Refined poses; a registration that is not reliable does not raise the confidence."""
        try:
            result = refine_item(self.registrar, item, starts)
        except CurviregError as error:
            return FailedRegistration(error)
        assert self._base is not None
        bound = 1.0 if _confidence(result) >= self._reliable else self._base
        return replace(result, probabilities=tuple(min(p, bound) for p in result.probabilities))

    def _registration(self, tracked: TrackedPose, item: ImageItem) -> Registration:
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
        warnings = item.warnings + self.registrar.mesh_warnings
        notes = self.registrar.mesh_notes
        features = dict(tracked.features)
        ranking = Ranking.none()
        return Registration(
            (hypothesis,),
            probabilities,
            ranking,
            features,
            warnings=warnings,
            notes=notes,
            camera=item.camera,
            reliable_from=self._reliable,
        )


def _confidence(result: Registration) -> float:
    """0 for pipelines without calibration."""
    return result.confidence or 0.0

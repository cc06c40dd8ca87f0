"""Following an object through the frames of a video."""

from contextlib import suppress
from typing import Any

import torch
from torch import Tensor

from ..errors import CurviregError, InvalidInputError, LostObjectError
from ..geometry.calibration import Camera
from ..geometry.cameras import rotation_towards
from ..matching import Ranking
from ..utils.checks import as_numbers, check_pose, check_tensor
from ..utils.threads import map_on_threads
from .inputs import ImageItem, image_items
from .refinement import nearest_view, refine_item
from .registrar import Registrar
from .result import FailedRegistration, Hypothesis, Registration
from .tracker import TrackedPose, Tracker

__all__ = ["Follower"]

TRUSTED_CONFIDENCE, KEPT_CONFIDENCE = 0.5, 0.2
"""Tracking confidence from which a tracked pose stands without a refinement, and after one that was no better."""

BELIEVED_CONFIDENCE = 0.5
"""Confidence of a registration from which it is followed; below, the next frame is registered again."""


class Follower:
    """Registers frames one after the other: each starts from the pose of the frame before.

    The first frame is registered, unless :meth:`start` gives its pose, and so is every further one until a pose is
    believed. From then on frames are tracked (docs/method.md). Where tracking is not trusted, contours are fitted
    around its pose (:func:`refine`), and the more certain pose counts; where neither finds the object, the frame is
    registered, and that pose is used only if it is reliable.

    The ``confidence`` of a tracked frame is the probability that its pose is within 10 degrees and 10 % of the distance
    of the truth: the tracker's own, times that of the pose from which tracking began. It never exceeds the latter.

    Args:
        registrar: of one mesh, with a bank of all views; or a mesh, see :class:`Registrar`.
        camera_matrix: (3, 3) in px, or a :class:`Camera`, of all frames.

    Raises:
        InvalidInputError: a registrar of several meshes.

    Example:
        >>> import curvireg_torch as cr
        >>> from curvireg_torch.synthetic import example_mesh
        >>> bank = cr.ViewBank.build(example_mesh(), cr.sample_views(azimuth_step=90), image_size=64, progress=False)
        >>> follow = Follower(cr.Registrar(bank), cr.camera_matrix(150.0, 150.0, 79.5, 59.5))
        >>> follow(torch.rand(3, 120, 160), box=[40, 30, 120, 90]).translation.shape
        torch.Size([3])
    """

    def __init__(self, registrar: Any, camera_matrix: Tensor | Camera) -> None:
        self.registrar = registrar if isinstance(registrar, Registrar) else Registrar(registrar)
        if self.registrar.others:
            raise InvalidInputError("Follower: expected a registrar of one mesh, which is followed, got several")
        self.camera_matrix = camera_matrix
        describer = self.registrar.describer
        self._tracker = Tracker(describer.renderer, describer.contours, describer.hull)
        self._start_confidence = 0.0  # of the pose from which tracking began; 0: there is none

    def start(self, image: Any, pose: Any) -> None:
        """Begin from a known pose, in place of registering the first frame.

        Args:
            image: the frame, see :class:`Registrar`.
            pose: (4, 4) rigid ``T_cam_from_model``.

        Raises:
            InvalidInputError: ``pose`` is not rigid and finite, or the frame cannot be used.
            LostObjectError: at ``pose`` the mesh lies behind the camera, or outside the frame.

        Example:
            >>> import curvireg_torch as cr
            >>> from curvireg_torch.synthetic import example_mesh
            >>> bank = cr.ViewBank.build(example_mesh(), cr.sample_views(azimuth_step=90), progress=False)
            >>> follow = Follower(cr.Registrar(bank), cr.camera_matrix(150.0, 150.0, 79.5, 59.5))
            >>> pose = torch.eye(4)
            >>> pose[2, 3] = 8.0
            >>> follow.start(torch.rand(3, 120, 160), pose)
        """
        T = as_numbers(pose, "pose", dtype=torch.float64)
        check_tensor(T, "pose", (4, 4))
        check_pose(T, "pose")
        item = image_items([image], None, self.camera_matrix)[0]
        if not isinstance(item, ImageItem):
            raise item
        self._start(item, T, 1.0)

    @torch.no_grad()
    def __call__(self, image: Any, box: Any = None) -> Registration | FailedRegistration:
        """The pose in the next frame, or why there is none.

        Args:
            image: see :class:`Registrar`.
            box: x0, y0, x1, y1 in px of the object, for a frame that is registered; None localizes it.
        """
        item = image_items([image], None, self.camera_matrix)[0]
        if not isinstance(item, ImageItem):
            return FailedRegistration(item)
        boxes = None if box is None else [box]
        if not self._start_confidence:
            result = self.registrar([image], boxes, self.camera_matrix)[0]
            if isinstance(result, Registration) and (result.confidence or 0.0) >= BELIEVED_CONFIDENCE:
                self._begin(item, result)
            return result
        tracked = map_on_threads(lambda item: self._track(item), [item])[0]
        found = None if tracked is None else self._registration(tracked, item)
        if tracked and found and tracked.confidence >= TRUSTED_CONFIDENCE:
            self._tracker.accept(tracked)
            return found
        return self._search(item, image, boxes, tracked, found)

    def _begin(self, item: ImageItem, result: Registration) -> None:
        """Track from a registered pose, if it lies within the frame."""
        with suppress(LostObjectError):
            self._start(item, _pose(result), result.confidence or 0.0)

    @torch.no_grad()
    def _start(self, item: ImageItem, T: Tensor, confidence: float) -> None:
        map_on_threads(lambda T: self._tracker.start(item.image, _camera(item), T), [T])
        self._start_confidence = confidence

    def _continue(self, item: ImageItem, result: Registration) -> None:
        """Track on from a pose that the search found, if it lies within the frame."""
        with suppress(LostObjectError):
            pose = map_on_threads(lambda T: self._tracker.measure(item.image, _camera(item), T), [_pose(result)])[0]
            self._tracker.accept(pose)

    def _track(self, item: ImageItem) -> TrackedPose | None:
        try:
            return self._tracker.track(item.image, _camera(item))
        except LostObjectError:
            return None

    def _search(
        self, item: ImageItem, image: Any, boxes: Any, tracked: TrackedPose | None, found: Registration | None
    ) -> Registration | FailedRegistration:
        """The pose in a frame in which tracking ``found`` a doubtful one, or none."""
        starts = [self._tracker.last_pose] if tracked is None else [tracked.T, self._tracker.last_pose]
        limit = self._start_confidence
        result: Registration | FailedRegistration
        try:
            result = map_on_threads(
                lambda T: refine_item(self.registrar, item, T, limit=limit, check=False), [torch.cat(starts)]
            )[0]
        except CurviregError as error:
            result = FailedRegistration(error)
        better = isinstance(result, Registration) and (
            found is None or (result.confidence or 0.0) > (found.confidence or 0.0)
        )
        if better and isinstance(result, Registration):
            self._continue(item, result)
            return result
        if tracked and found and tracked.confidence >= KEPT_CONFIDENCE:
            self._tracker.accept(tracked)
            return found
        registered = self.registrar([image], boxes, self.camera_matrix)[0]
        if isinstance(registered, Registration) and registered.reliable:
            self._begin(item, registered)
            return registered
        return result

    def _registration(self, tracked: TrackedPose, item: ImageItem) -> Registration:
        """The result of a tracked pose, without ranking and without rivals."""
        T, support = tracked.T[0], tracked.features["edge_support"]
        rotation, position = T[:3, :3], T[:3, :3] @ self._tracker.centre + T[:3, 3]
        allocentric = rotation_towards(position).mT @ rotation
        covariance = self._tracker.covariance(tracked)
        hypothesis = Hypothesis(
            rotation=rotation.clone(),
            translation=T[:3, 3].clone(),
            score=tracked.features["region"],
            evidence=tracked.features,
            allocentric_rotation=allocentric,
            distance=float(torch.linalg.vector_norm(position)),
            projection=(T.clone(), _camera(item)),
            view=nearest_view(self.registrar, allocentric),
            edge_support=support,
            covariance=covariance if bool(covariance.isfinite().all()) else None,
        )
        probabilities = (self._start_confidence * tracked.confidence,)
        warnings = item.warnings + self.registrar.mesh_warnings
        return Registration((hypothesis,), probabilities, Ranking.none(), dict(tracked.features), warnings=warnings)


def _camera(item: ImageItem) -> Tensor:
    """(3, 3) float64."""
    assert item.camera_matrix is not None
    return item.camera_matrix.double()


def _pose(result: Registration) -> Tensor:
    """(4, 4) of a result with a camera matrix."""
    assert result.transform is not None
    return result.transform

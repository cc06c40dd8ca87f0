"""The entry point: photographs, boxes and a mesh in; poses out."""

import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..errors import CurviregError, InvalidInputError
from ..fitting.edges import EdgeCrops
from ..fitting.landmarks import MIN_LANDMARKS, LandmarkMatches, Landmarks
from ..fitting.measured_fit import measure_contours
from ..geometry.pose_prior import PosePrior
from ..geometry.viewpoint import ViewSphere
from ..matching import ViewBank, ViewDescriber, ViewMatcher, cached_bank
from ..mesh import has_colours, mesh_symmetries, mesh_warnings
from ..pipeline import BankSettings, Pipeline
from ..rendering import DepthRenderer
from ..terms import QueryFeatures
from ..utils.checks import check_device, check_option, check_symmetries
from ..utils.choices import MESH_KINDS
from ..utils.precision import in_full_precision
from ..utils.threads import map_on_threads
from .confidence import are_near
from .detection import Detector, detect_item
from .focal import FINISHED
from .inputs import ImageItem, check_crop, image_items
from .judging import Work, better_of, flat_mesh_warnings, judged
from .poses import (
    FINISHED_FITS,
    SCREENING_WEIGHT,
    Poses,
    best_views,
    common_score,
    compare_with_photograph,
    distinct_poses,
    fit_poses,
    fit_texture_of,
    landmark_evidence,
    pose_features,
    pose_scores,
    projected_box,
    with_edge_support,
    with_quick_fit,
)
from .refinement import nearest_view, refine
from .refits import best_inside, fitted_again
from .result import FailedRegistration, Registration
from .search import search
from .several import register_views
from .siblings import telling_symmetries, with_siblings
from .unknown_camera import (
    limits_of,
    with_fitted_focal_lengths,
    with_focal_deviation,
    with_possible_cameras,
)

__all__ = ["Registrar"]

MIN_REFINED = 3
"""Minimum number of hypotheses to refine, even if fewer are reported: the confidence depends on
rivals. Of 15 photographs of another object, 14 were called reliable with one hypothesis, 2 with
two, none with three or five."""

SCREENED_VIEWS = 10
"""Number of the best distinct views of an exact mesh that get a short contour fit, which decides
with their rank which become hypotheses."""

# Fraction of the landmarks that agree with a start, which must agree with its fit as well
KEPT_LANDMARKS = 0.5

Results = list[Registration | FailedRegistration]

_SHAPE_LOCK = threading.Lock()


class Registrar:
    """Registers photographs to a mesh, or to the best of several.

    The views of the bank are ranked for each box; of the best distinct ones the most promising
    become hypotheses, to which contours are fitted (:func:`fit_contours`), and whose evidence
    decides their order. With a camera matrix the result is rotation and translation with their
    covariance; without, the rotation.

    Args:
        bank_or_mesh: a :class:`ViewBank`, a :class:`ViewMatcher`, a mesh, its path, or a list of
            meshes or paths, of which the best is reported, with its number as ``model``; the bank
            of a mesh is read from the disk cache or built.
        pipeline: all settings; default that of a bank, else ``Pipeline()``.
            ``replace(pipeline, contours=False)`` reports views of the bank,
            ``replace(pipeline, hypotheses=k)`` k hypotheses.
        views, settings: custom viewpoints and bank settings, for a mesh.
        field: custom photograph filter, see :class:`ViewMatcher`.
        renderer: for views of the mesh and a bank that is built; a custom renderer knows one mesh.
        mesh_is: "exact" for the mesh of this very object (None: the same), "similar" for that of
            another one of its kind. It decides how far fitted contours are trusted, and the
            probabilities of the hypotheses; a focal length is estimated with an exact mesh alone.
        symmetries: (S, 4, 4) of the mesh, from :func:`curvireg_torch.geometry.symmetry_transforms`;
            hypotheses that differ by one of them are reported once. Default: those of the shape of
            an exact mesh without colours, see :func:`curvireg_torch.mesh.mesh_symmetries`;
            ``torch.eye(4)[None]`` for none.
        device: of modules, bank and search.
        progress: True shows bars. A callback gets (stage, done, total), with the stages "detection"
            (without a box), "bank", "ranking", "search" and "contours"; to cancel, it may raise
            what is no :class:`CurviregError`. On a CPU photographs are registered in parallel:
            callback, custom renderer and custom field are then called from several threads.

    Example:
        >>> import trimesh
        >>> from curvireg_torch.geometry import sample_views
        >>> bank = ViewBank.build(trimesh.creation.box((1, 2, 3)), sample_views(azimuth_step=45,
        ...     elevations=[20]),
        ...                       image_size=64, progress=False)
        >>> result = Registrar(bank)(torch.rand(1, 3, 48, 64), torch.tensor([[4.0, 4, 40, 30]]))[0]
        >>> result.rotation.shape, result.translation.shape, result.camera.source
        (torch.Size([3, 3]), torch.Size([3]), 'estimated')
    """

    def __init__(
        self,
        bank_or_mesh: Any,
        *,
        pipeline: Pipeline | None = None,
        views: ViewSphere | None = None,
        settings: BankSettings | None = None,
        field: nn.Module | None = None,
        renderer: str | DepthRenderer = "auto",
        mesh_is: str | None = None,
        symmetries: Tensor | None = None,
        device: torch.device | str | None = None,
        progress: bool | Callable[[str, int, int], object] = False,
    ) -> None:
        if device is not None:
            check_device(device)
        if mesh_is is not None:
            check_option(mesh_is, MESH_KINDS, "mesh_is")
        if symmetries is not None:
            check_symmetries(symmetries)
        self.others: list[Registrar] = []
        if isinstance(bank_or_mesh, list | tuple):
            meshes = list(bank_or_mesh)
            if not meshes:
                raise InvalidInputError("Registrar: expected a mesh or several, got an empty list")
            if len(meshes) > 1 and not isinstance(renderer, str):
                raise InvalidInputError(
                    f"renderer: a custom renderer knows one mesh, got {len(meshes)}; give a name"
                )
            same: dict[str, Any] = {
                "pipeline": pipeline,
                "views": views,
                "settings": settings,
                "field": field,
            }
            same |= {
                "renderer": renderer,
                "mesh_is": mesh_is,
                "symmetries": symmetries,
                "device": device,
            }
            self.others = [Registrar(mesh, **same, progress=progress) for mesh in meshes[1:]]
            bank_or_mesh = meshes[0]
        self.matcher: ViewMatcher = bank_or_mesh
        if isinstance(bank_or_mesh, ViewMatcher):
            if any(value is not None for value in (pipeline, field, views, settings)):
                raise InvalidInputError(
                    "Registrar: pipeline, field, views and settings belong to the matcher"
                )
        else:
            if not isinstance(bank := bank_or_mesh, ViewBank):
                pipeline = pipeline or Pipeline()
                pipeline = replace(pipeline, bank=settings or pipeline.bank)
                built: dict[str, Any] = {
                    "pipeline": pipeline,
                    "renderer": renderer,
                    "progress": progress,
                    "device": device or "cpu",
                }
                bank = cached_bank(bank_or_mesh, views, **built)
            elif views is not None or settings is not None:
                raise InvalidInputError(
                    "Registrar: views and settings belong to the bank; give them with a mesh only"
                )
            bank = bank if device is None else bank.to(device)
            options: dict[str, Any] = {"pipeline": pipeline, "field": field, "renderer": renderer}
            # Built on one thread, so that rounding does not depend on the number of threads.
            self.matcher = map_on_threads(lambda bank: ViewMatcher(bank, **options), [bank])[0]
        self.bank = self.matcher.bank
        self.pipeline = self.matcher.pipeline
        self.mesh_is = mesh_is
        self.symmetries = symmetries
        self.progress = progress

    @torch.no_grad()
    @in_full_precision
    def __call__(
        self,
        images: Tensor | Sequence[Any],
        boxes: Any | None = None,
        camera_matrices: Any | None = None,
        *,
        prior: PosePrior | Sequence[PosePrior | None] | None = None,
        masks: Any | None = None,
    ) -> Results:
        """Register a batch.

        Args:
            images: (B, C, H, W) or a list of (C, H, W) tensors, (H, W, C) arrays, Pillow pictures
                or paths, C = 1 or 3 (RGB), floating in [0, 1] or uint8. Pictures and files are
                turned as their EXIF data say.
            boxes: (B, 4) x0, y0, x1, y1 in px; None searches for the object, see :func:`detect`.
            camera_matrices: (B, 3, 3) or (3, 3) in px, a :class:`Camera`, or a list of these. None:
                the camera of the EXIF data; without, its focal length is estimated with the pose,
                or with a similar mesh, rotations are relative to a camera that looks at the box.
            prior: what is known of the poses in advance, one for all photographs or a list.
            masks: B masks (H, W) of the objects, white in bool, uint8 or floating in [0, 1], paths,
                or None for some photographs with boxes. Contours are fitted to them; without boxes
                they give these.

        Returns:
            A :class:`Registration` for each photograph; a :class:`FailedRegistration` for one that
            cannot be registered (unreadable, box empty or outside, one colour, NaN) or, without a
            box, that does not show the object convincingly; it raises its error on access to a
            pose.

        Raises:
            InvalidInputError: not as many boxes, cameras, priors or masks as images.
        """
        items = image_items(images, boxes, camera_matrices, prior, masks)
        return self.register_items(items, detects=boxes is None and masks is None)

    @torch.no_grad()
    @in_full_precision
    def register_items(
        self, items: Sequence[ImageItem | CurviregError], *, detects: bool = False
    ) -> Results:
        """Register photographs that :func:`.inputs.image_items` has prepared, each to the best of
        the meshes; ``detects`` searches for the object in the whole photographs.

        :meta private:
        """
        for other in self.others:
            other.share()

        def register(item: ImageItem, index: int) -> Registration | FailedRegistration:
            best = self._result_of(item, index, detects=detects)
            for model, other in enumerate(self.others, 1):
                rival = other._result_of(item, index, detects=detects)
                best = better_of(best, rival, model)
            return best

        if detects:
            for registrar in (self, *self.others):
                _ = registrar.detector  # created once, before threads use it
        results: Results = self.map_items(items, register)
        return results

    def _result_of(
        self, item: ImageItem, index: int, *, detects: bool
    ) -> Registration | FailedRegistration:
        """The registration of a photograph to this mesh alone, or why there is none."""
        try:
            if detects:
                return detect_item(self, item, index)[0]
            return self.register_item(item)
        except CurviregError as error:
            return FailedRegistration(error.with_subject("").of_image(index))

    @in_full_precision
    def refine(self, images: Tensor | Sequence[Any], camera_matrices: Any, poses: Any) -> Results:
        """Refine known poses of the first mesh, see :func:`curvireg_torch.registration.refine`."""
        return refine(self, images, camera_matrices, poses)

    @in_full_precision
    def register_views(
        self, images: Sequence[Any], boxes: Any, camera_matrices: Any, T_cam_from_world: Any
    ) -> Registration:
        """Register photographs of one object together, see
        :func:`curvireg_torch.registration.register_views`."""
        given = images, boxes, camera_matrices, T_cam_from_world
        result: Registration | FailedRegistration
        try:
            result = register_views(self, *given)
        except CurviregError as error:
            if not self.others:
                raise
            result = FailedRegistration(error)
        for model, other in enumerate(self.others, 1):
            with suppress(CurviregError):  # that of the first mesh is raised if all fail
                result = better_of(result, other.register_views(*given), model)
        if isinstance(result, FailedRegistration):
            raise result.error
        return result

    def of_model(self, model: int) -> "Registrar":
        """Return the registrar of one of several meshes, by :attr:`Registration.model`."""
        return self.others[model - 1] if model else self

    def with_hypotheses(self, count: int) -> "Registrar":
        """The same registrar with at least ``count`` hypotheses, of which a joint result needs more
        than it reports.

        :meta private:
        """
        if self.pipeline.hypotheses >= count:
            return self
        _ = self.describer  # shared
        other = copy(self)
        other.pipeline = replace(self.pipeline, hypotheses=count)
        return other

    @property
    def is_exact(self) -> bool:
        """Whether the mesh counts as that of this very object."""
        return self.mesh_is != "similar"

    def symmetries_of(self, *, exact: bool) -> Tensor | None:
        """(S, 4, 4) that were given, or those of the shape of an exact mesh; None if there are
        none."""
        if not exact or self.symmetries is not None:
            return self.symmetries
        with _SHAPE_LOCK:  # photographs share them
            return None if has_colours(self.bank.mesh) else mesh_symmetries(self.bank.mesh)

    @property
    def uses_landmarks(self) -> bool:
        """Whether landmarks give starts and evidence: with an exact mesh and the contour fit."""
        return self.is_exact and self.pipeline.contours

    def landmark_matches(
        self, item: ImageItem, box: Tensor | None = None
    ) -> LandmarkMatches | None:
        """Landmarks of the mesh's print in a photograph, or in a ``box`` (4,) of it; None without
        colours or a camera matrix.

        :meta private:
        """
        if not self.describer.draws_colours or item.camera_matrix is None:
            return None
        with _SHAPE_LOCK:  # photographs share them
            landmarks = self._landmarks
        return landmarks.matches(item.image, item.camera_matrix, box)

    def landmark_poses(self, matches: LandmarkMatches | None) -> tuple[Poses, Tensor]:
        """Poses on which landmarks agree, as promising as the best view, and how many, the largest
        number first.

        :meta private:
        """
        found = [] if matches is None else matches.poses()
        T = (
            torch.stack([pose.T for pose in found])
            if found
            else torch.zeros(0, 4, 4, dtype=torch.float64)
        )
        K = torch.eye(3, dtype=torch.float64) if matches is None else torch.from_numpy(matches.K)
        none = torch.zeros(len(T))
        poses = Poses.at(
            T, K.expand(len(T), 3, 3), self.describer.centre, none.long(), none.double()
        )
        views = torch.tensor([nearest_view(self, R) for R in poses.rotation], dtype=torch.long)
        return replace(poses, view=views), torch.tensor([float(pose.count) for pose in found])

    @cached_property
    def _landmarks(self) -> Landmarks:
        return Landmarks(self.describer)

    @cached_property
    def telling_symmetries(self) -> Tensor:
        """(K, 4, 4) symmetries of the shape of an exact mesh whose poses are compared; the identity
        alone if they are given, and trusted."""
        symmetries = self.symmetries_of(exact=True)
        if self.symmetries is not None or symmetries is None:
            return torch.eye(4, dtype=torch.float64)[None]
        return telling_symmetries(self.bank.mesh, symmetries)

    @cached_property
    def mesh_warnings(self) -> tuple[str, ...]:
        """What makes every pose of this mesh questionable, in words."""
        return flat_mesh_warnings(self.bank.mesh)

    @property
    def mesh_notes(self) -> tuple[str, ...]:
        """What the mesh lacks, in words: see :func:`curvireg_torch.mesh.mesh_warnings`."""
        return tuple(warning.text for warning in mesh_warnings(self.bank.mesh))

    @cached_property
    def describer(self) -> ViewDescriber:
        """Renderer, contours and descriptor of the mesh, on a grid twice as fine as the bank's."""
        settings = self.bank.settings
        return self.matcher.describer.with_settings(
            replace(settings, grid=min(2 * settings.grid, settings.image_size))
        )

    @cached_property
    def detector(self) -> Detector:
        """Proposes boxes where none are given."""
        # one thread: rounding is always the same
        return map_on_threads(lambda _: Detector(self.matcher), [0])[0]

    def report_progress(self, stage: str) -> None:
        """Call the progress callback, if there is one."""
        if callable(self.progress):
            self.progress(stage, 0, 1)

    def share(self) -> None:
        """Create what threads share once, before they use it.

        :meta private:
        """
        _ = self.describer.contours, self.mesh_warnings
        _ = self.is_exact and self.telling_symmetries

    def map_items(
        self, items: Sequence[ImageItem | CurviregError], function: Callable[[ImageItem, int], Any]
    ) -> list[Any]:
        """Results of ``function(item, index)`` for all items, a :class:`FailedRegistration` for
        each error.

        On a CPU each photograph has a thread, in which torch uses no further ones: its result is
        the same to the bit, whatever else is registered. Items are read on demand, so that few
        photographs are in memory.
        """
        self.share()

        def run(index: int) -> Any:
            item = items[index]
            if not isinstance(item, ImageItem):
                return FailedRegistration(item)
            try:
                return function(item, index)
            except CurviregError as error:
                return FailedRegistration(error.with_subject("").of_image(index))

        return map_on_threads(run, range(len(items)), device=self.bank.device)

    def register_item(self, item: ImageItem) -> Registration:
        """Register a photograph with a box, and again if its pose asks for another box."""
        result = self._register_box(item)
        # Without a camera, poses are derived from their boxes.
        if self.pipeline.box_jitter and self.pipeline.contours and result.camera is not None:
            box = projected_box(self.describer, result.projection)
            if item.shows_other_part(box):
                with suppress(CurviregError):
                    again = self._register_box(replace(item, box=box.float()))
                    if common_score(again.hypotheses[0]) > common_score(result.hypotheses[0]):
                        result = replace(again, corrected_box=box)
        return result

    def _register_box(self, item: ImageItem) -> Registration:
        query = self.matcher.query([item.image], item.box[None])
        check_crop(query.crops[0])
        return self.register(item, query)

    @torch.no_grad()
    def register(self, item: ImageItem, query: QueryFeatures) -> Registration:
        """Register a photograph: rank, fit, judge, report.

        Args:
            item: the photograph.
            query: the same, cropped and described by the matcher.
        """
        work = self._rank(item, query)
        if work.exact and item.camera_matrix is None:
            work = with_possible_cameras(self, work)
        if self.pipeline.search:
            return self._searched(work)
        starts, outside, repeated = self._starts(work)
        poses = starts
        if work.crops is not None:
            self.report_progress("contours")
            unknown = poses.quick[:, 0, 0].isnan().nonzero()[:, 0]
            if len(unknown):
                poses = poses.replaced(
                    unknown, with_quick_fit(self.describer, work.crops, poses[unknown])[0]
                )
            finish = FINISHED_FITS if work.starts is None else FINISHED
            poses = self.fitted(work, work.crops, poses, quick=poses.quick, finish=finish)
        features = self.features_of(work, poses)
        sibling: tuple[Poses, Tensor] | None = None
        if work.crops is not None and work.exact:
            if work.item.focal_deviation:
                poses, features = with_fitted_focal_lengths(
                    self, work, work.crops, poses, features, outside
                )
            poses, features = fitted_again(self, work, work.crops, poses, features, outside)
            poses, features, sibling = with_siblings(
                self, work, work.crops, poses, features, outside
            )
            poses, features = self._with_texture(work, work.crops, poses, features, outside)
        inside = (~outside).nonzero()[:, 0]
        scores = pose_scores(features[inside], exact=work.exact)
        distinct = outside.index_copy(
            0, inside, distinct_poses(poses[inside], scores, work.symmetries)
        )
        # Unlike another view, these started near the pose that they merged with: they are no
        # rivals.
        other = (distinct | ~repeated).nonzero()[:, 0]
        starts = starts[other]
        poses = poses[other]
        features = features[other]
        distinct = distinct[other]
        outside = outside[other]
        keep = self._kept(work, poses, distinct, outside)
        if not bool(keep.all()):
            # Poses that merged, or whose fit is not trusted, go back to the views that they started
            # from.
            back = (~keep).nonzero()[:, 0]
            restored = starts[back]
            if work.crops is not None:
                restored = with_edge_support(self.describer, work.crops, restored)
            poses = poses.replaced(back, restored)
            features = features.index_copy(0, back, self.features_of(work, restored))
        if work.crops is not None and work.item.focal_deviation:
            work, poses = with_focal_deviation(self, work, work.crops, poses, features, outside)
        if sibling is not None:
            poses = Poses.cat([poses, sibling[0]])
            features = torch.cat([features, sibling[1]])
            distinct = F.pad(distinct, (0, 1), value=True)
            outside = F.pad(outside, (0, 1))
        return judged(self, work, poses, features, distinct, outside)

    def _rank(self, item: ImageItem, query: QueryFeatures) -> Work:
        self.report_progress("ranking")
        exact = self.is_exact
        limits = None if item.prior is None else limits_of(self, item)
        ranking = self.matcher.rank(query, None if limits is None else limits.allowed()[None])
        symmetries = self.symmetries_of(exact=exact)
        crops = None
        if self.pipeline.contours:
            mask = self.object_mask(query, [item])
            crops = EdgeCrops.cut([item.image], item.box[None], self.bank.settings.margin, mask)
        landmarks = self.landmark_matches(item, item.box) if self.uses_landmarks else None
        descriptor = self.describer.descriptor(query.field)
        return Work(item, query, ranking, descriptor, limits, exact, symmetries, crops, landmarks)

    def _starts(self, work: Work) -> tuple[Poses, Tensor, Tensor]:
        """Poses of the most promising distinct views, and (H,) bool: which lies outside the limits,
        the last one at most, and which repeats another one: the same view with another camera, or a
        pose that landmarks agree on, in place of the views near it.

        That outside is the best view there; it is never reported, and tells whether the limits are
        wrong.
        """
        poses = self._promising(work) if work.starts is None else work.starts
        repeated = _are_repeated(poses.view)
        if work.crops is not None and work.exact:
            found, _ = self.landmark_poses(work.landmarks)
            found = found if work.limits is None else found[work.limits.keeps(found)]
            if len(found):
                far = ~are_near(poses.rotation, found.rotation[0], work.symmetries)
                poses = Poses.cat([poses[far], found[torch.tensor([0])]])
                repeated = F.pad(repeated[far], (0, 1), value=True)
        outside = torch.zeros_like(repeated)
        if work.limits is None:
            return poses, outside, repeated
        assert work.ranking.outside is not None
        view = work.ranking.outside.cpu()
        if int(view) < 0:
            return poses, outside, repeated
        other = self.poses_of_views(work, view, torch.zeros(1, dtype=torch.float64))
        return (
            Poses.cat([poses, other]),
            F.pad(outside, (0, 1), value=True),
            F.pad(repeated, (0, 1)),
        )

    @property
    def least_starts(self) -> int:
        return max(MIN_REFINED, self.pipeline.hypotheses)

    def _promising(self, work: Work) -> Poses:
        """Poses of the most promising distinct views."""
        count = self.least_starts
        screened = max(SCREENED_VIEWS, count) if work.crops is not None and work.exact else count
        view, rank = best_views(work.ranking, self.bank, count=screened, symmetries=work.symmetries)
        poses = self.poses_of_views(work, view, rank)
        if work.limits is not None:
            poses = work.limits.moved_inside(poses)
        if work.crops is not None and len(poses) > count:
            poses = self._screened(work.crops, poses, count)
        return poses

    def _searched(self, work: Work) -> Registration:
        """The result of the paper's search, and further distinct views of the ranking, in its
        order."""
        self.report_progress("search")
        view, rank = best_views(
            work.ranking, self.bank, count=self.pipeline.hypotheses, symmetries=work.symmetries
        )
        rotation, distance = search(self.matcher, work.query, work.ranking)
        found = self._in_box(work, rotation[None], distance[None], view[:1], rank[:1])
        poses = self.poses_of_views(work, view, rank).replaced(torch.tensor([0]), found)
        if work.limits is not None:
            poses = work.limits.moved_inside(poses)
        distinct = torch.ones(len(poses), dtype=torch.bool)
        by_rank = replace(work, exact=False)
        return judged(self, by_rank, poses, self.features_of(work, poses), distinct, ~distinct)

    def _screened(self, crops: EdgeCrops, poses: Poses, count: int) -> Poses:
        """The ``count`` poses with the largest sum of rank and weighted edge support after a short
        fit, best first."""
        poses, support = with_quick_fit(self.describer, crops, poses)
        score = poses.rank + SCREENING_WEIGHT * support
        return poses[score.argsort(descending=True, stable=True)[:count]]

    def poses_of_views(self, work: Work, view: Tensor, rank: Tensor) -> Poses:
        return self._in_box(
            work,
            self.bank.rotations.cpu()[view].double(),
            self.bank.distances.cpu()[view],
            view,
            rank,
        )

    def _in_box(self, work: Work, *poses: Tensor) -> Poses:
        return Poses.in_box(self.describer, work.item.box, work.item.camera_matrix, *poses)

    def object_mask(self, query: QueryFeatures, items: Sequence[ImageItem]) -> Tensor | None:
        """(B, 1, S, S) probability that pixels of the crops belong to the object: given, predicted,
        or None."""
        settings = self.bank.settings
        masks = [item.mask_crop(settings.image_size, settings.margin) for item in items]
        if query.mask is not None:
            pairs = zip(masks, query.mask.split(1), strict=True)
            masks = [predicted if given is None else given for given, predicted in pairs]
        known = next((mask for mask in masks if mask is not None), None)
        if known is None:
            return None
        return torch.cat(
            [torch.ones_like(known) if mask is None else mask.to(known) for mask in masks]
        )

    def features_of(self, work: Work, poses: Poses) -> Tensor:
        """(H, F) :data:`POSE_FEATURES`."""
        given = work.query, work.descriptor, work.ranking
        similarity, appearance = compare_with_photograph(
            self, *given, poses.rotation, poses.distance
        )
        landmarks = (
            None
            if work.landmarks is None
            else landmark_evidence(work.landmarks.agreeing(poses.T, poses.cameras))
        )
        return pose_features(poses, similarity, appearance, landmarks)

    def fitted(self, work: Work, crops: EdgeCrops, starts: Poses, **options: Any) -> Poses:
        """Fit the contours of ``starts``; one keeps its pose if the fit leaves the landmarks that
        agree with it."""
        poses = fit_poses(self.describer, crops, starts, **options)
        if work.landmarks is not None:
            before = work.landmarks.agreeing(starts.T, starts.cameras)
            after = work.landmarks.agreeing(poses.T, poses.cameras)
            left = ((before >= MIN_LANDMARKS) & (after < KEPT_LANDMARKS * before)).nonzero()[:, 0]
            if len(left):
                kept = starts[left]
                seen = measure_contours(
                    self.describer.contours, crops, kept.cameras, kept.T, kept.crop_index
                )
                poses = poses.replaced(left, kept.with_fit(seen, self.describer.centre))
        return poses

    def _with_texture(
        self, work: Work, crops: EdgeCrops, poses: Poses, features: Tensor, outside: Tensor
    ) -> tuple[Poses, Tensor]:
        """Fit the best pose to the mesh's colours as well."""
        best = best_inside(features, outside)
        fitted = fit_texture_of(self.describer, crops, poses, int(best))
        if fitted is None:
            return poses, features
        return self.replaced(work, poses, features, best, fitted, self.features_of(work, fitted))

    def replaced(
        self, work: Work, poses: Poses, features: Tensor, index: Tensor, fitted: Poses, new: Tensor
    ) -> tuple[Poses, Tensor]:
        """Put ``fitted`` poses with ``new`` features in the places ``index``, unless that exceeds
        the limits."""
        if work.limits is not None and not bool(work.limits.keeps(fitted)):
            return poses, features
        return poses.replaced(index, fitted), features.index_copy(0, index, new)

    def _kept(self, work: Work, poses: Poses, distinct: Tensor, outside: Tensor) -> Tensor:
        """(H,) bool: poses that do not return to their views."""
        kept = distinct
        if self.pipeline.contours and not work.exact:
            # Where the contours of a similar object do not fit, the view has the smaller error.
            kept = kept & poses.fit.trustworthy
        return kept if work.limits is None else kept & (work.limits.keeps(poses) | outside)


def _are_repeated(views: Tensor) -> Tensor:
    """(H,) bool: whether a view (H,) is among those before it."""
    equal = views == views[:, None]
    return equal.tril(diagonal=-1).any(dim=1)

"""The stages of a registration, from photographs with boxes to poses."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from ..errors import CurviregError
from ..features.learned_field import LearnedCurvilinearSaliency
from ..matching import Ranking, ViewDescriber, ViewMatcher
from ..mesh import has_colours, mesh_symmetries
from ..terms import QueryFeatures
from ..utils.checks import check_option
from ..utils.choices import MESH_KINDS
from ..utils.threads import map_on_threads
from .answer_set import answer_set
from .calibration import CALIBRATION
from .confidence import confidence_features, confidence_model, model_name, ranking_evidence, ranking_features
from .hypotheses import Hypotheses, distinct_mask, start_hypotheses
from .inputs import ImageItem, check_crop
from .locator import Locator
from .poses import Poses, edge_supports, fit_poses, fit_texture_of, hypothesis_of, lift_to_poses
from .priors import BatchPriors
from .rescoring import rank_feature, rescore, similarities
from .results import FailedRegistration, Registration
from .search import search

__all__ = ["PoseEstimator"]

LEAST = 3
"""Hypotheses that are refined at least, even if fewer are reported: the confidence depends on rivals. Of 15 photographs
of another object, 14 were called reliable with one hypothesis, 2 with two, none with three or five."""

_SYMMETRIES_LOCK = threading.Lock()


@dataclass(frozen=True)
class _Batch:
    """B photographs: boxes (B, 4) float64 px, cameras (B, 3, 3) or None, descriptors (B, D) on the search's grid."""

    images: list[Tensor]
    boxes: Tensor
    camera_matrices: Tensor | None
    query: QueryFeatures
    ranking: Ranking
    descriptors: Tensor
    priors: BatchPriors | None
    exact: bool
    symmetries: Tensor | None

    def scores(self, evidence: Tensor) -> Tensor:
        return rescore(evidence, exact=self.exact)


class PoseEstimator:
    """Registers photographs with boxes: rank, search, fit contours, rescore.

    Args:
        matcher: of the bank; its pipeline decides all results.
        mesh_is: "exact" or "similar", see :class:`Registrar`.
        symmetries: (S, 4, 4) of the mesh, see :class:`Registrar`.
        progress: called with (stage, done, total) if it is a function.
    """

    def __init__(
        self,
        matcher: ViewMatcher,
        *,
        mesh_is: str | None = None,
        symmetries: Tensor | None = None,
        progress: bool | Callable[[str, int, int], object] = False,
    ) -> None:
        self.matcher, self.bank, self.pipeline = matcher, matcher.bank, matcher.pipeline
        if mesh_is is not None:
            check_option(mesh_is, MESH_KINDS, "mesh_is")
        self.mesh_is = mesh_is
        self.symmetries, self.progress = symmetries, progress

    def is_exact(self, *, with_camera: bool) -> bool:
        """Whether the mesh counts as that of this very object."""
        return self.mesh_is == "exact" if self.mesh_is else with_camera

    def symmetries_of(self, *, exact: bool) -> Tensor | None:
        """(S, 4, 4) that were given, or those of the shape of an exact mesh; None if there are none."""
        if not exact or self.symmetries is not None:
            return self.symmetries
        with _SYMMETRIES_LOCK:
            return self._shape_symmetries

    @cached_property
    def _shape_symmetries(self) -> Tensor | None:
        meshes = self.bank.meshes
        return None if len(meshes) > 1 or has_colours(meshes[0]) else mesh_symmetries(meshes[0])

    @cached_property
    def describers(self) -> tuple[ViewDescriber, ...]:
        """Renderer and descriptor of each model, on a grid twice as fine as the bank's."""
        fine = replace(self.bank.settings, grid=min(2 * self.bank.settings.grid, self.bank.settings.image_size))
        return tuple(coarse.with_settings(fine) for coarse in self.matcher.describers)

    @cached_property
    def locator(self) -> Locator:
        """Proposes boxes where none are given."""
        return map_on_threads(lambda _: Locator(self.matcher), [0])[0]  # one thread: rounding is always the same

    def report_progress(self, stage: str) -> None:
        if callable(self.progress):
            self.progress(stage, 0, 1)

    def map_items(
        self,
        items: Sequence[ImageItem | CurviregError],
        function: Callable[[Sequence[ImageItem | CurviregError], int], list[Any]],
    ) -> list[Any]:
        """Results of ``function(some items, index of the first)`` for all items, in their order.

        On a CPU each photograph has a thread, in which torch uses no further ones: its result is the same to the bit,
        whatever else is registered. On a GPU the matcher's ``chunk_size`` are registered at a time.
        """
        size = 1 if self.bank.device.type == "cpu" else self.matcher.chunk_size
        # Create once what threads share, before they use it; symmetries have a lock. Items are read on demand: asking
        # for them here would decode every photograph twice, and keep all of them in memory.
        _ = self.describers, self.matcher.describers

        def run(first: int) -> list[Any]:
            return function(items[first : first + size], first)

        parts = map_on_threads(run, range(0, len(items), size), device=self.bank.device)
        return [result for part in parts for result in part]

    def register_items(
        self, items: Sequence[ImageItem | CurviregError], *, first: int = 0
    ) -> list[Registration | FailedRegistration]:
        """Results of photographs or errors, the first of which has the index ``first``; boxes are not corrected."""
        results: list[Any] = [item if isinstance(item, ImageItem) else FailedRegistration(item) for item in items]
        usable = [i for i, item in enumerate(items) if isinstance(item, ImageItem)]
        if usable:
            boxes = torch.stack([results[i].box for i in usable])
            query = self.matcher.query([results[i].image for i in usable], boxes)
            for i, crop in zip(usable, query.crops, strict=True):
                try:
                    check_crop(crop)
                    if results[i].prior is not None:
                        BatchPriors([results[i]], self.bank).log_prior(self.bank)
                except CurviregError as error:
                    results[i] = FailedRegistration(error.with_subject(f"image {first + i}"))
            rows = [row for row, i in enumerate(usable) if isinstance(results[i], ImageItem)]
            if rows:
                registered = self.register([results[usable[row]] for row in rows], query[torch.tensor(rows)])
                for row, result in zip(rows, registered, strict=True):
                    results[usable[row]] = result
        return results

    @torch.no_grad()
    def register(
        self, items: Sequence[ImageItem], query: QueryFeatures, ranking: Ranking | None = None
    ) -> list[Registration]:
        """All stages after cropping.

        Args:
            items: B photographs, all with a camera matrix or all without.
            query: the same, cropped and described by the matcher.
            ranking: of the same; default :meth:`ViewMatcher.rank`.
        """
        batch = self._rank(items, query, ranking)
        count = max(LEAST, self.pipeline.hypotheses)
        starts = start_hypotheses(batch.ranking, self.bank, count=count, symmetries=batch.symmetries)
        starts = starts if batch.priors is None else batch.priors.moved_inside(starts)
        hypotheses = self._search(batch, starts) if self.pipeline.search else starts
        poses = self._lift(batch, hypotheses)
        if self.pipeline.contours:
            self.report_progress("contours")
            poses = fit_poses(self.describers, batch.images, poses, batch.boxes, self.object_mask(query))
        evidence = self._evidence(batch, starts, poses)
        if self.pipeline.contours and batch.exact:
            poses, evidence = self._fit_textures(batch, starts, poses, evidence)
        distinct = distinct_mask(poses.hypotheses, batch.scores(evidence), symmetries=batch.symmetries)
        poses, evidence = self._restore(batch, starts, poses, evidence, distinct)
        results = self._results(batch, poses, evidence, distinct)
        return [replace(result, warnings=item.warnings) for result, item in zip(results, items, strict=True)]

    def _rank(self, items: Sequence[ImageItem], query: QueryFeatures, ranking: Ranking | None) -> _Batch:
        self.report_progress("ranking")
        matrices = [item.camera_matrix for item in items if item.camera_matrix is not None]
        priors = BatchPriors(items, self.bank) if any(item.prior is not None for item in items) else None
        if ranking is None:
            ranking = self.matcher.rank(query, None if priors is None else priors.log_prior(self.bank))
        exact = self.is_exact(with_camera=bool(matrices))
        return _Batch(
            images=[item.image for item in items],
            boxes=torch.stack([item.box for item in items]).double(),
            camera_matrices=torch.stack(matrices) if matrices else None,
            query=query,
            ranking=ranking,
            descriptors=self.describers[0].descriptor(query.field),
            priors=priors,
            exact=exact,
            symmetries=self.symmetries_of(exact=exact),
        )

    def _search(self, batch: _Batch, starts: Hypotheses) -> Hypotheses:
        self.report_progress("search")
        return search(
            self.describers,
            batch.descriptors,
            starts,
            bank=self.bank,
            ranking=batch.ranking,
            boxes=batch.boxes,
            camera_matrices=batch.camera_matrices,
            brief=self.pipeline.contours,
            priors=batch.priors,
        )

    def _lift(self, batch: _Batch, hypotheses: Hypotheses) -> Poses:
        """Hypotheses as poses that fill the boxes, at distances within the priors."""
        poses = lift_to_poses(self.describers, hypotheses, batch.boxes, batch.camera_matrices)
        return poses if batch.priors is None else replace(poses, T=batch.priors.at_distance(hypotheses, poses.T))

    def object_mask(self, query: QueryFeatures) -> Tensor | None:
        """(B, 1, S, S) probability that pixels of the crops belong to the object, if the field predicts it."""
        field = self.matcher.field
        if not isinstance(field, LearnedCurvilinearSaliency):
            return None
        return torch.cat([field.mask(crop) for crop in query.crops.split(1)])  # rounding is that of a photograph alone

    def _evidence(self, batch: _Batch, starts: Hypotheses, poses: Poses) -> Tensor:
        """(H, 4) :data:`POSE_FEATURES` of poses that come from the views ``starts``."""
        hypotheses = poses.hypotheses
        similarity = similarities(self.describers, batch.descriptors, hypotheses)
        if not self.pipeline.contours:
            support = torch.zeros_like(similarity)
        elif poses.fit is not None:
            support = poses.fit.edge_support
        else:
            support = edge_supports(self.describers, batch.images, poses, batch.boxes)
        appearance = torch.zeros_like(similarity)
        if "appearance" in batch.ranking.terms:
            pictures = self.matcher.pictures(hypotheses.model, hypotheses.rotation, hypotheses.distance)
            options = (batch.query, batch.ranking, pictures, hypotheses.image_index)
            appearance = self.matcher.reranking_score("appearance", *options)
        return torch.stack([rank_feature(starts), similarity, support, appearance], dim=1)

    def _fit_textures(self, batch: _Batch, starts: Hypotheses, poses: Poses, evidence: Tensor) -> tuple[Poses, Tensor]:
        """Fit the best hypothesis of each photograph to the mesh's colours as well."""
        order, image_index = batch.scores(evidence).argsort(descending=True, stable=True), poses.hypotheses.image_index
        changed = []
        for b in range(len(batch.images)):
            best = int(order[image_index[order] == b][0])
            fitted = fit_texture_of(self.describers, batch.images, poses, batch.boxes, best)
            if fitted is None:
                continue
            if batch.priors is None or bool(batch.priors.keeps(fitted.hypotheses, fitted.T)[best]):
                poses = fitted
                changed.append(best)
        if changed:
            index, evidence = torch.tensor(changed), evidence.clone()
            evidence[index, 1:] = self._evidence(batch, starts[index], poses[index])[:, 1:]
        return poses, evidence

    def _restore(
        self, batch: _Batch, starts: Hypotheses, poses: Poses, evidence: Tensor, distinct: Tensor
    ) -> tuple[Poses, Tensor]:
        """Put hypotheses that merged, or whose fit is not trusted, back to the views that they started from."""
        keep = distinct
        # Where the contours of a similar object do not fit, the view has the smaller error.
        if poses.fit is not None and not batch.exact:
            keep = distinct & poses.fit.trustworthy
        if batch.priors is not None:
            keep = keep & batch.priors.keeps(poses.hypotheses, poses.T)
        if bool(keep.all()):
            return poses, evidence
        views, back = self._lift(batch, starts), ~keep
        evidence = evidence.clone()
        evidence[back, 1:] = self._evidence(batch, starts[back], views[back])[:, 1:]
        return poses.where(keep, views), evidence

    def _results(self, batch: _Batch, poses: Poses, evidence: Tensor, distinct: Tensor) -> list[Registration]:
        """Hypotheses of each photograph, best first, those that merged last, and their confidence."""
        with_camera, ranking, fitted = batch.camera_matrices is not None, batch.ranking, poses.fit is not None
        scores = batch.scores(evidence)
        order = (scores + torch.where(distinct, 0.0, -1e6)).argsort(descending=True, stable=True)
        of_image = [order[poses.hypotheses.image_index[order] == b] for b in range(len(batch.images))]
        # The confidence of a fitted pose was calibrated on the ranking's best view; without fit, on the result's view.
        views = None if fitted else poses.hypotheses.view[torch.stack([mine[0] for mine in of_image])]
        ranked = ranking_evidence(ranking, self.bank.rotations, answer=views, symmetries=batch.symmetries)
        with_appearance = "appearance" in ranking.terms
        name = model_name("contours" if fitted else "ranking", exact=batch.exact, with_appearance=with_appearance)
        confidence, constants = confidence_model(name), CALIBRATION["answer_set"][name]
        results = []
        for b, mine in enumerate(of_image):
            features = ranking_features(ranked[b])
            if fitted:
                features = confidence_features(evidence[mine], scores[mine], features["concentration"])
            reported = mine[: self.pipeline.hypotheses].tolist()
            hypotheses = tuple(hypothesis_of(h, poses, evidence, with_camera=with_camera) for h in reported)
            rivals = rescore(evidence[mine], exact=fitted and batch.exact)  # as calibrated
            answers = answer_set(confidence(features), rivals, constants, reported=len(reported))
            registration = Registration(hypotheses, answers, ranking[b : b + 1], features)
            if batch.priors is not None:
                best = poses[mine[:1]]
                filling = lift_to_poses(self.describers, best.hypotheses, batch.boxes, batch.camera_matrices)
                registration = batch.priors.note(registration, best.hypotheses, best.T, filling.T)
            results.append(registration)
        return results

"""The facade that joins it all: photographs, boxes and meshes to poses."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor, nn

from ..errors import CurviregError, InvalidInputError
from ..geometry.views import ViewSphere
from ..matching import Ranking, ViewBank, ViewDescriber, ViewMatcher, cached_bank
from ..pipeline import Pipeline
from ..rendering import DepthRenderer
from ..settings import BankSettings
from ..terms import QueryFeatures
from ..utils.checks import check_symmetries
from ..utils.threads import map_on_threads
from .confidence import confidence_model, pose_features, ranking_evidence, ranking_features
from .correction import corrected
from .hypotheses import Hypotheses, distinct_mask, hypotheses
from .inputs import ImageItem, check_crop, image_items
from .localization import Locator
from .localization.objects import localize
from .poses import Poses, follow_contours, lift_to_poses, supports
from .rescoring import POSE_FEATURES, gather_pose_features, rescore, similarities
from .results import FailedRegistration, Hypothesis, Registration
from .search import search

__all__ = ["Registrar"]

CARRIED = 3
"""Hypotheses that are always followed, however few are reported: without rivals nothing tells how sure the best is. Of
15 photographs of another object 14 were believed with one, 2 with two, none with three, as with five."""


class Registrar:
    """Registers photographs to a mesh, or to the best of several.

    Each box is cropped, turned into a field and ranked against the bank; the best distinct views become hypotheses,
    each is searched around in small steps, its contours are pulled onto the photograph's edges (:func:`fit_contours`),
    and what was found decides their order. With a camera matrix that yields rotation and translation with their
    covariance; without, the rotation. It does what ``curvireg register`` does, to the bit.

    Args:
        bank_or_mesh: a :class:`ViewBank`, a :class:`ViewMatcher`, a mesh, the path of a mesh, or a list of meshes or
            paths (which of them is it?); for meshes the bank comes from the disk cache or is built.
        pipeline: all settings; default that of a bank, else ``Pipeline()``.
        views, settings: viewpoints and bank settings of one's own, for a mesh.
        field: photograph filter of one's own, see :class:`ViewMatcher`.
        renderer: of the views rendered in search and contours, and of a bank that is built; one of your own is of one
            mesh.
        symmetries: (S, 4, 4) of the mesh, from :func:`curvireg_torch.geometry.symmetry_transforms`; hypotheses that
            differ by one of them are reported once.
        device: where modules, bank and search live.
        progress: show bars; or a function that is told a stage ("bank", "ranking", "search", "contours"; before
            ranking "looking", without a box), how much of it is done and of how much, and may raise to stop. On a CPU
            photographs are registered side by side: the function, a renderer and a field of your own are then called
            by several threads at a time.

    Example:
        >>> import trimesh
        >>> from curvireg_torch.geometry import sample_views
        >>> bank = ViewBank.build(trimesh.creation.box((1, 2, 3)), sample_views(azimuth_step=45, elevations=[20]),
        ...                       image_size=64, progress=False)
        >>> result = Registrar(bank)(torch.rand(1, 3, 48, 64), torch.tensor([[4.0, 4, 40, 30]]))[0]
        >>> result.rotation.shape, result.translation
        (torch.Size([3, 3]), None)
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
        symmetries: Tensor | None = None,
        device: torch.device | str | None = None,
        progress: bool | Callable[[str, int, int], object] = False,
    ) -> None:
        if isinstance(bank_or_mesh, ViewMatcher):
            if pipeline is not None or field is not None:
                raise InvalidInputError("Registrar: pipeline and field belong to the matcher; give them to ViewMatcher")
            matcher, pipeline = bank_or_mesh, bank_or_mesh.pipeline
        else:
            bank = bank_or_mesh
            if not isinstance(bank, ViewBank):
                pipeline = pipeline or Pipeline()
                pipeline = pipeline if settings is None else replace(pipeline, bank=settings)
                meshes = list(bank) if isinstance(bank, list | tuple) else [bank]
                bank = ViewBank.join(
                    [
                        cached_bank(
                            mesh, views, pipeline=pipeline, renderer=renderer, device=device or "cpu", progress=progress
                        )
                        for mesh in meshes
                    ]
                )
            bank = bank if device is None else bank.to(device)
            # Made on one thread, so that nothing in it is rounded otherwise where torch has several.
            matcher = map_on_threads(
                lambda bank: ViewMatcher(bank, pipeline=pipeline, field=field, renderer=renderer), [bank]
            )[0]
            pipeline = matcher.pipeline
        if isinstance(bank_or_mesh, ViewBank | ViewMatcher) and (views is not None or settings is not None):
            raise InvalidInputError("Registrar: views and settings belong to the bank; give them with a mesh only")
        self.pipeline = pipeline
        self.matcher, self.bank = matcher, matcher.bank
        if not isinstance(renderer, str) and len(self.bank.meshes) != 1:
            raise InvalidInputError(f"renderer: yours is of one mesh, the bank has {len(self.bank.meshes)}; name one")
        if symmetries is not None:
            check_symmetries(symmetries)
        self.symmetries = symmetries
        self.progress = progress

    @cached_property
    def describers(self) -> tuple[ViewDescriber, ...]:
        """Render and describe further views of each model, on a grid twice as fine as the bank's; made on first use."""
        settings = self.bank.settings
        fine = replace(settings, grid=min(2 * settings.grid, settings.image_size))
        return tuple(
            ViewDescriber(mesh, fine, renderer=coarse.renderer, device=self.bank.device)
            for mesh, coarse in zip(self.bank.meshes, self.matcher.describers, strict=True)
        )

    @cached_property
    def locator(self) -> Locator:
        """Proposes boxes where none are given; made on first use."""
        return map_on_threads(lambda _: Locator(self.matcher), [0])[0]  # rounded alike whatever torch's threads

    @torch.no_grad()
    def __call__(
        self,
        images: Tensor | Sequence[Any],
        boxes: Any | None = None,
        camera_matrices: Any | None = None,
        *,
        distance: tuple[float, float] | None = None,
    ) -> list[Registration | FailedRegistration]:
        """Register a batch.

        Args:
            images: (B, C, H, W) or a list of (C, H, W) tensors, (H, W, C) arrays or paths, C = 1 or 3, floating in
                [0, 1] or uint8.
            boxes: (B, 4) x0, y0, x1, y1 in px; None: the object is looked for, see :func:`localize`.
            camera_matrices: (B, 3, 3) or (3, 3) in px; without them translations are None and rotations are relative to
                a camera that looks straight at the box.
            distance: without boxes, nearest and farthest that the object's centre may be, in the mesh's unit.

        Returns:
            One :class:`Registration` for each photograph, in their order; a :class:`FailedRegistration` for one that
            cannot be registered (unreadable, its box empty or outside, one colour, NaN), which raises its error when
            asked for a pose.

        Raises:
            InvalidInputError: not as many boxes or cameras as images, or a ``distance`` beside boxes.
        """
        if boxes is None:
            return [each[0] for each in localize(self, images, camera_matrices, distance=distance)]
        if distance is not None:
            raise InvalidInputError("distance: for objects that are looked for; leave the boxes out, or the distance")
        items = image_items(images, boxes, camera_matrices)
        return self.each(items, self._answers_to_boxes)

    def each(
        self,
        items: Sequence[ImageItem | CurviregError],
        answer: Callable[[Sequence[ImageItem | CurviregError], int], list[Any]],
    ) -> list[Any]:
        """``answer(some items, number of the first)`` for all items, joined in their order.

        On a CPU each photograph is registered by itself, on a thread of its own, on which torch computes alone: its
        answer is the same to the bit whatever else is registered, on however many threads. On a GPU ``chunk_size`` of
        the matcher are registered at a time.
        """
        size = 1 if self.bank.device.type == "cpu" else self.matcher.chunk_size
        _ = self.describers, self.matcher.describers  # made once, before threads ask for them

        @torch.no_grad()  # a thread does not inherit it
        def some(first: int) -> list[Any]:
            return answer(items[first : first + size], first)

        parts = map_on_threads(some, range(0, len(items), size), device=self.bank.device)
        return [each for part in parts for each in part]

    def _answers_to_boxes(
        self, items: Sequence[ImageItem | CurviregError], first: int
    ) -> list[Registration | FailedRegistration]:
        answers = self.register_items(items, first=first)
        return list(corrected(self, items, answers)) if self.pipeline.box_jitter and self.pipeline.search else answers

    def register_items(
        self, items: Sequence[ImageItem | CurviregError], *, first: int = 0
    ) -> list[Registration | FailedRegistration]:
        """:meth:`register` for photographs that may be unfit, their boxes taken as they are; ``first``: its number."""
        out: list[Registration | FailedRegistration | None] = [
            None if isinstance(item, ImageItem) else FailedRegistration(item) for item in items
        ]
        usable = [(i, item) for i, item in enumerate(items) if isinstance(item, ImageItem)]
        if usable:
            query = self.matcher.query(
                [item.image for _, item in usable], torch.stack([item.box for _, item in usable])
            )
            kept = []
            for k, (i, _) in enumerate(usable):
                try:
                    check_crop(query.crops[k])
                    kept.append(k)
                except CurviregError as error:
                    out[i] = FailedRegistration(error.with_subject(f"image {first + i}"))
            if kept:
                results = self.register([usable[k][1] for k in kept], query[torch.tensor(kept)])
                for k, result in zip(kept, results, strict=True):
                    out[usable[k][0]] = result
        return [result for result in out if result is not None]

    @torch.no_grad()
    def register(
        self, items: Sequence[ImageItem], query: QueryFeatures, ranking: Ranking | None = None
    ) -> list[Registration]:
        """All stages behind the cropping.

        Args:
            items: B photographs, all with a camera matrix or all without.
            query: the same, cropped and described by the matcher.
            ranking: of the same; default :meth:`ViewMatcher.rank`.
        """
        self.report_progress("ranking")
        ranking = self.matcher.rank(query) if ranking is None else ranking
        images = [item.image for item in items]
        boxes = torch.stack([item.box for item in items]).double()
        matrices = [item.camera_matrix for item in items if item.camera_matrix is not None]
        K = torch.stack(matrices) if matrices else None
        count = max(CARRIED, self.pipeline.hypotheses)
        starts = hypotheses(ranking, self.bank, count=count, symmetries=self.symmetries)
        descriptors = self.describers[0].descriptor(query.field)
        found = starts
        if self.pipeline.search:
            self.report_progress("search")
            found = search(
                self.describers,
                descriptors,
                found,
                bank=self.bank,
                ranking=ranking,
                boxes=boxes,
                camera_matrices=K,
                brief=self.pipeline.contours,
            )
        poses = lift_to_poses(self.describers, found, boxes, K)
        if self.pipeline.contours:
            self.report_progress("contours")
            poses = follow_contours(self.describers, images, poses, boxes)

        def measured(poses: Poses) -> tuple[Tensor, Tensor]:
            similarity = similarities(self.describers, descriptors, poses.found)
            return similarity, self._appearance_scores(poses.found, query, ranking)

        fit, with_camera = poses.fit, K is not None
        similarity, appearance_scores = measured(poses)
        edge_support = torch.zeros_like(similarity) if fit is None else fit.edge_support.clone()
        evidence = gather_pose_features(starts, similarity, edge_support, appearance_scores)
        own = distinct_mask(poses.found, rescore(evidence, with_camera=with_camera), symmetries=self.symmetries)
        kept = own
        if fit is not None and not with_camera:
            # The mesh is often another object of the kind: where its contours do not fit, the view itself errs less.
            kept = own & fit.trustworthy
        if not bool(kept.all()):
            # A hypothesis that became another one is still a rival: it returns to the view that it started from, and
            # is measured there.
            views = lift_to_poses(self.describers, starts, boxes, K)
            poses, back = poses.where(kept, views), ~kept
            similarity[back], appearance_scores[back] = measured(views[back])
            if fit is not None:
                edge_support[back] = supports(self.describers, images, views[back], boxes)
            evidence = gather_pose_features(starts, similarity, edge_support, appearance_scores)
        poses = replace(poses, found=replace(poses.found, score=similarity))
        verdicts = rescore(evidence, with_camera=with_camera)
        order = (verdicts + torch.where(own, 0.0, -1e6)).argsort(descending=True, stable=True)
        ordered = [order[starts.photograph[order] == b] for b in range(len(items))]
        # Of a pose the calibration knows the ranking's own best view; without contours the answer is a view itself.
        answer = None if fit is not None else starts.view[torch.stack([mine[0] for mine in ordered])]
        ranked = ranking_evidence(ranking, self.bank.rotations, answer=answer, symmetries=self.symmetries)
        model = confidence_model(
            "ranking" if fit is None else "contours",
            with_camera=with_camera,
            with_appearance="appearance" in ranking.terms,
        )
        results = []
        for b, mine in enumerate(ordered):
            features = ranking_features(ranked[b])
            if fit is not None:
                features = pose_features(evidence[mine], verdicts[mine], features["concentration"])
            answers = tuple(
                _hypothesis(h, poses, edge_support, evidence, with_camera)
                for h in mine[: self.pipeline.hypotheses].tolist()
            )
            results.append(Registration(answers, model(features), ranking[b : b + 1], features))
        return results

    def report_progress(self, stage: str) -> None:
        """Call ``progress`` at the beginning of a stage, where it is a function."""
        if callable(self.progress):
            self.progress(stage, 0, 1)

    def _appearance_scores(self, found: Hypotheses, query: QueryFeatures, ranking: Ranking) -> Tensor:
        """(H,) float64 how much poses look like their photographs; 0 without that term."""
        if "appearance" not in ranking.terms:
            return torch.zeros(len(found), dtype=torch.float64)
        pictures = self.matcher.pictures(found.model, found.rotation, found.distance)
        return self.matcher.reranking_score("appearance", query, ranking, pictures, found.photograph)


def _hypothesis(h: int, poses: Poses, edge_support: Tensor, evidence: Tensor, with_camera: bool) -> Hypothesis:
    found, T, fit = poses.found, poses.T[h], poses.fit
    known = fit is not None and with_camera and bool(fit.covariance[h].isfinite().all())
    return Hypothesis(
        rotation=T[:3, :3].clone() if with_camera else found.rotation[h].clone(),
        translation=T[:3, 3].clone() if with_camera else None,
        score=float(found.score[h]),
        evidence=dict(zip(POSE_FEATURES, evidence[h].tolist(), strict=True)),
        allocentric_rotation=found.rotation[h].clone(),
        distance=float(found.distance[h]),
        projection=(T.clone(), poses.cameras[h].clone()),
        view=int(found.view[h]),
        model=int(found.model[h]),
        edge_support=None if fit is None else float(edge_support[h]),
        covariance=fit.covariance[h].clone() if fit is not None and known else None,
    )

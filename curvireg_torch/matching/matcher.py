"""All views of a bank ranked for every photograph of a batch."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor, nn

from ..descriptors import field_points
from ..errors import InvalidInputError
from ..geometry.crops import crop_images
from ..io.meshes.colours import has_colours
from ..pipeline import Pipeline
from ..rendering import DepthRenderer
from ..terms import (
    QueryFeatures,
    RerankingModule,
    RerankingTerm,
    Whitening,
    crop_regions,
    jittered_boxes,
    photograph_field,
    whole_box_shapes,
)
from ..terms.correlation import CorrelationModule
from ..utils.checks import as_boxes, check_photograph, check_pixels
from ..utils.threads import map_on_threads
from .bank import ViewBank
from .describe import ViewDescriber
from .distinct import distinct_views
from .fields import hog_layer

__all__ = ["Ranking", "ViewMatcher"]

KEPT = 2048
"""Views that late terms described when a photograph asked for them and that stay in memory, 35 kB each at 128 px."""

DESCRIBED = 16
"""Views that a late term describes at a time."""


@dataclass(frozen=True)
class Ranking:
    """Scores of N views for B photographs.

    Attributes:
        scores: (B, N) in [0, 1], the product of the terms' scores, each to the power of its weight.
        order: (B, N) view indices, best first; ties in the order of the bank.
        terms: name -> (B, N) raw scores of each term: "hog": normalised correlation of descriptors, in [0, 1], or in
            [-1, 1] if they are whitened; "repeatability": share of the photograph's points found in the view; "box":
            S_box in [0, 1], likeness of the boxes' proportions, best view 1.
    """

    scores: Tensor
    order: Tensor
    terms: Mapping[str, Tensor]

    def __len__(self) -> int:
        return self.scores.shape[0]

    def __getitem__(self, index: slice) -> "Ranking":
        """Some of the photographs, in memory of their own."""
        terms = {name: raw[index].clone() for name, raw in self.terms.items()}
        return Ranking(self.scores[index].clone(), self.order[index].clone(), terms)

    @property
    def hog(self) -> Tensor:
        """``terms["hog"]``."""
        return self.terms["hog"]

    @property
    def repeatability(self) -> Tensor:
        """``terms["repeatability"]``."""
        return self.terms["repeatability"]

    @property
    def box(self) -> Tensor:
        """``terms["box"]``."""
        return self.terms["box"]

    def top(self, k: int) -> Tensor:
        """(B, k) indices of the best views; fewer where the bank is smaller."""
        return self.order[:, :k]

    @staticmethod
    def cat(parts: Sequence["Ranking"]) -> "Ranking":
        """Rankings of the same views for more photographs."""
        terms = {name: torch.cat([part.terms[name] for part in parts]) for name in parts[0].terms}
        return Ranking(torch.cat([p.scores for p in parts]), torch.cat([p.order for p in parts]), terms)


class ViewMatcher(nn.Module):
    r"""Ranks all views of a bank for every photograph.

    The box of each photograph is cropped as the views are, turned into a field and described; each ranking term
    compares it with all views, and :math:`S = \prod_t S_t^{w_t}`. A box is never exact: terms take the best over a few
    crops that are moved and scaled a little.

    Photographs are described and compared in batches: what shares a batch, and the number of torch's threads, change
    scores by rounding, by about 1e-5 of themselves. :class:`curvireg_torch.Registrar` does not let that happen.

    Args:
        bank: the views of one model, or of several (which one is it?).
        pipeline: field, terms and slack; default the one the bank was made with. Its bank settings and view policy must
            be those of the bank, whose views may also have come with the call.
        field: photograph filter (B, 1, S, S) -> (B, 2, S, S) of one's own. One with an attribute ``colour = True`` gets
            colour photographs as (B, 3, S, S).
        box_jitter: instead of the pipeline's.
        whitening: compare whitened descriptors (:class:`DescriptorStatistics`), whatever the term "hog" says.
        renderer: of views that a :class:`RerankingTerm` asks for.
        chunk_size: photographs in memory at a time.

    Raises:
        BankError: the bank was made with other settings or for another pose than ``pipeline`` says.
        InvalidInputError: an option out of range.

    Example:
        >>> import trimesh
        >>> from curvireg_torch.geometry import sample_views
        >>> bank = ViewBank.build(trimesh.creation.box(), sample_views(azimuth_step=90), image_size=64, progress=False)
        >>> ranking = ViewMatcher(bank)(torch.rand(2, 3, 48, 64), torch.tensor([[4.0, 4, 40, 30], [10, 5, 60, 47]]))
        >>> ranking.scores.shape, ranking.top(3).shape
        (torch.Size([2, 32]), torch.Size([2, 3]))
    """

    def __init__(
        self,
        bank: ViewBank,
        *,
        pipeline: Pipeline | None = None,
        field: nn.Module | None = None,
        box_jitter: float | None = None,
        whitening: Whitening | None = None,
        renderer: str | DepthRenderer = "auto",
        chunk_size: int = 16,
    ) -> None:
        super().__init__()
        pipeline = bank.pipeline if pipeline is None else pipeline
        bank.check_made_for(pipeline)
        pipeline = replace(pipeline, views=bank.pipeline.views)  # "given" where they came with the call
        if box_jitter is not None:
            pipeline = replace(pipeline, box_jitter=box_jitter)
        if chunk_size < 1:
            raise InvalidInputError(f"chunk_size: expected >= 1, got {chunk_size}")
        self.bank, self.chunk_size, self._renderer = bank, chunk_size, renderer
        self._kept: dict[str, dict[int, Tensor]] = {}
        self.pipeline = pipeline if field is None else pipeline.with_field(field)
        self.field = (pipeline.photograph_field() if field is None else field).to(bank.device)
        self.descriptor = hog_layer(bank.settings)
        self._comparisons = nn.ModuleDict({term.name: term.build(bank) for term in pipeline.terms}).to(bank.device)
        if whitening is not None:
            self._comparisons["hog"] = CorrelationModule(bank.descriptors, whitening)

    @property
    def device(self) -> torch.device:
        """Where photographs are described and compared: that of the bank."""
        return self.bank.device

    def crop(self, images: Tensor | Sequence[Tensor], boxes: Any) -> tuple[Tensor, Tensor]:
        """(B, C, S, S) crops and (B, 3, 3) crop transforms, cut as the bank's views are."""
        settings = self.bank.settings
        return crop_images(images, boxes, size=settings.image_size, margin=settings.margin)

    def forward(self, images: Tensor | Sequence[Tensor], boxes: Any) -> Ranking:
        """Rank all views.

        Args:
            images: (B, C, H, W) or a list of (C, H, W), C = 1 or 3, floating in [0, 1] or uint8, on any device.
            boxes: (B, 4) x0, y0, x1, y1 in px, a tensor, an array or lists.

        Raises:
            InvalidInputError: wrong shape, dtype, as many boxes as images not given, or an unusable box.
            ImageError: missing (NaN or infinite) pixels in the crop of a box, or pixels outside [0, 1]. Missing pixels
                beside it do not matter.
        """
        boxes = as_boxes(boxes, len(images))
        parts = [
            self.rank(self.query(images[i : i + self.chunk_size], boxes[i : i + self.chunk_size]))
            for i in range(0, max(1, len(images)), self.chunk_size)
        ]
        return Ranking.cat(parts)

    def query(self, images: Tensor | Sequence[Tensor], boxes: Any) -> QueryFeatures:
        """Crop and describe photographs, see :meth:`forward`; missing pixels are refused by :meth:`rank`."""
        settings = self.bank.settings
        boxes = as_boxes(boxes, len(images)).to(self.device, torch.float32)
        for image in images:
            check_photograph(image)
        images = [image.to(self.device) for image in images]
        several = jittered_boxes(boxes, self.pipeline.box_jitter)
        regions = crop_regions(images, several, size=settings.image_size, margin=settings.margin)
        return self.describe(regions, whole_box_shapes(boxes, [(int(i.shape[-2]), int(i.shape[-1])) for i in images]))

    def features(self, crops: Tensor) -> QueryFeatures:
        """Describe (B, 1 or 3, S, S) crops that :meth:`crop` cut: boxes taken as they are, their shapes unknown."""
        return self.describe(crops[:, None], torch.full_like(crops[:, 0, 0, 0], torch.nan))

    def describe(self, regions: Tensor, shapes: Tensor) -> QueryFeatures:
        """Field, descriptors and points of (B, K, C, S, S) crops; ``shapes`` (B,) of the boxes."""
        B, K = regions.shape[:2]
        field = photograph_field(self.field, regions.flatten(0, 1))
        points = field_points(field, fraction=self.bank.settings.point_fraction)[:, 0]
        return QueryFeatures(
            regions=regions,
            field=field.unflatten(0, (B, K))[:, 0],
            descriptors=self.descriptor(field).unflatten(0, (B, K)),
            points=points.unflatten(0, (B, K)),
            shapes=shapes.to(regions),
        )

    def rank(self, query: QueryFeatures) -> Ranking:
        """Compare described photographs with all views.

        Raises:
            ImageError: missing pixels in the crop of a box, or pixels outside [0, 1].
        """
        check_pixels(query.crops, "of the box")
        early = [t for t in self.pipeline.terms if not isinstance(t, RerankingTerm)]
        terms = {t.name: self._comparisons[t.name](query) for t in early}
        log = torch.stack([t.weight * t.log_score(terms[t.name]) for t in early]).sum(dim=0)
        for late in (t for t in self.pipeline.terms if isinstance(t, RerankingTerm)):
            terms[late.name], score = self._asked_late(late, query, log)
            log = log + late.weight * score
        scores = log.exp()
        return Ranking(scores, scores.argsort(dim=1, descending=True, stable=True), terms)

    def _asked_late(self, term: RerankingTerm, query: QueryFeatures, log: Tensor) -> tuple[Tensor, Tensor]:
        """(B, N) raw scores, NaN for views that were not compared; and log scores of all views."""
        raw, score = torch.full_like(log, torch.nan), torch.zeros_like(log)
        if len(log) == 0:
            return raw, score
        module = self._late(term.name)
        if len(self.bank) <= term.exhaustive_limit:
            raw = module.compare(query, self._features(term.name, torch.arange(len(self.bank)))).to(log)
            return raw, term.log_score(raw)
        R, model = self.bank.rotations, self.bank.model
        order = log.argsort(dim=1, descending=True, stable=True)
        chosen = [distinct_views(o, R, count=term.top, angle=term.min_angle, model=model) for o in order]
        wanted = torch.cat(chosen).unique()
        found = module.compare(query, self._features(term.name, wanted)).to(log)
        for b, index in enumerate(chosen):
            raw[b, index] = found[b, torch.searchsorted(wanted, index)]
            alike = (R.flatten(1) @ R[index].flatten(1).T).masked_fill(model[:, None] != model[index], -4.0)
            score[b] = term.log_score(raw[b : b + 1, index])[0, alike.argmax(dim=1)]
        return raw, score

    def _late(self, name: str) -> RerankingModule:
        module = self._comparisons[name]
        assert isinstance(module, RerankingModule)
        return module

    def _features(self, name: str, views: Tensor) -> Tensor:
        """(U, D) features of (U,) views of the bank: from the bank, or of pictures made now, which are kept."""
        if name in self.bank.reranking_features:
            return self.bank.reranking_features[name][views.to(self.device)]
        kept = self._kept.setdefault(name, {})
        found = {view: known for view in views.tolist() if (known := kept.get(view)) is not None}
        missing = [view for view in views.tolist() if view not in found]
        module = self._late(name)

        def described(some: list[int]) -> Tensor:
            return module.describe(self._shaded(torch.tensor(some, device=self.device)))

        # On one thread each, as the bank's own: which photograph asked first does not decide how features are rounded.
        some = [missing[k : k + DESCRIBED] for k in range(0, len(missing), DESCRIBED)]
        parts = map_on_threads(described, some, device=self.device)
        new = dict(zip(missing, (feature for part in parts for feature in part), strict=True))
        if len(kept) + len(new) > KEPT:
            kept.clear()
        kept.update(new)
        found.update(new)
        return torch.stack([found[view] for view in views.tolist()])

    def reranking_score(
        self, name: str, query: QueryFeatures, ranking: Ranking, pictures: Tensor, photograph: Tensor
    ) -> Tensor:
        """(H,) float64 log scores of pictures of poses by a :class:`RerankingTerm`, as if they were ranked views.

        Args:
            name: of the term.
            query: B photographs.
            ranking: of them.
            pictures: (H, C, S, S), of :meth:`pictures`.
            photograph: (H,) which of the photographs each is compared with.
        """
        module, term = self._late(name), next(t for t in self.pipeline.terms if t.name == name)
        raw = module.compare(query, module.describe(pictures)).cpu().double()
        out = torch.zeros(len(pictures), dtype=torch.float64)
        for h, b in enumerate(photograph.tolist()):
            known = ranking.terms[name][b].cpu().double()
            among = torch.cat([known[known.isfinite()], raw[b, h : h + 1]])
            scores = term.log_score(among[None])[0]
            out[h] = scores[-1] - scores[:-1].max()  # above 0 where the pose looks better than every view
        return out

    def _shaded(self, views: Tensor) -> Tensor:
        """Pictures of (U,) views of the bank, see :meth:`ViewDescriber.shaded`."""
        return self.pictures(self.bank.model[views], self.bank.rotations[views], self.bank.distances[views])

    def pictures(self, model: Tensor, rotations: Tensor, distances: Tensor) -> Tensor:
        """(N, C, S, S) pictures of views of (N,) models, see :meth:`ViewDescriber.shaded`."""
        parts, index = [], []
        for m in model.unique().tolist():
            mine = (model == m).nonzero()[:, 0]
            parts.append(self.describers[m].shaded(rotations[mine], distances[mine]))
            index.append(mine)
        return torch.cat(parts)[torch.cat(index).argsort().to(parts[0].device)]

    @cached_property
    def describers(self) -> tuple[ViewDescriber, ...]:
        """Render and describe further views of each model, as the bank's views are; made on first use."""
        coloured = any(has_colours(mesh) for mesh in self.bank.meshes)
        return tuple(
            ViewDescriber(mesh, self.bank.settings, renderer=self._renderer, coloured=coloured, device=self.device)
            for mesh in self.bank.meshes
        )

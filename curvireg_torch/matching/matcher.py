"""All views of a bank ranked for every photograph of a batch, and the selection of distinct
views."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import torch
from torch import Tensor, nn

from ..errors import InvalidInputError
from ..features import field_points
from ..features.backbone import images_at_a_time
from ..geometry import ViewSphere
from ..mesh import mesh_radius
from ..pipeline import Pipeline
from ..rendering import DepthRenderer
from ..terms import (
    Appearance,
    Comparison,
    Correlation,
    QueryFeatures,
    Term,
    crop_photographs,
    jittered_fields,
    photograph_field,
    whole_box_shapes,
)
from ..utils.aliases import Fields
from ..utils.checks import as_boxes, check_pixels
from ..utils.computed import without_computed
from ..utils.files import text_digest
from ..utils.likes import BoxesLike
from ..utils.precision import full_precision
from ..utils.threads import map_on_threads
from .bank import ViewBank, packed, views_at_a_time
from .cells import ROUNDING_OF_TRACE, DescribedViews, best_cells, cells_of_views
from .describe import ViewDescriber, hog_layer

# Trace of a rotation by 30 degrees: views within that of the best one are no rivals of it
NEAR_TRACE = 1.0 + 3.0**0.5


@dataclass(frozen=True)
class Ranking:
    """Scores of N views for B photographs.

    Attributes:
        scores: (B, N) in [0, 1], the product of the terms' scores, each to the power of its weight.
        order: (B, N) view indices, best first; ties in the order of the bank.
        terms: name -> (B, N) raw scores of each term: "hog": normalised correlation of descriptors,
            in [0, 1], or in [-1, 1] if they are whitened, or the paper's product; "repeatability":
            fraction of the photograph's points found in the view; "box": similarity of the boxes'
            aspect ratios in [0, 1], best view 1.
        allowed, outside: of a pose prior, else None: (B, N) bool, the views that it leaves; (B,)
            the best of the others more than 30 degrees from the best view, or -1.

    Example:
        >>> import curvireg_torch as cr
        >>> scene = cr.synthetic.demo_scene()
        >>> views = cr.sample_views(azimuth_step=60, elevations=[20])
        >>> bank = cr.ViewBank.build(scene.mesh, views, image_size=64, progress=False)
        >>> ranking = cr.ViewMatcher(bank)([scene.image], [scene.box])
        >>> ranking.scores.shape, ranking.top(2).shape
        (torch.Size([1, 6]), torch.Size([1, 2]))
    """

    scores: Tensor
    order: Tensor
    terms: Mapping[str, Tensor]
    allowed: Tensor | None = None
    outside: Tensor | None = None

    @staticmethod
    def none() -> "Ranking":
        """That of a photograph which was compared with no view."""
        return Ranking(torch.zeros(1, 0), torch.zeros(1, 0, dtype=torch.long), {})

    def __len__(self) -> int:
        return self.scores.shape[0]

    @property
    def hog(self) -> Tensor:
        return self.terms["hog"]

    @property
    def repeatability(self) -> Tensor:
        return self.terms["repeatability"]

    def top(self, k: int) -> Tensor:
        """(B, k) indices of the best views; fewer if the bank is smaller."""
        return self.order[:, :k]

    def split(self) -> "list[Ranking]":
        """Each photograph by itself, on the CPU."""
        scores, order = (x.cpu().split(1) for x in (self.scores, self.order))
        terms = {name: x.cpu().split(1) for name, x in self.terms.items()}
        limits = [None if x is None else x.cpu().split(1) for x in (self.allowed, self.outside)]
        return [
            Ranking(
                scores[b],
                order[b],
                {name: x[b] for name, x in terms.items()},
                *(None if x is None else x[b] for x in limits),
            )
            for b in range(len(self))
        ]


class ViewMatcher(nn.Module):
    r"""Ranks all views of a bank for every photograph.

    The box of each photograph is cropped as the views are, filtered and described; each ranking
    term compares it with all views, and :math:`S = \prod_t S_t^{w_t}`. Boxes are never exact: terms
    take the best over a few jittered fields. The composition of a batch and the number of torch's
    threads change scores by rounding, relatively by about 1e-5; :class:`curvireg_torch.Registrar`
    prevents that.

    It computes in float32, also under autocast: ``.half()`` and other dtypes are refused.
    ``.to(device)`` moves bank, terms and field. A copy, also by pickle, has a bank of its own.

    Args:
        bank: the views of a mesh.
        pipeline: field, terms and box jitter; default the bank's.
        field: custom photograph filter (B, 1, S, S) -> (B, 2, S, S). With an attribute
            ``colour = True`` it gets colour photographs as (B, 3, S, S).
        renderer: for views that :class:`Appearance` needs.

    Raises:
        BankError: the bank was built with other settings than the pipeline's, or for another view
            policy.

    Example:
        >>> import trimesh
        >>> from curvireg_torch.geometry import sample_views
        >>> bank = ViewBank.build(trimesh.creation.box(), sample_views(azimuth_step=90),
        ...     image_size=64, progress=False)
        >>> ranking = ViewMatcher(bank)(torch.rand(2, 3, 48, 64), torch.tensor([[4.0, 4, 40, 30],
        ...     [10, 5, 60, 47]]))
        >>> ranking.scores.shape, ranking.top(3).shape
        (torch.Size([2, 32]), torch.Size([2, 3]))
    """

    def __init__(
        self,
        bank: ViewBank,
        *,
        pipeline: Pipeline | None = None,
        field: nn.Module | None = None,
        renderer: str | DepthRenderer = "auto",
    ) -> None:
        super().__init__()
        pipeline = bank.pipeline if pipeline is None else pipeline
        bank.check_compatible(pipeline)
        # "given" if the caller passed the views
        pipeline = replace(pipeline, views=bank.pipeline.views)
        self.bank = bank
        self._renderer = renderer
        self.pipeline = pipeline if field is None else pipeline.with_field(field)
        self.field = (pipeline.photograph_field() if field is None else field).to(bank.device)
        self.descriptor = hog_layer(bank.settings)
        appearance = next(
            (term for term in pipeline.terms if isinstance(term, Appearance) and term.weight > 0),
            None,
        )
        self._appearance = None if appearance is None else appearance.build().to(bank.device)
        _ = self._terms

    @cached_property
    def _terms(self) -> list[tuple[Term, Comparison]]:
        """Terms but appearance, and how they compare, on the bank's device."""
        counting = [term for term in self.pipeline.terms if term.weight > 0]
        with full_precision():
            return [
                (term, term.build(self.bank))
                for term in counting
                if not isinstance(term, Appearance)
            ]

    @cached_property
    def _described_views(self) -> DescribedViews:
        """Features of views. Those of a cached bank are kept in a file for its pictures by this
        renderer; others draw others. The name of a custom one says nothing: its are not kept."""
        shared = self.bank.described_views_file
        if shared is None or not isinstance(self._renderer, str):
            return DescribedViews(None)
        digest = text_digest(f"{shared.name} {self._renderer}", size=16)
        return DescribedViews(shared.with_name(f"views-{digest}.safetensors"))

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Move to another device. Modules convert their tensors by a function: what it does to one
        of float32 tells."""
        moved = fn(torch.zeros(0, device=self.bank.device))
        if moved.dtype != torch.float32:
            raise InvalidInputError(
                f"ViewMatcher: computes in float32, got {moved.dtype}; convert its field only"
            )
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        if moved.device != self.bank.device:
            self.bank = self.bank.to(moved.device)
            for name in vars(self).keys() - without_computed(self).keys():
                delattr(self, name)
            self._prepare_on_one_thread()
        return self

    def __getstate__(self) -> Fields:
        """Without what is computed from the rest: comparisons and renderers cannot be pickled."""
        return without_computed(self)

    def __setstate__(self, state: Fields) -> None:
        super().__setstate__(state)  # type: ignore[no-untyped-call]
        self._prepare_on_one_thread()

    def _prepare_on_one_thread(self) -> None:
        """Whatever number of threads torch has, rounding is that of a matcher which the registrar
        built."""
        map_on_threads(lambda _: self._terms, [0])

    def forward(self, images: Tensor | Sequence[Tensor], boxes: BoxesLike) -> Ranking:
        """Rank all views.

        Args:
            images: (B, C, H, W) or a list of (C, H, W), C = 1 or 3, floating in [0, 1] or uint8, on
                any device.
            boxes: (B, 4) x0, y0, x1, y1 in px, a tensor, an array or lists.

        Raises:
            InvalidInputError: wrong shape or dtype, another number of boxes than of images, or an
                unusable box.
            ImageError: pixels of the crop of a box are missing (NaN or infinite) or outside [0, 1].
        """
        return self.rank(self.query(images, boxes))

    @full_precision()
    def query(self, images: Tensor | Sequence[Tensor], boxes: BoxesLike) -> QueryFeatures:
        """Crop and describe photographs, see :meth:`forward`; :meth:`rank` rejects missing
        pixels."""
        settings = self.bank.settings
        boxes = as_boxes(boxes, len(images)).to(self.bank.device, torch.float32)
        crops = crop_photographs(images, boxes, size=settings.image_size, margin=settings.margin)
        sizes = [(int(image.shape[-2]), int(image.shape[-1])) for image in images]
        return self.describe(crops, whole_box_shapes(boxes, sizes))

    def features(self, crops: Tensor) -> QueryFeatures:
        """Describe (B, 1 or 3, S, S) crops of boxes, without box jitter and shapes."""
        unknown = torch.full_like(crops[:, 0, 0, 0], torch.nan)
        return self.describe(crops, unknown, box_jitter=0.0)

    @full_precision()
    def describe(
        self, crops: Tensor, shapes: Tensor, *, box_jitter: float | None = None
    ) -> QueryFeatures:
        """Field, descriptors and points of (B, C, S, S) crops; ``shapes`` (B,) of the boxes.
        ``box_jitter`` is by default the pipeline's."""
        settings = self.bank.settings
        jitter = self.pipeline.box_jitter if box_jitter is None else box_jitter
        field, mask = photograph_field(self.field, crops)
        jittered = jittered_fields(field, jitter, settings.margin)
        B, K = jittered.shape[:2]
        fields = jittered.flatten(0, 1)
        points = field_points(fields, fraction=settings.point_fraction)[:, 0]
        return QueryFeatures(
            crops=crops,
            field=field,
            descriptors=self.descriptor(fields).unflatten(0, (B, K)),
            points=points.unflatten(0, (B, K)),
            shapes=shapes.to(crops),
            mask=mask,
        )

    @full_precision()
    def rank(self, query: QueryFeatures, allowed: Tensor | None = None) -> Ranking:
        """Compare B described photographs with all views; errors as :meth:`forward`. ``allowed``
        (B, N) bool leaves views out, whose score is 0."""
        terms, first = self._first_terms(query)
        log, compared = self._with_appearance(query, first)
        if allowed is not None:
            if allowed.shape != first.shape or allowed.dtype != torch.bool:
                raise InvalidInputError(
                    f"allowed: expected bool of shape {tuple(first.shape)}, got {allowed.dtype} of "
                    f"{tuple(allowed.shape)}"
                )
            allowed = allowed.to(log.device)
            without_limits = log
            log, compared = self._with_appearance(query, first.masked_fill(~allowed, -torch.inf))
        order = log.argsort(dim=1, descending=True, stable=True)
        outside = None
        if allowed is not None:
            R = self.bank.rotations
            near = R[order[:, 0]].flatten(1) @ R.flatten(1).T >= NEAR_TRACE - ROUNDING_OF_TRACE
            best, outside = without_limits.masked_fill(allowed | near, -torch.inf).max(dim=1)
            outside = outside.masked_fill(best == -torch.inf, -1)
        return Ranking(log.exp(), order, {**terms, **compared}, allowed, outside)

    @full_precision()
    def flipped(self, query: QueryFeatures) -> tuple[QueryFeatures, Ranking]:
        """Described photographs as a mirror shows them, and their ranking by descriptors alone.
        Nothing is filtered or described again."""
        mirror = query.field.new_tensor([-1.0, 1.0]).view(2, 1, 1)
        descriptors = self.descriptor.mirrored(query.descriptors.flatten(0, 1))
        flipped = QueryFeatures(
            crops=query.crops.flip(-1),
            field=(mirror * query.field).flip(-1),
            descriptors=descriptors.view_as(query.descriptors),
            points=query.points.flip(-1),
            shapes=query.shapes,
            mask=None if query.mask is None else query.mask.flip(-1),
        )
        by_name = {term.name: compare for term, compare in self._terms}
        scores = by_name[Correlation.name](flipped)
        order = scores.argsort(dim=1, descending=True, stable=True)
        return flipped, Ranking(scores, order, {Correlation.name: scores})

    @full_precision()
    def similarity(self, query: QueryFeatures, allowed: Tensor | None = None) -> Tensor:
        """(B,) normalised correlation of the view that is best without the appearance term, at a
        fraction of the cost of :meth:`rank`."""
        terms, log = self._first_terms(query)
        if allowed is not None:
            log = log.masked_fill(~allowed.to(log.device), -torch.inf)
        return terms[Correlation.name].gather(1, log.argmax(dim=1, keepdim=True))[:, 0]

    def _first_terms(self, query: QueryFeatures) -> tuple[dict[str, Tensor], Tensor]:
        """Scores of all terms but appearance, and their product's logarithm (B, N)."""
        check_pixels(query.crops, "of the box")
        terms = {term.name: compare(query) for term, compare in self._terms}
        return terms, torch.stack(
            [term.weight * term.log_score(terms[term.name]) for term, _ in self._terms]
        ).sum(dim=0)

    @torch.no_grad()
    @full_precision()
    def compare_views(self, query: QueryFeatures, views: ViewSphere) -> Tensor:
        """(N,) log scores of further views of the mesh for one described photograph, 0 for the best
        of them, by all terms but appearance; mu and Sigma of whitened descriptors are those of the
        bank."""
        radius = mesh_radius(self.bank.mesh)
        at_a_time = views_at_a_time(self.bank.settings.image_size)
        parts = zip(
            views.rotations.split(at_a_time),
            views.distance.split(at_a_time),
            strict=True,
        )
        described = [packed(self.describer(R, distance * radius)) for R, distance in parts]
        tensors = {name: torch.cat([part[name] for part in described]) for name in described[0]}
        few = ViewBank(self.bank.mesh, views, self.bank.pipeline, tensors)
        for whitening, name in (("bank", "whitening"), ("paper", "precision")):
            if any(getattr(term, "whitening", "none") == whitening for term, _ in self._terms):
                setattr(few, name, getattr(self.bank, name))
        scores = [term.weight * term.log_score(term.build(few)(query)) for term, _ in self._terms]
        log = torch.stack(scores).sum(dim=0)[0]
        return log - log.max()

    def _with_appearance(
        self, query: QueryFeatures, log: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Log scores (B, N) with those of the appearance term, and its raw scores, NaN for views
        not compared."""
        if (appearance := self._appearance) is None:
            return log, {}
        term = appearance.term
        raw = torch.full_like(log, torch.nan)
        score = torch.zeros_like(log)
        if len(log) and len(self.bank) <= term.exhaustive_limit:
            raw = appearance.compare(
                query, self._features_of_views(torch.arange(len(self.bank)))
            ).to(log)
            score = term.log_score(raw)
        elif len(log):
            R = self.bank.rotations
            representatives, cells = self.bank.packing(term.min_angle)
            selected = [representatives[best_cells(row, cells, count=term.top)] for row in log]
            compared = torch.cat(selected).unique()
            similarity = appearance.compare(query, self._features_of_views(compared)).to(log)
            for b, index in enumerate(selected):
                raw[b, index] = similarity[b, torch.searchsorted(compared, index)]
                nearest = cells_of_views(R, index)
                score[b] = term.log_score(raw[b : b + 1, index])[0, nearest]
        return log + term.weight * score, {term.name: raw}

    def _features_of_views(self, views: Tensor) -> Tensor:
        """(U, D) features of (U,) ascending views: from the bank, described before, or described
        now."""
        if (features := self.bank.appearance) is not None:
            return features if len(views) == len(features) else features[views.to(self.bank.device)]
        return self._described_views.features(views.tolist(), self._describe_views)

    def _describe_views(self, views: list[int]) -> Tensor:
        """(U, D) appearance features of views, rendered and described."""
        appearance = self._appearance
        assert appearance is not None

        def describe(chunk: list[int]) -> Tensor:
            R = self.bank.rotations[chunk]
            distances = self.bank.distances[chunk]
            return appearance.describe(self.describer.shaded(R, distances))

        # One thread per chunk, so that rounding does not depend on which photograph came first.
        at_a_time = images_at_a_time(self.bank.device)
        chunks = [views[k : k + at_a_time] for k in range(0, len(views), at_a_time)]
        return torch.cat(map_on_threads(describe, chunks, device=self.bank.device))

    @full_precision()
    def appearance_of(self, pictures: Tensor) -> Tensor:
        """(H, D) features of ``pictures`` (H, C, S, S) by the appearance term."""
        assert self._appearance is not None
        return self._appearance.describe(pictures)

    @full_precision()
    def appearance_scores(
        self,
        query: QueryFeatures,
        rankings: Sequence[Ranking],
        features: Tensor,
        photograph: Tensor,
    ) -> Tensor:
        """(H,) float64 log scores of poses, each in a ``photograph`` (H,), whose pictures have
        these features (H, D), by the appearance term, minus that of the most similar view of the
        photograph's ranking: positive if a pose is more similar than every view."""
        assert self._appearance is not None
        similarity = self._appearance.compare(query, features).cpu().double()
        raw = similarity[photograph, torch.arange(len(photograph))]
        scores = torch.zeros_like(raw)
        for number, ranking in enumerate(rankings):
            mine = photograph == number
            if mine.any():
                views = ranking.terms[Appearance.name][0].cpu().double()
                compared = views[views.isfinite()].expand(int(mine.sum()), -1)
                every = torch.cat([compared, raw[mine][:, None]], dim=1)
                log = self._appearance.term.log_score(every)
                scores[mine] = log[:, -1] - log[:, :-1].amax(dim=1)
        return scores

    @cached_property
    def describer(self) -> ViewDescriber:
        """Render and describe further views as the bank's; built on first use."""
        return ViewDescriber(
            self.bank.mesh, self.bank.settings, renderer=self._renderer, device=self.bank.device
        )

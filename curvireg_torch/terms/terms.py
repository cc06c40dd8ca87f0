"""Ranking terms: each compares photographs with views; the ranking multiplies them."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..errors import InvalidInputError
from ..features.appearance import describe, similarity
from ..features.backbone import SHA256, Backbone
from ..utils.checks import check_option, check_positive
from ..utils.threads import map_on_threads
from .query import QueryFeatures
from .scores import (
    REPEATABILITY_MODES,
    VIEWS_AT_A_TIME,
    Whitening,
    box_shapes,
    cell_counts,
    check_box_shapes,
    dilate_points,
    inner_products,
    ledoit_wolf,
    log_repeatability_score,
    log_unit_score,
    matched_fraction,
    shape_scores,
)

__all__ = [
    "TERMS",
    "Appearance",
    "BoxShape",
    "Correlation",
    "Repeatability",
    "RerankingModule",
    "RerankingTerm",
    "Term",
    "Views",
]


class Views(Protocol):
    """N described views, for instance a :class:`curvireg_torch.ViewBank`, which documents the attributes."""

    @property
    def settings(self) -> Any: ...
    @property
    def descriptors(self) -> Tensor: ...
    @property
    def boxes(self) -> Tensor: ...
    def __len__(self) -> int: ...
    def points_at(self, index: Tensor | slice) -> Tensor: ...
    def silhouettes_at(self, index: Tensor | slice) -> Tensor: ...


@dataclass(frozen=True)
class Term(ABC):
    """One factor of the score S = prod S_t^w_t of a view for a photograph.

    A new term is a frozen dataclass of plain numbers with a ``name`` and these two methods, added to
    :data:`curvireg_torch.terms.TERMS` if JSON files of pipelines name it.

    Attributes:
        weight: w >= 0; a term of weight 0 is left out.
    """

    name: ClassVar[str]
    weight: float = 1.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.weight) and self.weight >= 0):
            raise InvalidInputError(f"{self.name}: weight: expected a number >= 0, got {self.weight}")

    @abstractmethod
    def build(self, views: Views) -> nn.Module:
        """A module that compares photographs with these N views: :class:`QueryFeatures` -> (B, N) raw scores."""

    @abstractmethod
    def log_score(self, raw: Tensor) -> Tensor:
        """(B, N) log S_t <= 0 from raw scores, 0 for the best view of each photograph or near it."""


@dataclass(frozen=True)
class RerankingTerm(Term):
    """A term that needs a picture of every view that it compares.

    A bank of up to ``exhaustive_limit`` views stores the features of all its views. In a larger bank the term compares
    only the best distinct views of the other terms and computes their features on demand; every other view gets the
    score of the nearest compared view, and NaN as raw score.

    Attributes:
        exhaustive_limit: largest number of views that are all compared.
        top, min_angle: in a larger bank, number of compared views and minimal angle between them in degrees.
    """

    exhaustive_limit: int = 1000
    top: int = 32
    min_angle: float = 20.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self.min_angle, "min_angle", zero_ok=True)
        if self.top < 1 or self.exhaustive_limit < 0:
            raise InvalidInputError(
                f"{self.name}: expected top >= 1 and exhaustive_limit >= 0, got {self.top} and {self.exhaustive_limit}"
            )

    @abstractmethod
    def build(self, views: Views | None) -> "RerankingModule":
        """The module that describes and compares. It does not depend on the views."""


class RerankingModule(nn.Module, ABC):
    """Describes pictures of views, and compares photographs with them."""

    @abstractmethod
    def describe(self, pictures: Tensor) -> Tensor:
        """(N, D) features of pictures of views: (N, 1, S, S) grey, or (N, 4, S, S) grey and in the mesh's colours."""

    @abstractmethod
    def compare(self, query: QueryFeatures, features: Tensor) -> Tensor:
        """(B, N) raw scores of B photographs and the (N, D) features of N views."""


@dataclass(frozen=True)
class Correlation(Term):
    """S_hog: normalised correlation of descriptors, the best over the jittered crops, mapped by :func:`unit_score`.

    Attributes:
        whitening: "none", or "bank": both descriptors are whitened by the mean mu and the covariance Sigma of the
            bank's views before the cosine. The paper scores (D_view - mu)^T Sigma^-1 D_query with the same mu and
            Sigma. Here the photograph's descriptor is centred too, lengths are divided out, and Sigma is shrunk
            (Ledoit-Wolf), because a bank has fewer views than a descriptor has entries.
    """

    name: ClassVar[str] = "hog"
    whitening: str = "none"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_option(self.whitening, ("none", "bank"), "whitening")

    def build(self, views: Views) -> nn.Module:
        whitening = None if self.whitening == "none" else Whitening(*ledoit_wolf(views.descriptors))
        return _CorrelationModule(views.descriptors, whitening)

    def log_score(self, raw: Tensor) -> Tensor:
        return log_unit_score(raw)


class _CorrelationModule(nn.Module):
    """Compares photographs with (N, D) descriptors of views, whitened or not."""

    def __init__(self, descriptors: Tensor, whitening: Whitening | None = None) -> None:
        super().__init__()
        self.whitening = whitening
        self.views: Tensor
        self.register_buffer("views", self._normalized(descriptors), persistent=False)

    def _normalized(self, descriptors: Tensor) -> Tensor:
        return F.normalize(descriptors if self.whitening is None else self.whitening(descriptors), dim=1)

    def forward(self, query: QueryFeatures) -> Tensor:
        B, K = query.descriptors.shape[:2]
        queries = self._normalized(query.descriptors.flatten(0, 1)).to(self.views.dtype)
        return (queries @ self.views.T).float().view(B, K, len(self.views)).amax(dim=1)


@dataclass(frozen=True)
class Repeatability(Term):
    """S_rep: the photograph's feature points have points of the view nearby, the best over the jittered crops.

    Attributes:
        sigma, mode: of :func:`repeatability_score`.
        eps: largest distance of matching points, as a fraction of the crop's side.
    """

    name: ClassVar[str] = "repeatability"
    sigma: float = 0.1
    mode: str = "monotone"
    eps: float = 0.02

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self.sigma, "sigma")
        check_option(self.mode, REPEATABILITY_MODES, "mode")
        check_positive(self.eps, "eps", zero_ok=True)

    def build(self, views: Views) -> nn.Module:
        return _RepeatabilityModule(views, self.eps)

    def log_score(self, raw: Tensor) -> Tensor:
        return log_repeatability_score(raw, self.mode, self.sigma)


class _RepeatabilityModule(nn.Module):
    """``near`` (N, cells) counts the pixels of each cell within eps of a view's points, ``area`` (1, cells) all."""

    near: Tensor
    area: Tensor

    def __init__(self, views: Views, eps: float) -> None:
        super().__init__()
        S = views.settings.image_size
        # Cells of at most eps px keep the matrix product small.
        self.cell = max(1, min(int(eps * S), S // 64))

        def count(i: int) -> Tensor:
            return cell_counts(
                dilate_points(views.points_at(slice(i, i + VIEWS_AT_A_TIME)), eps * S), self.cell
            ).flatten(1)

        near = map_on_threads(count, range(0, len(views), VIEWS_AT_A_TIME), device=views.descriptors.device)
        whole = torch.ones(1, S, S, dtype=torch.bool, device=near[0].device)
        self.register_buffer("near", torch.cat(near), persistent=False)
        self.register_buffer("area", cell_counts(whole, self.cell).flatten(1), persistent=False)

    def forward(self, query: QueryFeatures) -> Tensor:
        B, K = query.points.shape[:2]
        # A point in a cut cell counts as much as any other.
        points = cell_counts(query.points.flatten(0, 1), self.cell).flatten(1).float()
        matched = inner_products(points / self.area, self.near)
        return matched_fraction(matched, points).view(B, K, len(self.near)).amax(dim=1)


@dataclass(frozen=True)
class BoxShape(Term):
    """S_box: :func:`box_shape_score` with ``sigma``; 1 for all views if the box reaches the image's border."""

    name: ClassVar[str] = "box"
    sigma: float = 0.2

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self.sigma, "sigma")

    def build(self, views: Views) -> nn.Module:
        return _BoxShapeModule(box_shapes(views.boxes).float(), self.sigma)

    def log_score(self, raw: Tensor) -> Tensor:
        return raw.clamp(min=torch.finfo(raw.dtype).tiny).log()


class _BoxShapeModule(nn.Module):
    def __init__(self, shapes: Tensor, sigma: float) -> None:
        super().__init__()
        check_box_shapes(shapes)
        self.sigma = sigma
        self.shapes: Tensor
        self.register_buffer("shapes", shapes, persistent=False)

    def forward(self, query: QueryFeatures) -> Tensor:
        return shape_scores(query.shapes.float(), self.shapes, self.sigma)


@dataclass(frozen=True)
class Appearance(RerankingTerm):
    """The appearance score: features of an ImageNet network agree, cell by cell, between the photograph's crop and the
    shaded view.

    A mesh with colours is rendered twice, in grey and in its colours, and the better match counts for each view: a
    print distinguishes top from bottom, and the grey picture remains where the print misleads. Raw scores are mean
    cosines (:func:`curvireg_torch.features.appearance.similarity`) in [-1, 1]; log S = (raw - max raw) / std raw, over
    the compared views.

    Attributes:
        weights: digest of the network's weights.
    """

    name: ClassVar[str] = "appearance"
    weight: float = 2.0
    weights: str = SHA256[:16]

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.weights != SHA256[:16]:
            raise InvalidInputError(f"appearance: expected weights {self.weights}, got installed weights {SHA256[:16]}")

    def build(self, views: Views | None) -> RerankingModule:
        return _AppearanceModule()

    def log_score(self, raw: Tensor) -> Tensor:
        spread = raw.std(dim=1, keepdim=True, correction=0)
        spread = torch.where(spread > 0, spread, torch.ones_like(spread))
        return (raw - raw.amax(dim=1, keepdim=True)) / spread


class _AppearanceModule(RerankingModule):
    def __init__(self) -> None:
        super().__init__()
        self.backbone = Backbone()

    def describe(self, pictures: Tensor) -> Tensor:
        grey, colour = pictures[:, :1], pictures[:, 1:]
        features = [describe(picture, self.backbone) for picture in (grey, colour) if picture.shape[1]]
        return torch.cat(features, dim=1)

    def compare(self, query: QueryFeatures, features: Tensor) -> Tensor:
        if Appearance.name not in query.reranking_features:  # shared by ranking and rescoring
            query.reranking_features[Appearance.name] = describe(query.crops, self.backbone)
        crops = query.reranking_features[Appearance.name]
        similarities = similarity(crops[:, None], features.reshape(-1, crops.shape[1]))
        return similarities.view(len(crops), len(features), -1).amax(dim=2)


TERMS: dict[str, type[Term]] = {term.name: term for term in (Correlation, Repeatability, BoxShape, Appearance)}
"""Terms by the name that JSON files of pipelines use."""

"""Ranking terms compare photographs with views and turn the result into a score."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Protocol

from torch import Tensor, nn

from ..errors import InvalidInputError
from ..settings import BankSettings
from ..utils.checks import check_positive
from .query import QueryFeatures

__all__ = ["RerankingModule", "RerankingTerm", "Term", "Views"]


class Views(Protocol):
    """N described views, for instance a :class:`curvireg_torch.ViewBank`, which documents the attributes."""

    @property
    def settings(self) -> BankSettings: ...
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

    A new term is a frozen dataclass of plain numbers with a ``name`` and these two methods, registered in
    :data:`curvireg_torch.terms.TERMS`.

    Attributes:
        weight: w >= 0; a term of weight 0 is computed and reported, but does not count.
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

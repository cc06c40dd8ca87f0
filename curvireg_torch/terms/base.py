"""What a ranking term is: views and photographs are compared, and what comes out becomes a score."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Protocol

from torch import Tensor, nn

from ..errors import InvalidInputError
from ..utils.checks import check_positive
from .query import QueryFeatures

if TYPE_CHECKING:
    from ..settings import BankSettings

__all__ = ["RerankingModule", "RerankingTerm", "Term", "Views"]


class Views(Protocol):
    """N views as terms see them: a bank, or views that were rendered a moment ago."""

    @property
    def settings(self) -> "BankSettings": ...

    @property
    def descriptors(self) -> Tensor:
        """(N, D) float32."""
        ...

    @property
    def boxes(self) -> Tensor:
        """(N, 4) boxes of the object in normalised image coordinates."""
        ...

    def __len__(self) -> int: ...

    def points_at(self, index: Tensor | slice) -> Tensor:
        """(K, S, S) bool feature points of some of the views."""
        ...

    def silhouettes_at(self, index: Tensor | slice) -> Tensor:
        """(K, S, S) bool: pixels that show the object."""
        ...


@dataclass(frozen=True)
class Term(ABC):
    """One factor of the score S = prod S_t^w_t of a view for a photograph.

    A new term is a new file: a frozen dataclass of plain numbers with these three methods, and its name in
    :data:`curvireg_torch.terms.TERMS`.

    Attributes:
        weight: w >= 0; with 0 the term is computed and reported, and does not count.
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
    """A term that costs a picture of every view.

    In banks of up to ``coarse`` views all are described when the bank is built, and compared. In larger ones only the
    best distinct views of the other terms are, when a photograph asks for them; every other view then has the score of
    the one nearest to it, and NaN for a raw score.

    Attributes:
        coarse: views of a bank that is described as a whole.
        top, apart: otherwise, how many views are compared, and degrees between them.
    """

    coarse: int = 1000
    top: int = 32
    apart: float = 20.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self.apart, "apart", zero_ok=True)
        if self.top < 1 or self.coarse < 0:
            raise InvalidInputError(f"{self.name}: expected top >= 1 and coarse >= 0, got {self.top} and {self.coarse}")

    @abstractmethod
    def build(self, views: Views | None) -> "RerankingModule":
        """What describes and compares; the same for all views."""


class RerankingModule(nn.Module, ABC):
    """Describes pictures of views, and compares photographs with them."""

    @abstractmethod
    def described(self, pictures: Tensor) -> Tensor:
        """(N, D) features of pictures of views: (N, 1, S, S) grey, or (N, 4, S, S) grey and in the mesh's colours."""

    @abstractmethod
    def compare(self, photographs: QueryFeatures, views: Tensor) -> Tensor:
        """(B, N) raw scores of (N, D) features."""

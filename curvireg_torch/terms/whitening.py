"""Statistics of descriptors, and the linear map that decorrelates their entries (LDA, Aubry et al. 2014)."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ..errors import InvalidInputError
from ..utils.checks import check_option, check_tensor

__all__ = ["DescriptorStatistics", "Whitening"]


class Whitening(nn.Module):
    r"""x -> L^-1 (x - mean), where Sigma = L L^T: inner products become :math:`(x - \mu)^T \Sigma^{-1} (y - \mu)`.

    Args:
        mean: (D,).
        covariance: (D, D), symmetric, positive definite.

    Raises:
        InvalidInputError: wrong shapes or a covariance that is not positive definite.

    Example:
        >>> whiten = Whitening(torch.zeros(2), torch.diag(torch.tensor([4.0, 1.0])))
        >>> whiten(torch.tensor([[2.0, 3.0]])).tolist()
        [[1.0, 3.0]]
    """

    def __init__(self, mean: Tensor, covariance: Tensor) -> None:
        super().__init__()
        check_tensor(mean, "mean", (None,))
        check_tensor(covariance, "covariance", (len(mean), len(mean)))
        factor, failed = torch.linalg.cholesky_ex(covariance.double())
        if int(failed):
            raise InvalidInputError("covariance: expected a positive definite matrix; raise the shrinkage")
        identity = torch.eye(len(mean), dtype=torch.float64, device=mean.device)
        self.mean: Tensor
        self.matrix: Tensor
        self.register_buffer("mean", mean.float())
        self.register_buffer("matrix", torch.linalg.solve_triangular(factor, identity, upper=False).float())

    def forward(self, descriptors: Tensor) -> Tensor:
        """(N, D) -> (N, D)."""
        check_tensor(descriptors, "descriptors", (None, len(self.mean)))
        return (descriptors.to(self.mean) - self.mean) @ self.matrix.T


@dataclass(frozen=True)
class DescriptorStatistics:
    """Mean and covariance of a population of descriptors.

    Attributes:
        mean: (D,) float32.
        covariance: (D, D) float32, of the sample, not shrunk.
        count: number of descriptors.
        fourth: mean of ``|x - mean|^4``, which Ledoit and Wolf's shrinkage needs.

    Example:
        >>> statistics = DescriptorStatistics.from_descriptors(torch.rand(50, 8))
        >>> statistics.whitening(shrinkage="ledoit-wolf")(torch.rand(3, 8)).shape
        torch.Size([3, 8])
    """

    mean: Tensor
    covariance: Tensor
    count: int
    fourth: float

    @classmethod
    def from_descriptors(cls, descriptors: Tensor) -> "DescriptorStatistics":
        """Statistics of (N, D) descriptors, N >= 2, for example ``bank.descriptors`` as in the paper."""
        check_tensor(descriptors, "descriptors", (None, None))
        if len(descriptors) < 2:
            raise InvalidInputError(f"descriptors: expected at least 2, got {len(descriptors)}")
        x = descriptors.float()
        mean = x.mean(dim=0)
        x = x - mean
        fourth = float(x.square().sum(dim=1).double().square().mean())
        return cls(mean, x.T @ x / len(x), len(x), fourth)

    def shrinkage(self, rule: str | float) -> float:
        """The weight a in [0, 1] of the identity in (1 - a) Sigma + a tr(Sigma)/D Id.

        Args:
            rule: a number, or ``"ledoit-wolf"``, the closed form of Ledoit and Wolf (2004) for the weight that
                estimates the population's covariance best.

        Raises:
            InvalidInputError: another rule, or a number outside [0, 1].
        """
        if not isinstance(rule, str):
            if not (math.isfinite(rule) and 0.0 <= rule <= 1.0):
                raise InvalidInputError(f"shrinkage: expected a number in [0, 1], got {rule}")
            return float(rule)
        check_option(rule, ("ledoit-wolf",), "shrinkage")
        S = self.covariance.double()
        square = float(S.square().sum())
        spread = square - float(S.trace()) ** 2 / len(S)  # squared distance of S from its multiple of the identity
        if spread <= 0:
            return 1.0
        return min(1.0, max(0.0, (self.fourth - square) / self.count / spread))

    def whitening(self, *, shrinkage: str | float = 0.5) -> Whitening:
        """The whitening by these statistics, for example for :class:`ViewMatcher`.

        Args:
            shrinkage: see :meth:`shrinkage`. Descriptors of photographs and of renderings are different populations,
                so more shrinkage than the closed form gives (nearly 0) matches better: ``docs/experiments.md``.
        """
        a = self.shrinkage(shrinkage)
        S = self.covariance
        ridge = a * float(S.diagonal().mean()) * torch.eye(len(S), dtype=S.dtype, device=S.device)
        return Whitening(self.mean, (1.0 - a) * S + ridge)

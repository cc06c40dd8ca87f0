"""Covariances of descriptors: whitening, and products with the inverse."""

import torch
from torch import Tensor, nn

from ..errors import InvalidInputError
from ..utils.checks import check_finite, check_tensor


class Whitening(nn.Module):
    r"""x -> L^-1 (x - mean), where Sigma = L L^T: inner products become
    :math:`(x - \mu)^T \Sigma^{-1} (y - \mu)`. ``mean`` is (D,), ``covariance`` (D, D), symmetric,
    positive definite.

    Example:
        >>> whitening = Whitening(torch.ones(2), torch.diag(torch.tensor([4.0, 1.0])))
        >>> whitening(torch.tensor([[3.0, 2.0]])).tolist()
        [[1.0, 1.0]]
    """

    def __init__(self, mean: Tensor, covariance: Tensor) -> None:
        super().__init__()
        check_tensor(mean, "mean", (None,))
        check_tensor(covariance, "covariance", (len(mean), len(mean)))
        check_finite(mean, "mean")
        check_finite(covariance, "covariance")
        covariance = covariance.double()
        # Cholesky reads one half only
        if (covariance - covariance.T).norm() > 1e-4 * covariance.norm():
            raise InvalidInputError("covariance: expected a symmetric matrix")
        factor, failed = torch.linalg.cholesky_ex(covariance)
        if int(failed):
            raise InvalidInputError("covariance: expected a positive definite matrix; shrink it")
        identity = torch.eye(len(mean), dtype=torch.float64, device=mean.device)
        self.mean: Tensor
        self.matrix: Tensor
        self.register_buffer("mean", mean.float())
        self.register_buffer(
            "matrix", torch.linalg.solve_triangular(factor, identity, upper=False).float()
        )

    def forward(self, descriptors: Tensor) -> Tensor:
        """(N, D) -> (N, D)."""
        check_tensor(descriptors, "descriptors", (None, len(self.mean)))
        return (descriptors.to(self.mean) - self.mean) @ self.matrix.T


def ledoit_wolf(descriptors: Tensor) -> tuple[Tensor, Tensor]:
    """Mean (D,) and shrunk covariance (D, D) of (N, D) descriptors, N >= 2, float32. The covariance
    is (1 - a) S + a tr(S)/D Id with the a of Ledoit and Wolf (2004) that estimates the population's
    covariance best from the sample's covariance S."""
    mean, x, S = _centred(descriptors)
    S = x.T @ x / len(x) if S is None else S
    a = _shrinkage(x, S)
    ridge = a * float(S.diagonal().mean()) * torch.eye(len(S), dtype=S.dtype, device=S.device)
    return mean, (1.0 - a) * S + ridge


def _centred(descriptors: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
    """Mean (D,) of (N, D) descriptors, their differences x from it, and x^T x / N if N >= D;
    float32."""
    check_tensor(descriptors, "descriptors", (None, None))
    count = len(descriptors)
    if count < 2:
        raise InvalidInputError(f"descriptors: expected at least 2, got {count}")
    x = descriptors.float()
    mean = x.mean(dim=0)
    x = x - mean
    return mean, x, x.T @ x / count if count >= x.shape[1] else None


def _shrinkage(x: Tensor, product: Tensor) -> float:
    """The a of :func:`ledoit_wolf`, from x (N, D) with mean 0 and x^T x / N or x x^T / N, which
    have equal norms."""
    fourth = float(x.square().sum(dim=1).double().square().mean())
    square = float(product.double().square().sum())
    # Squared distance of the covariance from its multiple of the identity
    spread = square - float(product.double().trace()) ** 2 / x.shape[1]
    return min(1.0, max(0.0, (fourth - square) / len(x) / spread)) if spread > 0 else 1.0


class Precision(nn.Module):
    r"""y -> Sigma^-1 y, with the :func:`ledoit_wolf` covariance Sigma and the ``mean`` (D,) of (N,
    D) descriptors.

    With fewer descriptors than entries, N < D, Sigma = r Id + c x^T x is never formed: by
    Woodbury's identity :math:`\Sigma^{-1} y = (y - x^T (r/c\,Id + x x^T)^{-1} x y) / r`, in which
    the matrix to solve is (N, N).
    """

    def __init__(self, descriptors: Tensor) -> None:
        super().__init__()
        mean, x, S = _centred(descriptors)
        product = x @ x.T / len(x) if S is None else S
        a = _shrinkage(x, product)
        ridge = a * float(x.square().sum()) / x.numel()
        matrix = product.double() * (1.0 - a)
        matrix.diagonal().add_(ridge)
        factor, failed = torch.linalg.cholesky_ex(matrix)
        if int(failed) or (S is None and ridge <= 0.0):
            raise InvalidInputError(
                "descriptors: all views look alike; show the object from several sides"
            )
        self.ridge = ridge
        self.share = (1.0 - a) / len(x)
        self.mean: Tensor
        self.factor: Tensor
        self.register_buffer("mean", mean)
        self.register_buffer("factor", factor)
        self.x: Tensor | None
        self.register_buffer("x", x.double() if S is None else None)

    def forward(self, descriptors: Tensor) -> Tensor:
        """(B, D) -> (B, D) float32."""
        y = descriptors.to(self.mean).double()
        if self.x is None:
            return torch.cholesky_solve(y.T, self.factor).T.float()
        # The factor is that of c x x^T + r Id, c times the matrix of the identity.
        inner = torch.cholesky_solve(self.x @ y.T, self.factor).T
        return ((y - self.share * (inner @ self.x)) / self.ridge).float()

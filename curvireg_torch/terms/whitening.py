"""The linear map that decorrelates the entries of descriptors (LDA, Aubry et al. 2014)."""

import torch
from torch import Tensor, nn

from ..errors import InvalidInputError
from ..utils.checks import check_tensor

__all__ = ["Whitening", "ledoit_wolf"]


class Whitening(nn.Module):
    r"""x -> L^-1 (x - mean), where Sigma = L L^T: inner products become :math:`(x - \mu)^T \Sigma^{-1} (y - \mu)`.

    ``mean`` is (D,), ``covariance`` (D, D), symmetric, positive definite.

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
            raise InvalidInputError("covariance: expected a positive definite matrix; shrink it")
        identity = torch.eye(len(mean), dtype=torch.float64, device=mean.device)
        self.mean: Tensor
        self.matrix: Tensor
        self.register_buffer("mean", mean.float())
        self.register_buffer("matrix", torch.linalg.solve_triangular(factor, identity, upper=False).float())

    def forward(self, descriptors: Tensor) -> Tensor:
        """(N, D) -> (N, D)."""
        check_tensor(descriptors, "descriptors", (None, len(self.mean)))
        return (descriptors.to(self.mean) - self.mean) @ self.matrix.T


def ledoit_wolf(descriptors: Tensor) -> tuple[Tensor, Tensor]:
    """Mean (D,) and shrunk covariance (D, D) of (N, D) descriptors, N >= 2, float32.

    The covariance is (1 - a) S + a tr(S)/D Id with the a of Ledoit and Wolf (2004) that estimates the population's
    covariance best from the sample's covariance S.

    Example:
        >>> mean, covariance = ledoit_wolf(torch.rand(50, 8))
        >>> Whitening(mean, covariance)(torch.rand(3, 8)).shape
        torch.Size([3, 8])
    """
    check_tensor(descriptors, "descriptors", (None, None))
    count = len(descriptors)
    if count < 2:
        raise InvalidInputError(f"descriptors: expected at least 2, got {count}")
    x = descriptors.float()
    mean = x.mean(dim=0)
    x = x - mean
    fourth = float(x.square().sum(dim=1).double().square().mean())
    S = x.T @ x / count
    square = float(S.double().square().sum())
    spread = square - float(S.double().trace()) ** 2 / len(S)  # squared distance of S from its multiple of the identity
    a = min(1.0, max(0.0, (fourth - square) / count / spread)) if spread > 0 else 1.0
    ridge = a * float(S.diagonal().mean()) * torch.eye(len(S), dtype=S.dtype, device=S.device)
    return mean, (1.0 - a) * S + ridge

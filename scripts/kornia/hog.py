"""Histogram of oriented gradients of images with scikit-image's results, as it can be offered to
kornia.

It depends on torch alone, and follows kornia's habits: a function and its module, a Convention
block, no keyword-only options, errors of Python.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn


def histogram_of_oriented_gradients(
    input: Tensor,
    num_orientations: int = 9,
    cell_size: tuple[int, int] = (8, 8),
    block_size: tuple[int, int] = (3, 3),
    clip: float = 0.2,
    eps: float = 1e-5,
) -> Tensor:
    r"""Compute the histogram of oriented gradients (HOG) of each image.

    Convention:
        - Gradients are differences of the neighbours on both sides, zero at the border of the
          image; of several channels each pixel has the gradient of the channel in which it is
          longest.
        - Orientations are modulo 180 degrees. Bin :math:`i` holds those in
          :math:`[i, i + 1) \cdot 180 / n` degrees, from x to y. A pixel votes with the length of
          its gradient for one bin and one cell.
        - Blocks are normalised by L2-Hys. The result is that of ``skimage.feature.hog``.

    Args:
        input: the images with shape :math:`(B, C, H, W)`.
        num_orientations: number of bins.
        cell_size: height and width of a cell in px. Pixels beyond the last whole cell are ignored.
        block_size: height and width of a block in cells.
        clip: upper limit of L2-Hys.
        eps: added, squared, to squared norms of blocks.

    Returns:
        the descriptors with shape :math:`(B, R, S, B_H, B_W, N)`: rows and columns of blocks, rows
        and columns of cells in a block, orientations.

    Example:
        >>> histogram_of_oriented_gradients(torch.rand(2, 1, 64, 48)).shape
        torch.Size([2, 6, 4, 3, 3, 9])
    """
    if not isinstance(input, Tensor):
        raise TypeError(f"Input type is not a torch.Tensor. Got {type(input)}")
    if input.ndim != 4:
        raise ValueError(f"Invalid input shape, we expect BxCxHxW. Got {input.shape}")
    if not input.is_floating_point():
        raise TypeError(f"Input must be floating. Got {input.dtype}")
    if num_orientations < 1:
        raise ValueError(f"num_orientations must be positive. Got {num_orientations}")
    rows = input.shape[-2] // cell_size[0]
    columns = input.shape[-1] // cell_size[1]
    if rows < block_size[0] or columns < block_size[1]:
        raise ValueError(
            f"Input must hold one block of {block_size} cells of {cell_size} px. Got {input.shape}"
        )
    gx, gy = _longest_gradient(input)
    squared = gx * gx + gy * gy
    is_zero = squared == 0
    # The root has no derivative at 0.
    length = torch.where(is_zero, 1.0, squared).sqrt().masked_fill(is_zero, 0.0)
    position = torch.atan2(gy, gx).detach() * (num_orientations / math.pi)
    index = torch.remainder(
        torch.remainder(position, num_orientations).floor(), num_orientations
    ).long()
    votes = F.one_hot(index, num_orientations).movedim(-1, 1) * length[:, None]
    cells = F.avg_pool2d(votes[..., : rows * cell_size[0], : columns * cell_size[1]], cell_size)
    blocks = cells.unfold(2, block_size[0], 1).unfold(3, block_size[1], 1)
    blocks = blocks.permute(0, 2, 3, 4, 5, 1)
    return _normalised(_normalised(blocks, eps).clamp(max=clip), eps)


def _longest_gradient(input: Tensor) -> tuple[Tensor, Tensor]:
    """x and y differences (B, H, W) of the channel in which they are longest, zero at the
    border."""
    gx = F.pad(input[..., 2:] - input[..., :-2], (1, 1, 0, 0))
    gy = F.pad(input[..., 2:, :] - input[..., :-2, :], (0, 0, 1, 1))
    channel = (gx * gx + gy * gy).argmax(dim=1, keepdim=True)
    return gx.gather(1, channel)[:, 0], gy.gather(1, channel)[:, 0]


def _normalised(blocks: Tensor, eps: float) -> Tensor:
    squared = blocks.square().sum(dim=(3, 4, 5), keepdim=True)
    return blocks / (squared + eps**2).sqrt()


class HistogramOfOrientedGradients(nn.Module):
    """Module of :func:`histogram_of_oriented_gradients`, with the same options."""

    def __init__(
        self,
        num_orientations: int = 9,
        cell_size: tuple[int, int] = (8, 8),
        block_size: tuple[int, int] = (3, 3),
        clip: float = 0.2,
        eps: float = 1e-5,
    ) -> None:
        super().__init__()
        self.num_orientations = num_orientations
        self.cell_size = cell_size
        self.block_size = block_size
        self.clip = clip
        self.eps = eps

    def forward(self, input: Tensor) -> Tensor:
        options = self.num_orientations, self.cell_size, self.block_size, self.clip, self.eps
        return histogram_of_oriented_gradients(input, *options)

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}(num_orientations={self.num_orientations}, "
            f"cell_size={self.cell_size}, "
            f"block_size={self.block_size}, clip={self.clip}, eps={self.eps})"
        )

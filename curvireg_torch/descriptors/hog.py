"""Histogram of oriented gradients on a vector field."""

import math

import torch
from torch import Tensor, nn

from ..errors import InvalidInputError
from ..filters.blocks import Planes, in_blocks
from ..filters.inputs import finite_vectors
from ..filters.numerics import at_least_float32, floor, full_precision, image_maximum, readable, safe_sqrt
from ..utils.checks import check_field, check_option, check_positive, check_tensor

__all__ = ["HOG", "hog", "hog_length", "orientation_cells"]

VOTINGS = ("linear", "hard")

_EPSILON = 1e-5
"""Length of a block, in units of the image's longest one, below which it is nothing rather than a direction."""


def hog_length(*, grid: int = 8, bins: int = 9, block: int = 2) -> int:
    """Number of entries of a descriptor: (grid - block + 1)^2 block^2 bins.

    Example:
        >>> hog_length()
        1764
    """
    return (grid - block + 1) ** 2 * block**2 * bins


def hog(
    field: Tensor,
    *,
    grid: int = 8,
    bins: int = 9,
    block: int = 2,
    clip: float = 0.2,
    voting: str = "linear",
    bin_weights: Tensor | None = None,
) -> Tensor:
    """HOG (Dalal and Triggs 2005) of a vector field; the whole image is one grid of cells.

    A pixel votes with the vector's length for the vector's orientation modulo 180 degrees. ``"linear"`` shares a vote
    between the two nearest bins and the four nearest cells; ``"hard"`` gives it to one bin and one cell, as
    ``skimage.feature.hog`` does. Cell histograms are means over the cell's area; blocks of ``block`` x ``block`` cells
    are normalised by L2-Hys: to unit length, clipped, to unit length again. What counts as nothing is relative to the
    image's strongest block, so the descriptor does not change with the field's unit or the photograph's contrast.

    Args:
        field: (B, 2, H, W), channel 0 = x, 1 = y, H and W >= grid. Vectors with a NaN or infinite component have no
            vote.
        grid: cells along each side.
        bins: orientations over 180 degrees.
        block: cells along a block's side, <= grid.
        clip: upper limit of L2-Hys in (0, 1]; 1 switches it off.
        voting: ``"linear"`` or ``"hard"``.
        bin_weights: (bins,) factor on every vote for a bin, >= 0; differentiated through. In a graph (compiled,
            exported, under vmap) and on another device than the CPU the sign is not checked.

    Returns:
        (B, D), D = (grid - block + 1)^2 block^2 bins = 1764 by default, ordered block row, block column, cell row, cell
        column, bin; entries in [0, 1]. A field of zeros gives zeros. dtype kept (half types compute in float32).

    Raises:
        InvalidInputError: wrong shape, dtype or option, or fewer pixels than cells.

    Example:
        >>> hog(torch.randn(4, 2, 64, 64)).shape
        torch.Size([4, 1764])
    """
    check_field(field)
    limit = _check_options(grid, bins, block, clip, voting)
    H, W = field.shape[-2:]
    if min(H, W) < grid:
        raise InvalidInputError(f"field: expected at least {grid} x {grid} px for grid={grid}, got {H} x {W}")
    if bin_weights is not None:
        check_tensor(bin_weights, "bin_weights", (bins,))
        if readable(bin_weights) and not bool((bin_weights >= 0).all()):
            raise InvalidInputError(f"bin_weights: expected factors >= 0, got {bin_weights.tolist()}")

    def layer(field: Tensor) -> Planes:
        votes = _orientation_votes(finite_vectors(field), bins, voting)
        rows, columns = _cell_weights(H, grid, voting, votes), _cell_weights(W, grid, voting, votes)
        with full_precision(votes):
            cells = rows @ (votes @ columns.T)  # (B, bins, grid, grid)
        if bin_weights is not None:
            cells = cells * bin_weights.to(cells.dtype).view(1, -1, 1, 1)
        return (_normalised_blocks(cells, block, limit),)

    return in_blocks(layer, at_least_float32(field)).to(field.dtype)


def orientation_cells(field: Tensor, *, grid: tuple[int, int], bins: int = 9) -> Tensor:
    """The histograms of :func:`hog` before blocks are made of them, on a grid that need not be square.

    Args:
        field: (B, 2, H, W), channel 0 = x, 1 = y; vectors that are not finite have no vote.
        grid: rows and columns of cells, at most H and W.
        bins: orientations over 180 degrees.

    Returns:
        (B, bins, rows, columns) mean length of the vectors of each orientation, in the field's unit.

    Raises:
        InvalidInputError: wrong shape, dtype or option, or fewer pixels than cells.

    Example:
        >>> orientation_cells(torch.randn(1, 2, 48, 64), grid=(6, 8)).shape
        torch.Size([1, 9, 6, 8])
    """
    check_field(field)
    _check_options(min(grid), bins, 1, 1.0, "linear")
    H, W = field.shape[-2:]
    if grid[0] > H or grid[1] > W:
        raise InvalidInputError(f"field: expected at least {grid[0]} x {grid[1]} px for {grid=}, got {H} x {W}")
    votes = _orientation_votes(finite_vectors(at_least_float32(field)), bins, "linear")
    rows, columns = (_cell_weights(n, cells, "linear", votes) for n, cells in zip((H, W), grid, strict=True))
    with full_precision(votes):
        return (rows @ (votes @ columns.T)).to(field.dtype)


def _check_options(grid: int, bins: int, block: int, clip: float, voting: str) -> float:
    """clip."""
    check_option(voting, VOTINGS, "voting")
    if not 0 < clip <= 1:
        raise InvalidInputError(f"clip: expected 0 < clip <= 1, got {clip}")
    if bins < 1 or block < 1 or grid < block:
        raise InvalidInputError(f"expected bins >= 1 and 1 <= block <= grid, got {grid=}, {bins=}, {block=}")
    return check_positive(clip, "clip")


def _orientation_votes(field: Tensor, bins: int, voting: str) -> Tensor:
    """(B, bins, H, W): each pixel's length, shared among the bins of its orientation."""
    x, y = field[:, :1], field[:, 1:]
    length = safe_sqrt(x * x + y * y)
    # atan2 has no derivative at the origin: give it (1, 0) there; by arithmetic, torch.where takes ten times as long.
    angle = torch.atan2(y, x + (length == 0).to(x.dtype))
    position = torch.remainder(angle * (bins / math.pi), bins)  # bin i covers [i, i + 1)
    index = torch.arange(bins, device=field.device, dtype=field.dtype).view(1, -1, 1, 1)
    if voting == "hard":
        # remainder may round up to ``bins`` itself.
        return length * (torch.floor(position).clamp(max=bins - 1) == index)
    if bins == 1:
        return length
    # 1 - min(d, bins - d), written so that every step but the first can happen in place.
    half = 0.5 * bins
    distance = (position - (index + 0.5)).abs_().sub_(half).abs_()
    return distance.add_(1.0 - half).clamp_(min=0.0).mul_(length)


def _cell_weights(length: int, grid: int, voting: str, like: Tensor) -> Tensor:
    """(grid, length) share of each pixel in each cell along one axis, times the pixels-per-cell normalisation."""
    position = (torch.arange(length, device=like.device, dtype=like.dtype) + 0.5) * (grid / length)
    cell = torch.arange(grid, device=like.device, dtype=like.dtype)[:, None]
    if voting == "hard":
        weights = (torch.floor(position) == cell).to(like.dtype)
    else:
        weights = (1.0 - (position - (cell + 0.5)).abs()).clamp(min=0.0)
    return weights * (grid / length)


def _normalised_blocks(cells: Tensor, block: int, clip: float) -> Tensor:
    blocks = cells.unfold(2, block, 1).unfold(3, block, 1)  # (B, bins, n, n, block, block)
    blocks = blocks.permute(0, 2, 3, 4, 5, 1).flatten(3)  # (B, n, n, block * block * bins)
    squared = blocks.square().sum(-1, keepdim=True)
    blocks = blocks / (squared + (_EPSILON**2 * image_maximum(squared) + floor(squared))).sqrt()
    blocks = blocks.clamp(max=clip)
    blocks = blocks / (blocks.square().sum(-1, keepdim=True) + _EPSILON**2).sqrt()
    return blocks.flatten(1)


class HOG(nn.Module):
    """HOG of a vector field, as a layer; module twin of :func:`hog`.

    Args:
        grid: cells along each side.
        bins: orientations over 180 degrees.
        block: cells along a block's side, <= grid.
        clip: upper limit of L2-Hys in (0, 1].
        voting: ``"linear"`` or ``"hard"``.
        learnable: make the logarithms of the weights of the bins, 0 at first, a parameter, ``log_bin_weights``.

    Shape:
        Input (B, 2, H, W); output (B, D), D = :func:`hog_length` of grid, bins and block.

    Example:
        >>> import torch
        >>> layer = HOG(grid=4)
        >>> layer(torch.randn(2, 2, 32, 32)).shape, layer.length
        (torch.Size([2, 324]), 324)
    """

    log_bin_weights: nn.Parameter | None

    def __init__(
        self,
        *,
        grid: int = 8,
        bins: int = 9,
        block: int = 2,
        clip: float = 0.2,
        voting: str = "linear",
        learnable: bool = False,
    ) -> None:
        super().__init__()
        _check_options(grid, bins, block, clip, voting)
        self.grid, self.bins, self.block, self.clip, self.voting = grid, bins, block, clip, voting
        self.log_bin_weights = nn.Parameter(torch.zeros(bins)) if learnable else None

    @property
    def bin_weights(self) -> Tensor | None:
        """(bins,) learnt factors on the votes, positive after any step; None if not learnable."""
        return None if self.log_bin_weights is None else self.log_bin_weights.exp()

    @property
    def length(self) -> int:
        """Number of entries of a descriptor."""
        return hog_length(grid=self.grid, bins=self.bins, block=self.block)

    def half_turned(self, descriptors: Tensor) -> Tensor:
        """(B, D) of fields turned by 180 degrees, of the (B, D) of the fields: cells change places, orientations stay.

        Example:
            >>> field, layer = torch.randn(1, 2, 64, 64), HOG()
            >>> torch.allclose(layer.half_turned(layer(field)), layer(-field.rot90(2, (2, 3))), atol=1e-6)
            True
        """
        n = self.grid - self.block + 1
        cells = descriptors.view(-1, n, n, self.block, self.block, self.bins)
        return cells.flip(1, 2, 3, 4).flatten(1)

    def forward(self, field: Tensor) -> Tensor:
        return hog(
            field,
            grid=self.grid,
            bins=self.bins,
            block=self.block,
            clip=self.clip,
            voting=self.voting,
            bin_weights=self.bin_weights,
        )

    def extra_repr(self) -> str:
        return f"grid={self.grid}, bins={self.bins}, block={self.block}, clip={self.clip}, voting={self.voting!r}"

"""Histogram of oriented gradients on a vector field, and its feature points."""

import math

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..filters import operations as ops
from ..filters.modules import FunctionModule
from ..utils.checks import check_fraction, check_integer, check_tensor

# relative to the longest block of the image; normalisation suppresses shorter ones
MIN_BLOCK_LENGTH = 1e-5


def hog(
    field: Tensor,
    *,
    grid: int = 8,
    bins: int = 9,
    block: int = 2,
    clip: float = 0.2,
    bin_weights: Tensor | None = None,
) -> Tensor:
    """HOG (Dalal and Triggs 2005) of a vector field; one grid of cells covers the whole image.

    Each pixel votes with the length of its vector for the orientation of the vector modulo 180
    degrees, distributed linearly over the two nearest bins and the four nearest cells. Blocks of
    ``block`` x ``block`` cells are normalised by L2-Hys, relative to the strongest block of the
    image, so the descriptor is invariant to the unit of the field and to contrast.

    Args:
        field: (B, 2, H, W), channel 0 = x, 1 = y, H and W >= grid. Vectors that are not finite have
            no vote.
        grid: cells along each side.
        bins: orientations over 180 degrees.
        block: cells along the side of a block, <= grid.
        clip: upper limit of L2-Hys in (0, 1]; 1 disables clipping.
        bin_weights: (bins,) factor >= 0 on every vote for a bin; differentiable, and checked where
            it can be read.

    Returns:
        (B, D), D = (grid - block + 1)^2 block^2 bins = 1764 by default, ordered block row, block
        column, cell row, cell column, bin; entries in [0, 1]. A field of zeros gives zeros.

    Example:
        >>> hog(torch.randn(4, 2, 64, 64)).shape
        torch.Size([4, 1764])
    """
    return _hog(field, grid, bins, block, clip, bin_weights, with_quarter_turn=False)


def _hog(
    field: Tensor,
    grid: int,
    bins: int,
    block: int,
    clip: float,
    bin_weights: Tensor | None,
    *,
    with_quarter_turn: bool,
) -> Tensor:
    """:func:`hog`; ``with_quarter_turn`` (B, 2 D), followed by the descriptor of the field that is
    rotated clockwise by 90 degrees."""
    check_tensor(field, "field", (None, 2, None, None))
    clip = _check_options(grid, bins, block, clip)
    H, W = field.shape[-2:]
    if min(H, W) < grid:
        raise InvalidInputError(
            f"field: expected at least {grid} x {grid} px for grid={grid}, got {H} x {W}"
        )
    if bin_weights is not None:
        check_tensor(bin_weights, "bin_weights", (bins,))
        if ops.is_host_readable(bin_weights) and not (bin_weights >= 0).all():
            raise InvalidInputError(
                f"bin_weights: expected factors >= 0, got {bin_weights.tolist()}"
            )

    def layer(field: Tensor) -> ops.Planes:
        length, position = _orientations(ops.zero_nonfinite_vectors(field), bins)
        rows, columns = (_cell_weights(n, grid, length) for n in field.shape[-2:])

        def mean_votes(position: Tensor) -> Tensor:
            """(B, bins, grid, grid)."""
            votes = _votes(length, position, bins)
            with ops.full_precision(votes):
                return (rows @ votes) @ columns.T

        turns = [mean_votes(position)]
        if with_quarter_turn:
            across = _within(bins, position + 0.5 * bins)
            turns.append(mean_votes(across).rot90(-1, (2, 3)))
        if bin_weights is not None:
            factors = bin_weights.to(length.dtype).view(1, -1, 1, 1)
            turns = [cells * factors for cells in turns]
        return (torch.cat([_normalised_blocks(cells, block, clip) for cells in turns], dim=1),)

    return ops.apply_in_blocks(layer, ops.at_least_float32(field)).to(field.dtype)


def _check_options(grid: int, bins: int, block: int, clip: float) -> float:
    """Return ``clip`` as a number."""
    for name, value in (("grid", grid), ("bins", bins), ("block", block)):
        check_integer(value, name)
    if grid < block:
        raise InvalidInputError(f"block: expected 1 <= block <= grid, got {grid=}, {block=}")
    return check_fraction(clip, "clip")


def _orientations(field: Tensor, bins: int) -> tuple[Tensor, Tensor]:
    """(B, 1, H, W) vector length of each pixel, and its orientation in bins: bin i covers [i, i +
    1)."""
    x = field[:, :1]
    y = field[:, 1:]
    length = ops.safe_sqrt(x * x + y * y)
    # atan2 has no derivative at the origin: use (1, 0) there, by arithmetic, since torch.where
    # takes ten times as long.
    angle = torch.atan2(y, x + (length == 0).to(x.dtype))
    return length, _within(bins, angle * (bins / math.pi))


def _within(bins: int, position: Tensor) -> Tensor:
    """``torch.remainder`` of positions that are at most ``bins`` outside, in half of its time."""
    return position - bins * (position / bins).floor()


def _votes(length: Tensor, position: Tensor, bins: int) -> Tensor:
    """(B, bins, H, W) vector length of each pixel, distributed over the bins of its orientation."""
    if bins == 1:
        return length
    index = torch.arange(bins, device=length.device, dtype=length.dtype).view(1, -1, 1, 1)
    # 1 - min(d, bins - d), written so that all steps but the first are in place.
    half = 0.5 * bins
    distance = (position - (index + 0.5)).abs_().sub_(half).abs_()
    return distance.add_(1.0 - half).clamp_(min=0.0).mul_(length)


def _cell_weights(length: int, grid: int, like: Tensor) -> Tensor:
    """(grid, length) weight of each pixel in each cell along one axis, divided by the pixels per
    cell."""
    position = (torch.arange(length, device=like.device, dtype=like.dtype) + 0.5) * (grid / length)
    cell = torch.arange(grid, device=like.device, dtype=like.dtype)[:, None]
    return (1.0 - (position - (cell + 0.5)).abs()).clamp(min=0.0) * (grid / length)


def _normalised_blocks(cells: Tensor, block: int, clip: float) -> Tensor:
    blocks = cells.unfold(2, block, 1).unfold(3, block, 1)  # (B, bins, n, n, block, block)
    blocks = blocks.permute(0, 2, 3, 4, 5, 1).flatten(3)  # (B, n, n, block * block * bins)
    squared = blocks.square().sum(-1, keepdim=True)
    blocks = (
        blocks
        / (
            squared + (MIN_BLOCK_LENGTH**2 * ops.image_maximum(squared) + ops.safe_eps(squared))
        ).sqrt()
    )
    blocks = blocks.clamp(max=clip)
    blocks = blocks / (blocks.square().sum(-1, keepdim=True) + MIN_BLOCK_LENGTH**2).sqrt()
    return blocks.flatten(1)


class HOG(FunctionModule, learnable=("bin_weights",)):
    """Module twin of :func:`hog`: (B, 2, H, W) to (B, D), D = ``length``. ``learnable`` makes
    ``bin_weights`` (bins,), initially 1, positive parameters; otherwise it is None.

    Example:
        >>> layer = HOG(grid=4)
        >>> layer(torch.randn(2, 2, 32, 32)).shape, layer.length
        (torch.Size([2, 324]), 324)
    """

    grid: int
    bins: int
    block: int

    def __init__(
        self,
        *,
        grid: int = 8,
        bins: int = 9,
        block: int = 2,
        clip: float = 0.2,
        learnable: bool = False,
    ) -> None:
        _check_options(grid, bins, block, clip)
        weights = torch.ones(bins) if learnable else None
        options = {"grid": grid, "bins": bins, "block": block, "clip": clip}
        super().__init__(self._learnable if learnable else (), **options, bin_weights=weights)

    @property
    def length(self) -> int:
        """Number of entries of a descriptor: (grid - block + 1)^2 block^2 bins."""
        return (self.grid - self.block + 1) ** 2 * self.block**2 * self.bins

    def with_quarter_turn(self, field: Tensor) -> tuple[Tensor, Tensor]:
        """Descriptors (B, D) of square fields (B, 2, S, S), and of the same rotated clockwise by 90
        degrees, at three quarters of the time of both."""
        both = _hog(field, **self.options, with_quarter_turn=True)
        upright, sideways = both.chunk(2, dim=1)
        return upright, sideways

    def rotated_by_180(self, descriptors: Tensor) -> Tensor:
        """Descriptors (B, D) of the fields rotated by 180 degrees: cells are permuted, orientations
        are unchanged."""
        return self._cells(descriptors).flip(1, 2, 3, 4).flatten(1)

    def mirrored(self, descriptors: Tensor) -> Tensor:
        """Descriptors (B, D) of the fields as a mirror shows them, whose left is their right, if
        the weights of bins are equal."""
        return self._cells(descriptors).flip(2, 4, 5).flatten(1)

    def _cells(self, descriptors: Tensor) -> Tensor:
        """(B, block row, block column, cell row, cell column, bin) of descriptors (B, D)."""
        n = self.grid - self.block + 1
        return descriptors.view(-1, n, n, self.block, self.block, self.bins)

    def forward(self, field: Tensor) -> Tensor:
        return hog(field, **self.options)


def field_points(field: Tensor, *, fraction: float = 0.04) -> Tensor:
    """Feature points: vectors longer than both neighbours along their direction, rounded to 45
    degrees as in Canny, restricted to the longest. Ties at the limit of ``fraction`` are all
    selected; vectors of length 0 never.

    Args:
        field: (B, 2, H, W). Vectors with a NaN or infinite component count as 0.
        fraction: of the pixels of the image, in (0, 1].

    Returns:
        (B, 1, H, W) bool.

    Example:
        >>> field = torch.zeros(1, 2, 9, 9)
        >>> field[0, 0, :, 3:6] = torch.tensor([1.0, 2.0, 1.0])  # a ridge along y, pointing along x
        >>> field_points(field, fraction=1.0)[0, 0].sum(dim=0).tolist()
        [0, 0, 0, 0, 9, 0, 0, 0, 0]
    """
    check_tensor(field, "field", (None, 2, None, None))
    x, y = ops.zero_nonfinite_vectors(ops.at_least_float32(field)).split(1, dim=1)
    length = ops.safe_sqrt(x * x + y * y)
    return strongest_points(length, ops.is_directional_maximum(length, x, y), fraction)


def strongest_points(response: Tensor, candidates: Tensor, fraction: float) -> Tensor:
    """Candidates (B, 1, H, W) with the largest response > 0, up to ``fraction`` of the pixels of
    each image."""
    check_fraction(fraction, "fraction")
    B, _, H, W = response.shape
    if B == 0:
        return candidates
    candidates = candidates & (response > 0)
    count = max(1, int(fraction * H * W))
    if ops.is_host_readable(response) and not (candidates.sum(dim=(1, 2, 3)) > count).any():
        return candidates  # most views have fewer, and topk is slow
    limit = (
        torch.where(candidates, response, 0.0)
        .flatten(1)
        .topk(count, dim=1, sorted=False)
        .values.amin(dim=1)
    )
    return candidates & (response >= limit.view(B, 1, 1, 1))

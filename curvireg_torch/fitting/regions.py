"""Colours of the object and of the background, and where along lines the object's colours end."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

COLOUR_LEVELS = 8  # Levels of each colour channel in a histogram
SECTORS = 12  # Directions from the object's centre in the image, each with its own histograms
LOCAL_WEIGHT = 0.7  # Weight of a sector's own histogram; the rest is the mean of all sectors
# Added to probabilities, so that a colour never seen is not proof
MIN_PROBABILITY = 0.3 / COLOUR_LEVELS**3
MAX_LOG_RATIO = 4.0  # Largest log ratio of one pixel
LOG_RATIO_FACTOR = 0.3  # Factor of log ratios: neighbouring pixels are not independent
LEARNING_RATE = 0.2  # Weight of a new frame in the histograms
HALF_RATE_COUNT = 20.0  # Pixels of a sector with which it learns at half of the rate


def colour_bins(colours: Tensor) -> Tensor:
    """(S, S) int64 histogram bin of each pixel of (1, 3, S, S) colours in [0, 1]."""
    red, green, blue = (colours[0] * COLOUR_LEVELS).long().clamp(0, COLOUR_LEVELS - 1)
    bins: Tensor = (red * COLOUR_LEVELS + green) * COLOUR_LEVELS + blue
    return bins


def line_posterior(log_ratio: Tensor, radius: int) -> tuple[Tensor, Tensor]:
    """Mean (P,) px and variance (P,) px² of where P lines leave the object, from the colours along
    them.

    If a line leaves the object at d, its pixels before d show the object and those behind it the
    background. With r(l) = log p(colour at l | object) - log p(colour at l | background), the
    logarithm of the likelihood of d is, but for a constant, the sum of r(l) over l < d. The prior
    is uniform from -radius to radius px. ``log_ratio`` (P, L) is r at the offsets -h to h px along
    lines that point out of the object, L = 2 h + 1, h >= ``radius``.
    """
    half = log_ratio.shape[-1] // 2
    log_likelihood = log_ratio.cumsum(dim=-1)[..., half - radius : half + radius]
    d = torch.arange(-radius, radius, dtype=log_ratio.dtype) + 0.5  # between two pixels
    p = log_likelihood.softmax(dim=-1)
    mean = (p * d).sum(dim=-1)
    return mean, (p * (d - mean[..., None]).square()).sum(dim=-1)


class RegionModel:
    """Colour histograms of the object and of the background, a pair for each direction from the
    object's centre. Directions are angles in rad of the image's x, y axes; between the middles of
    two sectors both count."""

    def __init__(self) -> None:
        self._histograms = torch.zeros(2, SECTORS, COLOUR_LEVELS**3)
        self._log_ratio = torch.zeros(SECTORS * COLOUR_LEVELS**3)

    def learn(self, bins: Tensor, uv: Tensor, directions: Tensor, inside: Tensor) -> None:
        """Move the histograms towards the colours at ``uv`` (M, 2) px of ``bins`` (S, S), in
        ``directions`` (M,) rad from the object's centre, ``inside`` (M,) bool the object; empty
        histograms take all of them."""
        colour, seen = _colours_at(bins, uv)
        colour = colour[seen]
        low, high, fraction = _sectors(directions[seen])
        side = (~inside[seen]).long()
        new = torch.zeros_like(self._histograms)
        for sector, weight in ((low, 1.0 - fraction), (high, fraction)):
            new.view(-1).index_add_(
                0, (side * SECTORS + sector) * COLOUR_LEVELS**3 + colour, weight.float()
            )
        count = new.sum(dim=-1, keepdim=True)
        new = new / count.clamp(min=1e-9)
        step = LEARNING_RATE * count / (count + HALF_RATE_COUNT)
        empty = self._histograms.sum(dim=-1, keepdim=True) == 0
        self._histograms = torch.where(empty, new, (1.0 - step) * self._histograms + step * new)
        cube = self._histograms.view(-1, 1, COLOUR_LEVELS, COLOUR_LEVELS, COLOUR_LEVELS)
        for axis in range(3):  # smooth along each colour channel
            shape = [1, 1, 1]
            pad = [0] * 6
            shape[axis], pad[4 - 2 * axis], pad[5 - 2 * axis] = 3, 1, 1
            kernel = torch.tensor([0.2, 0.6, 0.2]).view(1, 1, *shape)
            cube = F.conv3d(F.pad(cube, pad, mode="replicate"), kernel)
        p = cube.view_as(self._histograms)
        p = LOCAL_WEIGHT * p + (1.0 - LOCAL_WEIGHT) * p.mean(dim=1, keepdim=True) + MIN_PROBABILITY
        self._log_ratio = LOG_RATIO_FACTOR * (p[0] / p[1]).log().clamp(
            -MAX_LOG_RATIO, MAX_LOG_RATIO
        ).view(-1)

    def log_ratio(self, bins: Tensor, uv: Tensor, directions: Tensor) -> Tensor:
        """(P, L) log p(colour | object) - log p(colour | background), times ``LOG_RATIO_FACTOR``,
        at (P, L, 2) px of lines in ``directions`` (P,); 0 outside the window."""
        colour, seen = _colours_at(bins, uv)
        low, high, fraction = (x[:, None] for x in _sectors(directions))
        of_low, of_high = (
            self._log_ratio[sector * COLOUR_LEVELS**3 + colour] for sector in (low, high)
        )
        return torch.lerp(of_low, of_high, fraction.to(of_low.dtype)) * seen


def _colours_at(bins: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Bins (...) of the pixels nearest to ``uv`` (..., 2), and whether they lie in the window."""
    side = bins.shape[-1]
    x, y = uv.round().long().unbind(-1)
    seen = (x >= 0) & (x < side) & (y >= 0) & (y < side)
    return bins[y.clamp(0, side - 1), x.clamp(0, side - 1)], seen


def _sectors(directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The two sectors beside each direction, and the weight of the second."""
    place = (directions / (2.0 * math.pi) % 1.0) * SECTORS
    low = place.floor()
    return low.long() % SECTORS, (low.long() + 1) % SECTORS, place - low

"""Colours of the object and of the background, and where along lines the object's colours end."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

COLOUR_LEVELS = 8  # Levels of each colour channel in a histogram
SECTORS = 12  # Directions from the object's centre in the image, each with its own histograms
DIRECTIONS = 72  # Directions of which the log ratios are kept, each between two sectors
LOCAL_WEIGHT = 0.7  # Weight of a sector's own histogram; the rest is the mean of all sectors
BINS = COLOUR_LEVELS**3  # of a histogram
# Added to probabilities, so that a colour never seen is not proof
MIN_PROBABILITY = 0.3 / BINS
MAX_LOG_RATIO = 4.0  # Largest log ratio of one pixel
LOG_RATIO_FACTOR = 0.3  # Factor of log ratios: neighbouring pixels are not independent
LEARNING_RATE = 0.2  # Weight of a new frame in the histograms
HALF_RATE_COUNT = 20.0  # Pixels of a sector with which it learns at half of the rate
# Smooths along one channel; the first and the last level repeat beyond
LEVEL_KERNEL = 0.6 * torch.eye(COLOUR_LEVELS, dtype=torch.float32) + sum(
    0.2 * torch.ones(COLOUR_LEVELS - 1, dtype=torch.float32).diag(side) for side in (-1, 1)
)
LEVEL_KERNEL[0, 0] = LEVEL_KERNEL[-1, -1] = 0.8


def colour_bins(colours: Tensor) -> Tensor:
    """(S, S) int32 histogram bin of each pixel of (1, 3, S, S) colours in [0, 1]."""
    red, green, blue = (colours[0] * COLOUR_LEVELS).clamp(0, COLOUR_LEVELS - 1).int()
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
    within = slice(half - radius, half + radius)
    log_likelihood = log_ratio.cumsum(dim=-1)[..., within]
    p = log_likelihood.softmax(dim=-1)
    d = torch.arange(-radius, radius, dtype=log_ratio.dtype) + 0.5  # between two pixels
    mean = (p * d).sum(dim=-1)
    square = (d - mean[..., None]).square()
    variance = (p * square).sum(dim=-1)
    return mean, variance


class Silhouette(NamedTuple):
    """Q contour points that have the background beside them: pixels ``uv`` (Q, 2), unit ``normals``
    (Q, 2) that point there, and ``directions`` (Q,) rad from the object's centre."""

    uv: Tensor
    normals: Tensor
    directions: Tensor

    def lines(self, offsets: Tensor) -> Tensor:
        """Pixels (Q, L, 2) at offsets (L,) px along the normals."""
        return self.uv[:, None] + offsets[:, None] * self.normals[:, None]


class RegionModel:
    """Colour histograms of the object and of the background, a pair for each direction from the
    object's centre. Directions are angles in rad of the image's x, y axes; between the middles of
    two sectors both count."""

    def __init__(self) -> None:
        self._histograms = torch.zeros(2, SECTORS, BINS, dtype=torch.float32)
        self._log_ratio = torch.zeros(DIRECTIONS * BINS, dtype=torch.float32)
        directions = torch.arange(DIRECTIONS).float() * (SECTORS / DIRECTIONS)
        apart = directions[:, None] - torch.arange(SECTORS)
        half_turn = 0.5 * SECTORS
        apart = (apart + half_turn) % SECTORS - half_turn
        self._sectors = (1.0 - apart.abs()).clamp(min=0.0)  # weights in each direction

    def learn(self, bins: Tensor, uv: Tensor, directions: Tensor, inside: Tensor) -> None:
        """Move the histograms towards the colours of ``bins`` (S, S) at ``uv`` (P, L, 2) px of
        lines in ``directions`` (P,) rad from the object's centre, ``inside`` (P, L) bool the
        object; empty histograms take all of them."""
        colour, seen = _colours_at(bins, uv)
        row = torch.where(inside, 0, DIRECTIONS) + _nearest(directions)[:, None]
        place = row * BINS + colour
        counts = torch.zeros(2, DIRECTIONS, BINS, dtype=torch.float32)
        counts.view(-1).index_add_(0, place.flatten(), seen.float().flatten())
        of_sectors = self._sectors.mT @ counts
        count = of_sectors.sum(dim=-1, keepdim=True)
        new = of_sectors / count.clamp(min=1e-9)
        step = LEARNING_RATE * count / (count + HALF_RATE_COUNT)
        empty = self._histograms.sum(dim=-1, keepdim=True) == 0
        moved = torch.lerp(self._histograms, new, step)
        self._histograms = torch.where(empty, new, moved)
        self._log_ratio = (self._sectors @ self._log_ratio_of_sectors()).view(-1)

    def _log_ratio_of_sectors(self) -> Tensor:
        """(SECTORS, BINS) of the histograms, smoothed, those of a sector mixed with the mean."""
        local = _smooth(self._histograms)
        mean = local.mean(dim=1, keepdim=True)
        inside, outside = torch.lerp(mean, local, LOCAL_WEIGHT) + MIN_PROBABILITY
        ratio: Tensor = (inside / outside).log()
        return LOG_RATIO_FACTOR * ratio.clamp(-MAX_LOG_RATIO, MAX_LOG_RATIO)

    def ends(self, bins: Tensor, silhouette: Silhouette, radius: int) -> tuple[Tensor, Tensor]:
        """Mean and variance (Q,) of where within ``radius`` px of a silhouette the object's colours
        end, see :func:`line_posterior`."""
        lines = silhouette.lines(torch.arange(-radius, radius + 1, dtype=torch.float64))
        ratio = self.log_ratio(bins, lines, silhouette.directions)
        return line_posterior(ratio.double(), radius)

    def log_ratio(self, bins: Tensor, uv: Tensor, directions: Tensor) -> Tensor:
        """(P, L) log p(colour | object) - log p(colour | background), times ``LOG_RATIO_FACTOR``,
        at (P, L, 2) px of lines in ``directions`` (P,); 0 outside the window."""
        colour, seen = _colours_at(bins, uv)
        row = _nearest(directions)[:, None]
        return self._log_ratio[row * BINS + colour] * seen


def _colours_at(bins: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Bins (...) of the pixels nearest to ``uv`` (..., 2), and whether they lie in the window."""
    pixel = uv.round().long()
    nearest = pixel.clamp(0, bins.shape[-1] - 1)
    return bins[nearest[..., 1], nearest[..., 0]], (nearest == pixel).all(dim=-1)


def _smooth(histograms: Tensor) -> Tensor:
    """Histograms (2, SECTORS, bins), smoothed along each colour channel."""
    by_red = LEVEL_KERNEL @ histograms.view(-1, COLOUR_LEVELS, COLOUR_LEVELS**2)
    return (by_red @ torch.kron(LEVEL_KERNEL, LEVEL_KERNEL)).view_as(histograms)


def _nearest(directions: Tensor) -> Tensor:
    """The nearest of ``DIRECTIONS`` to each of some directions."""
    return (directions * (DIRECTIONS / (2.0 * math.pi))).round().long() % DIRECTIONS

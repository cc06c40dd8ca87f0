"""Colours on both sides of an outline: where along its normals does the object end?"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

__all__ = ["Lines", "RegionModel", "colour_bins", "line_posterior"]

LEVELS = 8
"""Levels of each colour channel in a histogram."""

SECTORS = 12
"""Histograms around the object, one for each direction from its centre in the image."""


@dataclass(frozen=True)
class Lines:
    """Lines across an outline (P,): ``uv`` (P, 2) px and unit ``normals`` (P, 2) that point out of the object."""

    uv: Tensor
    normals: Tensor

    def samples(self, offsets: Tensor) -> Tensor:
        """(P, L, 2) px at offsets (L,) px along the normals."""
        return self.uv[:, None] + offsets[:, None] * self.normals[:, None]


def colour_bins(colours: Tensor) -> Tensor:
    """(S, S) int64 histogram bin of each pixel of (1, 3, S, S) colours in [0, 1]."""
    levels = (colours[0] * LEVELS).long().clamp(0, LEVELS - 1)
    return (levels[0] * LEVELS + levels[1]) * LEVELS + levels[2]


def line_posterior(log_ratio: Tensor, reach: int) -> tuple[Tensor, Tensor]:
    """Mean and variance in px of where lines cross the outline, from the colours along them.

    If the outline crosses at offset d, the pixels before d show the object and those behind it the background. With
    r(l) = log p(colour at l | object) - log p(colour at l | background), the logarithm of the likelihood of d is, but
    for a constant, the sum of r(l) over l < d. The prior is uniform over the offsets from -reach to reach.

    Args:
        log_ratio: (P, L) r at the offsets -h to h, L = 2 h + 1.
        reach: at most h px.

    Returns:
        (P,) and (P,).

    Example:
        >>> sharp = torch.tensor([[2.0, 2.0, 2.0, 2.0, -2.0, -2.0, -2.0]])           # the object ends after offset 0
        >>> mean, variance = line_posterior(sharp, 3)
        >>> round(float(mean), 2), float(variance) < 0.4
        (0.5, True)
    """
    half = log_ratio.shape[-1] // 2
    # The boundary lies half-way between two samples: after the sample at l, at d = l + 1/2.
    log_likelihood = log_ratio.cumsum(dim=-1)[..., half - reach : half + reach]
    d = torch.arange(-reach, reach, dtype=log_ratio.dtype) + 0.5
    p = log_likelihood.softmax(dim=-1)
    mean = (p * d).sum(dim=-1)
    return mean, (p * (d - mean[..., None]).square()).sum(dim=-1)


class RegionModel:
    """Colour histograms of the object and of the background around it, one pair for each sector."""

    def __init__(self, rate: float, temper: float) -> None:
        self.rate, self.temper = rate, temper
        self._counts = torch.zeros(2, SECTORS, LEVELS**3)
        self._table = torch.zeros(SECTORS, LEVELS**3)

    def learn(self, bins: Tensor, samples: Tensor, sectors: Tensor, inside: Tensor, valid: Tensor, rate: float) -> None:
        """Move the histograms towards the colours of samples (M, 2) px, ``inside`` (M,) the object or not."""
        x, y = samples.round().long().unbind(-1)
        S = bins.shape[-1]
        valid = valid & (x >= 0) & (x < S) & (y >= 0) & (y < S)
        colour = bins[y[valid], x[valid]]
        low, fraction = _sector_of(sectors[valid])
        new = torch.zeros_like(self._counts)
        side = (~inside[valid]).long()
        for sector, weight in ((low, 1.0 - fraction), ((low + 1) % SECTORS, fraction)):
            index = (side * SECTORS + sector) * LEVELS**3 + colour
            new.view(-1).index_add_(0, index, weight.float())
        total = new.sum(dim=-1, keepdim=True)
        new = new / total.clamp(min=1e-6)
        # A sector in which nothing was seen keeps its colours.
        step = rate * (total / (total + 20.0))
        known = self._counts.sum(dim=-1, keepdim=True) > 0
        self._counts = torch.where(known, (1.0 - step) * self._counts + step * new, new)
        smooth = self._smoothed(self._counts)
        p = smooth / smooth.sum(dim=-1, keepdim=True).clamp(min=1e-9)
        p = 0.7 * p + 0.3 * p.mean(dim=1, keepdim=True)
        floor = 0.3 / LEVELS**3
        self._table = self.temper * ((p[0] + floor).log() - (p[1] + floor).log()).clamp(-4.0, 4.0)

    @staticmethod
    def _smoothed(counts: Tensor) -> Tensor:
        kernel = torch.tensor([0.2, 0.6, 0.2])
        cube = counts.view(-1, 1, LEVELS, LEVELS, LEVELS)
        for shape, pad in (((1, 1, 3), (1, 1, 0, 0, 0, 0)), ((1, 3, 1), (0, 0, 1, 1, 0, 0)), ((3, 1, 1), (0, 0, 0, 0, 1, 1))):
            cube = F.conv3d(F.pad(cube, pad, mode="replicate"), kernel.view(1, 1, *shape))
        return cube.view_as(counts)

    def log_ratio(self, bins: Tensor, samples: Tensor, sectors: Tensor) -> Tensor:
        """(P, L) tempered log p(colour | object) - log p(colour | background) of samples (P, L, 2) on lines with
        directions ``sectors`` (P,) rad; 0 outside the window."""
        x, y = samples.round().long().unbind(-1)
        S = bins.shape[-1]
        seen = (x >= 0) & (x < S) & (y >= 0) & (y < S)
        colour = bins[y.clamp(0, S - 1), x.clamp(0, S - 1)]
        low, fraction = _sector_of(sectors)
        flat = self._table.view(-1)
        n = LEVELS**3
        a = flat[low[:, None] * n + colour]
        b = flat[((low + 1) % SECTORS)[:, None] * n + colour]
        f = fraction[:, None].to(a.dtype)
        return ((1.0 - f) * a + f * b) * seen


def _sector_of(angle: Tensor) -> tuple[Tensor, Tensor]:
    place = (angle / (2.0 * math.pi) % 1.0) * SECTORS
    low = place.floor()
    return low.long() % SECTORS, place - low

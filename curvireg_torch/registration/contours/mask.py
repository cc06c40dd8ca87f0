"""The object's mask in the contour fit: on which side of an edge the object lies."""

import torch
import torch.nn.functional as F
from torch import Tensor

from ...rendering.contours import ContourPoints

__all__ = ["ObjectMask"]

ASIDE = 6.0 / 256.0
"""Distance from an edge at which the mask is read on both sides, as a fraction of the crop's side: about 1.5 px of the
learned mask."""

TRUST = 0.7
"""Weight that an edge loses where the mask contradicts it."""

OUTLINE = 2.0
"""Weight of the outline relative to creases and inner contours, which prints and reflections imitate."""


class ObjectMask:
    """Probabilities (B, 1, s, s) that pixels of image crops belong to the object."""

    def __init__(self, probability: Tensor) -> None:
        self._probability = probability.detach().cpu().float()

    def weights(self, uv: Tensor, points: ContourPoints, offsets: Tensor, image_index: Tensor, size: int) -> Tensor:
        """How well edges at offsets along the normals of contour points agree with the mask.

        With p and q the probabilities 6/256 of the crop's side inward and outward of an edge, an edge of the outline
        has weight 2 (0.3 + 0.7 max(p - q, 0)), one within the object 0.3 + 0.7 min(p, q).

        Args:
            uv: (N, P, 2) px of the points in crops of ``size`` px.
            offsets: (L,) px along the normals.
            image_index: (N,) the crop of each pose.

        Returns:
            (N, P, L) float64, at most 2.
        """
        aside = ASIDE * size
        at = torch.cat([offsets - aside, offsets + aside])
        grid = ((2.0 * (uv[:, :, None] + at[:, None] * points.normals[:, :, None]) + 1.0) / size - 1.0).float()
        probability = grid.new_empty(grid.shape[:3])
        for b in image_index.unique().tolist():  # an expanded mask is not copied for every pose
            mine = (image_index == b).nonzero()[:, 0]
            mask = self._probability[b].expand(len(mine), -1, -1, -1)
            sampled = F.grid_sample(mask, grid[mine], padding_mode="border", align_corners=False)
            probability[mine] = sampled[:, 0]
        inside, outside = probability.double().chunk(2, dim=-1)
        outline, within = (inside - outside).clamp(min=0.0), torch.minimum(inside, outside)
        is_outline = points.outline[..., None]
        agreement = 1.0 - TRUST + TRUST * torch.where(is_outline, outline, within)
        return agreement * self.largest_weights(points)[..., None]

    @staticmethod
    def largest_weights(points: ContourPoints) -> Tensor:
        """(N, P) float64 weights of edges that agree with the mask: 2 for the outline, else 1."""
        return torch.where(points.outline, OUTLINE, 1.0).double()

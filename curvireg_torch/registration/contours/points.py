"""Edges of a photograph, to which contours are fitted."""

import torch
import torch.nn.functional as F
from torch import Tensor

from ...filters.derivatives import central_gradient, smooth

__all__ = ["EdgeField"]


class EdgeField:
    """Edges of image crops (B, C, S, S) in [0, 1]; the strongest of several channels counts."""

    def __init__(self, crops: Tensor) -> None:
        gx, gy = central_gradient(smooth(crops, 1.0))
        self._gradient = torch.stack([gx, gy], dim=2).flatten(1, 2)
        self._level = self._gradient.square().sum(dim=1).mean(dim=(1, 2)).sqrt().clamp(min=1e-6)

    def strength(self, uv: Tensor, normals: Tensor, offsets: Tensor, image_index: Tensor) -> Tensor:
        """Strength of the image gradient across a contour, at offsets along its normals.

        With g the gradient, m the crop's root mean square gradient and c = ``|n . g| / |g|``, r = ``|n . g| c^4`` gives
        the strength r / (r + m). It is 0 outside the crop; c^4 is one half where n and g differ by 33 degrees.

        Args:
            uv, normals: (N, P, 2) pixels of the crops and unit vectors.
            offsets: (L,) px along the normals.
            image_index: (N,) the crop of each pose.

        Returns:
            (N, P, L) float64 in [0, 1).
        """
        S = self._gradient.shape[-1]
        grid = ((2.0 * (uv[:, :, None] + offsets[:, None] * normals[:, :, None]) + 1.0) / S - 1.0).float()
        gradient = grid.new_empty(len(uv), self._gradient.shape[1], *grid.shape[1:3])
        for b in image_index.unique().tolist():  # an expanded crop is not copied for every pose
            mine = (image_index == b).nonzero()[:, 0]
            crop = self._gradient[b].expand(len(mine), -1, -1, -1)
            gradient[mine] = F.grid_sample(crop, grid[mine], align_corners=False)
        gx, gy = gradient[:, 0::2], gradient[:, 1::2]
        nx, ny = normals.to(gx.dtype)[:, None, :, None].unbind(-1)
        across = (gx * nx + gy * ny).abs()
        cosine = across * (gx * gx + gy * gy).clamp(min=1e-20).rsqrt()
        r = (across * cosine.square().square()).amax(dim=1)
        return (r / (r + self._level[image_index, None, None])).double()

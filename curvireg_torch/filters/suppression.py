"""Non-maximum suppression across the direction of a vector field."""

import torch
from torch import Tensor


def is_directional_maximum(length: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """True where ``length`` is a maximum along (x, y), rounded to 45 degrees as in Canny; all (B, 1, H, W)."""
    H, W = length.shape[-2:]
    p = length
    for dim in (-1, -2):  # F.pad would make a compiled graph recompute its input for every neighbour
        margin = torch.zeros_like(p.narrow(dim, 0, 1))
        p = torch.cat([margin, p, margin], dim=dim)

    def shifted(dx: int, dy: int) -> Tensor:
        return p[..., 1 + dy : 1 + dy + H, 1 + dx : 1 + dx + W]

    tan = 0.41421356  # tan 22.5 degrees
    horizontal, vertical = y.abs() <= tan * x.abs(), x.abs() <= tan * y.abs()
    diagonal = ~(horizontal | vertical)
    falling = diagonal & (x * y > 0)  # y points down: equal signs run from top left to bottom right
    result = torch.zeros_like(horizontal)
    for selected, dx, dy in ((horizontal, 1, 0), (vertical, 0, 1), (falling, 1, 1), (diagonal & ~falling, 1, -1)):
        # Strict on one side only, so that a plateau two pixels wide yields exactly one point.
        result = result | (selected & (length > shifted(dx, dy)) & (length >= shifted(-dx, -dy)))
    return result

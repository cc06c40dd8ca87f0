"""Views that differ by a turn about the optical axis, from one picture of each direction."""

import torch
from torch import Tensor

from .base import DepthRenderer, check_render_arguments

__all__ = ["render_views"]

FINENESS = 2.0
"""Pixels of a direction's picture per pixel of its views, across."""

FEWEST = 8
"""Turns of one direction that are worth a finer picture of it: four times the pixels, and the way there."""

SAME = 1e-5
"""Directions (radians) and places of cameras (share of the farthest) that count as one: 0.002 px in a view."""

ROOM = 8.0
"""A direction's picture may have so many times ``FINENESS``^2 the pixels of a view; framed views ask for 2 to 4."""


@torch.no_grad()
def render_views(
    renderer: DepthRenderer,
    T_cam_from_model: Tensor,
    camera_matrix: Tensor,
    size: tuple[int, int],
    *,
    orthographic: bool = False,
) -> Tensor:
    """As ``renderer.render``; where many views turn about one optical axis, one picture of that direction serves all.

    A camera's turn about its axis changes no z-depth: the pixels of the views are looked up in a picture of twice
    their resolution, nearest first, and moved along the surface to their own places. The surface goes on from a pixel
    by the smaller of its two slopes along each axis, of 1/z (of z where orthographic): exact on planes, and nothing is
    mixed across contours. Contours err by at most 1/4 px along each axis of the picture. Directions seen by fewer than
    ``FEWEST`` of the views are rendered view by view: hand over whole directions at a time, in any order.

    Args:
        renderer: of the mesh.
        T_cam_from_model, camera_matrix, size, orthographic: as for :meth:`DepthRenderer.render`.

    Returns:
        (N, 1, H, W) float32 z-depth in model units, 0 = background, on the renderer's device.

    Example:
        >>> import trimesh
        >>> from curvireg_torch.geometry import transform, uniform_views
        >>> from curvireg_torch.rendering import make_renderer
        >>> R = uniform_views(1, thetas=range(0, 360, 15)).rotations
        >>> T = transform(R, torch.tensor([0.0, 0, 5]).expand(24, 3))
        >>> K = torch.tensor([[100.0, 0, 31.5], [0, 100.0, 31.5], [0, 0, 1]])
        >>> render_views(make_renderer(trimesh.creation.box()), T, K, (64, 64)).shape
        torch.Size([24, 1, 64, 64])
    """
    T, K = check_render_arguments(T_cam_from_model, camera_matrix, size)
    groups = [g for g in _directions(T) if len(g) >= FEWEST]
    # A pixel p of a view stands at M p + o on the plane z = 1 (in model units where orthographic) of its group's first.
    frames, pictures = [], []
    border = torch.tensor([[-1.0, size[1], -1, size[1]], [-1, -1, size[0], size[0]]], dtype=T.dtype)
    for g in groups:
        M = T[g[0], :2, :3] @ T[g, :2, :3].mT @ torch.linalg.inv(K[g, :2, :2])
        o = -M @ K[g, :2, 2:]
        low, high = torch.aminmax((M @ border + o).transpose(0, 1).flatten(1), dim=1)
        f = FINENESS * K[g][:, [0, 1], [0, 1]].amax()
        W, H = (((high - low) * f).ceil().int() + 1).tolist()
        if ROOM * FINENESS**2 * size[0] * size[1] >= W * H:
            fine = torch.diag(torch.stack([f, f, torch.ones_like(f)]))
            fine[:2, 2] = -f * low
            frames.append((g, f * M, f * (o - low[:, None])))
            pictures.append((fine, H, W))
    depth: Tensor | None = None
    once = torch.ones(len(T), dtype=torch.bool)
    if frames:
        cameras = torch.stack([fine for fine, _, _ in pictures])
        largest = max(H for _, H, _ in pictures), max(W for _, _, W in pictures)
        first = torch.stack([g[0] for g, _, _ in frames])
        found = renderer.render(T[first], cameras, largest, orthographic=orthographic)[:, 0]
        depth = found.new_empty(len(T), 1, *size)
        for picture, (g, M, o) in zip(found, frames, strict=True):
            depth[g.to(depth.device), 0] = _looked_up(picture, M, o, size, orthographic)
            once[g] = False
    if not bool(once.any()) and depth is not None:
        return depth
    rest = renderer.render(T[once], K[once], size, orthographic=orthographic)
    if depth is None:
        return rest
    depth[once.to(depth.device)] = rest
    return depth


def _directions(T: Tensor) -> list[Tensor]:
    """Numbers of those of (N, 4, 4) cameras that stand in one place and look one way, for each such."""
    place = (T[:, :3, :3].mT @ T[:, :3, 3:])[..., 0]
    far = float(place.abs().amax()) if len(T) else 0.0
    key = (torch.cat([T[:, 2, :3], place / (far or 1.0)], dim=1) / SAME).round()
    _, direction, count = torch.unique(key, dim=0, return_inverse=True, return_counts=True)
    return list(direction.argsort(stable=True).split(count.tolist()))


def _looked_up(picture: Tensor, M: Tensor, o: Tensor, size: tuple[int, int], orthographic: bool) -> Tensor:
    """(n, H, W) depth of views whose pixels p stand at M p + o in the picture (H', W') of their direction."""
    seen = (picture > 0).nonzero()
    if len(seen) == 0:
        return picture.new_zeros(len(M), *size)
    (top, bottom), (left, right) = (  # the object and a rim around it, which stands for everything farther out
        (max(int(low) - 1, 0), min(int(high) + 1, n - 1))
        for low, high, n in zip(*seen.aminmax(dim=0), picture.shape, strict=True)
    )
    picture = picture[top : bottom + 1, left : right + 1]
    planes, low, high = _planes(picture, orthographic)
    o = o - torch.tensor([[left], [top]], dtype=o.dtype)
    M, o = M.float().to(picture.device), o.float().to(picture.device)
    H, W = picture.shape
    x = torch.arange(size[1], dtype=torch.float32, device=picture.device)
    y = torch.arange(size[0], dtype=torch.float32, device=picture.device)[:, None]
    u, v = (M[:, i, 0, None, None] * x + (M[:, i, 1, None, None] * y + o[:, i, :, None]) for i in (0, 1))
    column, row = ((c + 0.5).clamp_(0, n - 1).int() for c, n in ((u, W), (v, H)))
    nearest = row.mul_(W).add_(column).view(-1)
    w, dx, dy = (values.index_select(0, nearest).view_as(u) for values in planes.flatten(1))
    w.addcmul_(dx, u).addcmul_(dy, v).clamp_(low, high)
    if not orthographic:
        w.reciprocal_()
    return torch.nan_to_num_(w, nan=0.0)


def _planes(picture: Tensor, orthographic: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Of each pixel (x, y) of a picture the plane w = a + b x + c y through it, as (3, H, W), NaN beside the object,
    and the least and the greatest w. w is 1/z, or z where orthographic."""
    w = picture if orthographic else picture.reciprocal()
    w = w.masked_fill(picture == 0, torch.nan)
    low, high = torch.aminmax(w[picture > 0])
    y, x = (torch.arange(n, dtype=w.dtype, device=w.device) for n in w.shape)
    dx, dy = _slope(w, 1), _slope(w, 0)
    return torch.stack([w - dx * x - dy * y[:, None], dx, dy]), low, high


def _slope(w: Tensor, dim: int) -> Tensor:
    """The smaller step to the two neighbours along ``dim``; 0 where the steps differ in sign or none is known."""
    unknown = torch.full_like(w.narrow(dim, 0, 1), torch.nan)
    step = w.diff(dim=dim)
    before, behind = torch.cat([unknown, step], dim), torch.cat([step, unknown], dim)
    least, most = torch.fmin(before, behind), torch.fmax(before, behind)  # of the known one, where one is unknown
    return torch.nan_to_num_(least.clamp(min=0.0) + most.clamp(max=0.0), nan=0.0)

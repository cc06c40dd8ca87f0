"""Contours of the mesh pulled onto the photograph's edges: the continuous stage of the refinement."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from ..descriptors import field_points
from ..filters import depth_curvilinear_saliency, gaussian_smooth
from ..filters.curvilinear import fill_depth
from ..filters.derivatives import central_gradient
from ..geometry import rotation_from_axis_angle, transform
from ..rendering import DepthRenderer

import os
REACHES = eval(os.environ.get("REACHES", "(12.0, 8.0, 6.0, 4.0, 3.0, 2.0, 2.0)"))
OUTER, INNER = int(os.environ.get("NOUT", 256)), int(os.environ.get("NIN", 128))
JUMP = float(os.environ.get("JUMP", 0.05))
SHARE = float(os.environ.get("SHARE", 0.02))
SIGMA = float(os.environ.get("SIGMA", 1.0))
GATE = float(os.environ.get("GATE", 4))
LEVEL = float(os.environ.get("LEVEL", 1.0))
STEPS = int(os.environ.get("STEPS", 2))
WPOW = float(os.environ.get("WPOW", 1.0))


@dataclass(frozen=True)
class ContourPoints:
    model: Tensor
    normals: Tensor
    valid: Tensor


def contour_points(depth: Tensor, T: Tensor, K: Tensor, radius: float) -> ContourPoints:
    N, _, H, W = depth.shape
    seen = depth > 0
    z = torch.where(seen, depth, depth.amax(dim=(1, 2, 3), keepdim=True) + 4.0 * radius)
    gx, gy = central_gradient(gaussian_smooth(fill_depth(depth, None, None), 1.0))
    jumps, places, depths, normals = [], [], [], []
    v, u = torch.meshgrid(torch.arange(H, dtype=torch.float64), torch.arange(W, dtype=torch.float64), indexing="ij")
    at_jump = torch.zeros_like(seen)
    for dim, shift in ((-1, (0.5, 0.0)), (-2, (0.0, 0.5))):
        n = z.shape[dim]
        a, b = z.narrow(dim, 0, n - 1), z.narrow(dim, 1, n - 1)
        step = (b - a).abs()
        m = step.shape[dim]
        around = torch.cat([step.narrow(dim, 0, 1), step, step.narrow(dim, m - 1, 1)], dim=dim)
        usual = torch.minimum(around.narrow(dim, 0, m), around.narrow(dim, 2, m))
        jump = step - usual > JUMP * radius
        pad = (0, 1) if dim == -1 else (0, 0, 0, 1)
        at_jump |= F.pad(jump, pad) | F.pad(jump, (1, 0) if dim == -1 else (0, 0, 1, 0))
        jumps.append(jump.flatten(1))
        places.append(torch.stack([u + shift[0], v + shift[1]], -1).narrow(dim - 1, 0, n - 1).reshape(-1, 2))
        depths.append(torch.minimum(a, b).flatten(1))
        g = torch.cat([gx, gy], dim=1)
        g = 0.5 * (g.narrow(dim, 0, n - 1) + g.narrow(dim, 1, n - 1))
        normals.append(g.flatten(2).mT)
    parts = [(torch.cat(jumps, 1), torch.cat(places), torch.cat(depths, 1), torch.cat(normals, 1), OUTER)]
    if INNER:
        field = depth_curvilinear_saliency(depth, sigma=1.0)
        near = F.max_pool2d(at_jump.float(), 7, 1, 3) > 0
        field = torch.where(near, 0.0, field)
        crease = field_points(field, share=SHARE, threshold=float(os.environ.get("CTH", 0.0))) & seen
        parts.append((crease.flatten(1), torch.stack([u, v], -1).view(-1, 2), depth.flatten(1), field.flatten(2).mT, INNER))
    generator = torch.Generator().manual_seed(0)
    chosen = []
    for candidates, place, zs, ns, count in parts:
        keys = torch.rand(len(place), generator=generator)
        found, index = torch.where(candidates, keys, -1.0).topk(min(count, len(place)), dim=1)
        chosen.append((place[index], zs.gather(1, index), ns.gather(1, index[..., None].expand(-1, -1, 2)), found >= 0))
    uv, zs, ns, valid = (torch.cat(c, dim=1) for c in zip(*chosen, strict=True))
    ray = torch.cat([uv, torch.ones_like(uv[..., :1])], -1) @ torch.linalg.inv(K).T
    cam = ray * zs.double()[..., None]
    model = (cam - T[:, None, :3, 3]) @ T[:, :3, :3]
    length = torch.linalg.vector_norm(ns, dim=-1, keepdim=True)
    return ContourPoints(model, (ns / length.clamp(min=1e-12)).double(), valid & (length[..., 0] > 0))


class EdgeField:
    def __init__(self, crop: Tensor):
        smooth = gaussian_smooth(crop, SIGMA)
        gx, gy = central_gradient(smooth)
        self.gradient = torch.stack([gx, gy], dim=2).flatten(1, 2)  # (1, 2C, S, S)
        self.level = LEVEL * self.gradient.square().sum(dim=1).mean().sqrt()

    def profiles(self, uv: Tensor, normals: Tensor, offsets: Tensor) -> Tensor:
        """(N, P, L) strength in [0, 1) of edges along each normal."""
        S = self.gradient.shape[-1]
        N, P, _ = uv.shape
        at = uv[:, :, None] + offsets[:, None] * normals[:, :, None]
        grid = (2.0 * at + 1.0) / S - 1.0
        g = F.grid_sample(self.gradient.expand(N, -1, -1, -1), grid.float(), align_corners=False)
        g = g.unflatten(1, (-1, 2))
        n = normals.float().permute(2, 0, 1)[None, ..., None]  # 1 2 N P 1
        n = n.permute(2, 0, 1, 3, 4)  # N 1 2 P 1
        along = (g * n).sum(dim=2).abs()
        length = torch.linalg.vector_norm(g, dim=2)
        r = along * (along / length.clamp(min=1e-9)) ** GATE
        r = r.amax(dim=1)
        return r / (r + self.level)


def project(points: Tensor, T: Tensor, K: Tensor, centre: Tensor) -> tuple[Tensor, Tensor]:
    """uv (N, P, 2) and its derivative (N, P, 2, 6) by a turn about the centre and a shift of it, camera axes."""
    turned = (points - centre) @ T[:, :3, :3].mT
    cam = turned + (T[:, :3, :3] @ centre + T[:, :3, 3])[:, None]
    x, y, z = cam.unbind(-1)
    uvw = cam @ K.T
    z = z.clamp(min=1e-6)
    uv = uvw[..., :2] / z[..., None]
    o = torch.zeros_like(z)
    by_cam = torch.stack(
        [
            torch.stack([K[0, 0] / z, K[0, 1] / z, -(K[0, 0] * x + K[0, 1] * y) / z**2], -1),
            torch.stack([o, K[1, 1] / z, -K[1, 1] * y / z**2], -1),
        ],
        -2,
    )
    qx, qy, qz = turned.unbind(-1)
    by_turn = torch.stack(
        [torch.stack([o, qz, -qy], -1), torch.stack([-qz, o, qx], -1), torch.stack([qy, -qx, o], -1)], -2
    )
    return uv, by_cam @ torch.cat([by_turn, torch.eye(3, dtype=z.dtype).expand_as(by_turn)], dim=-1)


def moved(T: Tensor, step: Tensor, centre: Tensor) -> Tensor:
    turn = rotation_from_axis_angle(step[:, :3])
    R = turn @ T[:, :3, :3]
    position = T[:, :3, :3] @ centre + T[:, :3, 3] + step[:, 3:]
    return transform(R, position - R @ centre)


def fit(field: EdgeField, renderer: DepthRenderer, T: Tensor, K: Tensor, centre: Tensor, radius: float, size: int) -> Tensor:
    for reach in REACHES:
        depth = renderer.render(T, K, (size, size))
        points = contour_points(depth, T, K, radius)
        for _ in range(STEPS):
            uv, J = project(points.model, T, K, centre)
            n = points.normals
            Jn = (n[..., None, :] @ J)[..., 0, :]  # N P 6
            L = int(round(1.5 * reach)) + 1
            offsets = torch.arange(-L, L + 1, dtype=torch.float64)
            strength = field.profiles(uv, n, offsets).double()
            mid, before, after = strength[..., 1:-1], strength[..., :-2], strength[..., 2:]
            peak = (mid > before) & (mid >= after)
            bend = (before - 2 * mid + after).clamp(max=-1e-9)
            d = offsets[1:-1] + (0.5 * (before - after) / bend).clamp(-0.5, 0.5)
            value = torch.where(peak, mid, 0.0) * points.valid[..., None]
            step = torch.zeros(len(T), 6, dtype=torch.float64)
            s = 0.5 * reach
            for _ in range(3):
                e = (Jn @ step[..., None])[..., 0]
                gap = d - e[..., None]
                score = value * torch.exp(-0.5 * (gap / s) ** 2)
                best, index = score.max(dim=-1, keepdim=True)
                r = gap.gather(-1, index)[..., 0]
                target = d.gather(-1, index)[..., 0]
                w = value.gather(-1, index)[..., 0] ** WPOW * (1 - (r / (2 * s)) ** 2).clamp(min=0) ** 2
                A = Jn.mT @ (w[..., None] * Jn)
                b = (Jn.mT @ (w * target)[..., None])[..., 0]
                D = torch.diag_embed(A.diagonal(dim1=-2, dim2=-1)) * 1e-2 + 1e-9 * torch.eye(6, dtype=torch.float64)
                step = torch.linalg.solve(A + D, b)
            z = (T[:, :3, :3] @ centre + T[:, :3, 3])[:, 2]
            limit = torch.minimum(0.2 / step[:, :3].norm(dim=1), 0.1 * z / step[:, 3:].norm(dim=1)).clamp(max=1.0)
            T = moved(T, step * limit[:, None], centre)
    return T


def support(field: EdgeField, renderer: DepthRenderer, T: Tensor, K: Tensor, radius: float, size: int, reach: float = 2.0) -> Tensor:
    depth = renderer.render(T, K, (size, size))
    points = contour_points(depth, T, K, radius)
    uv, _ = project(points.model, T, K, torch.zeros(3, dtype=torch.float64))
    offsets = torch.arange(-3, 4, dtype=torch.float64)
    strength = field.profiles(uv, points.normals, offsets).double() * torch.exp(-0.5 * (offsets / (0.5*reach)) ** 2)
    best = strength.amax(dim=-1) * points.valid
    return best.sum(dim=1) / points.valid.sum(dim=1).clamp(min=1)


def halve(K):
    A = torch.tensor([[0.5, 0, -0.25], [0, 0.5, -0.25], [0, 0, 1]], dtype=K.dtype)
    return A @ K


REACH_A = eval(os.environ.get("REACH_A", "(6.0, 4.0, 3.0, 2.0)"))
REACH_B = eval(os.environ.get("REACH_B", "(6.0, 4.0, 3.0, 2.0, 2.0)"))
KEEP = int(os.environ.get("KEEP", 2))
SUPA = float(os.environ.get("SUPA", 2.0))


def multi(crop, renderer, starts, K, centre, radius, size):
    global REACHES
    small, Ks, s2 = F.avg_pool2d(crop, 2), halve(K), size // 2
    f2, f1 = EdgeField(small), EdgeField(crop)
    REACHES = REACH_A
    T = fit(f2, renderer, starts, Ks, centre, radius, s2)
    sup = support(f2, renderer, T, Ks, radius, s2, SUPA)
    T = T[sup.topk(min(KEEP, len(T))).indices]
    REACHES = REACH_B
    T = fit(f1, renderer, T, K, centre, radius, size)
    sup = support(f1, renderer, T, K, radius, size)
    return T[sup.argmax()][None]

"""What a mesh hides: the depth at which rays from cameras hit it, by rays on a CPU, and by tests of
all its faces on other devices."""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import torch
from torch import Tensor

from .embree import RayScene

TESTS_AT_A_TIME = 2**25  # of a ray and a face, 16 bytes each
# Barycentric coordinate, about, down to which a ray beside a face still hits it: there are no gaps
# between faces
BESIDE_FACE = 1e-6

DepthOf: TypeAlias = Callable[[Tensor, Tensor | None], Tensor]
"""(N, M) float32 depth where rays (x, y, 1), given by their x and y (N, M, 2), of N cameras hit the
mesh first; inf beside it, and for rays that are not ``wanted`` (N, M), None: all."""


class RayCaster:
    """The surface of a mesh with vertices (V, 3) and faces (F, 3), on a CPU."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        self._scene = RayScene(vertices, faces)

    def seen_from(self, R: Tensor, position: Tensor) -> DepthOf:
        """The depth in cameras in which the mesh has rotations (N, 3, 3) and its origin positions
        (N, 3), float64."""
        eye = -(position[:, None] @ R).float()
        across = R[:, :2].float()
        forward = R[:, 2:].float()

        def depth_of(rays: Tensor, wanted: Tensor | None) -> Tensor:
            directions = torch.baddbmm(forward, rays, across)
            origins = eye.expand_as(directions)
            if wanted is None:
                return self._distance(origins, directions).view(rays.shape[:2])
            depth = rays.new_full(wanted.shape, torch.inf)
            depth[wanted] = self._distance(origins[wanted], directions[wanted])
            return depth

        return depth_of

    def _distance(self, origins: Tensor, directions: Tensor) -> Tensor:
        """(M,) distances, in units of the directions, of rays (..., 3)."""
        origins = origins.reshape(-1, 3)
        directions = directions.reshape(-1, 3)
        return torch.from_numpy(self._scene.distance(origins.numpy(), directions.numpy()))


class FaceTests:
    """Like :class:`RayCaster` on one device: tests each ray against all faces, as a GPU does
    fast."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, device: torch.device) -> None:
        self._vertices = torch.from_numpy(vertices).to(device, torch.float64)
        self._faces = torch.from_numpy(faces).to(device, torch.long)

    def seen_from(self, R: Tensor, position: Tensor) -> DepthOf:
        vertices = self._vertices @ R.mT + position[:, None]
        equations = _ray_equations(vertices, self._faces)

        def depth_of(rays: Tensor, wanted: Tensor | None) -> Tensor:
            directions = torch.cat([rays, torch.ones_like(rays[..., :1])], dim=-1)
            tests = rays.shape[1] * len(self._faces)
            count = max(1, TESTS_AT_A_TIME // max(1, tests))
            parts = zip(directions.split(count), *(e.split(count) for e in equations), strict=True)
            inverse = torch.cat([_inverse_depth(*part) for part in parts])
            is_hit = inverse > 0 if wanted is None else wanted & (inverse > 0)
            return torch.where(is_hit, 1.0 / inverse, torch.inf)

        return depth_of


def _ray_equations(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """What tells where rays (x, y, 1) from the cameras hit faces, for float64 vertices (N, V, 3) in
    their frames: three (N, 3, F) float32 vectors.

    With the corners a, b, c of a face, a ray d hits it if d . (b x c), d . (c x a) and d . (a x b)
    have the sign of the determinant of a, b, c; divided by this, their sum is the inverse depth
    there. All are linear in d, so that rays times faces is a matrix product.
    """
    a, b, c = vertices[:, faces].unbind(dim=2)
    crosses = [torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)]
    volume = (a * crosses[0]).sum(dim=-1, keepdim=True)
    scale = torch.where(volume.abs() > 1e-12, 1.0 / volume, 0.0)  # 0: seen from the side
    first, second, third = ((scale * cross).float().mT.contiguous() for cross in crosses)
    return first, second, third


def _inverse_depth(rays: Tensor, first: Tensor, second: Tensor, third: Tensor) -> Tensor:
    """(N, M) inverse depth where rays (N, M, 3) hit the first of the faces of
    :func:`_ray_equations`, 0 where they hit none."""
    inverse = torch.bmm(rays, first)
    least = inverse.clone()
    for equations in (second, third):
        coordinate = torch.bmm(rays, equations)
        least = torch.minimum(least, coordinate)
        inverse += coordinate
    return inverse.masked_fill_(least < -BESIDE_FACE, 0.0).amax(dim=-1)

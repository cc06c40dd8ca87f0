"""Depth on the CPU, by ray casting with embree and by OpenCV's z-buffer: no GPU, no driver, no
display."""

import math
from collections.abc import Callable
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import torch
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from torch import Tensor

from ..geometry import camera_matrix, rotation_from_viewpoint
from ..geometry.cameras import transform
from ..mesh.edges import encloses_volumes
from ..mesh.mesh import Mesh, box_corners, extreme_points
from ..utils.aliases import Size
from ..utils.arrays import Array
from ..utils.threads import for_each
from .renderer import NEAREST, MeshRenderer

_MISS = 1e30  # embreex returns 1e37 where a ray hits nothing
_MAX_HULL_VERTICES = 200_000  # above, a convex hull takes more time than it saves
_MAX_COORDINATE = 16000  # px; OpenCV draws no polygons beyond
# Space, in object radii, between the object and the planes in front and behind it between which
# OpenCV draws
BESIDE = 1e-3
MAX_CULLED_FACES = 10_000  # Checking larger meshes takes longer than it saves
# Fraction of the object's pixels that may change where back faces are left out
DIFFERENT_PIXELS = 1e-3
# Depth, in object radii, beyond which single precision does not separate object and background
FARTHEST = 1000.0


class RayScene:
    """Triangles for ray casting: (V, 3) vertices and (F, 3) faces; rays have (N, 3) origins and
    directions."""

    def __init__(self, vertices: Array, faces: Array) -> None:
        self._scene = EmbreeScene()
        TriangleMesh(
            scene=self._scene,
            vertices=vertices.astype(np.float32),
            indices=np.asarray(faces, np.int32),
        )
        # builds embree's tree, which is not thread-safe
        self.distance(np.zeros((1, 3)), np.ones((1, 3)))

    def distance(self, origins: Array, directions: Array) -> Array:
        """(N,) float32 distances to the first hit, in units of the directions, which may be (1, 3);
        inf without one."""
        distance: Array = self._scene.run(float32(origins), float32(directions), query="DISTANCE")
        distance[distance >= _MISS] = np.inf
        return distance

    def hits(self, origins: Array, directions: Array) -> tuple[Array, ...]:
        """The first triangle hit (N,), -1 for none; barycentric u, v (N,) of its corners 2 and 3;
        the distance."""
        found = self._scene.run(
            float32(origins), float32(directions), query="INTERSECT", output=True
        )
        missed = found["tfar"] >= _MISS
        face = np.where(missed, -1, found["primID"])
        distance = np.where(missed, np.inf, found["tfar"])
        return face, found["u"], found["v"], distance


def float32(x: Array) -> Array:
    return np.ascontiguousarray(x, np.float32)


class EmbreeRenderer(MeshRenderer):
    """Casts one ray through each pixel's centre inside the outline of the object's hull, views in
    parallel on threads. Thread-safe, because rays only read the scene, and fork-safe. Cannot be
    pickled."""

    name = "embree"

    @cached_property
    def _scene(self) -> tuple[RayScene, Array]:
        """The triangles, and points (P, 3) whose hull is the object's."""
        few = len(self._mesh.vertices) <= _MAX_HULL_VERTICES
        outline = extreme_points(self._mesh) if few else box_corners(self._mesh)
        return RayScene(self._scaled(self._mesh.vertices), self._mesh.faces), self._scaled(outline)

    def _depth(self, T: Tensor, K: Tensor, size: Size, orthographic: bool) -> Tensor:
        scene, _ = self._scene
        return self._cast(T, K, size, orthographic, lambda _, *rays: scene.distance(*rays))

    def _cast(
        self,
        T: Tensor,
        K: Tensor,
        size: Size,
        orthographic: bool,
        hit: Callable[..., Array],
    ) -> Tensor:
        """(N, 1, H, W) depth; ``hit`` is called with the place of the pixels of a view that may
        show the object, and their rays, and returns the distances to what these hit."""
        poses = T.numpy()
        cameras = K.numpy()
        depth = np.zeros((len(T), *size), np.float32)

        def cast(i: int) -> None:
            if rays := self._rays(poses[i], cameras[i], size, orthographic):
                mask, starts, directions, near = rays
                z = hit((i, mask), starts, directions) + np.float32(near)
                depth[i, mask] = np.where(np.isinf(z), np.float32(0.0), z)

        for_each(len(T), cast)
        return torch.from_numpy(depth)[:, None]

    def faces_at(
        self,
        T_cam_from_model: Tensor,
        camera_matrix: Tensor,
        size: Size,
        *,
        orthographic: bool = False,
    ) -> tuple[Array, Array, Array, Tensor]:
        """(N, H, W) int32 faces that pixels show, -1 for none; (N, H, W) float32 u and v of their
        points (1 - u - v) a + u b + v c, with the face's corners a, b, c; and (N, 1, H, W)
        depth."""
        T, K = self._in_radii(T_cam_from_model, camera_matrix, size, orthographic)
        face = np.full((len(T), *size), -1, dtype=np.int32)
        u, v = (np.zeros(face.shape, np.float32) for _ in range(2))
        scene, _ = self._scene

        def hit(place: Any, *rays: Array) -> Array:
            face[place], u[place], v[place], along = scene.hits(*rays)
            return along

        return face, u, v, self._radius * self._cast(T, K, size, orthographic, hit)

    def _rays(
        self, T: Array, K: Array, size: Size, orthographic: bool
    ) -> tuple[Array, Array, Array, float] | None:
        """Pixels (H, W) that may show the object, origins and directions of their rays, and their
        start depth."""
        R = T[:3, :3]
        t = T[:3, 3]  # centre of the object in the camera
        outline = self._scene[1] @ R.T + t
        nearest = outline[:, 2].min()
        if outline[:, 2].max() <= NEAREST:
            return None  # entirely behind the camera
        mask = self._mask(outline, K, size, orthographic)
        # Rays start at the plane z = near close to the object, which keeps float32 precise for
        # distant objects. Rows and columns are computed in float64, pixels in float32.
        near = max(nearest - 1e-3, NEAREST)
        reach = 1.0 if orthographic else near
        y = (np.arange(size[0]) - K[1, 2]) / K[1, 1]
        x = (np.arange(size[1]) - K[0, 2]) / K[0, 0]
        pixels = np.nonzero(mask)
        starts = _combined(pixels, reach * x - t[0], reach * y - t[1], near - t[2], R)
        return (
            mask,
            starts,
            float32(R[2:]) if orthographic else _combined(pixels, x, y, 1.0, R),
            near,
        )

    def _mask(self, outline: Array, K: Array, size: Size, orthographic: bool) -> Array:
        """(H, W) bool: pixels inside the outline's projection, dilated by one pixel."""
        full = np.ones(size, dtype=bool)
        if orthographic:
            xy = outline[:, :2]
        elif outline[:, 2].min() > NEAREST:
            xy = outline[:, :2] / outline[:, 2:]
        else:
            return full  # the outline crosses the camera plane: no finite projection
        uv = xy @ K[:2, :2].T + K[:2, 2]
        if np.abs(uv).max() >= _MAX_COORDINATE:
            return full
        mask = np.zeros(size, dtype=np.uint8)
        cv2.fillConvexPoly(mask, cv2.convexHull(np.round(uv).astype(np.int32)), 1)
        return np.asarray(cv2.dilate(mask, np.ones((3, 3), np.uint8))).view(bool)


def _combined(pixels: tuple[Array, ...], x: Array, y: Array, z: float, axes: Array) -> Array:
    """(N, 3) float32 x(column) axes[0] + y(row) axes[1] + z axes[2] for the N rows and columns of
    pixels."""
    across = x.astype(np.float32)[:, None] * axes[0].astype(np.float32)
    down = y.astype(np.float32)[:, None] * axes[1].astype(np.float32) + (z * axes[2]).astype(
        np.float32
    )
    rays: Array = across.take(pixels[1], axis=0)  # four times as fast as across[pixels[1]]
    rays += down.take(pixels[0], axis=0)
    return rays


class RasterRenderer(EmbreeRenderer):
    """Draws into OpenCV's z-buffer, views in parallel on threads; casts rays where OpenCV is slower
    or wrong. The time of the z-buffer grows with the faces, that of ray casting with the pixels: it
    is used for meshes of fewer faces than the image has pixels. It does not clip faces that cross
    the near plane, is not precise far away, and knows no parallel projection. For ``many_views`` of
    at most ``MAX_CULLED_FACES`` faces it leaves out back faces, which halves the time, if all
    surfaces are closed, none is inside out, and pictures from eight sides are the same."""

    name = "auto"

    def __init__(self, mesh: Mesh | trimesh.Trimesh, *, many_views: bool = False) -> None:
        super().__init__(mesh)
        self._corners = self._scaled(box_corners(mesh))
        self._vertices = float32(self._scaled(mesh.vertices))[:, None]
        self._faces = np.array(mesh.faces, np.int32)[:, None]
        self.draws_back_faces = True
        if many_views and len(self._faces) <= MAX_CULLED_FACES and encloses_volumes(mesh):
            before = self._from_corners()
            self.draws_back_faces = False
            different = (self._from_corners() != before).sum()
            self.draws_back_faces = bool(different > DIFFERENT_PIXELS * (before > 0).sum())

    def _from_corners(self) -> Tensor:
        """(8, 1, 128, 128) depth from the corners of a cube around the object."""
        azimuths = torch.arange(45.0, 765.0, 90.0).double()
        elevations = torch.tensor([35.3, -35.3]).repeat_interleave(4)
        place = torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64)
        R = rotation_from_viewpoint(azimuths, elevations.double())
        K = camera_matrix(220.0, 220.0, 63.5, 63.5, dtype=torch.float64)
        return self._depth(transform(R, place.expand(8, 3)), K.expand(8, 3, 3), (128, 128), False)

    def _depth(self, T: Tensor, K: Tensor, size: Size, orthographic: bool) -> Tensor:
        if orthographic or len(self._faces) > size[0] * size[1]:
            return super()._depth(T, K, size, orthographic)
        poses = T.numpy()
        cameras = K.numpy()
        z = poses[:, 2, 3:] + poses[:, 2, :3] @ self._corners.T
        near = z.min(axis=1) - BESIDE
        far = z.max(axis=1) + BESIDE
        depth = np.zeros((len(T), 1, *size), np.float32)
        drawn = (near > NEAREST) & (far < FARTHEST)

        def draw(i: int) -> None:
            if drawn[i]:
                depth[i, 0] = self._draw(poses[i], cameras[i], size, float(near[i]), float(far[i]))

        for_each(len(T), draw)
        rest = torch.from_numpy(~drawn & (far > NEAREST))
        if rest.any():
            depth[rest.numpy()] = super()._depth(T[rest], K[rest], size, orthographic).numpy()
        return torch.from_numpy(depth)

    def _draw(self, T: Array, K: Array, size: Size, near: float, far: float) -> Array:
        """(H, W) depth of one view."""
        H, W = size
        # OpenCV's camera: axes of OpenGL, 90 degrees from the top to the bottom of the image,
        # centred, square pixels.
        x = [2.0 * K[0, 0], 0.0, 2.0 * K[0, 2] - (W - 1)]
        y = [0.0, -2.0 * K[1, 1], -(2.0 * K[1, 2] - (H - 1))]
        shear = np.array([x, y, [0.0, 0.0, -H]]) / H
        camera = (shear @ T[:3]).astype(np.float32)
        settings = cv2.TriangleRasterizeSettings()
        settings.setCullingMode(
            cv2.RASTERIZE_CULLING_NONE if self.draws_back_faces else cv2.RASTERIZE_CULLING_CW
        )
        z = np.full(size, far, np.float32)
        cv2.triangleRasterizeDepth(
            self._vertices, self._faces, z, camera, math.pi / 2.0, near, far, settings
        )
        z *= z <= far - 0.5 * BESIDE
        return z

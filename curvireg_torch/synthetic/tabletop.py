"""A photograph-like scene: an object on a wooden table before a wall, with soft shadows, depth of field and noise."""

from typing import Any

import cv2
import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from torch import Tensor

from ..errors import InvalidInputError
from ..geometry import projected_boxes
from ..mesh.mesh import mesh_centre, mesh_radius
from ..rendering.embree import RayScene
from ..utils.threads import for_each

__all__ = ["photograph_tabletop"]

Array = NDArray[Any]
Rng = np.random.Generator

PASSES = 4  # rays per pixel, each with its own part of the light
LAMP, SKY, BOUNCE = 2.2, 1.0, 0.1  # light of the lamp, of the room above, and from everywhere
LAMP_SIZE = 0.1  # tangent of half the angle under which the lamp is seen: the softness of shadows
LAMP_RAYS, SKY_RAYS = 4, 3  # shadow rays per pixel and pass
SHINE, SHININESS = 0.3, 60.0  # strength and exponent of the object's highlights
EDGE = np.cos(np.deg2rad(30))  # faces that meet at a smaller angle are shaded as one smooth surface
NOISE = 0.008  # standard deviation of the sensor's noise

OBJECT, THING, TABLE, WALL = range(4)
THINGS = np.array([(38, 92, 140), (226, 170, 52), (70, 122, 84), (214, 208, 196), (150, 62, 82)])
WALLS = np.array([(206, 200, 190), (176, 190, 196), (198, 186, 170)])


def photograph_tabletop(
    mesh: trimesh.Trimesh,
    T_cam_from_model: Tensor,
    camera_matrix: Tensor,
    size: tuple[int, int],
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """A synthetic photograph of a mesh in its face colours, which stands with z up on a table among other things.

    Args:
        mesh, T_cam_from_model, camera_matrix, size: the scene; (4, 4), (3, 3) and (H, W). The camera is above the
            table. (N, 4, 4) poses are photographs of one scene; it is furnished behind the object as the first camera
            sees it, so the others should be within about 45 degrees of azimuth.

    Returns:
        image (3, H, W) in [0, 1] and the object's box (4,) in px; (N, 3, H, W) and (N, 4) for (N, 4, 4) poses.

    Raises:
        InvalidInputError: the camera is below the table.

    Example:
        >>> from curvireg_torch.synthetic import example_mesh, random_pose
        >>> K, generator = torch.tensor([[130.0, 0, 59.5], [0, 130, 44.5], [0, 0, 1]]), torch.Generator().manual_seed(0)
        >>> pose = random_pose(example_mesh(), K, (90, 120), generator, elevations=(15.0, 45.0))
        >>> image, box = photograph_tabletop(example_mesh(painted=True), pose, K, (90, 120), generator)
        >>> tuple(image.shape)
        (3, 90, 120)
    """
    poses = T_cam_from_model.double().reshape(-1, 4, 4)
    rng = np.random.default_rng(int(torch.randint(2**31, (1,), generator=generator)))
    eyes = -(poses[:, :3, :3].mT @ poses[:, :3, 3:])[..., 0].numpy()
    if (eyes[:, 2] <= mesh.bounds[0, 2]).any():
        raise InvalidInputError("T_cam_from_model: expected a camera above the table, on which the mesh stands")
    scene = _Scene(mesh, eyes[0], rng)
    light = _Light(scene.away, rng)
    K = np.linalg.inv(camera_matrix.double().numpy())
    images = []
    for pose, eye in zip(poses.numpy(), eyes, strict=True):
        picture = _exposed(scene, light, pose, eye, K, size)
        images.append(torch.from_numpy(_develop(picture, rng)).permute(2, 0, 1).contiguous())
    vertices = torch.from_numpy(np.array(mesh.vertices, dtype=float))
    boxes = projected_boxes(vertices, poses, camera_matrix.double().expand(len(poses), 3, 3))
    return (images[0], boxes[0]) if T_cam_from_model.ndim == 2 else (torch.stack(images), boxes)


def _exposed(scene: "_Scene", light: "_Light", pose: Array, eye: Array, K: Array, size: tuple[int, int]) -> Array:
    """(H, W, 3) linear light through a lens; ``K`` is the inverse of the camera matrix."""
    pictures: list[Any] = [None] * PASSES

    def trace(k: int) -> None:
        v, u = np.mgrid[0.0 : size[0], 0.0 : size[1]].reshape(2, -1) + np.array([[k // 2], [k % 2]]) / 2 - 0.25
        rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ (K.T @ pose[:3, :3])  # of length 1 along the optical axis
        pictures[k] = scene.trace(eye, rays.astype(np.float32), light, k)

    for_each(PASSES, trace)
    colour, depth, cover = (np.mean([p[i] for p in pictures], axis=0).reshape(*size, -1) for i in range(3))
    return _defocus(colour, depth[..., 0], cover[..., 0], distance=float(pose[2, 3]), radius=scene.radius)


class _Light:
    """Directions (N, 3) to the lamp and to the sky, all in the mesh's frame."""

    def __init__(self, away: Array, rng: Rng) -> None:
        """``away`` is the horizontal direction in which the camera looks; the lamp hangs at its left or right."""
        across = np.array([away[1], -away[0], 0.0])
        towards = rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 0.9) * across - rng.uniform(0.0, 0.5) * away
        towards += (0.0, 0.0, rng.uniform(0.8, 1.2))
        self.lamp = _unit(_unit(towards) + LAMP_SIZE * _spread(PASSES * LAMP_RAYS, rng)).astype(np.float32)
        disc = _spread(PASSES * SKY_RAYS, rng)
        self.sky = (disc + (0.0, 0.0, 1.0) * np.sqrt(1.0 - _dot(disc, disc))[:, None]).astype(np.float32)


def _spread(n: int, rng: Rng) -> Array:
    """(n, 3) points spread evenly over the unit disc in the plane z = 0, in random order."""
    i = rng.permutation(n)
    radius, turn = np.sqrt((i + 0.5) / n), 2.4 * i + rng.uniform(0, 2 * np.pi)  # 2.4 rad is the golden angle
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), np.zeros(n)], axis=-1)


class _Scene:
    """All surfaces in the mesh's frame, whose z axis points up."""

    def __init__(self, mesh: trimesh.Trimesh, eye: Array, rng: Rng) -> None:
        self.radius, centre = mesh_radius(mesh), mesh_centre(mesh).numpy()
        self.foot = np.array([*centre[:2], mesh.bounds[0, 2]])
        self.away = _unit((centre - eye) * (1.0, 1.0, 1e-9))
        across = np.array([self.away[1], -self.away[0], 0.0])
        parts = [(OBJECT, mesh, _linear(mesh.visual.face_colors[:, :3]))]
        for place, colour in zip(rng.permutation(np.linspace(-3.0, 3.0, 5))[:3], rng.permutation(THINGS), strict=False):
            thing = _thing(rng).apply_scale(self.radius)
            where = rng.uniform(2.0, 3.5) * self.away + (place + rng.uniform(-0.4, 0.4)) * across
            parts.append((THING, thing.apply_translation(self.foot + self.radius * where), _linear(colour)))
        across, far = 60.0 * self.radius * across, 60.0 * self.radius * self.away
        wall = self.foot + rng.uniform(4.5, 7.0) * self.radius * self.away
        parts.append((TABLE, _plane(self.foot, across, far), np.ones(3)))
        parts.append((WALL, _plane(wall, across, np.array([0.0, 0.0, 60.0 * self.radius])), _linear(rng.choice(WALLS))))
        whole = trimesh.util.concatenate([trimesh.Trimesh(m.vertices, m.faces, process=False) for _, m, _ in parts])
        self.kind = np.repeat([kind for kind, *_ in parts], [len(m.faces) for _, m, _ in parts])
        albedo = np.concatenate([np.broadcast_to(colour, (len(m.faces), 3)) for _, m, colour in parts])
        self.albedo = albedo.astype(np.float32)
        self.normals = np.ascontiguousarray(_corner_normals(whole).astype(np.float32).transpose(1, 0, 2))
        self.rays = RayScene(whole.vertices, whole.faces)
        self.wood, self.grain = _wood(rng), rng.uniform(0, 2 * np.pi)

    def trace(self, eye: Array, rays: Array, light: _Light, k: int) -> tuple[Array, Array, Array]:
        """Linear light (N, 3), distance along the rays (N,) and whether they hit the object (N,), in pass ``k``."""
        face, u, v, distance = self.rays.barycentric_hits(np.broadcast_to(eye, rays.shape), rays)
        points = eye.astype(np.float32) + rays * distance[:, None]
        kind, albedo = self.kind[face], self.albedo[face]
        table, body = kind == TABLE, np.flatnonzero(kind == OBJECT)
        albedo[table] = self._table_colour(points[table])
        a, b, c = (corner.take(face, axis=0) for corner in self.normals)
        normal = _unit(a + u[:, None] * (b - a) + v[:, None] * (c - a))
        normal[_dot(normal, rays) > 0] *= -1.0  # both sides of a face are seen
        start = points + np.float32(1e-3 * self.radius) * normal
        view = -_unit(rays[body])
        level = np.full(len(rays), BOUNCE, np.float32)
        gleam = np.zeros(len(body), np.float32)
        for towards in light.lamp[k::PASSES]:
            lit = self._light_from(towards, start, normal)
            level += LAMP / LAMP_RAYS * lit
            gleam += (
                LAMP / LAMP_RAYS * (lit[body] > 0) * _dot(normal[body], _unit(view + towards)).clip(0.0) ** SHININESS
            )
        for towards in light.sky[k::PASSES]:
            level += SKY / SKY_RAYS * self._light_from(towards, start, normal)
        out = albedo * level[:, None]
        out[body] += SHINE * gleam[:, None]
        return out, distance, kind == OBJECT

    def _light_from(self, towards: Array, start: Array, normal: Array) -> Array:
        """Cosine at which the light of a direction falls on surfaces; 0 in the shadow."""
        blocked = self.rays.blocked(start, np.broadcast_to(towards, start.shape))
        return np.asarray(np.where(blocked, np.float32(0.0), (normal @ towards).clip(0.0)))

    def _table_colour(self, points: Array) -> Array:
        """Boards with a grain along one direction."""
        c, s = np.cos(self.grain) / self.radius, np.sin(self.grain) / self.radius
        along, over = np.array([[c, s], [-s, c]], np.float32) @ (points - self.foot.astype(np.float32))[:, :2].T
        side = len(self.wood)
        rows, columns = (np.floor(x * side).astype(int) % side for x in (over / 4.0, along / 12.0))
        return np.asarray(self.wood[rows, columns])


def _wood(rng: Rng) -> Array:
    """(1024, 1024, 3) linear colours of four boards, with the grain along the columns; repeats in both directions."""
    n = 1024
    y = np.arange(n)[:, None] / n
    picture = np.zeros((n, n), np.float32)
    for rows, columns, strength in ((8, 2, 0.5), (64, 4, 0.5), (256, 8, 0.35), (512, 64, 0.15)):
        noise = rng.normal(size=(rows, columns)).astype(np.float32)
        noise, (y0, x0) = np.pad(noise, 2, mode="wrap"), (2 * n // rows, 2 * n // columns)
        noise = cv2.resize(noise, (n + 2 * x0, n + 2 * y0), interpolation=cv2.INTER_CUBIC)
        picture += strength * noise[y0 : y0 + n, x0 : x0 + n]
    board = np.floor(4 * y).astype(int)[:, 0]
    picture += rng.normal(0, 0.5, 4).astype(np.float32)[board][:, None]
    gap = np.abs(4 * y - np.round(4 * y)) < 0.012
    colour = np.array([0.42, 0.25, 0.13]) * np.exp(0.16 * picture[..., None] * np.array([0.8, 1.0, 1.2]))
    return np.asarray(np.where(gap[..., None], 0.35 * colour, colour), np.float32)


def _thing(rng: Rng) -> trimesh.Trimesh:
    """Something that stands on the table, in radii of the object: a book, a can or a ball."""
    kind = rng.integers(3)
    if kind == 0:
        thing = trimesh.creation.box(rng.uniform((0.4, 0.7, 0.15), (0.9, 1.2, 0.8)))
    elif kind == 1:
        thing = trimesh.creation.cylinder(rng.uniform(0.25, 0.45), rng.uniform(0.6, 1.2), sections=64)
    else:
        thing = trimesh.creation.icosphere(subdivisions=4, radius=rng.uniform(0.25, 0.5))
    thing.apply_transform(trimesh.transformations.rotation_matrix(rng.uniform(0, np.pi), [0, 0, 1]))
    return thing.apply_translation([0.0, 0.0, -thing.bounds[0, 2]])


def _plane(centre: Array, a: Array, b: Array) -> trimesh.Trimesh:
    return trimesh.Trimesh(centre + np.stack([-a - b, a - b, a + b, b - a]), [[0, 1, 2], [0, 2, 3]], process=False)


def _corner_normals(mesh: trimesh.Trimesh) -> Array:
    """(F, 3, 3) normals at the corners of faces: means over the faces around a vertex that meet at no edge."""
    around = mesh.vertex_faces[mesh.faces]  # (F, 3, M), padded with -1
    normals = mesh.face_normals[around]
    same = (around >= 0) & (_dot(normals, mesh.face_normals[:, None, None]) > EDGE)
    return _unit((normals * (same * mesh.area_faces[around])[..., None]).sum(axis=2))


def _defocus(picture: Array, depth: Array, cover: Array, *, distance: float, radius: float) -> Array:
    """Blur what is farther than the object, which does not bleed into its surroundings.

    ``cover`` is the fraction of a pixel that shows the object; (H, W), like ``depth``. Blur grows with the difference
    of inverse depths, as that of a lens does, up to that of four radii behind the object.
    """
    strongest = 1.0 - 1.0 / (1.0 + 4.0 * radius / distance)
    far = np.clip((1.0 - distance / depth) / strongest, 0.0, 1.0)
    around = (1.0 - cover)[..., None]
    for blur, least in ((1.0, 0.15), (2.5, 0.45), (5.0, 0.9)):
        sigma = blur * max(picture.shape[:2]) / 960
        weight = cv2.GaussianBlur(1.0 - cover, (0, 0), sigma)[..., None]
        blurred = cv2.GaussianBlur(picture * around, (0, 0), sigma) / np.maximum(weight, 1e-3)
        picture = picture + np.clip((far - least) / 0.3 + 0.5, 0.0, 1.0)[..., None] * around * (blurred - picture)
    return picture


def _develop(picture: Array, rng: Rng) -> Array:
    """Exposure, vignetting, a film-like curve, the lens's softness and noise; float32 in [0, 1]."""
    height, width = picture.shape[:2]
    y, x = np.mgrid[-1.0 : 1.0 : height * 1j, -1.0 : 1.0 : width * 1j]
    exposed = picture * (1.0 / np.percentile(picture, 90)) * (1.0 - 0.13 * (x**2 + y**2))[..., None]
    curve = (exposed * (1.0 + exposed / 4.0) / (1.0 + exposed)) ** (1 / 2.2)
    soft = cv2.GaussianBlur(curve.astype(np.float32), (0, 0), 0.6)
    noisy: Array = soft * 1.12 + rng.normal(0, NOISE, picture.shape)
    return noisy.clip(0.0, 1.0).astype(np.float32)


def _linear(colour: Array) -> Array:
    """Linear light of 8-bit colours."""
    return (np.asarray(colour, dtype=float) / 255.0) ** 2.2


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("...i,...i->...", a, b))


def _unit(x: Array) -> Array:
    return np.asarray(x / np.sqrt(np.maximum(_dot(x, x), 1e-24))[..., None])

"""Sequences of photographs of real textured meshes with known poses, for following an object through a video.

The object stands or lies in a room with clutter of make.py; the camera moves around it, smoothly and at random.
Sequence i depends only on the seed, i and the meshes.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from curvireg_torch.geometry import rotation_from_axis_angle
from curvireg_torch.training.scenes.light import Light, random_light
from curvireg_torch.training.scenes.materials import random_picture
from curvireg_torch.training.scenes.rotations import random_rotation
from curvireg_torch.training.scenes.scene import simulate_camera
from scripts.benchmark.make import FULL_TURN, Meshes, clutter_around, ground_and_walls, scene_camera
from scripts.benchmark.textured import TexturedMesh, render

SIZE = (480, 640)
MAX_TURN, MAX_SHIFT = 5.0, 0.05
"""Largest rotation in degrees, and largest motion of the object's centre as a fraction of its distance, of a step."""
MIN_VISIBLE = 0.5
"""Smallest visible fraction of the silhouette in any frame."""

# Of azimuth, small rotation (3) in degrees, logarithm of the distance, and the centre's place in px: standard deviation
# of the acceleration, and the fraction of the displacement that pulls back to the start. The azimuth is free.
_ACCELERATION = np.array([1.2, 0.4, 0.4, 0.4, 0.014, 6.0, 6.0])
_PULL = np.array([0.0, 0.03, 0.03, 0.03, 0.03, 0.03, 0.03])
_PERSISTENCE = 0.9  # of the velocity


@dataclass(frozen=True)
class Sequence:
    """Frames of one object, made when they are asked for.

    Attributes:
        mesh: path of the object's CAD model below the benchmark's folder.
        camera_matrix: (3, 3) float64 in px.
        poses: (N, 4, 4) float64, true ``T_cam_from_model`` of each frame.
        symmetries: (S, 3, 3) rotations S, identity first, with R S equivalent to R.
        visible: (N,) visible fraction of the silhouette, measured at a quarter of the size.
    """

    mesh: str
    camera_matrix: Tensor
    poses: Tensor
    symmetries: Tensor
    visible: np.ndarray
    scene: "_Scene"

    def frames(self) -> Iterator[Tensor]:
        """The (3, 480, 640) uint8 frames, in their order."""
        for R, t in self.scene.path:
            picture, _, _ = self.scene.render(R, t, SIZE)
            image = simulate_camera(picture, np.random.default_rng(self.scene.camera_seed))
            yield torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))


@dataclass(frozen=True)
class _Scene:
    """What the camera sees: shapes in the world, the object first, and the camera's path (world -> camera)."""

    shapes: list[TexturedMesh]
    K: np.ndarray
    path: list[tuple[np.ndarray, np.ndarray]]
    light: Light
    background: np.ndarray
    camera_seed: int

    def render(self, R, t, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Picture and masks of :func:`scripts.benchmark.textured.render`; materials and light stay the same."""
        zoom = size[0] / SIZE[0]
        K = np.array([[zoom, 0, 0.5 * (zoom - 1)], [0, zoom, 0.5 * (zoom - 1)], [0, 0, 1.0]]) @ self.K
        rng = np.random.default_rng(self.camera_seed)
        return render(self.shapes, R, t, K, size, rng, light=self.light, background=self.background)


def camera_path(R: np.ndarray, centre: np.ndarray, K: np.ndarray, count: int, rng: np.random.Generator) -> list:
    """Smooth random path of ``count`` poses around an object.

    Args:
        R, centre: (3, 3) world -> camera and (3,) the object's centre in the camera's frame, at the start.
        K: (3, 3) camera matrix.

    Returns:
        Pairs of rotation (3, 3) and centre (3,). The steps are at most ``MAX_TURN`` and ``MAX_SHIFT``.
    """

    def pose(state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        azimuth, small, (distance, u, v) = state[0], state[1:4], state[4:]
        ray = centre / centre[2] + np.linalg.inv(K) @ (u, v, 0.0)
        place = ray / np.linalg.norm(ray) * np.linalg.norm(centre) * np.exp(distance)
        return _rotation(small) @ R @ _rotation(np.array([0.0, 0.0, azimuth])), place

    state, velocity = np.zeros(7), np.zeros(7)
    path = [pose(state)]
    while len(path) < count:
        velocity = _PERSISTENCE * velocity + rng.normal(0, _ACCELERATION) - _PULL * state
        turn, shift = step_between(path[-1], pose(state + velocity))
        velocity *= min(1.0, 0.98 * MAX_TURN / max(turn, 1e-9), 0.98 * MAX_SHIFT / max(shift, 1e-9))
        state = state + velocity
        path.append(pose(state))
    return path


def _rotation(degrees: np.ndarray) -> np.ndarray:
    return rotation_from_axis_angle(torch.from_numpy(np.radians(degrees))).numpy()


def step_between(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> tuple[float, float]:
    """Rotation in degrees, and motion of the centre as a fraction of its distance."""
    cosine = 0.5 * (np.trace(a[0].T @ b[0]) - 1.0)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))), float(
        np.linalg.norm(b[1] - a[1]) / np.linalg.norm(a[1])
    )


def make_sequence(meshes: Meshes, seed: int, index: int, count: int) -> Sequence:
    """Sequence ``index`` of ``count`` frames; every second object lies in a random orientation.

    Bodies of revolution are left out even if a print shows how they are turned.
    """
    about_z = {k for k, R in enumerate(meshes.rotations) if R[2, 2] > 0.99}
    determined = [len(about_z & set(row["shape_symmetries"])) < FULL_TURN for row in meshes.good]
    rows = [row for row, known in zip(meshes.good, determined, strict=True) if known]
    row = rows[np.random.default_rng((seed, 2)).permutation(len(rows))[index % len(rows)]]
    model = meshes.load(row["path"])
    radius, centre = model.radius_and_centre()
    for attempt in range(20):
        rng = np.random.default_rng((seed, index, attempt))
        rotation = random_rotation(rng) if index % 2 else np.eye(3)
        obj = model.standing(rotation, 1.0, 0.0)
        R, t, K = scene_camera(obj, SIZE, rng)
        eye = -R.T @ t
        toward = eye[:2] / (np.linalg.norm(eye[:2]) + 1e-9)
        reach = float(np.linalg.norm(obj.hull_points()[:, :2], axis=1).max())
        shapes = ground_and_walls(meshes, toward, rng)
        shapes += clutter_around(meshes, 0.8 * reach, eye, int(rng.choice([1, 3, 5])), bool(rng.random() < 0.6), rng)
        shapes = [obj, *(replace(shape, gloss=0.0 * shape.gloss) for shape in shapes)]  # highlights would not persist
        middle = model.floor_offset(rotation)
        path = camera_path(R, R @ middle + t, K, count, rng)
        steps = [(R, place - R @ middle) for R, place in path]
        scene = _Scene(
            shapes, K, steps, random_light(R[:, 2], rng), random_picture(rng, 512), int(rng.integers(1 << 31))
        )
        visible = np.array([_visible(scene, *step) for step in steps])
        if visible.min() >= MIN_VISIBLE:
            break
    else:
        raise RuntimeError(f"{index}: {row['id']} is hidden in every attempt")
    poses = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    for T, (R, place) in zip(poses, path, strict=True):
        T[:3, :3] = torch.from_numpy(R @ rotation)
        T[:3, 3] = torch.from_numpy(place * radius - R @ rotation @ centre)
    symmetries = torch.from_numpy(meshes.rotations[row["look_symmetries"]].astype(float))
    return Sequence(row["path"], torch.from_numpy(K), poses, symmetries, visible, scene)


def _visible(scene: _Scene, R: np.ndarray, t: np.ndarray) -> float:
    """Visible fraction of the object's silhouette; 0 if it is nearly outside the picture."""
    _, seen, whole = scene.render(R, t, (SIZE[0] // 4, SIZE[1] // 4))
    return float(seen.sum() / whole.sum()) if whole.sum() >= 100 else 0.0

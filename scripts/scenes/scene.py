"""Random scenes: objects among clutter in a room or on a shelf, and the cameras that see them.

Lengths are in the scene's unit: the radius of the first object, or the mean radius of those on a
shelf. z points up.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
import torch

from curvireg_torch.geometry import (
    rotation_from_axis_angle,
    rotation_from_viewpoint,
    rotation_towards,
    transform,
)
from curvireg_torch.geometry.framing import outside_fraction
from scripts.scenes.light import Light, random_light
from scripts.scenes.materials import random_picture, random_rotation
from scripts.scenes.surfaces import Array, Rng, middle_of, rotation, unit_circle
from scripts.scenes.textured import Picture, Placed, Texture, TexturedMesh, render

Draw: TypeAlias = Callable[[Rng], TexturedMesh]
View: TypeAlias = tuple[Array, Array, Array]
"""Rotation (3, 3) and translation (3,), scene -> camera, and camera matrix (3, 3)."""

SIZE = (480, 640)  # of photographs
# degrees, and fraction of the distance, between two frames of a sequence
MAX_TURN = 5.0
MAX_SHIFT = 0.05
RIG_STEP = (15.0, 45.0)  # degrees of azimuth between neighbouring cameras of a rig


@dataclass(frozen=True)
class Scene:
    """Shapes, the annotated ones with an ``obj_id``, under a light before a background, and the
    views of it."""

    shapes: list[Placed]
    light: Light
    background: Array
    views: list[View]

    @property
    def annotated(self) -> list[Placed]:
        return [shape for shape in self.shapes if shape.obj_id is not None]

    def render(self, view: View, size: tuple[int, int]) -> Picture:
        """Render one view at ``size`` (H, W)."""
        R, t, K = view
        return render(self.shapes, R, t, K, size, self.light.seen_by(R), self.background)


def single(
    mesh: TexturedMesh,
    obj_id: int,
    clutter: Draw,
    textures: Callable[[Rng], Array],
    rng: Rng,
    *,
    upright: bool,
    occluded: bool,
    cameras: int = 1,
) -> Scene:
    """One object of radius 1 on the floor of a room, with up to five others around it, and one in
    front of it."""
    turn = np.eye(3) if upright else random_rotation(rng)
    target = Placed.standing(mesh, turn, 1.0 / mesh.radius, obj_id=obj_id)
    hull = target.hull
    fill = rng.uniform(0.25, 0.65) * min(SIZE)
    low = rng.uniform(-4, 25)
    high = rng.uniform(5, 60)
    elevation = rng.choice([low, high])
    azimuth = rng.uniform(0, 360)
    view = look_at(hull, rng, fill=fill, azimuth=azimuth, elevation=elevation)
    R, t, _ = view
    eye = -R.T @ t
    shapes = [target]
    if eye[2] > 0.05 and rng.random() < 0.9:
        towards_camera = eye[:2] / (np.linalg.norm(eye[:2]) + 1e-9)
        shapes += _room(textures, towards_camera, rng)
    reach = 0.8 * np.linalg.norm(hull[:, :2], axis=1).max()
    count = rng.choice([0, 1, 3, 5])
    shapes += _clutter(clutter, reach, eye, count, occluded, rng)
    return _lit(shapes, view, hull, cameras, rng)


def _lit(
    shapes: list[Placed],
    view: View,
    points: Array,
    cameras: int,
    rng: Rng,
) -> Scene:
    """The scene of shapes under a random light, seen by a rig that looks at points (P, 3)."""
    light = random_light(rng)
    background = random_picture(rng, 512)
    return Scene(shapes, light, background, _rig(view, points, cameras, rng))


def shelf(
    meshes: list[tuple[int, TexturedMesh]],
    textures: Callable[[Rng], Array],
    rng: Rng,
    *,
    occlusion: float,
    cameras: int,
) -> Scene:
    """Objects side by side on one or two boards, two deep: the front row hides up to ``occlusion``
    of the back row."""
    unit = np.mean([mesh.radius for _, mesh in meshes])
    boards = 1 if len(meshes) < 10 or rng.random() < 0.3 else 2
    share = np.array_split(rng.permutation(len(meshes)), boards)
    shapes = []
    board_height = 0.0
    for members in share:
        edge = [0.0, 0.0]
        tallest = 0.0
        for n, k in enumerate(members):
            obj_id, mesh = meshes[k]
            row = n % 2  # front, back
            turn = rotation(2, np.radians(rng.normal(0, 35)))
            hull = Placed.standing(mesh, turn, 1.0 / unit).hull
            high = hull.max(axis=0)
            half = 0.5 * (high - hull.min(axis=0))[0]
            room = 1.2 * (1.0 - occlusion) * (1 - row)
            gap = rng.uniform(0.02, 0.2 + room)
            x = edge[row] + half + gap
            y = 1.6 * row + rng.uniform(-0.15, 0.15)
            edge[row] = x + half
            tallest = max(tallest, high[2])
            at = (x, y, board_height)
            shapes.append(Placed.standing(mesh, turn, 1.0 / unit, at, obj_id=obj_id))
        board_height += tallest + rng.uniform(0.3, 0.8)
    points = np.concatenate([shape.hull for shape in shapes])
    x0, _, _ = points.min(axis=0) - 0.3
    x1, _, top = points.max(axis=0) + 0.3
    wood = Texture(textures(rng))
    front = -1.2
    back = 3.0
    for z in sorted({round(float(shape.hull[:, 2].min()), 6) for shape in shapes}):
        board = [(x0, front, z), (x1, front, z), (x1, back, z), (x0, back, z)]
        under = z - 0.12
        rim = [(x0, front, under), (x1, front, under), (x1, front, z), (x0, front, z)]
        shapes.append(_quad(board, wood))
        shapes.append(_quad(rim, wood))
    wall = [(x0, back, -1), (x1, back, -1), (x1, back, top), (x0, back, top)]
    shapes.append(_quad(wall, Texture(textures(rng))))
    fill = rng.uniform(0.7, 1.0) * max(SIZE)
    azimuth = rng.normal(0, 18)
    elevation = rng.uniform(0, 25)
    view = look_at(points, rng, fill=fill, azimuth=azimuth, elevation=elevation)
    return _lit(shapes, view, points, cameras, rng)


def look_at(
    points: Array,
    rng: Rng,
    *,
    fill: float,
    azimuth: float,
    elevation: float,
) -> View:
    """A view whose box around points (P, 3) is ``fill`` px long and lies near the middle; angles in
    degrees."""
    H, W = SIZE
    sides = np.array([W, H])
    field_of_view = np.radians(rng.uniform(22, 60))
    focal = 0.5 * max(H, W) / np.tan(field_of_view / 2)
    K = np.array([[focal, 0, (W - 1) / 2], [0, focal, (H - 1) / 2], [0, 0, 1.0]])
    free = np.clip(0.5 - 0.5 * fill / sides, 0.0, 0.12)
    x, y = sides * (0.5 + free * rng.uniform(-1, 1, 2))
    ray = np.linalg.inv(K) @ (x, y, 1.0)
    ray /= np.linalg.norm(ray)
    R = towards(ray) @ rotation_from_viewpoint(azimuth, elevation, rng.normal(0, 4)).numpy()
    middle = middle_of(points)
    nearest = 1.25 * 0.5 * np.linalg.norm(np.ptp(points, axis=0))
    distance = 4.0 * nearest
    for _ in range(12):
        placed = (points - middle) @ R.T + distance * ray
        if placed[:, 2].min() > 0.05:
            flat = placed[:, :2] / placed[:, 2:] * focal
            distance *= np.ptp(flat, axis=0).max() / fill
        else:
            distance *= 1.5
        distance = max(distance, nearest)
    return R, distance * ray - R @ middle, K


def cut(
    view: View,
    points: Array,
    fraction: float,
    rng: Rng,
) -> View:
    """The view, turned so that about ``fraction`` of the outline of points (P, 3) lies outside the
    picture, at one side or at two."""
    R, t, K = view
    H, W = SIZE
    seen = (points @ R.T + t) @ K.T
    pixels = seen[:, :2] / seen[:, 2:]
    middle = middle_of(pixels)
    reach = np.ptp(pixels, axis=0)
    side = rng.choice([-1.0, 0.0, 1.0], 2)
    if not side.any():
        side[0] = rng.choice([-1.0, 1.0])
    border = np.where(side > 0, [W - 0.5, H - 0.5], -0.5)
    hull = torch.from_numpy(points)
    to_ray = np.linalg.inv(K)
    low = -0.6
    high = 0.6
    for _ in range(20):
        part = 0.5 * (low + high)
        target = np.where(side == 0, middle, border + side * part * reach)
        turn = towards(to_ray @ (*target, 1.0)) @ towards(to_ray @ (*middle, 1.0)).T
        pose = transform(torch.from_numpy(turn @ R), torch.from_numpy(turn @ t))
        if outside_fraction(hull, pose, torch.from_numpy(K), SIZE) < fraction:
            low = part
        else:
            high = part
    return turn @ R, turn @ t, K


def towards(ray: Array) -> Array:
    """(3, 3) rotation from the axis of a camera to a ray (3,)."""
    return rotation_towards(torch.from_numpy(ray)).numpy()


def _rig(
    view: View,
    points: Array,
    cameras: int,
    rng: Rng,
) -> list[View]:
    """The view and others around it, which look at the middle of points (P, 3) from other
    azimuths."""
    R, t, K = view
    middle = middle_of(points)
    views = [view]
    angle = np.zeros(2)
    for k in range(1, cameras):
        side = k % 2
        angle[side] += rng.uniform(*RIG_STEP)
        x, y = rng.normal(0, 3, 2)
        turned = R @ _rotation(x, y, (1 - 2 * side) * angle[side])
        place = (R @ middle + t) * rng.uniform(0.85, 1.15)
        views.append((turned, place - turned @ middle, K))
    return views


def camera_path(
    view: View,
    middle: Array,
    count: int,
    rng: Rng,
) -> list[View]:
    """Smooth random path of ``count`` views around ``middle`` (3,); steps are at most MAX_TURN and
    MAX_SHIFT."""
    R, t, K = view
    centre = R @ middle + t
    # Of azimuth, small rotation (3) in degrees, logarithm of the distance, and the centre's place
    # in px: deviation of the acceleration, and the fraction of the displacement that pulls back to
    # the start. The azimuth is free.
    acceleration = np.array([1.2, 0.4, 0.4, 0.4, 0.014, 6.0, 6.0])
    pull = np.array([0.0, 0.03, 0.03, 0.03, 0.03, 0.03, 0.03])

    def pose(state: Array) -> tuple[Array, Array]:
        azimuth, x, y, z, distance, u, v = state
        ray = centre / centre[2] + np.linalg.inv(K) @ (u, v, 0.0)
        place = ray / np.linalg.norm(ray) * np.linalg.norm(centre) * np.exp(distance)
        return _rotation(x, y, z) @ R @ _rotation(0.0, 0.0, azimuth), place

    state = np.zeros(7)
    velocity = np.zeros(7)
    path = [pose(state)]
    while len(path) < count:
        velocity = 0.9 * velocity + rng.normal(0, acceleration) - pull * state
        R0, place0 = path[-1]
        R1, place1 = pose(state + velocity)
        cosine = 0.5 * (np.trace(R0.T @ R1) - 1.0)
        turn = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        shift = np.linalg.norm(place1 - place0) / np.linalg.norm(place0)
        by_turn = 0.98 * MAX_TURN / max(turn, 1e-9)
        by_shift = 0.98 * MAX_SHIFT / max(shift, 1e-9)
        velocity *= min(1.0, by_turn, by_shift)
        state = state + velocity
        path.append(pose(state))
    return [(turn, place - turn @ middle, K) for turn, place in path]


def _rotation(x: float, y: float, z: float) -> Array:
    """By an axis times an angle in degrees."""
    vector = np.radians(np.array([x, y, z]))
    return rotation_from_axis_angle(torch.from_numpy(vector)).numpy()


def _quad(corners: list[tuple[float, ...]], paint: Texture, repeats: float = 1.0) -> Placed:
    uv = repeats * np.array([(0, 0), (1, 0), (1, 1), (0, 1.0)])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    mesh = TexturedMesh.from_arrays(np.array(corners), faces, [paint], uv=uv)
    return Placed(mesh, np.eye(3), np.zeros(3))


def _room(textures: Callable[[Rng], Array], toward: Array, rng: Rng) -> list[Placed]:
    """A floor and up to two walls on the far side; ``toward`` (2,) is the horizontal direction to
    the camera."""
    r = rng.choice([3.0, 8.0, 40.0])
    floor = [(-r, -r, 0.0), (r, -r, 0.0), (r, r, 0.0), (-r, r, 0.0)]
    paint = Texture(textures(rng))
    surfaces = [_quad(floor, paint, r / rng.uniform(0.5, 3.0))]
    for _ in range(rng.choice([0, 1, 1, 2])):
        back = -toward + rng.normal(0, 0.5, 2)
        back = back / np.linalg.norm(back)
        side = np.array([-back[1], back[0]])
        far = rng.uniform(1.2, 5.0)
        high = rng.uniform(2.0, 8.0)
        a = back * far - 12 * side
        b = back * far + 12 * side
        wall = [(*a, 0.0), (*b, 0.0), (*b, high), (*a, high)]
        paint = Texture(textures(rng))
        surfaces.append(_quad(wall, paint, 12 / rng.uniform(0.7, 4.0)))
    return surfaces


def _clutter(
    draw: Draw,
    reach: float,
    eye: Array,
    count: int,
    occluder: bool,
    rng: Rng,
) -> list[Placed]:
    """Other meshes on the floor; the last one, an occluder, stands between the object and the
    camera."""
    clutter = []
    for k in range(count + occluder):
        mesh = draw(rng)
        front = k >= count
        size = np.exp(rng.uniform(-0.9, 0.4))
        scale = size * (0.6 if front else 1.0) / mesh.radius
        turn = _rotation(0.0, 0.0, rng.uniform(0, 360))
        if rng.random() < 0.15:
            turn = random_rotation(rng)
        width, depth, _ = np.ptp(mesh.hull, axis=0)
        radius = 0.5 * scale * np.linalg.norm((width, depth))
        if front:
            x, y = eye[:2] / (np.linalg.norm(eye[:2]) + 1e-9)
            aside = np.array([-y, x]) * rng.uniform(-0.8, 0.8)
            far = reach + radius + rng.uniform(0.05, 0.4)
            place = np.array([x, y]) * far + aside
            free = 0.6
        else:
            direction = unit_circle(rng.uniform(0, 2 * np.pi))
            place = direction * (reach + radius + rng.exponential(0.7))
            free = 1.0
        # not around the camera
        if np.linalg.norm(eye[:2] - place) > radius + free:
            clutter.append(Placed.standing(mesh, turn, scale, (*place, 0.0)))
    return clutter


def simulate_camera(picture: Array, rng: Rng) -> Array:
    """Apply random exposure, white balance, blur, downsampling, noise and JPEG compression to a
    rendered picture.

    ``picture`` is (H, W, 3) float32 linear light; the result is uint8.
    """
    height, width = picture.shape[:2]
    bright = rng.uniform(0.45, 0.75)
    gain = bright / (np.percentile(picture, rng.uniform(60, 95)) + 1e-3)
    picture = picture * gain * (1 + rng.normal(0, 0.06, 3))
    picture = np.clip(picture, 0, 1) ** rng.uniform(0.5, 1.1)
    if rng.random() < 0.15:
        picture = np.broadcast_to(picture.mean(axis=2, keepdims=True), picture.shape)
    picture = np.ascontiguousarray(picture, dtype=np.float32)
    if rng.random() < 0.5:
        picture = cv2.GaussianBlur(picture, (0, 0), rng.uniform(0.3, 1.6))
    if rng.random() < 0.1:  # motion blur
        length = rng.integers(3, 8)
        kernel = np.zeros((length, length), np.float32)
        end = rng.integers(0, length, 2).tolist()
        cv2.line(kernel, (length // 2, length // 2), end, 1.0)
        picture = cv2.filter2D(picture, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)
    if rng.random() < 0.35:  # low resolution
        scale = rng.uniform(0.35, 0.9)
        size = (int(width * scale), int(height * scale))
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        picture = cv2.resize(picture, (width, height))
    noise = np.exp(rng.uniform(-6.5, -3.0))
    picture = picture + rng.normal(0, noise, picture.shape)
    coded = (255 * np.clip(picture, 0, 1) + 0.5).astype(np.uint8)
    if rng.random() < 0.6:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(30, 96))]
        _, data = cv2.imencode(".jpg", coded, quality)
        coded = cv2.imdecode(data, cv2.IMREAD_COLOR)
    return coded

"""Generated photographs of a mesh: its pose, size and place, light, background, clutter, focus and
a box that is not exact."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from ..filters import gaussian_smooth
from ..geometry import camera_matrix
from ..geometry.cameras import point_in_cameras, pose_around, transform
from ..geometry.framing import clipped
from ..geometry.viewpoint import up_rotation
from ..matching.describe import view_mesh
from ..mesh import Mesh, SurfaceColours, as_mesh, mesh_centre, mesh_radius
from ..mesh.edges import simplified
from ..synthetic import procedural_background, random_pose, synthesize_photograph
from ..utils.likes import MeshLike
from .facts import MANY_FACES
from .surface import coloured_points

SIZE = (480, 640)  # of the photographs, H, W
FOCAL = 700.0  # px: a field of view of 49 degrees
FILL = (0.2, 0.7)  # of the photographs' shorter side, by the object
UPRIGHT = (-10.0, 60.0)  # Elevations from which an upright object is seen, degrees
BOX_ERROR = 0.05  # Standard deviation of the box's edges, as a fraction of its sides
BLUR = 1.2  # px, the largest standard deviation
LARGEST_SEED = 2**63  # that a generator takes
SHARP = 0.3  # px, below which nothing is blurred
# Clutter: most objects beside and behind the object, their radii and distances from its centre as
# a fraction of its radius
MOST_BESIDE = 6
SIZES = (0.4, 1.2)
NEAREST = 0.9
FARTHEST = 2.2
COVERED = 0.3  # of the object's box, at most, by the object in front of it
# Faces of the mesh that stands for a coloured one of many faces, and points of the surface from
# which its corners take their colours
COLOURED_FACES = 50_000
COLOURED_POINTS = 400_000
# Patches of colour of a print, and the longest edge of a face with one, as a fraction of the
# mesh's size; edges are halved up to so many times
PATCHES = 60
PATCH_EDGE = 0.03
PATCH_STEPS = 12
SIDES = (6, 32)  # of prisms and cylinders


@dataclass(frozen=True)
class GeneratedPhotograph:
    """A generated photograph: (3, H, W) uint8, its box (4,) in px, the true pose (4, 4), the camera
    matrix (3, 3), and its number."""

    image: Tensor
    box: Tensor
    truth: Tensor
    camera: Tensor
    number: int = 0

    @property
    def pixels_across(self) -> float:
        """Longer side of the box in px."""
        return float((self.box[2:] - self.box[:2]).max())


@dataclass(frozen=True)
class PhotographGenerator:
    """Photographs of a mesh at random poses, sizes and places, in random light, out of focus by up
    to 1.2 px, with noise, in front of random or given ``backgrounds`` (3, H, W); boxes are wrong by
    about 5 % of their sides.

    Attributes:
        mesh: that is seen.
        seed: photograph k depends only on the seed and k.
        upright: whether the object stands; otherwise it is seen from everywhere and rolled.
        backgrounds: pictures of ``SIZE``, taken in turn.
        clutter: whether other objects stand beside, behind and, in half of the photographs, in
            front of the object.

    Example:
        >>> generate = PhotographGenerator(trimesh.creation.box((1, 2, 3)), seed=0)
        >>> generate(0).image.shape
        torch.Size([3, 480, 640])
    """

    mesh: MeshLike
    seed: int
    upright: bool = False
    backgrounds: Sequence[Tensor] = ()
    clutter: bool = False

    @cached_property
    def subject(self) -> Mesh:
        """The mesh as it is photographed."""
        return photographed_mesh(as_mesh(self.mesh))

    def __call__(self, index: int) -> GeneratedPhotograph:
        """Photograph number ``index``."""
        mesh = self.subject
        generator = torch.Generator().manual_seed((1_000_003 * self.seed + index) % LARGEST_SEED)
        # of its own: clutter changes nothing else
        others = torch.Generator().manual_seed((1_000_033 * self.seed + index) % LARGEST_SEED)
        truth = _random_truth(mesh, generator, upright=self.upright)
        centre = point_in_cameras(truth, mesh_centre(mesh))
        radius = mesh_radius(mesh)
        background = procedural_background(SIZE, generator)
        if self.backgrounds:
            background = self.backgrounds[index % len(self.backgrounds)]
        if self.clutter:
            background = _with_objects_behind(background, centre, radius, others)
        K = trial_camera()
        image, box = synthesize_photograph(mesh, truth, K, SIZE, generator, background=background)
        if self.clutter and float(torch.rand((), generator=others)) < 0.5:
            image = _with_object_in_front(image, box, centre, radius, others)
        blur = BLUR * float(torch.rand((), generator=generator))
        if blur > SHARP:
            image = gaussian_smooth(image[None], blur)[0]
        return GeneratedPhotograph(to_bytes(image), _wrong_box(box, generator), truth, K, index)


def trial_camera() -> Tensor:
    """(3, 3) float64 camera matrix of the generated photographs."""
    height, width = SIZE
    return camera_matrix(FOCAL, FOCAL, 0.5 * (width - 1), 0.5 * (height - 1), dtype=torch.float64)


def photographed_mesh(mesh: Mesh) -> Mesh:
    """The mesh, or a simplified one in its place if it has many faces: preparing millions of them
    for each photograph would take longer than to register it."""
    if len(mesh.faces) <= MANY_FACES:
        return mesh
    if mesh.colours is None or not mesh.has_colours:
        return replace(mesh, surface=view_mesh(mesh), colours=None)
    centre = mesh_centre(mesh).numpy()
    vertices, faces = simplified(mesh, centre, COLOURED_FACES)
    vertices += centre
    points, seen = coloured_points(mesh, mesh.colours, COLOURED_POINTS)
    nearest = cKDTree(points).query(vertices)[1]
    pixels = (255.0 * seen[nearest]).round().astype(np.uint8)
    colours = replace(SurfaceColours.plain(len(faces)), corners=pixels[faces])
    surface = trimesh.Trimesh(vertices, faces, process=False)
    return replace(mesh, surface=surface, colours=colours)


def with_print(mesh: MeshLike) -> Mesh:
    """A mesh with patches of random colours, as if its print were known.

    Example:
        >>> with_print(trimesh.creation.box((1, 2, 3))).has_colours
        True
    """
    whole = photographed_mesh(replace(as_mesh(mesh), colours=None))
    size = 2.0 * mesh_radius(whole)
    vertices, faces = trimesh.remesh.subdivide_to_size(
        whole.vertices, whole.faces, PATCH_EDGE * size, max_iter=PATCH_STEPS
    )
    printed = trimesh.Trimesh(vertices, faces, process=False)
    rng = np.random.default_rng(0)
    middles = printed.triangles_center
    seeds = rng.uniform(middles.min(axis=0), middles.max(axis=0), (PATCHES, 3))
    colours = rng.integers(20, 235, (PATCHES, 3)).astype(np.uint8)
    patch = cKDTree(seeds).query(middles)[1]
    corners = np.repeat(colours[patch][:, None], 3, axis=1)
    colours_of_faces = replace(SurfaceColours.plain(len(faces)), corners=corners)
    return replace(whole, surface=printed, colours=colours_of_faces)


def to_bytes(image: Tensor) -> Tensor:
    """A picture in [0, 1] as uint8."""
    return (255.0 * image).round().to(torch.uint8)


def _random_truth(mesh: Mesh, generator: torch.Generator, *, upright: bool) -> Tensor:
    """A (4, 4) pose that shows the mesh; seen from everywhere and rolled, unless it is upright."""
    elevations = UPRIGHT if upright else (-90.0, 90.0)
    T = random_pose(mesh, trial_camera(), SIZE, generator, elevations=elevations, fill=FILL)
    centre = mesh_centre(mesh)
    position = point_in_cameras(T, centre)
    R = T[:3, :3]
    if not upright:
        R = _random_rotation(generator)
    elif mesh.up != "z":
        R = R @ up_rotation(mesh.up).double()
    return pose_around(R, position, centre)


def _random_rotation(generator: torch.Generator) -> Tensor:
    """(3, 3) float64, uniform."""
    quaternion = torch.randn(4, generator=generator, dtype=torch.float64)
    return torch.from_numpy(Rotation.from_quat(quaternion.numpy()).as_matrix())


def _wrong_box(box: Tensor, generator: torch.Generator) -> Tensor:
    """The box with edges moved at random, within the photograph."""
    sides = (box[2:] - box[:2]).repeat(2)
    return clipped(box + BOX_ERROR * sides * torch.randn(4, generator=generator), SIZE)


def _random_object(radius: float, generator: torch.Generator) -> trimesh.Trimesh:
    """A box, prism, cylinder, cone or ellipsoid around the origin."""
    kind, sides = torch.rand(2, generator=generator).tolist()
    shapes = [
        trimesh.creation.box(),
        trimesh.creation.cylinder(0.5, 1.0, sections=round(SIDES[0] + sides * np.ptp(SIDES))),
        trimesh.creation.cone(0.5, 1.0),
        trimesh.creation.icosphere(3, 0.5),
    ]
    mesh = shapes[int(kind * len(shapes))]
    stretch = 0.4 + torch.rand(3, generator=generator, dtype=torch.float64)
    vertices = mesh.vertices * stretch.numpy()
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    size = 0.5 * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    return trimesh.Trimesh((vertices - middle) * radius / size, mesh.faces, process=False)


def _with_objects_behind(
    background: Tensor, centre: Tensor, radius: float, generator: torch.Generator
) -> Tensor:
    """The background with up to six objects beside and behind the object, as far away as its
    centre or farther."""
    count = 1 + int(MOST_BESIDE * float(torch.rand((), generator=generator)))
    picture = background
    for _ in range(count):
        angle, far, size, deep = torch.rand(4, generator=generator, dtype=torch.float64).tolist()
        away = radius * float(np.interp(far, (0, 1), (NEAREST, FARTHEST)))
        aside = [away * math.cos(2 * math.pi * angle), away * math.sin(2 * math.pi * angle)]
        place = centre + torch.tensor([*aside, 2.0 * radius * deep], dtype=torch.float64)
        other = _random_object(radius * float(np.interp(size, (0, 1), SIZES)), generator)
        picture = _with_object(picture, other, place, generator)
    return picture


def _with_object_in_front(
    image: Tensor, box: Tensor, centre: Tensor, radius: float, generator: torch.Generator
) -> Tensor:
    """The photograph with something before a side or corner of the object's box, of which it covers
    less than a third."""
    depth = float(centre[2]) - 1.5 * radius
    if depth < radius:
        return image
    sides = (box[2:] - box[:2]).double()
    across = float(sides.min()) * COVERED**0.5
    angle = 2.0 * torch.pi * torch.rand((), generator=generator, dtype=torch.float64)
    at = 0.5 * (box[:2] + box[2:]).double() + 0.5 * sides * torch.stack([angle.cos(), angle.sin()])
    ray = torch.linalg.inv(trial_camera()) @ torch.cat([at, torch.ones(1, dtype=torch.float64)])
    other = _random_object(across * depth / FOCAL, generator)
    return _with_object(image, other, depth * ray, generator)


def _with_object(
    picture: Tensor, mesh: trimesh.Trimesh, place: Tensor, generator: torch.Generator
) -> Tensor:
    """The picture with an object around a point (3,) in front of it, if the camera sees it."""
    K = trial_camera()
    pixel = (K @ place)[:2] / place[2]
    height, width = SIZE
    if not (0 <= pixel[0] < width and 0 <= pixel[1] < height):
        return picture
    T = transform(_random_rotation(generator), place)
    return synthesize_photograph(mesh, T, K, SIZE, generator, background=picture, defocus=0.0)[0]

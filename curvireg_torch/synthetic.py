"""Synthetic photographs with known pose, for the demo, the doctests and the tests."""

import math
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
import trimesh
from torch import Tensor

from .errors import InvalidInputError
from .filters import gaussian_smooth
from .geometry import camera_matrix, rotation_from_viewpoint
from .geometry.cameras import rotation_towards, transform
from .mesh import Mesh, as_mesh, mesh_centre, mesh_radius
from .rendering import render_colour, render_depth
from .utils.likes import MeshLike

__all__ = [
    "DemoScene",
    "demo_scene",
    "example_mesh",
    "procedural_background",
    "random_pose",
    "synthesize_photograph",
]
RED = (196, 44, 34, 255)
STEEL = (120, 124, 130, 255)
WOOD = (222, 190, 138, 255)
RUBBER = (44, 44, 48, 255)
PAINT = [STEEL, RED, RED, WOOD, WOOD, WOOD, STEEL, *[RUBBER] * 6]  # of the parts, in their order
DEFOCUS = 1.5  # blur of the background in px


def example_mesh(*, painted: bool = False) -> trimesh.Trimesh:
    """Return a toy truck, 0.25 m long, without symmetries; z up, front along -y, in metres;
    ``painted``: in colours.

    Example:
        >>> mesh = example_mesh()
        >>> mesh.is_watertight, len(mesh.faces) > 30
        (True, True)
    """
    box = trimesh.creation.box
    cylinder = trimesh.creation.cylinder
    shift = trimesh.transformations.translation_matrix
    across = trimesh.transformations.rotation_matrix(math.pi / 2, [0, 1, 0])
    parts = [
        box((0.09, 0.25, 0.02), transform=shift((0, 0, 0.045))),  # frame
        box((0.09, 0.06, 0.075), transform=shift((0, -0.09, 0.09))),  # cabin
        box((0.085, 0.03, 0.03), transform=shift((0, -0.133, 0.07))),  # bonnet
        box((0.1, 0.15, 0.012), transform=shift((0, 0.045, 0.06))),  # bed
        box((0.008, 0.15, 0.035), transform=shift((0.046, 0.045, 0.08))),  # one high side
        box((0.1, 0.008, 0.05), transform=shift((0, 0.118, 0.085))),  # tailgate
        cylinder(0.008, 0.1, transform=shift((-0.035, -0.05, 0.13))),  # chimney
    ]
    for x in (-0.05, 0.05):
        parts += [
            cylinder(0.03, 0.02, transform=shift((x, y, 0.03)) @ across)
            for y in (-0.085, 0.055, 0.1)
        ]
    mesh = trimesh.util.concatenate(parts)
    if painted:
        mesh.visual.face_colors = np.repeat(
            np.array(PAINT, np.uint8), [len(part.faces) for part in parts], axis=0
        )
    mesh.units = "m"
    return mesh


def random_pose(
    mesh: Mesh | trimesh.Trimesh,
    camera_matrix: Tensor,
    size: tuple[int, int],
    generator: torch.Generator,
    *,
    elevations: tuple[float, float] = (-10.0, 60.0),
    fill: tuple[float, float] = (0.4, 0.7),
) -> Tensor:
    """Return a (4, 4) float64 pose of an upright object that fills ``fill`` of the image's shorter
    side.

    Example:
        >>> from curvireg_torch.geometry import camera_matrix
        >>> K = camera_matrix(200.0, 200.0, 79.5, 59.5)
        >>> random_pose(example_mesh(), K, (120, 160), torch.Generator().manual_seed(0)).shape
        torch.Size([4, 4])
    """
    u = torch.rand(6, generator=generator, dtype=torch.float64)
    elevation = elevations[0] + (elevations[1] - elevations[0]) * u[1]
    fraction = fill[0] + (fill[1] - fill[0]) * float(u[3])
    distance = 2.0 * mesh_radius(mesh) * float(camera_matrix[0, 0]) / (fraction * min(size))
    pixel = torch.stack(
        [size[1] * (0.4 + 0.2 * u[4]), size[0] * (0.4 + 0.2 * u[5]), torch.ones_like(u[0])]
    )
    ray = torch.linalg.inv(camera_matrix.double()) @ pixel
    R = rotation_towards(ray) @ rotation_from_viewpoint(360.0 * u[0], elevation, 10.0 * u[2] - 5.0)
    return transform(R, ray / torch.linalg.vector_norm(ray) * distance - R @ mesh_centre(mesh))


def procedural_background(size: tuple[int, int], generator: torch.Generator) -> Tensor:
    """Return (3, H, W) clutter: coloured 1/f noise with a few tilted bands.

    Example:
        >>> procedural_background((48, 64), torch.Generator().manual_seed(0)).shape
        torch.Size([3, 48, 64])
    """
    H, W = size
    picture = torch.zeros(1, 3, H, W)
    for octave in range(1, 7):
        cells = 2**octave
        noise = torch.rand(1, 3, cells + 1, cells + 1, generator=generator) - 0.5
        grey = noise.mean(dim=1, keepdim=True)
        noise = 1.5 * grey + 0.4 * (noise - grey)
        picture += F.interpolate(noise, (H, W), mode="bicubic", align_corners=True) / octave**1.2
    y, x = torch.meshgrid(torch.linspace(-1, 1, H), torch.linspace(-1, 1, W), indexing="ij")
    for _ in range(6):
        angle, offset, width, *colour = torch.rand(6, generator=generator).tolist()
        across = x * math.cos(math.pi * angle) + y * math.sin(math.pi * angle) - 2 * offset + 1
        band = torch.sigmoid((0.05 + 0.15 * width - across.abs()) * 80)
        picture += band * 0.6 * (torch.tensor(colour).view(1, 3, 1, 1) - 0.5)
    return (0.5 + picture).clamp(0, 1)[0]


def synthesize_photograph(
    mesh: MeshLike,
    T_cam_from_model: Tensor,
    camera_matrix: Tensor,
    size: tuple[int, int],
    generator: torch.Generator,
    *,
    background: Tensor | None = None,
    texture: float = 0.35,
    defocus: float = DEFOCUS,
) -> tuple[Tensor, Tensor]:
    """Return a photograph (3, H, W) in [0, 1] of the mesh under random light, and the object's box
    (4,) in px. ``texture`` is the contrast of a random solid pattern; a mesh whose colours vary
    shows those instead. The background (3, H, W), default :func:`procedural_background`, is blurred
    by ``defocus`` px.

    Example:
        >>> from curvireg_torch.geometry import camera_matrix
        >>> K = camera_matrix(200.0, 200.0, 79.5, 59.5)
        >>> generator = torch.Generator().manual_seed(0)
        >>> T = random_pose(example_mesh(), K, (120, 160), generator)
        >>> image, box = synthesize_photograph(example_mesh(), T, K, (120, 160), generator)
        >>> image.shape, box.shape
        (torch.Size([3, 120, 160]), torch.Size([4]))
    """
    mesh = as_mesh(mesh)
    H, W = size
    # Supersampling by two.
    K = (
        torch.tensor([[2.0, 0.0, 0.5], [0.0, 2.0, 0.5], [0.0, 0.0, 1.0]]).double()
        @ camera_matrix.double()
    )
    depth = render_depth(mesh, T_cam_from_model, K, (2 * H, 2 * W))[0, 0].double()
    mask = depth > 0
    rows = mask.any(dim=1).nonzero()
    columns = mask.any(dim=0).nonzero()
    if len(rows) == 0:
        raise InvalidInputError(
            "T_cam_from_model: expected a pose that shows the object, but no pixel does"
        )
    # the object's rows and columns, and one more on each side for the differences
    high = slice(max(int(rows[0]) - 1, 0), int(rows[-1]) + 2)
    wide = slice(max(int(columns[0]) - 1, 0), int(columns[-1]) + 2)
    v, u = torch.meshgrid(torch.arange(2.0 * H)[high], torch.arange(2.0 * W)[wide], indexing="ij")
    rays = torch.stack([u, v, torch.ones_like(u)], dim=-1).double() @ torch.linalg.inv(K).T
    points = depth[high, wide, None] * rays
    surface = torch.zeros(2 * H, 2 * W, 3, dtype=torch.float64)
    surface[high, wide] = _shades(mesh.surface.scale, T_cam_from_model, points, generator, texture)
    coverage = F.avg_pool2d(mask[None, None].float(), 2)[0]
    front = F.avg_pool2d((surface * mask[..., None]).permute(2, 0, 1)[None].float(), 2)[0]
    if mesh.has_colours:  # drawn before white
        front = (
            render_colour(mesh, T_cam_from_model, camera_matrix, size)[0] - (1.0 - coverage)
        ).clamp(min=0.0)
    back = procedural_background(size, generator) if background is None else background
    blurred = gaussian_smooth(back[None], defocus)[0] if defocus > 0.0 else back
    image = front + (1.0 - coverage) * blurred
    image = image + 0.01 * torch.randn(3, H, W, generator=generator)
    # Outer borders of the outermost pixels, converted from the fine grid to the picture's.
    box = torch.tensor(
        [int(columns[0]) - 0.5, int(rows[0]) - 0.5, int(columns[-1]) + 0.5, int(rows[-1]) + 0.5]
    )
    return image.clamp(0, 1), (box - 0.5) / 2.0


def _shades(
    size: float, T: Tensor, points: Tensor, generator: torch.Generator, texture: float
) -> Tensor:
    """(H, W, 3) colours of a mesh of some ``size`` at neighbouring ``points`` (H, W, 3) in the
    camera, under random light."""
    # Normals come from neighbouring points; at occluding contours they point to the camera.
    dv, du = torch.gradient(points, dim=(0, 1))
    normal = F.normalize(torch.linalg.cross(dv, du), dim=-1)
    border = torch.maximum(du[..., 2].abs(), dv[..., 2].abs()) > 0.2 * size
    normal[border] = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    light = F.normalize(torch.randn(3, generator=generator, dtype=torch.float64), dim=0)
    # from above, in front
    light = F.normalize(light + torch.tensor([0.0, -0.8, -1.2], dtype=torch.float64), dim=0)
    shade = 0.35 + 0.65 * (normal @ light).clamp(min=0)
    model = (points - T[:3, 3]) @ T[:3, :3] / (0.5 * size)
    waves = torch.randn(3, 4, generator=generator, dtype=torch.float64) * 6
    phases = 6.3 * torch.rand(4, generator=generator, dtype=torch.float64)
    pattern = torch.sin(model @ waves + phases).mean(dim=-1)
    colour = 0.3 + 0.6 * torch.rand(3, generator=generator, dtype=torch.float64)
    return shade[..., None] * colour * (1.0 + texture * pattern[..., None])


class DemoScene(NamedTuple):
    """A generated ``image`` (3, 720, 960), float32 RGB in [0, 1], of a known object, its ``mesh``
    in metres and ``box`` (4,) x0, y0, x1, y1 in px; ``camera_matrix`` (3, 3) and ``truth`` (4, 4),
    ``T_cam_from_model``, in float64.

    Example:
        >>> scene = demo_scene()
        >>> scene.image.shape[0], scene.box.shape
        (3, torch.Size([4]))
    """

    mesh: trimesh.Trimesh
    image: Tensor
    box: Tensor
    camera_matrix: Tensor
    truth: Tensor


def demo_scene(seed: int = 2) -> DemoScene:
    """Return a photograph of the toy truck on a table, at a pose that depends on ``seed``.

    Example:
        >>> demo_scene().image.shape
        torch.Size([3, 720, 960])
    """
    generator = torch.Generator().manual_seed(seed)
    mesh = example_mesh()
    size = (720, 960)
    K = camera_matrix(1040.0, 1040.0, 479.5, 359.5, dtype=torch.float64)
    truth = random_pose(mesh, K, size, generator, elevations=(12.0, 45.0), fill=(0.75, 0.95))
    clutter = 0.15 * (procedural_background(size, generator).mean(dim=0) - 0.5)
    table = torch.arange(size[0])[:, None] > 0.3 * size[0]
    wall, wood = torch.tensor([[0.78, 0.76, 0.7], [0.62, 0.46, 0.3]])[..., None, None]
    room = torch.where(table, wood, wall) + clutter
    image, box = synthesize_photograph(
        example_mesh(painted=True), truth, K, size, generator, background=room
    )
    return DemoScene(mesh, image, box, K, truth)

"""Synthetic photographs of a mesh before clutter, with known pose."""

import math

import torch
import torch.nn.functional as F
import trimesh
from torch import Tensor

from ..errors import InvalidInputError
from ..filters import gaussian_smooth
from ..geometry.cameras import rotation_towards, transform
from ..geometry.viewpoint import rotation_from_viewpoint
from ..mesh.mesh import mesh_centre, mesh_radius
from ..rendering import render_depth

__all__ = ["procedural_background", "random_pose", "synthesize_photograph"]

DEFOCUS = 1.5  # blur of the background in px


def procedural_background(size: tuple[int, int], generator: torch.Generator) -> Tensor:
    """(3, H, W) clutter: coloured 1/f noise with a few tilted bands."""
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


def random_pose(
    mesh: trimesh.Trimesh,
    camera_matrix: Tensor,
    size: tuple[int, int],
    generator: torch.Generator,
    *,
    elevations: tuple[float, float] = (-10.0, 60.0),
    fill: tuple[float, float] = (0.4, 0.7),
) -> Tensor:
    """(4, 4) float64 pose of an upright object that fills ``fill`` of the image's shorter side, near its middle."""
    u = torch.rand(6, generator=generator, dtype=torch.float64)
    elevation = elevations[0] + (elevations[1] - elevations[0]) * u[1]
    fraction = fill[0] + (fill[1] - fill[0]) * float(u[3])
    distance = 2.0 * mesh_radius(mesh) * float(camera_matrix[0, 0]) / (fraction * min(size))
    pixel = torch.stack([size[1] * (0.4 + 0.2 * u[4]), size[0] * (0.4 + 0.2 * u[5]), torch.ones_like(u[0])])
    ray = torch.linalg.inv(camera_matrix.double()) @ pixel
    R = rotation_towards(ray) @ rotation_from_viewpoint(360.0 * u[0], elevation, 10.0 * u[2] - 5.0)
    return transform(R, ray / torch.linalg.vector_norm(ray) * distance - R @ mesh_centre(mesh))


def synthesize_photograph(
    mesh: trimesh.Trimesh,
    T_cam_from_model: Tensor,
    camera_matrix: Tensor,
    size: tuple[int, int],
    generator: torch.Generator,
    *,
    background: Tensor | None = None,
    texture: float = 0.35,
) -> tuple[Tensor, Tensor]:
    """A synthetic photograph of the mesh: random light, a random solid texture, defocused background, sensor noise.

    Args:
        mesh, T_cam_from_model, camera_matrix, size: the scene; (4, 4), (3, 3) and (H, W).
        background: (3, H, W) in [0, 1]; default :func:`procedural_background`.
        texture: contrast of the texture, 0 = none.

    Returns:
        image (3, H, W) in [0, 1] and the object's box (4,) in px.
    """
    H, W = size
    # Supersampling by two.
    K = torch.tensor([[2.0, 0.0, 0.5], [0.0, 2.0, 0.5], [0.0, 0.0, 1.0]]).double() @ camera_matrix.double()
    depth = render_depth(mesh, T_cam_from_model, K, (2 * H, 2 * W))[0, 0].double()
    mask = depth > 0
    rows, columns = mask.any(dim=1).nonzero(), mask.any(dim=0).nonzero()
    if len(rows) == 0:
        raise InvalidInputError("T_cam_from_model: expected a pose that shows the object, but no pixel does")
    v, u = torch.meshgrid(torch.arange(2.0 * H), torch.arange(2.0 * W), indexing="ij")
    pixels = torch.stack([u, v, torch.ones_like(u)], dim=-1).double()
    points = depth[..., None] * (pixels @ torch.linalg.inv(K).T)
    # Normals come from neighbouring points; at occluding contours they point to the camera.
    dv, du = torch.gradient(points, dim=(0, 1))
    normal = F.normalize(torch.linalg.cross(dv, du), dim=-1)
    jump = torch.maximum(du[..., 2].abs(), dv[..., 2].abs()) > 0.2 * mesh.scale
    normal[jump] = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    light = F.normalize(torch.randn(3, generator=generator, dtype=torch.float64), dim=0)
    light = F.normalize(light + torch.tensor([0.0, -0.8, -1.2], dtype=torch.float64), dim=0)  # from above, in front
    shade = 0.35 + 0.65 * (normal @ light).clamp(min=0)
    model = (points - T_cam_from_model[:3, 3]) @ T_cam_from_model[:3, :3] / (0.5 * mesh.scale)
    waves = torch.randn(3, 4, generator=generator, dtype=torch.float64) * 6
    pattern = torch.sin(model @ waves + 6.3 * torch.rand(4, generator=generator, dtype=torch.float64)).mean(dim=-1)
    colour = 0.3 + 0.6 * torch.rand(3, generator=generator, dtype=torch.float64)
    surface = shade[..., None] * colour * (1.0 + texture * pattern[..., None])
    coverage = F.avg_pool2d(mask[None, None].float(), 2)[0]
    front = F.avg_pool2d((surface * mask[..., None]).permute(2, 0, 1)[None].float(), 2)[0]
    back = procedural_background(size, generator) if background is None else background
    back = gaussian_smooth(back[None], DEFOCUS)[0]
    image = front + (1.0 - coverage) * back + 0.01 * torch.randn(3, H, W, generator=generator)
    # Outer borders of the outermost pixels, converted from the fine grid to the picture's.
    border = torch.tensor([int(columns[0]) - 0.5, int(rows[0]) - 0.5, int(columns[-1]) + 0.5, int(rows[-1]) + 0.5])
    return image.clamp(0, 1), (border - 0.5) / 2.0

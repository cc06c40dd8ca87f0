"""The scene of ``curvireg demo`` and of the viewer's sample."""

from dataclasses import dataclass

import torch
import trimesh
from torch import Tensor

from ..geometry import camera_matrix
from .photographs import random_pose
from .tabletop import photograph_tabletop
from .truck import example_mesh

__all__ = ["DemoScene", "demo_scene"]


@dataclass(frozen=True)
class DemoScene:
    """A generated photograph of a known object.

    Attributes:
        mesh: of the object, in metres.
        image: (3, 720, 960) float32 RGB in [0, 1].
        box: (4,) x0, y0, x1, y1 in px.
        camera_matrix: (3, 3) float64.
        truth: (4, 4) float64 ``T_cam_from_model``.
    """

    mesh: trimesh.Trimesh
    image: Tensor
    box: Tensor
    camera_matrix: Tensor
    truth: Tensor


def demo_scene(seed: int = 2) -> DemoScene:
    """A toy truck on a table, at a pose that depends on ``seed``.

    Example:
        >>> demo_scene().image.shape
        torch.Size([3, 720, 960])
    """
    generator = torch.Generator().manual_seed(seed)
    mesh, size = example_mesh(), (720, 960)
    K = camera_matrix(1040.0, 1040.0, 479.5, 359.5, dtype=torch.float64)
    truth = random_pose(mesh, K, size, generator, elevations=(12.0, 45.0), fill=(0.75, 0.95))
    image, box = photograph_tabletop(example_mesh(painted=True), truth, K, size, generator)
    return DemoScene(mesh, image, box, K, truth)

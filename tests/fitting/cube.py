"""A cube in front of a camera, shared by the tests of fits."""

import torch
import torch.nn.functional as F
import trimesh

from curvireg_torch import camera_matrix
from curvireg_torch.fitting.edges import EdgeCrops
from curvireg_torch.fitting.measured_fit import edges_at
from curvireg_torch.geometry import rotation_from_axis_angle
from curvireg_torch.geometry.cameras import transform
from curvireg_torch.registration import fit_contours
from curvireg_torch.rendering import make_renderer
from curvireg_torch.rendering.contours import MeshContours
from tests._support import double, seeded

K = camera_matrix(300.0, 310.0, 63.5, 60.0)
BOX = torch.tensor([40.0, 36, 88, 84])


def cube():
    return trimesh.creation.box((1.0, 1.4, 0.8))


def pose(axis_angle, position):
    """(4, 4) of a rotation in rad and a position."""
    R = rotation_from_axis_angle(double(axis_angle))
    return transform(R, double(position))


CUBE_POSE = pose([0.4, 0.5, 0.1], [0.0, 0.0, 8.0])


def silhouette(mesh, T):
    """(1, 128, 128) white object on black."""
    return (make_renderer(mesh).render(T[None], K, (128, 128))[0] > 0).float()


def crops_of(image, box, mask=None):
    """The crop of one photograph around its box (4,)."""
    return EdgeCrops.cut([image], box[None], 0.1, mask)


def cube_crops(mask=None):
    """The silhouette of the cube in its pose."""
    return crops_of(silhouette(cube(), CUBE_POSE), BOX, mask)


def edges_in(image, box, contours, K, T):
    """Support and excess of the poses T (N, 4, 4) in one photograph."""
    index = torch.zeros(len(T), dtype=torch.long)
    return edges_at(contours, crops_of(image, box), K.expand(len(T), 3, 3), T, index)


def random_points(count, centre):
    """(1, count, 3) points in a cube around a centre, and as many normals (1, count, 2)."""
    generator = seeded(0)
    model = centre + 2.0 * torch.rand(1, count, 3, generator=generator, dtype=torch.float64) - 1.0
    normals = torch.randn(1, count, 2, generator=generator, dtype=torch.float64)
    return model, F.normalize(normals, dim=-1)


def noise():
    return torch.rand(3, 128, 128, generator=seeded(0))


def fitted(image, starts, *, mesh=None, **options):
    """Fit a mesh, by default the cube, to a photograph that shows it in ``BOX``."""
    return fit_contours(
        MeshContours(mesh or cube()), image, options.pop("box", BOX), K, starts, **options
    )

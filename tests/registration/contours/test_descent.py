"""The steps of the contour stage on edges at known places along the normals."""

import math
from typing import Any

import pytest
import torch
import torch.nn.functional as F
import trimesh
from torch import Tensor

from curvireg_torch import camera_matrix
from curvireg_torch.geometry import rotation_from_axis_angle
from curvireg_torch.geometry.cameras import transform
from curvireg_torch.io.meshes import mesh_centre, mesh_radius
from curvireg_torch.registration import fit_contours
from curvireg_torch.registration.contours.descent import ContourProblem, ContourState, apply_twist, project
from curvireg_torch.registration.contours.points import ContourPoints
from curvireg_torch.rendering import make_renderer

K = camera_matrix(300.0, 310.0, 63.5, 60.0, dtype=torch.float64)[None]
CENTRE = torch.tensor([0.2, -0.1, 0.3], dtype=torch.float64)
T = transform(
    rotation_from_axis_angle(torch.tensor([0.3, -0.5, 0.2], dtype=torch.float64)),
    torch.tensor([0.1, 0.2, 6.0], dtype=torch.float64),
)[None]


class Edges:
    """Parabolas 1.5 px wide to both sides of (E, P) places in px, so high."""

    def __init__(self, places: Tensor, heights: list[float]) -> None:
        self.places, self.heights = places, torch.tensor(heights, dtype=torch.float64)

    def strength(self, uv: Tensor, normals: Tensor, offsets: Tensor, image_index: Tensor) -> Tensor:
        apart = (offsets - self.places[:, :, None]) / 1.5
        return (self.heights[:, None, None] * (1.0 - apart**2).clamp(min=0.0)).sum(dim=0)[None]


def views(places: Tensor, heights: list[float]) -> ContourProblem:
    return ContourProblem(None, Edges(places, heights), torch.tensor([0]), K, 128, CENTRE, 1.0)  # type: ignore[arg-type]


def points(count: int, valid: int | None = None) -> ContourPoints:
    generator = torch.Generator().manual_seed(0)
    model = CENTRE + 2.0 * torch.rand(1, count, 3, generator=generator, dtype=torch.float64) - 1.0
    normals = F.normalize(torch.randn(1, count, 2, generator=generator, dtype=torch.float64), dim=-1)
    return ContourPoints(model, normals, torch.arange(count)[None] < (count if valid is None else valid))


def there(some: ContourPoints) -> ContourState:
    return ContourState(T, T, some)


def at(count: int, *places: float) -> Tensor:
    return torch.tensor(places, dtype=torch.float64)[:, None].expand(-1, count)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_nearer_of_two_edges_is_matched_to_a_fraction_of_a_pixel(side):
    found = views(at(9, 1.2 * side, -2.0 * side), [0.5, 0.6]).matches(there(points(9, valid=7)), 4.0)
    torch.testing.assert_close(found.distance[0, :7, 0], torch.full((7,), 1.2 * side, dtype=torch.float64))
    seen = 0.5 * (1.0 - (0.2 / 1.5) ** 2)  # at the whole pixel
    tukey = (1.0 - (1.2 / 4.0) ** 2) ** 2
    assert found.weight[0, :, 0].tolist() == pytest.approx([seen * tukey] * 7 + [0.0] * 2)


def test_support_is_the_mean_strength_near_points_that_count():
    some = points(8, valid=4)
    assert float(views(at(8, 0.0), [0.7]).edge_support(there(some))) == pytest.approx(0.7)
    assert float(views(at(8, 1.0), [0.7]).edge_support(there(some))) == pytest.approx(0.7 * math.exp(-0.5))
    assert float(views(at(8, -3.0), [0.7]).edge_support(there(some))) == pytest.approx(
        0.7 * (1 - 1 / 2.25) * math.exp(-2.0)
    )
    half = torch.where(torch.arange(8) % 2 == 0, 0.0, 50.0)[None].double()
    assert float(views(half, [0.7]).edge_support(there(some))) == pytest.approx(0.35)
    assert float(views(half, [0.7]).edge_support(there(points(8, valid=0)))) == 0.0


def test_a_step_undoes_a_motion_though_stronger_edges_lie_elsewhere():
    """Edges where the points of the moved object are, and for every third point a stronger one 4 px to a side of it."""
    some = points(120)
    motion = torch.tensor([0.006, -0.008, 0.01, 0.01, -0.015, 0.06], dtype=torch.float64)
    _, by_motion = project(some.model, T, K, CENTRE)
    distance = (some.normals[..., None, :] @ by_motion)[..., 0, :] @ motion
    assert float(distance.abs().max()) > 1.5
    sides = torch.where(torch.arange(120) % 2 == 0, 4.0, -4.0)
    false = torch.where(torch.arange(120) % 3 == 0, distance + sides, 90.0)
    found = views(torch.cat([distance, false]), [0.5, 0.6])._step(some, T, 6.0)[0]
    torch.testing.assert_close(found, motion, rtol=0.03, atol=1e-4)


def test_nothing_found_is_no_step_and_a_long_one_is_cut():
    assert views(at(30, 90.0), [1.0])._step(points(30), T, 6.0)[0].tolist() == [0.0] * 6
    z = float(T[0, 2, :3] @ CENTRE + T[0, 2, 3])
    for step, share in (
        ([0.1, 0.0, 0.0, 0.0, 0.0, 0.05 * z], 1.0),
        ([0.0, 0.3, 0.4, 0.0, 0.0, 0.01 * z], 0.4),
        ([0.1, 0.0, 0.0, 0.3 * z, 0.0, 0.4 * z], 0.2),
    ):
        whole = torch.tensor([step], dtype=torch.float64)
        torch.testing.assert_close(views(at(1, 0.0), [1.0])._bounded(whole, T), share * whole)


def test_starts_that_the_first_rounds_made_no_better_come_back_as_they_were() -> None:
    """On noise, where fits lead anywhere: only one start is finished, and four others, all the same, gain nothing."""
    mesh, generator = trimesh.creation.box((1.0, 1.4, 0.8)), torch.Generator().manual_seed(3)
    noise = torch.rand(3, 128, 128, generator=torch.Generator().manual_seed(0))
    pose = transform(
        rotation_from_axis_angle(torch.tensor([0.4, 0.5, 0.1]).double()), torch.tensor([0.0, 0.0, 8.0]).double()
    )
    off = 0.3 * torch.randn(12, 6, generator=generator, dtype=torch.float64)
    off[:4] = 0.0
    starts = apply_twist(pose.repeat(12, 1, 1), off, mesh_centre(mesh))
    fit = fit_contours(
        make_renderer(mesh),
        noise,
        torch.tensor([40.0, 36, 88, 84]),
        K[0],
        starts,
        centre=mesh_centre(mesh),
        radius=mesh_radius(mesh),
        finish=1,
    )
    as_they_were = (fit.transform == starts).all(dim=(1, 2))
    assert int(as_they_were.sum()) >= 3
    assert int(as_they_were.sum()) < 9


class Counting:
    """A renderer that notes how many poses are rendered at full size at a time."""

    name = "counting"

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self.inner, self.poses = make_renderer(mesh), [0]

    def render(self, T: Tensor, K: Tensor, size: tuple[int, int], **options: Any) -> Tensor:
        if size[0] == 256:
            self.poses.append(len(T))
        return self.inner.render(T, K, size, **options)


def test_a_second_fit_goes_on_where_it_is_another_pose() -> None:
    """Around the true pose in a picture of two grey levels all turns lead back to it, and one pose goes on to full
    size; on noise they lead elsewhere, and two do."""
    mesh = trimesh.creation.box((1.0, 1.4, 0.8))
    pose = transform(
        rotation_from_axis_angle(torch.tensor([0.4, 0.5, 0.1]).double()), torch.tensor([0, 0, 8.0]).double()
    )
    clear = (make_renderer(mesh).render(pose[None], K[0], (128, 128))[0] > 0).float()
    noise = torch.rand(3, 128, 128, generator=torch.Generator().manual_seed(0))
    most = []
    for image in (clear, noise):
        renderer = Counting(mesh)
        box, places = torch.tensor([40.0, 36, 88, 84]), {"centre": mesh_centre(mesh), "radius": mesh_radius(mesh)}
        fit_contours(renderer, image, box, K[0], pose[None], **places)
        most.append(max(renderer.poses))
    assert most == [1, 2]

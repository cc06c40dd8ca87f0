import math
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import pytest
import torch
import torch.nn.functional as F
from torch.testing import assert_close

from curvireg_torch import camera_matrix, rotation_error
from curvireg_torch.fitting import contour_fit
from curvireg_torch.fitting.contour_fit import fit_to_edges, short_fit
from curvireg_torch.fitting.contour_problem import ContourProblem, ContourState
from curvireg_torch.fitting.edges import EdgeField, ObjectMask, PosesByPicture
from curvireg_torch.fitting.least_squares import apply_twist, project
from curvireg_torch.geometry import axis_angle_from_rotation
from curvireg_torch.mesh.mesh import mesh_centre
from curvireg_torch.registration import ContourFit, fit_contours
from curvireg_torch.rendering.contours import ContourPoints, MeshContours
from curvireg_torch.synthetic import example_mesh, random_pose, synthesize_photograph
from curvireg_torch.terms import crop_photographs
from tests._support import (
    check_near,
    double,
    eye,
    refused,
    seeded,
    skip_unless_products_are_exact,
    slow_after,
    zeros,
)
from tests.fitting.cube import (
    BOX,
    CUBE_POSE,
    K,
    cube,
    cube_crops,
    edges_in,
    fitted,
    noise,
    pose,
    random_points,
    silhouette,
)

CENTRE = double([0.2, -0.1, 0.3])
T = pose([0.3, -0.5, 0.2], [0.1, 0.2, 6.0])[None]
HERE = (0.0,)
FIRST = torch.tensor([0])
ONE = PosesByPicture(FIRST)


class ParabolicEdges:
    """Edges of given heights at (E, P) distances in px along the normals: parabolas 1.5 px wide to
    both sides."""

    def __init__(self, distances, heights):
        self.distances = distances
        self.heights = double(heights)

    def strength(self, uv, normals, offsets, image_index):
        apart = (torch.tensor(offsets) - self.distances[:, :, None]) / 1.5
        return (self.heights[:, None, None] * (1.0 - apart**2).clamp(min=0.0)).sum(dim=0)[None]

    def counts(self, uv, valid, image_index):
        return valid


def problem(distances, heights):
    contours = SimpleNamespace(centre=CENTRE, radius=1.0)
    edges = ParabolicEdges(distances, heights)
    return ContourProblem(contours, edges, FIRST, K[None], 128)


def state(count, valid=None):
    mask = torch.arange(count)[None] < (count if valid is None else valid)
    return ContourState(T, T, ContourPoints(*random_points(count, CENTRE), mask, mask))


def at(count, *distances):
    return double(distances)[:, None].expand(-1, count)


def twist_of(one, points, radius):
    """(6,) by which a step moves the pose, to first order."""
    moved = one.step(points, T, radius)
    turn = moved[0, :3, :3] @ T[0, :3, :3].T
    w = 0.5 * torch.stack(
        [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
    )
    shift = (moved[0, :3, :3] @ CENTRE + moved[0, :3, 3]) - (T[0, :3, :3] @ CENTRE + T[0, :3, 3])
    return torch.cat([w, shift])


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_edges_are_measured_to_a_fraction_of_a_pixel(side):
    measured = problem(at(9, 1.2 * side, -2.0 * side), [0.5, 0.6]).measured_edges(
        state(9, valid=7), 4.0
    )
    assert measured.distance[0, :7, 0].tolist() == pytest.approx([1.2 * side] * 7)
    strength = 0.5 * (1.0 - (0.2 / 1.5) ** 2)  # at the nearest whole pixel
    tukey = (1.0 - (1.2 / 4.0) ** 2) ** 2
    assert measured.weight[0, :, 0].tolist() == pytest.approx([strength * tukey] * 7 + [0.0] * 2)


def test_edge_support_is_the_mean_strength_near_valid_points():
    half = double([[0.0, 50.0] * 4])
    beside = 0.7 * (1 - 1 / 2.25) * math.exp(-2.0)
    cases = (at(8, 0.0), 4, 0.7), (at(8, -3.0), 4, beside), (half, 4, 0.35), (half, 0, 0.0)
    for distances, valid, expected in cases:
        support = problem(distances, [0.7]).edge_support(state(8, valid=valid))
        assert float(support) == pytest.approx(expected)


def test_step_undoes_a_motion_despite_stronger_wrong_edges():
    """Edges at the points of the moved object, and for every third point a stronger one 4 px beside
    it."""
    points = state(120).points
    motion = double([0.006, -0.008, 0.01, 0.01, -0.015, 0.06])
    distance = project(points.model, points.normals, T, K[None], CENTRE)[1] @ motion
    assert distance.abs().max() > 1.5
    sides = torch.where(torch.arange(120) % 2 == 0, 4.0, -4.0)
    wrong = torch.where(torch.arange(120) % 3 == 0, distance + sides, 90.0)
    found = twist_of(problem(torch.cat([distance, wrong]), [0.5, 0.6]), points, 6.0)
    assert_close(found, motion, rtol=0.03, atol=2e-4)


def slope():
    """(64, 64) distances in px along a slanted direction."""
    y, x = torch.meshgrid(torch.arange(64.0), torch.arange(64.0), indexing="ij")
    return 0.8 * x + 0.6 * y


def test_edge_strength_peaks_on_a_slanted_edge():
    n = double([[[0.8, 0.6]]])
    image = torch.sigmoid(4 * (slope() - 44.0))[None, None]
    here = double([[[32.0, 31.0]]])  # 0.2 px from the edge
    edges = EdgeField(image)
    offsets = tuple(range(-5, 6))
    across = edges.strength(here, n, offsets, ONE)[0, 0]
    assert int(across.argmax()) == 5
    assert float(across[0]) < 0.1 * float(across[5])
    along = edges.strength(here, n.flip(-1) * double([-1.0, 1.0]), offsets, ONE)
    assert along.max() < 0.01
    assert edges.strength(here + 500, n, offsets, ONE).max() == 0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_edge_strength_falls_with_the_fifth_power_of_the_cosine_in_the_strongest_channel(sign):
    ramp = sign * torch.tensor([0.004, 0.01, -0.005])[:, None, None] * slope()
    angles = math.atan2(0.6, 0.8) + double([0.0, 0.3, -0.6, 1.0, math.pi / 2, math.pi])
    n = torch.stack([angles.cos(), angles.sin()], dim=-1)[None]
    here = double([31.5, 30.2]).expand(1, 6, 2)
    strength = EdgeField(ramp[None]).strength(here, n, HERE, ONE)[0, :, 0].double()
    r = strength / (1.0 - strength)  # in units of the crop's root mean square gradient
    cosine = (angles - angles[0]).cos().abs()
    assert_close(r / r[0], cosine**5, rtol=1e-3, atol=1e-4)


def test_edges_outside_the_photograph_do_not_count():
    """A crop whose right half repeats the border of the photograph."""
    inside = torch.zeros(1, 1, 64, 64)
    inside[..., :32] = 1.0
    edges = EdgeField(torch.rand(1, 3, 64, 64, generator=seeded(0)), inside)
    uv = double([[[10.0, 20.0], [12.0, 40.0], [50.0, 20.0]]])
    n = double([1.0, 0.0]).expand(1, 3, 2)
    valid = torch.ones(1, 3, dtype=torch.bool)
    assert (edges.strength(uv, n, HERE, ONE)[0, :, 0] > 0).tolist() == [True, True, False]
    assert edges.counts(uv, valid, FIRST).tolist() == [[True, True, False]]
    # with less than half of the points inside, all count
    few = uv.index_fill(1, torch.tensor([1]), 50.0)
    assert edges.counts(few, valid, FIRST).tolist() == [[True, True, True]]


def half_planes(*columns):
    """For each column a crop of 256 px with the object to its left."""
    x = torch.arange(256)
    return ObjectMask(torch.stack([(x < column).float().expand(1, 256, 256) for column in columns]))


def row_of_points(outline, direction, *, count=1):
    normals = double([direction, 0.0]).expand(count, 1, 2)
    there = torch.ones(count, 1, dtype=torch.bool)
    return ContourPoints(
        torch.zeros(count, 1, 3, dtype=torch.float64), normals, there, there & outline
    )


def test_mask_weights_within_at_the_border_and_beyond_in_the_crop_of_each_pose():
    """At 20 px to the left of the border, on it, and at 20 px to the right."""
    uv = double([[[127.5, 90.0]]])
    offsets = (-20.0, 0.0, 20.0)
    # at the second the object lies outside
    for outline, direction, expected in (
        (True, 1.0, [0.6, 2.0, 0.6]),
        (True, -1.0, [0.6, 0.6, 0.6]),
        (False, 1.0, [1.0, 0.3, 0.3]),
        (False, -1.0, [0.3, 0.3, 1.0]),
    ):
        points = row_of_points(outline, direction)
        weights = half_planes(128).weights(uv, points, offsets, ONE, 256)
        assert weights[0, 0].tolist() == pytest.approx(expected)
    # Borders at 128 and 64 of 256 px are at 64 and 32 of 128 px; the mask is read 3 px to both
    # sides there.
    uv = double([[[31.5, 50.0]], [[63.5, 50.0]], [[31.5, 50.0]]])
    poses = PosesByPicture(torch.tensor([0, 0, 1]))
    found = half_planes(128, 64).weights(uv, row_of_points(True, 1.0, count=3), HERE, poses, 128)
    assert found.flatten().tolist() == pytest.approx([0.6, 2.0, 2.0])
    off = (-2.4, 2.4, -3.6, 3.6)
    found = half_planes(128).weights(uv[1:2], row_of_points(True, 1.0), off, ONE, 128)
    assert found.flatten().tolist() == pytest.approx([2.0, 2.0, 0.6, 0.6])


def test_mask_weights_steps_and_comparison_and_not_the_reported_support():
    """For two points of three the edge at 3 px is wrong; the mask gives it a tenth of the weight of
    the others."""
    wrong = torch.arange(120) % 3 > 0
    plain = problem(torch.where(wrong, 3.0, 0.0).double()[None], [0.6])
    weights = torch.where(wrong, 0.1, 1.5).double()[None]
    mask = SimpleNamespace(
        weights=lambda *_: weights[..., None], largest_weights=lambda _: 2.0 * weights
    )
    weighted = replace(plain, mask=mask)
    points = state(120)
    steps = [float(twist_of(one, points.points, 6.0).norm()) for one in (plain, weighted)]
    assert steps[1] < 0.2 * steps[0]
    assert_close(
        weighted.measured_edges(points, 4.0).weight, plain.measured_edges(points, 4.0).weight
    )
    assert float(weighted.edge_support(points)) == float(plain.edge_support(points))
    # Of the edges at 3 px, the flank at 2 px counts most.
    flank = (1 - 1 / 2.25) * math.exp(-2.0)
    by_hand = 0.6 * (60 + 8 * flank) / (2 * (60 + 8))
    assert float(weighted.supports(points)[1]) == pytest.approx(by_hand)
    assert float(plain.supports(points)[1]) == float(plain.edge_support(points))


@pytest.mark.parametrize("seed", slow_after(2, range(4)))
def test_fit_recovers_a_pose_three_degrees_and_three_per_cent_off(seed):
    mesh = example_mesh()
    generator = seeded(seed)
    size = (360, 480)
    camera = camera_matrix(600.0, 600.0, 239.5, 179.5)
    truth = random_pose(mesh, camera, size, generator, elevations=(10.0, 50.0))
    # darker than any shade of the object: its outline shows all around
    black = torch.zeros(3, *size)
    image, box = synthesize_photograph(
        mesh, truth, camera, size, generator, background=black, texture=0.0
    )
    axis = F.normalize(torch.randn(3, generator=generator, dtype=torch.float64), dim=0)
    off = torch.cat([math.radians(3.0) * axis, 0.03 * truth[2, 3] * torch.tensor([0.1, 0.1, 0.99])])
    start = apply_twist(truth[None], off[None], mesh_centre(mesh))
    contours = MeshContours(mesh)
    fit = fit_contours(contours, image, box, camera, start)
    check_near(fit.transform[0], truth, degrees=0.6, share=0.01)
    R = fit.transform[0, :3, :3]
    assert_close(R @ R.T, eye(3))
    C = fit.covariance[0]
    assert torch.linalg.eigvalsh(C).min() > 0
    assert 0.001 < torch.rad2deg(C.diagonal()[:3].sqrt()).max() < 5.0
    assert int(fit.observable) == 6
    assert float(fit.start_support) < float(fit.edge_support)
    support, excess = edges_in(image, box, contours, camera, fit.transform)
    assert float(support) == pytest.approx(float(fit.edge_support), abs=0.03)
    assert float(excess) == pytest.approx(float(fit.edge_excess), abs=0.03)


def test_a_fit_begins_around_its_start_and_farther_away_if_it_is_a_second_one(monkeypatch):
    """From rotations in degrees about x, y and z."""
    begun = []
    promising = contour_fit._promising

    def watched(half, around, count):
        turns = axis_angle_from_rotation(around[0, :, :3, :3] @ CUBE_POSE[:3, :3].T).rad2deg()
        begun.append({tuple(turn) for turn in turns.round().int().tolist()})
        return promising(half, around, count)

    monkeypatch.setattr(contour_fit, "_promising", watched)
    crops = cube_crops()
    T = CUBE_POSE[None]
    for refit in (False, True):
        fit_to_edges(MeshContours(cube()), crops, K[None], T, FIRST, short_fits=T, refit=refit)
    near = {(0, 0, 0), (8, 0, 0), (-8, 0, 0), (0, 8, 0), (0, -8, 0), (0, 0, 6), (0, 0, -6)}
    far = {(16, 0, 0), (-16, 0, 0), (0, 16, 0), (0, -16, 0)}
    assert begun == [near, near | far]


def test_fit_without_edges_returns_the_start():
    """In one colour, outside the crop, and behind the camera."""
    plain = torch.full((3, 128, 128), 0.4)
    for image, position in (
        (plain, [0.0, 0.0, 8.0]),
        (noise(), [9.0, 0.0, 8.0]),
        (noise(), [0.0, 0.0, -8.0]),
    ):
        start = pose([0.4, 0.5, 0.1], position)[None]
        fit = fitted(image, start)
        assert fit.transform.equal(start)
        assert float(fit.edge_support) == 0
        assert fit.covariance.isnan().all()


def test_a_grey_photograph_counts_as_three_equal_channels():
    """As a file of it is read: the level of edges is a sum over channels."""
    image = silhouette(cube(), CUBE_POSE).mean(dim=0, keepdim=True)
    start = pose([0.42, 0.5, 0.1], [0.0, 0.0, 8.0])[None]
    grey, colour = (fitted(picture, start) for picture in (image, image.expand(3, -1, -1)))
    assert colour.edge_support > 0.1
    assert grey.edge_support.equal(colour.edge_support)
    assert grey.transform.equal(colour.transform)


def test_edges_of_a_picture_are_the_same_alone_and_among_others(threads):
    skip_unless_products_are_exact()
    generator = seeded(0)
    images = torch.rand(4, 3, 256, 256, generator=generator)
    index = torch.tensor([3, 1, 3, 2, 1])
    uv = 255.0 * torch.rand(5, 40, 2, generator=generator).double()
    normals = F.normalize(torch.randn(5, 40, 2, generator=generator).double(), dim=-1)
    threads(1)
    by_picture = PosesByPicture(index)
    together = EdgeField(images).strength(uv, normals, (-1.0, 0.5, 1.0), by_picture)
    threads(3)
    for n, k in enumerate(index.tolist()):
        edges = EdgeField(images[k : k + 1])
        alone = edges.strength(uv[n : n + 1], normals[n : n + 1], (-1.0, 0.5, 1.0), ONE)
        assert alone[0].equal(together[n])
        assert alone.amax() > 0.3


@cache
def several():
    """Three photographs of the cube with their own sizes and cameras, and five starts: two, two and
    one, shuffled."""
    generator = seeded(0)
    off = double([[0.05, -0.03, 0.02, 0.0, 0.0, 0.05], [0.0, 0.4, 0.0, 0.0, 0.05, 0.0]])
    photographs = []
    starts = []
    for i, size in enumerate([(100, 128), (128, 96), (120, 120)]):
        camera = camera_matrix(300.0 + 20 * i, 300.0, size[1] / 2, size[0] / 2)
        truth = random_pose(cube(), camera, size, generator)
        image, box = synthesize_photograph(cube(), truth, camera, size, generator)
        photographs.append(((255 * image).round().byte(), box, camera))
        starts.append(apply_twist(truth.repeat(2, 1, 1), off, zeros(3)))
    images, boxes, cameras = zip(*photographs, strict=True)
    order = torch.tensor([3, 0, 4, 1, 2])
    return images, torch.stack(boxes), torch.stack(cameras), torch.cat(starts)[order], order // 2


def test_fits_of_a_batch_equal_single_fits():
    images, boxes, cameras, starts, image_index = several()
    contours = MeshContours(cube())
    fit = fit_contours(contours, images, boxes, cameras, starts, image_index=image_index)
    for i, b in enumerate(image_index.tolist()):
        alone = fit_contours(
            contours, images[b].float() / 255, boxes[b], cameras[b], starts[i : i + 1]
        )
        assert not alone.transform[0].equal(starts[i])
        # Crops are float32: the last bit depends on threads and vectors, which moves a fit of many
        # steps by some 1e-7, and a point across the border of a covariance cell, worth 0.3 % of it.
        # A round that is shared by mistake moves poses by 1e-2 and support by 1e-3.
        covariance = 0.02 * alone.covariance.max()
        tolerances = {"transform": 1e-4, "edge_support": 1e-4, "covariance": covariance}
        for name, atol in tolerances.items():
            assert_close(getattr(fit, name)[i], getattr(alone, name)[0], rtol=0, atol=atol)


def test_fit_finishes_the_best_starts_of_each_photograph():
    images, boxes, cameras, starts, image_index = several()
    off = double([0.6, 0.5, 0.7, 0.0, 0.0, 0.4]).expand(5, 6)
    both = torch.cat([apply_twist(starts, off, mesh_centre(cube())), starts])
    index = torch.cat([image_index, image_index])
    contours = MeshContours(cube())
    whole, one = (
        fit_contours(contours, images, boxes, cameras, both, image_index=index, finish=n)
        for n in (None, 1)
    )
    same = (one.transform - whole.transform).abs().amax(dim=(1, 2)) < 1e-9
    assert torch.bincount(index[same], minlength=3).tolist() == [1, 1, 1]
    for b in range(3):
        best = whole.edge_support[index == b].max()
        assert_close(one.edge_support[index == b].max(), best, rtol=0, atol=1e-4)


def test_start_support_is_at_full_size_and_trustworthy_depends_on_support_or_gain():
    off = double([[0.1, 0.1, 0.0, 0.05, 0.0, 0.1]])
    start = apply_twist(CUBE_POSE[None], off, mesh_centre(cube()))
    image = silhouette(cube(), CUBE_POSE)
    expected, _ = edges_in(image, BOX, MeshContours(cube()), K, start)
    fit = fitted(image, start)
    assert_close(fit.start_support, expected)
    assert fit.trustworthy
    assert not fitted(noise(), start).trustworthy
    none = torch.zeros(4)
    supports = (torch.tensor([0.51, 0.49, 0.35, 0.25]), torch.tensor([0.49, 0.45, 0.1, 0.1]))
    made = ContourFit(none, none, *supports, none, none)
    assert made.trustworthy.tolist() == [True, False, True, False]


def test_fit_rejects_bad_input():
    with refused("starts: expected finite"):
        fitted(noise(), CUBE_POSE[None] * math.nan)
    for message, options in (
        ("box: expected shape", {"box": torch.zeros(2, 4)}),
        ("finish: expected", {"finish": 0}),
        ("object_mask", {"object_mask": torch.ones(2, 1, 8, 8)}),
        ("image_index: expected", {"image_index": torch.tensor([1])}),
    ):
        with refused(message):
            fitted(noise(), CUBE_POSE[None], **options)


def test_a_short_fit_reaches_far_and_counts_the_mask():
    """At a quarter of the size, edges are found from 28 px beside them, which a fit at full size
    does not reach."""
    contours = MeshContours(cube())
    crops = cube_crops()
    crop = ContourProblem.of(contours, crops, K[None])
    focal = float(crop.K[0, 0, 0])
    depth = float((CUBE_POSE[:3, :3] @ mesh_centre(cube()) + CUBE_POSE[:3, 3])[2])
    beside = CUBE_POSE.clone()
    beside[0, 3] += 28.0 / focal * depth
    _, supports = short_fit(contours, crops, K.expand(2, 3, 3), torch.stack([CUBE_POSE, beside]))
    assert supports[1] > 0.95 * supports[0]
    image = silhouette(cube(), CUBE_POSE)
    inside = crop_photographs([image], BOX[None], size=64, margin=0.1)[:, :1].clamp(0, 1)
    with_mask, against = (
        float(short_fit(contours, cube_crops(mask), K[None], CUBE_POSE[None])[1])
        for mask in (inside, 1.0 - inside)
    )
    assert with_mask > 1.5 * against


def test_known_short_fits_change_nothing_and_fitted_poses_are_kept():
    """A pose that is fitted again moves only if fits around it end elsewhere."""
    contours = MeshContours(cube())
    starts = apply_twist(CUBE_POSE.repeat(2, 1, 1), torch.deg2rad(eye(6)[:2] * 6), contours.centre)
    problem = contours, cube_crops(), K.expand(2, 3, 3)
    both = FIRST.repeat(2)
    first = fit_to_edges(*problem, starts, both)
    known = fit_to_edges(*problem, starts, both, short_fits=short_fit(*problem, starts)[0])
    assert known.transform.equal(first.transform)
    assert known.edge_support.equal(first.edge_support)
    mixed = torch.stack([first.transform[0], starts[1]])
    again = fit_to_edges(*problem, mixed, both, refit=True)
    assert again.transform[0].equal(mixed[0])
    assert rotation_error(again.transform[1, :3, :3], CUBE_POSE[:3, :3]) < 1

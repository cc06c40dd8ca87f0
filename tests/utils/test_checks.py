"""The boundary of the library: what each public entry does with cameras, poses, photographs, boxes and masks."""

import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

import curvireg_torch as cr
from curvireg_torch import filters, geometry, metrics
from curvireg_torch.errors import CurviregError, ImageError, InvalidInputError
from curvireg_torch.geometry.cameras import transform
from curvireg_torch.io.meshes import mesh_centre, mesh_radius
from curvireg_torch.matching import distinct_views
from curvireg_torch.registration import fit_contours, localize
from curvireg_torch.rendering import make_renderer, render_colour
from curvireg_torch.rendering.shading import shade
from curvireg_torch.synthetic import example_mesh, synthesize_photograph
from curvireg_torch.terms import dilate_points
from curvireg_torch.utils.checks import check_pose, check_rotation, check_square_pixels
from curvireg_torch.visualization import contour_overlay, pose_glb, registration_sheet
from tests._support.scenes import unrefined

SIZE = (96, 128)
BACKENDS = ("torch", "embree")
CAMERA = torch.tensor([[220.1, 0.0, 63.5], [0.0, 220.1, 47.5], [0.0, 0.0, 1.0]], dtype=torch.float64)


@pytest.fixture(scope="module")
def mesh() -> trimesh.Trimesh:
    return example_mesh()


@pytest.fixture(scope="module")
def pose(mesh: trimesh.Trimesh) -> Tensor:
    R = cr.rotation_from_viewpoint(30.0, 20.0).double()
    centre = mesh_centre(mesh)
    return transform(R, torch.tensor([0.0, 0.0, 6.0 * mesh_radius(mesh)], dtype=torch.float64) - R @ centre)


@pytest.fixture(scope="module")
def photograph(mesh: trimesh.Trimesh, pose: Tensor) -> tuple[Tensor, Tensor]:
    return synthesize_photograph(mesh, pose, CAMERA, SIZE, torch.Generator().manual_seed(0))


@pytest.fixture(scope="module")
def thorough(mesh: trimesh.Trimesh) -> cr.Registrar:
    views = cr.sample_views(azimuth_step=30, elevations=[20])
    return cr.Registrar(cr.ViewBank.build(mesh, views, image_size=64, progress=False))


@pytest.fixture(scope="module")
def registrar(thorough: cr.Registrar) -> cr.Registrar:
    return cr.Registrar(thorough.bank, pipeline=unrefined(thorough.bank, box_jitter=0.0))


class Entries:
    """Every public entry as a call of one argument that everything else stands ready for."""

    def __init__(self, mesh: trimesh.Trimesh, pose: Tensor, photograph: tuple[Tensor, Tensor], registrar: Any) -> None:
        (image, box), R = photograph, pose[:3, :3]
        points = torch.from_numpy(np.array(mesh.vertices))
        renderers = {name: make_renderer(mesh, name) for name in BACKENDS}
        size, radius, centre = (24, 32), mesh_radius(mesh), mesh_centre(mesh)
        depth = torch.rand(1, 1, 16, 16) + 1.0
        result = registrar([image], box[None], CAMERA)[0]
        symmetries = torch.eye(4, dtype=torch.float64)[None]
        views = cr.sample_views(azimuth_step=90, elevations=[0])
        boxes, bank = torch.tensor([[0.0, 0.0, 9.0, 9.0]]), registrar.bank

        def fit(**given: Any) -> object:
            wanted = {"images": [image], "boxes": box[None], "camera_matrices": CAMERA, "starts": pose[None], **given}
            return fit_contours(renderers["embree"], *wanted.values(), centre=centre, radius=radius)

        def one(result: list[Any]) -> object:
            return result[0].rotation  # raises the error of a failed registration

        self.cameras: dict[str, Callable[[Tensor], object]] = {
            "Registrar": lambda K: one(registrar([image], box[None], K[None])),
            "Registrar, no box": lambda K: one(registrar([image], None, K)),
            "localize": lambda K: one(localize(registrar, [image], K)[0]),
            "Locator": lambda K: registrar.locator([image], camera_matrices=[K]),
            "locate": lambda K: cr.locate(registrar.pipeline, bank, [image], camera_matrices=[K]),
            "fit_contours": lambda K: fit(camera_matrices=K),
            "render_depth": lambda K: cr.render_depth(mesh, pose, K, size),
            "render_colour": lambda K: render_colour(mesh, pose, K, size),
            **{f"{b}.render": lambda K, b=b: renderers[b].render(pose[None], K, size) for b in BACKENDS},
            "shade": lambda K: shade(depth, K),
            "project_points": lambda K: cr.project_points(points, pose, K),
            "projected_boxes": lambda K: geometry.projected_boxes(points, pose, K),
            "translation_from_box": lambda K: geometry.translation_from_box(points, R, box, K),
            "pose_from_box": lambda K: geometry.pose_from_box(points, R, box, K),
            "opengl_projection": lambda K: geometry.opengl_projection(K, size, near=1.0, far=9.0),
            "mspd_error": lambda K: metrics.mspd_error(pose[None], pose[None], points, K),
            "pose_glb": lambda K: pose_glb(mesh, pose, K, image),
            "contour_overlay": lambda K: contour_overlay(registrar, result, image, box, K),
            "registration_sheet": lambda K: registration_sheet(registrar, result, image, box, K),
            "average_shading_gradient": lambda K: cr.average_shading_gradient(depth, camera_matrix=K.float()),
            "AverageShadingGradient": lambda K: cr.AverageShadingGradient(camera_matrix=K.float()),
            "apparent_ridges": lambda K: cr.apparent_ridges(depth, camera_matrix=K.float()),
            "ApparentRidges": lambda K: cr.ApparentRidges(camera_matrix=K.float()),
        }
        self.needs_square_pixels = ("Registrar", "Registrar, no box", "localize", "Locator", "locate")
        self.poses: dict[str, Callable[[Tensor], object]] = {
            "fit_contours": lambda T: fit(starts=T[None]),
            "render_depth": lambda T: cr.render_depth(mesh, T, CAMERA, size),
            "render_colour": lambda T: render_colour(mesh, T, CAMERA, size),
            **{f"{b}.render": lambda T, b=b: renderers[b].render(T[None], CAMERA, size) for b in BACKENDS},
            "project_points": lambda T: cr.project_points(points, T, CAMERA),
            "projected_boxes": lambda T: geometry.projected_boxes(points, T, CAMERA),
            "opengl_from_opencv": geometry.opengl_from_opencv,
            "opencv_from_opengl": geometry.opencv_from_opengl,
            "pytorch3d_from_opencv": geometry.pytorch3d_from_opencv,
            "pose_glb": lambda T: pose_glb(mesh, T, CAMERA, image),
            "add_error": lambda T: metrics.add_error(pose[None], T[None], points),
            "adds_error": lambda T: metrics.adds_error(pose[None], T[None], points),
            "mssd_error": lambda T: metrics.mssd_error(pose[None], T[None], points),
            "mspd_error": lambda T: metrics.mspd_error(pose[None], T[None], points, CAMERA),
            "mssd_error, symmetries": lambda T: metrics.mssd_error(pose[None], pose[None], points, symmetries=T[None]),
            "Registrar, symmetries": lambda T: cr.Registrar(bank, symmetries=torch.cat([symmetries, T[None]])),
            "distinct_views": lambda T: distinct_views(torch.arange(4), views.rotations, count=2, symmetries=T[None]),
            "views_without_symmetric": lambda T: geometry.views_without_symmetric(views, T[None]),
        }
        self.rotations: dict[str, Callable[[Tensor], object]] = {
            "rotation_error": lambda R: cr.rotation_error(pose[:3, :3], R),
            "rotation_error, first": lambda R: cr.rotation_error(R, pose[:3, :3]),
            "viewpoint_from_rotation": cr.viewpoint_from_rotation,
            "quaternion_from_rotation": geometry.quaternion_from_rotation,
            "axis_angle_from_rotation": geometry.axis_angle_from_rotation,
            "opencv_from_pytorch3d": lambda R: geometry.opencv_from_pytorch3d(R, torch.zeros(3).double()),
            "translation_from_box": lambda R: geometry.translation_from_box(points, R, box, CAMERA),
            "pose_from_box": lambda R: geometry.pose_from_box(points, R, box, CAMERA),
            "symmetric_rotation_error": lambda R: metrics.symmetric_rotation_error(R, pose[:3, :3], pose[None, :3, :3]),
            "axis_rotation_error": lambda R: metrics.axis_rotation_error(R, pose[:3, :3], torch.ones(3).double()),
            "symmetries": lambda R: metrics.symmetric_rotation_error(pose[:3, :3], pose[:3, :3], R[None]),
            "Objects": lambda R: metrics.Objects(torch.tensor([0]), boxes, R[None]),
        }
        self.photographs: dict[str, Callable[[Any], object]] = {
            "Registrar": lambda x: one(registrar([x], box[None])),
            "localize": lambda x: one(localize(registrar, [x])[0]),
            "ViewMatcher": lambda x: registrar.matcher([x], box[None]),
            "Locator": lambda x: registrar.locator([x]),
            "locate": lambda x: cr.locate(registrar.pipeline, bank, [x]),
            "fit_contours": lambda x: fit(images=[x]),
            "pose_glb": lambda x: pose_glb(mesh, pose, CAMERA, x),
            "contour_overlay": lambda x: contour_overlay(registrar, result, x, box),
        }
        self.boxes: dict[str, Callable[[Any], object]] = {
            "Registrar": lambda b: one(registrar([image], b)),
            "ViewMatcher": lambda b: registrar.matcher([image], b),
            "fit_contours": lambda b: fit(boxes=b),
            "crop_images": lambda b: cr.crop_images([image], b),
        }


@pytest.fixture(scope="module")
def entries(mesh: trimesh.Trimesh, pose: Tensor, photograph: tuple[Tensor, Tensor], registrar: cr.Registrar) -> Entries:
    return Entries(mesh, pose, photograph, registrar)


def refused(name: str, call: Callable[[Any], object], given: Any, match: str = "") -> CurviregError:
    """The error of an entry, which is ours and one line; fails where the entry takes what it is given."""
    error: CurviregError | None = None
    try:
        call(given)
    except CurviregError as raised:
        error = raised
    assert error is not None, f"{name} takes {given}"
    assert re.search(match, str(error)), f"{name}: {error}"
    assert "\n" not in str(error), name
    return error


def augment(matrix: Tensor, *changes: tuple[int, int, float]) -> Tensor:
    matrix = matrix.clone()
    for i, j, value in changes:
        matrix[i, j] = value
    return matrix


BAD_CAMERAS = {
    "NaN": augment(CAMERA, (0, 2, math.nan)),
    "infinite": augment(CAMERA, (1, 1, math.inf)),
    "fx = 0": augment(CAMERA, (0, 0, 0.0)),
    "fy = 0": augment(CAMERA, (1, 1, 0.0)),
    "fx < 0": augment(CAMERA, (0, 0, -220.1)),
    "both < 0": augment(CAMERA, (0, 0, -220.1), (1, 1, -220.1)),
    "skew": augment(CAMERA, (0, 1, 0.5)),
    "last row": augment(CAMERA, (2, 0, 0.01)),
    "not scaled": 2.0 * CAMERA,
    "transposed": CAMERA.T.contiguous(),
}


@pytest.mark.parametrize("bad", BAD_CAMERAS)
def test_no_entry_takes_a_bad_camera(entries: Entries, bad: str) -> None:
    for name, call in entries.cameras.items():
        error = refused(name, call, BAD_CAMERAS[bad], "camera.matri(x|ces): expected")
        assert isinstance(error, InvalidInputError)


def test_every_entry_takes_a_good_camera(entries: Entries) -> None:
    for call in entries.cameras.values():
        call(CAMERA)
        call(augment(CAMERA, (1, 1, 238.0)))  # 8 % apart


@pytest.mark.parametrize("fx", [195.0, 245.0])
def test_only_what_compares_views_asks_for_square_pixels(entries: Entries, fx: float) -> None:
    oblong = augment(CAMERA, (0, 0, fx))  # 11 % apart
    for name, call in entries.cameras.items():
        if name in entries.needs_square_pixels:
            refused(name, call, oblong, "square pixels.*resize")
        else:
            call(oblong)


def test_square_pixels_are_within_ten_per_cent_either_way() -> None:
    for ratio in (1.0 / 1.099, 1.0, 1.099):
        check_square_pixels(augment(CAMERA, (0, 0, 220.1 * ratio)))
    for ratio in (1.0 / 1.101, 1.101):
        with pytest.raises(InvalidInputError, match="square"):
            check_square_pixels(torch.stack([CAMERA, augment(CAMERA, (0, 0, 220.1 * ratio))]))


def bad_poses(T: Tensor) -> dict[str, Tensor]:
    def turned(R: Tensor) -> Tensor:
        return transform(R, T[:3, 3])

    shear = torch.eye(3, dtype=T.dtype)
    shear[0, 1] = 0.02
    return {
        "scaled up": turned(2.0 * T[:3, :3]),
        "scaled by 1 %": turned(1.01 * T[:3, :3]),
        "one axis scaled": turned(torch.diag(torch.tensor([1.0, 1.0, 1.02]).to(T)) @ T[:3, :3]),
        "mirrored": turned(torch.diag(torch.tensor([-1.0, 1.0, 1.0]).to(T)) @ T[:3, :3]),
        "inverted": turned(-T[:3, :3]),
        "sheared": turned(T[:3, :3] @ shear),
        "zero": turned(torch.zeros_like(T[:3, :3])),
        "NaN": augment(T, (1, 1, math.nan)),
        "infinite": augment(T, (0, 2, math.inf)),
    }


def test_no_entry_takes_a_pose_that_is_not_rigid(entries: Entries, pose: Tensor) -> None:
    others = augment(pose, (3, 0, 0.1)), augment(pose, (3, 3, 2.0)), augment(pose, (2, 3, math.inf))
    for T in (*bad_poses(pose).values(), *others):
        for name, call in entries.poses.items():
            refused(name, call, T, "expected (rigid|finite)")


def test_no_entry_takes_a_matrix_that_is_no_rotation(entries: Entries, pose: Tensor) -> None:
    for bad, T in bad_poses(pose).items():
        if bad not in ("NaN", "infinite"):  # a missing estimate of metrics
            for name, call in entries.rotations.items():
                refused(name, call, T[:3, :3], "expected rotations")


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_rounded_poses_pass(dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(0)
    R = geometry.rotation_from_axis_angle(2.0 * torch.randn(500, 3, generator=generator, dtype=torch.float64))
    T = transform(R, torch.randn(500, 3, generator=generator, dtype=torch.float64)).to(dtype)
    check_pose(T, "T")
    check_rotation(T[:, :3, :3], "R")
    check_pose(torch.linalg.inv(T.double()), "T")
    check_pose(T[:0], "T")
    check_pose(T[0], "T")


def test_every_entry_takes_a_pose_in_float32(entries: Entries, pose: Tensor) -> None:
    T = pose.float().double()  # rounded
    for call in entries.poses.values():
        call(T)
    for call in entries.rotations.values():
        call(T[:3, :3])


def test_no_entry_takes_what_is_no_photograph(entries: Entries, photograph: tuple[Tensor, Tensor]) -> None:
    image = photograph[0]
    for bad in (image[0], image[:2], image.long(), image > 0.5, image[None], image[:, :0], "missing.png", None):
        for name, call in entries.photographs.items():
            refused(name, call, bad)


def holes(image: Tensor, where: tuple[slice, slice], value: float) -> Tensor:
    image = image.clone()
    image[(slice(None), *where)] = value
    return image


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_missing_pixels_in_the_box_are_refused(
    entries: Entries, photograph: tuple[Tensor, Tensor], value: float
) -> None:
    image, box = photograph
    x, y = (int(v) for v in 0.5 * (box[:2] + box[2:]))
    for lost in (holes(image, (slice(y, y + 1), slice(x, x + 1)), value), torch.full_like(image, value)):
        for name in ("Registrar", "localize", "ViewMatcher", "Locator", "locate"):
            assert isinstance(refused(name, entries.photographs[name], lost, "NaN or inf in the pixels"), ImageError)
        fit: Any = entries.photographs["fit_contours"](lost)  # fills them
        assert bool(fit.transform.isfinite().all())


def test_pixels_beyond_one_are_refused(entries: Entries, photograph: tuple[Tensor, Tensor]) -> None:
    for name in ("Registrar", "localize", "ViewMatcher", "Locator", "locate"):
        refused(name, entries.photographs[name], 255.0 * photograph[0], r"outside \[0, 1\].*255")
        refused(name, entries.photographs[name], photograph[0] - 0.6, r"outside \[0, 1\].*255")


def test_missing_pixels_beside_the_box_do_not_matter(
    thorough: cr.Registrar, registrar: cr.Registrar, photograph: tuple[Tensor, Tensor]
) -> None:
    image, box = photograph
    H, W = image.shape[-2:]
    square = geometry.square_boxes(box, registrar.bank.settings.margin)
    x = min(int(square[2]) + 3, W - 1)
    assert x < W - 1
    lost = holes(image, (slice(0, H), slice(x, W)), math.nan)
    exact = (registrar.matcher([one], box[None]).scores for one in (lost, image))  # boxes as they are
    torch.testing.assert_close(*exact)
    found = thorough.matcher([lost], box[None])  # crops that are moved hold missing pixels
    assert bool(found.scores.isfinite().all())
    assert found.order[0, 0] == thorough.matcher([image], box[None]).order[0, 0]
    with_camera = [thorough([one], box[None], CAMERA)[0] for one in (image, lost)]
    assert float(cr.rotation_error(with_camera[0].rotation, with_camera[1].rotation)) < 5.0


def test_a_missing_pixel_spoils_the_pixels_of_the_crop_it_has_a_share_in() -> None:
    image = torch.rand(1, 3, 60, 80)
    boxes = torch.tensor([[30.0, 20.0, 60.0, 50.0]])
    clean, _ = cr.crop_images(image, boxes, size=32)
    outside = image.clone()
    outside[0, :, 2, 3], outside[0, 1, 59, 79] = math.nan, math.inf
    crop, _ = cr.crop_images(outside, boxes, size=32)
    torch.testing.assert_close(crop, clean, rtol=0, atol=0)
    inside = image.clone()
    inside[0, 1, 35, 45] = math.nan
    crop, A = cr.crop_images(inside, boxes, size=32)
    lost = crop.isnan()
    at = A[0] @ torch.tensor([45.0, 35.0, 1.0])
    rows, columns = lost[0, 1].nonzero().unbind(1)
    assert 1 <= int(lost.sum()) == int(lost[0, 1].sum()) <= 9
    assert float((columns - at[0]).abs().max()) < 2.0
    assert float((rows - at[1]).abs().max()) < 2.0
    torch.testing.assert_close(crop[~lost], clean[~lost], rtol=0, atol=0)
    several = torch.cat([inside, image])
    crops, _ = cr.crop_images(several, boxes.expand(2, 4), size=32)
    torch.testing.assert_close(crops[1], clean[0])


def test_fields_fill_missing_pixels() -> None:
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(1, 3, 64, 64, generator=generator)
    lost = image.clone()
    lost[0, :, 30:34, 30:34], lost[0, 2, 5, 5] = math.nan, math.inf
    where = filters.inputs.missing_mask(lost).any(dim=1, keepdim=True)
    learned = cr.LearnedCurvilinearSaliency()
    field = learned(lost)
    assert bool(field.isfinite().all())
    assert not bool(field.masked_select(where).any())
    assert bool(field.masked_select(~where).any())
    assert bool(learned.mask(lost).isfinite().all())
    from curvireg_torch.models.appearance import describe
    from curvireg_torch.models.backbone import Backbone

    appearance_scores = describe(torch.cat([image, lost]), Backbone())
    assert bool(appearance_scores.isfinite().all())
    assert 0.5 < float((appearance_scores[0].float() * appearance_scores[1].float()).sum()) < 0.9999


def test_a_field_of_ones_own_sees_no_missing_pixels(registrar: cr.Registrar, photograph: tuple[Tensor, Tensor]) -> None:
    image, box = photograph
    seen: list[Tensor] = []

    class Own(torch.nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            seen.append(x)
            return torch.ones_like(x).expand(-1, 2, -1, -1)

    matcher = cr.ViewMatcher(registrar.bank, field=Own())
    x, y = (int(v) for v in 0.5 * (box[:2] + box[2:]))
    query = matcher.query([holes(image, (slice(y, y + 4), slice(x, x + 4)), math.nan)], box[None])
    assert bool(seen[0].isfinite().all())
    lost = query.crops.isnan().any(dim=1, keepdim=True).expand_as(query.field)
    assert 0 < int(lost.sum()) < lost.numel()
    assert torch.equal(query.field == 0.0, lost)


def test_all_ways_to_write_boxes_and_cameras_are_one(
    registrar: cr.Registrar, photograph: tuple[Tensor, Tensor]
) -> None:
    image, box = photograph
    images, boxes = [image, image], torch.stack([box, box])
    expected = registrar(images, boxes, CAMERA.expand(2, 3, 3))[1]
    for as_boxes in (boxes.double(), [*boxes], boxes.tolist(), [*boxes.numpy()], boxes.numpy(), [box.tolist(), box]):
        assert torch.equal(registrar.matcher(images, as_boxes).scores, registrar.matcher(images, boxes).scores)
        torch.testing.assert_close(cr.crop_images(images, as_boxes)[0], cr.crop_images(images, boxes)[0])
        assert torch.equal(registrar(images, as_boxes, CAMERA)[1].rotation, expected.rotation)
    for K in (CAMERA, [CAMERA, CAMERA], [CAMERA.tolist()] * 2, [*CAMERA.expand(2, 3, 3).numpy()], CAMERA.numpy()):
        found = registrar(images, boxes, K)[1]
        assert torch.equal(found.rotation, expected.rotation)
        assert torch.equal(found.translation, expected.translation)


def test_boxes_that_are_none_are_refused_by_name(entries: Entries) -> None:
    for bad in (
        [["a", "b", "c", "d"]],
        [[1.0, 2.0, 3.0]],
        [[1.0, 2.0], [3.0, 4.0, 5.0]],
        [None],
        {"x": 1},
        np.array([[1, 2, 3, None]]),
        torch.ones(1, 4, dtype=torch.bool),
        [[9.0, 9.0, 3.0, 3.0]],
        [[math.nan, 0.0, 3.0, 3.0]],
    ):
        for name, call in entries.boxes.items():
            refused(name, call, bad, "box")


def test_cameras_that_are_none_are_refused_by_name(registrar: cr.Registrar, photograph: tuple[Tensor, Tensor]) -> None:
    image, box = photograph
    for bad in ([None], "camera", [CAMERA, None], [[1.0, 2.0, 3.0]], [CAMERA, CAMERA[:2]], [CAMERA] * 3):
        with pytest.raises(InvalidInputError, match="camera_matrices: expected"):
            registrar([image, image], torch.stack([box, box]), bad)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_photographs_are_cropped_where_whole_ones_are(dtype: torch.dtype) -> None:
    ramp = torch.linspace(0.0, 1.0, 3000).expand(1, 1, 1500, 3000)
    image = (37.0 * ramp).frac().to(dtype)  # many edges, so that a shift by a pixel is seen
    boxes = torch.tensor([[2001.0, 1001.0, 2101.0, 1101.0]])
    half, A = cr.crop_images(image, boxes, size=64)
    full, expected = cr.crop_images(image.float(), boxes, size=64)
    assert half.dtype == dtype
    assert torch.equal(half, full.to(dtype))
    assert A.dtype == torch.float32
    assert torch.equal(A, expected)
    assert cr.crop_images(image, boxes.double(), size=64)[1].dtype == torch.float64
    few = torch.tensor([[1.0, 2.0, 31.0, 32.0]], dtype=dtype)
    assert cr.crop_images(image[..., :99], few)[1].dtype == torch.float32


def test_masks_have_a_batch_axis_and_are_boolean() -> None:
    mask = torch.zeros(1, 9, 9, dtype=torch.bool)
    mask[0, 4, 4] = True
    grown = dilate_points(mask, 2.0)
    assert int(grown.sum()) == 13
    assert torch.equal(grown, grown.mT)
    for bad in (mask[0], mask[None], mask.float(), mask.byte(), mask.numpy()):
        with pytest.raises(InvalidInputError, match=r"points: expected bool \(N, H, W\)"):
            dilate_points(bad, 2.0)
    depth = torch.rand(1, 1, 9, 9) + 1.0
    for bad in (torch.ones(9, 1, dtype=torch.bool)[:5], mask.float()):
        with pytest.raises(InvalidInputError, match="mask: expected bool"):
            cr.depth_curvilinear_saliency(depth, bad)
    with pytest.raises(InvalidInputError, match="photo: expected bool"):
        metrics.intersection_percentage(mask.float(), mask)


def test_renderers_agree_on_what_they_take(mesh: trimesh.Trimesh, pose: Tensor) -> None:
    counts = [int((make_renderer(mesh, name).render(pose[None], CAMERA, SIZE) > 0).sum()) for name in BACKENDS]
    assert abs(counts[0] - counts[1]) <= 2
    assert counts[0] > 500

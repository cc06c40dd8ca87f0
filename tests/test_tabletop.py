"""The scene of the demo: what is drawn agrees with the pose and the box that come with it."""

import numpy as np
import pytest
import torch

from curvireg_torch import Registrar, camera_matrix, rotation_error
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.geometry import rotation_from_axis_angle, transform
from curvireg_torch.pipeline import Pipeline
from curvireg_torch.rendering import render_depth
from curvireg_torch.synthetic import example_mesh, photograph_tabletop, random_pose, tabletop

SIZE = (180, 240)
CAMERA = camera_matrix(260.0, 260.0, 119.5, 89.5, dtype=torch.float64)
MAGENTA = (255, 0, 255, 255)


def photograph(seed, mesh):
    generator = torch.Generator().manual_seed(seed)
    T = random_pose(mesh, CAMERA, SIZE, generator, elevations=(15.0, 45.0), fill=(0.75, 0.95))
    return *photograph_tabletop(mesh, T, CAMERA, SIZE, generator), T


@pytest.fixture(scope="module")
def magenta():
    """image, box, T of a truck in a colour that nothing else has."""
    mesh = example_mesh()
    mesh.visual.face_colors = np.tile(np.array(MAGENTA, np.uint8), (len(mesh.faces), 1))
    return photograph(3, mesh)


def silhouette(T):
    return render_depth(example_mesh(), T, CAMERA, SIZE)[0, 0] > 0


def is_magenta(image):
    return (image[0] > 1.5 * image[1]) & (image[2] > 1.5 * image[1])


def test_tabletop_shows_the_mesh_at_its_pose(magenta):
    image, box, T = magenta
    assert image.shape == (3, *SIZE)
    assert (image.dtype, float(image.min()) >= 0, float(image.max()) <= 1) == (torch.float32, True, True)
    drawn, expected = is_magenta(image), silhouette(T)
    assert int((drawn & expected).sum()) / int((drawn | expected).sum()) > 0.95
    rows, columns = expected.nonzero().unbind(dim=1)
    inside = torch.stack([columns.min(), rows.min(), columns.max(), rows.max()])
    assert float((box - inside).abs().max()) < 1


def test_tabletop_has_shadows_and_light(magenta):
    image, _, T = magenta
    grey = image.mean(dim=0)
    body = silhouette(T)
    around = torch.nn.functional.max_pool2d(body[None].float(), 21, 1, 10)[0].bool() & ~body & ~is_magenta(image)
    below = around & (torch.arange(SIZE[0])[:, None] > body.nonzero()[:, 0].float().mean())
    assert float(grey[below].quantile(0.05)) < 0.75 * float(grey[below].quantile(0.9)), "a shadow beside the wheels"
    sides = grey[body]
    assert float(sides.quantile(0.1)) < 0.7 * float(sides.quantile(0.9)), "lit and unlit sides"


def test_tabletop_is_reproducible():
    first, again, other = (photograph(seed, example_mesh(painted=True))[0] for seed in (0, 0, 1))
    assert torch.equal(first, again)
    assert float((first - other).abs().mean()) > 0.02


def test_tabletop_refuses_a_camera_below_the_table():
    away = torch.tensor([0.0, 0.0, 0.8], dtype=torch.float64)
    below = transform(torch.eye(3, dtype=torch.float64), away)
    above = transform(torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)), away)  # looks straight down
    generator = torch.Generator().manual_seed(0)
    with pytest.raises(InvalidInputError, match="above the table"):
        photograph_tabletop(example_mesh(), below, CAMERA, SIZE, generator)
    assert photograph_tabletop(example_mesh(), above, CAMERA, SIZE, generator)[0].isfinite().all()


def test_example_mesh_has_the_same_shape_when_painted():
    plain, painted = example_mesh(), example_mesh(painted=True)
    assert np.array_equal(plain.vertices, painted.vertices)
    assert np.array_equal(plain.faces, painted.faces)
    colours, counts = np.unique(painted.visual.face_colors[:, :3], axis=0, return_counts=True)
    assert len(colours) == 4
    red = painted.visual.face_colors[:, 0] > 150
    assert painted.triangles_center[red][:, 1].max() < painted.triangles_center[~red][:, 1].max(), "the front is red"
    assert counts.sum() == len(plain.faces)


def test_defocus_blurs_only_what_is_far():
    picture, cover, depth = np.zeros((360, 480, 3)), np.zeros((360, 480)), np.ones((360, 480))
    picture[:, 240:] = 1.0  # an edge at every depth
    depth[:150] = 3.0
    cover[200:], picture[200:] = 1.0, 6.0  # the object
    out = tabletop._defocus(picture, depth, cover, distance=1.0, radius=0.1)
    assert np.array_equal(out[200:], picture[200:])
    np.testing.assert_allclose(out[165:200], picture[165:200], atol=1e-9)
    assert 0.3 < out[50, 239, 0] < 0.5 < out[50, 240, 0] < 0.7
    depth[150:200] = 3.0
    assert tabletop._defocus(picture, depth, cover, distance=1.0, radius=0.1)[:200].max() < 1.001, "nothing bleeds"


@pytest.mark.slow
def test_demo_scenes_are_registered():
    K = camera_matrix(1040.0, 1040.0, 479.5, 359.5, dtype=torch.float64)
    registrar = Registrar(example_mesh(), pipeline=Pipeline().with_pose_prior("upright"), progress=False)
    for seed in range(10):
        generator = torch.Generator().manual_seed(seed)
        T = random_pose(example_mesh(), K, (720, 960), generator, elevations=(12.0, 45.0), fill=(0.75, 0.95))
        image, box = photograph_tabletop(example_mesh(painted=True), T, K, (720, 960), generator)
        result = registrar([image], box[None], K)[0]
        assert float(rotation_error(result.rotation, T[:3, :3])) < 2, seed
        assert result.reliable, seed


def test_several_poses_show_one_scene(magenta):
    _, _, first = magenta
    mesh = example_mesh()
    mesh.visual.face_colors = np.tile(np.array(MAGENTA, np.uint8), (len(mesh.faces), 1))
    turned = first.clone()
    turned[:3, :3] = first[:3, :3] @ rotation_from_axis_angle(torch.tensor([0.0, 0.0, 0.2], dtype=torch.float64))
    poses = torch.stack([first, turned, first])
    images, boxes = photograph_tabletop(mesh, poses, CAMERA, SIZE, torch.Generator().manual_seed(5))
    alone, box = photograph_tabletop(mesh, first, CAMERA, SIZE, torch.Generator().manual_seed(5))
    assert images.shape == (3, 3, *SIZE)
    assert torch.equal(images[0], alone)
    assert torch.equal(boxes[0], box)
    for image, pose in zip(images, poses, strict=True):
        drawn, expected = is_magenta(image), silhouette(pose)
        assert int((drawn & expected).sum()) / int((drawn | expected).sum()) > 0.95
    again = (images[2] - images[0]).abs()
    assert 0.0 < float(again.mean()) < 0.02, "the same but for the noise"
    assert float((images[1] - images[0]).abs().mean()) > 0.04

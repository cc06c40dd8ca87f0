"""The pictures show the pose that was found, with the camera it was found with."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.ndimage import binary_erosion, distance_transform_edt

from curvireg_torch import Pipeline, Registrar, ViewBank, camera_matrix, rotation_error, sample_views
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.rendering import make_renderer, render_depth
from curvireg_torch.settings import BankSettings
from curvireg_torch.synthetic import example_mesh, random_pose, synthesize_photograph
from curvireg_torch.visualization import contour_overlay, registration_sheet
from tests._support.scenes import CAMERA, SIZE, scene, truck_bank, unrefined

GREEN = (0, 255, 80)
HEIGHT = 2 * 192


def silhouette(T, K=CAMERA, mesh=None):
    return (render_depth(mesh or example_mesh(), T, K, SIZE)[0, 0] > 0).numpy()


def drawn(picture):
    return (picture == GREEN).all(axis=2)


def near(contour, mask, pixels):
    """Fraction of the contour's pixels within so many px of the contour of a mask."""
    assert contour.sum() > 50
    edge = mask & ~binary_erosion(mask)
    return float((distance_transform_edt(~edge)[contour] <= pixels).mean())


def wrong(box, share):
    """The box moved to the right and up by a fraction of its longer side."""
    side = (box[2:] - box[:2]).max()
    return box + share * side * torch.tensor([1.0, -1.0, 1.0, -1.0])


@pytest.fixture(scope="module")
def found():
    """A photograph registered with its camera, though from a wrong box."""
    image, box, T = scene(2)
    registrar = Registrar(truck_bank())
    return registrar, registrar([image], wrong(box, 0.08)[None], CAMERA)[0], image, wrong(box, 0.08), T


@pytest.fixture(scope="module")
def blind():
    """The same without the camera matrix."""
    image, box, T = scene(2)
    registrar = Registrar(truck_bank())
    return registrar, registrar([image], wrong(box, 0.05)[None])[0], image, wrong(box, 0.05), T


def test_contours_lie_where_the_object_is_seen_though_the_box_is_wrong(found):
    registrar, result, image, box, T = found
    contour = drawn(contour_overlay(registrar, result, image, box))
    assert near(contour, silhouette(T), 2) > 0.95
    assert near(contour, silhouette(T)[::-1], 2) < 0.5
    assert near(contour, silhouette(T)[:, ::-1], 2) < 0.5


def test_the_true_pose_is_drawn_on_the_true_contour(found):
    registrar, result, image, box, T = found
    best = replace(result.hypotheses[0], projection=(T, CAMERA))
    assert near(drawn(contour_overlay(registrar, best, image, box)), silhouette(T), 1) == 1.0


def check_assumed_camera(registrar, result, image, box, truth):
    assert result.translation is None
    contour = drawn(contour_overlay(registrar, result, image, box))
    assert near(contour, truth, 2) > 0.95
    assert near(contour, truth[::-1], 2) < 0.5
    # A view of the same rotation that fills the box lies beside it.
    angle, distance = result.allocentric_rotation[None], torch.tensor([result.distance])
    refitted = registrar.describers[0].cameras_of_boxes(angle, distance, box[None])
    old = replace(result.hypotheses[0], projection=(refitted[0][0], refitted[1][0]))
    assert near(drawn(contour_overlay(registrar, old, image, box)), truth, 2) < 0.5


def test_without_a_camera_matrix_the_assumed_one_is_drawn(blind):
    """What the contour stage pulled onto the edges is not pushed back into the box."""
    registrar, result, image, box, T = blind
    check_assumed_camera(registrar, result, image, box, silhouette(T))


def test_orthographic_pipelines_are_drawn_by_a_camera_from_far_away():
    long = camera_matrix(5200.0, 5200.0, 119.5, 89.5, dtype=torch.float64)
    generator = torch.Generator().manual_seed(2)
    T = random_pose(example_mesh(), long, SIZE, generator, elevations=(5.0, 50.0))
    image, box = synthesize_photograph(example_mesh(), T, long, SIZE, generator)
    settings = BankSettings(image_size=96, camera="orthographic")
    views = sample_views(azimuth_step=15, elevations=[0, 15, 30, 45, 60])
    pipeline = Pipeline(field="focus", bank=settings, hypotheses=1)
    registrar = Registrar(ViewBank.build(example_mesh(), views, pipeline=pipeline, progress=False))
    box = wrong(box, 0.05)
    check_assumed_camera(registrar, registrar([image], box[None])[0], image, box, silhouette(T, long))


def test_every_hypothesis_is_seen_where_its_pose_says(found, blind):
    for hypothesis in found[1].hypotheses:
        torch.testing.assert_close(hypothesis.projection[0], hypothesis.transform)
        assert hypothesis.projection[1].equal(CAMERA)
    registrar, result, _, box, _ = blind
    for hypothesis in result.hypotheses:
        T, K = hypothesis.projection
        centre = T[:3, :3] @ registrar.describers[0].centre + T[:3, 3]
        assert float(centre.norm()) == pytest.approx(hypothesis.distance, rel=1e-6)
        mask = silhouette(T, K)
        rows, columns = mask.any(axis=1).nonzero()[0], mask.any(axis=0).nonzero()[0]
        seen = torch.tensor([columns[0], rows[0], columns[-1], rows[-1]], dtype=torch.float64)
        assert float((seen - box).abs().max()) < 0.35 * float((box[2:] - box[:2]).max())


def test_a_hypothesis_that_was_sent_back_is_seen_by_the_camera_of_its_start(blind):
    _, result, image, box, _ = blind
    starts = Registrar(truck_bank(), pipeline=unrefined(truck_bank()))([image], box[None])[0].hypotheses
    begun = {start.view: start for start in starts}
    back = [h for h in result.hypotheses if torch.equal(h.rotation, begun[h.view].rotation)]
    assert back
    for hypothesis in back:
        torch.testing.assert_close(hypothesis.projection, begun[hypothesis.view].projection)


def test_the_registrars_own_renderer_draws():
    """``renderer=`` of the registrar, not whatever is found first."""
    image, box, _ = scene(0)

    class Counting:
        name = "counting"

        def __init__(self):
            self.inner, self.sizes = make_renderer(example_mesh()), []

        def render(self, T, K, size, *, orthographic=False):
            self.sizes.append(size)
            return self.inner.render(T, K, size, orthographic=orthographic)

    registrar = Registrar(truck_bank(), pipeline=unrefined(truck_bank()), renderer=Counting())
    result = registrar([image], box[None])[0]
    contour_overlay(registrar, result, image, box)
    assert registrar.describers[0].renderer.sizes[-1] == SIZE
    with pytest.raises(InvalidInputError, match="yours is of one mesh, the bank has 2"):
        Registrar(ViewBank.join([truck_bank(), truck_bank()]), renderer=Counting())


def test_several_meshes_each_with_its_own():
    """The mesh of the hypothesis is drawn, in the overlay and in its picture below."""
    views = sample_views(azimuth_step=30, elevations=[0, 30])
    pole = trimesh.creation.box((0.02, 0.02, 0.3))
    pipeline = truck_bank().pipeline
    banks = [ViewBank.build(mesh, views, pipeline=pipeline, progress=False) for mesh in (pole, example_mesh())]
    registrar = Registrar(ViewBank.join(banks), pipeline=unrefined(ViewBank.join(banks)))
    image, box, T = scene(0)
    result = registrar([image], box[None], CAMERA)[0]
    truck = next(h for h in result.hypotheses if h.model == 1)
    seen = replace(truck, projection=(T, CAMERA))
    assert near(drawn(contour_overlay(registrar, seen, image, box)), silhouette(T), 1) == 1.0
    seen = replace(seen, model=0)
    assert near(drawn(contour_overlay(registrar, seen, image, box)), silhouette(T, mesh=pole), 1) == 1.0


def tile(sheet, number):
    """The picture of a hypothesis below the overlay, its caption left out."""
    return sheet[HEIGHT + 20 :, 192 * (number - 1) : 192 * number]


def test_the_sheet_shows_each_hypothesis_at_its_own_pose_and_distance(found):
    registrar, result, image, box, _ = found
    sheet = registration_sheet(registrar, result, image, box)
    assert sheet.shape[0] == HEIGHT + 192
    nearer = replace(result.hypotheses[1], distance=result.hypotheses[1].distance / 3)
    changed = replace(result, hypotheses=(result.hypotheses[0], nearer, *result.hypotheses[2:]))
    other = registration_sheet(registrar, changed, image, box)
    count = len(result.hypotheses)
    alike = [np.array_equal(tile(sheet, n), tile(other, n)) for n in range(1, count + 1)]
    assert alike == [n != 2 for n in range(1, count + 1)]
    # Not the view of the bank that it came from, but what was found.
    turned = replace(result.hypotheses[1], allocentric_rotation=result.hypotheses[0].allocentric_rotation)
    assert float(rotation_error(turned.allocentric_rotation, nearer.allocentric_rotation)) > 15
    other = registration_sheet(registrar, replace(result, hypotheses=(turned, turned)), image, box)
    assert np.array_equal(tile(other, 1), tile(other, 2))


def test_a_small_object_is_drawn_large(found):
    """In a photograph four times as wide and high, what lies around the box fills the same place."""
    registrar, result, image, box, _ = found
    sheet = registration_sheet(registrar, result, image, box)
    H, W = SIZE
    room = torch.zeros(3, 4 * H, 4 * W)
    room[:, H : 2 * H, W : 2 * W] = image
    shift = torch.tensor([W, H], dtype=torch.float64)
    T, K = result.projection
    K = K.clone()
    K[:2, 2] += shift
    moved = replace(result, hypotheses=(replace(result.hypotheses[0], projection=(T, K)), *result.hypotheses[1:]))
    other = registration_sheet(registrar, moved, room, box + shift.repeat(2))
    wide = sheet.shape[1] - 2 * 192
    assert other.shape == sheet.shape
    assert drawn(sheet[:HEIGHT, :wide]).any()
    assert np.array_equal(other[:HEIGHT, :wide], sheet[:HEIGHT, :wide])


def test_photographs_as_the_registrar_takes_them(found):
    registrar, result, image, box, _ = found
    pixels = (image * 255).round().byte()
    expected = contour_overlay(registrar, result, pixels, box)
    assert drawn(expected).any()
    for same in (pixels / 255.0, pixels.permute(1, 2, 0).numpy()):
        assert np.array_equal(contour_overlay(registrar, result, same, box.tolist()), expected)
    grey = contour_overlay(registrar, result, image[:1], box)
    assert grey.shape == (*SIZE, 3)
    one = registration_sheet(registrar, result, pixels, box)
    assert np.abs(one.astype(int) - registration_sheet(registrar, result, pixels / 255.0, box)).max() <= 1
    with pytest.raises(InvalidInputError, match="channels"):
        contour_overlay(registrar, result, torch.zeros(4, 9, 9), box)
    with pytest.raises(InvalidInputError, match="X0 < X1"):
        contour_overlay(registrar, result, image, -box)


def test_another_camera_draws_a_smaller_copy(found, blind):
    registrar, result, image, box, T = found
    half = torch.tensor([[0.5, 0.0, -0.25], [0.0, 0.5, -0.25], [0.0, 0.0, 1.0]], dtype=torch.float64)
    small = torch.nn.functional.avg_pool2d(image[None], 2)[0]
    picture = contour_overlay(registrar, result, small, (box - 0.5) / 2, half @ CAMERA)
    mask = (render_depth(example_mesh(), T, half @ CAMERA, (SIZE[0] // 2, SIZE[1] // 2))[0, 0] > 0).numpy()
    assert near(drawn(picture), mask, 2) > 0.95
    with pytest.raises(InvalidInputError, match="found without one"):
        contour_overlay(registrar, *blind[1:4], CAMERA)

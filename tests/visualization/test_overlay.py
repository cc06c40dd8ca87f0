"""Pictures show the pose with the camera of the registration."""

from dataclasses import replace

import pytest
import torch
from scipy.ndimage import binary_erosion, distance_transform_edt

from curvireg_torch import Pipeline, Registrar, ViewBank, camera_matrix, sample_views
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.pipeline import BankSettings
from curvireg_torch.rendering import make_renderer, render_depth
from curvireg_torch.synthetic import example_mesh, random_pose, synthesize_photograph
from curvireg_torch.visualization import contour_overlay
from tests._support.scenes import CAMERA, SIZE, scene, truck_bank, unrefined

GREEN = (0, 255, 80)


def silhouette(T, K=CAMERA, mesh=None, size=SIZE):
    return (render_depth(mesh or example_mesh(), T, K, size)[0, 0] > 0).numpy()


def is_contour(picture):
    return (picture == GREEN).all(axis=2)


def fraction_near(contour, mask, pixels):
    """Fraction of the contour's pixels within so many px of the contour of a mask."""
    assert contour.sum() > 50
    edge = mask & ~binary_erosion(mask)
    return float((distance_transform_edt(~edge)[contour] <= pixels).mean())


def shifted(box, fraction):
    """The box moved to the right and up by a fraction of its longer side."""
    return box + fraction * (box[2:] - box[:2]).max() * torch.tensor([1.0, -1.0, 1.0, -1.0])


def registered(fraction, camera):
    image, box, T = scene(2)
    registrar, box = Registrar(truck_bank()), shifted(box, fraction)
    return registrar, registrar([image], box[None], camera)[0], image, box, T


@pytest.fixture(scope="module")
def with_camera():
    """registrar, result, image, wrong box, true pose."""
    return registered(0.08, CAMERA)


@pytest.fixture(scope="module")
def without_camera():
    return registered(0.05, None)


def check_contour(contour, truth):
    assert fraction_near(contour, truth, 2) > 0.95
    assert fraction_near(contour, truth[::-1], 2) < 0.5


def test_contour_overlay_draws_the_object_although_the_box_is_wrong(with_camera):
    registrar, result, image, box, T = with_camera
    contour = is_contour(contour_overlay(registrar, result, image, box))
    check_contour(contour, silhouette(T))
    assert fraction_near(contour, silhouette(T)[:, ::-1], 2) < 0.5
    truth = replace(result.hypotheses[0], projection=(T, CAMERA))
    assert fraction_near(is_contour(contour_overlay(registrar, truth, image, box)), silhouette(T), 1) == 1.0


def check_assumed_camera(registrar, result, image, box, truth):
    """Without a camera the overlay uses the assumed one, not a view that fills the box."""
    assert result.translation is None
    check_contour(is_contour(contour_overlay(registrar, result, image, box)), truth)
    rotation, distance = result.allocentric_rotation[None], torch.tensor([result.distance])
    T, K = registrar.describer.cameras_of_boxes(rotation, distance, box[None])
    filling = replace(result.hypotheses[0], projection=(T[0], K[0]))
    assert fraction_near(is_contour(contour_overlay(registrar, filling, image, box)), truth, 2) < 0.5


def test_contour_overlay_without_a_camera(without_camera):
    *registered, T = without_camera
    check_assumed_camera(*registered, silhouette(T))


def test_contour_overlay_of_an_orthographic_pipeline():
    telephoto = camera_matrix(5200.0, 5200.0, 119.5, 89.5, dtype=torch.float64)
    generator = torch.Generator().manual_seed(2)
    T = random_pose(example_mesh(), telephoto, SIZE, generator, elevations=(5.0, 50.0))
    image, box = synthesize_photograph(example_mesh(), T, telephoto, SIZE, generator)
    settings = BankSettings(image_size=96, camera="orthographic")
    views = sample_views(azimuth_step=15, elevations=[0, 15, 30, 45, 60])
    pipeline = Pipeline(field="focus", bank=settings, hypotheses=1)
    registrar = Registrar(ViewBank.build(example_mesh(), views, pipeline=pipeline, progress=False))
    box = shifted(box, 0.05)
    result = registrar([image], box[None])[0]
    check_assumed_camera(registrar, result, image, box, silhouette(T, telephoto))


def test_hypotheses_are_projected_at_their_poses(with_camera, without_camera):
    for hypothesis in with_camera[1].hypotheses:
        torch.testing.assert_close(hypothesis.projection[0], hypothesis.transform)
        assert hypothesis.projection[1].equal(CAMERA)
    registrar, result, _, box, _ = without_camera
    for hypothesis in result.hypotheses:
        T, K = hypothesis.projection
        centre = T[:3, :3] @ registrar.describer.centre + T[:3, 3]
        assert float(centre.norm()) == pytest.approx(hypothesis.distance, rel=1e-6)
        mask = silhouette(T, K)
        rows, columns = mask.any(axis=1).nonzero()[0], mask.any(axis=0).nonzero()[0]
        bounds = torch.tensor([columns[0], rows[0], columns[-1], rows[-1]], dtype=torch.float64)
        assert float((bounds - box).abs().max()) < 0.35 * float((box[2:] - box[:2]).max())


def test_restored_hypotheses_have_the_projection_of_their_start(without_camera, bank):
    _, result, image, box, _ = without_camera
    starts = Registrar(bank, pipeline=unrefined(bank))([image], box[None])[0].hypotheses
    start_of_view = {start.view: start for start in starts}
    restored = [h for h in result.hypotheses if torch.equal(h.rotation, start_of_view[h.view].rotation)]
    assert restored
    for hypothesis in restored:
        torch.testing.assert_close(hypothesis.projection, start_of_view[hypothesis.view].projection)


def test_contour_overlay_uses_the_renderer_of_the_registrar(bank):
    (image, box, _), renderer, sizes = scene(0), make_renderer(example_mesh()), []
    render = renderer.render
    renderer.render = lambda T, K, size, **options: sizes.append(size) or render(T, K, size, **options)
    registrar = Registrar(bank, pipeline=unrefined(bank), renderer=renderer)
    contour_overlay(registrar, registrar([image], box[None])[0], image, box)
    assert sizes[-1] == SIZE
    with pytest.raises(InvalidInputError, match="knows one mesh"):
        Registrar([bank, bank], renderer=renderer)

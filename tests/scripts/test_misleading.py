"""Photographs that mislead, by their known changes."""

from argparse import Namespace
from math import radians
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

from curvireg_torch.geometry import rotation_from_axis_angle
from curvireg_torch.registration.result import Axis
from scripts.benchmark.make import PART_AREA, TWIN, Variants
from scripts.calibration.misleading import (
    BARREL,
    CROPPED,
    LARGER,
    STRETCH,
    answer_of,
    axis_is_right,
    cases_of,
    table_of,
)
from tests._support import double

H, W = 240, 320
K = double([[300.0, 0.0, 159.5], [0.0, 300.0, 119.5], [0.0, 0.0, 1.0]])
SPOT = (250, 60)  # x, y of the brightest pixel, in the box
BOX = torch.tensor([220.0, 40.0, 280.0, 90.0])


@pytest.fixture
def sample():
    y, x = torch.meshgrid(torch.arange(H), torch.arange(W), indexing="ij")
    spot = torch.exp(-((x - SPOT[0]) ** 2 + (y - SPOT[1]) ** 2) / 18.0)
    return {"image": spot.expand(3, H, W).clone(), "box": BOX, "camera_matrix": K}


def brightest(image):
    index = int(image[0].argmax())
    return index % image.shape[-1], index // image.shape[-1]


def case(sample, kind, name):
    return next(found for found in cases_of(kind, sample) if found[0] == name)


@pytest.mark.parametrize(("name", "fx", "cx"), [
    ("size 0.50", 150.0, 79.75),
    ("size 0.67", 200.0, 159.5 * 2 / 3),
    ("size 1.60", 480.0, 255.2),
    ("focal length 0.7", 210.0, 159.5),
    ("focal length 1.3", 390.0, 159.5),
])  # fmt: skip
def test_a_wrong_camera_leaves_the_photograph_alone(sample, name, fx, cx):
    _, image, box, wrong = case(sample, "camera", name)
    assert torch.equal(image, sample["image"])
    assert torch.equal(box, BOX.double())
    assert wrong[0, 0] == pytest.approx(fx)
    assert wrong[1, 1] == pytest.approx(fx)
    assert wrong[0, 2] == pytest.approx(cx)
    assert wrong[2].tolist() == [0.0, 0.0, 1.0]


def test_a_stretched_photograph_moves_its_box_and_keeps_one_focal_length(sample):
    _, image, box, wrong = case(sample, "camera", "stretched")
    assert image.shape == (3, H, round(STRETCH * W))
    x, y = brightest(image)
    assert (x, y) == (pytest.approx(STRETCH * SPOT[0], abs=1.0), SPOT[1])
    assert box.tolist() == [275.0, 40.0, 350.0, 90.0]
    assert wrong[0, 0] == wrong[1, 1] == 300.0
    assert wrong[0, 2] == pytest.approx(STRETCH * 159.5)


def test_a_barrel_moves_points_towards_the_middle(sample):
    _, image, box, camera = case(sample, "camera", "distorted")
    x, y = brightest(image)
    ray = torch.tensor([(SPOT[0] - 159.5) / 300.0, (SPOT[1] - 119.5) / 300.0])
    r2 = float(ray.square().sum())
    factor = 1.0 + BARREL[0] * r2 + BARREL[1] * r2**2
    assert factor < 0.97
    assert x == pytest.approx(159.5 + 300.0 * factor * float(ray[0]), abs=1.0)
    assert y == pytest.approx(119.5 + 300.0 * factor * float(ray[1]), abs=1.0)
    assert torch.equal(camera, K)
    assert box[0] < x < box[2]
    assert float(box[2]) < 280.0


def test_a_cropped_photograph_holds_the_box_far_from_its_middle(sample):
    (_, image, box, camera), *_ = cases_of("cropped", sample)
    assert camera is None
    assert image.shape == (3, round(CROPPED * H), round(CROPPED * W))
    shift = BOX.double() - box
    x, y = brightest(image)
    assert (x + float(shift[0]), y + float(shift[1])) == SPOT
    assert (box[2:] - box[:2]).tolist() == [60.0, 50.0]
    # towards the corner in which the object is: the lost parts are left and below
    assert shift[:2].tolist() == [W - image.shape[2], 0.0]


def test_other_kinds_change_the_mesh_alone(sample):
    for kind in ("ordinary", "sizes", "chosen", "variant", "stranger", "twins", "round"):
        ((name, image, box, camera),) = cases_of(kind, sample)
        assert name == kind
        assert image is sample["image"]
        assert torch.equal(box, BOX.double())
        assert torch.equal(camera, K)


def test_wrong_ones_are_counted_among_the_reliable():
    right = {"reliable": True, "wrong": False, "verdict": "reliable", "confidence": 0.95}
    unsure = {"reliable": False, "wrong": True, "verdict": "unsure", "confidence": 0.95}
    axis = unsure | {"verdict": "reliable axis", "confidence": 0.5}
    rows = [right, right | {"wrong": True}, unsure]
    rows += [axis | {"axis_is_right": is_right} for is_right in (False, True)]
    assert table_of(rows) == {
        "photographs": 5,
        "confident": 3,
        "reliable": 2,
        "reliable and wrong": 1,
        "axis reliable": 2,
        "axis reliable and wrong": 1,
    }


@pytest.mark.slow
def test_an_answer_is_wrong_by_its_angle_its_distance_or_its_mesh(small_bank):
    import curvireg_torch as cr
    from curvireg_torch.synthetic import demo_scene

    scene = demo_scene(0)
    registrar = cr.Registrar(small_bank)
    result = registrar([scene.image], [scene.box], scene.camera_matrix)[0]
    centre = torch.as_tensor(registrar.bank.mesh.bounds.mean(axis=0)).double()
    row = {
        "rotation": result.rotation.double(),
        "translation": result.translation.double(),
        "model_info": {
            **{f"min_{c}": float(v) for c, v in zip("xyz", centre, strict=True)},
            **{f"size_{c}": 0.0 for c in "xyz"},
        },
    }
    found = answer_of(result, registrar, row, scene.camera_matrix, 0)
    assert (found["degrees"], found["wrong"]) == (pytest.approx(0.0, abs=0.1), False)
    assert found["distance"] == pytest.approx(0.0, abs=0.02)
    assert answer_of(result, registrar, row, scene.camera_matrix, 1)["wrong"]
    farther = row | {"translation": LARGER * row["translation"]}
    assert answer_of(result, registrar, farther, scene.camera_matrix, 0)["wrong"]
    assert not answer_of(result, registrar, farther, None, 0)["wrong"]
    turned = cr.geometry.rotation_from_axis_angle(double([0.0, 0.7, 0.0]))
    other = row | {"rotation": turned @ row["rotation"]}
    assert answer_of(result, registrar, other, None, 0)["wrong"]


def test_axes_are_right_within_their_tolerance():
    result = SimpleNamespace(axis=Axis(double([0.0, 0.0, 1.0]), 0.9))

    def judged(degrees, *, ends_are_alike=False):
        turn = rotation_from_axis_angle(double([radians(degrees), 0.0, 0.0]))
        registrar = SimpleNamespace(round_axis=SimpleNamespace(ends_are_alike=ends_are_alike))
        return axis_is_right(result, registrar, turn)

    assert judged(14.0)
    assert not judged(16.0)
    assert not judged(170.0)
    assert judged(170.0, ends_are_alike=True)
    assert not axis_is_right(SimpleNamespace(axis=None), SimpleNamespace(round_axis=None), None)


def test_a_variant_differs_in_one_part():
    shapes = Variants(Namespace(seed=112, models=12, cad="variant"))
    low, high = PART_AREA
    assert len(shapes.ids) >= 6
    left_out = 0
    for obj_id in shapes.ids:
        shown = shapes.mesh(obj_id)
        variant = shapes.mesh(obj_id + TWIN)
        area = trimesh.triangles.area(shown.triangles)
        if len(variant.triangles) < len(shown.triangles):
            left_out += 1
            kept = {tuple(triangle.ravel()) for triangle in variant.triangles}
            differs = np.array([tuple(t.ravel()) not in kept for t in shown.triangles])
        else:
            differs = (variant.triangles != shown.triangles).any(axis=(1, 2))
        assert low <= area[differs].sum() / area.sum() <= high
    assert left_out < len(shapes.ids)

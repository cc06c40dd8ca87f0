"""Every detector: the layer contract, options, colour, missing pixels, and detections on simple images."""

import inspect
import math

import numpy as np
import pytest
import torch
from kornia.color import rgb_to_grayscale
from scipy.ndimage import binary_dilation

from curvireg_torch import detectors
from curvireg_torch.detectors import DETECTORS
from curvireg_torch.detectors.base import Detection, detection_from_peaks, to_uint8_images
from curvireg_torch.errors import InvalidInputError

from .._support.layer_contract import LayerCase, LayerContract
from ..filters.layer_cases import colour_photos, photos

every_detector = pytest.mark.parametrize("name", list(DETECTORS))


class TestDetectors(LayerContract):
    cases = tuple(
        # kornia's corner responses pad by reflection, which needs 4 px
        LayerCase(name, detect, photos, min_size=4 if name in ("harris", "mineig") else 1)
        for name, detect in DETECTORS.items()
    )
    differentiable = False
    test_gradcheck = test_function_transforms = None
    test_compile_fullgraph = test_export_with_any_batch = test_onnx_export = None
    test_no_float64_operations = None  # fast_hessian computes in float64 on the CPU
    test_dtype_is_kept = None  # the response is float32 or float64


def box(contrast: float = 0.6) -> torch.Tensor:
    """A bright box from (20, 24) to (43, 71) on grey."""
    image = torch.full((1, 1, 72, 96), 0.2)
    image[..., 20:44, 24:72] += contrast
    return image


def fraction_near(points: np.ndarray, others: np.ndarray, radius: int) -> float:
    """Fraction of the points with one of the others within ``radius`` px (square)."""
    return float(binary_dilation(others, np.ones((2 * radius + 1,) * 2))[points].mean())


@every_detector
def test_detectors_return_ranked_points_with_positive_response(name: str) -> None:
    image = torch.cat([photos(1, 48), box()[..., :48, :48]])
    detection = DETECTORS[name](image, fraction=0.02)
    assert detection.response.shape == detection.points.shape == image.shape
    assert detection.response.dtype == torch.float32
    assert detection.points.dtype == torch.bool
    assert bool((detection.response >= 0).all())
    assert bool((detection.response[detection.points] > 0).all())
    for i, xy in enumerate(detection.coordinates()):
        assert len(xy) <= 2 * int(0.02 * 48 * 48)  # all ties at the limit are selected
        assert len(xy) > 0 or name == "sift"
        strengths = detection.response[i, 0, xy[:, 1], xy[:, 0]]
        assert bool((strengths.diff() <= 0).all())


@every_detector
@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_detectors_find_no_points_in_a_constant_image(name: str, value: float) -> None:
    assert not DETECTORS[name](torch.full((1, 1, 32, 40), value)).points.any()


@every_detector
def test_detectors_convert_colour_and_detect_nothing_on_missing_pixels(name: str) -> None:
    colour = colour_photos(1, 48)
    want, got = DETECTORS[name](rgb_to_grayscale(colour)), DETECTORS[name](colour)
    torch.testing.assert_close(got.response, want.response, rtol=1e-3, atol=1e-5)
    broken = box()
    broken[0, 0, 20, 30:33] = torch.nan  # on its outline
    clean, detection = DETECTORS[name](box()), DETECTORS[name](broken)
    assert torch.isfinite(detection.response).all()
    assert not detection.points[0, 0, 20, 30:33].any()
    assert not detection.response[0, 0, 20, 30:33].any()
    assert int((detection.points & clean.points).sum()) >= 0.5 * int(clean.points.sum())


@every_detector
@pytest.mark.parametrize("fraction", [-1.0, 0.0, 1.5, math.nan])
def test_detectors_reject_a_fraction_outside_0_to_1(name: str, fraction: float) -> None:
    assert inspect.signature(DETECTORS[name]).parameters["fraction"].default == 0.04
    with pytest.raises(InvalidInputError, match="fraction: expected 0 < fraction <= 1"):
        DETECTORS[name](torch.rand(1, 1, 32, 32), fraction=fraction)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("laplacian_of_gaussian", {"sigma": 0.0}, "expected a finite number > 0"),
        ("canny", {"sigma": -1.0}, "expected a finite number > 0"),
        ("fuzzy_edges", {"width": 0.0}, "expected a finite number > 0"),
        ("fast_hessian", {"threshold": 0.0}, "threshold: expected a finite number > 0"),
        *(("canny", {"edges": x}, "edges: expected 0 < edges <= 1") for x in (-0.5, 0.0, 1.5, math.nan)),
    ],
)
def test_detectors_reject_wrong_options(name: str, options: dict[str, float], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        getattr(detectors, name)(photos(1, 16), **options)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("harris", {"k": 0.04}),
        ("laplacian_of_gaussian", {"sigma": 2.0}),
        ("canny", {"sigma": 1.4, "edges": 0.3}),
        ("fast_hessian", {"threshold": 1e-4}),
        ("fuzzy_edges", {"width": 0.1}),
    ],
)
def test_detectors_have_the_default_options_of_the_comparison(name: str, options: dict[str, float]) -> None:
    # Noise has more peaks than any default fraction selects.
    image = torch.cat([photos(1, 48, seed=9), torch.rand(1, 1, 48, 48, generator=torch.Generator().manual_seed(0))])
    detect = getattr(detectors, name)
    default, explicit = detect(image), detect(image, **options)
    torch.testing.assert_close(default, explicit, rtol=0.0, atol=0.0)
    for option in options:
        same = detect(image, fraction=1.0)
        other = detect(image, **{**options, option: 2.0 * options[option]}, fraction=1.0)
        assert not (torch.equal(same.response, other.response) and torch.equal(same.points, other.points)), option


@pytest.mark.parametrize("name", ["mfc", "mcs", "ig", "sobel", "log", "canny", "fuzzy"])
def test_edge_detectors_find_the_outline_of_a_box(name: str) -> None:
    outline = np.zeros((72, 96), dtype=bool)
    outline[20:44, 24:72] = True
    outline[21:43, 25:71] = False
    points = DETECTORS[name](box(), fraction=0.05).points[0, 0].numpy()
    assert fraction_near(points, outline, 2) > 0.95
    assert fraction_near(outline, points, 2) > 0.9


@pytest.mark.parametrize("name", ["harris", "mineig"])
def test_corner_detectors_rank_the_corners_of_a_box_first(name: str) -> None:
    strongest = DETECTORS[name](box()).coordinates()[0][:4].tolist()
    corners = {(24, 20), (71, 20), (24, 43), (71, 43)}
    assert {min(corners, key=lambda c: math.dist(c, p)) for p in strongest} == corners
    assert all(min(math.dist(c, p) for c in corners) <= 3 for p in strongest)


def test_detection_from_peaks_selects_the_strongest_positive_peaks() -> None:
    response = torch.zeros(1, 1, 20, 20)
    response[0, 0, 2::6, 2::6] = torch.tensor([[3.0, 2.0, 1.0], [9.0, 8.0, 7.0], [6.0, 5.0, 4.0]])
    response[0, 0, 17, 17] = -5.0
    peaks = detection_from_peaks(response, 1.0).coordinates()[0]
    assert [response[0, 0, y, x].item() for x, y in peaks] == list(range(9, 0, -1))
    few = detection_from_peaks(response, 0.01)  # of 400
    assert [response[0, 0, y, x].item() for x, y in few.coordinates()[0]] == [9.0, 8.0, 7.0, 6.0]
    assert float(few.response.min()) == 0.0


def test_detection_coordinates_are_x_then_y() -> None:
    response = torch.zeros(2, 1, 4, 6)
    response[0, 0, 1, 5], response[0, 0, 3, 0], response[1, 0, 2, 2] = 1.0, 2.0, 1.0
    first, second = Detection(response, response > 0).coordinates()
    assert first.tolist() == [[0, 3], [5, 1]]
    assert second.tolist() == [[2, 2]]


def test_to_uint8_images_rounds_and_clamps() -> None:
    image = torch.tensor([-1.0, 0.0, 0.5 / 255 + 1e-4, 0.5, 1.0, 2.0]).view(1, 1, 2, 3)
    assert to_uint8_images(image)[0].tolist() == [[0, 0, 1], [128, 255, 255]]

"""Detectors against their definitions, implemented independently: numbers, defaults and orders, not only places."""

import cv2
import numpy as np
import pytest
import torch
from kornia.feature import gftt_response, harris_response

from curvireg_torch import detectors
from curvireg_torch.detectors.base import Detection, detection_from_peaks, to_uint8_images
from curvireg_torch.detectors.fast_hessian import _determinant
from curvireg_torch.errors import InvalidInputError

from ..filters.layer_cases import photos


def test_the_defaults_of_the_comparison() -> None:
    # Noise has more peaks than any default's share.
    image = torch.cat([photos(1, 48, seed=9), torch.rand(1, 1, 48, 48, generator=torch.Generator().manual_seed(0))])
    for name, options in (
        ("harris", {"k": 0.04, "fraction": 0.04}),
        ("laplacian_of_gaussian", {"sigma": 2.0, "fraction": 0.04}),
        ("canny", {"sigma": 1.4, "edges": 0.3, "fraction": 0.04}),
        ("fast_hessian", {"threshold": 1e-4, "fraction": 0.04}),
        ("fuzzy_edges", {"width": 0.1, "fraction": 0.04}),
        *((n, {"fraction": 0.04}) for n in ("minimum_eigenvalue", "sobel", "sift", "focus_curves", "gradient")),
        *((n, {"fraction": 0.04}) for n in ("multiscale_saliency", "principal_curvature")),
    ):
        detect = getattr(detectors, name)
        default, told = detect(image), detect(image, **options)
        assert torch.equal(default.response, told.response), name
        assert torch.equal(default.points, told.points), name
        for option in set(options) - {"fraction"}:
            all_points = {**options, "fraction": 1.0}
            same, other = detect(image, **all_points), detect(image, **{**all_points, option: 2.0 * options[option]})
            assert not (torch.equal(same.response, other.response) and torch.equal(same.points, other.points)), option


def test_corners_are_kornias_peaks() -> None:
    image = photos(1, 40, seed=4)
    for ours, theirs in (
        (detectors.harris(image, k=0.06, fraction=1.0), harris_response(image, k=0.06)),
        (detectors.minimum_eigenvalue(image, fraction=1.0), gftt_response(image)),
    ):
        torch.testing.assert_close(ours.response, theirs.clamp(min=0.0))
        r = ours.response[0, 0]
        padded = torch.nn.functional.pad(r, (1, 1, 1, 1), value=-1.0)
        around = torch.stack([padded[dy : dy + 40, dx : dx + 40] for dy in range(3) for dx in range(3)]).amax(0)
        assert torch.equal(ours.points[0, 0], (r == around) & (r > 0))


def test_peaks_below_zero_are_none_and_a_share_keeps_the_strongest() -> None:
    response = torch.zeros(1, 1, 20, 20)
    response[0, 0, 2::6, 2::6] = torch.tensor([[3.0, 2.0, 1.0], [9.0, 8.0, 7.0], [6.0, 5.0, 4.0]])
    response[0, 0, 17, 17] = -5.0
    assert [response[0, 0, y, x].item() for x, y in detection_from_peaks(response, 1.0).coordinates()[0]] == list(
        range(9, 0, -1)
    )
    few = detection_from_peaks(response, 0.01)  # of 400
    assert [response[0, 0, y, x].item() for x, y in few.coordinates()[0]] == [9.0, 8.0, 7.0, 6.0]
    assert float(few.response.min()) == 0.0


def test_coordinates_are_x_then_y() -> None:
    response = torch.zeros(2, 1, 4, 6)
    response[0, 0, 1, 5], response[0, 0, 3, 0], response[1, 0, 2, 2] = 1.0, 2.0, 1.0
    first, second = Detection(response, response > 0).coordinates()
    assert first.tolist() == [[0, 3], [5, 1]]
    assert second.tolist() == [[2, 2]]


def test_bytes_are_rounded_and_clamped() -> None:
    image = torch.tensor([-1.0, 0.0, 0.5 / 255 + 1e-4, 0.5, 1.0, 2.0]).view(1, 1, 2, 3)
    assert to_uint8_images(image)[0].tolist() == [[0, 0, 1], [128, 255, 255]]


@pytest.mark.parametrize("sigma", [2.0, 3.0])
def test_zero_crossings_of_a_step_have_the_height_of_the_closed_form(sigma: float) -> None:
    # A step of height A at x = 0, smoothed: L(x) = -A x exp(-x^2 / 2 s^2) / (sqrt(2 pi) s^3), sampled at x = +-1/2.
    image = torch.zeros(1, 1, 41, 60)
    image[..., 30:] = 0.8
    for picture in (image, image.mT):
        answer = detectors.laplacian_of_gaussian(picture, sigma=sigma, fraction=1.0)
        # The response belongs to the left or upper pixel of the two.
        line = answer.response[0, 0, 20] if picture is image else answer.response[0, 0, :, 20]
        expected = 0.8 * np.exp(-0.125 / sigma**2) / (np.sqrt(2 * np.pi) * sigma**3)
        assert int(line.argmax()) == 29
        assert float(line[29]) == pytest.approx(expected, rel=0.06)


def test_canny_is_opencvs_with_these_thresholds() -> None:
    image = photos(1, 64, seed=5)
    answer = detectors.canny(image, sigma=1.8, edges=0.2, fraction=1.0)
    grey = (image[0, 0] * 255).round().numpy().astype(np.float32)
    blurred = cv2.GaussianBlur(grey, (0, 0), 1.8, borderType=cv2.BORDER_REPLICATE)
    dx, dy = (cv2.Sobel(blurred, cv2.CV_32F, *o, ksize=3, borderType=cv2.BORDER_REPLICATE) for o in ((1, 0), (0, 1)))
    length = np.hypot(dx, dy)
    np.testing.assert_allclose(answer.response[0, 0], length / 8 / 255, atol=1e-6)
    high = np.quantile(length, 0.8)
    edges = cv2.Canny(
        *((d * 32).round().astype(np.int16) for d in (dx, dy)), 0.4 * high * 32, high * 32, L2gradient=True
    )
    assert np.array_equal(answer.points[0, 0].numpy(), edges > 0)
    # Hysteresis: every edge is over the lower threshold, some lie below the upper one.
    assert length[edges > 0].min() >= 0.39 * high
    assert length[edges > 0].min() < 0.9 * high


def test_sift_keeps_the_strongest_and_its_contrast() -> None:
    image = photos(1, 96, seed=7)
    grey = (image[0, 0] * 255).round().byte().numpy()
    answer = detectors.sift(image, fraction=0.002)
    keypoints = cv2.SIFT.create(nfeatures=int(0.002 * 96 * 96)).detect(grey, None)
    contrast: dict[tuple[int, int], float] = {}
    for k in keypoints:
        place = (round(k.pt[0]), round(k.pt[1]))
        contrast[place] = max(contrast.get(place, 0.0), k.response)
    assert {
        (x, y): pytest.approx(float(answer.response[0, 0, y, x])) for x, y in answer.coordinates()[0].tolist()
    } == contrast
    assert torch.equal(answer.points, answer.response > 0)


def _box_filters(side: int) -> np.ndarray:
    """(3, side, side): xx, yy, xy of Bay et al., fig. 2."""
    lobe, r = side // 3, side // 2
    filters = np.zeros((3, side, side))
    for k, weight in enumerate((1, -2, 1)):
        filters[0, lobe // 2 + 1 : side - lobe // 2 - 1, k * lobe : (k + 1) * lobe] = weight
    filters[1] = filters[0].T
    before, after = slice(r - lobe, r), slice(r + 1, r + 1 + lobe)
    for rows, columns, weight in ((before, before, 1), (after, after, 1), (before, after, -1), (after, before, -1)):
        filters[2, rows, columns] = weight
    return filters


@pytest.mark.parametrize("side", [9, 15, 21, 27])
def test_determinants_of_the_box_hessian_at_every_pixel(side: int) -> None:
    x = photos(1, 32, seed=8, dtype=torch.float64)[0, 0].numpy()
    xx, yy, xy = (cv2.filter2D(x, cv2.CV_64F, f, borderType=cv2.BORDER_REPLICATE) / side**2 for f in _box_filters(side))
    ours = _determinant(torch.from_numpy(x)[None, None], side)[0, 0]
    np.testing.assert_allclose(ours, xx * yy - 0.81 * xy**2, atol=1e-12)


def test_fast_hessian_is_the_maxima_over_place_and_side_of_bays_octaves() -> None:
    octaves = ((9, 15, 21, 27), (15, 27, 39, 51), (27, 51, 75, 99))
    image = photos(1, 104, seed=8, dtype=torch.float64)
    det = {s: _determinant(image, s)[0, 0] for s in {s for o in octaves for s in o}}
    expected = torch.zeros(104, 104, dtype=torch.bool)
    for octave in octaves:
        stack = torch.stack([det[s] for s in octave])
        padded = torch.nn.functional.pad(stack, (1, 1, 1, 1), value=-torch.inf)
        for level in range(1, 3):
            cube = padded[level - 1 : level + 2]
            around = torch.stack([cube[:, dy : dy + 104, dx : dx + 104] for dy in range(3) for dx in range(3)])
            expected |= (stack[level] == around.flatten(0, 1).amax(0)) & (stack[level] > 5e-5)
    answer = detectors.fast_hessian(image, threshold=5e-5, fraction=1.0)
    assert int(expected.sum()) > 3
    assert torch.equal(answer.points[0, 0], expected)
    torch.testing.assert_close(answer.response[0, 0].double(), torch.stack([*det.values()]).amax(0).clamp(min=0))
    tiny = detectors.fast_hessian(image[..., :5, :7])  # smaller than the smallest filter
    assert tiny.response.shape == (1, 1, 5, 7)
    assert not tiny.points.any()


def test_bad_options_are_refused() -> None:
    image = photos(1, 16)
    for call in (
        lambda: detectors.laplacian_of_gaussian(image, sigma=0.0),
        lambda: detectors.canny(image, sigma=-1.0),
        lambda: detectors.fuzzy_edges(image, width=0.0),
    ):
        with pytest.raises(InvalidInputError, match="expected a finite number > 0"):
            call()


@pytest.mark.parametrize("name", detectors.DETECTORS)
@pytest.mark.parametrize("fraction", [-1.0, 0.0, 1.5, float("nan")])
def test_shares_that_are_none_are_refused(name: str, fraction: float) -> None:
    with pytest.raises(InvalidInputError, match="fraction: expected 0 < fraction <= 1"):
        detectors.DETECTORS[name](torch.rand(1, 1, 32, 32), fraction=fraction)


@pytest.mark.parametrize("edges", [-0.5, 0.0, 1.5, float("nan")])
def test_canny_refuses_a_share_of_edges_that_is_none(edges: float) -> None:
    with pytest.raises(InvalidInputError, match="edges: expected 0 < edges <= 1"):
        detectors.canny(torch.rand(1, 1, 32, 32), edges=edges)


def test_canny_of_more_than_16_million_pixels() -> None:
    image = torch.zeros(1, 1, 4001, 4000)
    image[..., 2000:] = 1.0
    points = detectors.canny(image, edges=0.002, fraction=1e-3).points[0, 0]
    assert points[:, 1990:2010].sum() >= 4001
    assert not points[:, :1990].any()
    assert not points[:, 2010:].any()

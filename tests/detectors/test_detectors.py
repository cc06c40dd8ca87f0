"""Every detector answers in one form, and as the library that it wraps, or its definition, says."""

import inspect
import math

import cv2
import numpy as np
import pytest
import torch
from kornia.color import rgb_to_grayscale
from scipy.ndimage import binary_dilation
from skimage.feature import canny as skimage_canny
from skimage.feature import corner_harris, corner_shi_tomasi

from curvireg_torch import detectors
from curvireg_torch.detectors import DETECTORS
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.filters import gaussian_smooth

from ..filters.layer_cases import photos

every_detector = pytest.mark.parametrize("name", list(DETECTORS))


def _box(contrast: float = 0.6) -> torch.Tensor:
    """A bright box from (20, 24) to (43, 71) on grey."""
    image = torch.full((1, 1, 72, 96), 0.2)
    image[..., 20:44, 24:72] += contrast
    return image


@every_detector
def test_uniform_answer(name: str) -> None:
    image = torch.cat([photos(1, 48), _box()[..., :48, :48]])
    before = image.clone()
    answer = DETECTORS[name](image, fraction=0.02)
    assert answer.response.shape == answer.points.shape == image.shape
    assert answer.response.dtype == torch.float32
    assert answer.points.dtype == torch.bool
    assert torch.isfinite(answer.response).all()
    assert bool((answer.response >= 0).all())
    assert bool((answer.response[answer.points] > 0).all())
    assert torch.equal(image, before)
    for i, xy in enumerate(answer.coordinates()):
        assert len(xy) <= 2 * int(0.02 * 48 * 48)  # ties at the limit all stay
        assert len(xy) > 0 or name == "sift"
        strengths = answer.response[i, 0, xy[:, 1], xy[:, 0]]
        assert bool((strengths.diff() <= 0).all())


@every_detector
def test_images_do_not_mix(name: str) -> None:
    image = torch.cat([photos(1, 40), 0.2 * photos(1, 40, seed=3)]).double()
    both = DETECTORS[name](image)
    for i in range(2):
        alone = DETECTORS[name](image[i : i + 1])
        torch.testing.assert_close(both.response[i : i + 1], alone.response, rtol=1e-6, atol=1e-9)
        assert torch.equal(both.points[i : i + 1], alone.points)


@every_detector
@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_a_flat_image_has_no_points(name: str, value: float) -> None:
    answer = DETECTORS[name](torch.full((1, 1, 32, 40), value))
    assert not answer.points.any()
    assert torch.isfinite(answer.response).all()
    assert DETECTORS[name](torch.zeros(0, 1, 32, 40)).points.shape == (0, 1, 32, 40)


@every_detector
def test_bad_input_is_refused(name: str) -> None:
    with pytest.raises(InvalidInputError, match="image: expected shape"):
        DETECTORS[name](torch.zeros(3, 32, 32))
    with pytest.raises(InvalidInputError, match="got 2"):
        DETECTORS[name](torch.zeros(1, 2, 32, 32))


@every_detector
def test_colour_becomes_grey_and_missing_pixels_detect_nothing(name: str) -> None:
    colour = torch.stack([photos(1, 48, seed=i)[:, 0] for i in range(3)], dim=1)
    want, got = DETECTORS[name](rgb_to_grayscale(colour)), DETECTORS[name](colour)
    torch.testing.assert_close(got.response, want.response, rtol=1e-3, atol=1e-5)
    box = _box()
    broken = box.clone()
    broken[0, 0, 20, 30:33] = torch.nan  # on its outline
    clean, answer = DETECTORS[name](box), DETECTORS[name](broken)
    assert torch.isfinite(answer.response).all()
    assert not answer.points[0, 0, 20, 30:33].any()
    assert not answer.response[0, 0, 20, 30:33].any()
    assert int((answer.points & clean.points).sum()) >= 0.5 * int(clean.points.sum())


def _near(points: np.ndarray, others: np.ndarray, radius: int) -> float:
    """Fraction of the points with another within ``radius`` px (square)."""
    grown = binary_dilation(others, np.ones((2 * radius + 1,) * 2))
    return float(grown[points].mean())


@pytest.mark.parametrize("name", ["mfc", "mcs", "ig", "sobel", "log", "canny", "fuzzy"])
def test_edge_detectors_find_the_outline_of_a_box_and_little_else(name: str) -> None:
    outline = np.zeros((72, 96), dtype=bool)
    outline[20:44, 24:72] = True
    outline[21:43, 25:71] = False
    points = DETECTORS[name](_box(), fraction=0.05).points[0, 0].numpy()
    assert _near(points, outline, 2) > 0.95
    assert _near(outline, points, 2) > 0.9


def test_all_detectors_keep_the_same_share_of_the_pixels() -> None:
    assert {inspect.signature(detector).parameters["fraction"].default for detector in DETECTORS.values()} == {0.04}


@pytest.mark.parametrize("name", ["harris", "mineig"])
def test_corner_detectors_find_the_corners_of_a_box_first(name: str) -> None:
    strongest = DETECTORS[name](_box()).coordinates()[0][:4].tolist()
    corners = {(24, 20), (71, 20), (24, 43), (71, 43)}
    assert {min(corners, key=lambda c: math.dist(c, p)) for p in strongest} == corners
    assert all(min(math.dist(c, p) for c in corners) <= 3 for p in strongest)


def _on_bytes(image: torch.Tensor) -> np.ndarray:
    return (image[0, 0] * 255).round().byte().numpy()


def test_canny_against_scikit_image() -> None:
    """The same method in another library, its thresholds as quantiles: nearly all edges meet within 1 px."""
    image = gaussian_smooth(photos(1, 64, seed=5), 2.0)
    ours = detectors.canny(image, fraction=1.0).points[0, 0].numpy()
    theirs = skimage_canny(image[0, 0].numpy(), sigma=1.4, low_threshold=0.5, high_threshold=0.7, use_quantiles=True)
    assert _near(ours, theirs, 1) > 0.85
    assert _near(theirs, ours, 1) > 0.8


def test_corner_responses_against_scikit_image() -> None:
    image = photos(1, 64, seed=6)
    grey = image[0, 0].numpy()
    for ours, theirs in (
        (detectors.harris(image), corner_harris(grey, k=0.04, sigma=1.0)),
        (detectors.minimum_eigenvalue(image), corner_shi_tomasi(grey, sigma=1.0)),
    ):
        # Both weigh by a Gaussian of 1 px, cut at 3 px here and at 4 px there; the units differ.
        a, b = ours.response[0, 0, 6:-6, 6:-6].flatten().numpy(), np.maximum(theirs[6:-6, 6:-6], 0).ravel()
        assert np.corrcoef(a, b)[0, 1] > 0.99


def test_sobel_against_opencv() -> None:
    image = photos(1, 32)
    dx, dy = (
        cv2.Sobel(image[0, 0].numpy(), cv2.CV_32F, *o, ksize=3, borderType=cv2.BORDER_REPLICATE)
        for o in ((1, 0), (0, 1))
    )
    np.testing.assert_allclose(detectors.sobel(image).response[0, 0], np.hypot(dx, dy) / 8, atol=1e-6)


def test_sift_points_are_opencvs_keypoints() -> None:
    image = photos(1, 64, seed=7)
    keypoints = cv2.SIFT.create(nfeatures=int(0.04 * 64 * 64)).detect(_on_bytes(image), None)
    answer = detectors.sift(image)
    assert {(round(k.pt[0]), round(k.pt[1])) for k in keypoints} == set(map(tuple, answer.coordinates()[0].tolist()))


def test_zero_crossings_lie_on_a_disc_where_the_laplacian_changes_sign() -> None:
    axis = torch.arange(65.0) - 32
    r = (axis[:, None] ** 2 + axis**2).sqrt()
    disc = torch.sigmoid((20 - r) / 0.5)[None, None]
    answer = detectors.laplacian_of_gaussian(disc, fraction=0.04)
    # Rounding crosses zero too where the image is flat, a thousand times more weakly.
    strong = answer.points[0, 0] & (answer.response[0, 0] > 1e-3 * answer.response.max())
    assert int(strong.sum()) > 100
    assert float((r[strong] - 20).abs().max()) < 1.5


@pytest.mark.parametrize("contrast", [1.0, -0.5])
@pytest.mark.parametrize("transposed", [False, True])
def test_zero_crossings_find_a_step_whose_edge_is_a_pixel(contrast: float, transposed: bool) -> None:
    """0, ..., 0, 1/2, 1, ..., 1: the Laplacian is 0 on the edge itself, and of opposite sign beside it."""
    image = torch.zeros(1, 1, 24, 31)
    image[..., 15] = 0.5
    image[..., 16:] = 1.0
    image = contrast * image
    image = image.mT if transposed else image

    def response_of(sigma: float) -> torch.Tensor:
        found = detectors.laplacian_of_gaussian(image, sigma=sigma, fraction=1.0).response
        return (found.mT if transposed else found)[0, 0]

    # Smoothed by next to nothing the Laplacian is exact: contrast / 2, 0, -contrast / 2, one crossing.
    assert response_of(0.05).tolist() == [[0.5 * abs(contrast) * (i == 15) for i in range(31)]] * 24
    response = response_of(2.0)
    strong = response > 0.1 * response.max()
    assert float(response.max()) > 1e-3
    # Where rounding makes the 0 a little more or less, the crossing is on the one side or the other.
    assert strong.any(dim=0).nonzero().flatten().tolist() in ([14], [15], [14, 15])
    assert bool(strong.any(dim=1).all())


@pytest.mark.parametrize("sigma", [1.0, 2.0, 3.5])
def test_the_step_of_the_laplacian_is_that_of_a_gaussian_edge(sigma: float) -> None:
    """Beside a step of height 1 smoothed by s, L = -x exp(-x^2 / 2 s^2) / (sqrt(2 pi) s^3); the step is 2 L(1/2)."""
    image = (torch.arange(64) >= 32).double().expand(1, 1, 16, 64)
    response = detectors.laplacian_of_gaussian(image, sigma=sigma).response[0, 0, 8]
    want = math.exp(-0.125 / sigma**2) / (math.sqrt(2 * math.pi) * sigma**3)
    assert float(response.max()) == pytest.approx(want, rel=0.15 if sigma == 1.0 else 0.05)


def test_fuzzy_rules() -> None:
    """The degree of "edge" is 1 - min(mu(Ix), mu(Iy)) of the derivatives over the largest one."""
    image = torch.zeros(1, 1, 9, 40)
    image[..., 10:] += 1.0
    image[..., 30:] -= 0.05
    response = detectors.fuzzy_edges(image).response[0, 0, 4]
    assert float(response[9:11].max()) == pytest.approx(1.0, abs=1e-6)
    assert float(response[29:31].max()) == pytest.approx(1 - math.exp(-0.5 * (0.05 / 0.1) ** 2), rel=1e-3)


def _slow_determinant(x: np.ndarray, side: int, i: int, j: int) -> float:
    lobe, radius = side // 3, side // 2
    kernels = np.zeros((3, side, side))
    for k, weight in enumerate((1, -2, 1)):
        kernels[0, lobe // 2 + 1 : side - lobe // 2 - 1, k * lobe : (k + 1) * lobe] = weight
    kernels[1] = kernels[0].T
    for sy, sx, weight in ((-1, -1, 1), (1, 1, 1), (-1, 1, -1), (1, -1, -1)):
        rows = slice(radius + 1, radius + 1 + lobe) if sy > 0 else slice(radius - lobe, radius)
        columns = slice(radius + 1, radius + 1 + lobe) if sx > 0 else slice(radius - lobe, radius)
        kernels[2, rows, columns] = weight
    xx, yy, xy = (kernels * x[i - radius : i + radius + 1, j - radius : j + radius + 1]).sum((1, 2)) / side**2
    return xx * yy - (0.9 * xy) ** 2


def test_fast_hessian_against_the_filters_of_bay() -> None:
    """The largest determinant over all sides that fit, constants included, to the last digit of float32."""
    image = photos(1, 54, seed=8, dtype=torch.float64)
    response = detectors.fast_hessian(image).response[0, 0]
    pixels = ((26, 26), (27, 27), (26, 28), (28, 25))
    for i, j in pixels:
        want = max(_slow_determinant(image[0, 0].numpy(), side, i, j) for side in (9, 15, 21, 27, 39, 51))
        assert float(response[i, j]) == pytest.approx(max(want, 0.0), rel=1e-5)
    assert max(float(response[p]) for p in pixels) > 0.0


def test_fast_hessian_weighs_the_mixed_derivative() -> None:
    """On a saddle within a bowl D_xx, D_yy and D_xy all answer, and the weight 0.9 of the last one tells."""
    axis = torch.arange(41.0, dtype=torch.float64) - 20
    image = (0.5 + 0.001 * axis[:, None] * axis + 0.001 * (axis[:, None] ** 2 + axis**2))[None, None] / 4.0
    want = max(_slow_determinant(image[0, 0].numpy(), side, 20, 20) for side in (9, 15, 21, 27, 39))
    assert want > 0.0
    assert float(detectors.fast_hessian(image).response[0, 0, 20, 20]) == pytest.approx(want, rel=1e-4)


def test_fast_hessian_keeps_what_exceeds_its_threshold() -> None:
    axis = torch.arange(65.0) - 32
    blob = torch.exp(-0.5 * (axis[:, None] ** 2 + axis**2) / 3.0**2)[None, None]
    strongest = float(detectors.fast_hessian(blob).response.max())
    for contrast, found in ((0.95, False), (1.05, True)):  # the determinant goes with the square
        faint = contrast * math.sqrt(1e-4 / strongest) * blob
        assert bool(detectors.fast_hessian(faint).points.any()) is found
    assert not detectors.fast_hessian(blob, threshold=1.01 * strongest).points.any()
    assert detectors.fast_hessian(blob, threshold=0.99 * strongest).points.sum() == 1
    with pytest.raises(InvalidInputError, match="threshold"):
        detectors.fast_hessian(blob, threshold=0.0)


@pytest.mark.parametrize("side", [21, 27, 51, 75])
def test_fast_hessian_answers_at_the_side_that_a_blob_has(side: int) -> None:
    """A side of 9 stands for a Gaussian of 1.2 px; blobs of the sides within the three octaves are found at once."""
    axis = torch.arange(161.0) - 80
    blob = torch.exp(-0.5 * (axis[:, None] ** 2 + axis**2) / (1.2 * side / 9) ** 2)[None, None]
    assert detectors.fast_hessian(blob, threshold=1e-3).coordinates()[0][0].tolist() == [80, 80]


@pytest.mark.parametrize("sigma", [2.5, 4.0])
def test_fast_hessian_finds_a_blob(sigma: float) -> None:
    axis = torch.arange(65.0) - 32
    blob = torch.exp(-0.5 * (axis[:, None] ** 2 + axis**2) / sigma**2)[None, None]
    answer = detectors.fast_hessian(blob)
    assert answer.coordinates()[0][0].tolist() == [32, 32]

"""Filters against scikit-image, OpenCV, scipy, and loops in numpy float64."""

import math

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from scipy.ndimage import gaussian_filter
from skimage.feature import hessian_matrix_eigvals
from torch.testing import assert_close

from curvireg_torch import filters
from curvireg_torch.filters.curvilinear import dominant_eigenvector, scaled_direction
from curvireg_torch.filters.operations import central_derivatives, smooth
from tests._support import double, eye, seeded

from .layer_cases import depths, photos


def _smooth(x, sigma):
    return gaussian_filter(x, sigma, mode="nearest", radius=math.ceil(4 * sigma))


def _gradient(x, sigma):
    """Central differences, pixel by pixel, of the smoothed image with replicated borders."""
    H, W = x.shape
    p = _smooth(np.pad(x, 1, mode="edge"), sigma)
    gx = np.zeros_like(x)
    gy = np.zeros_like(x)
    for i in range(H):
        for j in range(W):
            gx[i, j] = (p[i + 1, j + 2] - p[i + 1, j]) / 2
            gy[i, j] = (p[i + 2, j + 1] - p[i, j + 1]) / 2
    return gx, gy


def _perona_malik(x, iterations, kappa, step, conductance):
    H, W = x.shape
    for _ in range(iterations):
        new = x.copy()
        for i in range(H):
            for j in range(W):
                for di, dj in ((0, 1), (0, -1), (1, 0), (-1, 0)):
                    if 0 <= i + di < H and 0 <= j + dj < W:
                        d = x[i + di, j + dj] - x[i, j]
                        g = (
                            1 / (1 + (d / kappa) ** 2)
                            if conductance == "rational"
                            else math.exp(-((d / kappa) ** 2))
                        )
                        new[i, j] += step * g * d
        x = new
    return x


@pytest.mark.parametrize("conductance", ["rational", "exponential"])
def test_anisotropic_diffusion_against_loops(conductance):
    image = photos(1, 15, dtype=torch.float64)
    got = filters.anisotropic_diffusion(
        image, iterations=6, kappa=0.07, step=0.25, conductance=conductance
    )
    want = _perona_malik(image[0, 0].numpy(), 6, 0.07, 0.25, conductance)
    assert_allclose(got[0, 0], want, rtol=1e-12)


def test_multiscale_curvilinear_saliency_against_loops():
    image = photos(1, 17, dtype=torch.float64)
    got = filters.multiscale_curvilinear_saliency(image, scales=3, sigma=0.8, kappa=0.05)[0]
    fields = []
    for n in (0, 5, 10):
        gx, gy = _gradient(_perona_malik(image[0, 0].numpy(), n, 0.05, 0.2, "rational"), 0.8)
        length = np.hypot(gx, gy)
        fields.append(np.stack([length * gx, length * gy]) / (length**2).max())
    lengths = np.stack([np.hypot(*f) for f in fields])
    retained = (lengths > math.exp(-3)).all(0)
    best = lengths.argmax(0)
    want = np.where(retained, np.take_along_axis(np.stack(fields), best[None, None], 0)[0], 0.0)
    assert 0.05 < retained.mean() < 0.95
    # At the strongest pixel all levels are 1, and rounding decides which direction is selected.
    ties = np.isclose(np.sort(lengths, axis=0)[-1], np.sort(lengths, axis=0)[-2], rtol=1e-9)
    assert_allclose(np.where(ties, 0, got), np.where(ties, 0, want), atol=1e-10)
    assert ties.mean() < 0.1


@pytest.mark.parametrize("mode", ["reblur-image", "reblur-saliency"])
@pytest.mark.parametrize("saliency_weight", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("threshold", [0.0, math.exp(-5), 0.1])
def test_multiscale_focus_curves_against_loops(mode, saliency_weight, threshold):
    image = photos(1, 21, dtype=torch.float64)
    image[..., :6] = 0.5 + 0.02 * image[..., :6]  # edges that are too weak
    options = {"scales": 4, "mode": mode, "saliency_weight": saliency_weight}
    options["threshold"] = threshold
    got = filters.multiscale_focus_curves(image, **options)[0]
    x = _smooth(image[0, 0].numpy(), 1.0)
    gx, gy = _gradient(image[0, 0].numpy(), 1.0)
    cs = gx**2 + gy**2
    cosine = gx / np.maximum(np.sqrt(cs), 1e-300)
    sine = gy / np.maximum(np.sqrt(cs), 1e-300)
    variance = (cosine**4 + sine**4) / 3
    fourth = variance**2 - 7 / 90 * (cosine**6 + sine**6)
    worst = np.zeros_like(cs)
    for s in (1.0, 2.0, 3.0):
        cs_s = sum(g**2 for g in _gradient(x, s)) if mode == "reblur-image" else _smooth(cs, s)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = cs / cs_s
            squared = s**2 / (ratio - 1) if mode == "reblur-image" else 2 * s**2 / (ratio**2 - 1)
        squared = np.where(ratio > 1, squared, np.inf)
        remainder = fourth / squared + fourth / (squared + s**2)
        worst = np.maximum(worst, np.sqrt(np.clip(squared - variance - remainder, 0, 1000.0**2)))
    focus = 1 / np.maximum(worst, 0.6)
    value = np.where((focus > math.exp(-4)) & (cs > threshold * cs.max()), focus, 0)
    value = value * cs**saliency_weight
    want = value * np.stack([gx, gy]) / np.maximum(np.sqrt(cs), 1e-300)
    assert 0.02 < (value > 0).mean() < 0.98
    assert_allclose(got, want, atol=1e-9)


def test_principal_curvature_image_against_scikit_image():
    image = photos(1, 33, dtype=torch.float64)
    for sign in (1.0, -1.0):
        got = filters.principal_curvature_image(sign * image, sigmas=(1.0, 2.0))[0]
        responses = []
        for sigma in (1.0, 2.0):
            xx, yy, xy = (h[0, 0].numpy() for h in central_derivatives(smooth(image, sigma))[2:])
            large, small = hessian_matrix_eigvals(np.stack([yy, xy, xx]))
            responses.append(sigma**2 * np.maximum(sign * (large if sign > 0 else small), 0))
        want = np.max(responses, axis=0)
        assert_allclose(np.hypot(*got.numpy()), want, atol=1e-12)


def test_gaussian_gradient_saliency_and_second_derivatives_against_scipy_and_loops():
    image = photos(1, 33, dtype=torch.float64)
    x = filters.gaussian_smooth(image, 1.7)[0, 0].numpy()
    # scipy rounds the radius 4 sigma to the nearest pixel; gaussian_smooth rounds it up.
    assert_allclose(
        x, gaussian_filter(image[0, 0].numpy(), 1.7, mode="nearest", radius=7), rtol=1e-12
    )
    xx, yy, xy = (h[0, 0].numpy() for h in central_derivatives(smooth(image, 1.7))[2:])
    gx, gy = _gradient(image[0, 0].numpy(), 1.7)
    assert_allclose(filters.image_gradient(image, sigma=1.7)[0], [gx, gy], atol=1e-14)
    saliency = filters.image_curvilinear_saliency(image, sigma=1.7)[0]
    assert_allclose(saliency, np.hypot(gx, gy) * [gx, gy], atol=1e-14)
    assert_allclose(xy[1:-1], np.gradient(gx, axis=0)[1:-1], atol=1e-14)
    assert_allclose(xx[:, 1:-1], np.diff(x, 2, axis=1), atol=1e-14)
    assert_allclose(yy[1:-1], np.diff(x, 2, axis=0), atol=1e-14)


def test_dominant_eigenvector_against_lapack():
    """(N, 2, 2) with real eigenvalues: adj(I_P) H_Z of random surfaces, and the boundaries between
    branches."""
    g = seeded(0)
    slope, h = (2 * torch.randn(500, n, generator=g, dtype=torch.float64) for n in (2, 3))
    across = torch.stack([slope[:, 1], -slope[:, 0]], dim=1)
    adjugate = eye(2) + across[:, :, None] * across[:, None]
    general = adjugate @ h[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    # equal diagonal (a ridge), or trace 0
    symmetric = [-1, 2, 2, -1], [1, 2, 2, 1], [-1, 2, 2, 1], [1, -2, -2, -1]
    triangular = [0, 3, 0, 1], [0, 0, 3, -1], [2, 3, 0, -1], [0, 0, 0, -5], [-5, 0, 0, 0]
    special = double([*symmetric, *triangular])
    m = torch.cat([general, special.view(-1, 2, 2)])
    planes = [m[:, i, j].view(-1, 1, 1, 1) for i in range(2) for j in range(2)]
    vx, vy, half_gap = dominant_eigenvector(*planes)
    v = torch.cat(scaled_direction(torch.ones_like(vx), vx, vy), dim=1)[:, :, 0, 0]
    values = torch.linalg.eigvals(m).real
    assert_close(2 * half_gap.flatten(), values.amax(dim=1) - values.amin(dim=1))
    assert_close(v.norm(dim=1), torch.ones(len(m), dtype=torch.float64))
    rayleigh = (m @ v[:, :, None])[:, :, 0]
    value = (rayleigh * v).sum(dim=1)
    assert_close(rayleigh, value[:, None] * v, atol=1e-12, rtol=1e-9)
    assert_close(value.abs(), values.abs().amax(dim=1))


@pytest.mark.parametrize("formula", ["geometric", "paper", "paper-length"])
def test_direction_of_depth_curvilinear_saliency_against_lapack(formula):
    """The paper's is the eigenvector of the largest eigenvalue, ours of the largest in absolute
    value; M is written out as adj(I_P) H_Z."""
    depth = depths(1, 33, dtype=torch.float64)
    field = filters.depth_curvilinear_saliency(depth, formula=formula)[0]
    near = depth[depth > 0].min()
    span = depth.max() - near
    z = torch.where(depth > 0, (depth - near) / span, 1.25)
    zx, zy, xx, yy, xy = (d[0, 0] for d in central_derivatives(smooth(z, 1.0, linear=True)))
    hessian = torch.stack([xx, xy, xy, yy], dim=-1).unflatten(-1, (2, 2))
    adjugate = torch.stack([1 + zy**2, -zx * zy, -zx * zy, 1 + zx**2], dim=-1)
    values, vectors = torch.linalg.eig(adjugate.unflatten(-1, (2, 2)) @ hessian)
    values = values.real
    key = values if formula == "paper" else values.abs()
    index = key.argmax(dim=-1)[..., None, None].expand(-1, -1, 2, 1)
    v = vectors.real.gather(-1, index)[..., 0]
    squared = zx**2 + zy**2
    factor = (1 + squared) ** -1.5 if formula == "geometric" else squared.sqrt()
    want = factor * (values.amax(dim=-1) - values.amin(dim=-1))
    assert_close(field.norm(dim=0), want, atol=1e-9, rtol=1e-7)
    clear = (key[..., 0] - key[..., 1]).abs() > 1e-6 * values.abs().amax(dim=-1)
    across = field[0] * v[..., 1] - field[1] * v[..., 0]
    assert across[clear].abs().max() < 1e-7 * float(want.max())
    negative = (values.sum(dim=-1) < 0) & (want > 0.01 * want.max())
    assert 0.1 < negative.double().mean() < 0.9  # where the two readings differ

"""Test inputs with known properties, and the cases of all filters and HOG for the layer
contract."""

import torch

from curvireg_torch import features, filters
from tests._support import uniform

from .._support.layer_contract import LayerCase


def grid(size, *, dtype=torch.float64):
    """Pixel coordinates x, y relative to the centre of a (size, size) image, size odd."""
    axis = torch.arange(size, dtype=dtype) - (size - 1) / 2
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    return x, y


def _front_of(squared, distance):
    return torch.where(squared > 0, distance - squared.clamp(min=0).sqrt(), 0.0)[None, None]


def sphere(size, radius, distance):
    """Depth in px of the near side of a sphere, 0 outside it."""
    x, y = grid(size)
    return _front_of(radius**2 - x**2 - y**2, distance)


def cylinder(size, radius, distance):
    """Depth in px of the near side of a cylinder along y, 0 outside it."""
    return _front_of(radius**2 - grid(size)[0] ** 2, distance)


def plane(size, slope_x, slope_y, distance):
    x, y = grid(size)
    return (distance + slope_x * x + slope_y * y)[None, None]


def depths(n=2, size=24, *, seed=0, dtype=torch.float32):
    """Rough surfaces inside a disc, background 0."""
    z = filters.gaussian_smooth(2.0 + uniform(n, 1, size, size, seed=seed), 2.0)
    x, y = grid(size) if size % 2 else (g[1:, 1:] for g in grid(size + 1))
    return torch.where(x**2 + y**2 < (0.4 * size) ** 2, z, 0.0).to(dtype)


def photos(n=2, size=24, *, seed=0, dtype=torch.float32):
    """Smooth noise with a bright box, in [0, 1]."""
    x = filters.gaussian_smooth(uniform(n, 1, size, size, seed=seed), 1.0)
    x[..., size // 4 : 3 * size // 4, size // 3 : 2 * size // 3] += 0.4
    return (x / x.amax(dim=(1, 2, 3), keepdim=True)).to(dtype)


def colour_photos(n=1, size=24, *, seed=0, dtype=torch.float32):
    """(n, 3, size, size) in [0, 1]."""
    return torch.cat([photos(n, size, seed=seed + i, dtype=dtype) for i in range(3)], dim=1)


def fields(n=2, size=24, *, seed=0, dtype=torch.float32):
    return filters.image_gradient(photos(n, size, seed=seed, dtype=torch.float64)).to(dtype)


CAMERA = torch.tensor([[40.0, 0.0, 11.5], [0.0, 42.0, 12.5], [0.0, 0.0, 1.0]])
# Function, inputs and module of every layer
PAIRS = {
    "cs": (filters.depth_curvilinear_saliency, depths, filters.DepthCurvilinearSaliency),
    "asg": (filters.average_shading_gradient, depths, filters.AverageShadingGradient),
    "hfn": (filters.hessian_frobenius_norm, depths, filters.HessianFrobeniusNorm),
    "ar": (filters.apparent_ridges, depths, filters.ApparentRidges),
    "ig": (filters.image_gradient, photos, filters.ImageGradient),
    "ics": (filters.image_curvilinear_saliency, photos, filters.ImageCurvilinearSaliency),
    "diffusion": (filters.anisotropic_diffusion, photos, filters.AnisotropicDiffusion),
    "mcs": (filters.multiscale_curvilinear_saliency, photos, filters.MultiScaleCurvilinearSaliency),
    "blur": (filters.edge_blur, photos, filters.EdgeBlur),
    "mfc": (filters.multiscale_focus_curves, photos, filters.MultiScaleFocusCurves),
    "pci": (filters.principal_curvature_image, photos, filters.PrincipalCurvatureImage),
    "hog": (features.hog, fields, features.HOG),
}
OPTIONS = {
    **{name: {} for name in PAIRS},
    "cs-paper": {"formula": "paper"},
    "cs-paper-length": {"formula": "paper-length"},
    "asg-perspective": {"camera_matrix": CAMERA},
    "diffusion": {"iterations": 4},
    "diffusion-exponential": {"iterations": 4, "conductance": "exponential"},
    "mcs": {"scales": 3},
    "blur-saliency": {"mode": "reblur-saliency"},
    "mfc-alone": {"saliency_weight": 0.0},
    "pci": {"sigmas": (1.0, 2.0)},
}


def _case(name, options):
    kind = name.partition("-")[0]
    return LayerCase(
        name,
        *PAIRS[kind],
        options,
        gradcheck_options={"grid": 4} if kind == "hog" else {},
        constant_gives_zero=kind not in ("diffusion", "blur", "hog"),
        min_size=8 if kind == "hog" else 1,
        accepts_colour=kind != "diffusion",
        is_variant=name in ("cs-paper-length", "diffusion-exponential", "mfc-alone"),
    )


LAYERS = {name: _case(name, options) for name, options in OPTIONS.items()}


def equal_up_to_sign(a, b, *, atol):
    """Whether the vectors of two fields (B, 2, H, W) agree, each up to its sign."""
    return bool((torch.minimum((a - b).abs().amax(1), (a + b).abs().amax(1)) <= atol).all())

"""Surfaces with known curvature, photographs made in code, and the list of layers that the contract tests run over."""

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from curvireg_torch import descriptors, filters


def grid(size: int, *, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """Pixel coordinates x, y from the centre of a (size, size) image, size odd."""
    axis = torch.arange(size, dtype=dtype) - (size - 1) / 2
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    return x, y


def sphere(size: int, radius: float, distance: float) -> Tensor:
    """Depth in px of a sphere's near side, 0 beside it."""
    x, y = grid(size)
    squared = radius**2 - x**2 - y**2
    return torch.where(squared > 0, distance - squared.clamp(min=0).sqrt(), 0.0)[None, None]


def cylinder(size: int, radius: float, distance: float) -> Tensor:
    """Depth in px of a cylinder along y, 0 beside it."""
    x, _ = grid(size)
    squared = radius**2 - x**2
    return torch.where(squared > 0, distance - squared.clamp(min=0).sqrt(), 0.0)[None, None]


def plane(size: int, slope_x: float, slope_y: float, distance: float) -> Tensor:
    x, y = grid(size)
    return (distance + slope_x * x + slope_y * y)[None, None]


def depths(n: int = 2, size: int = 24, *, seed: int = 0, dtype: torch.dtype = torch.float32) -> Tensor:
    """Rough surfaces behind a ragged silhouette, background 0."""
    generator = torch.Generator().manual_seed(seed)
    z = 2.0 + torch.rand(n, 1, size, size, generator=generator, dtype=torch.float64)
    z = filters.gaussian_smooth(z, 2.0)
    x, y = grid(size) if size % 2 else (g[1:, 1:] for g in grid(size + 1))
    return torch.where(x**2 + y**2 < (0.4 * size) ** 2, z, 0.0).to(dtype)


def photos(n: int = 2, size: int = 24, *, seed: int = 0, dtype: torch.dtype = torch.float32) -> Tensor:
    """Smooth noise with a bright box, in [0, 1]."""
    generator = torch.Generator().manual_seed(seed)
    x = filters.gaussian_smooth(torch.rand(n, 1, size, size, generator=generator, dtype=torch.float64), 1.0)
    x[..., size // 4 : 3 * size // 4, size // 3 : 2 * size // 3] += 0.4
    return (x / x.amax(dim=(1, 2, 3), keepdim=True)).to(dtype)


@dataclass(frozen=True)
class Layer:
    """A function, its module and the input that they take."""

    name: str
    function: Callable[..., Tensor]
    module: Callable[..., nn.Module]
    inputs: Callable[..., Tensor]
    options: dict[str, object] = field(default_factory=dict)

    def __call__(self, x: Tensor) -> Tensor:
        return self.function(x, **self.options)

    def twin(self) -> nn.Module:
        return self.module(**self.options)


CAMERA = torch.tensor([[40.0, 0.0, 11.5], [0.0, 42.0, 12.5], [0.0, 0.0, 1.0]])


def fields(n: int = 2, size: int = 24, *, seed: int = 0, dtype: torch.dtype = torch.float32) -> Tensor:
    return filters.image_gradient(photos(n, size, seed=seed, dtype=torch.float64)).to(dtype)


LAYERS = [
    Layer("cs", filters.depth_curvilinear_saliency, filters.DepthCurvilinearSaliency, depths),
    Layer(
        "cs-paper", filters.depth_curvilinear_saliency, filters.DepthCurvilinearSaliency, depths, {"formula": "paper"}
    ),
    Layer("asg", filters.average_shading_gradient, filters.AverageShadingGradient, depths),
    Layer(
        "asg-perspective",
        filters.average_shading_gradient,
        filters.AverageShadingGradient,
        depths,
        {"camera_matrix": CAMERA},
    ),
    Layer("hfn", filters.hessian_frobenius_norm, filters.HessianFrobeniusNorm, depths),
    Layer("ar", filters.apparent_ridges, filters.ApparentRidges, depths),
    Layer("ig", filters.image_gradient, filters.ImageGradient, photos),
    Layer("ics", filters.image_curvilinear_saliency, filters.ImageCurvilinearSaliency, photos),
    Layer("diffusion", filters.anisotropic_diffusion, filters.AnisotropicDiffusion, photos, {"iterations": 4}),
    Layer(
        "diffusion-exponential",
        filters.anisotropic_diffusion,
        filters.AnisotropicDiffusion,
        photos,
        {"iterations": 4, "conductance": "exponential"},
    ),
    Layer(
        "mcs",
        filters.multiscale_curvilinear_saliency,
        filters.MultiScaleCurvilinearSaliency,
        photos,
        {"scales": 3},
    ),
    Layer(
        "mcs-bilateral",
        filters.multiscale_curvilinear_saliency,
        filters.MultiScaleCurvilinearSaliency,
        photos,
        {"scales": 2, "smoothing": "bilateral"},
    ),
    Layer(
        "mcs-guided",
        filters.multiscale_curvilinear_saliency,
        filters.MultiScaleCurvilinearSaliency,
        photos,
        {"scales": 3, "smoothing": "guided"},
    ),
    Layer("blur", filters.edge_blur, filters.EdgeBlur, photos),
    Layer("blur-saliency", filters.edge_blur, filters.EdgeBlur, photos, {"mode": "reblur-saliency"}),
    Layer("mfc", filters.multiscale_focus_curves, filters.MultiScaleFocusCurves, photos),
    Layer(
        "mfc-alone", filters.multiscale_focus_curves, filters.MultiScaleFocusCurves, photos, {"saliency_weight": 0.0}
    ),
    Layer("pci", filters.principal_curvature_image, filters.PrincipalCurvatureImage, photos, {"sigmas": (1.0, 2.0)}),
    Layer("hog", descriptors.hog, descriptors.HOG, fields),
    Layer("hog-hard", descriptors.hog, descriptors.HOG, fields, {"voting": "hard"}),
]
NAMES = [layer.name for layer in LAYERS]


def equal_up_to_sign(a: Tensor, b: Tensor, *, atol: float) -> bool:
    """Fields (B, 2, H, W) whose vectors agree, each up to its sign."""
    return bool((torch.minimum((a - b).abs().amax(1), (a + b).abs().amax(1)) <= atol).all())

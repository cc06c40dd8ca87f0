"""The picture of docs/detectors.md: photograph, MCS, MFC, depth, depth CS; five rows.

    python scripts/make_detector_figure.py                                 # a scene made in code,
    docs/images/detectors.png
    python scripts/make_detector_figure.py --pairs a.png a_depth.png ... --out out/detectors.png

``--pairs`` takes photographs and 16-bit depth images (0 = background) in turn. Pictures of other people's photographs
stay where they were made: only the scene made in code is committed.
"""

import argparse
import math
from pathlib import Path

import cv2
import torch
from torch import Tensor

from curvireg_torch import filters

SIZE = 192


def scene(index: int, *, size: int = SIZE) -> tuple[Tensor, Tensor]:
    """Photograph and depth (1, 1, size, size) of a solid in front of a blurred, textured wall.

    The solid is drawn by its depth: 0 two spheres, 1 a cylinder, 2 a box seen along an edge, 3 a cone, 4 a torus. It
        is lit
    from the upper left and carries stripes; the photograph is in focus on the solid and out of focus on the wall.
    """
    axis = (torch.arange(size) - (size - 1) / 2) / (size / 2)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    far = torch.full_like(x, math.inf)

    def ball(cx: float, cy: float, r: float) -> Tensor:
        squared = r**2 - (x - cx) ** 2 - (y - cy) ** 2
        return torch.where(squared > 0, 3.0 - squared.clamp(min=0).sqrt(), far)

    if index == 0:
        z = torch.minimum(ball(-0.15, 0.1, 0.5), ball(0.35, -0.3, 0.3) - 0.2)
    elif index == 1:
        squared = 0.4**2 - x**2
        z = torch.where((squared > 0) & (y.abs() < 0.65), 3.0 - squared.clamp(min=0).sqrt(), far)
    elif index == 2:
        z = torch.where((x.abs() < 0.6) & ((y - 0.25 * x.abs()).abs() < 0.45), 2.6 + 0.8 * x.abs(), far)
    elif index == 3:
        radius = 0.35 * (y + 0.7)
        squared = radius**2 - x**2
        z = torch.where((squared > 0) & (y.abs() < 0.7), 3.0 - squared.clamp(min=0).sqrt(), far)
    else:
        ring = (x**2 + (1.3 * y) ** 2).sqrt() - 0.45
        squared = 0.2**2 - ring**2
        z = torch.where(squared > 0, 3.0 - squared.clamp(min=0).sqrt(), far)
    visible = torch.isfinite(z)
    depth = torch.where(visible, z, 0.0)
    closed = torch.where(visible, z, 3.0)
    slope_y, slope_x = torch.gradient(closed, spacing=2.0 / size)
    normal = torch.stack([-slope_x, -slope_y, torch.ones_like(x)])
    normal = torch.where(visible, normal / normal.norm(dim=0), torch.tensor([0.0, 0.0, 1.0]).view(3, 1, 1))
    light = torch.tensor([0.5, 0.55, 0.67]).view(3, 1, 1)
    shading = 0.15 + 0.75 * (normal * light).sum(dim=0).clamp(min=0.0)
    stripes = 1.0 - 0.06 * (torch.sin(60.0 * x + 25.0 * y) > 0)
    generator = torch.Generator().manual_seed(index)
    wall = torch.rand(1, 1, size, size, generator=generator)
    wall = filters.gaussian_smooth(wall, 3.0)
    wall = 0.45 + 2.0 * (wall - wall.mean())
    photo = torch.where(visible, shading * stripes, wall[0, 0])[None, None]
    photo = filters.gaussian_smooth(photo, 0.7) + 0.005 * torch.randn(1, 1, size, size, generator=generator)
    return photo.clamp(0.0, 1.0), depth[None, None]


def silhouette(depth: Tensor) -> Tensor:
    """Pixels of the solid with a pixel of the wall beside them."""
    outside = (depth == 0).float()
    return (depth > 0) & (torch.nn.functional.max_pool2d(outside, 3, stride=1, padding=1) > 0)


def _read_pair(photo: Path, depth: Path) -> tuple[Tensor, Tensor]:
    grey, z = cv2.imread(str(photo), cv2.IMREAD_GRAYSCALE), cv2.imread(str(depth), cv2.IMREAD_UNCHANGED)
    if grey is None or z is None or z.ndim != 2:
        raise SystemExit(f"cannot read {photo} as a photograph and {depth} as a depth image of one channel")
    scale = SIZE / max(grey.shape)
    grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    z = cv2.resize(z, grey.shape[::-1], interpolation=cv2.INTER_NEAREST)
    return torch.from_numpy(grey).float()[None, None] / 255.0, torch.from_numpy(z.astype("float32"))[None, None]


def _strength(field: Tensor) -> Tensor:
    """Length of a field, dark on white; its square root, so that weak edges are seen."""
    length = field.norm(dim=1)[0]
    return 1.0 - (length / length.flatten().quantile(0.995).clamp(min=1e-12)).clamp(max=1.0).sqrt()


def _nearness(depth: Tensor) -> Tensor:
    """Near is bright, the background black."""
    z = depth[0, 0]
    near, distant = z[z > 0].min(), z.max()
    return torch.where(z > 0, 1.0 - 0.8 * (z - near) / (distant - near).clamp(min=1e-12), 0.0)


def figure(pairs: list[tuple[Tensor, Tensor]]) -> Tensor:
    rows = []
    for photo, depth in pairs:
        tiles = [
            photo[0, 0],
            _strength(filters.multiscale_curvilinear_saliency(photo)),
            _strength(filters.multiscale_focus_curves(photo)),
            _nearness(depth),
            _strength(filters.depth_curvilinear_saliency(depth)),
        ]
        height, width = photo.shape[-2:]
        border = (2, SIZE + 2 - width, 2, SIZE + 2 - height)
        rows.append(torch.cat([torch.nn.functional.pad(t, border, value=1.0) for t in tiles], dim=1))
    return torch.cat(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", nargs="*", type=Path, default=[])
    default = Path(__file__).parent.parent / "docs" / "images" / "detectors.png"
    parser.add_argument("--out", type=Path, default=default)
    options = parser.parse_args()
    if len(options.pairs) % 2 or (options.pairs and options.out == default):
        raise SystemExit("--pairs takes photographs and depth images in turn, and an --out of its own")
    pairs = [_read_pair(p, d) for p, d in zip(options.pairs[::2], options.pairs[1::2], strict=True)]
    picture = figure(pairs or [scene(i) for i in range(5)])
    options.out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(options.out), (picture * 255).round().byte().numpy())
    print(f"wrote {options.out}, {picture.shape[1]} x {picture.shape[0]} px")


if __name__ == "__main__":
    main()

"""Two pictures of the documentation.

    python scripts/paper/figures.py detectors                    docs/images/detectors.png
    python scripts/paper/figures.py detectors --pairs a.png a_depth.png ... --out out/detectors.png
    python scripts/paper/figures.py learned                      docs/images/learned.png
    python scripts/paper/figures.py learned --pascal3d ROOT --out out/learned.png

``detectors`` shows photograph, MCS, MFC, depth and depth CS, one row per object: five solids drawn by code, or the
photographs of ``--pairs``, each followed by its 16-bit depth image (0 = background). ``learned`` shows photograph,
focus curves, learned mask, learned field and depth CS, one column per object: generated scenes, or one photograph of
each class of PASCAL3D+. Only pictures made by code are committed: photographs belong to their authors.
"""

import argparse
import math
from collections.abc import Iterator
from pathlib import Path

import cv2
import torch
from kornia.color import rgb_to_grayscale
from torch import Tensor

from curvireg_torch import filters
from curvireg_torch.data import Pascal3DPlus, read_image
from curvireg_torch.features import LearnedCurvilinearSaliency
from curvireg_torch.geometry import crop_images
from curvireg_torch.matching import ViewDescriber
from curvireg_torch.matching.describe import depth_filter
from curvireg_torch.mesh import load_mesh
from scripts.training.field_dataset import SETTINGS
from scripts.training.generated import GeneratedScenes

IMAGES = Path(__file__).resolve().parents[2] / "docs" / "images"
SIZE = 192
COLUMNS = 12
UNUSED_SEED = 77_000_001
"""Seed of scenes that neither training nor validation used."""


def scene(index: int, *, size: int = SIZE) -> tuple[Tensor, Tensor]:
    """Photograph and depth (1, 1, size, size) of a solid in front of a blurred, textured wall.

    The solid (0 two spheres, 1 a cylinder, 2 a box seen along an edge, 3 a cone, 4 a torus) is lit from the upper left
    and striped. The photograph is in focus on the solid and out of focus on the wall.
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
    slope_y, slope_x = torch.gradient(torch.where(visible, z, 3.0), spacing=2.0 / size)
    normal = torch.stack([-slope_x, -slope_y, torch.ones_like(x)])
    normal = torch.where(visible, normal / normal.norm(dim=0), torch.tensor([0.0, 0.0, 1.0]).view(3, 1, 1))
    light = torch.tensor([0.5, 0.55, 0.67]).view(3, 1, 1)
    shading = 0.15 + 0.75 * (normal * light).sum(dim=0).clamp(min=0.0)
    stripes = 1.0 - 0.06 * (torch.sin(60.0 * x + 25.0 * y) > 0)
    generator = torch.Generator().manual_seed(index)
    wall = filters.gaussian_smooth(torch.rand(1, 1, size, size, generator=generator), 3.0)
    wall = 0.45 + 2.0 * (wall - wall.mean())
    photo = torch.where(visible, shading * stripes, wall[0, 0])[None, None]
    photo = filters.gaussian_smooth(photo, 0.7) + 0.005 * torch.randn(1, 1, size, size, generator=generator)
    return photo.clamp(0.0, 1.0), depth[None, None]


def silhouette(depth: Tensor) -> Tensor:
    """Pixels of the solid that have a background pixel next to them."""
    outside = (depth == 0).float()
    return (depth > 0) & (torch.nn.functional.max_pool2d(outside, 3, stride=1, padding=1) > 0)


def read_pair(photo: Path, depth: Path) -> tuple[Tensor, Tensor]:
    grey, z = cv2.imread(str(photo), cv2.IMREAD_GRAYSCALE), cv2.imread(str(depth), cv2.IMREAD_UNCHANGED)
    if grey is None or z is None or z.ndim != 2:
        raise SystemExit(f"cannot read {photo} as a photograph and {depth} as a depth image of one channel")
    scale = SIZE / max(grey.shape)
    grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    z = cv2.resize(z, grey.shape[::-1], interpolation=cv2.INTER_NEAREST)
    return torch.from_numpy(grey).float()[None, None] / 255.0, torch.from_numpy(z.astype("float32"))[None, None]


def strength(field: Tensor) -> Tensor:
    """Square root of a field's length, dark on white. The root makes weak edges visible."""
    length = field.norm(dim=1)[0]
    return 1.0 - (length / length.flatten().quantile(0.995).clamp(min=1e-12)).clamp(max=1.0).sqrt()


def nearness(depth: Tensor) -> Tensor:
    """Near points bright, the background black."""
    z = depth[0, 0]
    near, distant = z[z > 0].min(), z.max()
    return torch.where(z > 0, 1.0 - 0.8 * (z - near) / (distant - near).clamp(min=1e-12), 0.0)


def detector_figure(pairs: list[tuple[Tensor, Tensor]]) -> Tensor:
    """(H, W) sheet in [0, 1], one row per (photograph, depth) pair."""
    rows = []
    for photo, depth in pairs:
        tiles = [
            photo[0, 0],
            strength(filters.multiscale_curvilinear_saliency(photo)),
            strength(filters.multiscale_focus_curves(photo)),
            nearness(depth),
            strength(filters.depth_curvilinear_saliency(depth)),
        ]
        height, width = photo.shape[-2:]
        border = (2, SIZE + 2 - width, 2, SIZE + 2 - height)
        rows.append(torch.cat([torch.nn.functional.pad(t, border, value=1.0) for t in tiles], dim=1))
    return torch.cat(rows)


def generated_pairs() -> Iterator[tuple[Tensor, Tensor]]:
    scenes = GeneratedScenes(COLUMNS, seed=UNUSED_SEED)
    for i in range(COLUMNS):
        yield scenes[i]["image"], scenes[i]["depth"]


def pascal3d_pairs(root: Path, pixel_origin: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Crop of one object of each class, and the depth of its CAD model at the annotated viewpoint."""
    dataset = Pascal3DPlus(root, "val", pixel_origin=pixel_origin)
    categories: set[str] = set()
    for i in range(len(dataset)):
        s = dataset.annotation(i)
        if s["category"] in categories or s["truncated"] or s["occluded"] or s["difficult"]:
            continue
        categories.add(s["category"])
        crop = crop_images([read_image(s["image_path"])], s["box"][None], size=SETTINGS.image_size)[0][0]
        describe = ViewDescriber(load_mesh(s["cad_path"]), SETTINGS)
        yield crop, describe.depth(s["rotation"][None], torch.tensor([float(s["distance"])]))[0][0]


def learned_figure(pairs: Iterator[tuple[Tensor, Tensor]], weights: Path | None) -> Tensor:
    """(H, W, 3) sheet in [0, 1], one column per (photograph, depth) pair."""
    learned, focus = LearnedCurvilinearSaliency(weights=weights), filters.MultiScaleFocusCurves()
    columns = []
    for image, depth in pairs:
        with torch.no_grad():
            fields = [focus(rgb_to_grayscale(image[None])), learned(image[None]), depth_filter(SETTINGS)(depth[None])]
            tiles = [field[0].norm(dim=0).sqrt() for field in fields]
            tiles.insert(2, learned.mask(image[None])[0, 0])
        scaled = [(x / x.flatten().quantile(0.99).clamp(min=1e-9)).clamp(0, 1) for x in tiles]
        columns.append(torch.cat([image.permute(1, 2, 0), *(x[..., None].expand(-1, -1, 3) for x in scaled)]))
    return torch.cat(columns, dim=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    figures = parser.add_subparsers(dest="figure", required=True)
    detectors = figures.add_parser("detectors")
    detectors.add_argument("--pairs", nargs="*", type=Path, default=[])
    learned = figures.add_parser("learned")
    learned.add_argument("--pascal3d", type=Path, metavar="ROOT", help="use photographs of this dataset")
    learned.add_argument("--pixel-origin", type=int, choices=(0, 1), default=1, help="of its annotations (default: 1)")
    learned.add_argument("--weights", type=Path, help="weights of another training")
    for one in (detectors, learned):
        one.add_argument("--out", type=Path)
    options = parser.parse_args()
    if options.figure == "detectors":
        if len(options.pairs) % 2 or (options.pairs and options.out is None):
            parser.error("--pairs expects photographs, each followed by its depth image, and needs --out")
        pairs = [read_pair(p, d) for p, d in zip(options.pairs[::2], options.pairs[1::2], strict=True)]
        picture = detector_figure(pairs or [scene(i) for i in range(5)])
    else:
        root = options.pascal3d
        if root is not None and options.out is None:
            parser.error("--pascal3d needs --out")
        picture = learned_figure(
            generated_pairs() if root is None else pascal3d_pairs(root, options.pixel_origin), options.weights
        ).flip(-1)
    out = options.out or IMAGES / f"{options.figure}.png"
    out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(out), (picture * 255).round().byte().numpy())
    print(f"wrote {out}, {picture.shape[1]} x {picture.shape[0]} px")


if __name__ == "__main__":
    main()

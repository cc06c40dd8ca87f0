"""The picture of docs/learned.md: photograph, focus curves, learned field, learned mask, depth CS; twelve columns.

    python scripts/make_learned_figure.py                                    # generated scenes, docs/images/learned.png
    python scripts/make_learned_figure.py --pascal3d ROOT --out out/learned.png          # one photograph of each class

Only the picture of generated scenes is committed: other people's photographs stay where they are.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import cv2
import torch
from kornia.color import rgb_to_grayscale
from torch import Tensor

from curvireg_torch.data import Pascal3DPlus
from curvireg_torch.filters import MultiScaleFocusCurves
from curvireg_torch.geometry import crop_images
from curvireg_torch.io import read_image
from curvireg_torch.io.meshes import load_mesh
from curvireg_torch.matching import ViewDescriber
from curvireg_torch.matching.fields import depth_filter
from curvireg_torch.models import LearnedCurvilinearSaliency
from curvireg_torch.training.field_dataset import SETTINGS
from curvireg_torch.training.scenes import GeneratedScenes

COLUMNS = 12
UNSEEN = 77_000_001
"""Seed of scenes that neither training nor validation used."""


def generated() -> Iterator[tuple[Tensor, Tensor]]:
    scenes = GeneratedScenes(COLUMNS, seed=UNSEEN)
    for i in range(COLUMNS):
        yield scenes[i]["image"], scenes[i]["depth"]


def photographs(root: Path, pixel_origin: int) -> Iterator[tuple[Tensor, Tensor]]:
    """One object of each class, and the depth of its CAD at the annotated viewpoint."""
    dataset = Pascal3DPlus(root, "val", pixel_origin=pixel_origin)
    seen: set[str] = set()
    for i in range(len(dataset)):
        s = dataset.annotation(i)
        if s["category"] in seen or s["truncated"] or s["occluded"] or s["difficult"]:
            continue
        seen.add(s["category"])
        crop = crop_images([read_image(s["image_path"])], s["box"][None], size=SETTINGS.image_size)[0][0]
        describe = ViewDescriber(load_mesh(s["cad_path"]), SETTINGS)
        yield crop, describe.depth(s["rotation"][None], torch.tensor([float(s["distance"])]))[0][0]


def as_grey(x: Tensor) -> Tensor:
    """(H, W) scaled to its 99th percentile, as (H, W, 3)."""
    return (x / x.flatten().quantile(0.99).clamp(min=1e-9)).clamp(0, 1)[..., None].expand(-1, -1, 3)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pascal3d", type=Path, metavar="ROOT", help="take photographs of this dataset")
    parser.add_argument("--pixel-origin", type=int, choices=(0, 1), default=1, help="of its annotations (default: 1)")
    parser.add_argument("--weights", type=Path, help="of another training")
    parser.add_argument("--out", type=Path, default=Path("docs/images/learned.png"))
    arguments = parser.parse_args()
    learned, focus = LearnedCurvilinearSaliency(weights=arguments.weights), MultiScaleFocusCurves()
    columns = []
    pairs = generated() if arguments.pascal3d is None else photographs(arguments.pascal3d, arguments.pixel_origin)
    for image, depth in pairs:
        with torch.no_grad():
            fields = [focus(rgb_to_grayscale(image[None])), learned(image[None]), depth_filter(SETTINGS)(depth[None])]
            lengths = [field[0].norm(dim=0).sqrt() for field in fields]
            lengths.insert(2, learned.mask(image[None])[0, 0])
        columns.append(torch.cat([image.permute(1, 2, 0), *map(as_grey, lengths)]))
    sheet = (255 * torch.cat(columns, dim=1)).round().byte().numpy()
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(arguments.out), cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))


if __name__ == "__main__":
    main()

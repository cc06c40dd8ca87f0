"""Draw docs/images/learned.png: generated scenes that neither training nor validation used, one in a column.

    python scripts/paper/figures.py [--weights FILE] [--out docs/images/learned.png]

From above: photograph, focus curves, learned field, learned mask, and curvilinear saliency of the true depth.
"""

import argparse
from pathlib import Path

import cv2
import torch
from kornia.color import rgb_to_grayscale
from torch import Tensor

from curvireg_torch import filters
from curvireg_torch.features import LearnedCurvilinearSaliency
from curvireg_torch.matching.describe import depth_filter
from scripts._shared import REPOSITORY
from scripts.training.field_dataset import SETTINGS
from scripts.training.generated import GeneratedScenes

COLUMNS, UNUSED_SEED = 12, 77_000_001


@torch.no_grad()
def learned_figure(weights: Path | None) -> Tensor:
    """(H, W, 3) picture in [0, 1]."""
    learned, focus = LearnedCurvilinearSaliency(weights=weights), filters.MultiScaleFocusCurves()
    scenes, columns = GeneratedScenes(COLUMNS, seed=UNUSED_SEED), []
    for sample in map(scenes.__getitem__, range(COLUMNS)):
        image, depth = sample["image"][None], sample["depth"][None]
        fields = [focus(rgb_to_grayscale(image)), learned(image), depth_filter(SETTINGS)(depth)]
        tiles = [field[0].norm(dim=0).sqrt() for field in fields]
        tiles.insert(2, learned.mask(image)[0, 0])
        scaled = [(x / x.flatten().quantile(0.99).clamp(min=1e-9)).clamp(0, 1) for x in tiles]
        columns.append(torch.cat([image[0].permute(1, 2, 0), *(x[..., None].expand(-1, -1, 3) for x in scaled)]))
    return torch.cat(columns, dim=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", type=Path, help="weights of another training")
    parser.add_argument("--out", type=Path, default=REPOSITORY / "docs" / "images" / "learned.png")
    options = parser.parse_args()
    picture = learned_figure(options.weights).flip(-1)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(options.out), (picture * 255).round().byte().numpy())


if __name__ == "__main__":
    main()

"""Draw the pictures of real photographs, and of the demo, in docs/images.

python scripts/docs_pictures.py demo cup
python scripts/docs_pictures.py buddha buddha-all known-pose --buddha data/bop/buddha

docs/images/SOURCES.txt names the photographers and licences.
"""

import argparse
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

import curvireg_torch as cr
from curvireg_torch.cli import main as curvireg
from curvireg_torch.data import BOPDataset
from curvireg_torch.geometry import rotation_from_axis_angle
from curvireg_torch.matching import cached_bank
from curvireg_torch.rendering import DepthRenderer
from curvireg_torch.visualization.contours import draw_pose
from curvireg_torch.visualization.encoding import shrink
from curvireg_torch.visualization.overlay import to_uint8
from scripts._cup import cup
from scripts._poses import recorded
from scripts._shared import REPOSITORY

IMAGES = REPOSITORY / "docs" / "images"

BUDDHA, WINDOW = 67, (95, 0, 1055, 720)
"""Number of the photograph, and the part of it that is shown: x0, y0, x1, y1 in px."""

FRAMES, HOLD, STEP = 12, 1500, 250
"""Most frames of the animation; milliseconds of the first and the last one, and of the others."""

OFF, AXIS = 10.0, (1.0, 1.0, 1.0)
"""Angle in degrees and axis, in the camera's frame, by which the start of a refinement is rotated from the truth."""

CUP_BOX, CUP_VIEW, CUP_WINDOW = (172.0, 18.0, 409.0, 308.0), 40.0, (120, 0, 460, 340)
"""Box of the cup in px, horizontal field of view in degrees, and the part of the photograph that is shown."""

TILE, COLUMNS = 184, 7
"""Side of a photograph among all of them in px, and how many of them stand in a row."""

STAGES = {"view": "best of the bank's views", "search": "search", "contours": "contour fit"}
PAPER, INK = (255, 255, 255), (30, 30, 30)


def drawn(
    renderer: DepthRenderer,
    pose: tuple[Tensor, Tensor],
    image: Tensor,
    window: tuple[int, int, int, int],
    box: Sequence[float] | None = None,
) -> np.ndarray:
    """(H, W, 3) uint8: the window x0, y0, x1, y1 of a photograph with contours at a pose and camera matrix."""
    x0, y0, x1, y1 = window
    T, K = pose
    shift = torch.tensor([[0.0, 0.0, x0], [0.0, 0.0, y0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    picture = to_uint8(image[:, y0:y1, x0:x1])
    inside = None if box is None else (box[0] - x0, box[1] - y0, box[2] - x0, box[3] - y0)
    draw_pose(picture, renderer, (T, K.double() - shift), inside)
    return picture


def captioned(picture: np.ndarray, caption: str) -> Image.Image:
    """The picture above a line of text."""
    height, width = picture.shape[:2]
    size = max(14, width // 32)
    sheet = Image.new("RGB", (width, height + 2 * size), PAPER)
    sheet.paste(Image.fromarray(picture))
    font = ImageFont.load_default(size)
    ImageDraw.Draw(sheet).text((width / 2, height + size), caption, INK, font, anchor="mm")
    return sheet


def side_by_side(pictures: Sequence[Image.Image], gap: int = 8) -> Image.Image:
    width, height = sum(p.width + gap for p in pictures) - gap, max(p.height for p in pictures)
    sheet, x = Image.new("RGB", (width, height), PAPER), 0
    for picture in pictures:
        sheet.paste(picture, (x, 0))
        x += picture.width + gap
    return sheet


def stacked(rows: Sequence[Image.Image], gap: int = 0) -> Image.Image:
    sheet = Image.new("RGB", (max(row.width for row in rows), sum(row.height + gap for row in rows) - gap), PAPER)
    y = 0
    for row in rows:
        sheet.paste(row, (0, y))
        y += row.height + gap
    return sheet


def save(picture: Image.Image, name: str, **options: Any) -> None:
    path = IMAGES / name
    picture.save(path, **{"quality": 80, "method": 6, **options})
    print(f"{name}: {picture.width} x {picture.height} px, {path.stat().st_size / 1000:.0f} kB")


def draw_demo() -> None:
    """The overlay of ``curvireg demo``."""
    out = REPOSITORY / "out" / "demo"
    curvireg(["demo", "--out", str(out)])
    save(Image.open(out / "overlay.png"), "demo.webp")


def draw_cup() -> None:
    """Two answers to one photograph, and the answer with a hint, each with its probability."""
    from skimage.data import coffee

    photograph = torch.from_numpy(coffee().copy()).permute(2, 0, 1)
    focal = coffee().shape[1] / 2 / math.tan(math.radians(CUP_VIEW / 2))
    K = cr.camera_matrix(focal, focal, 299.5, 199.5)
    pipeline = cr.Pipeline().with_pose_prior("upright")
    bank = cached_bank(cup(), pipeline=pipeline, progress=False)
    registrar = cr.Registrar(bank, pipeline=pipeline, mesh_is="similar")
    free, hinted = (
        registrar([photograph], [CUP_BOX], K, prior=prior)[0] for prior in (None, cr.PosePrior(azimuth=(0, 90)))
    )
    for name, result in (("no hint", free), ("azimuth 0 to 90", hinted)):
        answers = result.answer_set
        print(f"{name}: members {answers.members}, none of them {answers.none:.2f}, {result.ambiguous}")
    panels = []
    for words, result, index in (
        ("first answer", free, 0),
        ("could also be" if 1 in free.answer_set.members else "second", free, 1),
        ("with --azimuth 0 90", hinted, 0),
    ):
        hypothesis, probability = result.hypotheses[index], result.answer_set.probabilities[index]
        picture = drawn(registrar.describers[0].renderer, hypothesis.projection, photograph, CUP_WINDOW)
        panels.append(captioned(picture, f"{words}: {math.floor(100 * probability) / 100:.2f}"))
    save(side_by_side(panels), "cup.webp")


def buddha_samples(root: Path) -> tuple[cr.Registrar, list[dict[str, Any]]]:
    """The registrar of the plaster head, and the samples of all photographs with their (4, 4) true poses as "truth"."""
    samples = list(BOPDataset(root))
    for sample in samples:
        sample["truth"] = torch.eye(4, dtype=torch.float64)
        sample["truth"][:3, :3], sample["truth"][:3, 3] = sample["rotation"], sample["translation"]
    bank = cached_bank(cr.load_mesh(samples[0]["model_path"], unit="mm"), progress=False)
    return cr.Registrar(bank), samples


def buddha_sample(root: Path) -> tuple[cr.Registrar, dict[str, Any], Tensor]:
    """The registrar, the sample of the photograph ``BUDDHA``, and its true pose."""
    registrar, samples = buddha_samples(root)
    sample = next(s for s in samples if s["image_id"] == BUDDHA)
    return registrar, sample, sample["truth"]


def rotation_off(T: Tensor, truth: Tensor) -> float:
    return float(cr.rotation_error(T[:3, :3], truth[:3, :3]))


def draw_buddha(root: Path) -> None:
    """A photograph with the contours of its pose, and an animation of the poses on the way there."""
    registrar, sample, truth = buddha_sample(root)
    image, box, K = sample["image"], sample["box"], sample["camera_matrix"]
    with recorded() as record:
        result = registrar([image], box[None], K)[0]
    print(f"confidence {result.confidence:.2f}, {rotation_off(result.projection[0], truth):.2f} degrees off")
    overlay = drawn(registrar.describers[0].renderer, result.projection, image, WINDOW, box.tolist())
    save(Image.fromarray(overlay), "buddha.webp")
    steps = record.path(registrar, result, box)
    chosen = np.unique(np.linspace(0, len(steps) - 1, FRAMES).round().astype(int))
    frames = []
    for k in chosen:
        stage, T = steps[k]
        picture = drawn(registrar.describers[0].renderer, (T, K), image, WINDOW)
        print(f"{k:2d} {stage}: {rotation_off(T, truth):.1f} degrees off")
        frames.append(captioned(shrink(picture, 640), f"{STAGES[stage]}: {rotation_off(T, truth):.1f}° off"))
    durations = [HOLD, *[STEP] * (len(frames) - 2), 2 * HOLD]
    options = {"save_all": True, "append_images": frames[1:], "duration": durations, "loop": 0, "quality": 60}
    save(frames[0], "closing-in.webp", **options)


def draw_all(root: Path) -> None:
    """All photographs of the set with the contours of their poses, in the order of their numbers."""
    registrar, samples = buddha_samples(root)
    tiles = []
    for sample in samples:
        image, box, K = sample["image"], sample["box"], sample["camera_matrix"]
        result = registrar([image], box[None], K)[0]
        error = rotation_off(result.projection[0], sample["truth"])
        print(f"{sample['image_id']}: {error:.1f} degrees off, confidence {result.confidence:.2f}")
        T, K = result.projection
        H, W = image.shape[-2:]
        (x, y), half = ((box[:2] + box[2:]) / 2).round().int().tolist(), min(H, W) // 2
        x, y = min(max(x, half), W - half), min(max(y, half), H - half)
        picture = shrink(
            drawn(registrar.describers[0].renderer, (T, K), image, (x - half, y - half, x + half, y + half)), TILE
        )
        tiles.append(captioned(picture, f"{error:.1f}° ({math.floor(100 * result.confidence) / 100:.2f})"))
    rows = [side_by_side(tiles[k : k + COLUMNS], gap=4) for k in range(0, len(tiles), COLUMNS)]
    save(stacked(rows), "buddha-all.webp")


def draw_known_pose(root: Path) -> None:
    """A start that is 10 degrees off, and the refined pose."""
    registrar, sample, truth = buddha_sample(root)
    image, K = sample["image"], sample["camera_matrix"]
    centre = truth[:3, :3] @ registrar.describers[0].centre.double() + truth[:3, 3]
    axis = torch.nn.functional.normalize(torch.tensor(AXIS, dtype=torch.float64), dim=0)
    rotation = rotation_from_axis_angle(math.radians(OFF) * axis)
    start = truth.clone()
    start[:3, :3] = rotation @ truth[:3, :3]
    start[:3, 3] = centre - rotation @ (centre - truth[:3, 3])
    result = registrar.refine([image], K, [start])[0]
    panels = []
    for words, T in (("start", start), ("refined", result.projection[0])):
        picture = drawn(registrar.describers[0].renderer, (T, K), image, WINDOW)
        panels.append(captioned(shrink(picture, 476), f"{words}: {rotation_off(T, truth):.1f}° off"))
    save(side_by_side(panels), "known-pose.webp")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    generated: dict[str, Callable[[], None]] = {"demo": draw_demo, "cup": draw_cup}
    real: dict[str, Callable[[Path], None]] = {
        "buddha": draw_buddha,
        "buddha-all": draw_all,
        "known-pose": draw_known_pose,
    }
    parser.add_argument("pictures", nargs="+", choices=[*generated, *real])
    parser.add_argument("--buddha", type=Path, metavar="DIR", help="BOP folder of the plaster head")
    arguments = parser.parse_args()
    if arguments.buddha is None and not real.keys().isdisjoint(arguments.pictures):
        parser.error(f"{', '.join(real)} need --buddha DIR")
    for name in arguments.pictures:
        if name in generated:
            generated[name]()
        else:
            real[name](arguments.buddha)


if __name__ == "__main__":
    main()

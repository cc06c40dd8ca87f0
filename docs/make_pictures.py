"""The page docs/method-pictures.md with its pictures, from the gallery's page of the method.

    python docs/make_pictures.py

runs ``docs/gallery/plot_method.py`` and draws ``docs/images/method.webp`` from what it computed. A
test compares the text of the page with the gallery.
"""

import itertools
import re
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib
from PIL import Image

from docs.make_notebooks import DOCS, divided, markdown

SOURCE = DOCS / "gallery" / "plot_method.py"
PAGE = DOCS / "method-pictures.md"
PICTURES = DOCS / "images"
NOTE = (
    "Made by `python docs/make_pictures.py` from [a script](gallery/plot_method.py) that you can "
    "run."
)
DPI = 90
# Column, row, words and file of each box of the picture of the architecture
STEPS = {
    "mesh": (0, 1, "mesh", "mesh/mesh.py"),
    "views": (1, 1, "depth views", "rendering/renderer.py"),
    "saliency": (2, 1, "their edges", "filters/curvilinear.py"),
    "bank": (3, 1, "descriptors", "matching/bank.py"),
    "photograph": (0, 0, "photograph", "data/images.py"),
    "crop": (1, 0, "cut out", "geometry/crops.py"),
    "field": (2, 0, "its edges", "features/fields.py"),
    "query": (3, 0, "descriptor", "features/hog.py"),
    "ranking": (4, 0.5, "ranking", "matching/matcher.py"),
    "fit": (5, 0.5, "contour fit", "fitting/contour_fit.py"),
    "confidence": (6, 0.5, "confidence", "registration/confidence.py"),
    "result": (7, 0.5, "result", "registration/result.py"),
}
TILE = 300  # px of the sides of an overlay of the README
# Picture and part (left, top, right, bottom) of each
OVERLAYS = (
    ("demo", (340, 170, 840, 670)),
    ("buddha-all", (376, 424, 560, 608)),
    ("cup", (0, 0, 340, 340)),
    ("buddha-all", (188, 212, 372, 396)),
    ("buddha-all", (752, 212, 936, 396)),
    ("buddha-all", (188, 636, 372, 820)),
)
ARROWS = (
    "mesh views saliency bank ranking",
    "photograph crop field query ranking fit confidence result",
)


def blocks() -> list[tuple[str, str]]:
    """The text and the code of each part of the gallery's page."""
    head, rest = SOURCE.read_text(encoding="utf-8").split('"""', 2)[1:]
    parts = [divided(block) for block in re.split(r"^# %%\n", rest, flags=re.MULTILINE)]
    return [(head.strip(), ""), *parts]


def page() -> str:
    """The text of the page: no code, and a picture where the code shows one."""
    lines: list[str] = []
    number = 0
    for comment, code in blocks():
        if comment:
            lines += [markdown(comment).replace("](../", "]("), ""]
        if lines and len(lines) == 2:
            lines += [NOTE, ""]
        if "plt.show()" in code:
            number += 1
            heading = next(text for text in reversed(lines) if text.startswith("#"))
            title = heading.splitlines()[0].strip("# ")
            lines += [f"![{title}](images/{picture_name(number)})", ""]
    return re.sub(r"\n{3,}", "\n\n", "\n".join(lines))


def picture_name(number: int) -> str:
    """The file name of the n-th picture, from 1."""
    return f"method-{number}.webp"


def run() -> dict[str, Any]:
    """Run the gallery's page, and write a picture where it shows one; its variables."""
    from matplotlib import pyplot

    names: dict[str, Any] = {"__name__": "__main__"}
    numbers: Iterator[int] = iter(range(1, 100))
    pyplot.show = lambda: save(pyplot.gcf(), PICTURES / picture_name(next(numbers)))
    for _, code in blocks():
        exec(compile(code, SOURCE.name, "exec"), names)
    return names


def save(figure: Any, path: Path) -> None:
    """Write a figure as WebP."""
    content = BytesIO()
    figure.savefig(content, format="png", dpi=DPI)
    Image.open(content).convert("RGB").save(path, quality=70)
    matplotlib.pyplot.close(figure)


def draw_overview(names: dict[str, Any]) -> None:
    """One picture: mesh, views and their edges; photograph, crop and its edges; the answers, and
    the pose."""
    import torch
    from matplotlib import pyplot

    from curvireg_torch.visualization import contour_overlay

    bank, box, photograph, show = (names[name] for name in ("bank", "box", "photograph", "show"))
    answers = names["after"].hypotheses[:5]

    def views(numbers: Any) -> Any:
        return names["describer"].depth(bank.rotations[numbers], names["distances"][numbers])[0]

    rotations = torch.stack([pose.rotation for pose in answers]).to(bank.rotations)
    nearest = [int(names["cr"].rotation_error(bank.rotations, R).argmin()) for R in rotations]
    saliency = names["saliency"].norm(dim=1, keepdim=True).sqrt()
    _, axes = pyplot.subplots(2, 5, figsize=(12.5, 4.9), layout="constrained")
    show(axes[0, 0], views([names["right"]])[0, 0], "your mesh \u2192", cmap="gray")
    show(axes[0, 1], tiled(names["depth"]), "views of it \u2192", cmap="bone")
    show(axes[0, 2], tiled(saliency), "their edges \u2192", cmap="gray_r")
    show(axes[1, 0], photograph.permute(1, 2, 0), "your photograph and a box \u2192")
    x0, y0, x1, y1 = box.tolist()
    axes[1, 0].add_patch(pyplot.Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, color="white"))
    show(axes[1, 1], names["crop"][0].permute(1, 2, 0), "cut out \u2192")
    show(axes[1, 2], names["learned"][0].norm(dim=0).sqrt(), "its edges \u2192", cmap="gray_r")
    words = f"compared: {len(answers)} answers \u2192"
    show(axes[0, 3], tiled(views(nearest)), words, cmap="bone")
    for place, which, result, title in (
        (axes[1, 3], names["coarse"], names["before"], "the first, placed \u2192"),
        (axes[0, 4], names["registrar"], names["after"], "fitted to the edges"),
    ):
        show(place, contour_overlay(which, result, photograph, box), title)
        place.set(xlim=(x0 - 40, x1 + 40), ylim=(y1 + 30, y0 - 30))
    axes[1, 4].set_axis_off()
    after = names["after"]
    words = f"rotation, translation\nconfidence {after.confidence:.2f}\n{after.verdict}"
    axes[1, 4].text(0.5, 0.5, words, ha="center", va="center", fontsize=13)
    save(pyplot.gcf(), PICTURES / "method.webp")


def draw_architecture() -> None:
    """The steps as boxes, with the file of each."""
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(14, 2.7), layout="constrained")
    for column, row, words, file in STEPS.values():
        rim = {"boxstyle": "round,pad=0.5", "facecolor": "#e8f3ec", "edgecolor": "#0a6b35"}
        place = {"ha": "center", "va": "center"}
        axes.text(column, row, words, fontsize=12, bbox=rim, **place)
        axes.text(column, row - 0.24, file, fontsize=8, family="monospace", **place)
    for line in ARROWS:
        names = line.split()
        for first, second in itertools.pairwise(names):
            (x0, y0, _, _), (x1, y1, _, _) = STEPS[first], STEPS[second]
            ends = {"xytext": (x0 + 0.36, y0), "xy": (x1 - 0.36, y1)}
            axes.annotate("", arrowprops={"arrowstyle": "->", "color": "#566069"}, **ends)
    axes.set(xlim=(-0.6, 7.6), ylim=(-0.45, 1.25))
    axes.set_axis_off()
    save(figure, PICTURES / "architecture.webp")


def draw_overlays() -> None:
    """Six overlays, cut out of the pictures of other pages."""
    picture = Image.new("RGB", (3 * TILE + 8, 2 * TILE + 4), "white")
    for number, (name, place) in enumerate(OVERLAYS):
        with Image.open(PICTURES / f"{name}.webp") as source:
            tile = source.convert("RGB").crop(place).resize((TILE, TILE))
        picture.paste(tile, ((TILE + 4) * (number % 3), (TILE + 4) * (number // 3)))
    picture.save(PICTURES / "overlays.webp", quality=75)


def tiled(pictures: Any, columns: int = 3) -> Any:
    """(N, 1, H, W) side by side, in rows, of which the last one is filled up with nothing."""
    import torch

    missing = -len(pictures) % columns
    pictures = torch.cat([pictures[:, 0], torch.zeros_like(pictures[:missing, 0])])
    rows = [torch.cat(list(row), dim=1) for row in pictures.split(columns)]
    return torch.cat(rows)


def main() -> None:
    matplotlib.use("agg")
    PAGE.write_text(page(), encoding="utf-8")
    draw_overlays()
    draw_architecture()
    draw_overview(run())


if __name__ == "__main__":
    main()

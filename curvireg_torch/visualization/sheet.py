"""One HTML page of results: thumbnails with the contours at the estimated poses, best or worst
first."""

import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from torch import Tensor

from ..matching import ViewDescriber
from ..utils.files import write_file
from .contours import Drawn, draw_close_up
from .encoding import embedded, jpeg

SIDE = 224  # longer side of a thumbnail in px
MAX_ENTRIES = 500  # of the best, and of the worst: a larger page would be slow to open

_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>curvireg: {title}</title><style>
body {{ font: 14px/1.4 system-ui, sans-serif; margin: 1.5rem; background: #fff; color: #222 }}
#all {{ display: grid; grid-template-columns: repeat(auto-fill, minmax(14rem, 1fr)); gap: 1rem }}
figure {{ margin: 0; padding: .5rem; border: 1px solid #ccc; border-top: 4px solid #b33 }}
figure.reliable, figure.right {{ border-top-color: #2a7 }} figure.unsure {{ border-top-color: #d90 }}
img {{ width: 100%; height: 14rem; object-fit: contain; background: #eee }}
figcaption {{ overflow-wrap: anywhere }}
</style></head><body><h1>{title}</h1>
<p>{note} <button onclick="all.append(...[...all.children].reverse())">best or worst first</button></p>
<main id="all">
{figures}
</main><script>const all = document.getElementById("all")</script></body></html>
"""  # noqa: E501


@dataclass(frozen=True)
class SheetEntry:
    """A photograph on the page: the number of its row, from 1, its name, and the outcome in words.

    ``kind`` is "right" or "wrong" where the pose is known, else the verdict: "reliable" and "right"
    are green, "unsure" is orange, the others are red;
    ``picture`` is the file of its thumbnail; ``rank`` is smaller for better ones.
    """

    number: int
    name: str
    caption: str
    kind: str
    picture: Path | None
    rank: tuple[float, ...] = ()


def thumbnail(
    describer: ViewDescriber,
    projection: tuple[Tensor, Tensor],
    image: Tensor,
    box: Sequence[float],
    copies: Sequence[Drawn] = (),
) -> bytes:
    """JPEG of a (3, H, W) uint8 photograph around a box in px, with the mesh's contours at the
    pose.

    ``projection`` is ``T_cam_from_model`` (4, 4) and the camera matrix (3, 3) of the photograph.
    ``copies`` are further meshes that are drawn, each with its box.
    """
    boxes = np.array([box, *(copy.box for copy in copies)])
    around = [*boxes[:, :2].min(axis=0).tolist(), *boxes[:, 2:].max(axis=0).tolist()]
    drawn = Drawn(describer, projection, box)
    return jpeg(draw_close_up(image, around, SIDE, [*copies, drawn]), 80)


def write_sheet(
    path: Path, title: str, rows: Sequence[SheetEntry], *, table: str, each: int = MAX_ENTRIES
) -> None:
    """Write the page of ``rows`` as one file, best first; ``table`` is the name of the file that
    has all of them.

    Of many rows, ``each`` of the best and of the worst are shown.
    """
    note = "Best first; failed ones last."
    rows = sorted(rows, key=lambda row: row.rank)
    if len(rows) > 2 * each:
        rows = [*rows[:each], *rows[-each:]]
        note = f"The {each} best, then the {each} worst; {table} has them all."
    figures = "\n".join(map(_figure, rows))
    page = _PAGE.format(title=html.escape(title), note=note, figures=figures)
    write_file(path, page.encode(errors="backslashreplace"))  # file names may be no UTF-8


def _figure(entry: SheetEntry) -> str:
    name = html.escape(entry.name)
    picture = ""
    if entry.picture is not None and entry.picture.is_file():
        data = embedded(entry.picture.read_bytes())
        picture = f'<img alt="contours over {name}" src="{data}">'
    caption = f"<b>{entry.number}</b> {name}<br>{html.escape(entry.caption)}"
    kind = entry.kind.replace(" ", "-")
    return f'<figure class="{kind}">{picture}<figcaption>{caption}</figcaption></figure>'

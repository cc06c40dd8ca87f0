"""One HTML page of results: thumbnails with the contours at the estimated poses, best or worst first."""

import base64
import html
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import torch
from torch import Tensor

from ..rendering.protocol import DepthRenderer
from ..utils.files import write_file
from .encoding import jpeg
from .overlay import draw_pose

__all__ = ["SheetEntry", "thumbnail", "write_sheet"]

SIDE = 224
"""Longer side of a thumbnail in px."""

MAX_ENTRIES = 500
"""Of the best, and of the worst: a larger page would be slow to open."""

_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>curvireg: {title}</title><style>
body {{ font: 14px/1.4 system-ui, sans-serif; margin: 1.5rem; background: #fff; color: #222 }}
#all {{ display: grid; grid-template-columns: repeat(auto-fill, minmax(14rem, 1fr)); gap: 1rem }}
figure {{ margin: 0; padding: .5rem; border: 1px solid #ccc; border-top: 4px solid #b33 }}
figure.reliable, figure.right {{ border-top-color: #2a7 }} figure.doubtful {{ border-top-color: #d90 }}
img {{ width: 100%; height: 14rem; object-fit: contain; background: #eee }}
figcaption {{ overflow-wrap: anywhere }}
</style></head><body><h1>{title}</h1>
<p>{note} <button onclick="all.append(...[...all.children].reverse())">best or worst first</button></p>
<main id="all">
{figures}
</main><script>const all = document.getElementById("all")</script></body></html>
"""


@dataclass(frozen=True)
class SheetEntry:
    """A photograph on the page.

    Attributes:
        number: of its row, from 1.
        name: of the photograph.
        caption: the outcome in words.
        kind: "right" or "reliable" (green), "doubtful" (orange), "wrong" or "failed" (red).
        picture: returns its thumbnail or None; called only for entries that are written.
    """

    number: int
    name: str
    caption: str
    kind: str
    picture: Callable[[], bytes | None]


def thumbnail(renderer: DepthRenderer, projection: tuple[Tensor, Tensor], image: Tensor, box: Sequence[float]) -> bytes:
    """JPEG of the photograph around the box, with the mesh's contours at the pose.

    Args:
        renderer: of the mesh.
        projection: (4, 4) ``T_cam_from_model`` and (3, 3) camera matrix in px of the photograph, see
            :class:`~curvireg_torch.registration.Hypothesis`.
        image: (3, H, W) uint8.
        box: x0, y0, x1, y1 px.
    """
    H, W = image.shape[-2:]
    margin = 0.25 * max(box[2] - box[0], box[3] - box[1])
    left, top = (max(0, int(v - margin)) for v in box[:2])
    right, bottom = min(W, int(box[2] + margin) + 1), min(H, int(box[3] + margin) + 1)
    scale = min(1.0, SIDE / max(right - left, bottom - top))
    size = max(1, round((right - left) * scale)), max(1, round((bottom - top) * scale))
    small = cv2.resize(
        image[:, top:bottom, left:right].permute(1, 2, 0).numpy(), size, interpolation=cv2.INTER_AREA
    ).reshape(size[1], size[0], 3)
    x, y = size[0] / (right - left), size[1] / (bottom - top)
    to_small = torch.tensor(
        [[x, 0.0, x * (0.5 - left) - 0.5], [0.0, y, y * (0.5 - top) - 0.5], [0.0, 0.0, 1.0]], dtype=torch.float64
    )
    corners = torch.tensor([[box[0], box[2]], [box[1], box[3]], [1.0, 1.0]], dtype=torch.float64)
    (x0, x1), (y0, y1), _ = (to_small @ corners).tolist()
    T, K = projection
    draw_pose(small, renderer, (T, to_small @ K), (x0, y0, x1, y1))
    return jpeg(small, 80)


def write_sheet(path: Path, title: str, rows: Sequence[SheetEntry], *, table: str, each: int | None = None) -> None:
    """Write the page as one file.

    Args:
        path: of the page.
        title: summary of the results.
        rows: entries, best first.
        table: name of the file that has all of them.
        each: number of the best, and of the worst, that are shown (default: 500).
    """
    each = MAX_ENTRIES if each is None else each
    note = "Best first; failed ones last."
    if len(rows) > 2 * each:
        rows = [*rows[:each], *rows[-each:]]
        note = f"The {each} best, then the {each} worst; {table} has them all."
    figures = "\n".join(map(_figure, rows))
    write_file(path, _PAGE.format(title=html.escape(title), note=note, figures=figures).encode())


def _figure(entry: SheetEntry) -> str:
    name, thumbnail, picture = html.escape(entry.name), entry.picture(), ""
    if thumbnail is not None:
        data = base64.b64encode(thumbnail).decode()
        picture = f'<img alt="contours over {name}" src="data:image/jpeg;base64,{data}">'
    caption = f"<b>{entry.number}</b> {name}<br>{html.escape(entry.caption)}"
    return f'<figure class="{entry.kind}">{picture}<figcaption>{caption}</figcaption></figure>'

"""One HTML page of results: thumbnails with the contours at the estimated poses, best or worst first."""

import base64
import html
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import torch
from torch import Tensor

from ..rendering import DepthRenderer
from ..utils.files import write_file
from .contours import draw_pose
from .encoding import jpeg

__all__ = ["SheetEntry", "thumbnail", "write_sheet"]

SIDE = 224  # longer side of a thumbnail in px
MAX_ENTRIES = 500  # of the best, and of the worst: a larger page would be slow to open

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
        number, name, caption: of its row, from 1; of the photograph; the outcome in words.
        kind: "right" or "reliable" (green), "doubtful" (orange), "wrong" or "failed" (red).
        picture: returns its thumbnail or None; called only for entries that are written.
    """

    number: int
    name: str
    caption: str
    kind: str
    picture: Callable[[], bytes | None]


def thumbnail(renderer: DepthRenderer, projection: tuple[Tensor, Tensor], image: Tensor, box: Sequence[float]) -> bytes:
    """JPEG of a (3, H, W) uint8 photograph around a box in px, with the mesh's contours at the pose.

    ``projection`` is ``T_cam_from_model`` (4, 4) and the camera matrix (3, 3) of the photograph.
    """
    H, W = image.shape[-2:]
    x0, y0, x1, y1 = box
    margin = 0.25 * max(x1 - x0, y1 - y0)
    left, top = max(0, int(x0 - margin)), max(0, int(y0 - margin))
    right, bottom = min(W, int(x1 + margin) + 1), min(H, int(y1 + margin) + 1)
    scale = min(1.0, SIDE / max(right - left, bottom - top))
    size = max(1, round((right - left) * scale)), max(1, round((bottom - top) * scale))
    cropped = image[:, top:bottom, left:right].permute(1, 2, 0).numpy()
    small = cv2.resize(cropped, size, interpolation=cv2.INTER_AREA).reshape(size[1], size[0], 3)
    x, y = size[0] / (right - left), size[1] / (bottom - top)
    to_small = torch.tensor(
        [[x, 0.0, x * (0.5 - left) - 0.5], [0.0, y, y * (0.5 - top) - 0.5], [0.0, 0.0, 1.0]], dtype=torch.float64
    )
    corners = torch.tensor([[x0, x1], [y0, y1], [1.0, 1.0]], dtype=torch.float64)
    (x0, x1), (y0, y1), _ = (to_small @ corners).tolist()
    T, K = projection
    draw_pose(small, renderer, (T, to_small @ K), (x0, y0, x1, y1))
    return jpeg(small, 80)


def write_sheet(path: Path, title: str, rows: Sequence[SheetEntry], *, table: str, each: int | None = None) -> None:
    """Write the page of ``rows``, best first, as one file; ``table`` is the name of the file that has all of them.

    Of many rows, ``each`` of the best and of the worst are shown (default: 500).
    """
    each = MAX_ENTRIES if each is None else each
    note = "Best first; failed ones last."
    if len(rows) > 2 * each:
        rows = [*rows[:each], *rows[-each:]]
        note = f"The {each} best, then the {each} worst; {table} has them all."
    figures = "\n".join(map(_figure, rows))
    page = _PAGE.format(title=html.escape(title), note=note, figures=figures)
    write_file(path, page.encode(errors="backslashreplace"))  # file names may be no UTF-8


def _figure(entry: SheetEntry) -> str:
    name, content, picture = html.escape(entry.name), entry.picture(), ""
    if content is not None:
        data = base64.b64encode(content).decode()
        picture = f'<img alt="contours over {name}" src="data:image/jpeg;base64,{data}">'
    caption = f"<b>{entry.number}</b> {name}<br>{html.escape(entry.caption)}"
    return f'<figure class="{entry.kind}">{picture}<figcaption>{caption}</figcaption></figure>'

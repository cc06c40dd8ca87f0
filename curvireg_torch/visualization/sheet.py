"""One page that shows how a list ended: thumbnails, the best and the worst first."""

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import torch
from torch import Tensor

from .._files import write_file
from ..registration import Registrar, Registration
from ..visualization import contour_overlay

__all__ = ["Shown", "thumbnail", "write_sheet"]

SIDE = 224
"""Of a thumbnail, px."""

SHOWN = 500
"""Of the best, and of the worst: a page of them all would be too large to open."""

_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>curvireg: {title}</title><style>
body {{ font: 14px/1.4 system-ui, sans-serif; margin: 1.5rem; background: #fff; color: #222 }}
#all {{ display: grid; grid-template-columns: repeat(auto-fill, minmax(14rem, 1fr)); gap: 1rem }}
figure {{ margin: 0; padding: .5rem; border: 1px solid #ccc; border-top: 4px solid #b33 }}
figure.reliable {{ border-top-color: #2a7 }} figure.doubtful {{ border-top-color: #d90 }}
img {{ width: 100%; height: 14rem; object-fit: contain; background: #eee }}
figcaption {{ overflow-wrap: anywhere }}
</style></head><body><h1>{title}</h1>
<p>{note} <button onclick="all.append(...[...all.children].reverse())">best or worst first</button></p>
<main id="all">
{figures}
</main><script>const all = document.getElementById("all")</script></body></html>
"""


@dataclass(frozen=True)
class Shown:
    """A row on the page: number, photograph, status, message, confidence, whether reliable, file of the thumbnail."""

    row: int
    name: str
    message: str
    confidence: float
    reliable: bool
    picture: Path


def thumbnail(registrar: Registrar, result: Registration, image: Tensor, box: Sequence[float]) -> bytes:
    """JPEG of the photograph around the box, with the mesh's contours at the pose.

    Args:
        registrar: what made ``result``.
        image: (3, H, W) uint8.
        box: x0, y0, x1, y1 px.
    """
    H, W = image.shape[-2:]
    room = 0.25 * max(box[2] - box[0], box[3] - box[1])
    left, top = (max(0, int(v - room)) for v in box[:2])
    right, bottom = min(W, int(box[2] + room) + 1), min(H, int(box[3] + room) + 1)
    scale = min(1.0, SIDE / max(right - left, bottom - top))
    size = max(1, round((right - left) * scale)), max(1, round((bottom - top) * scale))
    small = cv2.resize(
        image[:, top:bottom, left:right].permute(1, 2, 0).numpy(), size, interpolation=cv2.INTER_AREA
    ).reshape(size[1], size[0], 3)
    x, y = size[0] / (right - left), size[1] / (bottom - top)
    to_small = torch.tensor(
        [[x, 0.0, x * (0.5 - left) - 0.5], [0.0, y, y * (0.5 - top) - 0.5], [0.0, 0.0, 1.0]], dtype=torch.float64
    )
    T, K = result.seen_by
    corners = torch.tensor([[box[0], box[2]], [box[1], box[3]], [1.0, 1.0]], dtype=torch.float64)
    (x0, x1), (y0, y1), _ = (to_small @ corners).tolist()
    pose = replace(result.hypotheses[0], seen_by=(T, to_small @ K))
    picture = contour_overlay(registrar, pose, small, [x0, y0, x1, y1])
    return bytes(cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes())


def write_sheet(path: Path, title: str, rows: Sequence[Shown]) -> None:
    """Write the page, whole in one file.

    Args:
        path: of the page.
        title: how the list ended.
        rows: in any order; of many, the best and the worst are shown.
    """
    ordered = sorted(rows, key=lambda shown: (bool(shown.message), not shown.reliable, -shown.confidence, shown.row))
    note = "Best first; failed ones last."
    if len(ordered) > 2 * SHOWN:
        ordered = [*ordered[:SHOWN], *ordered[-SHOWN:]]
        note = f"The {SHOWN} best, then the {SHOWN} worst; results.csv has them all."
    figures = "\n".join(map(_figure, ordered))
    write_file(path, _PAGE.format(title=html.escape(title), note=note, figures=figures).encode())


def _figure(shown: Shown) -> str:
    kind = "failed" if shown.message else "reliable" if shown.reliable else "doubtful"
    said = shown.message or f"confidence {shown.confidence:.2f}, {kind}"
    text: dict[str, Any] = {"name": html.escape(shown.name), "said": html.escape(said), "row": shown.row, "kind": kind}
    picture = ""
    if not shown.message and shown.picture.is_file():
        data = base64.b64encode(shown.picture.read_bytes()).decode()
        picture = f'<img alt="contours over {text["name"]}" src="data:image/jpeg;base64,{data}">'
    caption = "<b>{row}</b> {name}<br>{said}".format(**text)
    return f'<figure class="{kind}">{picture}<figcaption>{caption}</figcaption></figure>'

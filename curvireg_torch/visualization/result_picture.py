"""The picture of a result: the photograph with the contours of the pose, a caption, and how the pose was found."""

import math
from typing import Any

import cv2
import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from ..geometry import rotation_error
from ..mesh import mesh_unit, mesh_up
from ..registration import Hypothesis, Registrar, Registration
from ..registration.inputs import ImageItem
from ..registration.result import pose_in_words, verdict
from .overlay import Window, draw_window, photograph_item, side_pictures

__all__ = ["registration_sheet"]

LEAST, MOST = 960, 1600  # px of the photograph's longer side in the picture
NARROWEST = 720  # px of width that the caption needs
TILE = 180  # least side of a small picture in px
GAP = 10  # px between pictures
PAPER, INK, FAINT = (255, 255, 255), (30, 30, 30), (100, 100, 100)
VERDICT_COLOURS = {"likely": (20, 125, 65), "unsure": (185, 105, 0), "no match": (190, 40, 40)}
LEGEND = "Green: outline of the mesh at this pose. Orange: its inner edges. White: the box."


@torch.no_grad()
def registration_sheet(
    registrar: Registrar, result: Registration, image: Any, box: Any, camera_matrix: Any | None = None
) -> np.ndarray:
    """The photograph with the pose's contours and a caption; below it a close-up, the compared fields and the rivals.

    The photograph's longer side becomes 960 to 1600 px. Below a rival stand its rotation from the answer and its
    probability. Arguments as for :func:`contour_overlay`.

    Returns:
        (H', W', 3) uint8 RGB.
    """
    item = photograph_item(image, box)
    H, W = item.image.shape[-2:]
    scale = min(max(LEAST, H, W), MOST) / max(H, W)
    photograph = draw_window(registrar, result, item, (0, 0, W, H), scale, camera_matrix)
    height, width = photograph.shape[0], max(NARROWEST, photograph.shape[1])
    count = 3 + len(result.hypotheses)
    rows = -(-count // (width // TILE))
    columns = -(-count // rows)
    side = (width - GAP) // columns - GAP
    text, line = max(15, width // 60), max(12, side // 13)
    top, step = height + 4 * text + GAP, side + 2 * line + GAP
    sheet = Image.new("RGB", (width, top + rows * step), PAPER)
    sheet.paste(Image.fromarray(photograph), ((width - photograph.shape[1]) // 2, 0))
    draw = ImageDraw.Draw(sheet)
    _draw_caption(draw, registrar, result, (GAP, height + text // 2), text)
    for k, (name, picture) in enumerate(_small_pictures(registrar, result, item, camera_matrix, side)):
        x, y = GAP + k % columns * (side + GAP), top + k // columns * step
        h, w = picture.shape[:2]
        sheet.paste(Image.fromarray(picture), (x + (side - w) // 2, y + (side - h) // 2))
        draw.text((x, y + side + line // 3), name, INK, ImageFont.load_default(line))
    return np.asarray(sheet).copy()


def _draw_caption(
    draw: ImageDraw.ImageDraw, registrar: Registrar, result: Registration, corner: tuple[int, int], size: int
) -> None:
    """Verdict and pose in words, and the meaning of the colours."""
    x, y = corner
    word, font = verdict(result.confidence, result.none, result.reliable), ImageFont.load_default(size)
    badge = word
    if result.confidence is not None:  # 0.896 is not yet 0.90, reliable
        badge += f": confidence {math.floor(100 * result.confidence) / 100:.2f}"
    right = x + draw.textlength(badge, font) + size
    draw.rounded_rectangle((x, y, right, y + 1.6 * size), 0.5 * size, VERDICT_COLOURS[word])
    draw.text((x + size / 2, y + 0.8 * size), badge, PAPER, font, anchor="lm")
    mesh = registrar.of_model(result.model).bank.mesh
    front = None if result.prior is None else result.prior.front
    pose = pose_in_words(result.rotation, up=mesh_up(mesh), front=front)
    if result.translation is not None:
        pose += f", {float(f'{result.distance:.3g}'):g} {mesh_unit(mesh) or 'units'} away"
    if registrar.others:
        pose = f"mesh {result.model}, {pose}"
    room = draw.im.size[0] - right - 1.5 * size
    font = ImageFont.load_default(min(size, size * room / draw.textlength(pose, font)))
    draw.text((right + size / 2, y + 0.8 * size), pose, INK, font, anchor="lm")
    draw.text((x, y + 2 * size), LEGEND, FAINT, ImageFont.load_default(0.75 * size))


def _small_pictures(
    registrar: Registrar, result: Registration, item: ImageItem, camera_matrix: Any | None, side: int
) -> list[tuple[str, np.ndarray]]:
    """Captions and pictures, at most ``side`` px wide and high."""
    window = _close_up(item)
    scale = side / max(window[2] - window[0], window[3] - window[1])

    def draw(pose: Registration | Hypothesis) -> np.ndarray:
        return draw_window(registrar, pose, item, window, scale, camera_matrix, box=False)

    sides = side_pictures(registrar, result, item.image, item.box)
    names = {
        "photograph field": "edges of the photograph",
        "view field": "edges of the mesh",
        "pose": "mesh at this pose",
    }
    found = [
        (text, cv2.resize(sides[name], (side, side), interpolation=cv2.INTER_CUBIC)) for name, text in names.items()
    ]
    rivals = [(_rival(result, index), draw(h)) for index, h in enumerate(result.hypotheses) if index]
    return [("close-up", draw(result)), *found, *rivals]


def _rival(result: Registration, index: int) -> str:
    angle = f"rival: {float(rotation_error(result.hypotheses[index].rotation, result.rotation)):.0f}° away"
    return f"{angle} ({result.probabilities[index]:.2f})" if result.probabilities else angle


def _close_up(item: ImageItem) -> Window:
    """A square around the box with a margin, moved into the photograph and cut at its borders."""
    H, W = item.image.shape[-2:]
    x0, y0, x1, y1 = item.box.tolist()
    side = round(1.3 * max(x1 - x0, y1 - y0)) + 2
    left = max(0, min(round(0.5 * (x0 + x1 - side)), W - side))
    top = max(0, min(round(0.5 * (y0 + y1 - side)), H - side))
    return left, top, min(W, left + side), min(H, top + side)

"""Pictures as arrays and as files in memory."""

import base64

import cv2
import numpy as np
from torch import Tensor

from ..utils.arrays import Bytes


def png(picture: Bytes) -> bytes:
    """A PNG file of (H, W, 3 or 4) uint8 RGB or RGBA."""
    order = cv2.COLOR_RGB2BGR if picture.shape[2] == 3 else cv2.COLOR_RGBA2BGRA
    return bytes(cv2.imencode(".png", cv2.cvtColor(picture, order))[1].tobytes())


def jpeg(picture: Bytes, quality: int) -> bytes:
    """A JPEG file of (H, W, 3) uint8 RGB; ``quality`` is 0 to 100."""
    return bytes(
        cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
    )


def embedded(content: bytes) -> str:
    """A JPEG file as the address of a picture in a page."""
    return f"data:image/jpeg;base64,{base64.b64encode(content).decode()}"


def rescaled(picture: Bytes, scale: float) -> Bytes:
    """An (H, W, 3) uint8 picture, ``scale`` times as large."""
    if scale == 1.0:
        return picture
    size = [max(1, round(side * scale)) for side in picture.shape[1::-1]]
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(picture, size, interpolation=how), np.uint8)


def shrink(picture: Bytes, side: int) -> Bytes:
    """An (H, W, 3) uint8 picture, resized so that its longer side is at most ``side`` px."""
    return rescaled(picture, min(1.0, side / max(picture.shape[:2])))


def to_uint8(image: Tensor) -> Bytes:
    """(H, W, 3) uint8 RGB, always a copy, of a (1 or 3, H, W) image, floating in [0, 1] or uint8;
    black for NaN."""
    pixels = image.detach().cpu()
    if pixels.is_floating_point():
        pixels = (pixels.float().nan_to_num(0.0, 0.0, 0.0).clamp(0, 1) * 255).round().byte()
    return np.array(pixels.expand(3, -1, -1).permute(1, 2, 0).numpy(), order="C")

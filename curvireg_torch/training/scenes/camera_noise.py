"""Simulation of a camera's imperfections."""

import cv2
import numpy as np

from .surfaces import Array

__all__ = ["simulate_camera"]


def simulate_camera(picture: Array, rng: np.random.Generator) -> Array:
    """Apply random exposure, white balance, blur, downsampling, noise and JPEG compression to a rendered picture.

    Args:
        picture: (H, W, 3) float32 in [0, 1], linear light.
        rng: random generator.

    Returns:
        (H, W, 3) uint8.
    """
    height, width = picture.shape[:2]
    gain = rng.uniform(0.45, 0.75) / (np.percentile(picture, rng.uniform(60, 95)) + 1e-3)
    picture = picture * gain * (1 + rng.normal(0, 0.06, 3))
    picture = np.clip(picture, 0, 1) ** rng.uniform(0.5, 1.1)
    if rng.random() < 0.15:
        picture = np.broadcast_to(picture.mean(axis=2, keepdims=True), picture.shape)
    picture = np.ascontiguousarray(picture, dtype=np.float32)
    if rng.random() < 0.5:
        picture = cv2.GaussianBlur(picture, (0, 0), rng.uniform(0.3, 1.6))
    if rng.random() < 0.1:
        length = int(rng.integers(3, 8))
        kernel = np.zeros((length, length), np.float32)
        end = rng.integers(0, length, 2).tolist()
        cv2.line(kernel, (length // 2, length // 2), end, 1.0)
        picture = cv2.filter2D(picture, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)
    if rng.random() < 0.35:  # low resolution
        scale = rng.uniform(0.35, 0.9)
        few = cv2.resize(picture, (int(width * scale), int(height * scale)), interpolation=cv2.INTER_AREA)
        picture = cv2.resize(few, (width, height))
    picture = picture + rng.normal(0, np.exp(rng.uniform(-6.5, -3.0)), picture.shape)
    coded: Array = (255 * np.clip(picture, 0, 1) + 0.5).astype(np.uint8)
    if rng.random() < 0.6:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(30, 96))]
        coded = np.asarray(cv2.imdecode(cv2.imencode(".jpg", coded, quality)[1], cv2.IMREAD_COLOR))
    return coded

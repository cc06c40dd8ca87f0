"""Boxes of detectors and of annotation tools."""

from .files import ImageBox, read_boxes
from .finder import BoxFile, PictureSize, pixel_box

__all__ = ["BoxFile", "ImageBox", "PictureSize", "pixel_box", "read_boxes"]

"""Boxes of detectors and of annotation tools."""

from .files import ImageBox as ImageBox
from .files import read_boxes as read_boxes
from .finder import BoxFile as BoxFile
from .finder import PictureSize as PictureSize
from .finder import pixel_box as pixel_box

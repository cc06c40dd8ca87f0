"""Photographs with annotated objects, as torch datasets: PASCAL3D+, BOP, and collections of the user.

A sample is a dict, one per object. Every dataset reports skipped objects with the reason (``skipped``,
``skipped_items``), and ``annotation(index)`` returns a sample without its photograph. Nothing is downloaded.
"""

from ._base import ObjectDataset, collate
from .bop import BOPDataset, BOPRow, read_bop_csv, write_bop_csv
from .camera_files import load_camera
from .images import Photo, read_image, read_photo
from .pascal3d import Pascal3DPlus
from .videos import Video
from .web import WebCollection

__all__ = [
    "BOPDataset",
    "BOPRow",
    "ObjectDataset",
    "Pascal3DPlus",
    "Photo",
    "Video",
    "WebCollection",
    "collate",
    "load_camera",
    "read_bop_csv",
    "read_image",
    "read_photo",
    "write_bop_csv",
]

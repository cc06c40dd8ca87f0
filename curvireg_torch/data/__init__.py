"""Photographs with annotated objects, as torch datasets: PASCAL3D+, BOP, and folders of the user.

A sample is a dict, one per object. Every dataset reports skipped objects with the reason
(``skipped``, ``skipped_items``), and ``annotation(index)`` returns a sample without its photograph.
Nothing is downloaded.
"""

from ._base import ObjectDataset
from .bop import BOPDataset
from .cameras import load_camera
from .crops import ObjectCrops, crops
from .images import Photo, Video, read_image, read_photo
from .pascal3d import Pascal3DPlus
from .pose_folder import PoseFolder

__all__ = [
    "BOPDataset",
    "ObjectCrops",
    "ObjectDataset",
    "Pascal3DPlus",
    "Photo",
    "PoseFolder",
    "Video",
    "crops",
    "load_camera",
    "read_image",
    "read_photo",
]

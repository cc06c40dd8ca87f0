"""Photographs, meshes and tables as files. Input files are untrusted; every reader respects ``limits``."""

from .images import Photo, read_image, read_photo
from .meshes import load_mesh

__all__ = ["Photo", "load_mesh", "read_image", "read_photo"]

"""Photographs, meshes and tables as files. Input files are untrusted; every reader respects ``limits``."""

from .images import Photo, read_image, read_photo
from .meshes import load_mesh
from .videos import Video

__all__ = ["Photo", "Video", "load_mesh", "read_image", "read_photo"]

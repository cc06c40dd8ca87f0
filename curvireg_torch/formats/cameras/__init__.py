"""Cameras of calibration files."""

from .files import CameraFiles, read_camera
from .record import CameraRecord

__all__ = ["CameraFiles", "CameraRecord", "read_camera"]

"""Cameras of calibration files."""

from .files import CameraFiles as CameraFiles
from .files import read_camera as read_camera
from .record import CameraRecord as CameraRecord

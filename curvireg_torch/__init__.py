"""Pose of a known 3D object from one ordinary photograph."""

__version__ = "0.1.0"

"""Tracking: the pose in the next frame from that in the last one, without search and without learned features."""

from .tracker import TrackedPose, Tracker

__all__ = ["TrackedPose", "Tracker"]

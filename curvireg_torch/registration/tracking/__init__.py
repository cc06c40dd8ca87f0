"""Tracking: the pose in the next frame from that in the last one, without search and without learned features."""

from .tracker import TRACKING_FEATURES, TrackedPose, Tracker

__all__ = ["TRACKING_FEATURES", "TrackedPose", "Tracker"]

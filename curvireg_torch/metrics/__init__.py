"""Scores of poses, rankings, feature points and detections, as functions of a whole set.

An average over nothing is NaN; a missing estimate has the error ``inf`` and counts as a miss. Every threshold is
strict: equal is not good enough, except for a radius in pixels and for the IoU, which are inclusive.
"""

from ..geometry.symmetry import symmetry_transforms
from .detection import Detections, Objects, average_precision, average_rotation_precision, average_viewpoint_precision
from .points import hausdorff_distance, intersection_percentage, view_repeatability
from .pose import add_error, add_recall, adds_error, mspd_error, mspd_recall, mssd_error, mssd_recall
from .ranking import closest_view, pose_parameter_errors, rank_precision, viewpoint_differences
from .viewpoint import (
    AVP_BINS,
    accuracy,
    axis_rotation_error,
    azimuth_bin,
    binned_accuracy,
    median_error,
    symmetric_rotation_error,
)

__all__ = [
    "AVP_BINS",
    "Detections",
    "Objects",
    "accuracy",
    "add_error",
    "add_recall",
    "adds_error",
    "average_precision",
    "average_rotation_precision",
    "average_viewpoint_precision",
    "axis_rotation_error",
    "azimuth_bin",
    "binned_accuracy",
    "closest_view",
    "hausdorff_distance",
    "intersection_percentage",
    "median_error",
    "mspd_error",
    "mspd_recall",
    "mssd_error",
    "mssd_recall",
    "pose_parameter_errors",
    "rank_precision",
    "symmetric_rotation_error",
    "symmetry_transforms",
    "view_repeatability",
    "viewpoint_differences",
]

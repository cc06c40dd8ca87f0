"""Metrics of poses, rankings and feature points, as functions of a whole set.

An average over no items is NaN. A missing estimate has the error ``inf`` and counts as a miss. Thresholds are strict:
an error equal to the threshold is a miss; a radius in pixels is inclusive. Arguments outside the documented shapes and
ranges, on different devices, or with NaN or inf where no estimate can be missing raise
:class:`~curvireg_torch.errors.InvalidInputError`.
"""

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
    "accuracy",
    "add_error",
    "add_recall",
    "adds_error",
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
    "view_repeatability",
    "viewpoint_differences",
]

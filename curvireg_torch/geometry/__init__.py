"""Viewpoints, cameras, view spheres and boxes as tensors.

Conventions of the whole library (pinned by ``tests/geometry``):

- OpenCV camera: x right, y down, z forward; ``T_cam_from_model`` maps model points into the camera.
- Pixel (0, 0) is the centre of the top-left pixel; the image covers [-0.5, W - 0.5] x [-0.5, H -
  0.5].
- Boxes are ``x0, y0, x1, y1`` in pixels; depth is z along the optical axis in model units,
  background 0.
- Angles are degrees at the API, radians inside. Images are RGB, floating, in [0, 1].
- Poses refer to the frame and unit of the mesh file; ``up`` names the axis that points up and
  rotates nothing.
"""

from .calibration import Camera, undistorted
from .cameras import (
    camera_matrix,
    pose_from_box,
    project_points,
    projected_boxes,
    rotation_towards,
    transform,
)
from .conversions import (
    axis_angle_from_rotation,
    opencv_from_opengl,
    opengl_from_opencv,
    rotation_from_axis_angle,
    symmetry_transforms,
)
from .crops import box_iou, crop_images, crop_transforms, square_boxes, whole_image_box
from .pose_prior import PosePrior, object_frame
from .viewpoint import (
    ViewSphere,
    paper_views,
    rotation_error,
    rotation_from_viewpoint,
    sample_views,
    uniform_views,
    up_rotation,
    viewpoint_from_rotation,
)

__all__ = [
    "Camera",
    "PosePrior",
    "ViewSphere",
    "axis_angle_from_rotation",
    "box_iou",
    "camera_matrix",
    "crop_images",
    "crop_transforms",
    "object_frame",
    "opencv_from_opengl",
    "opengl_from_opencv",
    "paper_views",
    "pose_from_box",
    "project_points",
    "projected_boxes",
    "rotation_error",
    "rotation_from_axis_angle",
    "rotation_from_viewpoint",
    "rotation_towards",
    "sample_views",
    "square_boxes",
    "symmetry_transforms",
    "transform",
    "undistorted",
    "uniform_views",
    "up_rotation",
    "viewpoint_from_rotation",
    "whole_image_box",
]

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

from .calibration import Camera as Camera
from .calibration import undistorted as undistorted
from .cameras import camera_matrix as camera_matrix
from .cameras import pose_from_box as pose_from_box
from .cameras import project_points as project_points
from .cameras import projected_boxes as projected_boxes
from .cameras import rotation_towards as rotation_towards
from .cameras import transform as transform
from .conversions import axis_angle_from_rotation as axis_angle_from_rotation
from .conversions import opencv_from_opengl as opencv_from_opengl
from .conversions import opengl_from_opencv as opengl_from_opencv
from .conversions import rotation_from_axis_angle as rotation_from_axis_angle
from .conversions import symmetry_transforms as symmetry_transforms
from .crops import box_iou as box_iou
from .crops import crop_images as crop_images
from .crops import crop_transforms as crop_transforms
from .crops import square_boxes as square_boxes
from .crops import whole_image_box as whole_image_box
from .pose_prior import PosePrior as PosePrior
from .pose_prior import object_frame as object_frame
from .viewpoint import ViewSphere as ViewSphere
from .viewpoint import paper_views as paper_views
from .viewpoint import rotation_error as rotation_error
from .viewpoint import rotation_from_viewpoint as rotation_from_viewpoint
from .viewpoint import sample_views as sample_views
from .viewpoint import uniform_views as uniform_views
from .viewpoint import up_rotation as up_rotation
from .viewpoint import viewpoint_from_rotation as viewpoint_from_rotation

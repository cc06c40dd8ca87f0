"""Calibration files, and the cameras that they describe."""

import json

import numpy as np
import torch

K = np.array([[520.5, 0.0, 321.25], [0.0, 522.0, 238.5], [0.0, 0.0, 1.0]])
VGA = (480, 640)


def calibration(focal, cx, cy, **more):
    """A calibration file of OpenCV as JSON."""
    return json.dumps({"camera_matrix": [focal, 0, cx, 0, focal, cy, 0, 0, 1], **more})


def check_camera(camera, distortion, size=VGA, *, matrix=K, model="radial-tangential"):
    torch.testing.assert_close(camera.matrix, torch.from_numpy(matrix))
    assert (camera.distortion, camera.size, camera.model) == (distortion, size, model)

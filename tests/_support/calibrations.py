"""Cameras that calibration files describe, and what is said of files that are refused."""

import json

import numpy as np
import pytest
import torch

from curvireg_torch import load_camera
from curvireg_torch.errors import InvalidInputError

K = np.array([[520.5, 0.0, 321.25], [0.0, 522.0, 238.5], [0.0, 0.0, 1.0]])
VGA = (480, 640)


def check_camera(camera, distortion, size=VGA, *, matrix=K, model="radial-tangential"):
    torch.testing.assert_close(camera.matrix, torch.from_numpy(matrix))
    assert (camera.distortion, camera.size, camera.model) == (distortion, size, model)


def check_refused(folder, content, words):
    """A JSON file with this content is refused in these words."""
    file = folder / "camera.json"
    file.write_text(json.dumps(content))
    with pytest.raises(InvalidInputError, match=words):
        load_camera(file)

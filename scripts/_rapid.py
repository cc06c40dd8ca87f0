"""RAPID, the edge-based tracker in OpenCV's contributed modules, which other methods are compared with.

It needs opencv-contrib-python-headless in place of opencv-python-headless; ``AVAILABLE`` says whether it is there.
"""

import cv2
import numpy as np
import torch
import trimesh
from torch import Tensor
from trimesh.remesh import subdivide_to_size

from curvireg_torch.mesh.mesh import mesh_centre

AVAILABLE = hasattr(cv2, "rapid")
ABSENT = "cv2.rapid is absent (it comes with opencv-contrib-python-headless), so it is not measured"
LARGEST_EDGE = 0.05
"""Of the mesh that RAPID gets, as a fraction of the mesh's diagonal."""


class Rapid:
    """``cv2.rapid.Rapid`` of a mesh.

    Its settings are the best of several on eight generated sequences that no table contains; OpenCV's two trackers by
    colour histograms were worse. RAPID takes 3D points from the vertices nearest to the silhouette, so large triangles
    are divided; and it draws only triangles that face the camera, so both orientations are given.

    Args:
        mesh: the mesh.
        count, length, steps: number of search lines, their length in px to either side, and number of iterations.
    """

    def __init__(self, mesh: trimesh.Trimesh, *, count: int = 300, length: int = 12, steps: int = 20) -> None:
        self.centre, self.unit = mesh_centre(mesh).double(), float(mesh.scale)
        vertices, faces = subdivide_to_size(mesh.vertices, mesh.faces, self.unit * LARGEST_EDGE, max_iter=20)
        points = np.ascontiguousarray((vertices - self.centre.numpy()) / self.unit, np.float32)
        both = np.ascontiguousarray(np.concatenate([faces, faces[:, ::-1]]), np.int32)
        self.tracker = cv2.rapid.Rapid.create(points, both)
        self.lines = count, length
        self.criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, steps, 0.01)

    def __call__(self, image: Tensor, K: Tensor, start: Tensor) -> Tensor | None:
        """(4, 4) pose in a (3, H, W) uint8 image from a (4, 4) start; None if it diverges."""
        pixels = np.ascontiguousarray(image.permute(1, 2, 0).numpy()[..., ::-1])
        R, t = start[:3, :3].double(), start[:3, 3].double()
        pose = cv2.Rodrigues(R.numpy())[0], ((R @ self.centre + t) / self.unit).numpy()[:, None]
        try:
            _, r, t = self.tracker.compute(pixels, *self.lines, K.numpy(), *pose, self.criteria)
        except cv2.error:
            return None
        if not (np.isfinite(r).all() and np.isfinite(t).all() and t[2] > 0):
            return None
        T = torch.eye(4, dtype=torch.float64)
        T[:3, :3] = torch.from_numpy(cv2.Rodrigues(r)[0])
        T[:3, 3] = torch.from_numpy(t[:, 0] * self.unit) - T[:3, :3] @ self.centre
        return T

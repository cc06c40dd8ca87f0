"""Following an object through the frames of a video."""

from typing import Any

import torch
from torch import Tensor

from .refinement import refine
from .registrar import Registrar
from .results import FailedRegistration, Registration

__all__ = ["Follower"]


class Follower:
    """Registers frames one after the other: each starts from the pose of the frame before, at constant velocity.

    The first frame is registered; so is a frame in which the object is lost, and its pose is used only if it is
    reliable.

    Args:
        registrar: of the mesh, with a bank of all views; or a mesh, see :class:`Registrar`.
        camera_matrix: (3, 3) in px, of all frames.

    Example:
        >>> import curvireg_torch as cr
        >>> from curvireg_torch.synthetic import example_mesh
        >>> bank = cr.ViewBank.build(example_mesh(), cr.sample_views(azimuth_step=90), image_size=64, progress=False)
        >>> follow = Follower(cr.Registrar(bank), cr.camera_matrix(150.0, 150.0, 79.5, 59.5))
        >>> follow(torch.rand(3, 120, 160), box=[40, 30, 120, 90]).translation.shape
        torch.Size([3])
    """

    def __init__(self, registrar: Any, camera_matrix: Tensor) -> None:
        self.registrar = registrar if isinstance(registrar, Registrar) else Registrar(registrar)
        self.camera_matrix = camera_matrix
        self._poses: list[Tensor] = []

    def __call__(self, image: Any, box: Any = None) -> Registration | FailedRegistration:
        """The pose in the next frame, or why there is none.

        Args:
            image: see :class:`Registrar`.
            box: x0, y0, x1, y1 in px of the object, for a frame that is registered; None localizes it.
        """
        K, boxes = self.camera_matrix, None if box is None else [box]
        if not self._poses:
            result = self.registrar([image], boxes, K)[0]
        else:
            result = refine(self.registrar, [image], K, [self._predictions()])[0]
            if not result.ok:
                registered = self.registrar([image], boxes, K)[0]
                if isinstance(registered, Registration) and registered.reliable:
                    result = registered
                    self._poses.clear()  # the velocity is unknown
        if isinstance(result, Registration) and result.transform is not None:
            self._poses = [*self._poses[-1:], result.transform]
        return result

    def _predictions(self) -> Tensor:
        """(S, 4, 4) starts: the last pose moved as it moved before, and the last pose."""
        last = self._poses[-1]
        if len(self._poses) < 2:
            return last[None]
        return torch.stack([last @ torch.linalg.inv(self._poses[-2]) @ last, last])

"""What a renderer is, and what all of them check and measure in."""

from typing import Any, Protocol

import numpy as np
import torch
import trimesh
from torch import Tensor

from ..errors import InvalidInputError
from ..geometry.cameras import point_in_cameras, transform
from ..mesh.mesh import Mesh, mesh_centre, mesh_radius
from ..utils.aliases import Size
from ..utils.checks import check_camera_matrix, check_integer, check_pose, check_tensor

# Near plane, in object radii: surface closer to the camera plane, or behind it, is not rendered
NEAREST = 1e-3


class DepthRenderer(Protocol):
    """Depth images of one mesh. Both sides of every face are visible; textures are ignored.

    Example:
        >>> import trimesh
        >>> from curvireg_torch.rendering import make_renderer
        >>> renderer: DepthRenderer = make_renderer(trimesh.creation.box())
    """

    name: str

    def render(
        self,
        T_cam_from_model: Tensor,
        camera_matrix: Tensor,
        size: Size,
        *,
        orthographic: bool = False,
    ) -> Tensor:
        """Render N views, with the arguments of :func:`render_depth`, into (N, 1, H, W) float32
        z-depth."""
        ...


class MeshRenderer:
    """A :class:`DepthRenderer` of a mesh that is centred and scaled to radius 1: the libraries that
    draw compute in single precision. Its subclasses draw in these units."""

    name: str

    def __init__(self, mesh: Mesh | trimesh.Trimesh) -> None:
        self._mesh = mesh
        self._centre = mesh_centre(mesh)
        self._radius = mesh_radius(mesh)

    def _scaled(self, points: Any) -> np.ndarray:
        return np.asarray((np.asarray(points) - self._centre.numpy()) / self._radius)

    def render(
        self,
        T_cam_from_model: Tensor,
        camera_matrix: Tensor,
        size: Size,
        *,
        orthographic: bool = False,
    ) -> Tensor:
        """See :meth:`DepthRenderer.render`."""
        T, K = self._in_radii(T_cam_from_model, camera_matrix, size, orthographic)
        return self._radius * self._depth(T, K, size, orthographic)

    def _in_radii(
        self, T: Tensor, K: Tensor, size: Size, orthographic: bool
    ) -> tuple[Tensor, Tensor]:
        """Poses and cameras of the scaled mesh, checked, as float64 on the CPU."""
        T, K = check_render_arguments(T, K, size)
        if orthographic:
            K = K.clone()
            K[:, :2, :2] *= self._radius
        place = point_in_cameras(T, self._centre) / self._radius
        return transform(T[:, :3, :3], place), K

    def _depth(self, T: Tensor, K: Tensor, size: Size, orthographic: bool) -> Tensor:
        """(N, 1, H, W) depth of the scaled mesh."""
        raise NotImplementedError


def check_render_arguments(T: Tensor, K: Tensor, size: Size) -> tuple[Tensor, Tensor]:
    """Rigid poses (N, 4, 4), or one (4, 4), and cameras (N, 3, 3), checked, as float64 on the
    CPU."""
    T = T[None] if getattr(T, "ndim", 0) == 2 else T
    check_tensor(T, "T_cam_from_model", (None, 4, 4))
    if not hasattr(size, "__len__") or len(size) != 2:
        raise InvalidInputError(f"size: expected (H, W), got {size}")
    for side in size:
        check_integer(side, "size")
    check_camera_matrix(K)
    if K.ndim == 3 and K.shape[0] not in (1, T.shape[0]):
        raise InvalidInputError(
            f"camera_matrix: expected one or {T.shape[0]} matrices, got {K.shape[0]}"
        )
    check_pose(T, "T_cam_from_model")
    T = T.detach().to("cpu", torch.float64)
    return T, K.detach().to("cpu", torch.float64).expand(T.shape[0], 3, 3)

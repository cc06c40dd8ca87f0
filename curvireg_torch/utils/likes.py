"""What callers may pass for images, boxes, cameras, poses and meshes: the types of public
parameters.

Each is checked where it is read, with an error that says what was expected.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, Union

from torch import Tensor

from .aliases import PathName
from .arrays import Array

if TYPE_CHECKING:
    import trimesh
    from PIL.Image import Image

__all__ = [
    "ArrayLike",
    "BoxLike",
    "BoxesLike",
    "CalibratedCamera",
    "CameraLike",
    "CleanMesh",
    "ImageLike",
    "ImagesLike",
    "MaskLike",
    "MeshLike",
]


class CalibratedCamera(Protocol):
    """A :class:`curvireg_torch.Camera`."""

    @property
    def matrix(self) -> Tensor:
        """(3, 3) camera matrix in px."""


class CleanMesh(Protocol):
    """A :class:`curvireg_torch.mesh.Mesh`."""

    @property
    def surface(self) -> "trimesh.Trimesh":
        """Its triangles."""


ArrayLike: TypeAlias = Tensor | Array | Sequence[Any]
"""Numbers: a tensor, an array, or nested lists of these."""

ImageLike: TypeAlias = Union[Tensor, Array, "Image", PathName]
"""A photograph: a (1 or 3, H, W) tensor or an (H, W) or (H, W, 3) array, RGB, floating in [0, 1] or
uint8, a Pillow picture, or the path of a file."""

ImagesLike: TypeAlias = Tensor | Sequence[ImageLike]
"""Photographs: a (B, C, H, W) tensor, or a list."""

BoxLike: TypeAlias = Tensor | Array | Sequence[float]
"""A box: x0, y0, x1, y1 in px."""

BoxesLike: TypeAlias = Tensor | Array | Sequence[BoxLike | None]
"""(B, 4) boxes, or a list of them."""

CameraLike: TypeAlias = ArrayLike | CalibratedCamera
"""A (3, 3) camera matrix in px, a :class:`curvireg_torch.Camera`, or one of these for each
photograph."""

MaskLike: TypeAlias = Tensor | Array | PathName
"""An (H, W) tensor or array, the object white, in bool, uint8 or floating in [0, 1], or the path of
a picture."""

MeshLike: TypeAlias = Union[CleanMesh, "trimesh.Trimesh", "trimesh.Scene", PathName]
"""A mesh of :func:`curvireg_torch.load_mesh` or of trimesh, a scene whose parts are joined, or the
path of a file."""

"""Surface colours of a mesh, from its textures, materials, faces or vertices."""

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL.Image import Resampling

from ...errors import MAX_IMAGE_PIXELS, MAX_TEXTURE_PIXELS
from ...utils.pictures import PICTURE_STARTS, open_picture
from ...utils.srgb import srgb

BOX = Resampling.BOX
TEXTURE_SIDE = 512  # Textures are reduced to this longer side in px; views are smaller
LARGE = 1 << 25  # Pixels of a texture that is reduced in its own mode first
_UNSET = (102, 102, 102)  # trimesh's colour for a material without one
_PLAIN = 255
# by their ids, images, which so keep them, and pixels
_Textures = dict[int, tuple[Any, NDArray[np.uint8] | None]]


@dataclass(frozen=True)
class SurfaceColours:
    """Colours of F faces, stored by corner: interpolated between the corners and multiplied by a
    texture.

    Attributes:
        corners: (F, 3, 3) uint8 RGB.
        uv: (F, 3, 2) float32 texture coordinates; (0, 0) is the bottom left, and textures repeat.
        texture: (F,) int32 index of the texture, -1 for none.
        textures: (h, w, 3) uint8 RGB each.

    Example:
        >>> red = SurfaceColours.plain(12, (255, 0, 0))
        >>> len(red), red[:2].corners.shape
        (12, (2, 3, 3))
    """

    corners: NDArray[np.uint8]
    uv: NDArray[np.float32]
    texture: NDArray[np.int32]
    textures: tuple[NDArray[np.uint8], ...] = ()

    def __len__(self) -> int:
        return len(self.corners)

    def __getitem__(self, index: Any) -> "SurfaceColours":
        """The colours of some of the faces."""
        return SurfaceColours(
            self.corners[index], self.uv[index], self.texture[index], self.textures
        )

    def check(self, faces: int) -> None:
        """Raise ValueError unless these are valid colours of ``faces`` faces."""
        parts = (self.corners, (faces, 3, 3), np.uint8), (self.uv, (faces, 3, 2), np.float32)
        valid = all(x.shape == shape and x.dtype == dtype for x, shape, dtype in parts)
        valid = valid and self.texture.shape == (faces,) and self.texture.dtype == np.int32
        valid = valid and all(
            t.ndim == 3 and t.shape[2] == 3 and t.size and t.dtype == np.uint8
            for t in self.textures
        )
        valid = valid and bool(np.isfinite(self.uv).all())
        if not (valid and -1 <= self.texture.min() <= self.texture.max() < len(self.textures)):
            raise ValueError("colours that do not match the mesh")

    @classmethod
    def plain(cls, faces: int, colour: Any = (_PLAIN,) * 3) -> "SurfaceColours":
        """One colour everywhere, white by default."""
        corners = np.broadcast_to(np.array(colour, np.uint8), (faces, 3, 3))
        return cls(corners, np.zeros((faces, 3, 2), np.float32), np.full(faces, -1, np.int32))

    @classmethod
    def cat(cls, parts: Sequence["SurfaceColours"]) -> "SurfaceColours":
        """The colours of a mesh that is made of several, which may share textures."""
        textures = {id(texture): texture for part in parts for texture in part.textures}
        number = {key: k for k, key in enumerate(textures)}
        texture = [
            np.array([*(number[id(t)] for t in part.textures), -1])[part.texture] for part in parts
        ]
        return cls(
            np.concatenate([part.corners for part in parts]),
            np.concatenate([part.uv for part in parts]),
            np.concatenate(texture).astype(np.int32),
            tuple(textures.values()),
        )


def colours_of_parts(meshes: Iterable[Any]) -> list[SurfaceColours | None]:
    """The colours of each mesh, plain ones too; None, with a warning, where they cannot be used. A
    texture is decoded once, however many meshes share it."""
    known: _Textures = {}
    found = []
    for mesh in meshes:
        try:
            colours = _surface_colours(mesh, known)
            if colours is not None and len(colours) != len(mesh.faces):
                raise ValueError(f"{len(colours)} for {len(mesh.faces)} faces")
        except Exception as error:  # files may hold anything
            warnings.warn(
                f"the mesh's colours cannot be used ({error}); it is drawn in grey", stacklevel=2
            )
            colours = None
        found.append(colours)
    return found


def surface_colours(mesh: Any) -> SurfaceColours | None:
    """The colours of a ``trimesh.Trimesh``, or None where it has none; transparent texels are
    white. They come from ``mesh.metadata["colours"]``, where :func:`load_mesh` keeps them, else
    from ``mesh.visual``.

    Example:
        >>> from curvireg_torch.synthetic import example_mesh
        >>> mesh = example_mesh(painted=True)
        >>> len(surface_colours(mesh)) == len(mesh.faces)
        True
    """
    return _surface_colours(mesh, {})


def _surface_colours(mesh: Any, known: _Textures) -> SurfaceColours | None:
    colours = mesh.metadata.get("colours")
    if isinstance(colours, SurfaceColours) and len(colours) == len(mesh.faces):
        return colours
    visual = mesh.visual
    faces = np.asarray(mesh.faces)
    plain = SurfaceColours.plain(len(faces))
    if visual.kind == "face":
        corners = np.repeat(np.asarray(visual.face_colors, np.uint8)[:, None, :3], 3, axis=1)
        return replace(plain, corners=corners)
    if visual.kind == "vertex":
        return replace(plain, corners=np.asarray(visual.vertex_colors, np.uint8)[faces][..., :3])
    if visual.kind != "texture":
        return None
    material = visual.material
    image = getattr(material, "image", None)  # beside an image, exporters of OBJ write any colour
    image = getattr(material, "baseColorTexture", None) if image is None else image
    factor = getattr(material, "baseColorFactor", None)
    if factor is None:
        colour = material.main_color[:3]
    else:  # linear, as factors in glTF are
        linear = np.asarray(factor[:3], np.float64) / 255
        colour = np.asarray((255 * srgb(linear)).round(), np.uint8)
    texture = None if image is None or visual.uv is None else _decoded(image, known)
    if texture is not None:
        tint = SurfaceColours.plain(len(faces), (_PLAIN,) * 3 if factor is None else colour)
        uv = np.nan_to_num(np.asarray(visual.uv, np.float32), posinf=0.0, neginf=0.0)[faces][
            ..., :2
        ]
        return SurfaceColours(tint.corners, uv, np.zeros(len(faces), np.int32), (texture,))
    unset = factor is None and tuple(colour) == _UNSET
    return None if unset else SurfaceColours.plain(len(faces), colour)


def _decoded(image: Any, known: _Textures) -> NDArray[np.uint8] | None:
    """(h, w, 3) uint8 of a PIL image, decoded once; None, with a warning, if it cannot be used."""
    if id(image) not in known:
        texture = None
        try:
            texture = _texture(image)
        except Exception as error:  # decoders raise anything
            message = (
                f"a texture cannot be read ({error}); its faces are drawn in their plain colour"
            )
            warnings.warn(message, stacklevel=2)
        known[id(image)] = image, texture
    return known[id(image)][1]


def texture_pixels(content: bytes, most: int) -> tuple[NDArray[np.uint8], int]:
    """(h, w, 3) uint8 of a picture's file, reduced, and how many pixels it has: ``most`` at
    most."""
    with open_picture(content) as image:
        count = image.width * image.height
        if count > most:
            raise ValueError(f"the textures have more than {MAX_TEXTURE_PIXELS:,} pixels together")
        return _texture(image), count


def _texture(image: Any) -> NDArray[np.uint8]:
    """The pixels of a PIL image; of one that is not decoded yet, only in the formats of
    photographs."""
    if image.format is not None and image.format not in PICTURE_STARTS:
        raise ValueError(f"the format {image.format} is not read")
    if image.width * image.height > MAX_IMAGE_PIXELS:
        raise ValueError(f"{image.width} x {image.height} px are too many")
    if image.width * image.height > LARGE and image.mode in ("L", "RGB", "RGBA"):
        image = image.reduce(4)  # before it is converted, which takes four times the memory
    image = image.convert("RGBA")
    shrink = TEXTURE_SIDE / max(image.size)
    if shrink < 1:
        size = max(1, round(image.width * shrink)), max(1, round(image.height * shrink))
        image = image.resize(size, BOX)  # means of areas
    rgba = np.asarray(image, np.uint8)
    alpha = rgba[..., 3:].astype(np.float32) / 255
    return np.asarray((rgba[..., :3] * alpha + 255 * (1 - alpha)).round(), np.uint8)

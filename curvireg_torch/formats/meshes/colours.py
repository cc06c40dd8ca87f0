"""Surface colours of a mesh, from its textures, materials, faces or vertices."""

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from PIL.Image import Resampling

from ...errors import MAX_IMAGE_PIXELS, MAX_TEXTURE_PIXELS
from ...utils.arrays import Array, Bytes, Floats, Indices, Singles
from ...utils.pictures import PICTURE_STARTS, open_picture
from ...utils.srgb import srgb

BOX = Resampling.BOX
TEXTURE_SIDE = 512  # Textures are reduced to this longer side in px; views are smaller
LARGE = 1 << 25  # Pixels of a texture that is reduced in its own mode first
_UNSET = (102, 102, 102)  # trimesh's colour for a material without one
# by their ids, images, which so keep them, and pixels
_Textures = dict[int, tuple[Any, Bytes | None]]


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

    corners: Bytes
    uv: Singles
    texture: Indices
    textures: tuple[Bytes, ...] = ()

    def __len__(self) -> int:
        return len(self.corners)

    def __getitem__(self, index: Any) -> "SurfaceColours":
        """The colours of some of the faces."""
        return SurfaceColours(
            self.corners[index], self.uv[index], self.texture[index], self.textures
        )

    def check(self, faces: int) -> None:
        """Raise ValueError unless these are valid colours of ``faces`` faces."""

        def fits(x: Array, shape: tuple[int, ...], dtype: type) -> bool:
            return x.shape == shape and x.dtype == dtype

        is_valid = (
            fits(self.corners, (faces, 3, 3), np.uint8)
            and fits(self.uv, (faces, 3, 2), np.float32)
            and fits(self.texture, (faces,), np.int32)
            and all(x.size and fits(x, (*x.shape[:2], 3), np.uint8) for x in self.textures)
            and np.isfinite(self.uv).all()
            and -1 <= self.texture.min() <= self.texture.max() < len(self.textures)
        )
        if not is_valid:
            raise ValueError("colours that do not match the mesh")

    @classmethod
    def plain(cls, faces: int, colour: Any = (255, 255, 255)) -> "SurfaceColours":
        """One colour everywhere, white by default, in arrays that a reader may change."""
        corners = np.full((faces, 3, 3), colour, np.uint8)
        return cls(corners, np.zeros((faces, 3, 2), np.float32), np.full(faces, -1, np.int32))

    def with_texture(self, faces: Any, texture: Bytes, uv: Floats | Singles) -> "SurfaceColours":
        """These colours, whose arrays change, with a texture on ``faces``, an index, at the
        coordinates (N, 3, 2) of their corners."""
        self.uv[faces] = np.nan_to_num(uv, posinf=0.0, neginf=0.0)
        self.texture[faces] = len(self.textures)
        return replace(self, textures=(*self.textures, texture))

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


def byte_colours(fractions: Any) -> Bytes:
    """Colours in [0, 1], beyond which they are clipped, as uint8."""
    return np.asarray(np.round(255.0 * np.clip(fractions, 0.0, 1.0)), np.uint8)


def colours_of_parts(meshes: Iterable[Any]) -> list[SurfaceColours | None]:
    """The colours of each mesh, plain ones too; None, with a warning, where they cannot be used. A
    texture is decoded once, however many meshes share it."""
    known: _Textures = {}
    found = []
    for mesh in meshes:
        try:
            colours = _surface_colours(mesh, known)
        except Exception as error:  # files may hold anything
            warnings.warn(
                f"the mesh's colours cannot be used ({error}); it is drawn in grey", stacklevel=2
            )
            colours = None
        found.append(colours)
    return found


def _surface_colours(mesh: Any, known: _Textures) -> SurfaceColours | None:
    """The colours of a ``trimesh.Trimesh``, or None where it has none; transparent texels are
    white."""
    visual = mesh.visual
    faces = np.asarray(mesh.faces)
    found = SurfaceColours.plain(len(faces))
    if visual.kind == "face":
        found.corners[:] = np.asarray(visual.face_colors, np.uint8)[:, None, :3]
        return found
    if visual.kind == "vertex":
        found.corners[:] = np.asarray(visual.vertex_colors, np.uint8)[faces][..., :3]
        return found
    if visual.kind != "texture":
        return None
    material = visual.material
    image = getattr(material, "image", None)  # beside an image, exporters of OBJ write any colour
    image = getattr(material, "baseColorTexture", None) if image is None else image
    factor = getattr(material, "baseColorFactor", None)
    texture = None if image is None or visual.uv is None else _decoded(image, known)
    if factor is not None:  # linear, as factors in glTF are
        found.corners[:] = byte_colours(srgb(np.asarray(factor[:3], np.float64) / 255))
    elif texture is None:
        colour = tuple(material.main_color[:3])
        if colour == _UNSET:
            return None
        found.corners[:] = colour
    if texture is None:
        return found
    uv = np.asarray(visual.uv, np.float32)[faces][..., :2]
    return found.with_texture(slice(None), texture, uv)


def _decoded(image: Any, known: _Textures) -> Bytes | None:
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


def texture_pixels(content: bytes, most: int) -> tuple[Bytes, int]:
    """(h, w, 3) uint8 of a picture's file, reduced, and how many pixels it has: ``most`` at
    most."""
    with open_picture(content) as image:
        count = image.width * image.height
        if count > most:
            raise ValueError(f"the textures have more than {MAX_TEXTURE_PIXELS:,} pixels together")
        return _texture(image), count


def _texture(image: Any) -> Bytes:
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

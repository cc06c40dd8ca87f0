"""Masks of objects: white on black, by a label, by transparency."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import ImageError, InvalidInputError, MissingFileError
from ..utils.aliases import PathName
from ..utils.arrays import Array, Singles
from ..utils.choices import listed
from .boxes import PictureSize
from .pictures import as_in_file, opened_picture, oriented

if TYPE_CHECKING:
    from PIL.Image import Image

MAX_LABEL = 127  # of a picture of 8 bits that counts as one of labels: brighter ones are white
MAX_LISTED = 12  # labels that a message names; a palette of more is none of labels
VOID = 255  # index of a palette of labels for pixels that are of none, as borders of PASCAL VOC


def mask_file(mask: PathName) -> tuple[Path, int | None]:
    """The file and the label of ``FILE`` or ``FILE:LABEL``.

    Example:
        >>> mask_file("labels.png:2")
        (PosixPath('labels.png'), 2)
    """
    front, colon, label = str(mask).rpartition(":")
    if colon and label.isdecimal() and not os.path.isfile(mask):
        return Path(front), int(label)
    return Path(mask), None


def existing_mask(mask: PathName) -> tuple[Path, int | None]:
    """:func:`mask_file` of a file that exists; refuses one that does not, and a folder."""
    file, label = mask_file(mask)
    if file.is_dir():
        raise InvalidInputError("a folder; give the file of one mask", subject=mask)
    if not file.is_file():
        raise MissingFileError("no such file; check the path of the mask", subject=mask)
    return file, label


def read_mask(mask: PathName) -> Singles:
    """(H, W) in [0, 1], 1 = object, of a picture in which the object is white, or one of several
    labels.

    Args:
        mask: ``FILE``, or ``FILE:LABEL`` for the pixels of that value: of the palette's index, of
            grey of 8 or 16 bits. Without a label: an alpha channel that varies is the mask; else
            the brightest channel; pixels of a single dark value beside 0, or of a single index of
            a palette beside 0 and 255, are the object.

    Raises:
        MissingFileError: the file does not exist.
        ImageError: it cannot be read.
        InvalidInputError: no pixel has the label, or none is chosen and there are several, or more
            pixels of labels than of white.

    Example:
        >>> import tempfile
        >>> from PIL import Image
        >>> file = Path(tempfile.mkdtemp(), "labels.png")
        >>> Image.fromarray(np.array([[0, 2], [5, 0]], np.uint8)).save(file)
        >>> read_mask(f"{file}:2").tolist()
        [[0.0, 1.0], [0.0, 0.0]]
    """
    file, label = existing_mask(mask)
    with opened_picture(file) as (image, orientation, _):
        values, largest = _values(image, label is not None)
        values = oriented(as_in_file(values, image, orientation), orientation)
    if label is not None:
        return _labelled(values, label, file)
    if values.dtype == np.float32:
        return values
    try:
        return mask_of_values(values, largest)
    except InvalidInputError as error:
        raise error.with_subject(mask) from error


def mask_as_shown(mask: Any, picture: PictureSize) -> Any:
    """The mask of a photograph, a path or (H, W) values, turned as its EXIF orientation says where
    its shape is that of the pixels in the file; other ones as they are."""
    is_square = picture.shown[0] == picture.shown[1]
    if picture.orientation <= 4 or is_square or mask is None:
        return mask
    values = read_mask(mask) if isinstance(mask, str | os.PathLike) else np.asarray(mask)
    if values.shape != picture.stored:
        return values
    return np.array(oriented(values, picture.orientation))


def mask_of_values(values: Array, largest: int) -> Singles:
    """(H, W) in [0, 1] of a picture's values, of which ``largest`` is white; of a label image, of
    its only label."""
    limit = largest * MAX_LABEL / 255
    is_label = (values > 0) & (values < largest)
    labels = np.unique(values[is_label])
    white_pixels = int((values == largest).sum())
    has_white = white_pixels > 0
    # an edge that is soft, or was compressed, has fewer pixels than the object
    if labels.max(initial=0) > limit or (has_white and is_label.sum() < white_pixels):
        return np.asarray(values / largest, dtype=np.float32)
    if len(labels) > 1 or has_white:
        white = "white pixels, which may be void, and" if has_white else "no white pixel, but"
        raise InvalidInputError(
            f"mask: {white} labels {listed(labels, MAX_LISTED)}; choose one as FILE:LABEL, or "
            "mask == LABEL"
        )
    return np.asarray(is_label, dtype=np.float32)


def _labelled(values: Array, label: int, file: Path) -> Singles:
    chosen = np.equal(values, label)
    if not chosen.any():
        labels = listed(np.unique(values), MAX_LISTED)
        raise InvalidInputError(
            f"mask: no pixel has the label {label}; it has {labels}", subject=file
        )
    return np.asarray(chosen, dtype=np.float32)


def _values(image: "Image", is_of_labels: bool) -> tuple[Array, int]:
    """(H, W) values of an open picture, and the value of white; those of transparency are a mask in
    float32."""
    is_palette_of_labels = image.mode == "P" and len(np.unique(np.asarray(image))) <= MAX_LISTED
    if image.has_transparency_data and not (is_of_labels or is_palette_of_labels):
        alpha = np.asarray(image.convert("RGBA"))[..., 3]
        if alpha.min() != alpha.max():
            return np.asarray(alpha / alpha.max(), dtype=np.float32), 1
    if image.mode == "P":
        return (np.asarray(image), 255) if is_of_labels else _of_palette(image)
    if image.mode == "1":
        return np.asarray(image).astype(np.uint8), 1
    if image.mode == "I" or image.mode.startswith("I;16"):
        return np.asarray(image).astype(np.int64), 65535
    if image.mode == "F":
        raise ImageError("mask: expected whole numbers, got floating values; save it as PNG")
    return np.asarray(image.convert("RGB")).max(axis=2), 255


def _of_palette(image: "Image") -> tuple[Array, int]:
    """Brightness where a palette is that of grey, or black and white; else its indices, none of
    which is white."""
    indices = np.asarray(image)
    colours = np.asarray(image.convert("RGB"))
    brightest = colours.max(axis=2)
    is_black_and_white = bool(np.isin(brightest, (0, 255)).all()) and len(np.unique(indices)) <= 2
    if is_black_and_white or bool((colours == indices[..., None]).all()):
        return brightest, 255
    labels = np.where(indices == VOID, 0, indices)
    return (labels if labels.any() else indices), 65535

"""The EXIF orientation and focal length of a photograph.

This reader replaces Pillow's because :mod:`.image_headers` needs the offsets of TIFF entries, which Pillow hides.
"""

import struct
from dataclasses import dataclass

_FORMATS = {1: "B", 3: "H", 4: "I"}  # byte, short, long
_ORIENTATION, _EXIF_DIRECTORY, _FOCAL_35MM = 0x0112, 0x8769, 0xA405


class Directory:
    """The integer entries of one directory of a TIFF or EXIF block; ValueError if the block is damaged.

    ``next`` is the offset of the following directory, 0 after the last; ``offsets`` are those of the entries' values.
    """

    def __init__(self, block: bytes, offset: int | None = None) -> None:
        self._block = block
        self.order = {b"II": "<", b"MM": ">"}.get(block[:2], "")
        try:
            if not self.order or struct.unpack_from(self.order + "H", block, 2) != (42,):
                raise ValueError("not a TIFF block")
            if offset is None:
                (offset,) = struct.unpack_from(self.order + "I", block, 4)
            (count,) = struct.unpack_from(self.order + "H", block, offset)
            layout = self.order + "HHII"
            entries = [struct.unpack_from(layout, block, offset + 2 + 12 * i) for i in range(count)]
            (self.next,) = struct.unpack_from(self.order + "I", block, offset + 2 + 12 * count)
        except struct.error as error:
            raise ValueError("ends inside a directory") from error
        self.offsets = {tag: offset + 10 + 12 * i for i, (tag, *_) in enumerate(entries)}
        self._entries = {tag: (kind, count, value) for tag, kind, count, value in entries}

    def get(self, tag: int, default: int) -> int:
        """The first number of an entry; ``default`` if it is absent or not an integer."""
        kind, count, offset = self._entries.get(tag, (0, 0, 0))
        if kind not in _FORMATS or count < 1:
            return default
        layout = self.order + _FORMATS[kind]
        offset = self.offsets[tag] if struct.calcsize(layout) * count <= 4 else offset
        try:
            return int(struct.unpack_from(layout, self._block, offset)[0])
        except struct.error:
            return default


@dataclass(frozen=True)
class Exif:
    """``orientation``: 1 to 8, 1 = as stored. ``focal_35mm``: focal length of a 36 x 24 mm camera of the same view."""

    orientation: int = 1
    focal_35mm: float | None = None


def read_exif(block: bytes) -> Exif:
    """Read a TIFF block (the part after ``Exif\\0\\0``); a damaged block gives the defaults."""
    try:
        main = Directory(block)
        orientation = main.get(_ORIENTATION, 1)
        offset = main.get(_EXIF_DIRECTORY, 0)
        focal = Directory(block, offset).get(_FOCAL_35MM, 0) if offset else 0
    except ValueError:
        return Exif()
    return Exif(orientation if 1 <= orientation <= 8 else 1, float(focal) if focal > 0 else None)

import struct
import zlib


def exif(orientation, focal=0, order=">"):
    """A TIFF block with an orientation and, in its EXIF directory at byte 38, a 35 mm focal
    length."""
    start = {">": b"MM", "<": b"II"}[order] + struct.pack(order + "HI", 42, 8)
    main = struct.pack(order + "HHHIHHHHIII", 2, 274, 3, 1, orientation, 0, 0x8769, 4, 1, 38, 0)
    return start + main + struct.pack(order + "HHHIHHI", 1, 0xA405, 3, 1, focal, 0, 0)


def with_exif(path, block):
    """Put ``block`` into a JPEG or PNG that has none."""
    data = path.read_bytes()
    if path.suffix == ".jpg":
        body = b"Exif\0\0" + block
        path.write_bytes(
            data[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body + data[2:]
        )
    else:
        path.write_bytes(data[:33] + png_chunk(b"eXIf", block) + data[33:])


def png_chunk(kind, content):
    body = kind + content
    return struct.pack(">I", len(content)) + body + struct.pack(">I", zlib.crc32(body))

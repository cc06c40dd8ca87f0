"""How much of a file is read, in one place: files are others' and may be made to harm."""

__all__ = ["MAX_IMAGE_BYTES", "MAX_IMAGE_PIXELS", "MAX_IMAGE_SCANS", "MAX_POLYGON_CORNERS"]

MAX_IMAGE_BYTES = 1 << 28
"""Bytes of a photograph's file."""

MAX_IMAGE_PIXELS = 1 << 27
"""Width times height as the header says, before anything is decoded: 134 million."""

MAX_IMAGE_SCANS = 64
"""Passes over the picture in a progressive JPEG; encoders make about ten, and each takes as long as the picture."""

MAX_POLYGON_CORNERS = 2000
"""Corners of one face that is not convex; dividing it into triangles takes time with their square."""

"""How much of a file is read, in one place: files are others' and may be made to harm.

A file beyond a limit ends in an error that names it; nothing is cut in silence. Readers use no network and open no file
but the one named and, for glTF, buffers in its folder.
"""

__all__ = [
    "MAX_IMAGE_BYTES",
    "MAX_IMAGE_PIXELS",
    "MAX_IMAGE_SCANS",
    "MAX_MAT_BYTES",
    "MAX_MAT_DEPTH",
    "MAX_MAT_UNPACKED_BYTES",
    "MAX_MESH_BYTES",
    "MAX_MESH_COORDINATE",
    "MAX_MESH_DEPTH",
    "MAX_MESH_FACES",
    "MAX_MESH_LINES",
    "MAX_MESH_PARTS",
    "MAX_POLYGON_CORNERS",
    "MAX_POLYGON_WORK",
    "MAX_TABLE_BYTES",
    "MAX_VIEWER_FACES",
    "MAX_VIEWER_PAGES",
    "MAX_VIEWER_SECONDS",
]

MAX_IMAGE_BYTES = 1 << 28
"""Bytes of a photograph's file."""

MAX_IMAGE_PIXELS = 1 << 27
"""Width times height as the header says, before anything is decoded: 134 million."""

MAX_IMAGE_SCANS = 64
"""Passes over the picture in a progressive JPEG; encoders make about ten, and each takes as long as the picture."""

MAX_MESH_BYTES = 1 << 29
"""Bytes of a mesh file, and of all the buffers of a glTF file together."""

MAX_MESH_FACES = 10_000_000
"""Triangles of a mesh, every placed copy of a part counted."""

MAX_MESH_LINES = 50_000_000
"""Lines of a text file with faces of more than three corners; each takes some 50 bytes more than its text."""

MAX_MESH_COORDINATE = 1e12
"""Distance of a vertex from the origin along an axis, in the file's unit; squares and products stay finite."""

MAX_MESH_PARTS = 10_000
"""Placed parts of a glTF scene."""

MAX_MESH_DEPTH = 200
"""Nodes from the root of a glTF scene to a part."""

MAX_POLYGON_CORNERS = 2000
"""Corners of one face that is not convex; dividing it into triangles takes time with their square."""

MAX_POLYGON_WORK = 20_000_000
"""Squares of the corners of all faces that are not convex: of a million quads, or of five faces of 2000 corners."""

MAX_TABLE_BYTES = 1 << 25
"""Bytes of a JSON or CSV file: 32 MiB; a row of a CSV of poses takes up to 60 times as much memory as text."""

MAX_MAT_BYTES = 1 << 24
"""Bytes of a MATLAB annotation file."""

MAX_MAT_UNPACKED_BYTES = 1 << 24
"""Bytes that all of its compressed variables unpack to; a struct in them may take 60 times as much memory."""

MAX_MAT_DEPTH = 16
"""Structs within structs of a MATLAB annotation file."""

MAX_VIEWER_FACES = 300_000
"""Triangles that the viewer sends to the browser for its 3D view, 96 bytes each; of larger meshes it says so."""

MAX_VIEWER_PAGES = 8
"""Pages open at a time, each with a photograph, a mesh and a bank in memory."""

MAX_VIEWER_SECONDS = 600.0
"""Time that a registration in the viewer may take."""

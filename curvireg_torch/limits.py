"""Limits on what is read: input files are untrusted.

A file beyond a limit is refused with an error that names the limit; nothing is truncated silently. Readers use no
network, and open only the named file and, for meshes, files that it names in its folder.
"""

MAX_IMAGE_BYTES = 1 << 28
"""Bytes of an image file."""

MAX_IMAGE_PIXELS = 1 << 27
"""Width times height in the header, before anything is decoded: 134 million."""

MAX_IMAGE_SCANS = 64
"""Scans of a progressive JPEG. Encoders write about ten, and each takes as long to decode as the whole picture."""

MAX_BOX_COORDINATE = 1e6
"""Distance of a box's corner from the origin, px; no image is that wide."""

MAX_MESH_BYTES = 1 << 29
"""Bytes of a mesh file, and of all the buffers of a glTF file together."""

MAX_MESH_FACES = 10_000_000
"""Triangles of a mesh; every copy of a part counts."""

MAX_MESH_LINES = 50_000_000
"""Lines of a text file with polygons; each takes some 50 bytes more than its text."""

MAX_MESH_COORDINATE = 1e12
"""Distance of a vertex from the origin along an axis, in the file's unit; squares and products stay finite."""

MIN_MESH_EXTENT = 1e-6
"""Longest side of a mesh's box, in the file's unit; of smaller ones single precision computes no views."""

MAX_MESH_PARTS = 10_000
"""Nodes with a mesh in a glTF scene."""

MAX_MESH_DEPTH = 200
"""Nodes from the root of a glTF scene to a part."""

MAX_POLYGON_CORNERS = 2000
"""Corners of a concave face; the time of its division into triangles grows with their square."""

MAX_POLYGON_WORK = 20_000_000
"""Sum of squared corners of all concave faces: a million quads, or five faces of 2000 corners."""

MAX_TABLE_BYTES = 1 << 25
"""Bytes of a JSON or CSV file, 32 MiB; rows of a CSV of poses take up to 60 times as much memory."""

MAX_MAT_BYTES = 1 << 24
"""Bytes of a MATLAB annotation file."""

MAX_MAT_UNPACKED_BYTES = 1 << 24
"""Bytes that all compressed variables of a MATLAB file unpack to; structs may take 60 times as much memory."""

MAX_MAT_DEPTH = 16
"""Nesting of structs in a MATLAB annotation file."""

MAX_VIEWER_FACES = 300_000
"""Triangles that the viewer sends to the browser, 96 bytes each; for larger meshes it shows a notice."""

MAX_VIEWER_PAGES = 8
"""Pages of the viewer, open or left, each with a photograph, a mesh and a bank in memory; a new one replaces the page
that was left first."""

MAX_VIEWER_BYTES = 1 << 30
"""Bytes of the files of a page of the viewer, those on their way included."""

MAX_VIEWER_UPLOADS = 8
"""Files that a page of the viewer receives at a time."""

MAX_ARCHIVE_FILES = 1000
"""Files in a zip archive with a mesh and its parts."""

MAX_VIEWER_SECONDS = 600.0
"""Time limit of a registration in the viewer."""

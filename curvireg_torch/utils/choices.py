"""Names that a user may choose from. The command line lists them without importing torch."""

RENDERER_NAMES = ("auto", "embree", "pyrender", "torch")
"""Renderers."""

DEFAULT = "learned"
"""The default preset."""

PRESET_NAMES = ("learned", "classical", "fast", "paper")
"""Of :data:`curvireg_torch.pipeline.PRESETS`."""

UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
"""Metres per unit."""

IMAGES = (".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".pnm", ".ppm", ".tif", ".tiff", ".webp")
VIDEOS = (".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".webm")
MESHES = (".obj", ".ply", ".stl", ".off", ".glb", ".gltf")
MESHES_AND_BANKS = (*MESHES, ".safetensors")
"""Suffixes of file names, in lower case."""

MESH_KINDS = ("exact", "similar")
"""Whether a mesh is that of the photographed object itself, or of another one of its kind."""

SIDE_NAMES = ("front", "front-right", "right", "back-right", "back", "back-left", "left", "front-left")
"""Sides of an object, every 45 degrees of azimuth from 0."""

UP_AXES = {
    "x": [[0, 0, -1], [0, 1, 0], [1, 0, 0]],
    "y": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "z": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "-x": [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
    "-y": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "-z": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
}
"""Axis that points up, and the rotation by quarter turns that brings it to z."""

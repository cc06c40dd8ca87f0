"""Reader of AC3D files (.ac, .acc), the format of FlightGear's and TORCS's models."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

POLYGON, STRIP = 0, 4
"""AC3D surface types with an area; the others are lines."""

INVISIBLE = re.compile(
    r"light|shadow|glow|prop.?dis[ck]|propfast|disc|flare|beam|contrail|strobe|beacon|wake|navl|halo"
)
"""Names of AC3D objects that a photograph does not show: glow of lamps, spinning propellers, drawn shadows."""


@dataclass
class Part:
    """Triangles of one material and texture: corners (F, 3, 3) in the file's frame, texture coordinates (F, 3, 2)."""

    colour: list[float]
    gloss: float
    texture: str | None
    corners: np.ndarray
    uv: np.ndarray


def read_ac3d(path: Path) -> list[Part]:
    """Read all objects of an AC3D file in one frame, grouped by material and texture.

    Raises:
        ValueError: the file is not AC3D, malformed or truncated.
    """
    lines = iter(path.read_text(encoding="latin1").splitlines())
    if not next(lines, "").startswith("AC3D"):
        raise ValueError(f"{path}: not an AC3D file")
    materials: list[tuple[list[float], float]] = []
    found: dict[tuple[int, str | None], list[np.ndarray]] = {}
    try:
        for line in lines:
            if line.startswith("MATERIAL"):
                colour, gloss = re.search(r"rgb\s+(\S+)\s+(\S+)\s+(\S+)", line), re.search(r"spec\s+(\S+)", line)
                materials.append(([float(x) for x in colour.groups()], float(gloss[1])))
            elif line.startswith("OBJECT"):
                _read_object(lines, np.eye(3), np.zeros(3), found)
    except (StopIteration, AttributeError, IndexError, TypeError) as error:
        raise ValueError(f"{path}: truncated or malformed") from error
    parts = []
    for (number, texture), triangles in found.items():
        columns = np.array(triangles)
        colour, gloss = materials[number] if number < len(materials) else ([0.6] * 3, 0.0)
        parts.append(Part(colour, gloss, texture, columns[..., :3], columns[..., 3:]))
    return parts


def _read_object(lines: Iterator[str], R: np.ndarray, t: np.ndarray, found: dict) -> None:
    """Read one object and its children; R and t are the pose of the parent."""
    name, texture, repeat, offset = "", None, np.ones(2), np.zeros(2)
    rotation, translation, points, surfaces = np.eye(3), np.zeros(3), np.zeros((0, 3)), []
    key = ""
    while key != "kids":
        words = re.findall(r'"[^"]*"|\S+', next(lines))
        key = words[0] if words else ""
        if key == "name" and len(words) > 1:
            name = words[1].strip('"').lower()
        elif key == "data":
            length, read = int(words[1]), 0
            while read < length:
                read += len(next(lines)) + 1
        elif key == "texture" and texture is None:  # the first of several layers is the paint
            texture = words[1].strip('"').replace("\\", "/")
        elif key == "texrep":
            repeat = np.array(words[1:3], float)
        elif key == "texoff":
            offset = np.array(words[1:3], float)
        elif key == "rot":
            rotation = np.array(words[1:10], float).reshape(3, 3).T
        elif key == "loc":
            translation = np.array(words[1:4], float)
        elif key == "numvert":
            points = np.array([next(lines).split()[:3] for _ in range(int(words[1]))], float).reshape(-1, 3)
        elif key == "numsurf":
            surfaces = [_read_surface(lines) for _ in range(int(words[1]))]
    R, t = R @ rotation, R @ translation + t
    points = points @ R.T + t
    for kind, material, corners in surfaces if not INVISIBLE.search(name) else []:
        rows = np.array([[*points[i], *(uv * repeat + offset)] for i, uv in corners])
        for k in range(len(corners) - 2 if kind in (POLYGON, STRIP) else 0):
            strip = [k, k + 1, k + 2] if k % 2 == 0 else [k + 1, k, k + 2]
            triangle = [0, k + 1, k + 2] if kind == POLYGON else strip
            found.setdefault((material, texture), []).append(rows[triangle])
    for _ in range(int(words[1])):
        if any(line.startswith("OBJECT") for line in lines):  # some files declare more children than they have
            _read_object(lines, R, t, found)


def _read_surface(lines: Iterator[str]) -> tuple[int, int, list[tuple[int, np.ndarray]]]:
    """Type, material number, and corners as (vertex number, texture coordinates)."""
    kind, material = POLYGON, 0
    while True:
        words = next(lines).split()
        if words[:1] == ["SURF"]:
            kind = int(words[1], 16) & 0xF
        elif words[:1] == ["mat"]:
            material = int(words[1])
        elif words[:1] == ["refs"]:
            rows = [next(lines).split() for _ in range(int(words[1]))]
            return kind, material, [(int(row[0]), np.array(row[1:3], float)) for row in rows]

"""Triangles of AC3D files (.ac, .acc), as FlightGear's and TORCS's models are written."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

POLYGON, STRIP = 0, 4
"""Kinds of surfaces that have an inside; the others are lines."""

_NO_PART = re.compile(r"light|shadow|glow|prop.?dis[ck]|propfast|disc|flare|beam|contrail|strobe|beacon|wake|navl|halo")
"""Names of objects that a photograph does not show: lamps' glow, turning propellers, shadows drawn below."""


@dataclass
class Part:
    """Triangles of one material and texture: corners (F, 3, 3) in the file's frame, places in the texture (F, 3, 2)."""

    colour: list[float]
    gloss: float
    texture: str | None
    corners: np.ndarray
    places: np.ndarray


def read(path: Path) -> list[Part]:
    """The file's objects in one frame, by material and texture.

    Raises:
        ValueError: not an AC3D file, or one that ends within an object.
    """
    lines = iter(path.read_text(encoding="latin1").splitlines())
    if not next(lines, "").startswith("AC3D"):
        raise ValueError(f"{path}: not an AC3D file")
    materials: list[tuple[list[float], float]] = []
    found: dict[tuple[int, str | None], list[np.ndarray]] = {}
    try:
        for line in lines:
            if line.startswith("MATERIAL"):
                colour = re.search(r"rgb\s+(\S+)\s+(\S+)\s+(\S+)", line)
                gloss = re.search(r"spec\s+(\S+)", line)
                materials.append(([float(x) for x in colour.groups()], float(gloss[1])))
            elif line.startswith("OBJECT"):
                _object(lines, np.eye(3), np.zeros(3), found)
    except (StopIteration, AttributeError, IndexError, TypeError) as error:
        raise ValueError(f"{path}: cut short or malformed") from error
    parts = []
    for (number, texture), triangles in found.items():
        both = np.array(triangles)
        colour, gloss = materials[number] if number < len(materials) else ([0.6] * 3, 0.0)
        parts.append(Part(colour, gloss, texture, both[..., :3], both[..., 3:]))
    return parts


def _object(lines: Iterator[str], R: np.ndarray, t: np.ndarray, found: dict) -> None:
    """One object with its children, at the frame of its parent."""
    name, texture, repeat, offset = "", None, np.ones(2), np.zeros(2)
    turn, shift, points, surfaces = np.eye(3), np.zeros(3), np.zeros((0, 3)), []
    while True:
        words = re.findall(r'"[^"]*"|\S+', next(lines))
        key = words[0] if words else ""
        if key == "name" and len(words) > 1:
            name = words[1].strip('"').lower()
        elif key == "data":
            length, got = int(words[1]), 0
            while got < length:
                got += len(next(lines)) + 1
        elif key == "texture" and texture is None:  # of several layers the first is the paint
            texture = words[1].strip('"').replace("\\", "/")
        elif key == "texrep":
            repeat = np.array(words[1:3], float)
        elif key == "texoff":
            offset = np.array(words[1:3], float)
        elif key == "rot":
            turn = np.array(words[1:10], float).reshape(3, 3).T
        elif key == "loc":
            shift = np.array(words[1:4], float)
        elif key == "numvert":
            points = np.array([next(lines).split()[:3] for _ in range(int(words[1]))], float).reshape(-1, 3)
        elif key == "numsurf":
            surfaces = [_surface(lines) for _ in range(int(words[1]))]
        elif key == "kids":
            break
    R, t = R @ turn, R @ shift + t
    placed = points @ R.T + t
    for kind, material, corners in surfaces if not _NO_PART.search(name) else []:
        where = np.array([[*placed[i], *(uv * repeat + offset)] for i, uv in corners])
        for k in range(len(corners) - 2):
            if kind == POLYGON:
                three = [0, k + 1, k + 2]
            elif kind == STRIP:
                three = [k, k + 1, k + 2] if k % 2 == 0 else [k + 1, k, k + 2]
            else:
                break
            found.setdefault((material, texture), []).append(where[three])
    for _ in range(int(words[1])):
        if any(line.startswith("OBJECT") for line in lines):  # files promise more children than they have
            _object(lines, R, t, found)


def _surface(lines: Iterator[str]) -> tuple[int, int, list[tuple[int, np.ndarray]]]:
    """Kind, number of the material, and numbers of the corners with their places in the texture."""
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

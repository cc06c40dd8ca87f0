"""A map of the directions that an object is seen from, and the allowed part of it: it needs no NiceGUI."""

from collections.abc import Mapping
from typing import Any

from ..geometry.pose_prior import SIDES

__all__ = ["HEIGHT", "WIDTH", "limits_of_box", "map_svg"]

WIDTH, HEIGHT = 360, 180
"""Size of the map in px, one for each degree: the front is in the middle, azimuths grow to the right."""


def limits_of_box(box: tuple[float, float, float, float]) -> dict[str, Any]:
    """Arguments ``azimuth`` and ``elevation`` of a prior; None where a box x0, y0, x1, y1 on the map is as large as it.

    Example:
        >>> limits_of_box((150, 45, 210, 180))
        {'azimuth': (330, 30), 'elevation': (-90, 45)}
    """
    x0, y0, x1, y1 = (round(min(max(v, 0.0), end)) for v, end in zip(box, (WIDTH, HEIGHT) * 2, strict=True))
    return {
        "azimuth": None if x1 - x0 >= WIDTH else ((x0 + 180) % 360, (x1 + 180) % 360),
        "elevation": None if y1 - y0 >= HEIGHT else (90 - y1, 90 - y0),
    }


def map_svg(limits: Mapping[str, Any]) -> str:
    """The map as SVG, with the limits on azimuth and elevation; a range that goes through the back is in two parts."""
    low, high = limits.get("azimuth") or (180.0, 540.0)
    start = (low + 180.0) % 360.0
    width = 360.0 if abs(high - low) >= 360.0 else (high - low) % 360.0
    bottom, top = limits.get("elevation") or (-90.0, 90.0)
    shape = f"y='{90 - top:g}' height='{max(top - bottom, 0.0):g}' fill='#1976d2' fill-opacity='0.35' stroke='#1976d2'"
    parts = [f"<rect width='{WIDTH}' height='{HEIGHT}' fill='#f5f5f5' stroke='#9e9e9e'/>"]
    parts += [f"<rect x='{x:g}' width='{w:g}' {shape}/>" for x, w in _within_map(start, width)]
    for name, azimuth in SIDES.items():
        x = (azimuth + 180.0) % 360.0
        parts.append(f"<line x1='{x:g}' x2='{x:g}' y1='0' y2='{HEIGHT}' stroke='#bdbdbd'/>")
        if "-" not in name:
            parts.append(f"<text x='{x + 3:g}' y='102' font-size='11'>{name}</text>")
    parts.append(f"<line x1='0' x2='{WIDTH}' y1='90' y2='90' stroke='#bdbdbd'/>")
    for y, text in ((12, "from above"), (HEIGHT - 4, "from below")):
        parts.append(f"<text x='{WIDTH - 58}' y='{y}' font-size='11'>{text}</text>")
    return "".join(parts)


def _within_map(start: float, width: float) -> list[tuple[float, float]]:
    """Start and width of the parts of a range that may go beyond the right border."""
    beyond = start + width - WIDTH
    return [(start, width)] if beyond <= 0.0 else [(start, width - beyond), (0.0, beyond)]

"""Draw docs/images/viewpoints.png: what azimuth, elevation, theta and the sides of an object mean.

python scripts/viewpoints_figure.py [--out FILE]
"""

import argparse
from pathlib import Path

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from curvireg_torch.geometry import rotation_from_viewpoint
from curvireg_torch.geometry.pose_prior import SIDES, object_frame
from curvireg_torch.matching import ViewDescriber
from curvireg_torch.mesh.mesh import mesh_radius
from curvireg_torch.settings import BankSettings
from curvireg_torch.synthetic import example_mesh
from scripts._shared import REPOSITORY

FRONTS = {"z": ("-y", "x", "y", "-x"), "y": ("z", "x", "-z", "-x")}
"""Front axes for each up axis, the default first."""

COLOURS = {"x": "#d62728", "y": "#2ca02c", "z": "#1f77b4"}
ELEVATIONS, THETAS = (-30, 0, 45, 90), (-30, 0, 30, 180)


def pictures(viewpoints: list[tuple[float, float, float]]) -> Tensor:
    """(N, H, W) shaded views of the truck."""
    mesh = example_mesh()
    rotations = torch.stack([rotation_from_viewpoint(*torch.tensor(v, dtype=torch.float64)) for v in viewpoints])
    distances = torch.full((len(viewpoints),), 6.0 * mesh_radius(mesh), dtype=torch.float64)
    return ViewDescriber(mesh, BankSettings(image_size=192)).shaded(rotations, distances)[:, 0]


def axes_from_above(up: str, front: str) -> dict[str, tuple[float, float]]:
    """Where the mesh file's horizontal axes point on a plan with the front at the bottom: right, and towards the top.

    Example:
        >>> axes_from_above("z", "-y")
        {'x': (1.0, 0.0), 'y': (0.0, 1.0)}
    """
    columns = object_frame(up, front).round().T.tolist()
    return {name: (x + 0.0, y + 0.0) for name, (x, y, z) in zip("xyz", columns, strict=True) if z == 0.0}


def draw_plan(ax: Axes, picture: Tensor, up: str, front: str) -> None:
    ax.imshow(picture.numpy(), cmap="gray", vmin=0, vmax=1, extent=(-0.75, 0.75, -0.75, 0.75))
    for (x, y), azimuth in zip([(0, -1), (1, 0), (0, 1), (-1, 0)], (0, 90, 180, 270), strict=True):
        ax.text(1.05 * x, 1.05 * y, f"{azimuth}", fontsize=8, ha="center", va="center")
    for name, (x, y) in axes_from_above(up, front).items():
        ax.annotate("", (0.65 * x, 0.65 * y), (0, 0), arrowprops={"arrowstyle": "->", "color": COLOURS[name], "lw": 2})
        ax.text(0.75 * x, 0.75 * y, name, color=COLOURS[name], ha="center", va="center", weight="bold")
    default = " (default)" if front == FRONTS[up][0] else ""
    ax.set_title(f"{up} up\nfront {front}{default}", fontsize=9)
    ax.set(xlim=(-1.2, 1.2), ylim=(-1.2, 1.2))
    ax.axis("off")


def viewpoints_figure() -> Figure:
    """Sides, elevations and in-plane rotations of a truck; below, the azimuths from above for each front axis."""
    views: dict[str, tuple[float, float, float]] = {}
    views |= {f"{name}\nazimuth {azimuth:g}": (azimuth, 20.0, 0.0) for name, azimuth in SIDES.items()}
    views |= {f"azimuth 45\nelevation {elevation}": (45.0, elevation, 0.0) for elevation in ELEVATIONS}
    views |= {f"azimuth 45\ntheta {theta}": (45.0, 20.0, theta) for theta in THETAS}
    *shown, above = pictures([*views.values(), (0.0, 90.0, 0.0)])
    figure = Figure(figsize=(12, 5.4), dpi=100, layout="constrained")
    axes = figure.subplots(3, 8)
    for ax, caption, picture in zip(axes[:2].flat, views, shown, strict=True):
        ax.imshow(picture.numpy(), cmap="gray", vmin=0, vmax=1)
        ax.set_title(caption, fontsize=9)
        ax.axis("off")
    plans = [(up, front) for up, fronts in FRONTS.items() for front in fronts]
    for ax, (up, front) in zip(axes[2], plans, strict=True):
        draw_plan(ax, above, up, front)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=REPOSITORY / "docs" / "images" / "viewpoints.png")
    out = parser.parse_args().out
    viewpoints_figure().savefig(out)
    print(f"wrote {out}")


if __name__ == "__main__":
    main()

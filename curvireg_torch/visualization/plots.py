"""Figures of registrations, as ``matplotlib.figure.Figure``: ``.savefig("a.png")`` writes them.

They need matplotlib (``pip install matplotlib``) and raise :class:`MissingDependencyError` without it.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from ..errors import InvalidInputError, MissingDependencyError
from ..matching import Ranking, ViewBank
from ..registration import Hypothesis, Registrar, Registration
from .overlay import side_pictures

__all__ = ["direction_scores", "fields", "picture", "sphere_map", "viewpoints"]


def viewpoints(bank: ViewBank, ranking: Ranking | Registration, *, image_index: int = 0) -> Any:
    """The scores of :func:`direction_scores` over azimuth and elevation; several maxima are rival poses.

    Hypotheses of a registration are numbered, best first.
    """
    poses: Sequence[Hypothesis] = ()
    if isinstance(ranking, Registration):
        poses, ranking = ranking.hypotheses, ranking.ranking
    scores = direction_scores(bank, ranking, image_index=image_index)
    figure = _figure(7.0, 3.8)
    axes = figure.subplots()
    drawn = axes.imshow(sphere_map(*scores), extent=(0, 360, -90, 90), aspect="auto", cmap="viridis")
    figure.colorbar(drawn, ax=axes, label="score S")
    axes.set(xlabel="azimuth, degrees", xticks=range(0, 361, 45))
    axes.set(ylabel="elevation, degrees", yticks=range(-90, 91, 30))
    for number, pose in enumerate(poses, start=1):
        azimuth, elevation, _ = pose.viewpoint
        axes.plot(azimuth % 360.0, elevation, "o", mfc="white", mec="black", ms=11, clip_on=False)
        axes.annotate(str(number), (azimuth % 360.0, elevation), ha="center", va="center_baseline", fontsize=8)
    return figure


def fields(registrar: Registrar, result: Registration | Hypothesis, image: Any, box: Any) -> Any:
    """The photograph and its field, the pose and its field; arguments as for :func:`.contour_overlay`."""
    pictures = side_pictures(registrar, result, image, box)
    figure = _figure(10.0, 2.9)
    for axes, (name, pixels) in zip(figure.subplots(1, len(pictures)), pictures.items(), strict=True):
        axes.imshow(pixels)
        axes.set_title(name)
        axes.set_axis_off()
    return figure


def picture(pixels: Any) -> Any:
    """One picture (H, W, 3) uint8 without axes, in its own size at 150 dpi."""
    figure = _figure(pixels.shape[1] / 150.0, pixels.shape[0] / 150.0)
    axes = figure.subplots()
    axes.imshow(pixels)
    axes.set_axis_off()
    return figure


def _figure(width: float, height: float) -> Any:
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingDependencyError("plots: matplotlib is not installed; pip install matplotlib") from error
    return Figure(figsize=(width, height), layout="constrained")


def direction_scores(bank: ViewBank, ranking: Ranking, *, image_index: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Best score of every viewing direction of a bank, over in-plane rotations and distances.

    Returns:
        azimuth and elevation (M,) in degrees, [0, 360) and [-90, 90], and score (M,); float64.

    Raises:
        InvalidInputError: a ranking of other views, or no such photograph.
    """
    if ranking.scores.shape[1] != len(bank) or not 0 <= image_index < len(ranking):
        expected = f"{len(bank)} views and image {image_index}"
        raise InvalidInputError(f"ranking: expected {expected}, got {tuple(ranking.scores.shape)}")
    azimuth, elevation = bank.views.azimuth.cpu().double() % 360.0, bank.views.elevation.cpu().double()
    azimuth = torch.where(elevation.abs() > 89.999, 0.0, azimuth)  # at a pole azimuth is an in-plane rotation
    keys = torch.stack([azimuth, elevation], dim=1).mul(1000).round().long()
    directions, group = keys.unique(dim=0, return_inverse=True)
    score = torch.full((len(directions),), -torch.inf, dtype=torch.float64)
    score = score.scatter_reduce(0, group, ranking.scores[image_index].cpu().double(), "amax")
    return directions[:, 0] / 1000.0, directions[:, 1] / 1000.0, score


def sphere_map(
    azimuth: Tensor, elevation: Tensor, score: Tensor, *, size: tuple[int, int] = (180, 360)
) -> NDArray[np.float64]:
    """Map of scores of (M,) directions: rows from elevation 90 to -90, columns from azimuth 0 to 360.

    A cell has the score of the nearest direction, or NaN if that is farther away than any direction is from its
    nearest neighbour.

    Example:
        >>> sphere_map(torch.tensor([0.0, 180]), torch.zeros(2), torch.tensor([1.0, 2]), size=(1, 4)).tolist()
        [[1.0, 2.0, 2.0, 1.0]]
    """
    rows, columns = size
    e, a = 90.0 - (np.arange(rows) + 0.5) * 180.0 / rows, (np.arange(columns) + 0.5) * 360.0 / columns
    directions = cKDTree(_unit(azimuth.double().numpy(), elevation.double().numpy()))
    distance, nearest = directions.query(_unit(a[None], e[:, None]))
    neighbour = directions.query(directions.data, k=2)[0][:, 1].max()
    return np.where(distance <= neighbour + 1e-9, score.double().numpy()[nearest], np.nan)


def _unit(azimuth: NDArray[np.float64], elevation: NDArray[np.float64]) -> NDArray[np.float64]:
    a, e = np.radians(azimuth), np.radians(elevation)
    return np.stack(np.broadcast_arrays(np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)), axis=-1)

"""Figures of registrations, as ``matplotlib.figure.Figure``: ``.savefig("a.png")`` writes them.

They need matplotlib (``pip install matplotlib``) and raise :class:`MissingDependencyError` without it.
"""

from collections.abc import Sequence
from typing import Any

from ..errors import MissingDependencyError
from ..matching import Ranking, ViewBank
from ..registration import Hypothesis, Registrar, Registration
from .overlay import side_pictures
from .sphere import direction_scores, sphere_map

__all__ = ["fields", "picture", "viewpoints"]


def _figure(width: float, height: float) -> Any:
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingDependencyError("plots: matplotlib is not installed; pip install matplotlib") from error
    return Figure(figsize=(width, height), layout="constrained")


def viewpoints(bank: ViewBank, ranking: Ranking | Registration, *, image_index: int = 0) -> Any:
    """The scores of :func:`~curvireg_torch.visualization.sphere.direction_scores`; several maxima are rival poses.

    Hypotheses of a registration are numbered, best first.
    """
    poses: Sequence[Hypothesis] = ()
    if isinstance(ranking, Registration):
        poses, ranking = ranking.hypotheses, ranking.ranking
    scores = direction_scores(bank, ranking, image_index=image_index)
    figure = _figure(7.0, 3.8)
    axes = figure.subplots()
    picture = axes.imshow(sphere_map(*scores), extent=(0, 360, -90, 90), aspect="auto", cmap="viridis")
    figure.colorbar(picture, ax=axes, label="score S")
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
    for axes, (name, picture) in zip(figure.subplots(1, len(pictures)), pictures.items(), strict=True):
        axes.imshow(picture)
        axes.set_title(name)
        axes.set_axis_off()
    return figure


def picture(pixels: Any) -> Any:
    """One picture (H, W, 3) uint8 without axes, in its own size at 150 dpi."""
    H, W = pixels.shape[:2]
    figure = _figure(W / 150.0, H / 150.0)
    axes = figure.subplots()
    axes.imshow(pixels)
    axes.set_axis_off()
    return figure

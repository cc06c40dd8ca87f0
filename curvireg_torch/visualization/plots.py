"""Figures of registrations, as ``matplotlib.figure.Figure``; :class:`MissingDependencyError`
without matplotlib."""

from typing import Any

from ..errors import MissingDependencyError
from ..matching import ViewBank
from ..registration import Hypothesis, Registrar, Registration
from ..registration.photograph import Photograph
from ..utils.extras import install_command
from ..utils.likes import BoxLike, ImageLike
from .overlay import side_pictures


def viewpoints(bank: ViewBank, result: Registration) -> Any:
    """Best score of each viewing direction of a bank over azimuth and elevation; several maxima are
    rival poses.

    The hypotheses are numbered, best first.
    """
    scores = result.ranking.scores[0].cpu()
    order = scores.argsort()  # the best one of a direction is drawn last
    figure = _figure(7.0, 3.8)
    axes = figure.subplots()
    at = bank.views.azimuth.cpu()[order] % 360.0, bank.views.elevation.cpu()[order]
    drawn = axes.scatter(*at, c=scores[order], s=120, marker="s", cmap="viridis")
    figure.colorbar(drawn, ax=axes, label="score S")
    axes.set(xlabel="azimuth, degrees", xticks=range(0, 361, 45), xlim=(0, 360))
    axes.set(ylabel="elevation, degrees", yticks=range(-90, 91, 30), ylim=(-90, 90))
    for number, pose in enumerate(result.hypotheses, start=1):
        azimuth, elevation, _ = pose.viewpoint
        axes.plot(azimuth % 360.0, elevation, "o", mfc="white", mec="black", ms=11, clip_on=False)
        axes.annotate(
            str(number), (azimuth % 360.0, elevation), ha="center", va="center_baseline", fontsize=8
        )
    return figure


def fields(
    registrar: Registrar,
    result: Registration | Hypothesis,
    image: ImageLike | Photograph,
    box: BoxLike | None = None,
) -> Any:
    """The photograph and its field, the pose and its field; arguments as for
    :func:`.contour_overlay`."""
    pictures = side_pictures(registrar, result, image, box)
    figure = _figure(10.0, 2.9)
    for axes, (name, pixels) in zip(
        figure.subplots(1, len(pictures)), pictures.items(), strict=True
    ):
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
        raise MissingDependencyError(
            f"plots: matplotlib is not installed: {install_command(['plot'])}"
        ) from error
    return Figure(figsize=(width, height), layout="constrained")

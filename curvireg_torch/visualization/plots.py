"""Pictures of numbers, one call each; they need matplotlib (``pip install 'curvireg_torch[plot]'``)."""

from typing import Any

from ..errors import MissingDependencyError
from ..matching import Ranking, ViewBank
from ..registration import Registration
from .sphere import direction_scores, sphere_map

__all__ = ["view_sphere"]


def _figure(width: float, height: float) -> Any:
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingDependencyError(
            "plots: matplotlib is not installed; pip install 'curvireg_torch[plot]'"
        ) from error
    return Figure(figsize=(width, height), layout="constrained")


def view_sphere(bank: ViewBank, ranking: Ranking | Registration, *, photograph: int = 0, model: int = 0) -> Any:
    """Score over the directions of view: one bright place is an answer, several are rivals.

    Each direction shows its best turn in the image plane. Of a registration, its hypotheses are numbered, best first.

    Args:
        bank: the views.
        ranking: of them, or a registration.
        photograph, model: of the ranking and the bank.

    Returns:
        ``matplotlib.figure.Figure``.

    Raises:
        MissingDependencyError, InvalidInputError.
    """
    found = ranking if isinstance(ranking, Registration) else None
    scores = direction_scores(bank, ranking.ranking if isinstance(ranking, Registration) else ranking,
                              photograph=photograph, model=model)  # fmt: skip
    figure = _figure(7.0, 3.8)
    axes = figure.subplots()
    picture = axes.imshow(sphere_map(*scores), extent=(0, 360, -90, 90), aspect="auto", cmap="viridis")
    figure.colorbar(picture, ax=axes, label="score S")
    axes.set(
        xlabel="azimuth, degrees", ylabel="elevation, degrees", xticks=range(0, 361, 45), yticks=range(-90, 91, 30)
    )
    for number, pose in enumerate(found.hypotheses if found else (), start=1):
        if pose.model == model:
            azimuth, elevation, _ = pose.viewpoint
            axes.plot(azimuth % 360.0, elevation, "o", mfc="white", mec="black", ms=11)
            axes.annotate(str(number), (azimuth % 360.0, elevation), ha="center", va="center_baseline", fontsize=8)
    return figure

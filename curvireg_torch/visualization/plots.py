"""Pictures of numbers, one call each: ``matplotlib.figure.Figure``, so ``.savefig("a.png")`` writes them.

They need matplotlib (``pip install 'curvireg_torch[plot]'``).
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ..errors import InvalidInputError, MissingDependencyError
from ..matching import Ranking, ViewBank
from ..metrics import accuracy, azimuth_bin, median_error
from ..registration import Hypothesis, Registrar, Registration
from ..utils.checks import check_tensor
from .overlay import side_pictures
from .sphere import direction_scores, sphere_map

__all__ = [
    "azimuth_confusion",
    "bars",
    "curves",
    "errors_by_class",
    "fields",
    "reliability",
    "risk_coverage",
    "view_sphere",
]

_MISS = 200.0
"""Where in degrees an object without an estimate is drawn."""


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

    Raises:
        MissingDependencyError, InvalidInputError.
    """
    poses = ranking.hypotheses if isinstance(ranking, Registration) else ()
    ranking = ranking.ranking if isinstance(ranking, Registration) else ranking
    scores = direction_scores(bank, ranking, photograph=photograph, model=model)
    figure = _figure(7.0, 3.8)
    axes = figure.subplots()
    picture = axes.imshow(sphere_map(*scores), extent=(0, 360, -90, 90), aspect="auto", cmap="viridis")
    figure.colorbar(picture, ax=axes, label="score S")
    axes.set(
        xlabel="azimuth, degrees", ylabel="elevation, degrees", xticks=range(0, 361, 45), yticks=range(-90, 91, 30)
    )
    for number, pose in enumerate(poses, start=1):
        if pose.model == model:
            azimuth, elevation, _ = pose.viewpoint
            axes.plot(azimuth % 360.0, elevation, "o", mfc="white", mec="black", ms=11, clip_on=False)
            axes.annotate(str(number), (azimuth % 360.0, elevation), ha="center", va="center_baseline", fontsize=8)
    return figure


def fields(registrar: Registrar, result: Registration | Hypothesis, image: Any, box: Any) -> Any:
    """What was compared: the photograph and its field, the pose and its field.

    Arguments and errors as for :func:`curvireg_torch.visualization.contour_overlay`.
    """
    pictures = side_pictures(registrar, result, image, box)
    figure = _figure(10.0, 2.9)
    for axes, (name, picture) in zip(figure.subplots(1, len(pictures)), pictures.items(), strict=True):
        axes.imshow(picture)
        axes.set_title(name)
        axes.set_axis_off()
    return figure


DenseFeatures = Sequence[str | float]


def curves(columns: Sequence[str], rows: Sequence[DenseFeatures], *, title: str = "", ylabel: str = "share") -> Any:
    """Curves over the first column: repeatability around the right view, precision at rank k.

    Args:
        columns: names; the first is that of the abscissa.
        rows: as long as ``columns``.

    Raises:
        InvalidInputError: rows of other lengths, or none.
        MissingDependencyError.

    Example:
        >>> figure = curves(["k", "CS/MFC"], [[1, 0.5], [3, 0.7], [5, 0.8]], ylabel="precision")
        >>> figure.axes[0].lines[0].get_ydata().tolist()
        [0.5, 0.7, 0.8]
    """
    values = _columns(columns, rows)
    x = [float(row[0]) for row in rows]
    figure = _figure(7.0, 4.0)
    axes = figure.subplots()
    for name, y in values.items():
        axes.plot(x, y, marker="." if len(rows) < 12 else "", label=name)
    axes.set(xlabel=columns[0], ylabel=ylabel, title=title)
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small", ncols=2)
    return figure


def bars(columns: Sequence[str], rows: Sequence[DenseFeatures], *, title: str = "", ylabel: str = "share") -> Any:
    """A group of bars for each row: precision by class, errors by filter.

    Args:
        columns: names; the first is that of the groups' names.
        rows: as long as ``columns``: a group's name and its numbers.

    Raises:
        InvalidInputError: rows of other lengths, or none.
        MissingDependencyError.

    Example:
        >>> figure = bars(["class", "CS/MFC", "CS/IG"], [["car", 0.5, 0.4], ["sofa", 0.7, 0.6]], ylabel="precision")
        >>> [float(bar.get_height()) for bar in figure.axes[0].containers[1]]
        [0.4, 0.6]
    """
    values = _columns(columns, rows)
    figure = _figure(8.0, 4.5)
    axes = figure.subplots()
    width = 0.8 / len(values)
    for k, (name, heights) in enumerate(values.items()):
        axes.bar([i + (k + 0.5) * width - 0.4 for i in range(len(rows))], heights, width, label=name)
    axes.set_xticks(range(len(rows)), [str(row[0]) for row in rows], rotation=30, ha="right")
    axes.set(ylabel=ylabel, title=title)
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small", ncols=2)
    return figure


def _columns(columns: Sequence[str], rows: Sequence[DenseFeatures]) -> dict[str, list[float]]:
    """The numbers of each column but the first."""
    if len(columns) < 2 or not rows or any(len(row) != len(columns) for row in rows):
        raise InvalidInputError(
            f"rows: expected rows of {len(columns)} >= 2 cells, as many as columns, and at least one"
        )
    return {name: [float(row[k]) for row in rows] for k, name in enumerate(columns) if k}


def azimuth_confusion(azimuth: Tensor, truth: Tensor, *, bins: int = 8) -> Any:
    """How often azimuths of one bin were estimated in another, as shares of each true bin; numbers are counts.

    Bins are those of :func:`curvireg_torch.metrics.azimuth_bin`. Half a turn shows as a second diagonal.

    Args:
        azimuth, truth: (N,) degrees; pairs with NaN are left out.
        bins: of the circle.

    Raises:
        InvalidInputError: of different lengths, or nothing left.
        MissingDependencyError.

    Example:
        >>> figure = azimuth_confusion(torch.tensor([1.0, 2.0, 181.0]), torch.tensor([0.0, 180.0, 180.0]), bins=4)
        >>> figure.axes[0].images[0].get_array()[2].tolist()                # true azimuths about 180 degrees
        [0.5, 0.0, 0.5, 0.0]
    """
    check_tensor(azimuth, "azimuth", (None,))
    check_tensor(truth, "truth", tuple(azimuth.shape))
    known = azimuth.isfinite() & truth.isfinite()
    if not bool(known.any()):
        raise InvalidInputError("azimuth: expected at least one pair of estimate and truth, got none")
    there = azimuth_bin(truth[known], bins).long() * bins + azimuth_bin(azimuth[known], bins).long()
    count = torch.bincount(there, minlength=bins * bins).view(bins, bins)
    share = count / count.sum(dim=1, keepdim=True).clamp(min=1)
    figure = _figure(5.2, 4.6)
    axes = figure.subplots()
    picture = axes.imshow(share.numpy(), cmap="Blues", vmin=0, vmax=1)
    for row in range(bins):
        for column in range(bins):
            if count[row, column]:
                shade = "white" if share[row, column] > 0.5 else "black"
                axes.text(column, row, str(int(count[row, column])), ha="center", va="center", color=shade, fontsize=8)
    middles = [f"{360 * i / bins:g}" for i in range(bins)]
    axes.set_xticks(range(bins), middles)
    axes.set_yticks(range(bins), middles)
    axes.set(xlabel="estimated azimuth, degrees", ylabel="true azimuth, degrees")
    figure.colorbar(picture, ax=axes, label="share of the true bin")
    return figure


def reliability(confidence: Tensor, right: Tensor, *, bins: int = 10) -> Any:
    """Whether a confidence is what it says: share of right answers over mean confidence, bin by bin.

    Points on the diagonal are honest, below it too sure. The areas of the points are the numbers of answers.

    Args:
        confidence: (N,) in [0, 1].
        right: (N,) bool.
        bins: of equal width.

    Raises:
        InvalidInputError: of different lengths, empty, or outside [0, 1].
        MissingDependencyError.

    Example:
        >>> figure = reliability(torch.tensor([0.91, 0.93, 0.15]), torch.tensor([True, False, False]))
        >>> [[round(float(v), 2) for v in point] for point in figure.axes[0].collections[0].get_offsets()]
        [[0.15, 0.0], [0.92, 0.5]]
    """
    _check_judged(confidence, right, "right")
    place = (confidence * bins).long().clamp(max=bins - 1)
    count = torch.bincount(place, minlength=bins)
    some = count > 0
    mean = torch.bincount(place, weights=confidence.double(), minlength=bins)[some] / count[some]
    share = torch.bincount(place, weights=right.double(), minlength=bins)[some] / count[some]
    figure = _figure(4.6, 4.4)
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color="grey", lw=1)
    axes.scatter(mean.numpy(), share.numpy(), s=(20 + 400 * count[some] / count.sum()).numpy(), alpha=0.7)
    for x, y, n in zip(mean.tolist(), share.tolist(), count[some].tolist(), strict=True):
        axes.annotate(str(n), (x, y), xytext=(0, 9), textcoords="offset points", ha="center", fontsize=7)
    axes.set(xlabel="confidence", ylabel="share within the threshold", xlim=(-0.03, 1.03), ylim=(-0.06, 1.09))
    axes.grid(alpha=0.3)
    return figure


def risk_coverage(confidence: Tensor, right: Tensor) -> Any:
    """Share of wrong answers among the most confident ones, over the share of all that those are.

    Args:
        confidence: (N,) in [0, 1].
        right: (N,) bool.

    Raises:
        InvalidInputError: of different lengths, empty, or outside [0, 1].
        MissingDependencyError.

    Example:
        >>> figure = risk_coverage(torch.tensor([0.9, 0.2, 0.5, 0.7]), torch.tensor([True, False, False, True]))
        >>> [round(v, 2) for v in figure.axes[0].lines[0].get_ydata().tolist()]
        [0.0, 0.0, 0.33, 0.5]
    """
    _check_judged(confidence, right, "right")
    order = confidence.argsort(descending=True, stable=True)
    count = torch.arange(1, len(order) + 1)
    risk = (~right.bool()[order]).cumsum(0) / count
    ranked = confidence[order]
    whole = torch.cat([ranked[1:] != ranked[:-1], torch.ones(1, dtype=torch.bool)])  # equals have no order
    figure = _figure(5.6, 3.8)
    axes = figure.subplots()
    axes.plot((count / len(order))[whole].numpy(), risk[whole].numpy(), label="by confidence")
    axes.axhline(float(risk[-1]), color="grey", lw=1, ls="--", label="all answers")
    axes.set(xlabel="coverage: share of the answers that are kept", ylabel="risk: share of them that is wrong")
    axes.set(xlim=(0, 1), ylim=(0, None))
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


def errors_by_class(categories: Sequence[str], errors: Tensor, *, threshold_deg: float = 30.0) -> Any:
    """Every error as a dot, class by class, lowest median first; bars are medians.

    Args:
        categories: of N objects.
        errors: (N,) degrees, ``inf`` for a miss, which is drawn above 180.
        threshold_deg: what counts as right, for the shares beside the names.

    Raises:
        InvalidInputError: of different lengths, or empty.
        MissingDependencyError.

    Example:
        >>> figure = errors_by_class(["car", "sofa", "car"], torch.tensor([4.0, 90.0, torch.inf]))
        >>> [text.get_text() for text in figure.axes[0].get_yticklabels()]
        ['sofa  0.00 of 1', 'car  0.50 of 2']
    """
    if len(categories) == 0 or tuple(errors.shape) != (len(categories),):
        raise InvalidInputError(f"errors: expected ({len(categories)},), N >= 1, got {tuple(errors.shape)}")
    mine = {c: errors[torch.tensor([c == other for other in categories])] for c in sorted(set(categories))}
    names = sorted(mine, key=lambda c: (median_error(mine[c]), c))
    figure = _figure(7.0, 1.2 + 0.36 * len(names))
    axes = figure.subplots()
    for row, name in enumerate(names):
        shown = mine[name].clamp(max=_MISS)
        axes.plot(shown.numpy(), [row] * len(shown), "|", ms=12, alpha=0.6, color="tab:blue")
        axes.plot(min(median_error(mine[name]), _MISS), row, "d", color="tab:orange")
    told = [f"{name}  {accuracy(mine[name], threshold_deg):.2f} of {len(mine[name])}" for name in names]
    axes.set_yticks(range(len(names)), told)
    axes.axvline(threshold_deg, color="grey", lw=1)
    axes.set_xticks([*range(0, 181, 30), _MISS], [*map(str, range(0, 181, 30)), "none"])
    axes.set(xlabel=f"error, degrees; beside the names, the share below {threshold_deg:g}", xlim=(-3, _MISS + 5))
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.grid(alpha=0.3, axis="x")
    return figure


def _check_judged(confidence: Tensor, right: Tensor, name: str) -> None:
    check_tensor(confidence, "confidence", (None,))
    if tuple(right.shape) != tuple(confidence.shape) or len(confidence) == 0:
        raise InvalidInputError(f"{name}: expected one for each of N >= 1 confidences, got {tuple(right.shape)}")
    if not bool(((confidence >= 0) & (confidence <= 1)).all()):
        raise InvalidInputError("confidence: expected numbers in [0, 1]")

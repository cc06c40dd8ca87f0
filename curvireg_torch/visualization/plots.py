"""Figures of numbers, one function each, as ``matplotlib.figure.Figure``: ``.savefig("a.png")`` writes them.

They need matplotlib (``pip install 'curvireg_torch[plot]'``) and raise :class:`MissingDependencyError` without it, and
:class:`InvalidInputError` for empty inputs, unequal lengths and numbers out of range.
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
    "support_over_frames",
    "view_sphere",
]

Row = Sequence[str | float]

_MISS = 200.0  # position in degrees at which an object without an estimate is drawn


def _figure(width: float, height: float) -> Any:
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        message = "plots: matplotlib is not installed; pip install 'curvireg_torch[plot]'"
        raise MissingDependencyError(message) from error
    return Figure(figsize=(width, height), layout="constrained")


def _axes(width: float, height: float) -> Any:
    axes = _figure(width, height).subplots()
    axes.grid(alpha=0.3)
    return axes


def view_sphere(bank: ViewBank, ranking: Ranking | Registration, *, image_index: int = 0) -> Any:
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


def curves(columns: Sequence[str], rows: Sequence[Row], *, title: str = "", ylabel: str = "fraction") -> Any:
    """Curves over the first column, for example precision at rank k.

    Example:
        >>> figure = curves(["k", "CS/MFC"], [[1, 0.5], [3, 0.7], [5, 0.8]])
        >>> figure.axes[0].lines[0].get_ydata().tolist()
        [0.5, 0.7, 0.8]
    """
    values = _columns(columns, rows)
    axes = _axes(7.0, 4.0)
    for name, y in values.items():
        axes.plot([float(row[0]) for row in rows], y, marker="." if len(rows) < 12 else "", label=name)
    axes.set(xlabel=columns[0], ylabel=ylabel, title=title)
    axes.legend(fontsize="small", ncols=2)
    return axes.figure


def bars(columns: Sequence[str], rows: Sequence[Row], *, title: str = "", ylabel: str = "fraction") -> Any:
    """A group of bars for each row, for example precision by class; the first column names the groups.

    Example:
        >>> figure = bars(["class", "CS/MFC", "CS/IG"], [["car", 0.5, 0.4], ["sofa", 0.7, 0.6]])
        >>> [float(bar.get_height()) for bar in figure.axes[0].containers[1]]
        [0.4, 0.6]
    """
    values = _columns(columns, rows)
    axes = _axes(8.0, 4.5)
    width = 0.8 / len(values)
    for k, (name, heights) in enumerate(values.items()):
        axes.bar([i + (k + 0.5) * width - 0.4 for i in range(len(rows))], heights, width, label=name)
    axes.set_xticks(range(len(rows)), [str(row[0]) for row in rows], rotation=30, ha="right")
    axes.set(ylabel=ylabel, title=title)
    axes.legend(fontsize="small", ncols=2)
    return axes.figure


def _columns(columns: Sequence[str], rows: Sequence[Row]) -> dict[str, list[float]]:
    """The numbers of each column but the first."""
    if len(columns) < 2 or not rows or any(len(row) != len(columns) for row in rows):
        raise InvalidInputError(f"rows: expected at least one row of {len(columns)} >= 2 cells, as many as columns")
    return {name: [float(row[k]) for row in rows] for k, name in enumerate(columns) if k}


def azimuth_confusion(azimuth: Tensor, truth: Tensor, *, bins: int = 8) -> Any:
    """Confusion matrix of azimuth bins, as fractions of each true bin; the numbers are counts.

    Azimuths are (N,) degrees; pairs with NaN are left out. Bins are those of
    :func:`curvireg_torch.metrics.azimuth_bin`. Errors of 180 degrees form a second diagonal.

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
    cell = azimuth_bin(truth[known], bins).long() * bins + azimuth_bin(azimuth[known], bins).long()
    count = torch.bincount(cell, minlength=bins * bins).view(bins, bins)
    fraction = count / count.sum(dim=1, keepdim=True).clamp(min=1)
    figure = _figure(5.2, 4.6)
    axes = figure.subplots()
    picture = axes.imshow(fraction.numpy(), cmap="Blues", vmin=0, vmax=1)
    for row, column in count.nonzero().tolist():
        colour = "white" if fraction[row, column] > 0.5 else "black"
        axes.text(column, row, str(int(count[row, column])), ha="center", va="center", color=colour, fontsize=8)
    for set_ticks in (axes.set_xticks, axes.set_yticks):
        set_ticks(range(bins), [f"{360 * i / bins:g}" for i in range(bins)])
    axes.set(xlabel="estimated azimuth, degrees", ylabel="true azimuth, degrees")
    figure.colorbar(picture, ax=axes, label="fraction of the true bin")
    return figure


def reliability(confidence: Tensor, correct: Tensor, *, bins: int = 10) -> Any:
    """Reliability diagram: fraction of correct results over mean confidence, bin by bin.

    Confidences are (N,) in [0, 1], ``correct`` is (N,) bool. A calibrated confidence lies on the diagonal; below it, it
    is too high. Areas are the numbers of results.

    Example:
        >>> figure = reliability(torch.tensor([0.91, 0.93, 0.15]), torch.tensor([True, False, False]))
        >>> [[round(float(v), 2) for v in point] for point in figure.axes[0].collections[0].get_offsets()]
        [[0.15, 0.0], [0.92, 0.5]]
    """
    _check_confidence(confidence, correct)
    index = (confidence * bins).long().clamp(max=bins - 1)
    count = torch.bincount(index, minlength=bins)
    used = count > 0
    n = count[used]
    mean = torch.bincount(index, weights=confidence.double(), minlength=bins)[used] / n
    fraction = torch.bincount(index, weights=correct.double(), minlength=bins)[used] / n
    axes = _axes(4.6, 4.4)
    axes.plot([0, 1], [0, 1], color="grey", lw=1)
    axes.scatter(mean.numpy(), fraction.numpy(), s=(20 + 400 * n / count.sum()).numpy(), alpha=0.7)
    for x, y, number in zip(mean.tolist(), fraction.tolist(), n.tolist(), strict=True):
        axes.annotate(str(number), (x, y), xytext=(0, 9), textcoords="offset points", ha="center", fontsize=7)
    axes.set(xlabel="confidence", ylabel="fraction within the threshold", xlim=(-0.03, 1.03), ylim=(-0.06, 1.09))
    return axes.figure


def risk_coverage(confidence: Tensor, correct: Tensor) -> Any:
    """Risk-coverage curve: fraction of wrong results among the most confident ones, over the fraction that is kept.

    Confidences are (N,) in [0, 1], ``correct`` is (N,) bool.

    Example:
        >>> figure = risk_coverage(torch.tensor([0.9, 0.2, 0.5, 0.7]), torch.tensor([True, False, False, True]))
        >>> [round(v, 2) for v in figure.axes[0].lines[0].get_ydata().tolist()]
        [0.0, 0.0, 0.33, 0.5]
    """
    _check_confidence(confidence, correct)
    order = confidence.argsort(descending=True, stable=True)
    count = torch.arange(1, len(order) + 1)
    risk = (~correct.bool()[order]).cumsum(0) / count
    ranked = confidence[order]
    last = torch.cat([ranked[1:] != ranked[:-1], torch.ones(1, dtype=torch.bool)])  # equal confidences have no order
    axes = _axes(5.6, 3.8)
    axes.plot((count / len(order))[last].numpy(), risk[last].numpy(), label="by confidence")
    axes.axhline(float(risk[-1]), color="grey", lw=1, ls="--", label="all results")
    axes.set(xlabel="coverage: fraction of results kept", ylabel="risk: fraction of them that is wrong")
    axes.set(xlim=(0, 1), ylim=(0, None))
    axes.legend()
    return axes.figure


def errors_by_class(categories: Sequence[str], errors: Tensor, *, threshold_deg: float = 30.0) -> Any:
    """Every error as a mark, class by class, lowest median first; diamonds are medians.

    Errors are (N,) degrees, ``inf`` for a miss, which is drawn above 180. Beside the names are the fractions of errors
    below ``threshold_deg``.

    Example:
        >>> figure = errors_by_class(["car", "sofa", "car"], torch.tensor([4.0, 90.0, torch.inf]))
        >>> [text.get_text() for text in figure.axes[0].get_yticklabels()]
        ['sofa  0.00 of 1', 'car  0.50 of 2']
    """
    if len(categories) == 0 or tuple(errors.shape) != (len(categories),):
        raise InvalidInputError(f"errors: expected ({len(categories)},), N >= 1, got {tuple(errors.shape)}")
    by_class = {c: errors[torch.tensor([c == other for other in categories])] for c in sorted(set(categories))}
    names = sorted(by_class, key=lambda c: (median_error(by_class[c]), c))
    axes = _figure(7.0, 1.2 + 0.36 * len(names)).subplots()
    for row, name in enumerate(names):
        marks = by_class[name].clamp(max=_MISS)
        axes.plot(marks.numpy(), [row] * len(marks), "|", ms=12, alpha=0.6, color="tab:blue")
        axes.plot(min(median_error(by_class[name]), _MISS), row, "d", color="tab:orange")
    labels = [f"{name}  {accuracy(by_class[name], threshold_deg):.2f} of {len(by_class[name])}" for name in names]
    axes.set_yticks(range(len(names)), labels)
    axes.axvline(threshold_deg, color="grey", lw=1)
    axes.set_xticks([*range(0, 181, 30), _MISS], [*map(str, range(0, 181, 30)), "none"])
    axes.set(xlabel=f"error, degrees; beside the names: fraction below {threshold_deg:g}", xlim=(-3, _MISS + 5))
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.grid(alpha=0.3, axis="x")
    return axes.figure


def support_over_frames(edge_support: Tensor, confidence: Tensor) -> Any:
    """Edge support and confidence over the frames of a video; crosses mark frames without a pose.

    Both are (N,); where ``confidence`` is NaN, the object was lost or the frame could not be read.

    Example:
        >>> figure = support_over_frames(torch.tensor([0.8, torch.nan, 0.7]), torch.tensor([0.9, torch.nan, 0.9]))
        >>> figure.axes[0].lines[-1].get_xdata().tolist()
        [1]
    """
    check_tensor(confidence, "confidence", (None,))
    check_tensor(edge_support, "edge_support", tuple(confidence.shape))
    axes = _axes(8.0, 3.0)
    marker = "." if len(confidence) < 100 else ""
    for name, values in (("confidence", confidence), ("edge support", edge_support)):
        axes.plot(values.numpy(), marker=marker, label=name)
    lost = confidence.isnan().nonzero()[:, 0]
    axes.plot(lost.numpy(), [0.0] * len(lost), "x", color="tab:red", clip_on=False, label="no pose")
    axes.set(xlabel="frame", xlim=(-0.5, max(len(confidence) - 0.5, 0.5)), ylim=(0, 1.02))
    axes.legend(fontsize="small", ncols=3, loc="lower right")
    return axes.figure


def _check_confidence(confidence: Tensor, correct: Tensor) -> None:
    check_tensor(confidence, "confidence", (None,))
    if tuple(correct.shape) != tuple(confidence.shape) or len(confidence) == 0:
        raise InvalidInputError(f"correct: expected one for each of N >= 1 confidences, got {tuple(correct.shape)}")
    if not bool(((confidence >= 0) & (confidence <= 1)).all()):
        raise InvalidInputError("confidence: expected numbers in [0, 1]")

"""Agreement of feature points of photographs with those of the true view: IP, Hausdorff distance, repeatability."""

from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from statistics import fmean
from typing import Any

import torch
from kornia.color import rgb_to_grayscale
from torch import Tensor, nn

from ...detectors import DETECTORS
from ...features import field_points
from ...filters import ImageGradient, MultiScaleCurvilinearSaliency, MultiScaleFocusCurves
from ...matching import ViewDescriber
from ...matching.describe import depth_filter
from ...metrics import hausdorff_distance, intersection_percentage, view_repeatability
from ...pipeline import BankSettings
from .cases import Case, grouped
from .tables import Cell, Table

__all__ = ["PHOTO_FIELDS", "curve_table", "detector_tables", "repeatability_table"]

PHOTO_FIELDS: dict[str, Callable[[], nn.Module]] = {
    "MFC": MultiScaleFocusCurves,
    "MCS": MultiScaleCurvilinearSaliency,
    "IG": ImageGradient,
}
"""The paper's filters of photographs, by their names there."""

CURVE_OFFSETS = tuple(range(-100, 100, 5))
"""Degrees about the object's z axis: 40 views, the true one in the middle."""

CURVE_DETECTORS = ("mfc", "mcs", "ig", "sift", "sobel")

Scores = defaultdict[str, defaultdict[str, list[float]]]
"""Values by category and column."""


def detector_tables(cases: list[Case], settings: BankSettings, eps_px: float, progress: bool = True) -> list[Table]:
    """IP and Hausdorff distances of each detector against the curvilinear saliency of the true view, per category."""
    detectors = _photo_detectors(settings)
    scores: defaultdict[str, Scores] = defaultdict(_no_scores)
    for category, depth, crop in _views(cases, settings, "detectors", progress):
        view = _view_points(depth, settings)
        chance = intersection_percentage(torch.ones_like(view), view, eps_px=eps_px)
        scores["ip"][category]["chance"].append(float(chance))
        for name, detect in detectors.items():
            photo = detect(crop)
            values = {
                "ip": intersection_percentage(photo, view, eps_px=eps_px),
                "hausdorff": hausdorff_distance(photo, view),
                "hausdorff_95": hausdorff_distance(photo, view, percentile=95.0),
                "points": photo.sum().float(),
            }
            for table, value in values.items():
                if bool(value.isfinite().all()):
                    scores[table][category][name].append(float(value))
    where = f"Crops of {settings.image_size} px, N = {len(cases)}; mean over photographs with points"
    definitions = {
        "ip": (
            "Intersection percentage",
            f"fraction of the photograph's points within {eps_px:g} px of a point of the view; chance: of all pixels",
        ),
        "hausdorff": ("Hausdorff distance", "in px of the crop"),
        "hausdorff_95": ("Hausdorff distance, 95th percentile", "in px of the crop"),
        "points": ("Number of points", "in the photograph's crop"),
    }
    tables = []
    for name, (title, text) in definitions.items():
        columns = [*detectors, "chance"] if name == "ip" else [*detectors]
        tables.append(_table(name, f"{title}, by detector", f"{title}: {text}. {where}.", scores[name], columns))
    return tables


def repeatability_table(cases: list[Case], settings: BankSettings, eps_px: float, progress: bool = True) -> Table:
    """Repeatability of each depth filter's points in each photograph filter's points."""
    detectors = _photo_detectors(settings, [*PHOTO_FIELDS])
    depths = ("CS", "ASG", "HFN")
    scores = _no_scores()
    for category, depth, crop in _views(cases, settings, "repeatability", progress):
        photos = {name: detect(crop) for name, detect in detectors.items()}
        for name in depths:
            view = _view_points(depth, replace(settings, depth_field=name))
            for photo_name, photo in photos.items():
                value = view_repeatability(view, photo, eps_px=eps_px)
                if bool(value.isfinite().all()):
                    scores[category][f"{name}/{photo_name}"].append(float(value))
    text = (
        f"Repeatability: fraction of the points of the true view with a point of the photograph within {eps_px:g} px. "
        f"Crops of {settings.image_size} px, at most {settings.point_fraction:.0%} of the pixels, N = {len(cases)}."
    )
    title = "Repeatability, depth filter / photograph filter"
    return _table("repeatability", title, text, scores, [f"{d}/{p}" for d in depths for p in detectors])


def curve_table(cases: list[Case], settings: BankSettings, eps_px: float, progress: bool = True) -> Table:
    """Repeatability in 40 views around the true one."""
    detectors = _photo_detectors(settings, CURVE_DETECTORS)
    angles = torch.deg2rad(torch.tensor(CURVE_OFFSETS, dtype=torch.float64))
    rotations = torch.zeros(len(angles), 3, 3, dtype=torch.float64)
    rotations[:, 0, 0] = rotations[:, 1, 1] = angles.cos()
    rotations[:, 1, 0], rotations[:, 0, 1], rotations[:, 2, 2] = angles.sin(), -angles.sin(), 1.0
    sums = torch.zeros(len(detectors), len(angles), dtype=torch.float64)
    for _, depth, crop in _views(cases, settings, "curve", progress, rotations):
        views = _view_points(depth, settings)
        for k, detect in enumerate(detectors.values()):
            sums[k] += view_repeatability(views, detect(crop).expand_as(views), eps_px=eps_px).nan_to_num().double()
    means = (sums / len(cases)).T.tolist()
    text = (
        f"Fraction of the points of the view with a point of the photograph within {eps_px:g} px, with the object "
        f"rotated about its z axis; curvilinear saliency on depth. Crops of {settings.image_size} px, mean over "
        f"N = {len(cases)}."
    )
    rows: list[list[Cell]] = [[float(offset), *line] for offset, line in zip(CURVE_OFFSETS, means, strict=True)]
    return Table("curve", "Repeatability around the true view", text, ["offset_deg", *detectors], rows, curve=True)


def _no_scores() -> Scores:
    return defaultdict(lambda: defaultdict(list))


def _views(
    cases: list[Case], settings: BankSettings, label: str, progress: bool, rotations: Tensor | None = None
) -> Iterator[tuple[str, Tensor, Tensor]]:
    """Of each case: category, depth (N, 1, S, S) after ``rotations`` of the object, and grey crop (1, 1, S, S)."""
    for mesh, group in grouped(cases, label, progress):
        describe = ViewDescriber(mesh, settings)
        for case in group:
            R, distance = case.view(mesh)
            R = R[None] if rotations is None else R @ rotations
            depth = describe.depth(R, torch.full((len(R),), distance, dtype=torch.float64))[0]
            yield case.category, depth, rgb_to_grayscale(case.crop(settings))


def _view_points(depth: Tensor, settings: BankSettings) -> Tensor:
    """(N, S, S) bool."""
    with torch.no_grad():
        return _field_points(depth_filter(settings), settings.point_fraction, depth)


def _photo_detectors(settings: BankSettings, names: Any = ()) -> dict[str, Callable[[Tensor], Tensor]]:
    """Detectors (B, 1, H, W) -> bool (B, H, W) of the paper's filters and the classical ones; ``names`` selects."""
    fraction = settings.point_fraction
    found = {name: partial(_field_points, make(), fraction) for name, make in PHOTO_FIELDS.items()}
    known = {name.lower() for name in found}
    classical = {n: partial(_detected_points, d, fraction) for n, d in DETECTORS.items() if n.lower() not in known}
    wanted = {name.lower() for name in names}
    return {name: detect for name, detect in (found | classical).items() if not wanted or name.lower() in wanted}


def _field_points(field: nn.Module, fraction: float, x: Tensor) -> Tensor:
    return field_points(field(x), fraction=fraction)[:, 0]


def _detected_points(detect: Callable[..., Any], fraction: float, image: Tensor) -> Tensor:
    points: Tensor = detect(image, fraction=fraction).points
    return points[:, 0]


def _table(name: str, title: str, text: str, scores: Scores, columns: list[str]) -> Table:
    """One row of means per category, and the mean of all photographs."""
    everything = {c: [v for by_name in scores.values() for v in by_name[c]] for c in columns}
    means: list[list[Cell]] = [
        [category, *(fmean(values[c]) if values[c] else float("nan") for c in columns)]
        for category, values in [*sorted(scores.items()), ("all", everything)]
    ]
    return Table(name, title, text, ["category", *columns], means)

"""Agreement of feature points of photographs with those of the true view: IP, Hausdorff distance, repeatability."""

from collections import defaultdict
from dataclasses import replace
from statistics import fmean

import torch
from kornia.color import rgb_to_grayscale
from torch import Tensor

from ...descriptors import field_points
from ...matching import ViewDescriber
from ...matching.fields import depth_filter
from ...metrics import hausdorff_distance, intersection_percentage, view_repeatability
from ...settings import BankSettings
from .cases import Case, grouped
from .fields import PHOTO_FIELDS, photo_detectors
from .tables import Cell, Table

__all__ = ["CURVE_OFFSETS", "curve_table", "detector_tables", "repeatability_table"]

CURVE_OFFSETS = tuple(range(-100, 100, 5))
"""Degrees about the object's z axis: 40 views, the true one in the middle."""

CURVE_DETECTORS = ("mfc", "mcs", "ig", "sift", "sobel")

Scores = defaultdict[str, defaultdict[str, list[float]]]
"""Values by category and column."""


def detector_tables(cases: list[Case], settings: BankSettings, eps_px: float, progress: bool = True) -> list[Table]:
    """IP and Hausdorff distances of each detector against the curvilinear saliency of the true view, per category."""
    detectors = photo_detectors(settings.point_fraction)
    scores = {name: _no_scores() for name in ("ip", "hausdorff", "hausdorff_95", "points")}
    for mesh, group in grouped(cases, "detectors", progress):
        describe = ViewDescriber(mesh, settings)
        for case in group:
            view = _points(_depth(describe, *case.view(mesh)), settings)
            crop = _crop(case, settings)
            chance = intersection_percentage(torch.ones_like(view), view, eps_px=eps_px)
            scores["ip"][case.category]["chance"].append(float(chance))
            for name, detect in detectors.items():
                photo = detect(crop)
                values = (
                    intersection_percentage(photo, view, eps_px=eps_px),
                    hausdorff_distance(photo, view),
                    hausdorff_distance(photo, view, percentile=95.0),
                    photo.sum().float(),
                )
                for table, value in zip(scores, values, strict=True):
                    if bool(value.isfinite().all()):
                        scores[table][case.category][name].append(float(value))
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
    detectors = {n: d for n, d in photo_detectors(settings.point_fraction).items() if n in PHOTO_FIELDS}
    depths = ("CS", "ASG", "HFN")
    scores = _no_scores()
    for mesh, group in grouped(cases, "repeatability", progress):
        describe = ViewDescriber(mesh, settings)
        for case in group:
            depth = _depth(describe, *case.view(mesh))
            crop = _crop(case, settings)
            photos = {name: detect(crop) for name, detect in detectors.items()}
            for name in depths:
                view = _points(depth, settings, name)
                for photo_name, photo in photos.items():
                    value = float(view_repeatability(view, photo, eps_px=eps_px))
                    if value == value:
                        scores[case.category][f"{name}/{photo_name}"].append(value)
    text = (
        f"Repeatability: fraction of the points of the true view with a point of the photograph within {eps_px:g} px. "
        f"Crops of {settings.image_size} px, at most {settings.point_fraction:.0%} of the pixels, N = {len(cases)}."
    )
    title = "Repeatability, depth filter / photograph filter"
    return _table("repeatability", title, text, scores, [f"{d}/{p}" for d in depths for p in detectors])


def curve_table(cases: list[Case], settings: BankSettings, eps_px: float, progress: bool = True) -> Table:
    """Repeatability in 40 views around the true one."""
    detectors = {n: d for n, d in photo_detectors(settings.point_fraction).items() if n.lower() in CURVE_DETECTORS}
    angles = torch.deg2rad(torch.tensor(CURVE_OFFSETS, dtype=torch.float64))
    rotations = torch.zeros(len(angles), 3, 3, dtype=torch.float64)
    rotations[:, 0, 0] = rotations[:, 1, 1] = angles.cos()
    rotations[:, 1, 0], rotations[:, 0, 1], rotations[:, 2, 2] = angles.sin(), -angles.sin(), 1.0
    sums = torch.zeros(len(detectors), len(angles), dtype=torch.float64)
    for mesh, group in grouped(cases, "curve", progress):
        describe = ViewDescriber(mesh, settings)
        for case in group:
            R, distance = case.view(mesh)
            views = _points(_depth(describe, R @ rotations, distance), settings)
            crop = _crop(case, settings)
            for k, detect in enumerate(detectors.values()):
                photo = detect(crop).expand_as(views)
                sums[k] += view_repeatability(views, photo, eps_px=eps_px).nan_to_num().double()
    rows: list[list[Cell]] = [
        [float(o), *means] for o, means in zip(CURVE_OFFSETS, (sums / len(cases)).T.tolist(), strict=True)
    ]
    text = (
        f"Fraction of the points of the view with a point of the photograph within {eps_px:g} px, with the object "
        f"rotated about its z axis; curvilinear saliency on depth. Crops of {settings.image_size} px, mean over "
        f"N = {len(cases)}."
    )
    return Table("curve", "Repeatability around the true view", text, ["offset_deg", *detectors], rows, curve=True)


def _no_scores() -> Scores:
    return defaultdict(lambda: defaultdict(list))


def _crop(case: Case, settings: BankSettings) -> Tensor:
    """(1, 1, S, S) grey crop."""
    grey: Tensor = rgb_to_grayscale(case.crop(settings))
    return grey


def _depth(describe: ViewDescriber, R: Tensor, distance: float) -> Tensor:
    """Depth (N, 1, S, S) of the views (..., 3, 3) at ``distance`` in model units."""
    R = R.reshape(-1, 3, 3)
    return describe.depth(R, torch.full((len(R),), distance, dtype=torch.float64))[0]


def _points(depth: Tensor, settings: BankSettings, name: str = "CS") -> Tensor:
    """(N, S, S) bool, feature points of the depth filter ``name``."""
    with torch.no_grad():
        field = depth_filter(replace(settings, depth_field=name))(depth)
    return field_points(field, fraction=settings.point_fraction)[:, 0]


def _table(name: str, title: str, text: str, scores: Scores, columns: list[str]) -> Table:
    """One row of means per category, and the mean of all photographs."""
    everything = {c: [v for by_name in scores.values() for v in by_name[c]] for c in columns}
    means: list[list[Cell]] = [
        [category, *(fmean(values[c]) if values[c] else float("nan") for c in columns)]
        for category, values in [*sorted(scores.items()), ("all", everything)]
    ]
    return Table(name, title, text, ["category", *columns], means)

"""How well feature points of photographs and of the right view fall on each other: IP, HD, repeatability."""

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
from .tables import Table

__all__ = ["CURVE_OFFSETS", "curve_table", "detector_tables", "repeatability_table"]

CURVE_OFFSETS = tuple(range(-100, 100, 5))
"""Degrees about the object's z axis: 40 views, the right one in the middle."""

CURVE_DETECTORS = ("mfc", "mcs", "ig", "sift", "sobel")


def detector_tables(cases: list[Case], settings: BankSettings, eps_px: float, progress: bool = True) -> list[Table]:
    """IP and Hausdorff distances of every detector against the curvilinear saliency of the right view, per category."""
    detectors = photo_detectors(settings.point_fraction)
    scores: dict[str, dict[str, dict[str, list[float]]]] = {
        name: defaultdict(lambda: defaultdict(list)) for name in ("ip", "hausdorff", "hausdorff_95", "points")
    }
    for mesh, group in grouped(cases, "detectors", progress):
        describe = ViewDescriber(mesh, settings)
        for case in group:
            view = _view_points(describe, settings, *case.view(mesh))
            crop = _crop(case, settings)
            anywhere = intersection_percentage(torch.ones_like(view), view, eps_px=eps_px)
            scores["ip"][case.category]["chance"].append(float(anywhere))
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
    where = f"Crops of {settings.image_size} px, N = {len(cases)}; mean over photographs in which points were found"
    told = {
        "ip": (
            "Intersection percentage",
            f"share of the photograph's points within {eps_px:g} px of a point of the view; chance: of all pixels",
        ),
        "hausdorff": ("Hausdorff distance", "in px of the crop"),
        "hausdorff_95": ("Hausdorff distance, 95th percentile", "in px of the crop"),
        "points": ("Number of points", "in the photograph's crop"),
    }
    tables = []
    for name, (title, text) in told.items():
        columns = [*detectors, "chance"] if name == "ip" else [*detectors]
        rows = _rows(scores[name], columns)
        tables.append(Table(name, f"{title}, by detector", f"{title}: {text}. {where}.", ["category", *columns], rows))
    return tables


def repeatability_table(cases: list[Case], settings: BankSettings, eps_px: float, progress: bool = True) -> Table:
    """Repeatability of each depth filter's points in each photograph filter's points."""
    detectors = {n: d for n, d in photo_detectors(settings.point_fraction).items() if n in PHOTO_FIELDS}
    depths = ("CS", "ASG", "HFN")
    columns = [f"{d}/{p}" for d in depths for p in detectors]
    scores: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
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
        f"Repeatability: share of the points of the right view with a point of the photograph within {eps_px:g} px. "
        f"Crops of {settings.image_size} px, {settings.point_fraction:.0%} of the pixels at most, N = {len(cases)}."
    )
    return Table(
        "repeatability",
        "Repeatability, depth filter / photograph filter",
        text,
        ["category", *columns],
        _rows(scores, columns),
    )


def curve_table(cases: list[Case], settings: BankSettings, eps_px: float, progress: bool = True) -> Table:
    """Repeatability in 40 views around the right one."""
    detectors = {n: d for n, d in photo_detectors(settings.point_fraction).items() if n.lower() in CURVE_DETECTORS}
    angles = torch.deg2rad(torch.tensor(CURVE_OFFSETS, dtype=torch.float64))
    turns = torch.zeros(len(angles), 3, 3, dtype=torch.float64)
    turns[:, 0, 0] = turns[:, 1, 1] = angles.cos()
    turns[:, 1, 0], turns[:, 0, 1], turns[:, 2, 2] = angles.sin(), -angles.sin(), 1.0
    sums = torch.zeros(len(detectors), len(angles), dtype=torch.float64)
    for mesh, group in grouped(cases, "curve", progress):
        describe = ViewDescriber(mesh, settings)
        for case in group:
            R, distance = case.view(mesh)
            views = _view_points(describe, settings, R @ turns, distance)
            crop = _crop(case, settings)
            for k, detect in enumerate(detectors.values()):
                photo = detect(crop).expand_as(views)
                sums[k] += view_repeatability(views, photo, eps_px=eps_px).nan_to_num().double()
    rows = [[float(o), *means] for o, means in zip(CURVE_OFFSETS, (sums / len(cases)).T.tolist(), strict=True)]
    text = (
        f"Share of the points of the view with a point of the photograph within {eps_px:g} px, the object turned about "
        f"its z axis; curvilinear saliency on depth. Crops of {settings.image_size} px, mean over N = {len(cases)}."
    )
    return Table(
        "curve", "Repeatability around the right view", text, ["offset_deg", *detectors], list(rows), curve=True
    )


def _crop(case: Case, settings: BankSettings) -> Tensor:
    """(1, 1, S, S) grey crop."""
    grey: Tensor = rgb_to_grayscale(case.crop(settings))
    return grey


def _depth(describe: ViewDescriber, R: Tensor, distance: float) -> Tensor:
    """Depth (N, 1, S, S) of the views (..., 3, 3) at ``distance`` in model units."""
    R = R.reshape(-1, 3, 3)
    distances = torch.full((len(R),), distance, dtype=torch.float64)
    return describe.depth(R, distances)[0]


def _points(depth: Tensor, settings: BankSettings, name: str = "CS") -> Tensor:
    with torch.no_grad():
        field = depth_filter(replace(settings, depth_field=name))(depth)
    return field_points(field, fraction=settings.point_fraction)[:, 0]


def _view_points(describe: ViewDescriber, settings: BankSettings, R: Tensor, distance: float) -> Tensor:
    return _points(_depth(describe, R, distance), settings)


def _rows(scores: dict[str, dict[str, list[float]]], columns: list[str]) -> list[list[str | float]]:
    """One row of means per category, and the mean of all photographs."""
    everything = {c: [v for by_name in scores.values() for v in by_name[c]] for c in columns}
    table = [*sorted(scores.items()), ("all", everything)]
    return [[name, *(fmean(values[c]) if values[c] else float("nan") for c in columns)] for name, values in table]

"""The measurements of the paper, on any of the datasets."""

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
import trimesh
from kornia.color import rgb_to_grayscale
from torch import Tensor, nn
from tqdm import tqdm

from curvireg_torch.data import read_image
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.evaluation import DATASETS
from curvireg_torch.evaluation.benchmarks import UNOCCLUDED
from curvireg_torch.evaluation.metrics import average_recall
from curvireg_torch.features import field_points
from curvireg_torch.filters import ImageGradient, MultiScaleCurvilinearSaliency, MultiScaleFocusCurves
from curvireg_torch.geometry import ViewSphere, crop_images, rotation_error, rotation_towards, viewpoint_from_rotation
from curvireg_torch.geometry.viewpoint import DEFAULT_DISTANCE
from curvireg_torch.matching import ViewBank, ViewDescriber, ViewMatcher
from curvireg_torch.matching.describe import depth_filter
from curvireg_torch.mesh import load_mesh, mesh_centre, mesh_radius
from curvireg_torch.pipeline import BankSettings, Pipeline
from curvireg_torch.utils.files import write_csv, write_file
from scripts._shared import table_lines
from scripts.paper.detectors import DETECTORS
from scripts.paper.measures import angle_errors, hausdorff_distance, intersection_percentage, rank_precision

Cell = str | float


@dataclass(frozen=True)
class Table:
    """Rows of numbers with their definition.

    Attributes:
        name: of the files.
        title, definition: what was measured, on what.
        columns: the first names the rows.
        rows: as long as ``columns``.
    """

    name: str
    title: str
    definition: str
    columns: list[str]
    rows: list[list[Cell]]

    def markdown(self) -> str:
        """Title, definition and table, three digits."""
        lines = table_lines([self.columns, *([_short(v) for v in row] for row in self.rows)])
        return "\n".join([f"## {self.title}", "", self.definition, "", *lines, ""])


def write_table(table: Table, folder: Path) -> list[Path]:
    """Write ``NAME.csv`` and ``NAME.md``; returns their paths."""
    paths = [folder / f"{table.name}.{suffix}" for suffix in ("csv", "md")]
    write_csv(paths[0], [table.columns, *table.rows])
    write_file(paths[1], table.markdown().encode())
    return paths


def _short(value: Cell) -> str:
    if isinstance(value, str):
        return value
    return "-" if math.isnan(value) else f"{value:.3g}"


@dataclass(frozen=True)
class Case:
    """One object in one photograph.

    Attributes:
        category: class or object.
        image_path, mesh_path, unit: files, and the unit of the mesh.
        box: (4,) x0, y0, x1, y1 in px.
        pose: (3, 4) float64 model to camera; without translation (NaN) it is that of a camera that looks at the box.
    """

    category: str
    image_path: str
    mesh_path: str
    unit: str
    box: Tensor
    pose: Tensor

    def crop(self, settings: BankSettings) -> Tensor:
        """(1, 3, S, S) crop of the photograph, framed as the views of a bank."""
        image = read_image(self.image_path)
        return crop_images([image], self.box[None], size=settings.image_size, margin=settings.margin)[0]

    def view(self, mesh: trimesh.Trimesh) -> tuple[Tensor, float]:
        """Rotation (3, 3) and distance in model units of a camera that looks at the object's centre.

        Without translation the distance is that of banks.
        """
        R, t = self.pose[:, :3], self.pose[:, 3]
        if not bool(t.isfinite().all()):
            return R, DEFAULT_DISTANCE * mesh_radius(mesh)
        centre = R @ mesh_centre(mesh) + t
        return rotation_towards(centre).T @ R, float(torch.linalg.vector_norm(centre))


def find_cases(kind: str, root: Path, *, pixel_origin: int = 1, limit: int | None = None) -> list[Case]:
    """The objects that the paper uses: neither occluded nor truncated, with known pose; grouped by mesh.

    ``kind`` is "pascal3d", "bop" or "web"; ``limit`` uses only this many, spread evenly.
    """
    row = DATASETS[kind]
    origin = {"pixel_origin": pixel_origin} if "pixel_origin" in row.options else {}
    dataset = row.open(root, **row.whole, **origin)
    cases = [case for i in range(len(dataset)) if (case := _case(row, dataset.annotation(i))) is not None]
    if not cases:
        raise InvalidInputError(f"{root}: holds no whole object with a known pose")
    if limit is not None and limit < len(cases):
        cases = [cases[i * len(cases) // limit] for i in range(limit)]
    return sorted(cases, key=lambda case: case.mesh_path)


def _case(kind: Any, s: dict[str, Any]) -> Case | None:
    translation = s.get("translation", torch.full((3,), math.nan))
    pose = torch.cat([s["rotation"], translation[:, None]], dim=1).double()
    known = bool(pose[:, :3].isfinite().all() and s["box"].isfinite().all())
    if not known or s.get("visib_fract", 1.0) < UNOCCLUDED:
        return None
    return Case(
        kind.category.format_map(s), s["image_path"], str(s[kind.scored.mesh]), kind.scored.unit, s["box"], pose
    )


def grouped(cases: list[Case], label: str, progress: bool) -> Iterator[tuple[trimesh.Trimesh, list[Case]]]:
    """Meshes with their cases; one mesh is in memory at a time."""
    with tqdm(total=len(cases), desc=label, unit="photo", disable=not progress) as bar:
        for (path, unit), group in groupby(cases, key=lambda case: (case.mesh_path, case.unit)):
            chosen = list(group)
            yield load_mesh(path, unit=unit), chosen
            bar.update(len(chosen))


PHOTO_FIELDS: dict[str, Callable[[], nn.Module]] = {
    "MFC": MultiScaleFocusCurves,
    "MCS": MultiScaleCurvilinearSaliency,
    "IG": ImageGradient,
}
"""The paper's filters of photographs, by their names there."""

CURVE_OFFSETS = tuple(range(-100, 100, 5))  # degrees about the object's z axis: 40 views, the true one in the middle

CURVE_DETECTORS = ("mfc", "mcs", "ig", "sift", "sobel")

Scores = defaultdict[str, defaultdict[str, list[float]]]  # values by category and column


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
                "points": photo.sum().float(),
            }
            for table, value in values.items():
                if bool(value.isfinite().all()):
                    scores[table][category][name].append(float(value))
    where = f"Crops of {settings.image_size} px, N = {len(cases)}; mean over photographs with points"
    hits = f"fraction of the photograph's points within {eps_px:g} px of a point of the view; chance: of all pixels"
    definitions = {
        "ip": ("Intersection percentage", hits),
        "hausdorff": ("Hausdorff distance", "in px of the crop"),
        "points": ("Number of points", "in the photograph's crop"),
    }
    tables = []
    for name, (title, text) in definitions.items():
        columns = [*detectors, "chance"] if name == "ip" else [*detectors]
        tables.append(_table(name, f"{title}, by detector", f"{title}: {text}. {where}.", scores[name], columns))
    return tables


def repeatability_table(cases: list[Case], settings: BankSettings, eps_px: float, progress: bool = True) -> Table:
    """Repeatability of each depth filter's points in each photograph filter's points."""
    detectors = _photo_detectors(settings, PHOTO_FIELDS)
    depths = ("CS", "ASG", "HFN")
    scores = _no_scores()
    for category, depth, crop in _views(cases, settings, "repeatability", progress):
        photos = {name: detect(crop) for name, detect in detectors.items()}
        for name in depths:
            view = _view_points(depth, replace(settings, depth_field=name))
            for photo_name, photo in photos.items():
                value = intersection_percentage(view, photo, eps_px=eps_px)
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
            sums[k] += intersection_percentage(views, detect(crop).expand_as(views), eps_px=eps_px).nan_to_num()
    means = (sums / len(cases)).T.tolist()
    text = (
        f"Fraction of the points of the view with a point of the photograph within {eps_px:g} px, with the object "
        f"rotated about its z axis; curvilinear saliency on depth. Crops of {settings.image_size} px, mean over "
        f"N = {len(cases)}."
    )
    rows: list[list[Cell]] = [[float(offset), *line] for offset, line in zip(CURVE_OFFSETS, means, strict=True)]
    return Table("curve", "Repeatability around the true view", text, ["offset_deg", *detectors], rows)


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
        return field_points(depth_filter(settings)(depth), fraction=settings.point_fraction)[:, 0]


def _photo_detectors(settings: BankSettings, names: Iterable[str] = DETECTORS) -> dict[str, Callable[[Tensor], Tensor]]:
    """Detectors (B, 1, H, W) -> bool (B, H, W) of the paper's filters and the classical ones, by name in capitals."""

    def points(detect: Callable[..., Tensor], image: Tensor) -> Tensor:
        return detect(image, fraction=settings.point_fraction)[:, 0]

    return {name.upper(): partial(points, DETECTORS[name.lower()]) for name in names}


def _table(name: str, title: str, text: str, scores: Scores, columns: list[str]) -> Table:
    """One row of means per category, and the mean of all photographs."""
    everything = {c: [v for by_name in scores.values() for v in by_name[c]] for c in columns}
    means: list[list[Cell]] = [
        [category, *(fmean(values[c]) if values[c] else float("nan") for c in columns)]
        for category, values in [*sorted(scores.items()), ("all", everything)]
    ]
    return Table(name, title, text, ["category", *columns], means)


RANKS = (1, 3, 5, 10, 20)
THRESHOLD_DEG = 30.0


@dataclass(frozen=True)
class Rankings:
    """The best views of each photograph, for each pair of filters.

    Attributes:
        views: of all banks.
        categories: (B) of the photographs.
        truth: (B, 3) azimuth, elevation, theta in degrees.
        errors: (B, N) rotation errors of the views, degrees.
        orders: pair such as "CS/MFC" -> (B, 20) indices of the best views.
    """

    views: ViewSphere
    categories: list[str]
    truth: Tensor
    errors: Tensor
    orders: dict[str, Tensor]

    @property
    def definition(self) -> str:
        settings = "no refinement, CAD and box as annotated"
        return f"{len(self.views)} views per object, {settings}, N = {len(self.categories)}."


@torch.no_grad()
def rank_views(cases: list[Case], views: ViewSphere, settings: BankSettings, progress: bool = True) -> Rankings:
    """Rank all views for every photograph with {CS, ASG, AR} x {MFC, MCS, IG}."""
    depths = ("CS", "ASG", "AR")
    photos = {name: make() for name, make in PHOTO_FIELDS.items()}
    categories: list[str] = []
    truth, errors = [], []
    orders: dict[str, list[Tensor]] = {f"{d}/{p}": [] for d in depths for p in photos}
    for mesh, group in grouped(cases, "rankings", progress):
        crops = torch.cat([case.crop(settings) for case in group])
        for case in group:
            R, _ = case.view(mesh)
            categories.append(case.category)
            truth.append(torch.tensor([*map(float, viewpoint_from_rotation(R))]))
            errors.append(rotation_error(R[None].float(), views.rotations))
        for depth in depths:
            pipeline = replace(Pipeline(), bank=replace(settings, depth_field=depth))
            bank = ViewBank.build(mesh, views, pipeline=pipeline, progress=False)
            for photo, field in photos.items():
                matcher = ViewMatcher(bank, field=field)
                for chunk in crops.split(16):
                    orders[f"{depth}/{photo}"].append(matcher.rank(matcher.features(chunk)).top(max(RANKS)))
    found = {name: torch.cat(parts) for name, parts in orders.items()}
    return Rankings(views, categories, torch.stack(truth), torch.stack(errors), found)


def precision_table(rankings: Rankings) -> Table:
    """Fraction of the photographs whose best view is nearly right, per category."""
    rows: list[list[Cell]] = []
    for category in [*sorted(set(rankings.categories)), "all"]:
        mask = torch.tensor([category in (c, "all") for c in rankings.categories])
        best = [rankings.errors.gather(1, order[:, :1])[mask, 0] for order in rankings.orders.values()]
        rows.append([category, *(average_recall(errors, (THRESHOLD_DEG,)) for errors in best)])
    text = (
        f"Precision: fraction of the photographs whose best view is within {THRESHOLD_DEG:g} degrees of the true one. "
        f"{rankings.definition}"
    )
    return Table("precision", "Precision, depth filter / photograph filter", text, ["category", *rankings.orders], rows)


def rank_table(rankings: Rankings) -> Table:
    """Precision at rank 1, 3, 5, 10, 20."""
    columns = [
        rank_precision(order, rankings.errors, ks=RANKS, threshold_deg=THRESHOLD_DEG)
        for order in rankings.orders.values()
    ]
    rows: list[list[Cell]] = [[float(k), *(column[k] for column in columns)] for k in RANKS]
    text = (
        f"Fraction of the photographs with a view within {THRESHOLD_DEG:g} degrees of the true one among the best k. "
        f"{rankings.definition}"
    )
    return Table("ranks", "Precision at rank k", text, ["k", *rankings.orders], rows)


def angle_table(rankings: Rankings) -> Table:
    """Mean errors of elevation, azimuth and in-plane angle: of the estimate and of the closest view of the bank."""
    v = rankings.views
    views = torch.stack([v.azimuth, v.elevation, v.theta], dim=1)
    rows: list[list[Cell]] = []
    for name, order in rankings.orders.items():
        means = angle_errors(views[order[:, 0]], rankings.truth, views)
        rows.append([name, *(means[k][a] for a in ("elevation", "azimuth", "theta") for k in ("est", "clo"))])
    text = (
        "Mean absolute errors in degrees: Est. of the best-ranked view, Clo. of the view that is closest to the true "
        f"one. {rankings.definition}"
    )
    columns = [f"{angle} {kind}" for angle in ("elevation", "azimuth", "in-plane") for kind in ("Est.", "Clo.")]
    return Table("angles", "Errors of angles", text, ["filters", *columns], rows)

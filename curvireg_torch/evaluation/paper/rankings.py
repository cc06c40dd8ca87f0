"""Rank of the true view: precision, precision at rank k, errors of the angles."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ...geometry import ViewSphere, rotation_error, viewpoint_from_rotation
from ...matching import ViewBank, ViewMatcher
from ...metrics import accuracy, pose_parameter_errors, rank_precision
from ...pipeline import BankSettings
from .cases import Case, grouped
from .points import PHOTO_FIELDS
from .tables import Cell, Table

__all__ = ["angle_table", "precision_table", "rank_tables", "rank_views"]

RANKS = (1, 3, 5, 10, 20)
THRESHOLD_DEG = 30.0


@dataclass(frozen=True)
class Rankings:
    """The best views of each photograph, for each pair of filters.

    Attributes:
        views: of all banks.
        categories: (B) of the photographs.
        truth: (B, 4) azimuth, elevation, theta in degrees, and distance 0, as banks have one distance.
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
            truth.append(torch.tensor([*map(float, viewpoint_from_rotation(R)), 0.0]))
            errors.append(rotation_error(R[None].float(), views.rotations))
        for depth in depths:
            bank = ViewBank.build(mesh, views, settings=replace(settings, depth_field=depth), progress=False)
            for photo, field in photos.items():
                matcher = ViewMatcher(bank, field=field)
                for chunk in crops.split(matcher.chunk_size):
                    orders[f"{depth}/{photo}"].append(matcher.rank(matcher.features(chunk)).top(max(RANKS)))
    found = {name: torch.cat(parts) for name, parts in orders.items()}
    return Rankings(views, categories, torch.stack(truth), torch.stack(errors), found)


def precision_table(rankings: Rankings) -> Table:
    """Fraction of the photographs whose best view is nearly right, per category."""
    rows: list[list[Cell]] = []
    for category in [*sorted(set(rankings.categories)), "all"]:
        mask = torch.tensor([category in (c, "all") for c in rankings.categories])
        best = [rankings.errors.gather(1, order[:, :1])[mask, 0] for order in rankings.orders.values()]
        rows.append([category, *(accuracy(errors, THRESHOLD_DEG) for errors in best)])
    text = (
        f"Precision: fraction of the photographs whose best view is within {THRESHOLD_DEG:g} degrees of the true one. "
        f"{rankings.definition}"
    )
    return Table("precision", "Precision, depth filter / photograph filter", text, ["category", *rankings.orders], rows)


def rank_tables(rankings: Rankings) -> list[Table]:
    """Precision at rank 1, 3, 5, 10, 20, in two readings of a definition that the paper leaves open."""
    readings = (
        ("ranks", f"a view within {THRESHOLD_DEG:g} degrees of the true one", THRESHOLD_DEG),
        ("ranks_nearest", "the view of the bank that is nearest to the true one", None),
    )
    names = ["k", *rankings.orders]
    tables = []
    for name, reading, limit in readings:
        orders = rankings.orders.values()
        columns = [rank_precision(order, rankings.errors, ks=RANKS, threshold_deg=limit) for order in orders]
        rows: list[list[Cell]] = [[float(k), *(column[k] for column in columns)] for k in RANKS]
        text = f"Fraction of the photographs with {reading} among the best k. {rankings.definition}"
        tables.append(Table(name, f"Precision at rank k: {reading}", text, names, rows, curve=True))
    return tables


def angle_table(rankings: Rankings) -> Table:
    """Mean errors of elevation, azimuth and in-plane angle: of the estimate and of the closest view of the bank."""
    v = rankings.views
    views = torch.stack([v.azimuth, v.elevation, v.theta, torch.zeros(len(v))], dim=1)
    rows: list[list[Cell]] = []
    for name, order in rankings.orders.items():
        means = pose_parameter_errors(views[order[:, 0]], rankings.truth, views)
        rows.append([name, *(means[k][a] for a in ("elevation", "azimuth", "theta") for k in ("est", "clo"))])
    text = (
        "Mean absolute errors in degrees: Est. of the best-ranked view, Clo. of the view that is closest to the true "
        f"one. Distance is omitted: banks have one. {rankings.definition}"
    )
    columns = [f"{angle} {kind}" for angle in ("elevation", "azimuth", "in-plane") for kind in ("Est.", "Clo.")]
    return Table("angles", "Errors of angles", text, ["filters", *columns], rows)

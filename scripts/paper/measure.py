"""What the paper measures, for the photographs of one mesh: values that its tables are made of.

Ranking is by the paper's S_hog and S_rep alone, in three variants: ``literal`` is the preset
``paper``; ``printed`` has what docs/method.md corrects, in perspective views of the mesh in its own
frame, and S_hog as the paper prints it; ``corrected`` is that with S_hog as a cosine.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from kornia.color import rgb_to_grayscale
from skimage.metrics import hausdorff_distance
from torch import Tensor, nn

from curvireg_torch.features import field_points
from curvireg_torch.filters import (
    ImageGradient,
    MultiScaleCurvilinearSaliency,
    MultiScaleFocusCurves,
)
from curvireg_torch.filters.focus import PAPER_THRESHOLD
from curvireg_torch.geometry import (
    pose_from_box,
    rotation_error,
    rotation_from_axis_angle,
    viewpoint_from_rotation,
)
from curvireg_torch.matching import ViewBank, ViewDescriber, ViewMatcher
from curvireg_torch.matching.search import BEST_VIEWS, coherent_of, different_views, refine, search
from curvireg_torch.mesh import Mesh
from curvireg_torch.pipeline import FIELDS, PRESETS, BankSettings, Pipeline, ViewPolicy
from scripts._shared import RIGHT_DEG, Record
from scripts.paper.cases import Case
from scripts.paper.detectors import DETECTORS
from scripts.paper.measures import share_near
from scripts.paper.tables import (
    CURVE_OFFSETS,
    PAIRS,
    PHOTOS,
    RANKS,
    REFINED_PAIRS,
    REPEATED_DEPTHS,
    SEARCHED_PAIRS,
)

CURVE_DETECTORS = ("MFC", "MCS", "IG", "SIFT", "SOBEL")
SENSITIVE = ("MFC", "MCS", "IG", "SOBEL", "CANNY")
EPS_OF_SHARES = {0.01: (2.0,), 0.02: (2.0,), 0.04: (1.0, 2.0, 3.0, 4.0), 0.08: (2.0,)}
"""Radii in px, of each share of the pixels that are points: one of the two is usual."""

BEST_PAIR = "CS/MFC"
KNOWN_AZIMUTH_DEG = 45.0
THRESHOLDS = (0.001, PAPER_THRESHOLD, 0.01, 0.03, 0.06, 0.1)


def variants(pose: str) -> dict[str, Pipeline]:
    """The three variants of the paper's ranking and search."""
    literal = PRESETS["paper"]
    views = replace(literal, views=ViewPolicy(pose), bank=BankSettings())
    printed = views.with_term("repeatability", mode="monotone")
    corrected = printed.with_term("hog", whitening="none")
    return {"literal": literal, "printed": printed, "corrected": corrected}


def focus_fields() -> dict[str, nn.Module]:
    """Focus curves of every threshold, alone and weighted by CS, then the fields beside them."""
    weights = {"MFC": 0.0, "MFC x CS": 1.0}
    curves = {
        f"{name} {threshold:.4f}": MultiScaleFocusCurves(
            saliency_weight=weight, threshold=threshold
        )
        for name, weight in weights.items()
        for threshold in THRESHOLDS
    }
    return {**curves, "MCS": MultiScaleCurvilinearSaliency(), "IG": ImageGradient()}


def photo_fields(variant: str) -> dict[str, nn.Module]:
    """The paper's filters of photographs."""
    exact = MultiScaleFocusCurves(saliency_weight=0.0, threshold=PAPER_THRESHOLD)
    focus = FIELDS["MFC"]() if variant == "literal" else exact
    return {"MFC": focus, "MCS": MultiScaleCurvilinearSaliency(), "IG": ImageGradient()}


def sized(pipeline: Pipeline, settings: BankSettings) -> Pipeline:
    """The pipeline with crops as in ``settings``."""
    bank = replace(pipeline.bank, image_size=settings.image_size, margin=settings.margin)
    return replace(pipeline, bank=bank)


def detected(crop: Tensor, share: float) -> dict[str, Tensor]:
    """Points (H, W) bool of every detector in a crop (1, 1, H, W), by name in capitals."""
    return {name.upper(): detect(crop, share)[0, 0] for name, detect in DETECTORS.items()}


@torch.no_grad()
def measure_points(
    mesh: Mesh,
    cases: list[Case],
    settings: BankSettings,
    _pose: str,
) -> list[Record]:
    """Agreement of the points of photographs with those of the views at their true poses."""
    describers = {
        name: ViewDescriber(mesh, replace(settings, depth_field=name)) for name in REPEATED_DEPTHS
    }
    return [_points_of(case, mesh, describers, settings) for case in cases]


def _points_of(
    case: Case,
    mesh: Mesh,
    describers: dict[str, ViewDescriber],
    settings: BankSettings,
) -> Record:
    crop = rgb_to_grayscale(case.crop(settings))
    R, distance = case.view(mesh)
    distances = torch.tensor([distance], dtype=torch.float64)
    share = settings.point_fraction
    photos = detected(crop, share)
    fields = {name: describe.fields(R[None], distances) for name, describe in describers.items()}
    views = {name: field_points(field, fraction=share)[0, 0] for name, field in fields.items()}
    view = views["CS"]
    turned = R @ _turns_about_z()
    around = describers["CS"].fields(turned, distances.expand(len(turned)))
    circle = field_points(around, fraction=share)[:, 0]
    record = {
        "ip": {name: share_near(photo, view) for name, photo in photos.items()},
        "hausdorff": {
            name: hausdorff_distance(photo.numpy(), view.numpy()) for name, photo in photos.items()
        },
        "points": {name: int(photo.sum()) for name, photo in photos.items()},
        "repeatability": {
            f"{depth}/{name}": share_near(points, photos[name])
            for depth, points in views.items()
            for name in PHOTOS
        },
        "curve": {
            name: [share_near(one, photos[name]) for one in circle] for name in CURVE_DETECTORS
        },
        "sensitivity": {},
        "threshold": {},
    }
    record["ip"]["chance"] = share_near(torch.ones_like(view), view)
    for share, radii in EPS_OF_SHARES.items():
        few = field_points(fields["CS"], fraction=share)[0, 0]
        found = detected(crop, share)
        for name in SENSITIVE:
            for eps in radii:
                key = f"{name} {share:g} {eps:g}"
                record["sensitivity"][key] = share_near(found[name], few, eps_px=eps)
    for threshold in THRESHOLDS:
        field = FIELDS["MFC"](threshold=threshold)(crop)
        points = field_points(field, fraction=settings.point_fraction)[0, 0]
        record["threshold"][f"{threshold:.4f}"] = share_near(points, view)
    return record


def _turns_about_z() -> Tensor:
    """(40, 3, 3) rotations of the object about its z axis."""
    turns = torch.zeros(len(CURVE_OFFSETS), 3, dtype=torch.float64)
    turns[:, 2] = torch.deg2rad(torch.tensor(CURVE_OFFSETS))
    return rotation_from_axis_angle(turns)


@torch.no_grad()
def measure_views(
    mesh: Mesh,
    cases: list[Case],
    settings: BankSettings,
    pose: str,
) -> list[Record]:
    """Rankings of all views, and the poses that the paper's search finds, for each pair of
    filters."""
    describe = ViewDescriber(mesh, settings)
    views = [case.view(mesh)[0] for case in cases]
    truths = [Truth(case, R, describe) for case, R in zip(cases, views, strict=True)]
    crops = [case.crop(settings) for case in cases]
    records = [{} for _ in cases]
    banks = {}

    def matcher_of(pipeline: Pipeline, **bank: Any) -> ViewMatcher:
        """Variants that differ in their terms share views."""
        pipeline = replace(pipeline, bank=replace(pipeline.bank, **bank))
        key = (pipeline.views, pipeline.bank)
        if key not in banks:
            banks[key] = ViewBank.build(mesh, pipeline=pipeline, progress=False)
        return ViewMatcher(banks[key], pipeline=pipeline)

    for variant, pipeline in variants(pose).items():
        pipeline = sized(pipeline, settings)
        fields = photo_fields(variant)
        found = [record.setdefault(variant, {}) for record in records]
        for pair in PAIRS:
            depth, photo = pair.split("/")
            matcher = matcher_of(pipeline, depth_field=depth)
            matcher.field = fields[photo]
            for b, truth in enumerate(truths):
                found[b][pair] = _ranked(matcher, crops[b], truth, wider=pair in SEARCHED_PAIRS)
                if variant == "corrected" and pair in REFINED_PAIRS:
                    found[b][pair]["refined"] = _closest_refined(matcher, crops[b], truth)
        rotations = matcher.bank.rotations
        for b, truth in enumerate(truths):
            errors = truth.errors(rotations)
            found[b]["limit"] = truth.pose_errors(rotations[errors.argmin()])
            # what a ranking by lot and the best one would have
            found[b]["chance"] = float((errors < RIGHT_DEG).double().mean())
            found[b]["ceiling"] = float(errors.min() < RIGHT_DEG)
            found[b]["grid 8"] = found[b][BEST_PAIR]["top"][0]
        for grid in (4, 16):
            matcher = matcher_of(pipeline, grid=grid)
            matcher.field = fields["MFC"]
            for b, truth in enumerate(truths):
                best = matcher.rank(matcher.features(crops[b])).order[0, 0]
                found[b][f"grid {grid}"] = float(truth.errors(rotations)[best])
    return records


@dataclass(frozen=True)
class Truth:
    """The rotation ``R`` (3, 3) of a photograph's object, as a camera that looks at it sees it."""

    case: Case
    R: Tensor
    describe: ViewDescriber

    def errors(self, rotations: Tensor) -> Tensor:
        """Degrees between rotations (..., 3, 3) and the truth."""
        return rotation_error(self.R, rotations.double())

    def pose_errors(self, rotation: Tensor) -> list[float]:
        """Absolute errors of elevation, azimuth and in-plane angle in degrees, and of the distance,
        at which the view fills the box of the photograph, in percent."""
        found = torch.stack(viewpoint_from_rotation(rotation.double()))
        true = torch.stack(viewpoint_from_rotation(self.R))
        azimuth, elevation, theta = ((found - true + 180.0) % 360.0 - 180.0).abs().tolist()
        return [elevation, azimuth, theta, self.distance_error(rotation)]

    def distance_error(self, rotation: Tensor) -> float:
        case = self.case
        if not case.has_distance or case.camera is None:
            return math.nan
        centre = self.describe.centre
        box = case.box.double()
        R, t = pose_from_box(self.describe.hull, rotation.double(), box, case.camera.double())
        true = torch.linalg.vector_norm(case.pose[:, :3] @ centre + case.pose[:, 3])
        return 100.0 * abs(float(torch.linalg.vector_norm(R @ centre + t) / true) - 1.0)


def _ranked(
    matcher: ViewMatcher,
    crop: Tensor,
    truth: Truth,
    *,
    wider: bool,
) -> Record:
    """``wider``: with what the search finds between views down the ranking until two are
    coherent."""
    rotations = matcher.bank.rotations
    query = matcher.features(crop)
    ranking = matcher.rank(query)
    # Views at several distances are one picture to an orthographic camera.
    top = different_views(rotations, ranking.order[0], max(RANKS))
    errors = truth.errors(rotations[top])
    rotation, _ = search(matcher, query, ranking)
    closest = top[errors[:BEST_VIEWS].argmin()]
    record = {
        "top": errors.tolist(),
        "est": truth.pose_errors(rotation),
        "found": float(truth.errors(rotation)),
        "coherent": len(coherent_of(matcher.bank, ranking)),
        "clo": truth.pose_errors(rotations[closest]),
    }
    if wider:
        if record["coherent"] == 1:
            rotation, _ = search(matcher, query, ranking, least_coherent=2)
        record["wider found"] = float(truth.errors(rotation))
    return record


def _closest_refined(matcher: ViewMatcher, crop: Tensor, truth: Truth) -> list[float]:
    """Errors of the closest of the three retrieved views, each replaced by the best of a grid of 5°
    as far as half way to the next view of the bank."""
    query = matcher.features(crop)
    order = matcher.rank(query).order[0]
    views = different_views(matcher.bank.rotations, order, BEST_VIEWS)
    refined = torch.stack([refine(matcher, query, int(view)) for view in views])
    return truth.pose_errors(refined[truth.errors(refined).argmin()])


@torch.no_grad()
def measure_focus(
    mesh: Mesh,
    cases: list[Case],
    settings: BankSettings,
    pose: str,
) -> list[Record]:
    """IP and the best views of focus curves by threshold, and of the fields beside them, in the
    ranking "corrected"; and what of them is right by other protocols."""
    pipeline = sized(variants(pose)["corrected"], settings)
    bank = ViewBank.build(mesh, pipeline=pipeline, progress=False)
    matcher = ViewMatcher(bank, pipeline=pipeline)
    azimuths = torch.stack([viewpoint_from_rotation(R)[0] for R in bank.rotations.double()])
    return [_focus_of(case, mesh, matcher, azimuths) for case in cases]


def _focus_of(
    case: Case,
    mesh: Mesh,
    matcher: ViewMatcher,
    azimuths: Tensor,
) -> Record:
    rotations = matcher.bank.rotations.double()
    settings = matcher.bank.settings
    crop = case.crop(settings)
    R, distance = case.view(mesh)
    field = matcher.describer.fields(R[None], torch.tensor([distance], dtype=torch.float64))
    view = field_points(field, fraction=settings.point_fraction)[0, 0]
    errors = rotation_error(R, rotations)
    half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64))
    turned = torch.minimum(errors, rotation_error(R @ half_turn, rotations))
    apart = (azimuths - viewpoint_from_rotation(R)[0] + 180.0) % 360.0 - 180.0
    is_near = apart.abs() <= KNOWN_AZIMUTH_DEG
    right = (errors < RIGHT_DEG).double()
    by_lot = float(right.mean())
    record = {
        "chance": {
            "right": by_lot,
            "half turn": float((turned < RIGHT_DEG).double().mean()),
            "azimuth": float(right[is_near].mean()),
            "top 20": 1.0 - (1.0 - by_lot) ** 20,
        }
    }
    for name, matcher.field in focus_fields().items():
        query = matcher.features(crop)
        order = matcher.rank(query).order[0]
        record[name] = {
            "ip": share_near(query.points[0, 0], view),
            "right": float(errors[order[0]]),
            "half turn": float(turned[order[0]]),
            "azimuth": float(errors[order[is_near[order]][0]]),
            "top 20": float(errors[order[:20]].min()),
        }
    return record


MEASURES = {"points": measure_points, "views": measure_views, "focus": measure_focus}

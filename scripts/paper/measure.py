"""What the paper measures, for the photographs of one mesh: values that its tables are made of.

Ranking is by the paper's S_hog and S_rep alone, in three variants: ``literal`` is the preset
``paper``; ``printed`` has what docs/method.md corrects, in perspective views of the mesh in its own
frame, and S_hog as the paper prints it; ``corrected`` is that with S_hog as a cosine.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from kornia.color import rgb_to_grayscale
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
from curvireg_torch.mesh import Mesh, load_mesh
from curvireg_torch.pipeline import FIELDS, PRESETS, BankSettings, Pipeline, ViewPolicy
from scripts.paper.cases import Case
from scripts.paper.detectors import DETECTORS
from scripts.paper.measures import (
    angle_differences,
    hausdorff_distance,
    intersection_percentage,
    points_within,
    repeatability,
)
from scripts.paper.tables import (
    CURVE_OFFSETS,
    PHOTOS,
    RANKS,
    REFINED_PAIRS,
    REPEATED_DEPTHS,
    RIGHT_DEG,
    SEARCHED_PAIRS,
)

Record = dict[str, Any]

DEPTHS = ("CS", "ASG", "AR")
CURVE_DETECTORS = ("MFC", "MCS", "IG", "SIFT", "SOBEL")
SENSITIVE = ("MFC", "MCS", "IG", "SOBEL", "CANNY")
EPS = (1.0, 2.0, 3.0, 4.0)
SHARES = (0.01, 0.02, 0.04, 0.08)
BEST_PAIR = "CS/MFC"
KNOWN_AZIMUTH_DEG = 45.0
FOCUS_BATCH = 16  # photographs
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


class Remembered:
    """A renderer of one mesh that renders every view once."""

    def __init__(self, mesh: Mesh) -> None:
        self._inner = ViewDescriber(mesh, BankSettings()).view_renderer
        self.name = self._inner.name
        self._known = {}

    def render(
        self,
        T_cam_from_model: Tensor,
        camera_matrix: Tensor,
        size: tuple[int, int],
        *,
        orthographic: bool = False,
    ) -> Tensor:
        numbers = torch.cat([T_cam_from_model.flatten(), camera_matrix.flatten()]).numpy().tobytes()
        key = numbers + bytes(f"{size} {orthographic}", "ascii")
        if key not in self._known:
            self._known[key] = self._inner.render(
                T_cam_from_model, camera_matrix, size, orthographic=orthographic
            )
        return self._known[key].clone()


def detectors_of(share: float) -> dict[str, Callable[[Tensor], Tensor]]:
    """Detectors (1, 1, H, W) -> (H, W) bool, by name in capitals."""

    def points(detect: Callable[..., Tensor], image: Tensor) -> Tensor:
        return detect(image, fraction=share)[0, 0]

    return {name.upper(): partial(points, detect) for name, detect in DETECTORS.items()}


@torch.no_grad()
def measure_points(cases: list[Case], settings: BankSettings) -> list[Record]:
    """Agreement of the points of photographs with those of the views at their true poses."""
    mesh = load_mesh(cases[0].mesh_path, unit=cases[0].unit)
    describers = {
        name: ViewDescriber(mesh, replace(settings, depth_field=name)) for name in REPEATED_DEPTHS
    }
    return [_points_of(case, mesh, describers, settings) for case in cases]


def _points_of(
    case: Case, mesh: Mesh, describers: dict[str, ViewDescriber], settings: BankSettings
) -> Record:
    crop = rgb_to_grayscale(case.crop(settings))
    R, distance = case.view(mesh)
    turned = R @ _turns_about_z()
    around = turned, torch.full((len(turned),), distance, dtype=torch.float64)
    share = settings.point_fraction
    fields = {
        name: describe.fields(R[None], around[1][:1]) for name, describe in describers.items()
    }
    views = {name: field_points(field, fraction=share)[0, 0] for name, field in fields.items()}
    photos = {name: detect(crop) for name, detect in detectors_of(share).items()}
    view = views["CS"]
    record = {
        "ip": {name: float(intersection_percentage(photo, view)) for name, photo in photos.items()},
        "hausdorff": {
            name: float(hausdorff_distance(photo, view)) for name, photo in photos.items()
        },
        "points": {name: int(photo.sum()) for name, photo in photos.items()},
        "repeatability": {
            f"{depth}/{name}": float(repeatability(points, photos[name]))
            for depth, points in views.items()
            for name in PHOTOS
        },
    }
    record["ip"]["chance"] = float(intersection_percentage(torch.ones_like(view), view))
    circle = field_points(describers["CS"].fields(*around), fraction=share)[:, 0]
    record["curve"] = {
        name: [float(repeatability(one, photos[name])) for one in circle]
        for name in CURVE_DETECTORS
    }
    record["sensitivity"] = {}
    for share in SHARES:
        few = field_points(fields["CS"], fraction=share)[0, 0]
        detect = detectors_of(share)
        for name in SENSITIVE:
            found = points_within(detect[name](crop), few, EPS)
            record["sensitivity"] |= {
                f"{name} {share:g} {eps:g}": value for eps, value in zip(EPS, found, strict=True)
            }
    record["threshold"] = {}
    for threshold in THRESHOLDS:
        field = FIELDS["MFC"](threshold=threshold)(crop)
        points = field_points(field, fraction=settings.point_fraction)[0, 0]
        record["threshold"][f"{threshold:.4f}"] = float(intersection_percentage(points, view))
    return record


def _turns_about_z() -> Tensor:
    """(40, 3, 3) rotations of the object about its z axis."""
    turns = torch.zeros(len(CURVE_OFFSETS), 3, dtype=torch.float64)
    turns[:, 2] = torch.deg2rad(torch.tensor(CURVE_OFFSETS))
    return rotation_from_axis_angle(turns)


@torch.no_grad()
def measure_views(cases: list[Case], settings: BankSettings, pose: str) -> list[Record]:
    """Rankings of all views, and the poses that the paper's search finds, for each pair of
    filters."""
    mesh = load_mesh(cases[0].mesh_path, unit=cases[0].unit)
    renderer = Remembered(mesh)
    describe = ViewDescriber(mesh, settings)
    crops = torch.cat([case.crop(settings) for case in cases])
    truths = torch.stack([case.view(mesh)[0] for case in cases])
    records = [{} for _ in cases]
    banks = {}

    def bank_of(pipeline: Pipeline) -> ViewBank:
        """Variants that differ in their terms share views."""
        key = pipeline.views, pipeline.bank
        if key not in banks:
            banks[key] = ViewBank.build(mesh, pipeline=pipeline, renderer=renderer, progress=False)
        return banks[key]

    for variant, pipeline in variants(pose).items():
        bank_settings = replace(
            pipeline.bank, image_size=settings.image_size, margin=settings.margin
        )
        pipeline = replace(pipeline, bank=bank_settings)
        fields = photo_fields(variant)
        for depth in DEPTHS:
            given = replace(pipeline, bank=replace(bank_settings, depth_field=depth))
            bank = bank_of(given)
            errors = rotation_error(truths[:, None], bank.rotations.double())
            matcher = ViewMatcher(bank, pipeline=given, renderer=renderer)
            for photo in PHOTOS:
                matcher.field = fields[photo]
                for b, case in enumerate(cases):
                    wider = f"{depth}/{photo}" in SEARCHED_PAIRS
                    found = _ranked(matcher, crops[b], case, truths[b], errors[b], describe, wider)
                    if variant == "corrected" and f"{depth}/{photo}" in REFINED_PAIRS:
                        found["refined"] = _closest_refined(
                            matcher, crops[b], case, truths[b], describe
                        )
                    records[b].setdefault(variant, {})[f"{depth}/{photo}"] = found
        limit = errors.argmin(dim=1)
        for b, case in enumerate(cases):
            records[b][variant]["limit"] = _pose_errors(
                bank.rotations[limit[b]], case, truths[b], describe
            )
            # what a ranking by lot and the best one would have
            records[b][variant]["chance"] = float((errors[b] < RIGHT_DEG).double().mean())
            records[b][variant]["ceiling"] = float(errors[b].min() < RIGHT_DEG)
            records[b][variant]["grid 8"] = records[b][variant][BEST_PAIR]["top"][0]
        for grid in (4, 16):
            given = replace(pipeline, bank=replace(bank_settings, grid=grid))
            matcher = ViewMatcher(
                bank_of(given), pipeline=given, renderer=renderer, field=fields["MFC"]
            )
            for b in range(len(cases)):
                best = matcher.rank(matcher.features(crops[b : b + 1])).order[0, 0]
                records[b][variant][f"grid {grid}"] = float(errors[b, best])
    return records


def _ranked(
    matcher: ViewMatcher,
    crop: Tensor,
    case: Case,
    truth: Tensor,
    errors: Tensor,
    describe: ViewDescriber,
    wider: bool,
) -> Record:
    """``wider``: with what the search finds between views down the ranking until two are
    coherent."""
    query = matcher.features(crop[None])
    ranking = matcher.rank(query)
    # Views at several distances are one picture to an orthographic camera.
    top = different_views(matcher.bank.rotations, ranking.order[0], max(RANKS))
    rotation, _ = search(matcher, query, ranking)
    retrieved = top[:BEST_VIEWS]
    closest = retrieved[errors[retrieved].argmin()]
    record = {
        "top": errors[top].tolist(),
        "est": _pose_errors(rotation, case, truth, describe),
        "found": float(rotation_error(truth, rotation)),
        "coherent": len(coherent_of(matcher.bank, ranking)),
        "clo": _pose_errors(matcher.bank.rotations[closest], case, truth, describe),
    }
    if wider:
        if record["coherent"] == 1:
            rotation, _ = search(matcher, query, ranking, least_coherent=2)
        record["wider found"] = float(rotation_error(truth, rotation))
    return record


def _closest_refined(
    matcher: ViewMatcher, crop: Tensor, case: Case, truth: Tensor, describe: ViewDescriber
) -> list[float]:
    """Errors of the closest of the three retrieved views, each replaced by the best of a grid of 5°
    as far as half way to the next view of the bank."""
    query = matcher.features(crop[None])
    order = matcher.rank(query).order[0]
    refined = [
        refine(matcher, query, int(view))
        for view in different_views(matcher.bank.rotations, order, BEST_VIEWS)
    ]
    closest = min(refined, key=lambda R: float(rotation_error(truth, R)))
    return _pose_errors(closest, case, truth, describe)


@torch.no_grad()
def measure_focus(cases: list[Case], settings: BankSettings, pose: str) -> list[Record]:
    """IP and the best views of focus curves by threshold, and of the fields beside them, in the
    ranking "corrected"; and what of them is right by other protocols."""
    mesh = load_mesh(cases[0].mesh_path, unit=cases[0].unit)
    pipeline = variants(pose)["corrected"]
    pipeline = replace(
        pipeline,
        bank=replace(pipeline.bank, image_size=settings.image_size, margin=settings.margin),
    )
    bank = ViewBank.build(mesh, pipeline=pipeline, progress=False)
    matcher = ViewMatcher(bank, pipeline=pipeline)
    rotations = bank.rotations.double()
    azimuths = torch.stack([viewpoint_from_rotation(R)[0] for R in rotations])
    records = []
    for k in range(0, len(cases), FOCUS_BATCH):
        records += _focus_of(cases[k : k + FOCUS_BATCH], mesh, matcher, rotations, azimuths)
    return records


def _focus_of(
    cases: Sequence[Case],
    mesh: Mesh,
    matcher: ViewMatcher,
    rotations: Tensor,
    azimuths: Tensor,
) -> list[Record]:
    """:func:`measure_focus` of some photographs, whose fields are computed together."""
    fraction = matcher.bank.settings.point_fraction
    crops = torch.cat([case.crop(matcher.bank.settings) for case in cases])
    half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64))
    views = []
    errors = []
    near = []
    records = []
    for case in cases:
        R, distance = case.view(mesh)
        field = matcher.describer.fields(R[None], torch.tensor([distance]).double())
        views.append(field_points(field, fraction=fraction)[0, 0])
        of_view = rotation_error(R, rotations)
        turned = torch.minimum(of_view, rotation_error(R @ half_turn, rotations))
        errors.append({"right": of_view, "half turn": turned})
        apart = ((azimuths - viewpoint_from_rotation(R)[0] + 180.0) % 360.0 - 180.0).abs()
        near.append(apart <= KNOWN_AZIMUTH_DEG)
        right = (of_view < RIGHT_DEG).double()
        chance = {
            "right": float(right.mean()),
            "half turn": float((turned < RIGHT_DEG).double().mean()),
            "azimuth": float(right[near[-1]].mean()),
            "top 20": 1.0 - (1.0 - float(right.mean())) ** 20,
        }
        records.append({"chance": chance})
    for name, matcher.field in focus_fields().items():
        query = matcher.features(crops)
        orders = matcher.rank(query).order
        for b, order in enumerate(orders):
            right = errors[b]["right"]
            records[b][name] = {
                "ip": float(intersection_percentage(query.points[b, 0], views[b])),
                "right": float(right[order[0]]),
                "half turn": float(errors[b]["half turn"][order[0]]),
                "azimuth": float(right[order[near[b][order]][0]]),
                "top 20": float(right[order[:20]].min()),
            }
    return records


def _pose_errors(
    rotation: Tensor, case: Case, truth: Tensor, describe: ViewDescriber
) -> list[float]:
    """Absolute errors of elevation, azimuth and in-plane angle in degrees, and of the distance, at
    which the view fills the box of the photograph, in percent."""
    angles = [torch.stack(viewpoint_from_rotation(R.double())) for R in (rotation, truth)]
    azimuth, elevation, theta = angle_differences(*angles).tolist()
    error = math.nan
    if case.has_distance and case.camera is not None:
        K = case.camera.double()
        R, t = pose_from_box(describe.hull, rotation.double(), case.box.double(), K)
        true = torch.linalg.vector_norm(case.pose[:, :3] @ describe.centre + case.pose[:, 3])
        error = 100.0 * abs(float(torch.linalg.vector_norm(R @ describe.centre + t) / true) - 1.0)
    return [elevation, azimuth, theta, error]

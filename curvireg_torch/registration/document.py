"""The document of a result: what ``result.json`` and every line of ``results.jsonl`` say (docs/results.md)."""

import math
import platform
from collections.abc import Mapping, Sequence
from typing import Any

import kornia
import torch
import trimesh

from ..io.meshes.mesh import mesh_unit
from ..version import __version__
from . import RELIABLE, Hypothesis, Registrar, Registration
from .calibration import SQUARED_RADIUS

__all__ = [
    "CONVENTIONS",
    "SCHEMA",
    "corners",
    "correction",
    "fitting_box",
    "found_document",
    "pose_document",
    "result_document",
]

SCHEMA = 1
"""Version of ``result.schema.json``; raised when a key goes or changes its meaning."""

CONVENTIONS = {
    "rotation": "x_cam = R x_model + t, OpenCV camera: x right, y down, z forward; model frame of the mesh file",
    "translation": "in the mesh file's unit; null without a camera",
    "viewpoint": "PASCAL3D+ azimuth, elevation, theta in degrees",
    "pixels": "(0, 0) is the centre of the top-left pixel of the picture as viewers show it (EXIF orientation applied)",
    "boxes": "x0, y0, x1, y1 in those pixels",
    "score": "normalised correlation of photograph and view, 0 to 1",
    "confidence": "estimated probability that the rotation is within 30 degrees of the truth; of an object that was "
    "looked for, times presence",
    "presence": "estimated probability that the photograph shows the object in that box",
    "reliable": f"confidence of at least {RELIABLE:g}; false = no reliable match, the pose is a guess",
    "confidence_features": "what the confidence rests on; lead: how far the best pose leads its best rival, null where "
    "the bank has no rival view, and then little confidence is given",
    "edge_support": "how strongly edges of the photograph lie under the mesh's contours, 0 to 1",
    "covariance": "of turn (rad) about the camera's x, y, z, then translation along them: R_true = exp([w]x) R, "
    "t_true = t + e; null without a camera, with a guessed one, whose error nobody knows, and where not reliable",
    "squared_radius": "with e = (w, e) the error, e^T covariance^-1 e is below it for that share of reliable answers, "
    "measured on photographs of the benchmark that had no part in it",
}


def result_document(result: Registration, registrar: Registrar, seconds: Mapping[str, float]) -> dict[str, Any]:
    """All that is known of a registration, as plain JSON.

    Args:
        result: of ``registrar``.
        registrar: what made it.
        seconds: what took how long, ``bank`` and ``register``.
    """
    bank = registrar.bank
    top = [
        {
            **pose_document(h),
            "score": h.score,
            "evidence": dict(h.evidence),
            "view": h.view,
            "terms": {n: float(r[0, h.view]) for n, r in result.ranking.terms.items() if r[0, h.view].isfinite()},
        }
        for h in result.hypotheses
    ]
    deviations = result.standard_deviations
    return {
        "schema": SCHEMA,
        **pose_document(result),
        "unit": mesh_unit(bank.meshes[result.model]),
        "score": result.score,
        "confidence": result.confidence,
        "reliable": result.reliable,
        "confidence_features": dict(result.confidence_features),
        "edge_support": result.edge_support,
        "standard_deviations": None
        if deviations is None
        else {"rotation_deg": _known(deviations[0]), "translation": _known(deviations[1])},
        "covariance": None if result.covariance is None else result.covariance.tolist(),
        "squared_radius": None if result.covariance is None else {f"{k:g}": r for k, r in SQUARED_RADIUS.items()},
        "corrected_box": None if result.corrected_box is None else result.corrected_box.tolist(),
        "top": top,
        "views": len(bank),
        "pipeline": registrar.pipeline.describe(),
        "seconds": dict(seconds),
        "versions": {
            "curvireg_torch": __version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
            "kornia": kornia.__version__,
            "trimesh": trimesh.__version__,
        },
        "conventions": CONVENTIONS,
    }


def fitting_box(document: Mapping[str, Any]) -> list[float]:
    """The box that the answer of a document was made with."""
    box: list[float] = document["corrected_box"] or document["inputs"]["box"]
    return box


def corners(box: Sequence[float]) -> str:
    """A box in whole px, as ``--box`` takes it."""
    return " ".join(f"{v:.0f}" for v in box)


def correction(document: Mapping[str, Any]) -> list[str]:
    """A line that says by which box the given one was replaced; none where it was not."""
    box = document["corrected_box"]
    return [] if box is None else [f"the box did not fit the pose; one that does: {corners(box)}"]


def found_document(results: Sequence[Registration]) -> dict[str, Any]:
    """What is known of objects that were looked for, the surest first.

    Args:
        results: of one photograph, see :func:`curvireg_torch.registration.localize`.
    """
    lift_to_poses = [(result, result.found) for result in results if result.found is not None]
    places = lift_to_poses[0][1]
    return {
        "presence": places.presence,
        "proposals": [
            {"box": box, "score": score}
            for box, score in zip(places.boxes.tolist(), places.scores.tolist(), strict=True)
        ],
        "instances": [
            {
                "box": found.box.tolist(),
                "presence": found.presence,
                "confidence": result.confidence,
                **pose_document(result),
            }
            for result, found in lift_to_poses
        ],
    }


def pose_document(found: Registration | Hypothesis) -> dict[str, Any]:
    """``rotation``, ``translation`` and ``viewpoint``."""
    return {
        "rotation": found.rotation.tolist(),
        "translation": None if found.translation is None else found.translation.tolist(),
        "viewpoint": dict(zip(("azimuth", "elevation", "theta"), found.viewpoint, strict=True)),
    }


def _known(deviations: torch.Tensor) -> list[float | None]:
    """Numbers that JSON can hold: None for a deviation without bound."""
    return [None if math.isinf(v) else v for v in deviations.tolist()]

"""JSON documents of results: ``result.json`` and the lines of ``results.jsonl`` (docs/results.md)."""

import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

import torch

from ..mesh.mesh import mesh_unit
from ..version import __version__
from .confidence import RELIABLE
from .registrar import Registrar
from .results import Registration

__all__ = ["SCHEMA", "corners", "localization_document", "remarks", "result_document", "used_box"]

SCHEMA = 2
"""Version of ``result.schema.json``; raised when a key is removed or changes its meaning."""

CONVENTIONS = {
    "rotation": "x_cam = R x_model + t, OpenCV camera: x right, y down, z forward; model frame of the mesh file",
    "translation": "in the mesh file's unit; null without a camera",
    "viewpoint": "PASCAL3D+ azimuth, elevation, theta in degrees",
    "pixels": "(0, 0) is the centre of the top-left pixel of the picture as viewers show it (EXIF orientation applied)",
    "boxes": "x0, y0, x1, y1 in those pixels",
    "score": "normalised correlation of photograph and view, 0 to 1",
    "confidence": "estimated probability that the rotation is within 30 degrees of the truth; times presence for an "
    "object without a given box; of a pose refined from a start: that it is within 10 degrees and 10 % of the distance",
    "answer_set": "probabilities of the poses of top in their order and of none of them; members: numbers, from 0, of "
    "the poses in the smallest set that holds the truth with probability level, together with none of them if "
    "holds_none",
    "ambiguous": "how the members differ: half turn, mirror or several; null for one member",
    "symmetries": "number of orientations in which the mesh looks the same; poses that differ by them count as one",
    "presence": "estimated probability that the photograph shows the object in that box",
    "reliable": f"confidence of at least {RELIABLE:g}, no warnings, and no better match outside the prior; false = no "
    "reliable match, the pose is a guess",
    "warnings": "what is questionable about the box and the camera",
    "confidence_features": "features that the confidence is computed from; lead: score of the best pose above that of "
    "its best rival, null where the bank has no rival view, which bounds the confidence",
    "edge_support": "how strongly image edges lie under the projected contours, 0 to 1",
    "covariance": "of rotation (rad) about the camera's x, y, z, then translation along them: R_true = exp([w]x) R, "
    "t_true = t + e; null without a camera, with a guessed camera, whose error is unknown, and where not reliable",
    "squared_radius": "with e = (w, e) the error, e^T covariance^-1 e is below it for that fraction of reliable "
    "results, measured on benchmark photographs that were not used for calibration",
}


def result_document(result: Registration, registrar: Registrar, seconds: Mapping[str, float]) -> dict[str, Any]:
    """:meth:`Registration.to_dict` and how the result was computed, with the seconds of ``bank`` and ``register``."""
    bank = registrar.bank
    symmetries = registrar.symmetries_of(exact=registrar.is_exact(with_camera=result.translation is not None))
    return {
        "schema": SCHEMA,
        **result.pose_dict(),
        "unit": mesh_unit(bank.meshes[result.model]),
        **result.to_dict(),
        "symmetries": 1 if symmetries is None else len(symmetries),
        "views": len(bank),
        "pipeline": registrar.pipeline.describe(),
        "seconds": dict(seconds),
        "versions": {
            "curvireg_torch": __version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
            "kornia": version("kornia"),
            "trimesh": version("trimesh"),
        },
        "conventions": CONVENTIONS,
    }


def localization_document(results: Sequence[Registration]) -> dict[str, Any]:
    """The key ``localization``: the objects that :func:`localize` found in one photograph."""
    located = [(result, result.localization) for result in results if result.localization is not None]
    first = located[0][1]
    return {
        "presence": first.presence,
        "proposals": [{"box": b.tolist(), "score": float(s)} for b, s in zip(first.boxes, first.scores, strict=True)],
        "instances": [
            {"box": at.box.tolist(), "presence": at.presence, "confidence": result.confidence, **result.pose_dict()}
            for result, at in located
        ],
    }


def used_box(document: Mapping[str, Any]) -> list[float]:
    """The box that a document's pose was computed with: the given one, or the one that replaced it."""
    box: list[float] = document["corrected_box"] or document["inputs"]["box"]
    return box


def corners(box: Sequence[float]) -> str:
    """A box in whole px, as ``--box`` takes it."""
    return " ".join(f"{v:.0f}" for v in box)


def remarks(document: Mapping[str, Any]) -> list[str]:
    """Lines about numbers that did not fit, a replaced box or contradicted limits, and about a symmetric mesh."""
    box, contradiction = document["corrected_box"], document.get("prior", {}).get("contradiction")
    lines = [] if box is None else [f"the box did not fit the pose; one that does: {corners(box)}"]
    if contradiction == "better outside":
        lines.append("the photograph fits much better outside the limits on the pose; check them")
    elif contradiction is not None:
        lines.append("the pose lies at one of its limits; widen it to see whether it stays")
    if (count := document.get("symmetries", 1)) > 1:
        lines.append(f"the mesh looks the same in {count} orientations: the pose is one of as many")
    return lines

"""Results as JSON documents: docs/results.md describes all keys."""

import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import version

import torch

from ..registration.result import Detection, Registration
from ..registration.target import Target
from ..utils.aliases import Document, Fields
from ..version import __version__

# Version of the keys of result.json; raised when a key is removed or changes its meaning
SCHEMA = 5
# Keys of result.json that have another name in the lines of results.jsonl
LINE_KEYS = {"hypotheses": "top", "no_match_probability": "none"}
VERSIONS = {
    "curvireg_torch": __version__,
    "python": platform.python_version(),
    "torch": torch.__version__,
}
CONVENTIONS = {  # docs/results.md describes all keys
    "rotation": "x_cam = R x_model + t, OpenCV camera: x right, y down, z forward; model frame of "
    "the mesh file; x_world in place of x_cam where the frame is the world",
    "translation": "in the mesh file's unit; null with a similar mesh and no camera",
    "viewpoint": "PASCAL3D+ azimuth, elevation, theta in degrees",
    "pixels": "(0, 0) is the centre of the top-left pixel of the picture as viewers show it (EXIF "
    "orientation applied)",
    "boxes": "x0, y0, x1, y1 in those pixels",
    "confidence": "estimated probability that the rotation is within 30 degrees of the truth",
    "reliable": "confidence of at least pipeline.fit.reliable, and nothing questionable; false = "
    "the pose is a guess",
    "covariance": "of rotation (rad) about x, y, z of the frame, then translation along them: "
    "R_true = exp([w]x) R, "
    "t_true = t + e; of the camera's errors, that of an estimated focal length is in it",
}


def result_document(result: Registration, target: Target, seconds: Mapping[str, float]) -> Fields:
    """:meth:`Registration.to_dict` and how the result was computed, with the seconds of ``bank``
    and ``register``."""
    target = target.of_mesh(result.mesh_index)
    bank = target.bank
    symmetries = target.symmetries_of(exact=target.is_exact)
    return {
        "schema": SCHEMA,
        "unit": bank.mesh.unit,
        "bank_views": len(bank),
        **result.to_dict(),
        "symmetries": 1 if symmetries is None else len(symmetries),
        "pipeline": target.pipeline.describe(),
        "seconds": dict(seconds),
        "versions": {
            **VERSIONS,
            "kornia": version("kornia"),
            "trimesh": version("trimesh"),
        },
        "conventions": CONVENTIONS,
    }


def detection_document(results: Sequence[Registration]) -> Fields:
    """The key ``detection``: the objects that :func:`.detect` found in one photograph."""
    found = [(result, result.detection) for result in results if result.detection is not None]
    instances = [
        {
            "box": at.box.tolist(),
            "score": at.score,
            "verdict": result.verdict,
            "confidence": result.confidence,
            "reliable": result.reliable,
            "axis": result.axis and result.axis.to_dict(),
            "warnings": [*result.warnings, *result.notes],
            **result.hypotheses[0].pose_dict(),
        }
        for result, at in found
    ]
    return {**places_document(found[0][1]), "instances": instances}


def places_document(detection: Detection) -> Fields:
    """Where the object may be: the first place's score, and all proposals."""
    pairs = zip(detection.boxes, detection.responses, strict=True)
    return {
        "score": detection.score,
        "proposals": [{"box": b.tolist(), "response": float(r)} for b, r in pairs],
    }


def line_document(document: Document) -> Fields:
    """The content of ``result.json`` under the keys of a line of ``results.jsonl``."""
    return {LINE_KEYS.get(key, key): value for key, value in document.items()}

"""The lines that ``register`` and ``demo`` print about a result."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..registration.result import RIVAL_FRACTION, corners, remarks

__all__ = ["print_result"]

WEAK_CONTOURS = 0.35
"""Edge support of a right pose that hardly occurs: 24 generated scenes of the example mesh had 0.47 to 0.64, after a
blur of 4 px 0.26 to 0.39, and with the meshes of a sphere and of a cuboid 0.14 to 0.43."""

DOUBTFUL_SCORE = 0.5
"""Probability below which the object is more likely absent from a detected box than there."""


def print_result(document: Mapping[str, Any], out: Path) -> None:
    """Print a :func:`~curvireg_torch.registration.result.result_document`; ``out`` is the folder of its files."""
    angles = ", ".join(f"{name} {value:.1f}" for name, value in document["viewpoint"].items())
    confidence = "not calibrated" if document["confidence"] is None else f"{document['confidence']:.2f}"
    print(f"viewpoint: {angles} degrees   score {document['score']:.3f}   confidence {confidence}")
    if not document["reliable"]:
        print(f"no reliable match: take the pose as a guess; {_advice(document)}")
    print_alternatives(document)
    if ", " in document.get("inputs", {}).get("mesh", ""):
        print(f"mesh: {document['mesh']}")
    for line in remarks(document):
        print(line)
    for instance in document.get("detection", {}).get("instances", []):
        print(f"found in box {corners(instance['box'])}: there with probability {instance['score']:.2f}")
    if document["translation"] is not None:
        print(f"translation: {', '.join(f'{v:.4g}' for v in document['translation'])} {document['unit']}")
    deviations = document["standard_deviations"]
    if deviations is not None:
        rotation, translation = (
            ", ".join("unknown" if v is None else f"{v:.2g}" for v in deviations[name])
            for name in ("rotation_deg", "translation")
        )
        values = f"{rotation} degrees; {translation} {document['unit']}"
        print(f"standard deviations: {values}   (about and along the camera's axes)")
    seconds = document["seconds"]
    print(f"bank {seconds['bank']:.1f} s, registration {seconds['register']:.1f} s; see {out}/overlay.png")


def print_alternatives(document: Mapping[str, Any]) -> None:
    """Print rivals that are nearly as probable as the best pose, if there are any."""
    if document["ambiguous"] is None:
        return
    for rival, probability in list(zip(document["top"], document["probabilities"], strict=False))[1:]:
        if probability >= RIVAL_FRACTION * document["confidence"]:
            angles = ", ".join(f"{name} {value:.1f}" for name, value in rival["viewpoint"].items())
            print(f"could also be: {angles} degrees   probability {probability:.2f}")
    words = {"half turn": "differ by a half turn", "mirror": "are mirror images", "several": "differ"}
    none = f"none of them: {document['none']:.2f}"
    print(f"the poses {words[document['ambiguous']]}; {none}; a hint decides: --side, --azimuth or --near")


def _advice(document: Mapping[str, Any]) -> str:
    """What to try after a registration that is not reliable, by its likely reason."""
    support, detection = document["edge_support"], document.get("detection")
    upright = document["pipeline"]["views"]["pose"] == "upright"
    mesh = "that the mesh is the object's" + (", standing as in its file (--pose upright, --up)" if upright else "")
    if document["warnings"]:
        return "correct what the warning names"
    if document["ambiguous"] is not None:
        return "more than one pose fits"
    if "distance" in document.get("prior", {}):
        return f"check --distance, --unit and --camera, and {mesh}"
    if detection is not None:
        if detection["score"] < DOUBTFUL_SCORE:
            return f"the object may not be in the photograph: add --box, and check {mesh}"
        return f"the object seems to be there, at an unsure pose: add --box, and check {mesh}"
    if support is not None and support < WEAK_CONTOURS:
        return f"its contours hardly show in the photograph: take a sharp one with the whole object, and check {mesh}"
    return f"check that the box is tight and {mesh}"

"""The lines that ``register`` and ``demo`` print about a result."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..registration.document import corners, remarks

__all__ = ["print_result"]


def print_result(document: Mapping[str, Any], out: Path) -> None:
    """Print a :func:`~curvireg_torch.registration.document.result_document`; ``out`` is the folder of its files."""
    angles = ", ".join(f"{name} {value:.1f}" for name, value in document["viewpoint"].items())
    print(f"viewpoint: {angles} degrees   score {document['score']:.3f}   confidence {document['confidence']:.2f}")
    if not document["reliable"]:
        print(f"no reliable match: take the pose as a guess; {_advice(document)}")
    print_alternatives(document)
    if ", " in document.get("inputs", {}).get("mesh", ""):
        print(f"mesh: {document['mesh']}")
    for line in remarks(document):
        print(line)
    for instance in document.get("localization", {}).get("instances", []):
        print(f"found in box {corners(instance['box'])}: there with probability {instance['presence']:.2f}")
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
    """Print the other members of the answer set, if there are any."""
    answers = document["answer_set"]
    for member in answers["members"][1:]:
        viewpoint = document["top"][member]["viewpoint"]
        angles = ", ".join(f"{name} {value:.1f}" for name, value in viewpoint.items())
        print(f"could also be: {angles} degrees   probability {answers['probabilities'][member]:.2f}")
    if document["ambiguous"] is not None:
        words = {"half turn": "differ by a half turn", "mirror": "are mirror images", "several": "differ"}
        none = f"; none of them: {answers['none']:.2f}" if answers["holds_none"] else ""
        print(f"the poses {words[document['ambiguous']]}{none}; a hint decides: --side, --azimuth or --near")


def _advice(document: Mapping[str, Any]) -> str:
    """What to check after a registration that is not reliable."""
    upright = document["pipeline"]["views"]["pose"] == "upright"
    orientation = ", and that it stands as in its file (--pose upright, --up)" if upright else ""
    if "localization" in document:
        return f"no box was given: add --box, and check that the mesh is the object's{orientation}"
    return f"check that the box is tight and the mesh is the object's{orientation}"

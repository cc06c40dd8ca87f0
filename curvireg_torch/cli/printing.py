"""What ``register`` and ``demo`` print of a result."""

from pathlib import Path

from ..registration.confidence import two_decimals
from ..registration.result import likely_rivals
from ..utils.aliases import Document
from ..visualization.words import corners, measured, remarks

NOT_CALIBRATED = "not calibrated for other terms, fields or views than the default ones"
OPEN_AXES = 1.0  # axes of rotation that a fit leaves undetermined, from which the advice says so


def print_result(document: Document, out: Path) -> None:
    """Print a :func:`~curvireg_torch.jobs.documents.result_document`; ``out`` is the folder
    of its files."""
    confidence = NOT_CALIBRATED
    if document["confidence"] is not None:
        confidence = two_decimals(document["confidence"])
    kind = " (as seen by a camera that looks straight at it)"
    of_camera = "" if document["translation"] is not None else kind
    print(
        f"viewpoint: {_angles(document)}{of_camera}   score {document['score']:.3f}   confidence "
        f"{confidence}, {document['verdict']}"
    )
    if not document["reliable"]:
        print(f"take the pose as a guess; {_advice(document)}")
    _print_rivals(document)
    if ", " in document.get("inputs", {}).get("mesh", ""):
        print(f"mesh: {document['mesh']}")
    for line in remarks(document):
        print(line)
    _print_objects(document)
    if document["translation"] is not None:
        deviation = (document.get("camera") or {}).get("focal_deviation", 0.0)
        numbers = ", ".join(measured(document["translation"], deviation))
        print(f"translation: {numbers} {document['unit']}")
    if (deviations := document["standard_deviations"]) is not None:
        rotation, translation = (
            ", ".join("unknown" if v is None else f"{v:.2g}" for v in deviations[name])
            for name in ("rotation_deg", "translation")
        )
        values = f"{rotation} degrees; {translation} {document['unit']}"
        axes = f"about and along the {document['frame']}'s axes"
        print(f"standard deviations: {values}   ({axes})")
    seconds = document["seconds"]
    print(
        f"bank {seconds['bank']:.1f} s, registration {seconds['register']:.1f} s; see "
        f"{out}/overlay.png"
    )


def _print_objects(document: Document) -> None:
    """Print where objects were detected, and the confidence of each if there are several."""
    instances = document.get("detection", {}).get("instances", [])
    several = len(instances) > 1
    if several:
        print(f"{len(instances)} objects, the best first:")
    for instance in instances:
        sure = ""
        if several and instance["confidence"] is not None:
            sure = f"confidence {two_decimals(instance['confidence'])}, {instance['verdict']}; "
        print(
            f"{'' if several else 'found '}in box {corners(instance['box'])}: there with "
            f"probability {two_decimals(instance['score'])}; {sure}{_angles(instance)}"
            f"{_place(instance, document)}"
        )


def _place(pose: Document, document: Document) -> str:
    """The translation of an instance, behind its angles; "" without a camera."""
    if pose["translation"] is None:
        return ""
    return f", at {', '.join(f'{v:.4g}' for v in pose['translation'])} {document['unit']}"


def _angles(pose: Document) -> str:
    return (
        ", ".join(f"{name} {value:.1f}" for name, value in pose["viewpoint"].items()) + " degrees"
    )


def _print_rivals(document: Document) -> None:
    """Print rivals that are nearly as probable as the best pose, if there are any."""
    if document["ambiguous"] is None:
        return
    if document["ambiguous"].startswith("mesh"):
        every = enumerate(document["mesh_probabilities"])
        of_meshes = ", ".join(f"mesh {k}: {two_decimals(p)}" for k, p in every)
        print(f"several meshes fit: {of_meshes}; a photograph of where they differ decides")
        return
    probabilities = document["probabilities"]
    pair = document["pair_probability"]
    likely = likely_rivals(probabilities, pair, is_hidden=document["feature_is_hidden"])
    if not likely:
        print("right up to turns that only a small feature tells apart, which is not in view")
        return
    for k in likely:
        rival = _angles(document["hypotheses"][k])
        print(f"could also be: {rival}   probability {two_decimals(probabilities[k])}")
    words = {
        "half turn": "are flipped by 180 degrees",
        "mirror": "are mirror images",
        "several": "differ",
    }
    none = f"none of them: {two_decimals(document['no_match_probability'])}"
    decides = "a pose prior decides: --side, --azimuth or --near"
    print(f"the poses {words[document['ambiguous']]}; {none}; {decides}")


def _advice(document: Document) -> str:
    """What to try after a registration that is not reliable, by the reason that was measured, if
    there is one."""
    mesh = "that the mesh is the object's, in its --unit and with its --up axis"
    features = document["confidence_features"]
    if document["warnings"]:
        return "correct what the warning names"
    if document["ambiguous"] is not None:
        return "more than one pose fits"
    if document.get("confidence", 0.0) is None:
        return "look at the overlay, or leave --preset and other settings out to have a confidence"
    if "distance" in document.get("prior", {}):
        return f"check --distance, --camera, and {mesh}"
    if "detection" in document:
        return f"add --box, and check {mesh}"
    if (features.get("border") or 0) > 0:
        return "the box ends at the border of the photograph: take one that shows the whole object"
    if document["translation"] is None:
        return f"give the --camera, and check {mesh}"
    if suspicion := _suspicious_box(document.get("inputs", {})):
        return f"{suspicion}; and check {mesh}"
    if (features.get("undetermined") or 0.0) >= OPEN_AXES:
        return (
            "the contours that were found leave its rotation open: take a sharper or closer one, "
            f"and check {mesh}"
        )
    if document["verdict"] == "unsure":
        return (
            "look whether its contours fit in the overlay; a tight box, the --camera, --pose "
            "upright or a pose prior make it surer"
        )
    return f"check that the box is tight, and {mesh}"


def _suspicious_box(inputs: Document) -> str:
    """What a box of an answer that is not reliable may be instead of px of the photograph as it is
    shown; "" without a suspicion."""
    box = inputs.get("box")
    picture = inputs.get("picture")
    if box is None or picture is None:
        return ""
    if max(box) <= 100.0 < min(picture["width"], picture["height"]):
        return "the box is in px: of percent, multiply it by the photograph's size / 100"
    if (orientation := picture["orientation"]) != 1:
        return (
            f"box and mask are of the photograph as it is shown, with its EXIF orientation "
            f"{orientation} applied: check that they are not of the pixels in the file"
        )
    return ""

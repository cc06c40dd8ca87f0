"""Results in words."""

import math
from collections.abc import Mapping, Sequence

from torch import Tensor

from ..fitting.exactness import degrees_in_words
from ..geometry.pose_prior import object_frame
from ..geometry.viewpoint import viewpoint_from_rotation
from ..utils.aliases import Document
from ..utils.choices import SIDE_NAMES

# How sure an answer is, surest first; the last two have no pose
VERDICTS = ("reliable", "reliable axis", "unsure", "no match", "lost", "failed")
HOLDS_FOR = "if the mesh has the object's size and the focal length is right"
AXIS_ALONE = "the axis is certain, the turn about it is not"
STEEP_ELEVATION = 70  # Degrees of elevation beyond which an object is seen from above or below
# Deviation of an estimated focal length, as a fraction, from which it is hardly measured
WEAK_PERSPECTIVE = 0.15


def corners(box: Sequence[float]) -> str:
    """A box in whole px, as ``--box`` takes it."""
    return " ".join(f"{v:.0f}" for v in box)


def remarks(document: Document) -> list[str]:
    """Lines about numbers that did not fit, a replaced box or contradicted limits, and about a
    symmetric mesh."""
    box = document["corrected_box"]
    contradiction = document.get("prior", {}).get("contradiction")
    lines = [] if box is None else [f"another box agrees better with the pose: {corners(box)}"]
    if contradiction == "better outside":
        lines.append("the photograph fits much better outside the pose prior; check it")
    elif contradiction is not None:
        lines.append("the pose lies at one of its limits; widen it to see whether it stays")
    if document.get("verdict") == "reliable axis":
        lines.append(AXIS_ALONE)
    if exactness := document.get("exactness"):
        lines.append(_exactness_in_words(exactness, document.get("camera_source")))
    if (count := document.get("symmetries", 1)) > 1:
        lines.append(f"the mesh looks the same in {count} orientations: the pose is one of as many")
    return lines


def _exactness_in_words(exactness: Document, camera_source: str | None) -> str:
    """How exact a pose is; of an estimated camera, how exact the rotation is that a cropped
    photograph does not change."""
    if camera_source != "estimated":
        return f"exact {exactness['words']}, {HOLDS_FOR}"
    return (
        f"exact to about {degrees_in_words(exactness['allocentric_deg'])} as seen along the ray to "
        f"the object: use allocentric_rotation if the photograph may be cropped; in the camera "
        f"{exactness['words']}"
    )


def camera_in_words(document: Document) -> list[str]:
    """A line about a camera that was not given exactly: where it is from, and how well its focal
    length is known."""
    camera = document["camera"]
    line = "" if camera is None else focal_length_in_words(camera, document["inputs"]["picture"])
    return [line] if line else []


def used_camera_in_words(document: Document) -> str:
    """The camera with which a pose was found; where its focal length is not known exactly, how far
    away the object is, how certain that is, and why.

    Example:
        >>> camera = {"matrix": [[1450, 0, 960], [0, 1450, 540], [0, 0, 1]], "source": "given"}
        >>> document = {"camera": {**camera, "focal_deviation": 0.0}, "camera_source": "file"}
        >>> used_camera_in_words(document)
        'camera: 1450 1450 960 540 px, from a calibration file'
        >>> camera |= {"source": "estimated", "focal_deviation": 0.25}
        >>> used_camera_in_words({"camera": camera, "translation": [0, 0, 0.555], "unit": "m"})
        'about 0.56 m away, +- 25 %: the camera is unknown (give it)'
    """
    camera = document.get("camera")
    if camera is None:
        return ""
    deviation = camera["focal_deviation"]
    if not deviation or document["translation"] is None:
        (fx, _, cx), (_, fy, cy), _ = camera["matrix"]
        numbers = " ".join(f"{v:.5g}" for v in (fx, fy, cx, cy))
        is_file = document.get("camera_source") == "file"
        return f"camera: {numbers} px, {'from a calibration file' if is_file else 'as given'}"
    reasons = {
        "exif": "the camera is that of the file's EXIF",
        "given": "the camera is known by its field of view",
    }
    reason = reasons.get(camera["source"], "the camera is unknown (give it)")
    distance = measured(document["translation"], deviation)[2]
    return f"about {distance} {document['unit']} away, +- {100 * deviation:.0f} %: {reason}"


def measured(translation: Sequence[float], deviation: float = 0.0) -> list[str]:
    """Components of a translation with the digits that its relative ``deviation`` leaves, at least
    two; four where it is not known.

    Example:
        >>> measured([135.71, -216.84, 555.43], 0.25), measured([0.1, 0.0, 1.23456])
        (['140', '-220', '560'], ['0.1', '0', '1.235'])
    """
    if not deviation:
        return [f"{v:.4g}" for v in translation]
    digits = max(2, 1 + math.floor(-math.log10(deviation)))
    longest = max(map(abs, translation)) or 1.0
    decimals = digits - 1 - math.floor(math.log10(longest))
    return [f"{round(v, decimals) + 0.0:.{max(decimals, 0)}f}" for v in translation]


def focal_length_in_words(camera: Document, picture: Document | None = None) -> str:
    """Where a camera, as :meth:`.Camera.describe` has it, is from, and how well its focal length is
    known; "" if it was given exactly. ``picture`` has the ``focal_35mm`` of the EXIF data."""
    if not camera["focal_deviation"]:
        return ""
    if camera["source"] == "exif":
        millimetres = "" if picture is None else f", {picture['focal_35mm']:.3g} mm"
        return f"camera: from the file's EXIF{millimetres}"
    widths = camera["matrix"][0][0] / camera["size"][1]
    deviation = 100.0 * camera["focal_deviation"]
    known = f"{widths:.2g} widths +- {deviation:.0f} %; the distance is proportional to it"
    if camera["source"] == "given":
        return f"camera: field of view given, focal length {known}"
    weak = (
        ", as perspective is too weak to measure it"
        if camera["focal_deviation"] > WEAK_PERSPECTIVE
        else ""
    )
    return f"camera: focal length estimated, {known}{weak}"


def view_in_words(view: Document) -> str:
    """Why a photograph of several, one of a document's ``photographs``, does not count, or how
    much it does; empty if its pose was set by hand, so that nobody has compared it."""
    counts = "" if view["similarity"] is None else f"prefers the pose by {view['contribution']:.2f}"
    return view["failure"] or counts


def verdict_counts(verdicts: Mapping[str, int]) -> str:
    """Numbers of photographs by verdict, in words, "reliable axis" where there are any; the counts
    of other words do not matter.

    Example:
        >>> verdict_counts({"reliable": 2, "failed": 1})
        '2 reliable, 0 unsure, 0 no match, 0 lost, 1 failed'
    """
    named = [word for word in VERDICTS if word != "reliable axis" or verdicts.get(word)]
    return ", ".join(f"{verdicts.get(word, 0)} {word}" for word in named)


def pose_in_words(rotation: Tensor, *, up: str = "z", front: str | None = None) -> str:
    """The side from which a (3, 3) rotation shows the object, such as "seen from the front-left
    (azimuth 310°), 20° above the horizon"; ``up`` and ``front`` are axes of the mesh, see
    :func:`.object_frame`."""
    R = rotation.detach().cpu().double()
    azimuth, elevation, theta = (
        round(float(v)) for v in viewpoint_from_rotation(R @ object_frame(up, front).mT)
    )
    side = f"the {SIDE_NAMES[round(azimuth / 45.0) % 8]}"
    if abs(elevation) > STEEP_ELEVATION:
        side = "above" if elevation > 0 else "below"
    height = (
        f"{abs(elevation)}° {'above' if elevation > 0 else 'below'} the horizon"
        if elevation
        else "level"
    )
    tilt = f", tilted by {abs(theta)}° to the {'left' if theta > 0 else 'right'}" if theta else ""
    return f"seen from {side} (azimuth {azimuth % 360}°), {height}{tilt}"

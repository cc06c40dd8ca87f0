"""The command line and the Python program that give the same answer as the page."""

import shlex
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

from ..jobs.options import QUALIFIERS, RegisterOptions
from .shot import Shot

_OPTIONS = (
    "unit",
    "link",
    "textures",
    "up",
    "pose",
    "mesh_is",
    "preset",
    "pipeline",
    "renderer",
    "device",
)
_DEFAULTS = {option.name: option.default for option in fields(RegisterOptions)}


def python_program(shot: Shot, name: Callable[[Path], str]) -> str:
    """A Python program that gives the answer of a photograph; ``name`` tells what the user calls a
    file."""
    result = shot.require_result()
    (request, boxes), prior = result.inputs, result.registration.prior
    mesh = repr(name(request.meshes[0]))
    rows = result.document.get("photographs", [])
    photos = [repr(name(path)) for path in request.photos]
    if shot.is_undistorted:
        read = (
            "cr.geometry.undistorted(cr.data.read_photo({}).image, "
            "cr.load_camera('CALIBRATION')).image"
        )
        photos = list(map(read.format, photos))
    more = {
        name: getattr(request, name)
        for name in ("link", "textures")
        if getattr(request, name) is not None
    }
    given = "".join(f", {name}={str(value)!r}" for name, value in more.items())
    model = f"cr.load_mesh({mesh}, unit={request.unit!r}, up={request.up!r}{given})"
    model = f"cr.ViewBank.load({mesh})" if request.meshes[0].suffix == ".safetensors" else model
    pipeline = (
        f"cr.Pipeline.read({str(request.pipeline)!r})" if request.pipeline else "cr.Pipeline()"
    )
    pipeline = f"cr.pipeline.PRESETS[{request.preset!r}]" if request.preset else pipeline
    pipeline = f"{pipeline}.with_pose_prior({request.pose!r})" if request.pose else pipeline
    pipeline = "None" if request.bank_decides and not request.pose else pipeline
    if result.photographs:
        call = [
            f"cameras = {[row['camera']['matrix'] for row in rows]}",
            f"T_cam_from_world = {[row['T_cam_from_world'] for row in rows]}",
            f"photos, boxes = [{', '.join(photos)}], {list(boxes)}",
            "result = registrar.register_views(photos, boxes, cameras, T_cam_from_world)",
        ]
    else:
        call = [
            f"prior = {None if prior is None else f'cr.PosePrior(**{prior.to_dict()})'}",
            f"box, camera = {request.box}, {result.document['inputs']['camera']}",
            f"result = cr.register({photos[0]}, registrar, box=box, camera=camera, prior=prior)",
        ]
    lines = [
        "import curvireg_torch as cr",
        "",
        f"registrar = cr.Registrar({model}, pipeline={pipeline}, mesh_is={request.mesh_is!r})",
        *call,
        f"pose = result.hypotheses[{result.answer.number}].pose_dict()",
        *(
            [f"pose = {result.answer.pose.pose_dict()}  # corrected by hand"]
            if result.answer.edits
            else []
        ),
    ]
    return "\n".join([*lines, "print(pose)", ""])


def command_line(options: RegisterOptions, name: Callable[[Path], str], rig: str = "") -> str:
    """``curvireg register`` with these options; ``name`` tells what the user calls a file."""
    words = [
        "curvireg",
        "register",
        *(["--views", rig] if rig else list(map(name, options.photos)) or ["PHOTO"]),
    ]
    words += list(map(name, options.meshes)) or ["MESH"]
    limits = (
        {}
        if options.limits is None or not options.limits.keys() - QUALIFIERS
        else dict(options.limits)
    )
    values: dict[str, Any] = {
        "box": options.box,
        "camera": "exif" if options.guess == "exif" else options.camera,
        "fov": None if options.guess == "exif" else options.guess,
        **{"near" if limit == "viewpoint" else limit: value for limit, value in limits.items()},
        **{
            key.replace("_", "-"): v
            for key in _OPTIONS
            if (v := getattr(options, key)) != _DEFAULTS[key]
        },
    }
    for option, value in values.items():
        if value is not None:
            texts = [
                str(v).removesuffix(".0") for v in (value if isinstance(value, tuple) else (value,))
            ]
            is_like_option = texts[0][0] == "-" and isinstance(value, str)
            words += [f"--{option}={value}"] if is_like_option else [f"--{option}", *texts]
    return shlex.join([*words, "--out", "result"])

"""The command line and the Python program that give the same answer as the page."""

import shlex
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

from ..geometry.cameras import camera_numbers
from ..jobs.options import QUALIFIERS, RegisterOptions
from ..jobs.photograph import RegisteredPhotograph
from ..registration.photograph import Photograph
from .shot import Shot

_OPTIONS = (
    "unit",
    "link",
    "textures",
    "up",
    "pose",
    "box_is",
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
    request, boxes = result.inputs
    prior = result.registration.prior
    mesh = repr(name(request.meshes[0]))
    rows = result.document.get("photographs", [])
    photos = [repr(name(path)) for path in request.photos]
    if shot.is_undistorted:
        read = (
            "cr.geometry.undistorted(cr.data.read_photo({}).image, "
            "cr.load_camera('CALIBRATION')).image"
        )
        photos = list(map(read.format, photos))
    of_mesh = _given(unit=request.unit, up=request.up)
    of_registrar = _given(mesh_is=request.mesh_is, renderer=request.renderer, device=request.device)
    if pipeline := _pipeline(request):
        of_registrar = f", pipeline={pipeline}{of_registrar}"
    of_parts = _given(
        link=request.link, textures=None if request.textures is None else str(request.textures)
    )
    is_bank = request.meshes[0].suffix == ".safetensors"
    model = f"cr.load_mesh({mesh}{of_mesh}{of_parts})"
    model = f"cr.ViewBank.load({mesh})" if is_bank else model
    registrar = f"registrar = cr.Registrar({model}{of_registrar})"
    if result.photographs:
        call = [
            registrar,
            f"cameras = [{', '.join(map(_camera, result.photographs))}]",
            f"T_cam_from_world = {[row['T_cam_from_world'] for row in rows]}",
            f"photos, boxes = [{', '.join(photos)}], {list(boxes)}",
            "result = registrar.register_views(photos, boxes, cameras, T_cam_from_world)",
        ]
    else:
        assert isinstance(result.registration, RegisteredPhotograph)
        camera = _camera(result.registration.photograph)
        given = _given(box=request.box) + (f", camera={camera}" if camera else "")
        given += "" if prior is None else f", prior=cr.PosePrior(**{prior.to_dict()})"
        if of_registrar or of_parts or is_bank:
            call = [registrar, f"result = cr.register({photos[0]}, registrar{given})"]
        else:
            call = [f"result = cr.register({photos[0]}, {mesh}{given}{of_mesh})"]
    lines = [
        "import curvireg_torch as cr",
        "",
        *call,
        f"pose = result.hypotheses[{result.answer.number}].pose_dict()",
        *(
            [f"pose = {result.answer.pose.pose_dict()}  # corrected by hand"]
            if result.answer.edits
            else []
        ),
    ]
    return "\n".join([*lines, "print(pose)", ""])


def _camera(photograph: Photograph) -> str:
    """The camera of a photograph, without distortion, as Python; empty for one that is found again:
    by the EXIF data, or estimated."""
    camera = photograph.camera
    if camera is None or camera.source == "exif":
        return ""
    matrix = f"cr.camera_matrix{camera_numbers(camera.matrix)}"
    if not camera.focal_deviation:
        return matrix
    source = ", source='estimated'" if photograph.has_estimated_camera else ""
    return f"cr.Camera({matrix}, focal_deviation={camera.focal_deviation}{source})"


def _given(**values: Any) -> str:
    """Arguments of a call without those that have their defaults."""
    return "".join(
        f", {name}={value!r}" for name, value in values.items() if value != _DEFAULTS[name]
    )


def _pipeline(request: RegisterOptions) -> str:
    """The pipeline of a request as Python, empty for the default one, or that of a bank."""
    pipeline = f"cr.Pipeline.read({str(request.pipeline)!r})" if request.pipeline else ""
    pipeline = f"cr.pipeline.PRESETS[{request.preset!r}]" if request.preset else pipeline
    changes = ""
    if request.pose:
        changes = f".with_pose_prior({request.pose!r})"
    if request.box_is:
        changes = f"{changes}.with_boxes({request.box_is!r})"
    if changes:
        return f"{pipeline or 'cr.Pipeline()'}{changes}"
    return "" if request.bank_decides else pipeline


def command_line(options: RegisterOptions, name: Callable[[Path], str], rig: str = "") -> str:
    """``curvireg register`` with these options; ``name`` tells what the user calls a file."""
    photos, meshes = (
        [_no_option(name(path)) for path in paths] for paths in (options.photos, options.meshes)
    )
    words = ["curvireg", "register"]
    words += ["--views", _no_option(rig)] if rig else photos or ["PHOTO"]
    words += meshes or ["MESH"]
    limits = options.limits if options.limits.keys() - QUALIFIERS else {}
    values: dict[str, Any] = {
        "box": options.box,
        "fov" if isinstance(options.camera, float) else "camera": options.camera,
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


def _no_option(name: str) -> str:
    """A file name that no command takes for an option."""
    return f"./{name}" if name.startswith("-") else name

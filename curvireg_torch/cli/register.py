"""``curvireg register PHOTO... MESH``."""

import argparse
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from itertools import chain
from pathlib import Path
from typing import Any

from ..errors import CurviregError, InvalidInputError
from ..formats.exports.ros import OPTICAL_FRAME, time_stamp
from ..jobs.options import CAMERA_OPTIONS, PRIOR_OPTIONS, RegisterOptions, whole_number
from ..jobs.store import to_json
from ..utils.choices import VIDEOS, check_given, is_one_photograph
from ..utils.executors import opened_workers
from .libraries import load_libraries
from .options import (
    BOXES,
    PHOTOGRAPH,
    TRACKERS,
    add_command,
    add_limits,
    add_options,
    add_path,
    add_workers,
    conflict,
    given_options,
    input_files,
    numbers_among,
    register_options,
)

# photographs of a list that could not be registered, of which the command prints the reason
MAX_FAILURES = 10
# By what ``--need`` names, the verdicts that are enough for ``--strict``
ENOUGH = {"pose": ("reliable",), "axis": ("reliable", "reliable axis")}
# exit codes of ``--strict``
NONE_RELIABLE = 3
SOME_FAILED = 4
FORMATS = ("ros", *TRACKERS)


def add_register(commands: Any) -> None:
    parser = add_command(
        commands,
        "register",
        "curvireg register photo.jpg part.stl --unit mm --box 410 220 890 700 --out out/part",
        "curvireg register photo.jpg part.stl --camera 1450 1450 960 540 --json",
        "curvireg register photo.jpg part.stl --camera exif --out out/part",
        "curvireg register shelf.jpg part.stl --instances 4 --out out/shelf",
        "curvireg register --list photos.csv part.stl --out out/parts",
        "curvireg register shots/ turn.mp4 part.stl --every 10 --out out/shots",
        "curvireg register photo.jpg --mesh mug.obj --mesh bowl.obj --out out/which",
        "curvireg register --views rig.csv part.stl --unit mm --out out/rig",
        help="find the pose of MESH in PHOTO",
        usage="curvireg register PHOTO... MESH --out DIR [options]\n       "
        "curvireg register --list LIST [MESH] --out DIR [options]\n       "
        "curvireg register --views RIG MESH --out DIR [options]",
        description="One photograph: writes DIR/result.json, DIR/overlay.png and "
        "DIR/pose.glb.\nSeveral, or a list: DIR/results.csv, DIR/results.jsonl and "
        "DIR/index.html;\nafter an interruption the same command resumes.",
        run=run,
    )
    add = parser.add_argument
    add_path(
        parser,
        "paths",
        "PHOTO... MESH",
        nargs="*",
        help="photographs, folders of them, patterns ('shots/*.jpg') or videos; last a mesh (.obj "
        ".ply .stl .off .glb .gltf .3mf .urdf; with extras .step .iges .dae .usdz) or a bank. "
        "Textures and colours are compared too; a mesh without colours is grey",
    )
    candidates = "a candidate mesh; repeat the option, and the best of them is reported"
    add_path(parser, "--mesh", "MESH", action="append", default=[], help=candidates)
    add_path(
        parser,
        "--list",
        "LIST",
        help="CSV with columns photo,x0,y0,x1,y1 and optionally fx,fy,cx,cy,mesh and "
        "azimuth,side,... (see below: what is known about the pose). Paths are relative to the "
        "list's folder. Empty cells mean: detect the object, EXIF or an estimated camera, MESH, "
        "what the options say",
    )
    add_path(
        parser,
        "--views",
        "RIG",
        help="photographs of one pose from cameras with known poses: CSV with columns "
        "photo,x0,y0,x1,y1 (box may be empty), fx,fy,cx,cy or camera (a file), r11..r33 or "
        "qw,qx,qy,qz and tx,ty,tz (camera from world, in the mesh's unit); a folder of COLMAP with "
        "images.txt and cameras.txt; or the folder of a BOP scene with cam_R_w2c",
    )
    add(
        "--every",
        type=whole_number(1),
        default=1,
        metavar="N",
        help="use every N-th frame of videos (default: 1)",
    )
    add_options(
        parser,
        *PHOTOGRAPH,
        *BOXES,
        "start",
        "start_convention",
        "instances",
        "field",
        "hypotheses",
        "refine",
    )
    add_limits(parser)
    add_workers(parser, "for several photographs")
    strict = (
        f"exit code {NONE_RELIABLE} if no result is reliable, else {SOME_FAILED} if some "
        f"photographs failed"
    )
    add("--strict", action="store_true", help=strict)
    need = (
        "with --strict: what must be reliable, the whole pose or, of nearly round objects, at "
        "least the axis (default: pose)"
    )
    add("--need", choices=tuple(ENOUGH), help=need)
    formats = (
        "ros: also write DIR/pose.yaml, a PoseStamped, DIR/tf.yaml, and, of reliable poses, "
        "DIR/pose_with_covariance.yaml, in metres; m3t, visp: a start pose and the mesh for these "
        "trackers, DIR/object.yaml and others, or DIR/object.cao, object.init and object.pos"
    )
    add("--format", choices=FORMATS, help=formats)
    stamp = "with --format ros: when the photograph was taken, in seconds since 1970 (default: 0)"
    add("--stamp", type=time_stamp, metavar="SECONDS", help=stamp)
    frame = f"with --format ros: the camera's frame (default: {OPTICAL_FRAME})"
    add("--frame", metavar="NAME", help=frame)
    add("--json", action="store_true", help="print only the results as JSON; --out is optional")
    add_path(parser, "--out", "DIR", help="folder of the results; made if it does not exist")


NO_CAMERA = f"needs a camera with --mesh-is similar; give {CAMERA_OPTIONS}"
CONFLICTS = {
    "missing": "expected PHOTO MESH, PHOTO ... --mesh MESH, or --list FILE MESH",
    "!out !json": "expected --out DIR, or --json",
    "views list|start|no_mesh": "--views takes one or several meshes, and neither --list nor "
    "--start",
    "box|boxes|mask instances": "--instances applies only without a box; leave --box and --mask "
    "out",
    "start|views instances": "--start and --views are of one object; leave --instances out",
    "hypotheses start": "--start refines one pose; leave --hypotheses out",
    "start !refine": "--start refines a pose; leave --no-refine out",
    "views boxes": "the rig holds the boxes; leave --boxes out",
    **{
        f"{name} alone": f"--{name}: several processes share several photographs; leave it out for "
        "one result"
        for name in ("scheduler", "jobs")
    },
    "boxes videos": "--boxes are of photographs; give frames as pictures, or use curvireg follow",
    "every !videos": "--every applies to the frames of videos; leave it out",
    "start box|mask|listed|meshes": "--start refines one mesh in one photograph; leave --box, "
    "--mask and --list out",
    "views mask": "--views: a rig takes no masks; leave --mask out",
    "listed box|mask|matrix": "the list holds boxes, masks and cameras; leave --box, --mask and "
    "--camera out",
    "views guess|prior|camera": "the rig holds the cameras, and a rig takes no pose prior; leave "
    "--camera, --fov, --azimuth, ... out",
    "start_convention !start": "--start-convention: of the pose of --start; give it too",
    "start prior": "--start: refines this pose alone; leave the pose prior out",
    "distance !listed !camera !guess similar": f"--distance: {NO_CAMERA}",
    "start|mask !one": "--start and --mask are of one photograph; give several masks in a list, "
    "column mask",
    "stamp !ros": "--stamp: of the messages of --format ros; give it too",
    "frame !ros": "--frame: of the messages of --format ros; give it too",
    "need !strict": "--need says what --strict asks for; give it too",
    "format !alone": "--format {format}: of one result, in --out DIR",
    "format !out": "--format {format}: of one result, in --out DIR",
    "tracker views": "--format {format}: a tracker starts in one camera, not in a rig's world",
    "format !views !camera !guess similar": f"--format {{format}}: {NO_CAMERA}",
}
"""Options that conflict, see :func:`.options.conflict`, and what is said about them."""


def complete(arguments: argparse.Namespace) -> str | None:
    """Divide ``paths`` into ``photos`` and ``meshes``, and tell whether there is one result
    ``alone``; returns what is wrong with the options together, or None."""
    rig = arguments.views
    listed = arguments.list is not None or rig is not None
    arguments.photos = [] if listed else arguments.paths if arguments.mesh else arguments.paths[:-1]
    arguments.meshes = [*arguments.paths[len(arguments.photos) :], *arguments.mesh]
    if arguments.unit is None and rig is not None and (rig / "scene_camera.json").is_file():
        arguments.unit = "mm"  # of the models in a BOP set
    if numbers := numbers_among(arguments.paths):
        return (
            f"{' '.join(numbers)}: numbers where a file is expected; --box and --camera take "
            f"four, --distance two"
        )
    if listed and len(arguments.paths) > 1:
        return (
            f"with --list or --views, expected at most one MESH, got {len(arguments.paths)}; give "
            f"several by --mesh"
        )
    is_one = is_one_photograph(arguments.photos)
    arguments.alone = rig is not None or (not listed and is_one)
    facts = {
        "listed": listed,
        "missing": not listed and not (arguments.photos and arguments.meshes),
        "one": is_one,
        "alone": arguments.alone,
        "videos": any(photo.suffix.lower() in VIDEOS for photo in arguments.photos),
        "no_mesh": not arguments.meshes,
        "meshes": len(arguments.meshes) > 1,
        "matrix": arguments.camera not in (None, "exif"),
        "prior": any(getattr(arguments, name) is not None for name in PRIOR_OPTIONS),
        "similar": arguments.mesh_is == "similar",
        "tracker": arguments.format in TRACKERS,
        "ros": arguments.format == "ros",
    }
    given = given_options(arguments) - facts.keys() | {name for name in facts if facts[name]}
    problem = conflict(CONFLICTS, given)
    return problem and problem.format(format=arguments.format)


def run(arguments: argparse.Namespace) -> int:
    """Register one photograph, or several; returns the exit code."""
    enough = ENOUGH[arguments.need or "pose"]
    if arguments.alone:
        is_enough = _register_alone(arguments) in enough
        return NONE_RELIABLE if arguments.strict and not is_enough else 0
    options = _checked_options(arguments)
    from ..utils.threads import one_torch_thread
    from .registering import register_several

    with ExitStack() as stack:
        stack.enter_context(one_torch_thread())
        out = arguments.out or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        workers = stack.enter_context(opened_workers(arguments.jobs, arguments.scheduler))
        counts = register_several(options, arguments, out, workers)
        if arguments.json:
            print((out / "results.jsonl").read_text(encoding="utf-8"), end="")
    notes = sys.stderr if arguments.json else sys.stdout
    for failure in counts.failures[:MAX_FAILURES]:
        print(f"failed: {failure}", file=notes)
    if (more := len(counts.failures) - MAX_FAILURES) > 0:
        print(f"failed: {more} more", file=notes)
    table = "" if arguments.out is None else f"; see {out}/results.csv"
    print(f"{counts}{table}", file=notes)
    if not counts.posed:
        message = "no photograph could be registered; the message of each gives the reason"
        raise InvalidInputError(message, subject=arguments.list or "")
    if not arguments.strict:
        return 0
    if not any(counts.verdicts.get(verdict) for verdict in enough):
        return NONE_RELIABLE
    return SOME_FAILED if counts.failures else 0


def _checked_options(arguments: argparse.Namespace) -> RegisterOptions:
    """The options; errors in them come before any photograph is read."""
    check_given(arguments.photos, arguments.meshes, arguments.list or arguments.views)
    if arguments.list is not None and arguments.progress:  # a long one takes seconds
        print(f"{arguments.list}: reading", file=sys.stderr, flush=True)
    load_libraries()
    return register_options(arguments, arguments.photos, arguments.meshes)


def _register_alone(arguments: argparse.Namespace) -> str:
    """Register one photograph or rig; returns the verdict. An older result goes first."""
    from ..jobs.outputs import output_folder

    with ExitStack() as stack:
        if arguments.out is not None:
            named = input_files(arguments, *arguments.photos, *arguments.meshes)
            inputs = chain(named, _photographs_of_rig(arguments))
            stack.enter_context(output_folder(arguments.out, "register", inputs=inputs))
        options = _checked_options(arguments)
        from ..utils.threads import one_torch_thread
        from .printing import print_result
        from .registering import register_one, register_views

        stack.enter_context(one_torch_thread())
        register = register_one if arguments.views is None else register_views
        document = register(options, arguments)
        if arguments.json:
            print(to_json(document), end="")
        else:
            print_result(document, arguments.out)
    return str(document["verdict"])


def _photographs_of_rig(arguments: argparse.Namespace) -> Iterator[Path]:
    """The photographs of a rig that can be read."""
    if arguments.views is None:
        return
    from ..jobs.rigs import read_rig

    with suppress(CurviregError):  # that the registration reports
        yield from (view.photo for view in read_rig(arguments.views, arguments.meshes[0]))

"""``curvireg register PHOTO... MESH``."""

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import CurviregError, InvalidInputError, LostObjectError
from ..formats.exports.ros import OPTICAL_FRAME, time_stamp
from ..jobs.options import CAMERA_OPTIONS, PRIOR_OPTIONS, whole_number
from ..utils.aliases import Document, Fields
from ..utils.choices import VIDEOS, check_given, is_one_photograph
from .libraries import load_libraries
from .options import (
    BOXES,
    PHOTOGRAPH,
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
from .stages import shown_stages

if TYPE_CHECKING:
    from ..jobs.lists import Counts
    from ..jobs.options import RegisterOptions
    from ..registration import Registrar
    from ..utils.executors import Workers

# photographs of a list that could not be registered, of which the command prints the reason
MAX_FAILURES = 10
# By what ``--need`` names, the verdicts that are enough for ``--strict``
ENOUGH = {"pose": ("reliable",), "axis": ("reliable", "reliable axis")}
# exit codes of ``--strict``
NONE_RELIABLE = 3
SOME_FAILED = 4
NOT_CALIBRATED = "not calibrated for other terms, fields or views than the default ones"
TRACKERS = ("m3t", "visp")
FORMATS = ("ros", *TRACKERS)
OPEN_AXES = 1.0  # axes of rotation that a fit leaves undetermined, from which the advice says so


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
        "DIR/pose.glb.\nSeveral, or a list: "
        "DIR/results.csv, DIR/results.jsonl and DIR/index.html;\nafter an interruption the same "
        "command resumes.",
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
        "azimuth,side,... (see below: what "
        "is known about the pose). Paths are relative to the list's folder. Empty cells mean: "
        "detect the object, "
        "EXIF or an estimated camera, MESH, what the options say",
    )
    add_path(
        parser,
        "--views",
        "RIG",
        help="photographs of one pose from cameras with known poses: CSV with columns "
        "photo,x0,y0,x1,y1 (box may be "
        "empty), fx,fy,cx,cy or camera (a file), r11..r33 or qw,qx,qy,qz and tx,ty,tz (camera "
        "from world, in the "
        "mesh's unit); a folder of COLMAP with images.txt and cameras.txt; or the folder of a BOP "
        "scene with cam_R_w2c",
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
    **{
        f"{name} alone": f"--{name}: several processes share several photographs; leave it out for "
        "one result"
        for name in ("scheduler", "jobs")
    },
    "boxes videos": "--boxes are of photographs; give frames as pictures, or use curvireg follow",
    "every !videos": "--every applies to the frames of videos; leave it out",
    "start box|mask|listed|meshes": "--start refines one mesh in one photograph; leave --box, "
    "--mask and --list out",
    "listed box|mask|matrix": "the list holds boxes, masks and cameras; leave --box, --mask and "
    "--camera out",
    "views guess|prior": "the rig holds the cameras, and a rig takes no pose prior; leave --fov, "
    "--azimuth, ... out",
    "start_convention !start": "--start-convention: of the pose of --start; give it too",
    "start prior": "--start: refines this pose alone; leave the pose prior out",
    "distance !listed !camera !guess similar": f"--distance: {NO_CAMERA}",
    "start|mask !one": "--start and --mask are of one photograph; give several masks in a list, "
    "column mask",
    "stamp !ros": "--stamp: of the messages of --format ros; give it too",
    "frame !ros": "--frame: of the messages of --format ros; give it too",
    "need !strict": "--need says what --strict asks for; give it too",
    "format list": "--format {format}: of one result, in --out DIR",
    "format !out": "--format {format}: of one result, in --out DIR",
    "tracker views": "--format {format}: a tracker starts in one camera, not in a rig's world",
    "format !views !camera !guess similar": f"--format {{format}}: {NO_CAMERA}",
}
"""Options that conflict, see :func:`.options.conflict`, and what is said about them."""


def complete(arguments: argparse.Namespace) -> str | None:
    """Divide ``paths`` into ``photos`` and ``meshes``; returns what is wrong with the options
    together, or None."""
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
    facts = {
        "listed": listed,
        "missing": not listed and not (arguments.photos and arguments.meshes),
        "one": is_one,
        "alone": rig is not None or (not listed and is_one),
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
    if arguments.views is not None or (
        arguments.list is None and is_one_photograph(arguments.photos)
    ):
        verdict = _register_alone(arguments)
        is_enough = not arguments.strict or verdict in ENOUGH[arguments.need or "pose"]
        return 0 if is_enough else NONE_RELIABLE
    options = _checked_options(arguments)
    from ..utils.executors import opened_workers
    from ..utils.threads import one_torch_thread

    with (
        one_torch_thread(),
        _output(arguments) as out,
        opened_workers(arguments.jobs, arguments.scheduler) as workers,
    ):
        counts = _register_several(options, arguments, out, workers)
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
    if not any(counts.verdicts.get(verdict) for verdict in ENOUGH[arguments.need or "pose"]):
        return NONE_RELIABLE
    return SOME_FAILED if counts.failures else 0


def _checked_options(arguments: argparse.Namespace) -> "RegisterOptions":
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

        stack.enter_context(one_torch_thread())
        register = _register_one if arguments.views is None else _register_rig
        document = register(options, arguments)
        if arguments.json:
            from ..jobs.store import to_json

            print(to_json(document), end="")
        else:
            print_result(document, arguments.out)
    return str(document["verdict"])


@contextmanager
def _output(arguments: argparse.Namespace) -> Iterator[Path]:
    """The folder of the results, or one for the time being."""
    if arguments.out is not None:
        yield arguments.out
        return
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


def _photographs_of_rig(arguments: argparse.Namespace) -> Iterator[Path]:
    """The photographs of a rig that can be read."""
    if arguments.views is None:
        return
    from ..jobs.rigs import read_rig

    with suppress(CurviregError):  # that the registration reports
        yield from (view.photo for view in read_rig(arguments.views, arguments.meshes[0]))


def _register_one(options: "RegisterOptions", arguments: argparse.Namespace) -> Document:
    """Register one photograph and write the result; returns its document."""
    from ..jobs.entry import entry_of, prepare
    from ..jobs.photograph import register_entry
    from ..jobs.result_files import write_lost
    from ..visualization.words import camera_in_words

    out = arguments.out
    path = options.photos[0]
    entry = entry_of(path, options)
    photograph = prepare(entry)
    if options.progress and not (options.box or options.boxes or options.mask or options.start):
        print(
            f"{path}: detecting the object; --box X0 Y0 X1 Y1 is faster and more reliable",
            file=sys.stderr,
        )
    with opened_registrar(options) as (registrar, seconds):
        try:
            found = register_entry(entry, photograph, registrar, bank_seconds=seconds)
        except LostObjectError as error:
            if out is not None:
                write_lost(out, str(error))
            raise
    if out is not None:
        found.write(out)
    _write_pose(arguments, found.document, found.registrar.of_mesh(found.mesh_index))
    for warning in found.warnings:
        print(f"curvireg: warning: {path}: {warning}", file=sys.stderr)
    remarks = [*photograph.facts["picture"]["notes"], *camera_in_words(found.document)]
    if photograph.camera is not None and photograph.camera.distorts:
        remarks.append(
            "distortion of the lens removed: boxes and overlay.png are of the undistorted "
            "photograph"
        )
    if not found.reliable and options.pose == "upright" and options.up is None:
        axis = found.registrar.of_mesh(found.mesh_index).bank.mesh.up
        remarks.append(f"--pose upright: {axis} of the mesh is taken as up; --up names another")
    if remarks:  # with --json, standard output holds only the result
        print(f"{path}: {'; '.join(remarks)}", file=sys.stderr if arguments.json else sys.stdout)
    return found.document


def _register_rig(options: "RegisterOptions", arguments: argparse.Namespace) -> Document:
    """Register the photographs of a rig together and write the result; returns its document."""
    from ..jobs.photograph import prepare_views
    from ..jobs.result_files import write_views
    from ..jobs.rigs import read_rig, register_rig
    from ..visualization.words import view_in_words

    out = arguments.out
    rig = read_rig(arguments.views, options.meshes[0])
    photographs = prepare_views(rig)
    with opened_registrar(options) as (registrar, seconds):
        result, document = register_rig(
            arguments.views, rig, photographs, registrar, bank_seconds=seconds
        )
    document["mesh"] = str(options.meshes[result.mesh_index])
    if out is not None:
        write_views(out, document, registrar, result, photographs)
    _write_pose(arguments, document, registrar.of_mesh(result.mesh_index))
    if not arguments.json:
        print("pose in the world (model to world)")
        for view in document["photographs"]:
            print(f"{view['name']}: {view_in_words(view)}")
    return document


def _write_pose(arguments: argparse.Namespace, document: Fields, registrar: "Registrar") -> None:
    """Write the pose in the format of another tool, if one is asked for."""
    from ..formats.exports.ros import write_ros

    if arguments.format in TRACKERS:
        from ..jobs.trackers import write_start

        write_start(arguments.format, arguments.out, registrar.bank.mesh, document)
    elif arguments.format:
        mesh = Path(document.get("mesh") or arguments.meshes[0])
        chosen = {name: getattr(arguments, name) for name in ("stamp", "frame")}
        given = {name: value for name, value in chosen.items() if value is not None}
        write_ros(arguments.out, document, child=mesh.stem, **given)
        if document["covariance"] is None:
            print(
                "curvireg: no pose_with_covariance.yaml, as this pose has no covariance",
                file=sys.stderr,
            )


def _register_several(
    options: "RegisterOptions", arguments: argparse.Namespace, out: Path, workers: "Workers"
) -> "Counts":
    """Register photographs that are named one by one, or by a list."""
    from ..jobs.lists import list_photographs, read_list, register_list
    from ..jobs.opening import open_registrar
    from ..pipeline import field_digest

    if arguments.list is None:
        photos = list_photographs(options, every=arguments.every)
        source = [str(path.resolve()) for path in options.photos]
        has_numbers = not isinstance(options.camera, str | float | None)
        given = ["--box"] * (options.box is not None) + ["--camera"] * has_numbers
        if given:
            print(f"{' and '.join(given)}: used for all {len(photos)} photographs", file=sys.stderr)
    else:
        photos = read_list(arguments.list, options)
        source = [str(arguments.list.resolve())]
    names = (
        "bank_decides",
        "pose",
        "box_is",
        "mesh_is",
        "unit",
        "link",
        "up",
        "hypotheses",
        "refine",
        "renderer",
        "device",
    )
    settings = {
        "pipeline": options.open_pipeline().describe(),
        "field": None if options.network is None else field_digest(options.network),
        **{name: getattr(options, name) for name in names},
    }
    return register_list(
        photos,
        out,
        partial(open_registrar, options),
        inputs=input_files(arguments),
        source=source,
        settings=settings,
        textures=[] if options.textures is None else [options.textures],
        progress=options.progress,
        workers=workers,
    )


def print_result(document: Document, out: Path) -> None:
    """Print a :func:`~curvireg_torch.jobs.documents.result_document`; ``out`` is the folder
    of its files."""
    from ..registration.confidence import two_decimals
    from ..visualization.words import measured, remarks

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
        print(f"standard deviations: {values}   (about and along the camera's axes)")
    seconds = document["seconds"]
    print(
        f"bank {seconds['bank']:.1f} s, registration {seconds['register']:.1f} s; see "
        f"{out}/overlay.png"
    )


def _print_objects(document: Document) -> None:
    """Print where objects were detected, and the confidence of each if there are several."""
    from ..registration.confidence import two_decimals
    from ..visualization.words import corners

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
    from ..registration.confidence import two_decimals
    from ..registration.result import likely_rivals

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
        return "the box is in px: of percent, divide it by 100 and add --box-format fractions"
    if (orientation := picture["orientation"]) != 1:
        return (
            f"box and mask are of the photograph as it is shown, with its EXIF orientation "
            f"{orientation} applied: check that they are not of the pixels in the file"
        )
    return ""


@contextmanager
def opened_registrar(options: "RegisterOptions") -> "Iterator[tuple[Registrar, float]]":
    """The registrar of the options' meshes, and the seconds that it took to open. A terminal shows
    its stages."""
    from ..jobs.opening import open_registrar

    start = time.perf_counter()
    with shown_stages(shown=options.progress) as show:
        progress = show if options.progress else None
        registrar = open_registrar(options, options.meshes, progress=progress)
        registrar.progress = progress or False
        yield registrar, time.perf_counter() - start

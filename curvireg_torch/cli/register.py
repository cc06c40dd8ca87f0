"""``curvireg register PHOTO... MESH``."""

import argparse
import re
import sys
import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InvalidInputError, LostObjectError
from ..utils.choices import check_given, is_one_photograph
from ..utils.files import check_writable
from .options import (
    NUMBER,
    add_box_and_camera,
    add_mesh_is,
    add_pose_prior,
    common_options,
    examples,
    mesh_options,
    pipeline_options,
    register_options,
    whole_number,
)
from .stages import show_stages

if TYPE_CHECKING:
    from ..evaluation.lists import PhotoList
    from ..evaluation.opening import RegisterOptions

MAX_FAILURES = 10
"""Photographs of a list that could not be registered, of which the command prints the reason."""


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "register",
        parents=[common_options(), pipeline_options(), mesh_options()],
        help="find the pose of MESH in PHOTO",
        usage="curvireg register PHOTO... MESH --out DIR [options]\n       "
        "curvireg register --list LIST [MESH] --out DIR [options]",
        description="One photograph: writes DIR/result.json, DIR/overlay.png and DIR/pose.glb.\nSeveral, or a list: "
        "DIR/results.csv, DIR/results.jsonl and DIR/index.html;\nafter an interruption the same command resumes.",
        **examples(
            "curvireg register photo.jpg part.stl --unit mm --box 410 220 890 700 --out out/part",
            "curvireg register photo.jpg part.stl --camera 1450 1450 960 540 --json",
            "curvireg register photo.jpg part.stl --camera exif --out out/part",
            "curvireg register shelf.jpg part.stl --instances 4 --out out/shelf",
            "curvireg register --list photos.csv part.stl --out out/parts",
            "curvireg register shots/ turn.mp4 part.stl --every 10 --out out/shots",
            "curvireg register photo.jpg --mesh mug.obj --mesh bowl.obj --out out/which",
        ),
    )
    add = parser.add_argument
    add(
        "paths",
        type=Path,
        nargs="*",
        metavar="PHOTO... MESH",
        help="photographs, folders of them, patterns ('shots/*.jpg') or videos; last a mesh (.obj .ply .stl .off .glb "
        ".gltf) or a bank. Textures and colours of .glb .obj .ply are compared too; a mesh without colours is grey",
    )
    candidates = "a candidate mesh; repeat the option, and the best of them is reported"
    add("--mesh", type=Path, action="append", default=[], metavar="MESH", help=candidates)
    add(
        "--list",
        type=Path,
        metavar="LIST",
        help="CSV with columns photo,x0,y0,x1,y1 and optionally fx,fy,cx,cy,mesh and azimuth,side,... (see below: what "
        "is known about the pose). Paths are relative to the list's folder. Empty cells mean: detect the object, no "
        "camera, MESH, what the options say. Or the same as JSON, COCO annotations, or the folder of a BOP scene",
    )
    add("--every", type=whole_number(1), default=1, metavar="N", help="use every N-th frame of videos (default: 1)")
    add_box_and_camera(
        parser,
        box="in px; default: the object is detected",
        camera="in px; gives the translation. For an unknown camera give --camera exif (focal length of the "
        "photograph's file) or --fov; the result then has no covariance",
    )
    add("--exif", action="store_true", help=argparse.SUPPRESS)
    start = "result.json, or any JSON with rotation and translation: refine this pose in one photograph; needs no box"
    add("--start", type=Path, metavar="FILE", help=start)
    add_pose_prior(parser)
    add_mesh_is(parser)
    add("--instances", type=whole_number(1), default=1, metavar="N", help="without a box: up to N objects (default: 1)")
    add("--field", type=Path, metavar="FILE", help="weights of a learned field")
    add("--top", type=whole_number(1), metavar="K", help="hypotheses to carry and report (default: 5)")
    add("--no-refine", dest="refine", action="store_false", help="stop at the best view of the bank")
    add(
        "--jobs",
        type=whole_number(1),
        default=1,
        metavar="N",
        help="processes for several photographs (default: 1)",
    )
    add("--json", action="store_true", help="print only the results as JSON; --out is optional")
    add("--out", type=Path, metavar="DIR", help="folder of the results; made if it does not exist")
    parser.set_defaults(run=run)


def complete(arguments: argparse.Namespace) -> str | None:
    """Divide ``paths`` into ``photos`` and ``meshes``; returns what is wrong with the options together, or None."""
    arguments.photos = [] if arguments.list else arguments.paths if arguments.mesh else arguments.paths[:-1]
    arguments.meshes = [*arguments.paths[len(arguments.photos) :], *arguments.mesh]
    if arguments.unit is None and arguments.list is not None and arguments.list.is_dir():
        arguments.unit = "mm"  # of the models in a BOP set
    if numbers := [str(path) for path in arguments.paths if re.fullmatch(NUMBER, str(path))]:
        return f"{' '.join(numbers)}: numbers where a file is expected; --box and --camera take four, --distance two"
    if arguments.list is None and not (arguments.photos and arguments.meshes):
        return "expected PHOTO MESH, PHOTO ... --mesh MESH, or --list FILE MESH"
    if arguments.out is None and not arguments.json:
        return "expected --out DIR, or --json"
    if arguments.out is None and arguments.jobs > 1:
        return "--jobs: several processes need --out DIR, where their results meet"
    if arguments.list is not None and len(arguments.paths) > 1:
        return f"with --list, expected at most one MESH, got {len(arguments.paths)}; give several by --mesh"
    if sum(map(bool, (arguments.camera, arguments.exif, arguments.fov))) > 1:
        return "expected one of --camera FX FY CX CY, --camera exif, --fov DEG"
    if arguments.box and arguments.instances != 1:
        return "--instances applies only without a box; leave --box out"
    if arguments.start is not None and (arguments.box or arguments.list is not None or len(arguments.meshes) > 1):
        return "--start refines one mesh in one photograph; leave --box and --list out"
    if arguments.list is not None and (arguments.box or arguments.camera):
        return "the list holds boxes and cameras; leave --box and --camera out"
    return None


def run(arguments: argparse.Namespace) -> None:
    """Register one photograph, or several."""
    check_given(arguments.photos, arguments.meshes, arguments.list)
    from ..evaluation.opening import check_camera
    from ..evaluation.prior_options import prior_from_limits
    from ..evaluation.workers import run_processes
    from ..utils.threads import one_torch_thread

    options = register_options(arguments, arguments.photos, arguments.meshes)
    options.open_pipeline()  # errors in options come before any photograph is read
    field = options.open_field()
    check_camera(options.camera, options.guess)
    if prior_from_limits(options.limits or {}) is None and options.limits and arguments.list is None:
        raise InvalidInputError("--front limits nothing by itself; give --azimuth, for instance")
    if "distance" in (options.limits or {}) and arguments.list is None and not (options.camera or options.guess):
        raise InvalidInputError("--distance: needs a camera; give --camera FX FY CX CY, --camera exif or --fov DEG")
    if options.start is not None and options.limits:
        raise InvalidInputError("--start: refines this pose alone; leave limits on the pose out")
    if arguments.list is None and is_one_photograph(options.photos):
        with one_torch_thread():
            _register_one(options, field, arguments.out, as_json=arguments.json)
        return
    if options.start is not None:
        raise InvalidInputError("--start: refines one pose; give one photograph")
    if run_processes(arguments.jobs, arguments.argv):
        return
    with one_torch_thread(), tempfile.TemporaryDirectory() as folder:
        out = Path(folder) if arguments.out is None else arguments.out
        photos = _photo_list(options, arguments.list, out, every=arguments.every)
        counts = _register_several(options, field, photos, out)
        if counts is None:  # another process writes the tables
            return
        if arguments.json:
            print((out / "results.jsonl").read_text(encoding="utf-8"), end="")
    notes = sys.stderr if arguments.json else sys.stdout
    for failure in counts.failures[:MAX_FAILURES]:
        print(f"failed: {failure}", file=notes)
    if (more := len(counts.failures) - MAX_FAILURES) > 0:
        print(f"failed: {more} more", file=notes)
    table = "" if arguments.out is None else f"; see {out}/results.csv"
    print(f"{counts}{table}", file=notes)
    if not counts.ok:
        subject = {} if arguments.list is None else {"subject": arguments.list}
        message = "no photograph could be registered; the message of each gives the reason"
        raise InvalidInputError(message, **subject)


def _register_one(options: "RegisterOptions", field: Any, out: Path | None, *, as_json: bool) -> None:
    import torch

    from ..data import read_photo
    from ..evaluation.opening import open_registrar
    from ..evaluation.result_files import write_lost, write_result
    from ..evaluation.runner import check_entry, register_entry
    from ..evaluation.store import to_json
    from ..registration.result import used_box
    from .report import print_result

    start = time.perf_counter()
    path = options.photos[0]
    photo, entry = read_photo(path, dtype=torch.uint8), options.entry(path)
    check_entry(entry, photo)
    if out is not None:
        check_writable(out, "--out")
    if options.box is None and options.start is None and options.progress:
        print(f"{path}: detecting the object; --box X0 Y0 X1 Y1 is faster and more reliable", file=sys.stderr)
    with show_stages(enabled=options.progress) as progress:
        if progress is not None:
            progress("reading the mesh", 0, 1)
        registrar = open_registrar(options, options.meshes, field, progress=progress)
        registrar.progress = progress or False
        ready = time.perf_counter() - start
        try:
            result, document = register_entry(entry, photo, registrar, bank_seconds=ready)
        except LostObjectError as error:
            if out is not None:
                write_lost(out, str(error))
            raise
    notes = sys.stderr if as_json else sys.stdout  # with --json, standard output holds only the result
    if out is not None:
        write_result(out, document, registrar, result, photo.image, used_box(document))
    for warning in document["warnings"]:
        print(f"curvireg: warning: {path}: {warning}", file=sys.stderr)
    if document["inputs"]["camera_source"] in ("exif", "fov"):
        focal = document["inputs"]["camera"][0]
        note = f"camera guessed, focal length {focal:.0f} px; distances are off by the same factor"
        print(f"{path}: {note}", file=notes)
    if photo.notes:
        print(f"{path}: {'; '.join(photo.notes)}", file=notes)
    if as_json:
        print(to_json(document), end="")
    else:
        assert out is not None
        print_result(document, out)


def _register_several(options: "RegisterOptions", field: Any, photos: "PhotoList", out: Path) -> Any:
    from ..evaluation.lists import register_list
    from ..evaluation.opening import open_registrar
    from ..pipeline import field_digest

    names = ("bank_decides", "pose", "mesh_is", "unit", "up", "top", "refine", "renderer", "device")
    settings = {
        "pipeline": options.open_pipeline().describe(),
        "field": None if field is None else field_digest(field),
        **{name: getattr(options, name) for name in names},
    }
    open_meshes = partial(open_registrar, options, field=field)
    return register_list(photos, out, open_meshes, settings=settings, progress=options.progress)


def _photo_list(options: "RegisterOptions", path: Path | None, out: Path, *, every: int) -> "PhotoList":
    """The photographs that are named one by one or by the list at ``path``."""
    from ..evaluation.lists import list_photographs, read_list

    if path is not None:
        photos = read_list(path, options.meshes, options.limits)
        check_writable(out, "--out")
    else:
        check_writable(out, "--out")
        photos = list_photographs(
            options.photos,
            options.meshes,
            box=options.box,
            camera=options.camera,
            limits=options.limits,
            every=every,
            frames=out / "frames",
        )
        given = [f"--{name}" for name in ("box", "camera") if getattr(options, name) is not None]
        if given:
            print(f"{' and '.join(given)}: used for all {len(photos.entries)} photographs", file=sys.stderr)
    if options.guess is not None:
        print("unknown cameras are guessed; distances are off by the same factor as the guesses", file=sys.stderr)
    return replace(photos, entries=tuple(map(options.complete, photos.entries)))

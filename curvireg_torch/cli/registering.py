"""How ``register`` registers: one photograph, a rig, or several photographs."""

import argparse
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from ..errors import LostObjectError
from ..formats.exports.ros import write_ros
from ..jobs.entry import entry_of, prepare
from ..jobs.lists import Counts, list_photographs, read_list, register_list
from ..jobs.opening import open_registrar
from ..jobs.options import RegisterOptions
from ..jobs.photograph import prepare_views, register_entry
from ..jobs.result_files import write_lost
from ..jobs.rigs import read_rig, register_rig
from ..jobs.trackers import write_start
from ..pipeline import field_digest
from ..registration import Registrar
from ..utils.aliases import Document, Fields
from ..utils.executors import Workers
from ..visualization.words import camera_in_words, view_in_words
from .options import TRACKERS, input_files
from .stages import shown_stages


def register_one(options: RegisterOptions, arguments: argparse.Namespace) -> Document:
    """Register one photograph and write the result; returns its document."""
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
    of_mesh = found.registrar.of_mesh(found.mesh_index)
    _write_pose(arguments, found.document, of_mesh)
    for warning in found.warnings:
        print(f"curvireg: warning: {path}: {warning}", file=sys.stderr)
    remarks = [*photograph.facts["picture"]["notes"], *camera_in_words(found.document)]
    if photograph.camera is not None and photograph.camera.distorts:
        remarks.append(
            "distortion of the lens removed: boxes and overlay.png are of the undistorted "
            "photograph"
        )
    if not found.reliable and options.pose == "upright" and options.up is None:
        axis = of_mesh.bank.mesh.up
        remarks.append(f"--pose upright: {axis} of the mesh is taken as up; --up names another")
    if remarks:  # with --json, standard output holds only the result
        print(f"{path}: {'; '.join(remarks)}", file=sys.stderr if arguments.json else sys.stdout)
    return found.document


def register_views(options: RegisterOptions, arguments: argparse.Namespace) -> Document:
    """Register the photographs of a rig together and write the result; returns its document."""
    out = arguments.out
    rig = read_rig(arguments.views, options.meshes[0])
    photographs = prepare_views(rig)
    with opened_registrar(options) as (registrar, seconds):
        found = register_rig(arguments.views, rig, photographs, registrar, bank_seconds=seconds)
    document = found.document
    mesh_index = found.registration.mesh_index
    document["mesh"] = str(options.meshes[mesh_index])
    if out is not None:
        found.write(out)
    _write_pose(arguments, document, registrar.of_mesh(mesh_index))
    if not arguments.json:
        print("pose in the world (model to world)")
        for view in document["photographs"]:
            print(f"{view['name']}: {view_in_words(view)}")
    return document


def _write_pose(arguments: argparse.Namespace, document: Fields, registrar: Registrar) -> None:
    """Write the pose in the format of another tool, if one is asked for."""
    if arguments.format in TRACKERS:
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


def register_several(
    options: RegisterOptions, arguments: argparse.Namespace, out: Path, workers: Workers
) -> Counts:
    """Register photographs that are named one by one, or by a list."""
    if arguments.list is None:
        photos = list_photographs(options, every=arguments.every)
        source = [str(path.resolve()) for path in options.photos]
        is_measured = not isinstance(options.camera, str | float | None)
        given = ["--box"] * (options.box is not None) + ["--camera"] * is_measured
        if given and len(photos) > 1:
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


@contextmanager
def opened_registrar(options: RegisterOptions) -> Iterator[tuple[Registrar, float]]:
    """The registrar of the options' meshes, and the seconds that it took to open. A terminal shows
    its stages."""
    start = time.perf_counter()
    with shown_stages(shown=options.progress) as show:
        progress = show if options.progress else None
        registrar = open_registrar(options, options.meshes, progress=progress)
        registrar.progress = progress or False
        yield registrar, time.perf_counter() - start

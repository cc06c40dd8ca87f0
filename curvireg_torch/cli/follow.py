"""``curvireg follow FRAMES MESH``."""

import argparse
from pathlib import Path
from typing import Any

from ..errors import CurviregError, InvalidInputError, LostObjectError, MissingFileError
from ..utils.files import check_writable
from ..utils.input_paths import check_given
from .options import add_box_and_camera, common_options, examples, mesh_options, pipeline_options, register_options


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "follow",
        parents=[common_options(), pipeline_options(), mesh_options()],
        help="follow an object through the frames of a video",
        description="Registers the first frame and refines each next one from the pose before it.\nWrites "
        "DIR/results.csv: photo, status (ok, lost, failed), rotation row by row, translation in the\nmesh's unit, "
        "confidence and edge support.",
        **examples(
            "curvireg follow shots/ part.stl --unit mm --camera 1450 1450 960 540 --out out/follow",
            "curvireg follow turn.mp4 part.stl --camera 1450 1450 960 540 --box 410 220 890 700 --out out/follow",
        ),
    )
    frames = "a video, or a folder of frames in the order of their names"
    parser.add_argument("frames", type=Path, metavar="FRAMES", help=frames)
    parser.add_argument("mesh", type=Path, metavar="MESH", help="a mesh or a bank")
    add_box_and_camera(parser, box="px in the first frame; default: the object is localized", fov=False)
    parser.add_argument("--out", type=Path, metavar="DIR", required=True)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Follow the object, and write its poses."""
    check_given([arguments.frames], [arguments.mesh])
    if not arguments.frames.exists():
        raise MissingFileError("no such folder or video", subject=arguments.frames)
    if arguments.camera is None:
        raise InvalidInputError("follow: give --camera FX FY CX CY")
    from tqdm import tqdm

    from ..evaluation.lists import list_photographs
    from ..evaluation.lists.tables import POSE_COLUMNS
    from ..evaluation.opening import check_camera, open_registrar
    from ..geometry import camera_matrix
    from ..registration.following import Follower
    from ..utils.files import write_csv

    options = register_options(arguments, [arguments.frames], [arguments.mesh])
    check_camera(options.camera, None)
    check_writable(arguments.out, "--out")
    frames = list_photographs(options.photos, options.meshes, frames=arguments.out / "frames").entries
    follow = Follower(open_registrar(options, options.meshes, options.open_field()), camera_matrix(*arguments.camera))
    rows: list[list[Any]] = []
    try:
        for frame in tqdm(frames, desc="follow", unit="frame", disable=not options.progress):
            rows.append(_row(follow, frame.name, frame.photo, None if rows else options.box))
    finally:  # an interruption loses no pose
        header = ["photo", "status", *POSE_COLUMNS, "confidence", "edge_support"]
        write_csv(arguments.out / "results.csv", [header, *rows])
    counts = {status: sum(row[1] == status for row in rows) for status in ("ok", "lost", "failed")}
    summary = ", ".join(f"{count} {status}" for status, count in counts.items())
    print(f"{len(rows)} frames: {summary}; see {arguments.out}/results.csv")
    if not counts["ok"]:
        raise InvalidInputError("no frame could be registered; give --box of the object in the first frame")


def _row(follow: Any, name: str, path: Path, box: Any) -> list[Any]:
    from ..io import read_photo

    try:
        result = follow(read_photo(path).image, box)
    except (CurviregError, OSError):
        return [name, "failed", *[""] * 14]
    if not result.ok:
        return [name, "lost" if isinstance(result.error, LostObjectError) else "failed", *[""] * 14]
    pose = [*result.rotation.flatten().tolist(), *result.translation.tolist()]
    return [name, "ok", *pose, result.confidence, result.edge_support]

"""``curvireg follow FRAMES MESH``."""

import argparse
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import (
    CurviregError,
    ImageError,
    InvalidInputError,
    LostObjectError,
    MissingFileError,
)
from ..utils.choices import VIDEOS, check_given
from ..utils.files import check_writable
from .options import add_box_and_camera, common_options, examples, mesh_options, pipeline_options, register_options

if TYPE_CHECKING:
    from torch import Tensor

    from ..evaluation.opening import RegisterOptions
    from ..registration import FailedRegistration, Follower, Registration

FOLDER_FPS = 10.0
"""Frames per second of the overlay of a folder."""


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "follow",
        parents=[common_options(), pipeline_options(), mesh_options()],
        help="follow an object through the frames of a video",
        description="Registers the first frame and tracks the object from frame to frame. Writes\n"
        "DIR/results.csv: photo, status (ok: confidence of 0.5 or more; unsure, lost, failed),\nrotation row by row, "
        "translation in the mesh's unit, "
        "confidence, edge support, and why there is no pose;\n"
        "DIR/overlay.mp4: contours of the pose and confidence on each frame;\n"
        "DIR/support.png: edge support and confidence over the frames.",
        **examples(
            "curvireg follow shots/ part.stl --unit mm --camera 1450 1450 960 540 --out out/follow",
            "curvireg follow turn.mp4 part.stl --camera 1450 1450 960 540 --box 410 220 890 700 --out out/follow",
        ),
    )
    frames = "a video, or a folder of frames in the order of their names"
    parser.add_argument("frames", type=Path, metavar="FRAMES", help=frames)
    parser.add_argument("mesh", type=Path, metavar="MESH", help="a mesh or a bank")
    add_box_and_camera(parser, box="in px in the first frame; default: the object is detected", fov=False)
    parser.add_argument("--out", type=Path, metavar="DIR", required=True, help="folder of the results")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Follow the object; write its poses, and draw them."""
    check_given([arguments.frames], [arguments.mesh])
    if not arguments.frames.exists():
        raise MissingFileError("no such folder or video", subject=arguments.frames)
    if arguments.camera is None:
        raise InvalidInputError("follow: give --camera FX FY CX CY")
    from ..evaluation.opening import check_camera
    from ..utils.threads import one_torch_thread

    options, out = register_options(arguments, [arguments.frames], [arguments.mesh]), arguments.out
    check_camera(options.camera, None)
    check_writable(out, "--out")
    with one_torch_thread():
        rows, seconds, video = _follow(options, out)
    counts = {status: sum(row[1] == status for row in rows) for status in ("ok", "unsure", "lost", "failed")}
    summary = ", ".join([f"{counts['ok']} of {len(rows)} believed", *(f"{counts[s]} {s}" for s in list(counts)[1:])])
    after_first = seconds[1:]  # the first frame is registered
    rate = f", {len(after_first) / sum(after_first):.1f} frames per second" if after_first else ""
    print(f"{len(rows)} frames: {summary}{rate}; see {out}/results.csv and {video}")
    if not counts["ok"] and not counts["unsure"]:
        reason = f"; the first: {rows[0][-1]}" if rows else ""
        message = f"no frame could be registered{reason}; give frames that can be read, and --box of the object"
        raise InvalidInputError(message, subject=arguments.frames)


def _follow(options: "RegisterOptions", out: Path) -> tuple[list[list[Any]], list[float], Path]:
    """Rows of ``out / "results.csv"``, which is also written after an interruption, seconds that the pose of each frame
    took, and path of the overlay."""
    from tqdm import tqdm

    from ..evaluation.opening import open_registrar
    from ..geometry import camera_matrix
    from ..registration import Follower
    from ..visualization import OverlayVideo

    assert options.camera is not None
    frames, count, fps = _frames(options.photos[0], options.meshes)
    registrar = open_registrar(options, options.meshes, options.open_field())
    follow = Follower(registrar, camera_matrix(*options.camera))
    rows: list[list[Any]] = []
    seconds: list[float] = []
    try:
        with closing(OverlayVideo(out / "overlay.mp4", registrar, fps=fps)) as video:
            for name, image in tqdm(frames, desc="follow", unit="frame", total=count, disable=not options.progress):
                start = time.perf_counter()
                result = _pose(follow, image, None if rows else options.box)
                seconds.append(time.perf_counter() - start)
                rows.append(_row(name, result))
                video.add(None if isinstance(image, ImageError) else image, result)
    finally:
        if rows:
            _write_tables(out, rows)
    return rows, seconds, video.path


def _pose(follow: "Follower", image: "Tensor | ImageError", box: Any) -> "Registration | FailedRegistration":
    from ..registration import FailedRegistration

    try:
        return FailedRegistration(image) if isinstance(image, ImageError) else follow(image, box)
    except CurviregError as error:
        return FailedRegistration(error)


def _frames(path: Path, meshes: Sequence[Path]) -> tuple[Iterator[tuple[str, "Tensor | ImageError"]], int, float]:
    """Names and pixels of the frames, with errors in place of unreadable ones; their number, and frames per second."""
    from ..data import Video, read_photo
    from ..evaluation.lists import list_photographs

    if path.suffix.lower() in VIDEOS and path.is_file():
        video = Video(path)
        fps = video.fps if 0 < video.fps < 1000 else FOLDER_FPS
        return ((f"{path.stem}-{number:06d}", image) for number, image in video), video.count, fps
    photos = list_photographs([path], meshes, frames=path).entries

    def read() -> Iterator[tuple[str, "Tensor | ImageError"]]:
        for entry in photos:
            try:
                yield entry.name, read_photo(entry.photo).image
            except (CurviregError, OSError) as error:
                yield entry.name, ImageError(str(error))

    return read(), len(photos), FOLDER_FPS


def _row(name: str, result: "Registration | FailedRegistration") -> list[Any]:
    from ..registration import FailedRegistration
    from ..registration.following import BELIEVED_CONFIDENCE

    if isinstance(result, FailedRegistration):
        status = "lost" if isinstance(result.error, LostObjectError) else "failed"
        return [name, status, *[""] * 14, str(result.error)]
    assert result.translation is not None  # there is a camera matrix
    pose = [*result.rotation.flatten().tolist(), *result.translation.tolist()]
    believed = (result.confidence or 0.0) >= BELIEVED_CONFIDENCE
    return [name, "ok" if believed else "unsure", *pose, result.confidence, result.edge_support, ""]


def _write_tables(out: Path, rows: list[list[Any]]) -> None:
    """Write results.csv."""
    from ..evaluation.lists import POSE_COLUMNS
    from ..utils.files import write_csv

    header = ["photo", "status", *POSE_COLUMNS, "confidence", "edge_support", "message"]
    write_csv(out / "results.csv", [header, *rows])

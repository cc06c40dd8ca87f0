"""``curvireg follow FRAMES MESH``."""

import argparse
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import CurviregError, ImageError, InvalidInputError, LostObjectError, MissingFileError
from ..utils.choices import VIDEOS, check_given
from ..utils.files import check_writable
from .options import PHOTOGRAPH, add_command, add_options, register_options

if TYPE_CHECKING:
    from torch import Tensor

    from ..evaluation.opening import RegisterOptions
    from ..registration import FailedRegistration, Follower, Registration

FOLDER_FPS = 10.0
"""Frames per second of the overlay of a folder."""


def add_follow(commands: Any) -> None:
    parser = add_command(
        commands,
        "follow",
        "curvireg follow shots/ part.stl --unit mm --camera 1450 1450 960 540 --out out/follow",
        "curvireg follow turn.mp4 part.stl --camera 1450 1450 960 540 --box 410 220 890 700 --out out/follow",
        help="follow an object through the frames of a video",
        description="Registers the first frame and tracks the object from frame to frame. Writes\n"
        "DIR/results.csv: photo, status (ok: confidence of 0.5 or more; unsure, lost, failed),\nrotation row by row, "
        "translation in the mesh's unit, confidence, edge support, and why there is no pose;\n"
        "DIR/overlay.mp4: contours of the pose and confidence on each frame.",
        run=run,
    )
    frames = "a video, or a folder of frames in the order of their names"
    parser.add_argument("frames", type=Path, metavar="FRAMES", help=frames)
    parser.add_argument("mesh", type=Path, metavar="MESH", help="a mesh or a bank")
    add_options(parser, *PHOTOGRAPH, box="in px in the first frame; default: the object is localized")
    parser.add_argument("--out", type=Path, metavar="DIR", required=True, help="folder of the results")


def run(arguments: argparse.Namespace) -> None:
    """Follow the object; write its poses, and draw them."""
    if "://" in str(arguments.frames) or ":/" in str(arguments.frames):
        message = "streams are not read; record a video, or give a folder of frames"
        raise InvalidInputError(message, subject=arguments.frames)
    check_given([arguments.frames], [arguments.mesh])
    if not arguments.frames.exists():
        raise MissingFileError("no such folder or video", subject=arguments.frames)
    from ..evaluation.opening import check_camera
    from ..utils.threads import one_torch_thread

    options, out = register_options(arguments, [arguments.frames], [arguments.mesh]), arguments.out
    if options.camera is None and options.guess is None:
        raise InvalidInputError("follow: give --camera FX FY CX CY, --camera exif or --fov DEG")
    check_camera(options.camera, options.guess)
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
    from ..registration import Follower
    from ..visualization import OverlayVideo

    frames, count, fps = _frames(options.photos[0], options.meshes)
    K = _camera_matrix(options)
    registrar = open_registrar(options, options.meshes, options.open_field())
    follow = Follower(registrar, K)
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


def _camera_matrix(options: "RegisterOptions") -> "Tensor":
    """The given camera matrix, or that of the first frame by its EXIF or the field of view."""
    from ..data import Video, read_photo
    from ..evaluation.lists import list_photographs
    from ..geometry import camera_matrix
    from ..geometry.cameras import camera_of_view

    frames = options.photos[0]
    if options.camera is not None:
        return camera_matrix(*options.camera)
    if frames.is_file() and frames.suffix.lower() in VIDEOS:
        if options.guess == "exif":
            raise InvalidInputError("a video has no EXIF; give --camera FX FY CX CY, or --fov DEG", subject=frames)
        image = next(iter(Video(frames)))[1]
        return camera_of_view(float(options.guess or 0.0), (image.shape[-2], image.shape[-1]))
    first = list_photographs([frames], options.meshes, frames=frames).entries[0]
    photo = read_photo(first.photo)
    if options.guess != "exif":
        return camera_of_view(float(options.guess or 0.0), (photo.image.shape[-2], photo.image.shape[-1]))
    K = photo.guessed_camera_matrix()
    if K is None:
        raise InvalidInputError(
            "no focal length in its EXIF; give --camera FX FY CX CY, or --fov DEG", subject=first.photo
        )
    return K


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

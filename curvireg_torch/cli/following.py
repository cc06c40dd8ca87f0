"""How ``follow`` follows an object through a video, or live."""

import argparse
import itertools
import json
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from queue import Empty, Queue
from typing import Any

import cv2
import torch
from torch import Tensor
from tqdm import tqdm

from ..data import Photo, Video, read_photo
from ..data.images import ANIMATED, frame_tensor
from ..errors import CurviregError, ImageError, InvalidInputError
from ..formats.boxes import PictureSize, pixel_box
from ..formats.poses import PoseRecord
from ..geometry import Camera, undistorted
from ..geometry.crops import check_boxes
from ..jobs.entry import camera_of, entry_of, start_in_unit
from ..jobs.lists import POSE_COLUMNS, find_photographs, is_video
from ..jobs.opening import open_registrar
from ..jobs.options import CAMERA_OPTIONS, RegisterOptions, prior_from_limits
from ..jobs.outputs import output_folder
from ..registration import FailedRegistration, Follower, Registrar, Registration, refine
from ..registration.confidence import is_calibrated, two_decimals
from ..registration.tracking import BELIEVED_CONFIDENCE, KEPT_CONFIDENCE
from ..utils.aliases import Fields, Size
from ..utils.files import CsvFile
from ..utils.threads import one_torch_thread
from ..visualization import OverlayVideo
from ..visualization.words import focal_length_in_words, verdict_counts
from .options import input_files, register_options

Frame = tuple[str, Photo | ImageError]  # its name, and its pixels or why they cannot be read

FOLDER_FPS = 10.0  # frames per second of the overlay of a folder, or of a camera that does not tell

FRAMES_TO_LOCK = 3  # after which a pose that is not believed is spoken of
SCORES = ("confidence", "edge_support", "message")


@dataclass
class Tally:
    """What became of the frames so far: all that is kept of them in memory, since a live video may
    last for days."""

    counts: Counter[str] = field(default_factory=Counter)
    first_message: str = ""  # why the first frame has no pose
    seconds_after_first: float = 0.0  # the first frame is registered
    best_confidence: float = 0.0
    camera: str = ""  # in words, if its focal length is not known exactly

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.counts.total()

    def add(self, pose: Fields, seconds: float) -> None:
        """Count a frame that took ``seconds``."""
        if self.frames:
            self.seconds_after_first += seconds
        else:
            self.first_message = pose.get("message", "")
        self.counts[pose["verdict"]] += 1
        self.best_confidence = max(self.best_confidence, pose.get("confidence") or 0.0)

    def doubt(self) -> str:
        """What to say once, after the first frames, if the object was not found with certainty."""
        if self.frames != FRAMES_TO_LOCK or self.best_confidence >= BELIEVED_CONFIDENCE:
            return ""
        best = ""  # pipelines without calibration have no confidence
        if self.best_confidence > 0.0:
            best = f" (best confidence {two_decimals(self.best_confidence)})"
        return f"not sure of the object yet{best}; give --box, or --start near the pose"

    @property
    def posed(self) -> int:
        """Number of frames with a pose."""
        return self.frames - self.counts["lost"] - self.counts["failed"]

    def __str__(self) -> str:
        rate = ""
        if self.seconds_after_first > 0.0:
            rate = f", {(self.frames - 1) / self.seconds_after_first:.1f} frames per second"
        camera = f"; {self.camera}" if self.camera else ""
        frames = f"{self.frames} frame{'s' * (self.frames != 1)}"
        return f"{frames}: {verdict_counts(self.counts)}{rate}{camera}"


def follow(arguments: argparse.Namespace, *, live: bool) -> None:
    """Follow the object of the command; write its poses, and draw them. ``live`` frames have no
    end."""
    source = arguments.frames
    out = arguments.out
    options = register_options(arguments, [Path(source)], [arguments.mesh])
    if options.camera is None and options.mesh_is == "similar":
        raise InvalidInputError(
            f"follow: needs the camera with --mesh-is similar; give {CAMERA_OPTIONS}"
        )
    if out is None and not (arguments.json or arguments.show):
        raise InvalidInputError("follow: give --out DIR, --show or --json")
    with ExitStack() as stack:
        if out is not None:
            frames = [] if live else find_photographs(Path(source))
            inputs = input_files(arguments, arguments.mesh, *frames)
            stack.enter_context(output_folder(out, "follow", inputs=inputs))
        stack.enter_context(one_torch_thread())
        tally = _follow(options, arguments, live=live)
    files = ""
    if out is not None:
        video = out / "overlay.mp4"
        files = f"; see {out}/results.csv" + (f" and {video}" if video.is_file() else "")
    print(f"{tally}{files}", file=sys.stderr if arguments.json else sys.stdout)
    if not tally.posed:
        reason = f"; the first: {tally.first_message}" if tally.frames else ""
        message = (
            f"no frame could be registered{reason}; give frames that can be read, and --box of the "
            "object"
        )
        raise InvalidInputError(message, subject=source)


def _follow(options: RegisterOptions, arguments: argparse.Namespace, *, live: bool) -> Tally:
    """Follow the object; each pose is in ``results.csv`` once it is known."""
    out = arguments.out
    frames, count, fps = _live(arguments.frames) if live else _frames(options.photos[0])
    fps = fps if 0 < fps < 1000 else FOLDER_FPS
    registrar = open_registrar(options, options.meshes)
    tally = Tally()
    columns = ["photo", "verdict", *POSE_COLUMNS, *SCORES]
    table = None if out is None else CsvFile(out / "results.csv", columns)
    start = time.monotonic()
    sinks: list[Callable[[Tensor | None, Registration | FailedRegistration], object]] = []
    try:
        with ExitStack() as stack:
            if out is not None:
                video = OverlayVideo(out / "overlay.mp4", registrar, fps=fps)
                sinks.append(stack.enter_context(video).add)
            if arguments.show:
                from ..viewer.live import LivePage

                sinks.append(stack.enter_context(LivePage(registrar)).show)
            bar = tqdm(
                frames,
                desc="follow",
                unit="frame",
                total=count,
                disable=not options.progress or arguments.json,
            )
            for name, shown, result, took in _poses(options, registrar, bar):
                pose = {
                    "frame": name,
                    "seconds": round(time.monotonic() - start, 4),
                    **_document(result),
                }
                if table is not None:
                    table.add(_cells(pose))
                tally.add(pose, took)
                if doubt := tally.doubt():
                    tqdm.write(f"curvireg: {doubt}", file=sys.stderr)
                tally.camera = tally.camera or _camera_in_words(result)
                if arguments.json:
                    print(json.dumps(pose, allow_nan=False), flush=True)
                for sink in sinks:
                    sink(shown, result)
    except KeyboardInterrupt:
        if not live:  # a file has an end
            raise
    return tally


def _poses(
    options: RegisterOptions, registrar: Registrar, frames: Iterable[Frame]
) -> Iterator[tuple[str, Tensor | None, Registration | FailedRegistration, float]]:
    """Of each frame its name, its pixels without distortion, the pose, and the seconds that this
    took."""
    follow = None
    prior = prior_from_limits(options.limits)
    has_probabilities = is_calibrated(registrar.pipeline)
    is_first = True
    for name, photo in frames:
        begun = time.perf_counter()
        if isinstance(photo, ImageError):
            yield name, None, FailedRegistration(photo), time.perf_counter() - begun
            continue
        image = photo.image
        result: Registration | FailedRegistration
        try:
            box: Any = _box(options, name, photo, is_first=is_first)
            is_first = False
            if isinstance(options.camera, Camera):
                if options.camera.size is None:  # it is of frames as large as the first
                    options = replace(options, camera=options.camera.at(_size(photo)))
                seen = undistorted(
                    image, options.camera, None if box is None else torch.tensor(box)
                )
                image = seen.image
                box = seen.box
            start = None
            if follow is None:
                follow = Follower(registrar, _camera(options, photo), prior=prior)
                start = options.read_start()
            result = follow(image, box) if start is None else _started(follow, image, start)
            if isinstance(result, Registration) and not has_probabilities:
                result = replace(result, probabilities=())
        except CurviregError as error:
            if follow is None and options.boxes is None:
                raise  # it would fail in each frame
            result = FailedRegistration(error)
        if isinstance(result, FailedRegistration):
            result = FailedRegistration(result.error.with_image_names([name]))
        yield name, image, result, time.perf_counter() - begun


def _started(
    follow: Follower, image: Tensor, start: PoseRecord
) -> Registration | FailedRegistration:
    """The start, refined in the first frame, from which the object is followed. A tracker that
    learned a wrong pose from a frame finds it again there."""
    registrar = follow.registrar
    pose = start_in_unit(start, registrar.bank.mesh.unit)
    limit = [start.confidence]
    (found,) = refine(registrar, [image], follow.camera_matrix, [pose], start_confidences=limit)
    if isinstance(found, Registration):
        known, _ = found.projection
        confidence = found.confidence
        if confidence is None:  # pipelines without calibration
            confidence = 1.0 if start.confidence is None else start.confidence
        confidence = min(confidence, found.confidence_bound)
        if confidence >= KEPT_CONFIDENCE:
            follow.start(image, known, confidence=confidence, warnings=found.warnings)
    return found


def _box(
    options: RegisterOptions, name: str, photo: Photo, *, is_first: bool
) -> list[float] | None:
    """The given box of the first frame, or a detector's of any; a frame that has none is searched
    for the object."""
    size = _size(photo)
    if options.box is not None:
        if not is_first:
            return None
        box = list(pixel_box(options.box, options.box_format or "xyxy", size))
        check_boxes(torch.tensor([box]), [size])
        return box
    video, _, number = name.rpartition("-")
    names = [name, f"{video}_{int(number) + 1}"] if number.isdecimal() else [name]
    picture = PictureSize(size, photo.orientation)
    found = (options.detected_box(text, picture) for text in names)
    return next(map(list, filter(None, found)), None)


def _camera(options: RegisterOptions, photo: Photo) -> Camera | None:
    """The given camera without its distortion, or that of the first frame by its EXIF or the field
    of view, which frames of other sizes scale; None if it is not known."""
    without_box = replace(options, box=None, boxes=None)
    camera, _ = camera_of(entry_of(options.photos[0], without_box), photo)
    if camera is None:
        return None
    if not isinstance(options.camera, Camera):  # other cameras are those of frames of this size
        camera = camera.at(_size(photo))
    return replace(camera, distortion=(), model="radial-tangential")


def _size(photo: Photo) -> Size:
    """(H, W) of a frame."""
    return photo.image.shape[-2], photo.image.shape[-1]


def _frames(path: Path) -> tuple[Iterator[Frame], int, float]:
    """The frames of a video or a folder, their number, and frames per second."""
    if is_video(path):
        video = Video(path)
        return (
            ((f"{path.stem}-{number:06d}", Photo(image)) for number, image in video),
            video.count,
            video.fps,
        )
    photos = find_photographs(path)

    def read() -> Iterator[Frame]:
        for name in photos:
            try:
                photo = read_photo(name)
                if len(photos) == 1 and ANIMATED in photo.notes:
                    raise ImageError("an animation; save it as MP4, or its pictures in a folder")
                yield str(name), photo
            except (CurviregError, OSError) as error:
                yield str(name), ImageError(str(error))

    return read(), len(photos), FOLDER_FPS


def _live(source: str) -> tuple[Iterator[Frame], None, float]:
    """Frames of a camera or a stream: a thread reads them, and the latest one is taken, so that
    none is late."""
    file = cv2.VideoCapture(int(source) if source.isdecimal() else source)
    if not file.isOpened():
        kind = (
            "no such camera, or another program uses it"
            if source.isdecimal()
            else "the stream cannot be opened"
        )
        raise InvalidInputError(f"{kind}; check its number or address", subject=source)
    latest: Queue[tuple[int, Any]] = Queue(maxsize=1)
    ended = threading.Event()

    def read() -> None:
        for number in itertools.count():
            known, pixels = file.read()
            if not known or ended.is_set():
                return
            with suppress(Empty):
                latest.get_nowait()
            latest.put((number, pixels))

    def frames() -> Iterator[Frame]:
        reader = threading.Thread(target=read, daemon=True)
        reader.start()
        try:
            while reader.is_alive() or not latest.empty():
                with suppress(Empty):
                    number, pixels = latest.get(timeout=0.2)
                    yield f"frame-{number:06d}", Photo(frame_tensor(pixels))
        finally:
            ended.set()
            reader.join(timeout=5.0)
            file.release()

    return frames(), None, file.get(cv2.CAP_PROP_FPS)


def _camera_in_words(result: Registration | FailedRegistration) -> str:
    """A camera that is not known exactly; "" of one that is, and of a frame without a pose."""
    if isinstance(result, FailedRegistration) or result.camera is None:
        return ""
    return focal_length_in_words(result.camera.describe())


def _document(result: Registration | FailedRegistration) -> Fields:
    """A pose, or why there is none, as JSON values."""
    if isinstance(result, FailedRegistration):
        return {"verdict": result.verdict, "message": str(result.error)}
    pose = {key: getattr(result, key).tolist() for key in ("rotation", "translation", "quaternion")}
    scores = {"confidence": result.confidence, "edge_support": result.edge_support}
    return {"verdict": result.verdict, **pose, **scores}


def _cells(pose: Fields) -> list[Any]:
    """The row of a frame in ``results.csv``."""
    numbers = [""] * 12
    if "rotation" in pose:
        numbers = [*itertools.chain(*pose["rotation"]), *pose["translation"]]
    return [pose["frame"], pose["verdict"], *numbers, *(pose.get(name, "") for name in SCORES)]

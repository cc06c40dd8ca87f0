"""``curvireg follow FRAMES MESH``."""

import argparse
from pathlib import Path
from typing import Any

from ..errors import MissingFileError
from ..utils.choices import check_given
from .libraries import load_libraries
from .options import BOXES, PHOTOGRAPH, add_command, add_limits, add_options, add_path


def add_follow(commands: Any) -> None:
    parser = add_command(
        commands,
        "follow",
        "curvireg follow shots/ part.stl --unit mm --camera 1450 1450 960 540 --out out/follow",
        "curvireg follow turn.mp4 part.stl --camera cam.yaml --box 410 220 890 700 --out "
        "out/follow",
        "curvireg follow 0 part.stl --unit mm --camera cam.yaml --json",
        help="follow an object through a video, or live",
        description="Registers the first frame and tracks the object from frame to frame. Writes\n"
        "DIR/results.csv: photo, verdict (reliable, reliable axis, unsure, no match, lost, "
        "failed),\nrotation row by row, "
        "translation in the mesh's unit, confidence, edge support, and why there is no pose;\n"
        "DIR/overlay.mp4: contours of the pose and confidence on each frame.\n"
        "Ctrl-C ends it; the poses so far are kept.",
        run=run,
    )
    frames = (
        "a video; a folder of frames in the order of their names; the number of a camera, such as "
        "0; or a stream, "
    )
    parser.add_argument(
        "frames", metavar="FRAMES", help=frames + "rtsp://... Live frames are dropped, not delayed"
    )
    add_path(parser, "mesh", "MESH", help="a mesh or a bank")
    options = [name for name in PHOTOGRAPH if name != "mask"]
    add_options(
        parser,
        *options,
        *BOXES,
        "start",
        "start_convention",
        "field",
        box="in px in the first frame; default: the object is detected",
        boxes="boxes of a detector for frames that are registered, such as the first: as in "
        "register; of a video's frame 7, VIDEO-000007.txt, or VIDEO_8.txt as YOLO has it",
    )
    add_limits(parser)
    parser.add_argument(
        "--json", action="store_true", help="print each pose as a line of JSON; --out is optional"
    )
    parser.add_argument(
        "--show", action="store_true", help="open a page with the latest frame; --out is optional"
    )
    add_path(parser, "--out", "DIR", help="folder of the results")


def run(arguments: argparse.Namespace) -> None:
    """Follow the object; write its poses, and draw them."""
    source = arguments.frames
    # a folder may be called 000001, as a scene of BOP
    live = not Path(source).exists() and (source.isdecimal() or "://" in source)
    packages = ["nicegui"] if arguments.show else []
    if not live and not Path(source).exists():
        raise MissingFileError(
            "no such folder or video; or give the number of a camera, or rtsp://...", subject=source
        )
    check_given([] if live else [Path(source)], [arguments.mesh], packages=packages)
    load_libraries()
    from .following import follow

    follow(arguments, live=live)

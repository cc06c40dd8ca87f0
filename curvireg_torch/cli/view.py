"""``curvireg view [PHOTO] [MESH]``."""

import argparse
from pathlib import Path
from typing import Any

from ..errors import MissingDependencyError
from ..utils.choices import check_given
from .options import (
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

LOCAL = "127.0.0.1"


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "view",
        parents=[common_options(), pipeline_options(), mesh_options()],
        help="register in the browser: draw the box, inspect the result, correct it",
        description="Opens a page on this machine; needs pip install 'curvireg_torch[viewer]'.",
        **examples("curvireg view", "curvireg view photo.jpg part.stl --unit mm"),
    )
    parser.add_argument("photo", type=Path, nargs="?", metavar="PHOTO")
    parser.add_argument("mesh", type=Path, nargs="?", metavar="MESH", help="a mesh or a bank; both can be added later")
    add_box_and_camera(parser, box="in px; can be drawn")
    add_pose_prior(parser)
    hosts = f"who may connect: {LOCAL}, only this machine (default), or 0.0.0.0, everyone"
    parser.add_argument("--host", default=LOCAL, help=hosts)
    parser.add_argument("--port", type=whole_number(0, 65535), default=0, help="default: a free one")
    parser.add_argument("--no-browser", dest="browser", action="store_false", help="only print the address")
    add_mesh_is(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Serve the page until Ctrl-C."""
    photos, meshes = ([path] if path else [] for path in (arguments.photo, arguments.mesh))
    check_given(photos, meshes)
    try:
        import matplotlib  # noqa: F401
        import nicegui  # noqa: F401
    except ImportError as error:
        message = f"curvireg view: {error.name} is not installed; pip install 'curvireg_torch[viewer]'"
        raise MissingDependencyError(message) from error
    from ..evaluation.opening import check_camera
    from ..utils.threads import one_torch_thread
    from ..viewer.server import serve

    options = register_options(arguments, photos, meshes)
    check_camera(options.camera, options.guess)
    with one_torch_thread():
        serve(options, host=arguments.host, port=arguments.port, browser=arguments.browser)

"""``curvireg view [PHOTO] [MESH]``."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..errors import MissingDependencyError
from .examples import examples

__all__ = ["add_parser", "run"]

LOCAL = "127.0.0.1"


def add_parser(commands: Any, parents: Sequence[argparse.ArgumentParser]) -> None:
    """Add ``view`` to the subparsers ``commands``; parsed arguments get ``run``, to be called with them.

    Args:
        commands: what ``ArgumentParser.add_subparsers`` returned.
        parents: parsers with the options of ``register`` that say how to register.
    """
    parser = commands.add_parser(
        "view",
        parents=parents,
        help="register in the browser: draw the box, look at the answer, correct it",
        description="Opens a page on this machine; needs pip install 'curvireg_torch[viewer]'.",
        **examples("curvireg view", "curvireg view photo.jpg part.stl --unit mm"),
    )
    parser.add_argument("photo", type=Path, nargs="?", metavar="PHOTO")
    parser.add_argument("mesh", type=Path, nargs="?", metavar="MESH", help="a mesh or a bank; both can come later")
    parser.add_argument("--box", type=float, nargs=4, metavar=("X0", "Y0", "X1", "Y1"), help="px; can be drawn")
    parser.add_argument("--camera", type=float, nargs=4, metavar=("FX", "FY", "CX", "CY"), help="px")
    parser.add_argument("--fov", type=float, metavar="DEG", help="degrees that the picture shows across its width")
    parser.add_argument(
        "--host", default=LOCAL, help=f"who may connect: {LOCAL}, this machine alone (default), or 0.0.0.0, all"
    )
    parser.add_argument("--port", type=int, default=0, help="default: one that is free")
    parser.add_argument("--no-browser", action="store_true", help="print the address and open nothing")
    parser.set_defaults(run=run, top=None, no_refine=False)


def run(arguments: argparse.Namespace) -> None:
    """Serve the page until Ctrl-C.

    Raises:
        MissingDependencyError: NiceGUI or matplotlib is not installed.
        CurviregError: a photograph or a mesh was named that cannot be used.
    """
    try:
        import matplotlib  # noqa: F401
        import nicegui  # noqa: F401
    except ImportError as error:
        raise MissingDependencyError(
            f"curvireg view: {error.name} is not installed; pip install 'curvireg_torch[viewer]'"
        ) from error
    from ..viewer.server import serve

    serve(arguments)

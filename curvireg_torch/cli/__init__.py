"""``curvireg``: register a photograph, build a bank, evaluate a dataset, run the demo."""

import argparse
import os
import re
import sys
import warnings
from collections.abc import Callable, Sequence
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any

from ..errors import CurviregError
from ..utils.choices import DEFAULT, PRESET_NAMES, RENDERER_NAMES, UNITS, UP_AXES
from ..utils.files import terminable
from ..utils.input_paths import check_given
from ..version import __version__
from .completion import SHELLS, script
from .evaluate import add_parser as add_evaluate
from .examples import examples
from .plot import add_parser as add_plot
from .view import add_parser as add_view

__all__ = ["main"]

_NUMBERS = {"--box": 4, "--camera": 4, "--distance": 2}
_NUMBER = r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?"


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code: 0, 2 for input that cannot be used, 141 where a pipe has lost its reader."""
    try:
        try:
            return _main(argv)
        finally:
            print(end="", flush=True)  # while it can still be told that nobody reads it
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what is printed but not written
        return 128 + 13  # what a shell calls the end of its own tools by SIGPIPE


def _main(argv: Sequence[str] | None) -> int:
    arguments = _parsed(argv)
    with warnings.catch_warnings(), terminable():
        if not arguments.debug:
            warnings.showwarning = _show_warning
        try:
            check_given(*_named(arguments))
            arguments.run(arguments)
        except CurviregError as error:
            if arguments.debug:
                raise
            print(f"curvireg: error: {error}", file=sys.stderr)
            return 2
        except OSError as error:
            if arguments.debug or isinstance(error, BrokenPipeError):
                raise
            print(f"curvireg: error: {error}; check that it is there and may be read", file=sys.stderr)
            return 2
        except KeyboardInterrupt:
            print("curvireg: interrupted", file=sys.stderr)
            return 130
    return 0


def _show_warning(message: Any, *_: Any, **__: Any) -> None:
    print(f"curvireg: warning: {message}", file=sys.stderr)


def _parsed(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = _parser()
    words = _spelled(sys.argv[1:] if argv is None else argv)
    arguments, rest = parser.parse_known_args(words)
    if hasattr(arguments, "paths") and not any(word.startswith("-") for word in rest):
        arguments.paths += [Path(word) for word in rest]  # those behind an option
    elif rest:
        parser.error(f"unrecognized arguments: {' '.join(rest)}")
    if getattr(arguments, "unit", "m") is None:
        of_bop = getattr(arguments, "list", None) is not None and arguments.list.is_dir()
        arguments.unit = "mm" if of_bop else "m"
    if hasattr(arguments, "paths"):
        photos = [] if arguments.list else arguments.paths if arguments.mesh else arguments.paths[:-1]
        arguments.photos, arguments.meshes = photos, [*arguments.paths[len(photos) :], *arguments.mesh]
        if problem := _misused(arguments):
            parser.error(f"register: {problem}")
    return arguments


def _spelled(words: Sequence[str]) -> list[str]:
    """One word for each number: those of --box, --camera and --distance may be divided by commas, too."""
    spelled: list[str] = []
    expected = 0
    for word in words:
        option, equals, value = word.partition("=")
        if option in _NUMBERS:
            expected, word = _NUMBERS[option], value
            spelled.append(option)
            if not equals:
                continue
        parts = re.split(r"[,\s]+", word.strip(", "))
        numbers = len(parts) <= expected and all(re.fullmatch(_NUMBER, part) for part in parts)
        expected = expected - len(parts) if numbers else 0
        spelled += parts if numbers else [word]
    if ("--camera", "exif") in pairwise(spelled):
        place = spelled.index("--camera")
        spelled[place : place + 2] = ["--exif"]
    return spelled


def _named(arguments: argparse.Namespace) -> tuple[Sequence[Path], Sequence[Path], Path | None]:
    """Photographs, meshes and the list that a command names."""
    if hasattr(arguments, "photos"):
        return arguments.photos, arguments.meshes, arguments.list
    photo, mesh = (getattr(arguments, name, None) for name in ("photo", "mesh"))
    return [photo] if photo else [], [mesh] if mesh else [], None


def _misused(arguments: argparse.Namespace) -> str | None:
    """What is wrong with the words given to ``register``."""
    if arguments.list is None and not (arguments.photos and arguments.meshes):
        return "expected PHOTO MESH, PHOTO ... --mesh MESH, or --list FILE MESH"
    if arguments.out is None and not arguments.json:
        return "expected --out DIR, or --json"
    if arguments.list is not None and len(arguments.paths) > 1:
        return f"with --list, expected at most one MESH, got {len(arguments.paths)}; give several by --mesh"
    if sum(map(bool, (arguments.camera, arguments.exif, arguments.fov))) > 1:
        return "expected one of --camera FX FY CX CY, --camera exif, --fov DEG"
    if arguments.box and (arguments.instances != 1 or arguments.distance):
        return "--instances and --distance are for objects that are looked for; leave --box out"
    if arguments.list is not None and (arguments.box or arguments.camera):
        return "the list holds boxes and cameras; leave --box and --camera out"
    return None


def _parser() -> argparse.ArgumentParser:
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--debug", action="store_true", help="show tracebacks")
    common.add_argument("--quiet", action="store_true", help="no progress bars")
    common.add_argument("--renderer", choices=RENDERER_NAMES, default="auto", help="default: auto")
    parser = argparse.ArgumentParser(prog="curvireg", description="Pose of a known 3D object from one photograph.")
    parser.add_argument("--version", action="version", version=f"curvireg_torch {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    preset = argparse.ArgumentParser(add_help=False)
    preset.add_argument(
        "--preset", choices=sorted(PRESET_NAMES), help=f"default: that of a bank that is given, else {DEFAULT}"
    )
    preset.add_argument("--pipeline", type=Path, metavar="FILE", help="JSON of a pipeline, instead of --preset")
    preset.add_argument("--device", default="cpu", help="where modules, bank and search live (default: cpu)")

    mesh_options = argparse.ArgumentParser(add_help=False)
    mesh_options.add_argument(
        "--unit", choices=sorted(UNITS), help="the mesh file's unit (default: m; of a BOP scene mm)"
    )
    mesh_options.add_argument(
        "--pose",
        choices=("any", "upright"),
        help="any: no assumption. upright: the mesh's up axis points up in the photograph and the object is seen "
        "from 10 degrees below to 60 above; faster, and right more often where it is true (default: any)",
    )

    mesh_options.add_argument(
        "--up", choices=UP_AXES, help="the mesh file's axis that points up, as --up=-y; default: y for glTF, else z"
    )

    register = commands.add_parser(
        "register", parents=[common, preset, mesh_options], help="find the pose of MESH in PHOTO",
        usage="curvireg register PHOTO... MESH --out DIR [options]\n       "
        "curvireg register --list LIST [MESH] --out DIR [options]",
        **examples(
            "curvireg register photo.jpg part.stl --unit mm --box 410 220 890 700 --out out/part",
            "curvireg register photo.jpg part.stl --camera 1450 1450 960 540 --json",
            "curvireg register photo.jpg part.stl --camera exif --out out/part",
            "curvireg register shelf.jpg part.stl --instances 4 --out out/shelf",
            "curvireg register --list photos.csv part.stl --out out/parts",
            "curvireg register shots/ turn.mp4 part.stl --every 10 --out out/shots",
            "curvireg register photo.jpg --mesh mug.obj --mesh bowl.obj --out out/which",
        ),
        description="One photograph: writes DIR/result.json, DIR/overlay.png and DIR/pose.glb. Several, or a list: "
        "DIR/results.csv, DIR/results.jsonl and DIR/index.html; killed and run again, it goes on where it was.",
    )  # fmt: skip
    register.add_argument(
        "paths",
        type=Path,
        nargs="*",
        metavar="PHOTO... MESH",
        help="photographs, folders of them, patterns ('shots/*.jpg') or videos; last a mesh (.obj .ply .stl .off .glb; "
        "textures and colours of .glb .obj .ply are compared too, a mesh without is seen in grey) or a bank",
    )
    register.add_argument(
        "--mesh", type=Path, action="append", default=[], metavar="MESH", help="several times: which of these is it?"
    )
    register.add_argument(
        "--list",
        type=Path,
        metavar="LIST",
        help="CSV with columns photo,x0,y0,x1,y1 and, if wanted, fx,fy,cx,cy,mesh; paths count from the list's folder, "
        "empty cells mean that the object is looked for, no camera, MESH. Or JSON of the like, COCO annotations, the "
        "folder of a BOP scene",
    )
    register.add_argument("--every", type=int, default=1, metavar="N", help="of a video, every N-th frame (default: 1)")
    register.add_argument(
        "--box", type=float, nargs=4, metavar=("X0", "Y0", "X1", "Y1"), help="px; default: the object is looked for"
    )
    register.add_argument(
        "--instances", type=int, default=1, metavar="N", help="without a box: up to N objects (default: 1)"
    )
    register.add_argument(
        "--distance",
        type=float,
        nargs=2,
        metavar=("MIN", "MAX"),
        help="without a box: how near and far the object's centre may be, in the mesh's unit; needs --camera",
    )
    register.add_argument(
        "--camera", type=float, nargs=4, metavar=("FX", "FY", "CX", "CY"), help="px; gives the translation. "
        "Where it is not known, guess it and get no covariance: --camera exif, by the focal length in the photograph's "
        "file, or --fov"
    )  # fmt: skip
    register.add_argument("--exif", action="store_true", help=argparse.SUPPRESS)
    register.add_argument("--fov", type=float, metavar="DEG", help="degrees that the picture shows across its width")
    register.add_argument("--field", type=Path, metavar="FILE", help="weights from curvireg bank --adapt")
    register.add_argument("--top", type=int, metavar="K", help="hypotheses to carry and report (default: 5)")
    register.add_argument("--no-refine", action="store_true", help="stop at the best view of the bank")
    register.add_argument("--json", action="store_true", help="print the documents and nothing else; --out is optional")
    register.add_argument("--out", type=Path, metavar="DIR")
    register.set_defaults(run=_later("register"))

    bank = commands.add_parser(
        "bank", parents=[common, preset, mesh_options], help="render and describe the views of MESH",
        **examples(
            "curvireg bank part.stl --unit mm --out part.safetensors",
            "curvireg bank chair.glb --pose upright --out chair.safetensors --adapt chair_field.safetensors",
        ),
    )  # fmt: skip
    bank.add_argument("mesh", type=Path, metavar="MESH")
    bank.add_argument("--out", type=Path, required=True, metavar="FILE")
    bank.add_argument(
        "--adapt",
        type=Path,
        metavar="FILE",
        help="also fine-tune the learned field on generated photographs of MESH (minutes) and write its weights to "
        "FILE, for register --field",
    )
    bank.set_defaults(run=_later("bank"))

    cache = commands.add_parser(
        "cache", parents=[common], help="list or clear the banks that were kept on disk",
        **examples("curvireg cache", "curvireg cache --clear"),
    )  # fmt: skip
    cache.add_argument("--clear", action="store_true", help="remove them all")
    cache.set_defaults(run=_later("cache"))

    add_evaluate(commands, [common])
    add_view(commands, [common, preset, mesh_options])
    add_plot(commands, common, [preset, mesh_options])

    demo = commands.add_parser(
        "demo", parents=[common, preset], help="register a scene made in code, where the truth is known",
        **examples("curvireg demo --out out/demo", "curvireg demo --seed 7 --preset fast --out out/demo"),
    )  # fmt: skip
    demo.add_argument("--seed", type=int, default=0)
    demo.add_argument("--out", type=Path, required=True, metavar="DIR")
    demo.set_defaults(run=_later("demo"), pose="upright")

    schema = commands.add_parser(
        "schema", help="print the JSON schema of results",
        **examples("curvireg schema", "curvireg schema > result.schema.json"),
    )  # fmt: skip
    schema.add_argument("--debug", action="store_true", help="show tracebacks")
    schema.set_defaults(run=_print_schema)

    completion = commands.add_parser(
        "completion", help="print a script that completes this command line",
        **examples("curvireg completion bash > ~/.local/share/bash-completion/completions/curvireg",
                   "curvireg completion zsh >> ~/.zshrc",
                   "curvireg completion fish > ~/.config/fish/completions/curvireg.fish"),
    )  # fmt: skip
    completion.add_argument("shell", choices=SHELLS)
    completion.add_argument("--debug", action="store_true", help="show tracebacks")
    completion.set_defaults(run=lambda arguments: print(script(parser, arguments.shell), end=""))
    return parser


def _print_schema(_: argparse.Namespace) -> None:
    print(Path(__file__).parents[1].joinpath("registration", "result.schema.json").read_text(encoding="utf-8"), end="")


def _later(name: str) -> Callable[[argparse.Namespace], None]:
    """The command of that name; what it needs is imported when it runs: help and mistyped options answer at once."""

    def run(arguments: argparse.Namespace) -> None:
        getattr(import_module(".commands", __package__), name)(arguments)

    return run


if __name__ == "__main__":
    sys.exit(main())

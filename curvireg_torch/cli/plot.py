"""``curvireg plot KIND``: the pictures of :mod:`curvireg_torch.visualization.plots` from files."""

import argparse
import csv
from collections.abc import Callable, Sequence
from io import BytesIO, StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InvalidInputError, MissingFileError
from ..utils.files import write_file
from .examples import examples

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["add_parser", "run"]

REGISTERED = {
    "sphere": "score over the directions of view, and the hypotheses",
    "fields": "the photograph and its field, the pose and its field",
}
EVALUATED = {
    "confusion": "azimuth bins, true against estimated",
    "reliability": "share of right answers over confidence",
    "risk": "share of wrong answers over the share that is kept, by confidence",
    "classes": "every error, class by class",
    "sheet": "a page of the best and the worst photographs, with the contours that were found",
}
TABLES = {
    "curves": "columns of a table over its first one",
    "bars": "a group of bars for each row of a table",
}
FORMATS = (".png", ".svg", ".pdf")
PAGES = (".html",)


def add_parser(commands: Any, common: argparse.ArgumentParser, parents: Sequence[argparse.ArgumentParser]) -> None:
    """Add ``plot`` to the subparsers ``commands``; parsed arguments get ``run``, to be called with them.

    Args:
        commands: what ``ArgumentParser.add_subparsers`` returned.
        common: parser of the options of every command.
        parents: parsers with the options of ``register`` that say how to register.
    """
    plot = commands.add_parser(
        "plot",
        help="draw a picture of a registration or an evaluation",
        **examples(
            "curvireg plot sphere photo.jpg part.stl --unit mm --box 410 220 890 700 --out sphere.png",
            "curvireg plot confusion results/pascal3d --out confusion.png",
            "curvireg plot sheet results/pascal3d --out sheet.html",
            "curvireg plot curves results/paper/ranks.csv --out ranks.svg",
        ),
    )
    kinds = plot.add_subparsers(required=True, metavar="KIND")
    for kind, told in {**REGISTERED, **EVALUATED, **TABLES}.items():
        source = "photo.jpg part.stl" if kind in REGISTERED else "table.csv" if kind in TABLES else "results/pascal3d"
        formats = _formats(kind)
        parser = kinds.add_parser(
            kind,
            parents=[common, *parents] if kind in REGISTERED else [common],
            help=told,
            **examples(f"curvireg plot {kind} {source} --out {kind}{formats[0]}"),
        )
        if kind in REGISTERED:
            parser.add_argument("photo", type=Path, metavar="PHOTO")
            parser.add_argument("mesh", type=Path, metavar="MESH", help="a mesh or a bank")
            parser.add_argument("--box", type=float, nargs=4, metavar=("X0", "Y0", "X1", "Y1"), help="px")
            parser.add_argument("--camera", type=float, nargs=4, metavar=("FX", "FY", "CX", "CY"), help="px")
        elif kind in EVALUATED:
            sets = "pascal3d, bop or web" if kind == "sheet" else "pascal3d or web"
            parser.add_argument("source", type=Path, metavar="DIR", help=f"of curvireg evaluate {sets}")
        else:
            parser.add_argument("source", type=Path, metavar="FILE.csv")
        if kind == "confusion":
            parser.add_argument(
                "--bins", type=int, default=8, choices=(4, 8, 16, 24), help="of the circle (default: 8)"
            )
        elif kind in EVALUATED:
            parser.add_argument("--within", type=float, default=30.0, metavar="DEG", help="that is right (default: 30)")
        if kind == "sheet":
            parser.add_argument(
                "--each", type=int, default=30, metavar="N", help="of the best, and of the worst (default: 30)"
            )
        parser.add_argument("--out", type=Path, required=True, metavar="FILE", help=", ".join(formats))
        parser.set_defaults(run=run, kind=kind, top=None, no_refine=False)


def run(arguments: argparse.Namespace) -> None:
    """Draw what ``curvireg plot`` was asked for.

    Raises:
        CurviregError: a file is missing or not what it should be, or matplotlib is not installed.
    """
    formats = _formats(arguments.kind)
    if arguments.out.suffix.lower() not in formats:
        raise InvalidInputError(f"--out {arguments.out}: expected a name that ends in {', '.join(formats)}")
    if arguments.kind == "sheet":
        from ..evaluation import contact_sheet

        n = contact_sheet(arguments.source, arguments.out, each=arguments.each, within_deg=arguments.within)
        print(f"{arguments.out}: {n} objects")
        return
    figure = _of_registration(arguments) if arguments.kind in REGISTERED else _of_table(arguments)
    content = BytesIO()
    figure.savefig(content, format=arguments.out.suffix[1:].lower(), dpi=150)
    write_file(arguments.out, content.getvalue())
    print(arguments.out)


def _formats(kind: str) -> tuple[str, ...]:
    return PAGES if kind == "sheet" else FORMATS


def _of_registration(arguments: argparse.Namespace) -> Any:
    from ..viewer.session import Session
    from ..visualization import plots

    session = Session(arguments)
    session.take_photo(arguments.photo)
    session.take_mesh(arguments.mesh)
    session.box, session.camera = arguments.box, arguments.camera
    session.register()
    answer, _ = session.seen()
    if arguments.kind == "sphere":
        return plots.view_sphere(answer.registrar.bank, answer.result)
    return plots.fields(answer.registrar, answer.result, answer.image, answer.box)


def _of_table(arguments: argparse.Namespace) -> Any:
    from ..visualization import plots

    if arguments.kind in TABLES:
        columns, rows = _table(arguments.source)
        first: Callable[[str], str | float] = str if arguments.kind == "bars" else _number_of(arguments.source)
        number = _number_of(arguments.source)
        return getattr(plots, arguments.kind)(columns, [[first(row[0]), *map(number, row[1:])] for row in rows])
    path = arguments.source / "predictions.csv"
    columns, rows = _table(path)
    number = _number_of(path)

    def column(name: str) -> list[str]:
        if name not in columns:
            raise InvalidInputError(f"{path}: no column {name!r}; expected a table of evaluate pascal3d or web")
        return [row[columns.index(name)] for row in rows]

    def numbers(name: str) -> "Tensor":
        import torch

        return torch.tensor([number(cell or "nan") for cell in column(name)], dtype=torch.float64)

    if arguments.kind == "confusion":
        return plots.azimuth_confusion(numbers("azimuth"), numbers("true_azimuth"), bins=arguments.bins)
    errors = numbers("error_deg")
    if arguments.kind == "classes":
        return plots.errors_by_class(column("category"), errors, threshold_deg=arguments.within)
    confidence = numbers("confidence").nan_to_num()  # no answer: none at all
    drawn: Callable[..., Any] = plots.reliability if arguments.kind == "reliability" else plots.risk_coverage
    return drawn(confidence, errors < arguments.within)


def _table(path: Path) -> tuple[list[str], list[list[str]]]:
    from ..io.json_files import check_table_size

    if not path.is_file():
        raise MissingFileError(f"{path}: no such table; curvireg evaluate writes predictions.csv")
    check_table_size(path)
    try:
        columns, *rows = csv.reader(StringIO(path.read_text(encoding="utf-8")))
    except (ValueError, csv.Error) as error:
        raise InvalidInputError(f"{path}: not a table of comma-separated values ({error})") from error
    if not rows or any(len(row) != len(columns) for row in rows):
        raise InvalidInputError(f"{path}: expected a header and rows as long as it")
    return columns, rows


def _number_of(path: Path) -> Callable[[str], float]:
    """Reads a cell of that table."""

    def number(cell: str) -> float:
        try:
            return float(cell)
        except ValueError as error:
            raise InvalidInputError(f"{path}: expected a number, got {cell[:40]!r}") from error

    return number

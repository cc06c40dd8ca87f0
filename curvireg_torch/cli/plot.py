"""``curvireg plot KIND``: figures of :mod:`curvireg_torch.visualization.plots` from files."""

import argparse
import csv
from collections.abc import Callable
from io import BytesIO, StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InvalidInputError, MissingFileError
from ..utils.files import check_writable, write_file
from ..utils.input_paths import check_given
from .options import add_box_and_camera, common_options, examples, mesh_options, pipeline_options, register_options

if TYPE_CHECKING:
    from ..evaluation.opening import RegisterOptions

REGISTERED = {
    "sphere": "score over the viewing directions, and the hypotheses",
    "fields": "the photograph and its field, the pose and its field",
}
EVALUATED = {
    "confusion": "azimuth bins, true against estimated",
    "reliability": "fraction of right results over confidence",
    "risk": "fraction of wrong results over the fraction of results kept, by confidence",
    "classes": "every error, class by class",
    "sheet": "a page of the best and the worst photographs, with the contours at the estimated poses",
}
TABLES = {"curves": "columns of a table over its first one", "bars": "a group of bars for each row of a table"}
FORMATS = (".png", ".svg", ".pdf")


def add_parser(commands: Any) -> None:
    plot = commands.add_parser(
        "plot",
        help="draw a figure of a registration or an evaluation",
        **examples(
            "curvireg plot sphere photo.jpg part.stl --unit mm --box 410 220 890 700 --out sphere.png",
            "curvireg plot confusion results/pascal3d --out confusion.png",
            "curvireg plot sheet results/pascal3d --out sheet.html",
            "curvireg plot curves results/paper/ranks.csv --out ranks.svg",
        ),
    )
    kinds = plot.add_subparsers(required=True, metavar="KIND")
    for kind, text in REGISTERED.items():
        parser = _add_kind(kinds, kind, text, "photo.jpg part.stl", pipeline_options(), mesh_options())
        parser.add_argument("photo", type=Path, metavar="PHOTO")
        parser.add_argument("mesh", type=Path, metavar="MESH", help="a mesh or a bank")
        add_box_and_camera(parser, fov=False)
    for kind, text in EVALUATED.items():
        parser = _add_kind(kinds, kind, text, "results/pascal3d")
        sets = "pascal3d, bop or web" if kind == "sheet" else "pascal3d or web"
        parser.add_argument("source", type=Path, metavar="DIR", help=f"of curvireg evaluate {sets}")
        if kind == "confusion":
            parser.add_argument("--bins", type=int, default=8, choices=(4, 8, 16, 24), help="number (default: 8)")
        else:
            largest = "largest right error (default: 30)"
            parser.add_argument("--within", type=float, default=30.0, metavar="DEG", help=largest)
        if kind == "sheet":
            parser.add_argument("--each", type=int, default=30, metavar="N", help="best and worst (default: 30)")
    for kind, text in TABLES.items():
        parser = _add_kind(kinds, kind, text, "table.csv")
        parser.add_argument("source", type=Path, metavar="FILE.csv")


def _add_kind(kinds: Any, kind: str, text: str, source: str, *parents: argparse.ArgumentParser) -> Any:
    formats = _formats(kind)
    example = examples(f"curvireg plot {kind} {source} --out {kind}{formats[0]}")
    parser = kinds.add_parser(kind, parents=[common_options(), *parents], help=text, **example)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help=", ".join(formats))
    parser.set_defaults(run=run, kind=kind)
    return parser


def run(arguments: argparse.Namespace) -> None:
    """Draw one figure."""
    kind, out, formats = arguments.kind, arguments.out, _formats(arguments.kind)
    if kind in REGISTERED:
        check_given([arguments.photo], [arguments.mesh])
    if out.suffix.lower() not in formats:
        raise InvalidInputError(f"--out {out}: expected a name that ends in {', '.join(formats)}")
    check_writable(out.parent, "--out")
    if kind == "sheet":
        from ..evaluation import contact_sheet

        n = contact_sheet(arguments.source, out, each=arguments.each, within_deg=arguments.within)
        print(f"{out}: {n} objects")
        return
    if kind in REGISTERED:
        figure = _registration_figure(kind, register_options(arguments, [arguments.photo], [arguments.mesh]))
    elif kind in TABLES:
        figure = _table_figure(kind, _Table(arguments.source))
    else:
        figure = _evaluation_figure(kind, _Table(arguments.source / "predictions.csv"), arguments)
    content = BytesIO()
    figure.savefig(content, format=out.suffix[1:].lower(), dpi=150)
    write_file(out, content.getvalue())
    print(out)


def _formats(kind: str) -> tuple[str, ...]:
    return (".html",) if kind == "sheet" else FORMATS


def _registration_figure(kind: str, options: "RegisterOptions") -> Any:
    import torch

    from ..data import read_photo
    from ..evaluation.lists import register_entry
    from ..evaluation.opening import check_camera, open_registrar
    from ..registration.result import used_box
    from ..utils.threads import one_torch_thread
    from ..visualization import plots

    check_camera(options.camera, options.guess)
    photo = read_photo(options.photos[0], dtype=torch.uint8)
    with one_torch_thread():
        registrar = open_registrar(options, options.meshes)
        result, document = register_entry(options.entry(options.photos[0]), photo, registrar, bank_seconds=0.0)
    if kind == "sphere":
        return plots.view_sphere(registrar.bank, result)
    return plots.fields(registrar, result, photo.image, torch.tensor(used_box(document)))


def _table_figure(kind: str, table: "_Table") -> Any:
    from ..visualization import plots

    first: Callable[[str], str | float] = str if kind == "bars" else table.number
    rows = [[first(row[0]), *map(table.number, row[1:])] for row in table.rows]
    return getattr(plots, kind)(table.columns, rows)


def _evaluation_figure(kind: str, table: "_Table", arguments: argparse.Namespace) -> Any:
    from ..visualization import plots

    if kind == "confusion":
        return plots.azimuth_confusion(table.numbers("azimuth"), table.numbers("true_azimuth"), bins=arguments.bins)
    errors = table.numbers("error_deg")
    if kind == "classes":
        return plots.errors_by_class(table.column("category"), errors, threshold_deg=arguments.within)
    confidence = table.numbers("confidence").nan_to_num()  # a failed object has no confidence
    plot = plots.reliability if kind == "reliability" else plots.risk_coverage
    return plot(confidence, errors < arguments.within)


class _Table:
    """A CSV file with a header."""

    def __init__(self, path: Path) -> None:
        from ..utils.files import check_table_size

        if not path.is_file():
            raise MissingFileError(f"{path}: no such table; curvireg evaluate writes predictions.csv")
        check_table_size(path)
        self.path = path
        try:
            self.columns, *self.rows = list(csv.reader(StringIO(path.read_text(encoding="utf-8")))) or [[]]
        except (ValueError, csv.Error) as error:
            message = f"{path}: not a table of comma-separated values in UTF-8 ({error}); give a .csv file"
            raise InvalidInputError(message) from error
        if not self.rows or any(len(row) != len(self.columns) for row in self.rows):
            raise InvalidInputError(f"{path}: expected a header, and rows of as many cells")

    def column(self, name: str) -> list[str]:
        if name not in self.columns:
            raise InvalidInputError(f"{self.path}: no column {name!r}; expected a table of evaluate pascal3d or web")
        return [row[self.columns.index(name)] for row in self.rows]

    def numbers(self, name: str) -> Any:
        """A column as a (N,) float64 tensor; NaN for empty cells."""
        import torch

        return torch.tensor([self.number(cell or "nan") for cell in self.column(name)], dtype=torch.float64)

    def number(self, cell: str) -> float:
        try:
            return float(cell)
        except ValueError as error:
            raise InvalidInputError(f"{self.path}: expected a number, got {cell[:40]!r}") from error

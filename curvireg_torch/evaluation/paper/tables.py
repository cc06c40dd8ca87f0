"""Tables as CSV, Markdown and figures."""

import io
import math
from dataclasses import dataclass
from pathlib import Path

from ...errors import MissingDependencyError
from ...utils.files import write_csv, write_file
from ...visualization import plots

__all__ = ["Table", "write_table"]

Cell = str | float


@dataclass(frozen=True)
class Table:
    """Rows of numbers with their definition.

    Attributes:
        name: of the files.
        title, definition: what was measured, on what.
        columns: the first names the rows.
        rows: as long as ``columns``.
        curve: the other columns are curves over the first, which is numeric.
    """

    name: str
    title: str
    definition: str
    columns: list[str]
    rows: list[list[Cell]]
    curve: bool = False

    def markdown(self) -> str:
        """Title, definition and table, three digits."""
        lines = [self.columns, *([_short(v) for v in row] for row in self.rows)]
        head, *body = ("| " + " | ".join(line) + " |\n" for line in lines)
        return f"## {self.title}\n\n{self.definition}\n\n{head}|{'---|' * len(self.columns)}\n{''.join(body)}"


def write_table(table: Table, folder: Path) -> list[Path]:
    """Write ``NAME.csv``, ``NAME.md`` and, where matplotlib is installed, ``NAME.png``; returns their paths."""
    paths = [folder / f"{table.name}.{suffix}" for suffix in ("csv", "md", "png")]
    write_csv(paths[0], [table.columns, *table.rows])
    write_file(paths[1], table.markdown().encode())
    try:
        figure = (plots.curves if table.curve else plots.bars)(table.columns, table.rows, title=table.title, ylabel="")
    except MissingDependencyError:
        return paths[:2]
    picture = io.BytesIO()
    figure.savefig(picture, dpi=120, format="png")
    write_file(paths[2], picture.getvalue())
    return paths


def _short(value: Cell) -> str:
    if isinstance(value, str):
        return value
    return "-" if math.isnan(value) else f"{value:.3g}"

"""Tables as CSV, Markdown and figures."""

import csv
import io
import math
from dataclasses import dataclass
from pathlib import Path

from ...errors import MissingDependencyError
from ...utils.files import write_file
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

    def csv(self) -> str:
        """Comma-separated values with a header; all digits."""
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([self.columns, *self.rows])
        return text.getvalue()

    def markdown(self) -> str:
        """Title, definition and table, three digits.

        Example:
            >>> print(Table("a", "A", "Shares.", ["class", "x"], [["car", 0.5]]).markdown())
            ## A
            <BLANKLINE>
            Shares.
            <BLANKLINE>
            | class | x |
            |---|---|
            | car | 0.5 |
            <BLANKLINE>
        """
        lines = [self.columns, ["---"] * len(self.columns), *([_short(v) for v in row] for row in self.rows)]
        body = "\n".join("| " + " | ".join(line) + " |" for line in lines)
        return f"## {self.title}\n\n{self.definition}\n\n{body.replace('| --- |', '|---|').replace(' --- |', '---|')}\n"


def write_table(table: Table, folder: Path) -> list[Path]:
    """Write ``NAME.csv``, ``NAME.md`` and, where matplotlib is installed, ``NAME.png``; returns their paths."""
    paths = [folder / f"{table.name}.{suffix}" for suffix in ("csv", "md")]
    write_file(paths[0], table.csv().encode())
    write_file(paths[1], table.markdown().encode())
    try:
        figure = (plots.curves if table.curve else plots.bars)(table.columns, table.rows, title=table.title, ylabel="")
    except MissingDependencyError:
        return paths
    picture = io.BytesIO()
    figure.savefig(picture, dpi=120, format="png")
    write_file(folder / f"{table.name}.png", picture.getvalue())
    return [*paths, folder / f"{table.name}.png"]


def _short(value: Cell) -> str:
    if isinstance(value, str):
        return value
    return "-" if math.isnan(value) else f"{value:.3g}"

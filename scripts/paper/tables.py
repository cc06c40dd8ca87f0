"""The paper's tables, made of the records of :mod:`scripts.paper.measure`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import getitem
from pathlib import Path

import numpy as np

from curvireg_torch.filters.focus import PAPER_THRESHOLD
from scripts._shared import RIGHT_DEG, Record, markdown_table, read_json
from scripts.paper import printed
from scripts.paper.measures import Estimate, bootstrap

Cell = str | Estimate
Value = Callable[[Record], float]

SHOWN = read_json(Path(__file__).with_suffix(".json"))
"""Title, definition and columns of each table."""

PHOTOS = ("MFC", "MCS", "IG")
REPEATED_DEPTHS = ("CS", "ASG", "HFN")
PAIRS = printed.PAIRS
SEARCHED_PAIRS = PAIRS[:3]
REFINED_PAIRS = PAIRS[:2]
RANKS = (1, 3, 5, 10, 20)
GRIDS = (4, 8, 16)
NAMES = {"literal": "literal", "printed": "corrected, S_hog as printed", "corrected": "corrected"}
VARIANTS = tuple(NAMES)
CLASS_DETECTORS = ("MFC", "MCS", "PCI", "SOBEL", "CANNY")
# degrees about the object's z axis: 40 views, the true one among them
CURVE_OFFSETS = tuple(range(-100, 100, 5))
SHOWN_OFFSETS = (-90, -20, -10, -5, 0, 5, 10, 20, 90)


@dataclass(frozen=True)
class Table:
    """Rows of numbers with their definition.

    Attributes:
        name: of the file.
        title, definition: what was measured, on what.
        columns: the first names the rows.
        rows: as long as ``columns``.
    """

    name: str
    title: str
    definition: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]

    def markdown(self) -> str:
        """Title, definition and table; means with their intervals."""
        table = markdown_table([self.columns, *self.rows])
        return f"### {self.title}\n\n{self.definition}\n\n{table}"


@dataclass(frozen=True)
class Records:
    """The records of photographs, with category and CAD, and ``what`` they are measured on."""

    records: Sequence[Record]
    what: str

    def mean(self, value: Value) -> Estimate:
        """Mean of the finite values of all photographs."""
        return bootstrap([value(r) for r in self.records], [r["cad"] for r in self.records])

    @property
    def categories(self) -> list[str]:
        return sorted({r["category"] for r in self.records})

    def of(self, category: str) -> "Records":
        """Those of one category."""
        return Records([r for r in self.records if r["category"] == category], self.what)

    def table(self, name: str, rows: Sequence[Sequence[Cell | Value]]) -> Table:
        """A table with the means of values, which also says on how many they were measured; short
        rows end in dashes."""
        shown = SHOWN[name]
        columns = shown["columns"]
        cads = len({r["cad"] for r in self.records})
        text = (
            f"{shown['definition']} {self.what}, N = {len(self.records)} ({cads} CADs); in "
            "brackets 95 % by bootstrap of the CADs."
        )
        cells = []
        for row in rows:
            means = [self.mean(cell) if callable(cell) else cell for cell in row]
            cells.append([*means, *["-"] * (len(columns) - len(row))])
        return Table(name, shown["title"], text, columns, cells)


def beside_the_paper(
    name: str,
    title: str,
    records: Records,
    columns: dict[str, list[Value]],
    paper: dict[str, dict[str, float]],
    parts: Sequence[str],
) -> Table:
    """One row for each class that we or the paper have. Cells hold our numbers, one for each of
    ``parts``, and the paper's."""
    rows = []
    for category in sorted({*records.categories, *paper}):
        group = records.of(category)
        cells = []
        for column, values in columns.items():
            means = [group.mean(value) for value in values]
            ours = [_printed(one.mean if one.n else None) for one in means]
            theirs = _printed(paper.get(category, {}).get(column))
            cells.append(" / ".join([*ours, theirs]))
        rows.append([category, f"{len(group.records)}", *cells])
    text = f"{' / '.join([*parts, 'the paper'])}; N photographs of ours. {records.what}."
    return Table(f"{name}_classes", title, text, ["class", "N", *columns], rows)


def at(*keys: str | int) -> Value:
    """The number of a record under these keys, one within the other."""
    return lambda record: float(reduce(getitem, keys, record))


def right_at(*keys: str | int | slice) -> Value:
    """Whether the error under these keys is small; of several errors, any."""
    return lambda record: float(np.min(reduce(getitem, keys, record)) < RIGHT_DEG)


def _printed(number: float | None, digits: int = 2) -> str:
    return "-" if number is None else f"{number:.{digits}f}"


def detector_tables(records: Records) -> list[Table]:
    """IP, Hausdorff distance and number of points of each detector, and IP by class."""
    rows = []
    for name in records.records[0]["points"]:
        row = [
            name,
            at("ip", name),
            _printed(printed.IP.get(name)),
            _printed(printed.WEB_IP.get(name)),
            at("hausdorff", name),
            _printed(printed.HAUSDORFF.get(name), 0),
            _printed(printed.WEB_HAUSDORFF.get(name), 0),
            at("points", name),
        ]
        rows.append(row)
    rows.append(["any pixel (chance)", at("ip", "chance")])
    of_class = {name: [at("ip", name)] for name in CLASS_DETECTORS}
    return [
        records.table("detectors", rows),
        beside_the_paper("ip", "IP by class", records, of_class, printed.IP_BY_CLASS, ("ours",)),
    ]


def repeatability_tables(records: Records) -> list[Table]:
    """Repeatability of each depth filter's points in each photograph filter's points."""
    rows = [
        [depth, *(at("repeatability", f"{depth}/{photo}") for photo in PHOTOS)]
        for depth in REPEATED_DEPTHS
    ]
    return [records.table("repeatability", rows)]


def curve_tables(records: Records) -> list[Table]:
    """Repeatability in some of the 40 views around the true one."""
    names = list(records.records[0]["curve"])
    rows = [
        [f"{offset}", *(at("curve", name, CURVE_OFFSETS.index(offset)) for name in names)]
        for offset in SHOWN_OFFSETS
    ]
    return [records.table("curve", rows)]


def sensitivity_tables(records: Records) -> list[Table]:
    """IP for other radii and numbers of points."""
    keys = [key.split() for key in records.records[0]["sensitivity"]]
    names = list(dict.fromkeys(name for name, _, _ in keys))
    settings = sorted({(float(share), float(eps)) for _, share, eps in keys})
    rows = []
    for share, eps in settings:
        cells = [at("sensitivity", f"{name} {share:g} {eps:g}") for name in names]
        rows.append([f"{100 * share:g} %", f"{eps:g} px", *cells])
    for threshold in records.records[0]["threshold"]:
        rows.append(["4 %", f"2 px, threshold {threshold}", at("threshold", threshold)])
    return [records.table("sensitivity", rows)]


def _right(variant: str, pair: str, rank: int) -> Value:
    return right_at(variant, pair, "top", slice(rank))


def limit_rows() -> list[list[Cell | Value]]:
    """What views drawn by lot, and the best view of the bank, would have, for each variant."""
    return [
        ["a view by lot", *(at(variant, "chance") for variant in VARIANTS)],
        ["a right view is there", *(at(variant, "ceiling") for variant in VARIANTS)],
    ]


def _by_lot(variant: str, count: int) -> Value:
    """The probability that one of ``count`` views by lot is right."""
    chance = at(variant, "chance")
    return lambda record: 1.0 - (1.0 - chance(record)) ** count


def precision_tables(records: Records) -> list[Table]:
    """Fraction of the photographs whose best view is nearly right."""

    def values(pair: str) -> list[Value]:
        return [_right(variant, pair, 1) for variant in VARIANTS]

    rows = [[pair, *values(pair), _printed(printed.PRECISION[pair])] for pair in PAIRS]
    rows += limit_rows()
    return [
        records.table("precision", rows),
        beside_the_paper(
            "precision",
            "Precision by class",
            records,
            {pair: values(pair) for pair in SEARCHED_PAIRS},
            printed.PRECISION_BY_CLASS,
            tuple(NAMES.values()),
        ),
    ]


def rank_tables(records: Records) -> list[Table]:
    """Precision at rank 1, 3, 5, 10, 20."""
    rows = []
    for variant, name in NAMES.items():
        for pair in SEARCHED_PAIRS:
            rows.append([f"{name}, {pair}", *(_right(variant, pair, k) for k in RANKS)])
        if variant != "printed":  # whose views are those of the last
            rows.append([f"{name}, views by lot", *(_by_lot(variant, k) for k in RANKS)])
            ceiling = [at(variant, "ceiling")] * len(RANKS)
            rows.append([f"{name}, a right view is there", *ceiling])
    return [records.table("ranks", rows)]


def angle_tables(records: Records) -> list[Table]:
    """Mean errors of elevation, azimuth, in-plane angle and distance."""

    rows = []

    def add(name: str, *closest: str, estimated: Sequence[str] = ()) -> None:
        """A row with the errors of the estimate, if there is one, and of the closest view."""
        row = [name]
        for k in range(4):  # elevation, azimuth, in-plane angle, distance
            row.append(at(*estimated, k) if estimated else "-")
            row.append(at(*closest, k))
        rows.append(row)

    for variant in ("literal", "corrected"):
        name = NAMES[variant]
        for pair in REFINED_PAIRS:
            add(f"{name}, {pair}", variant, pair, "clo", estimated=(variant, pair, "est"))
            if variant == "corrected":
                add(f"{name}, {pair}, of refined views", variant, pair, "refined")
                rows.append([f"{pair}, paper", *printed.POSE_ERRORS[pair]])
        add(f"{name}, bank", variant, "limit")
    return [records.table("angles", rows)]


def search_tables(records: Records) -> list[Table]:
    """What the search does, and what it would with views down the ranking."""

    def more(variant: str, pair: str) -> Value:
        return lambda record: float(record[variant][pair]["coherent"] > 1)

    rows = [
        [
            f"{name}, {pair}",
            more(variant, pair),
            _right(variant, pair, 1),
            right_at(variant, pair, "found"),
            right_at(variant, pair, "wider found"),
        ]
        for variant, name in NAMES.items()
        for pair in SEARCHED_PAIRS
    ]
    return [records.table("search", rows)]


def focus_tables(records: Records) -> list[Table]:
    """Focus curves by threshold, and protocols of precision."""

    def cells(name: str) -> list[Value]:
        return [at(name, "ip"), right_at(name, "right")]

    names = [name for name in records.records[0] if name.startswith("MFC ")]
    rows = [
        [threshold, *cells(f"MFC {threshold}"), *cells(f"MFC x CS {threshold}")]
        for threshold in sorted({name.split()[-1] for name in names})
    ]
    rows += [[name, *cells(name)] for name in ("MCS", "IG")]
    thresholds = records.table("thresholds", rows)
    shown = (f"MFC {PAPER_THRESHOLD:.4f}", f"MFC x CS {PAPER_THRESHOLD:.4f}", "MCS", "IG")
    rows = [
        [name, *(right_at(field, key) for field in shown), at("chance", key)]
        for name, key in PROTOCOLS.items()
    ]
    return [thresholds, records.table("protocols", rows)]


PROTOCOLS = {
    "best view": "right",
    "half turns about the vertical are right": "half turn",
    "azimuth known within 45°": "azimuth",
    "among the best 20": "top 20",
}


def grid_tables(records: Records) -> list[Table]:
    """Precision of CS/MFC with other grids of the descriptor."""
    rows = [
        [f"{n} x {n}", *(right_at(variant, f"grid {n}") for variant in VARIANTS)] for n in GRIDS
    ]
    rows += limit_rows()
    return [records.table("grids", rows)]

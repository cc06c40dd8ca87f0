"""The paper's tables, made of the records of :mod:`scripts.paper.measure`."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from curvireg_torch.filters.focus import PAPER_THRESHOLD
from scripts._shared import table_lines
from scripts.paper import printed
from scripts.paper.measures import Estimate, bootstrap

Cell = str | Estimate
Value = Callable[[dict[str, Any]], float]

PHOTOS = ("MFC", "MCS", "IG")
REPEATED_DEPTHS = ("CS", "ASG", "HFN")
PAIRS = printed.PAIRS
SEARCHED_PAIRS = PAIRS[:3]
REFINED_PAIRS = PAIRS[:2]
RANKS = (1, 3, 5, 10, 20)
GRIDS = (4, 8, 16)
RIGHT_DEG = 30.0
VARIANTS = ("literal", "printed", "corrected")
NAMES = {"literal": "literal", "printed": "corrected, S_hog as printed", "corrected": "corrected"}
CLASS_DETECTORS = ("MFC", "MCS", "PCI", "SOBEL", "CANNY")
# degrees about the object's z axis: 40 views, the true one among them
CURVE_OFFSETS = tuple(range(-100, 100, 5))
SHOWN_OFFSETS = (-90, -20, -10, -5, 0, 5, 10, 20, 90)
PARTS = ("elevation", "azimuth", "in-plane", "distance")
POSE_COLUMNS = tuple(f"{name} {kind}" for name in PARTS for kind in ("Est.", "Clo."))


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
        lines = table_lines([self.columns, *([str(cell) for cell in row] for row in self.rows)])
        return "\n".join([f"### {self.title}", "", self.definition, "", *lines, ""])


class Records:
    """The records of photographs, with category and CAD."""

    def __init__(self, records: Sequence[dict[str, Any]], what: str) -> None:
        self.records = records
        self.what = what

    def mean(self, value: Value) -> Estimate:
        """Mean of the finite values of all photographs."""
        return bootstrap([value(r) for r in self.records], [r["cad"] for r in self.records])

    @property
    def categories(self) -> list[str]:
        return sorted({r["category"] for r in self.records})

    def of(self, category: str) -> "Records":
        """Those of one category."""
        return Records([r for r in self.records if r["category"] == category], self.what)

    @property
    def text(self) -> str:
        """What was measured, and on how many."""
        cads = len({r["cad"] for r in self.records})
        return (
            f"{self.what}, N = {len(self.records)} ({cads} CADs); in brackets 95 % by "
            f"bootstrap "
            f"of the CADs."
        )


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
    rows: list[list[Cell]] = []
    for category in sorted({*records.categories, *paper}):
        group = records.of(category)
        cells: list[Cell] = []
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

    def value(record: dict[str, Any]) -> float:
        for key in keys:
            record = record[key]
        return number(record)  # type: ignore[arg-type]

    return value


def _printed(number: float | None, digits: int = 2) -> str:
    return "-" if number is None else f"{number:.{digits}f}"


def detector_tables(records: Records) -> list[Table]:
    """IP, Hausdorff distance and number of points of each detector, and IP by class."""
    names = list(records.records[0]["points"])
    rows: list[list[Cell]] = []
    for name in names:
        ours = [records.mean(at(kind, name)) for kind in ("ip", "hausdorff", "points")]
        ip = [_printed(means.get(name)) for means in (printed.IP, printed.WEB_IP)]
        distances = printed.HAUSDORFF, printed.WEB_HAUSDORFF
        hausdorff = [_printed(means.get(name), 0) for means in distances]
        rows.append([name, ours[0], *ip, ours[1], *hausdorff, ours[2]])
    chance = records.mean(at("ip", "chance"))
    rows.append(["any pixel (chance)", chance, *["-"] * 6])
    text = (
        "IP: fraction of the photograph's points within 2 px of a point of the curvilinear "
        "saliency (CS) of the view "
        "at the true pose. HD: Hausdorff distance of the two sets, px of the crop (paper: of "
        "unknown pictures). "
        "At most 4 % of the pixels are points. MFC x CS is the preset `classical`'s, not the "
        "paper's. The web "
        f"collection of the paper was never published. {records.text}"
    )
    columns = [
        "detector",
        "IP",
        "paper, PASCAL3D+",
        "paper, web",
        "HD",
        "paper, PASCAL3D+ ",
        "paper, web ",
        "points",
    ]
    of_class = {name: [at("ip", name)] for name in CLASS_DETECTORS}
    return [
        Table("detectors", "Detectors: IP and Hausdorff distance", text, columns, rows),
        beside_the_paper("ip", "IP by class", records, of_class, printed.IP_BY_CLASS, ("ours",)),
    ]


def repeatability_tables(records: Records) -> list[Table]:
    """Repeatability of each depth filter's points in each photograph filter's points."""
    rows = [
        [d, *(records.mean(at("repeatability", f"{d}/{p}")) for p in PHOTOS)]
        for d in REPEATED_DEPTHS
    ]
    text = (
        "Fraction of the points of the view at the true pose with a point of the photograph "
        "within 2 px (the paper "
        f"plots it for two objects). {records.text}"
    )
    return [
        Table(
            "repeatability",
            "Repeatability, depth field / field of the photograph",
            text,
            ["", *PHOTOS],
            rows,
        )
    ]


def curve_tables(records: Records) -> list[Table]:
    """Repeatability in some of the 40 views around the true one."""
    names = list(records.records[0]["curve"])
    rows: list[list[Cell]] = []
    for offset in SHOWN_OFFSETS:
        k = CURVE_OFFSETS.index(offset)
        rows.append([f"{offset}", *(records.mean(at("curve", name, k)) for name in names)])
    text = (
        "Fraction of the points of the view with a point of the photograph within 2 px, with the "
        "object turned about "
        f"its z axis by so many degrees from the true pose. {records.text}"
    )
    columns = ["degrees", *names]
    return [Table("curve", "Repeatability around the true view", text, columns, rows)]


def sensitivity_tables(records: Records) -> list[Table]:
    """IP for other radii and numbers of points."""
    keys = [key.split() for key in records.records[0]["sensitivity"]]
    names = list(dict.fromkeys(key[0] for key in keys))
    settings = sorted({(float(key[1]), float(key[2])) for key in keys})
    rows: list[list[Cell]] = []
    for share, eps in settings:
        if share != 0.04 and eps != 2.0:  # one of the two is usual
            continue
        cells = [records.mean(at("sensitivity", f"{name} {share:g} {eps:g}")) for name in names]
        rows.append([f"{100 * share:g} %", f"{eps:g} px", *cells])
    thresholds = [
        ["4 %", f"2 px, threshold {name}", records.mean(at("threshold", name)), *others]
        for others in [["-"] * (len(names) - 1)]
        for name in records.records[0]["threshold"]
    ]
    text = (
        "IP with other shares of the pixels that are points, in photograph and view, radii, and "
        f"thresholds of MFC (the paper: .0067). {records.text}"
    )
    columns = ["points", "eps", *names]
    return [Table("sensitivity", "Sensitivity of IP", text, columns, [*rows, *thresholds])]


def _right(variant: str, pair: str, rank: int) -> Value:
    return lambda record: float(min(record[variant][pair]["top"][:rank]) < RIGHT_DEG)


def limit_rows(records: Records, columns: int) -> list[list[Cell]]:
    """What views drawn by lot, and the best view of the bank, would have, for each variant."""
    return [
        [
            name,
            *(records.mean(at(variant, key)) for variant in VARIANTS),
            *["-"] * (columns - 1 - len(VARIANTS)),
        ]
        for name, key in (("a view by lot", "chance"), ("a right view is there", "ceiling"))
    ]


def _by_lot(variant: str, count: int) -> Value:
    """The probability that one of ``count`` views by lot is right."""
    return lambda record: 1.0 - (1.0 - number(record[variant]["chance"])) ** count


def precision_tables(records: Records) -> list[Table]:
    """Fraction of the photographs whose best view is nearly right."""
    rows: list[list[Cell]] = []
    for pair in PAIRS:
        cells = [records.mean(_right(variant, pair, 1)) for variant in VARIANTS]
        rows.append([pair, *cells, _printed(printed.PRECISION[pair])])
    rows += limit_rows(records, 5)
    text = (
        f"Fraction of the photographs whose best view is within {RIGHT_DEG:g}° of the true one "
        f"(the paper does not "
        f"define its precision), before the search. {records.text}"
    )
    return [
        Table(
            "precision",
            "Precision, nine pairs",
            text,
            ["depth / photograph", *NAMES.values(), "paper"],
            rows,
        ),
        beside_the_paper(
            "precision",
            "Precision by class",
            records,
            {pair: [_right(variant, pair, 1) for variant in VARIANTS] for pair in SEARCHED_PAIRS},
            printed.PRECISION_BY_CLASS,
            tuple(NAMES.values()),
        ),
    ]


def rank_tables(records: Records) -> list[Table]:
    """Precision at rank 1, 3, 5, 10, 20."""
    text = (
        f"Fraction of the photographs with a view within {RIGHT_DEG:g}° among the best k (the "
        f"paper plots it). "
        f"{records.text}"
    )
    columns = ["depth / photograph", *(f"k = {k}" for k in RANKS)]
    rows: list[list[Cell]] = []
    for variant in VARIANTS:
        name = NAMES[variant]
        for pair in SEARCHED_PAIRS:
            cells = [records.mean(_right(variant, pair, k)) for k in RANKS]
            rows.append([f"{name}, {pair}", *cells])
        if variant != "printed":  # whose views are those of the last
            lot = [records.mean(_by_lot(variant, k)) for k in RANKS]
            ceiling = records.mean(at(variant, "ceiling"))
            rows.append([f"{name}, views by lot", *lot])
            rows.append([f"{name}, a right view is there", *[ceiling] * len(RANKS)])
    return [Table("ranks", "Precision at rank k", text, columns, rows)]


def angle_tables(records: Records) -> list[Table]:
    """Mean errors of elevation, azimuth, in-plane angle and distance."""

    text = (
        "Mean absolute errors, angles in degrees, distance in percent (that at which the mesh "
        "fills the box, with the "
        "camera of the annotation; the paper's centimetres are of unknown objects). Est.: after "
        "the search. Clo.: the "
        "closest of the three retrieved views; of refined views: each the best of a grid of 5°, as "
        "an azimuth of 1.2° on a grid of 20° must be. Bank: the closest of all its views. Angles "
        f"of symmetric objects count in full. {records.text}"
    )
    columns = ["depth / photograph", *POSE_COLUMNS]
    rows: list[list[Cell]] = []

    def means(*keys: str) -> list[Estimate]:
        return [records.mean(at(*keys, k)) for k in range(4)]

    def beside(left: Sequence[Cell], right: Sequence[Cell]) -> list[Cell]:
        return [cell for pair in zip(left, right, strict=True) for cell in pair]

    nothing = ["-"] * 4
    for variant in ("literal", "corrected"):
        name = NAMES[variant]
        for pair in REFINED_PAIRS:
            found = beside(means(variant, pair, "est"), means(variant, pair, "clo"))
            rows.append([f"{name}, {pair}", *found])
            if variant == "corrected":
                refined = beside(nothing, means(variant, pair, "refined"))
                rows.append([f"{name}, {pair}, of refined views", *refined])
                rows.append([f"{pair}, paper", *printed.POSE_ERRORS[pair]])
        rows.append([f"{name}, bank", *beside(nothing, means(variant, "limit"))])
    return [Table("angles", "Errors of the pose", text, columns, rows)]


def search_tables(records: Records) -> list[Table]:
    """What the search does, and what it would with views down the ranking."""
    rows: list[list[Cell]] = []

    def more(variant: str, pair: str) -> Value:
        return lambda record: float(record[variant][pair]["coherent"] > 1)

    def found(variant: str, pair: str, key: str) -> Value:
        return lambda record: float(record[variant][pair][key] < RIGHT_DEG)

    for variant in VARIANTS:
        for pair in SEARCHED_PAIRS:
            kinds = ("found", "wider found")
            values = (more(variant, pair), _right(variant, pair, 1))
            values += tuple(found(variant, pair, kind) for kind in kinds)
            rows.append([f"{NAMES[variant]}, {pair}", *(records.mean(one) for one in values)])
    text = (
        "More than one: photographs in which one of the best three views is coherent with the "
        f"best, so that something lies between them. Precision within {RIGHT_DEG:g}° of the best "
        "view, after the search, and after it with views down the ranking until two are coherent. "
        f"{records.text}"
    )
    columns = ["depth / photograph", "more than one", "before", "after", "down the ranking"]
    return [Table("search", "What the search does", text, columns, rows)]


def focus_tables(records: Records) -> list[Table]:
    """Focus curves by threshold, and protocols of precision."""

    def right(name: str, protocol: str) -> Value:
        return lambda record: float(record[name][protocol] < RIGHT_DEG)

    names = [name for name in records.records[0] if name.startswith("MFC ")]
    thresholds = sorted({name.split()[-1] for name in names})
    rows: list[list[Cell]] = []
    for threshold in thresholds:
        cells: list[Cell] = []
        for curve in ("MFC", "MFC x CS"):
            name = f"{curve} {threshold}"
            cells += [records.mean(at(name, "ip")), records.mean(right(name, "right"))]
        rows.append([threshold, *cells])
    for name in ("MCS", "IG"):
        ip, share = records.mean(at(name, "ip")), records.mean(right(name, "right"))
        rows.append([name, ip, share, "-", "-"])
    text = (
        "Least CS of an edge, relative to the largest (the paper: e⁻⁵ = .0067, as for MCS): IP, "
        "and precision of the corrected ranking, of focus curves alone and weighted by CS. "
        f"{records.text}"
    )
    columns = ["threshold", "MFC, IP", "precision", "MFC x CS, IP", "precision "]
    tables = [Table("thresholds", "Threshold of focus curves", text, columns, rows)]
    shown = (f"MFC {PAPER_THRESHOLD:.4f}", f"MFC x CS {PAPER_THRESHOLD:.4f}", "MCS", "IG")
    rows = []
    for name, protocol in PROTOCOLS.items():
        chance = records.mean(at("chance", protocol))
        cells = [records.mean(right(field, protocol)) for field in shown]
        rows.append([name, *cells, chance])
    text = (
        "The same rankings (corrected, CS of depth) by other protocols than the rotation of the "
        f"best view within {RIGHT_DEG:g}°. {records.text}"
    )
    columns = ["protocol", "MFC", "MFC x CS", "MCS", "IG", "chance"]
    tables.append(Table("protocols", "Protocols of precision", text, columns, rows))
    return tables


PROTOCOLS = {
    "best view": "right",
    "half turns about the vertical are right": "half turn",
    "azimuth known within 45°": "azimuth",
    "among the best 20": "top 20",
}


def number(value: float | None) -> float:
    """The number, NaN for none: records hold None for what is not finite."""
    return math.nan if value is None else float(value)


def grid_tables(records: Records) -> list[Table]:
    """Precision of CS/MFC with other grids of the descriptor."""

    def right(variant: str, grid: int) -> Value:
        return lambda record: float(record[variant][f"grid {grid}"] < RIGHT_DEG)

    rows = [
        [f"{g} x {g}", *(records.mean(right(variant, g)) for variant in VARIANTS)] for g in GRIDS
    ]
    rows += limit_rows(records, 4)
    text = (
        f"Precision of CS/MFC by the cells of the descriptor; the paper says that 8 x 8 is "
        f"best. "
        f"{records.text}"
    )
    return [Table("grids", "Grids", text, ["cells", *NAMES.values()], rows)]

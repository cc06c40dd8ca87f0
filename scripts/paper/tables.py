"""The paper's tables, made of the records of :mod:`scripts.paper.measure`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import getitem

import numpy as np

from curvireg_torch.filters.focus import PAPER_THRESHOLD
from scripts._shared import RIGHT_DEG, Record, markdown_table
from scripts.paper import printed
from scripts.paper.measures import Estimate, bootstrap

Cell = str | Estimate
Value = Callable[[Record], float]

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

    def table(
        self,
        name: str,
        title: str,
        definition: str,
        columns: Sequence[str],
        rows: Sequence[Sequence[Cell | Value]],
    ) -> Table:
        """A table with the means of values, which also says on how many they were measured; short
        rows end in dashes."""
        cads = len({r["cad"] for r in self.records})
        text = (
            f"{definition} {self.what}, N = {len(self.records)} ({cads} CADs); in brackets 95 % "
            "by bootstrap of the CADs."
        )
        cells = []
        for row in rows:
            means = [self.mean(cell) if callable(cell) else cell for cell in row]
            cells.append([*means, *["-"] * (len(columns) - len(row))])
        return Table(name, title, text, columns, cells)


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
    text = (
        "IP: fraction of the photograph's points within 2 px of a point of the curvilinear "
        "saliency (CS) of the view at the true pose. HD: Hausdorff distance of the two sets, px of "
        "the crop (paper: of unknown pictures). At most 4 % of the pixels are points. MFC x CS is "
        "the preset `classical`'s, not the paper's. The web collection of the paper was never "
        "published."
    )
    of_paper = ("paper, PASCAL3D+", "paper, web")
    columns = ["detector", "IP", *of_paper, "HD", "paper, PASCAL3D+ ", "paper, web ", "points"]
    of_class = {name: [at("ip", name)] for name in CLASS_DETECTORS}
    return [
        records.table("detectors", "Detectors: IP and Hausdorff distance", text, columns, rows),
        beside_the_paper("ip", "IP by class", records, of_class, printed.IP_BY_CLASS, ("ours",)),
    ]


def repeatability_tables(records: Records) -> list[Table]:
    """Repeatability of each depth filter's points in each photograph filter's points."""
    rows = [
        [depth, *(at("repeatability", f"{depth}/{photo}") for photo in PHOTOS)]
        for depth in REPEATED_DEPTHS
    ]
    title = "Repeatability, depth field / field of the photograph"
    text = (
        "Fraction of the points of the view at the true pose with a point of the photograph "
        "within 2 px (the paper plots it for two objects)."
    )
    return [records.table("repeatability", title, text, ["", *PHOTOS], rows)]


def curve_tables(records: Records) -> list[Table]:
    """Repeatability in some of the 40 views around the true one."""
    names = list(records.records[0]["curve"])
    rows = [
        [f"{offset}", *(at("curve", name, CURVE_OFFSETS.index(offset)) for name in names)]
        for offset in SHOWN_OFFSETS
    ]
    title = "Repeatability around the true view"
    text = (
        "Fraction of the points of the view with a point of the photograph within 2 px, with the "
        "object turned about its z axis by so many degrees from the true pose."
    )
    return [records.table("curve", title, text, ["degrees", *names], rows)]


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
    text = (
        "IP with other shares of the pixels that are points, in photograph and view, radii, and "
        "thresholds of MFC (the paper: .0067)."
    )
    columns = ["points", "eps", *names]
    return [records.table("sensitivity", "Sensitivity of IP", text, columns, rows)]


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
    text = (
        f"Fraction of the photographs whose best view is within {RIGHT_DEG:g}° of the true one "
        "(the paper does not define its precision), before the search."
    )
    columns = ["depth / photograph", *NAMES.values(), "paper"]
    return [
        records.table("precision", "Precision, nine pairs", text, columns, rows),
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
    text = (
        f"Fraction of the photographs with a view within {RIGHT_DEG:g}° among the best k (the "
        "paper plots it)."
    )
    columns = ["depth / photograph", *(f"k = {k}" for k in RANKS)]
    return [records.table("ranks", "Precision at rank k", text, columns, rows)]


def angle_tables(records: Records) -> list[Table]:
    """Mean errors of elevation, azimuth, in-plane angle and distance."""

    rows = []

    def add(name: str, *closest: str, estimated: Sequence[str] = ()) -> None:
        """A row with the errors of the estimate, if there is one, and of the closest view."""
        row = [name]
        for k in range(len(PARTS)):
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
    text = (
        "Mean absolute errors, angles in degrees, distance in percent (that at which the mesh "
        "fills the box, with the camera of the annotation; the paper's centimetres are of unknown "
        "objects). Est.: after the search. Clo.: the closest of the three retrieved views; of "
        "refined views: each the best of a grid of 5°, as an azimuth of 1.2° on a grid of 20° must "
        "be. Bank: the closest of all its views. Angles of symmetric objects count in full."
    )
    columns = ["depth / photograph", *POSE_COLUMNS]
    return [records.table("angles", "Errors of the pose", text, columns, rows)]


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
    text = (
        "More than one: photographs in which one of the best three views is coherent with the "
        f"best, so that something lies between them. Precision within {RIGHT_DEG:g}° of the best "
        "view, after the search, and after it with views down the ranking until two are coherent."
    )
    columns = ["depth / photograph", "more than one", "before", "after", "down the ranking"]
    return [records.table("search", "What the search does", text, columns, rows)]


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
    text = (
        "Least CS of an edge, relative to the largest (the paper: e⁻⁵ = .0067, as for MCS): IP, "
        "and precision of the corrected ranking, of focus curves alone and weighted by CS."
    )
    columns = ["threshold", "MFC, IP", "precision", "MFC x CS, IP", "precision "]
    thresholds = records.table("thresholds", "Threshold of focus curves", text, columns, rows)
    shown = (f"MFC {PAPER_THRESHOLD:.4f}", f"MFC x CS {PAPER_THRESHOLD:.4f}", "MCS", "IG")
    rows = [
        [name, *(right_at(field, key) for field in shown), at("chance", key)]
        for name, key in PROTOCOLS.items()
    ]
    text = (
        "The same rankings (corrected, CS of depth) by other protocols than the rotation of the "
        f"best view within {RIGHT_DEG:g}°."
    )
    columns = ["protocol", "MFC", "MFC x CS", "MCS", "IG", "chance"]
    title = "Protocols of precision"
    return [thresholds, records.table("protocols", title, text, columns, rows)]


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
    text = "Precision of CS/MFC by the cells of the descriptor; the paper says that 8 x 8 is best."
    return [records.table("grids", "Grids", text, ["cells", *NAMES.values()], rows)]

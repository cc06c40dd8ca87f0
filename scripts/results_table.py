"""Write the tables of results, in words into the README and whole into docs/accuracy.md, from
``scripts/results/evaluation_*.json``.

    python scripts/results_table.py --record DIR/summary.json NAME    store a summary of
    ``curvireg evaluate`` as NAME python scripts/results_table.py --compare DIR/summary.json ...
    print them beside the stored ones python scripts/results_table.py
       write the tables

A stored summary contains the date and the commit at which it was recorded ("+": with uncommitted
changes), so record it right after measuring.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from scripts._shared import (
    REPOSITORY,
    RESULTS,
    markdown_table,
    parser_of,
    read_json,
    stamp,
    update_page,
    write_json,
)

PASCAL3D = (
    "set | N | Acc 30° | Acc 10° | median | Acc 30°, symmetric | easy: Acc 30° | median",
    "Acc 30°, Acc 10°: share of the objects whose rotation error acos((tr(R1ᵀR2) - 1) / 2) is "
    "below; median: of that "
    "error; symmetric: a bottle's turns about its axis and a table's half turn do not count; "
    "easy: neither truncated, "
    "occluded nor difficult. No camera is given.",
)
BOP = (
    "set | N | Acc 15° | Acc 30° | median | ADD(-S) 0.1d | AR MSSD | AR MSPD | unoccluded: N | "
    "Acc 30°",
    "Rotation errors up to the object's symmetries; ADD(-S) 0.1d: share of the objects whose mean "
    "distance of model "
    "points is below a tenth of the diameter; AR MSSD, AR MSPD: BOP's average recalls; "
    "unoccluded: at least 95 % "
    "visible. Box and camera matrix are given.",
)


WORDS = {
    "hope_print": "Printed packages in clutter, with their print",
    "hope": "The same packages, of a mesh without print",
    "hope28": "27 household packages in clutter, of meshes without print",
    "ycbv_mini": "Household objects in clutter (YCB-Video)",
    "buddha": "A plaster figurine",
    "dino": "A toy dinosaur",
    "visp_boxes": "Boxes and cubes, of meshes without their print",
    "lego": "A LEGO model",
    "tless_tiago": "Industrial parts without texture (T-LESS)",
    "tracebot": "Transparent canisters and a tray",
    "lm": "Two figurines among clutter (LINEMOD)",
    "lmo": "Small objects behind others (LINEMOD-Occlusion)",
    "pascal3d_mini": "Cars, chairs and others on photographs of the web, with the mesh of a "
    "similar object and without a camera (PASCAL3D+)",
}
"""What a set shows, in the order of the README's table."""

RIGHT = 30.0  # degrees

LIGHTINGS = {"hope": 5, "hope_print": 5}  # per view; objects of these sets are not independent


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument(
        "--record", nargs=2, metavar=("SUMMARY", "NAME"), help="store a summary.json under a name"
    )
    parser.add_argument(
        "--compare",
        nargs="+",
        type=Path,
        metavar="SUMMARY",
        help="print summaries beside stored ones",
    )
    arguments = parser.parse_args()
    if arguments.record:
        print(record(Path(arguments.record[0]), arguments.record[1]))
    elif arguments.compare:
        print(comparison(arguments.compare, RESULTS))
    else:
        update_page(REPOSITORY / "README.md", "results", table_in_words(RESULTS))
        update_page(REPOSITORY / "docs" / "accuracy.md", "sets", table(RESULTS))


def record(summary: Path, name: str) -> Path:
    """Store ``summary`` with the date and the commit; returns the path."""
    path = RESULTS / f"evaluation_{name}.json"
    content = read_json(summary)
    write_json(path, {"name": name, **stamp(), "summary": content})
    return path


COMPARED = {
    "pascal3d": ("acc_pi_6", "acc_pi_18", "med_err_deg"),
    "bop": ("acc_15_deg", "acc_30_deg", "med_err_deg", "mspd_ar"),
}
"""Of each kind of data set: the scores that a comparison shows."""


def comparison(summaries: Sequence[Path], results: Path) -> str:
    """Markdown of ``DIR/NAME/summary.json`` files beside the stored results of the same names."""
    rows = [["set", "N", "score", "stored", "now"]]
    for path in summaries:
        name = path.parent.name
        measured = read_json(path)
        earlier = stored(results / f"evaluation_{name}.json").get("summary", {})
        for key in COMPARED[measured["settings"]["dataset"]]:
            values = [score(summary.get(key), key) for summary in (earlier, measured)]
            rows.append([name, measured["n"], key, *values])
    return markdown_table(rows)


def score(value: float | None, key: str) -> str:
    """A score as the tables print it."""
    return degrees(value) if key.endswith("_err_deg") else percent(value)


def stored_records(results: Path) -> list[dict[str, Any]]:
    """The stored summaries, by name."""
    paths = sorted(results.glob("evaluation_*.json"))
    return [read_json(path) for path in paths]


def table_in_words(results: Path) -> str:
    """Markdown for readers who know none of the sets; sets without words are left out."""
    records = {record["name"]: record for record in stored_records(results)}
    of_set = {each["name"]: each for each in stored(results / "confidence.json").get("sets", ())}
    rows = [
        ["objects", "number", "within 30°", "median error", "called reliable", "of these right"]
    ]
    for name, words in WORDS.items():
        if name not in records:
            continue
        summary = records[name]["summary"]
        right = summary.get("acc_30_deg", summary.get("acc_pi_6"))
        sure = of_set.get(name, {})
        believed = [sure.get(key, "-") for key in ("reliable", "reliable_right")]
        values = [percent(right), degrees(summary["med_err_deg"])]
        rows.append([words, counted(name, summary["n"]), *values, *believed])
    commits = {records[name]["commit"] for name in WORDS if name in records}
    followed = stored(results / "videos.json")
    if followed:
        rows.insert(-1, video_row(followed["videos"]))  # PASCAL3D+ stays last
        commits.add(followed["commit"])
    return f"{markdown_table(rows)}\nCommit {', '.join(sorted(commits))}.\n"


def stored(path: Path) -> dict[str, Any]:
    """A record, empty if there is none."""
    return read_json(path) if path.exists() else {}


def video_row(videos: Sequence[Mapping[str, Any]]) -> list[object]:
    """The row of the frames that scripts/videos.py followed."""
    errors = [error for video in videos for error in video["errors_deg"]]
    verdicts = [verdict for video in videos for verdict in video["verdicts"]]
    trusted = [e for e, verdict in zip(errors, verdicts, strict=True) if verdict == "reliable"]
    right = sum(error < RIGHT for error in errors) / len(errors)
    return [
        f"Frames of {len(videos)} videos, each followed from its first frame",
        len(errors),
        percent(right),
        degrees(median(errors)),
        len(trusted),
        sum(error < RIGHT for error in trusted),
    ]


def table(results: Path) -> str:
    """Markdown of all stored summaries."""
    records = stored_records(results)
    parts = []
    for title, kind, (columns, definition), cells in (
        ("Viewpoints on PASCAL3D+", "pascal3d", PASCAL3D, pascal3d_cells),
        ("Poses on BOP sets", "bop", BOP, bop_cells),
    ):
        chosen = [r for r in records if r["summary"]["settings"]["dataset"] == kind]
        if not chosen:
            continue
        rows = [columns.split(" | ")]
        sets = {}
        for each in chosen:
            rows.append(cells(each["name"], each["summary"]))
            sets.setdefault(note(each), []).append(each["name"])
        notes = [f"- {', '.join(names)}: {conditions}" for conditions, names in sets.items()]
        lines = [f"**{title}.** {definition}", "", markdown_table(rows), *notes, ""]
        parts.append("\n".join(lines))
    return "\n".join(parts)


def note(record: dict[str, Any]) -> str:
    """Conditions under which one line was measured."""
    summary = record["summary"]
    settings = summary["settings"]
    limit = "" if summary["limit"] is None else f", limited to {summary['limit']} objects"
    skipped = sum(summary["skipped"].values())
    return (
        f"split {settings['split']}{limit}; {summary['protocol']}; "
        f"preset {settings['preset']}; {summary['failed']} failed, {skipped} skipped; "
        f"{record['date']}, commit {record['commit']}"
    )


def pascal3d_cells(name: str, summary: dict[str, Any]) -> list[object]:
    easy = summary["subsets"]["easy"]
    return [
        name,
        summary["n"],
        percent(summary["acc_pi_6"]),
        percent(summary["acc_pi_18"]),
        degrees(summary["med_err_deg"]),
        percent(summary["symmetry_aware"]["acc_pi_6"]),
        percent(easy["acc_pi_6"]),
        degrees(easy["med_err_deg"]),
    ]


def bop_cells(name: str, summary: dict[str, Any]) -> list[object]:
    whole = summary["subsets"]["unoccluded"]
    return [
        name,
        counted(name, summary["n"]),
        percent(summary["acc_15_deg"]),
        percent(summary["acc_30_deg"]),
        degrees(summary["med_err_deg"]),
        percent(summary["add_recall_0.1d"]),
        percent(summary["mssd_ar"]),
        percent(summary["mspd_ar"]),
        whole["n"],
        percent(whole["acc_30_deg"]),
    ]


def counted(name: str, n: int) -> str:
    """The number of objects, with the numbers of views and lightings if the set has several
    lightings."""
    lightings = LIGHTINGS.get(name, 1)
    if lightings == 1 or n % lightings:
        return str(n)
    return f"{n} ({n // lightings} views x {lightings} lightings)"


def percent(fraction: float | None) -> str:
    return "-" if fraction is None else f"{100 * fraction:.1f} %"


def degrees(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}°"


if __name__ == "__main__":
    main()

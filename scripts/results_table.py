"""Write the tables of results, in words into the README and whole into docs/accuracy.md, from
``scripts/results/evaluation_*.json``.

    python scripts/results_table.py --record DIR/summary.json NAME
    python scripts/results_table.py --compare DIR/summary.json ...
    python scripts/results_table.py

The first stores a summary of ``curvireg evaluate`` under a name, the second prints summaries beside
the stored ones of the same names, the last writes the tables.

A stored summary contains the date and the commit at which it was recorded ("+": with uncommitted
changes), so record it right after measuring.
"""

from collections.abc import Iterator, Sequence
from functools import reduce
from operator import getitem
from pathlib import Path
from statistics import median

from curvireg_torch.utils.checks import check_option
from scripts._shared import (
    REPOSITORY,
    RESULTS,
    RIGHT_DEG,
    Record,
    markdown_table,
    read_json,
    run,
    stamp,
    update_page,
    write_json,
)

SHOWN = read_json(Path(__file__).with_name("tables.json"))
KINDS = SHOWN["kinds"]
"""Of each kind of data set: title, definition and columns of its table, with the keys of scores;
and the scores that a comparison shows."""

WORDS = SHOWN["words"]
"""What a set shows, in the order of the README's table."""

LIGHTINGS = SHOWN["lightings"]
"""Of sets with several lightings of a view: their number; objects are not independent."""


def main(
    *,
    record: tuple[str, str] | None = None,
    compare: list[Path] | None = None,
) -> None:
    if record:
        summary, name = record
        print(store(Path(summary), name))
    elif compare:
        print(comparison(compare, RESULTS))
    else:
        update_page(REPOSITORY / "README.md", "results", table_in_words(RESULTS))
        update_page(REPOSITORY / "docs" / "accuracy.md", "sets", table(RESULTS))


def store(summary: Path, name: str) -> Path:
    """Store ``summary`` with the date and the commit; returns the path."""
    path = RESULTS / f"evaluation_{name}.json"
    content = read_json(summary)
    write_json(path, {"name": name, **stamp(), "summary": content})
    return path


def comparison(summaries: Sequence[Path], results: Path) -> str:
    """Markdown of ``DIR/NAME/summary.json`` files beside the stored results of the same names."""
    rows = [["set", "N", "score", "stored", "now"]]
    for path in summaries:
        name = path.parent.name
        measured = read_json(path)
        dataset = measured["settings"]["dataset"]
        check_option(dataset, KINDS, f"{path}: dataset")
        earlier = stored(results / f"evaluation_{name}.json").get("summary", {})
        for key in KINDS[dataset]["compared"]:
            values = [score(summary.get(key), key) for summary in (earlier, measured)]
            rows.append([name, measured["n"], key, *values])
    return markdown_table(rows)


def score(value: float | None, key: str) -> str:
    """A number of a summary as the tables print it."""
    if key == "n":
        return str(value)
    return degrees(value) if key.endswith("_err_deg") else percent(value)


def stored_records(results: Path) -> list[Record]:
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


def stored(path: Path) -> Record:
    """A record, empty if there is none."""
    return read_json(path) if path.exists() else {}


def video_row(videos: Sequence[Record]) -> list[object]:
    """The row of the frames that scripts/videos.py followed."""
    errors = [error for video in videos for error in video["errors_deg"]]
    verdicts = [verdict for video in videos for verdict in video["verdicts"]]
    trusted = [e for e, verdict in zip(errors, verdicts, strict=True) if verdict == "reliable"]
    right = sum(error < RIGHT_DEG for error in errors) / len(errors)
    return [
        f"Frames of {len(videos)} videos, each followed from its first frame",
        len(errors),
        percent(right),
        degrees(median(errors)),
        len(trusted),
        sum(error < RIGHT_DEG for error in trusted),
    ]


def table(results: Path) -> str:
    """Markdown of all stored summaries."""
    records = stored_records(results)
    parts = []
    for name, kind in KINDS.items():
        chosen = [each for each in records if each["summary"]["settings"]["dataset"] == name]
        if not chosen:
            continue
        rows = [["set", *(column for column, _ in kind["columns"])]]
        sets = {}
        for each in chosen:
            rows.append([each["name"], *cells(each, kind["columns"])])
            sets.setdefault(note(each), []).append(each["name"])
        notes = [f"- {', '.join(names)}: {conditions}" for conditions, names in sets.items()]
        title = f"**{kind['title']}.** {kind['definition']}"
        parts.append("\n".join([title, "", markdown_table(rows), *notes, ""]))
    return "\n".join(parts)


def cells(record: Record, columns: Sequence[Sequence[str]]) -> Iterator[str]:
    """The scores of a set; keys within others are parted by slashes."""
    for _, keys in columns:
        *outer, key = keys.split("/")
        value = reduce(getitem, outer, record["summary"])[key]
        yield counted(record["name"], value) if keys == "n" else score(value, key)


def note(record: Record) -> str:
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
    run(main)

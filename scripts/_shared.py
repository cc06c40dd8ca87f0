"""Helpers that several scripts use: options, records, tables and timing."""

import argparse
import datetime
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from curvireg_torch.errors import WorkerError
from curvireg_torch.utils.executors import Workers
from curvireg_torch.utils.files import write_file

if TYPE_CHECKING:
    import resource

REPOSITORY = Path(__file__).resolve().parents[1]
RESULTS = REPOSITORY / "scripts" / "results"
WRITTEN = ("scripts/results", "docs", "README.md")
"""Paths that scripts write to. A change there does not affect what a script measures."""


def parser_of(description: str | None) -> argparse.ArgumentParser:
    """A parser of options whose help is a script's docstring as it is written."""
    return argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )


def update_page(page: Path, name: str, body: str) -> None:
    """Write ``body`` between the markers ``name:begin`` and ``name:end`` of a Markdown page."""
    begin = f"<!-- {name}:begin -->"
    end = f"<!-- {name}:end -->"
    text = page.read_text(encoding="utf-8")
    page.write_text(
        f"{text[: text.index(begin) + len(begin)]}\n{body}{text[text.index(end) :]}",
        encoding="utf-8",
    )


def markdown_table(rows: Sequence[Sequence[object]]) -> str:
    """Rows of cells as Markdown, the first of them as the header."""
    lines = ["| " + " | ".join(map(str, row)) + " |" for row in rows]
    lines.insert(1, "|---" * len(rows[0]) + "|")
    return "\n".join(lines) + "\n"


def read_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def write_json(path: Path, content: Any) -> None:
    """Write a record, and create its folder if needed; an interrupted run leaves no half of a
    file."""
    write_file(path, (json.dumps(content, indent=2) + "\n").encode())


def read_lines(path: Path) -> list[Any]:
    """JSON lines."""
    return list(map(json.loads, path.read_text(encoding="utf-8").splitlines()))


def in_processes(
    function: Callable[[Any], Any],
    tasks: Collection[Any],
    jobs: int,
    name: str,
) -> Iterator[tuple[Any, Any]]:
    """Tasks and their results as they are done, with a bar; each process gets the function once."""
    with Workers(jobs) as workers:
        done = workers.map(_each, function, ([task] for task in tasks))
        for task, found in tqdm(done, total=len(tasks), desc=name):
            if isinstance(found, WorkerError):
                raise found
            yield task, found


def _each(function: Callable[[Any], Any], tasks: Sequence[Any]) -> list[Any]:
    return list(map(function, tasks))


def measured(
    out: Path,
    function: Callable[[Any], list[Any]],
    tasks: Mapping[str, Any],
    jobs: int,
    name: str,
) -> list[Any]:
    """Rows of tasks, by what they depend on; those of finished tasks are kept in a file, and read
    from it."""
    out.parent.mkdir(parents=True, exist_ok=True)
    known = {}
    if out.exists():
        known = {str(entry["task"]): entry["rows"] for entry in read_lines(out)}
    new = {key: task for key, task in tasks.items() if key not in known}
    with out.open("a", encoding="utf-8") as file:
        for (key, _), rows in in_processes(partial(_of_item, function), new.items(), jobs, name):
            known[key] = rows
            file.write(json.dumps({"task": key, "rows": rows}) + "\n")
            file.flush()
    return [row for key in tasks for row in known[key]]


def _of_item(function: Callable[[Any], Any], item: tuple[str, Any]) -> Any:
    return function(item[1])


def stamp() -> dict[str, Any]:
    """The first entries of a record: when it was measured, and of which checkout."""
    return {"date": today(), "commit": commit()}


def today() -> str:
    return datetime.datetime.now(datetime.UTC).date().isoformat()


def commit(root: Path = REPOSITORY) -> str:
    """Short hash of the checkout, with "+" if anything outside ``WRITTEN`` was changed; "unknown"
    without git."""

    def git(*words: str) -> str:
        command = ["git", "-C", str(root), *words]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        changed = git(
            "status",
            "--porcelain",
            "--untracked-files=no",
            "--",
            ".",
            *(f":!{path}" for path in WRITTEN),
        )
        return git("rev-parse", "--short", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def processor(device: str = "cpu") -> str:
    """Name of the GPU of a device, or of the processor, as Linux reports it, and the number of its
    cores."""
    if device != "cpu":
        import torch

        return torch.cuda.get_device_name(device)
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{names[0] if names else 'unknown processor'}, {os.cpu_count()} cores"


def run_process(
    words: Sequence[str], folder: Path, environment: dict[str, str]
) -> "tuple[float, resource.struct_rusage, str]":
    """Seconds, resources and output of a Python process in a folder; the script ends if the process
    fails. On Windows, which does not count resources, an AttributeError.

    Args:
        words: arguments of the interpreter.
    """
    start = time.perf_counter()
    with (folder / "output").open("w+") as output, (folder / "errors").open("w+") as errors:
        process = subprocess.Popen(
            [sys.executable, *words], env=environment, stdout=output, stderr=errors, cwd=folder
        )
        _, status, usage = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - start
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            errors.seek(0)
            raise SystemExit(
                f"{' '.join(words)} failed with PYTHONPATH={environment['PYTHONPATH']}: "
                f"{errors.read()}"
            )
        output.seek(0)
        return seconds, usage, output.read()

"""Helpers that several scripts use: options, records, tables, and rows that are resumed."""

import argparse
import datetime
import inspect
import json
import os
import subprocess
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args, get_origin

from tqdm import tqdm

from curvireg_torch.errors import CurviregError, WorkerError
from curvireg_torch.utils.executors import Workers
from curvireg_torch.utils.files import file_digest, text_digest, write_file

Record: TypeAlias = dict[str, Any]
"""A row, or what a file of JSON holds."""

REPOSITORY = Path(__file__).resolve().parents[1]
RESULTS = REPOSITORY / "scripts" / "results"
RIGHT_DEG = 30.0  # a pose is right whose rotation is within it
WRITTEN = ("scripts/results", "docs", "README.md")
"""Paths that scripts write to. A change there does not affect what a script measures."""


def run(main: Callable[..., Any]) -> Any:
    """Call the ``main`` of a script with the arguments of the command line, which its parameters
    describe; the help is the script's docstring. Errors of the library end it with their message.

    Parameters by keyword are options. ``Literal`` lists what may be chosen, ``bool`` is a switch,
    ``list`` is one value or several, and ``tuple`` as many as it has types.
    """
    parser = argparse.ArgumentParser(
        description=main.__globals__["__doc__"],
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    for name, parameter in inspect.signature(main).parameters.items():
        how = _argument(parameter.annotation)
        if parameter.kind is parameter.KEYWORD_ONLY:
            name = f"--{name.replace('_', '-')}"
            how |= {"default": parameter.default, "required": parameter.default is parameter.empty}
        elif parameter.default is not parameter.empty:
            how["nargs"] = "*"
        parser.add_argument(name, **how)
    try:
        return main(**vars(parser.parse_args()))
    except CurviregError as error:
        parser.error(str(error))


def _argument(kind: Any) -> Record:
    """What argparse has to know of an argument of a type."""
    origin = get_origin(kind)
    parts = get_args(kind)
    if kind is bool:
        return {"action": "store_true"}
    if origin is Literal:
        return {"choices": parts}
    if origin is list:
        return _argument(parts[0]) | {"nargs": "+"}
    if origin is tuple:
        return _argument(parts[0]) | {"nargs": len(parts)}
    return _argument(parts[0]) if parts else {"type": kind}  # parts are those of X | None


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
    return json.loads(path.read_bytes())


def write_json(path: Path, content: Any) -> None:
    """Write a record, and create its folder if needed; an interrupted run leaves no half of a
    file."""
    write_file(path, (json.dumps(content, indent=2) + "\n").encode())


def read_lines(path: Path) -> list[Any]:
    """JSON lines."""
    return [json.loads(line) for line in path.read_bytes().splitlines()]


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
        known = {entry["task"]: entry["rows"] for entry in read_lines(out)}
    new = {key: task for key, task in tasks.items() if key not in known}
    with out.open("a", encoding="utf-8") as file:
        for (key, _), rows in in_processes(partial(_of_item, function), new.items(), jobs, name):
            known[key] = rows
            file.write(json.dumps({"task": key, "rows": rows}) + "\n")
            file.flush()
    return [row for key in tasks for row in known[key]]


def request_digest(
    request: Sequence[Any],
    scripts: Iterable[Path],
    mesh: str | Path,
    pictures: Iterable[str | Path],
) -> str:
    """Digest of all that the rows of a mesh and photographs depend on, code included."""
    from curvireg_torch.formats.meshes.files import mesh_digest  # imports torch
    from curvireg_torch.jobs.runner import results_digest

    code = [results_digest(), *map(file_digest, scripts)]
    photographs = [file_digest(Path(picture)) for picture in pictures]
    return text_digest(json.dumps([request, code, mesh_digest(Path(mesh)), photographs]))


def _of_item(function: Callable[[Any], Any], item: tuple[str, Any]) -> Any:
    return function(item[1])


def stamp() -> Record:
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

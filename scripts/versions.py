"""The suite at both ends of what ``pyproject.toml`` admits, on every Python.

    scripts/test_versions.sh                              every cell that was not yet tested at this commit
    scripts/test_versions.sh 3.12-newest 3.11-lowest      these
    scripts/test_versions.sh --select ""                  the slow tests too

"newest" is what pip takes on that day, "lowest" each lower bound of ``pyproject.toml`` made exact. Each cell has an
environment of its own under ``out/versions``, removed afterwards (several GB, since pip's own choice of torch is a CUDA
build), and a log beside it. What was found goes to ``scripts/results/versions.json`` and from there into
``docs/versions.md``, cell by cell: stopped and started again, it goes on. Exits 1 if a cell failed.
"""

import argparse
import json
import shlex
import shutil
import subprocess
import sys
import time
import tomllib
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

from _record import REPOSITORY, between, commit, today

RESULTS = REPOSITORY / "scripts" / "results" / "versions.json"
DOCUMENT = REPOSITORY / "docs" / "versions.md"
MARKERS = "<!-- versions:begin -->", "<!-- versions:end -->"
CELLS = ["3.11-newest", "3.11-lowest", "3.12-newest", "3.13-newest", "3.14-newest"]
PARALLEL = ["--numprocesses", "auto", "--maxprocesses", "4", "--dist", "loadfile"]
SHOWN = ["torch", "kornia", "numpy", "scipy", "opencv-python-headless", "trimesh", "scikit-learn", "safetensors"]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cells", nargs="*", metavar="CELL", help=f"default: {' '.join(CELLS)}")
    parser.add_argument("--select", default="not slow", metavar="MARKS", help='of pytest -m (default: "not slow")')
    parser.add_argument("--keep", action="store_true", help="keep the environments")
    arguments = parser.parse_args()
    known = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.is_file() else {}
    written = [str(path.relative_to(REPOSITORY)) for path in (RESULTS, DOCUMENT)]
    here = {"commit": commit(REPOSITORY, but=written), "select": arguments.select}
    for cell in arguments.cells or CELLS:
        if here.items() <= known.get(cell, {}).items() and not here["commit"].endswith("+"):
            continue
        known[cell] = {**test(cell, arguments.select, keep=arguments.keep), **here, "date": today()}
        RESULTS.write_text(json.dumps(dict(sorted(known.items())), indent=2) + "\n", encoding="utf-8")
        text = DOCUMENT.read_text(encoding="utf-8")
        DOCUMENT.write_text(between(text, *MARKERS, table(known)), encoding="utf-8")
    return int(any(known[cell]["failed"] for cell in arguments.cells or CELLS))


def test(cell: str, select: str, *, keep: bool) -> dict[str, Any]:
    """Make the cell's environment and run the suite in it; the counts and versions, or why there are none."""
    number, end = cell.split("-")
    folder = REPOSITORY / "out" / "versions" / cell
    python, log, report = folder / "bin" / "python", Path(f"{folder}.log"), Path(f"{folder}.xml")
    folder.parent.mkdir(parents=True, exist_ok=True)
    nothing = {"passed": 0, "failed": 0, "skipped": 0, "versions": {}}
    found = shutil.which(f"python{number}")
    if found is None or subprocess.run([found, "--version"], capture_output=True).returncode:
        return {**nothing, "note": f"no python{number} on this machine"}
    constraints = Path(f"{folder}.txt")
    constraints.write_text("\n".join(lowest() if end == "lowest" else []) + "\n")
    start = time.monotonic()
    report.unlink(missing_ok=True)
    with log.open("w") as output:
        for command in (
            [found, "-m", "venv", folder],
            [python, "-m", "pip", "install", "--quiet", "-e", f"{REPOSITORY}[dev]", "-c", constraints],
            [python, "-m", "pytest", "-q", *PARALLEL, "-p", "no:cacheprovider", "-m", select, f"--junitxml={report}"],
        ):
            print(f"{cell}: {shlex.join(map(str, command))}", flush=True)
            code = subprocess.run(command, stdout=output, stderr=subprocess.STDOUT, cwd=REPOSITORY).returncode
            if code:
                break
    result = {**nothing, "failed": 1, "note": f"{log.relative_to(REPOSITORY)}: {log.read_text().splitlines()[-1:]}"}
    if report.is_file():
        suite = next(ElementTree.parse(report).getroot().iter("testsuite"))
        total, failures, errors, skipped = (int(suite.get(k, 0)) for k in ("tests", "failures", "errors", "skipped"))
        failed = failures + errors or int(code != 0)
        result = {"passed": total - failures - errors - skipped, "failed": failed, "skipped": skipped, "note": ""}
        result |= {"versions": versions(python), "seconds": round(time.monotonic() - start)}
    if not keep:
        shutil.rmtree(folder, ignore_errors=True)
    return result


def lowest() -> list[str]:
    """The lower bounds of ``pyproject.toml`` as pip's constraints."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    groups = [project["dependencies"], *project["optional-dependencies"].values()]
    return sorted({wanted.replace(">=", "==") for group in groups for wanted in group if ">=" in wanted})


def versions(python: Path) -> dict[str, str]:
    listing = subprocess.run(
        [python, "-m", "pip", "list", "--format=json"], capture_output=True, text=True, check=True
    ).stdout
    found = {entry["name"]: entry["version"] for entry in json.loads(listing)}
    exact = subprocess.run([python, "--version"], capture_output=True, text=True, check=True).stdout.split()[-1]
    return {"python": exact, **{name: found[name] for name in SHOWN}}


def table(known: dict[str, dict[str, Any]]) -> str:
    """Markdown of every cell that was tested or could not be."""
    columns = ["cell", "Python", *SHOWN, "passed", "failed", "skipped", "tests", "day, commit"]
    lines = [columns, ["---"] * len(columns)]
    for cell, result in sorted(known.items()):
        found = [result["versions"].get(name, "") for name in ["python", *SHOWN]]
        counts = [str(result[name]) for name in ("passed", "failed", "skipped")]
        what = result["note"] or result["select"] or "all"
        lines.append([cell, *found, *counts, what, f"{result['date']}, {result['commit']}"])
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())

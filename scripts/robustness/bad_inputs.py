"""Run command lines and calls with one mistake each, and judge what they answer.

    python scripts/robustness/bad_inputs.py                       writes scripts/results/bad_inputs.json
    python scripts/robustness/bad_inputs.py --only lists --print  the answers of one group

An answer is clear if the command ends with code 2 and prints one error of ours, which names the file or option, or if
it registers and prints a warning that does; no traceback, no message of a library, at most five processor seconds.
Calls of the Python interface must raise one of our errors with such a message. Exit code 1 if anything is not clear.

``bad_cases.txt`` holds the command lines in groups, and after ``=>`` what the message must name. A line that begins
with ``?`` describes an input that is used, but with a warning or note of these words. ``P``, ``M`` and ``K`` are a good
photograph, mesh and bank, ``BOX`` and ``CAMERA`` fit them, ``O`` is a folder for the results, ``TAKEN`` a port in use.
"""

import argparse
import json
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from curvireg_torch.cli import main as run_command
from curvireg_torch.errors import CurviregError
from scripts._shared import REPOSITORY, RESULTS, commit, today, write_json
from scripts.robustness.bad_calls import CALLS
from scripts.robustness.bad_files import write_files

RESULT = RESULTS / "bad_inputs.json"
LINES = Path(__file__).with_name("bad_cases.txt")
WORDS = {
    "P": "photo.png", "M": "truck.ply", "K": "bank.safetensors", "O": "--out out --quiet",
    "BOX": "--box 30 25 210 160", "CAMERA": "--camera 260 260 119.5 89.5",
}  # fmt: skip
SECONDS = 5.0
"""Processor seconds that an answer may take."""

LIMIT = 100
"""Seconds after which a command is interrupted."""

OURS = r"curvireg: error: .*|curvireg( \w+){0,2}: error: .*"
NOTES = r"curvireg: warning: .*|usage: .*| {4,}.*|.*: (localizing the object|camera guessed|used for all).*|failed: .*"
FOREIGN = r"Traceback|Error:|Exception|File \"|site-packages|Warning:|\[ WARN|\[ERROR|libpng|\bself\b"


def read_cases() -> list[tuple[str, str]]:
    """Group and line of each case, with the words of ``WORDS`` in place of their short names."""
    cases, group = [], ""
    for line in filter(None, LINES.read_text(encoding="utf-8").splitlines()):
        if line.startswith("# "):
            group = line.removeprefix("# ")
        else:
            cases.append((group, " ".join(WORDS.get(word, word) for word in line.split())))
    return cases


@contextmanager
def captured(folder: Path) -> Iterator[list[str]]:
    """A list that holds, afterwards, what was written to standard output and error, also by libraries in C."""
    streams, texts = (sys.stdout, sys.stderr), []
    kept = [os.dup(number) for number in (1, 2)]
    files = [(folder / name).open("w+", errors="replace") for name in ("stdout", "stderr")]
    try:
        for stream, file, number in zip(streams, files, (1, 2), strict=True):
            stream.flush()
            os.dup2(file.fileno(), number)
        sys.stdout, sys.stderr = (os.fdopen(os.dup(number), "w") for number in (1, 2))
        yield texts
    finally:
        for stream in (sys.stdout, sys.stderr):
            stream.close()
        sys.stdout, sys.stderr = streams
        for copy, number, file in zip(kept, (1, 2), files, strict=True):
            os.dup2(copy, number)
            os.close(copy)
            file.seek(0)
            texts.append(file.read())
            file.close()


def run_line(line: str, log: Path) -> dict[str, Any]:
    """Exit code, output and processor seconds of a command line in this process."""
    words = shlex.split(line)
    variables = dict(word.split("=", 1) for word in words if re.match("[A-Z_]+=", word))
    words = words[len(variables) :]
    if words[0] == "view":
        words.append("--no-browser")
    before = dict(os.environ)
    os.environ.update(variables)
    signal.signal(signal.SIGALRM, _interrupt)
    start = time.process_time()
    with captured(log) as texts:
        signal.alarm(LIMIT)
        try:
            code: Any = run_command(words)
        except SystemExit as stop:
            code = stop.code
        except BaseException as error:  # what a user would see as a traceback
            code = f"Traceback: {type(error).__name__}: {error}"
        finally:
            signal.alarm(0)
            os.environ.clear()
            os.environ.update(before)
    return {"code": code, "out": texts[0], "err": texts[1], "seconds": round(time.process_time() - start, 2)}


def _interrupt(*_: object) -> None:
    raise TimeoutError(f"no answer within {LIMIT} s")


def judge_line(answer: dict[str, Any], names: list[str], *, used: bool) -> list[str]:
    """What is wrong with the answer to a command line; ``used``: the input is used, with a warning or note."""
    err, lines = answer["err"], [line for line in answer["err"].splitlines() if line.strip()]
    errors = [line for line in lines if re.fullmatch(OURS, line)]
    reasons = [line for line in answer["out"].splitlines() if line.startswith("failed: ")]
    said = answer["out"] + err if used else "\n".join(errors + reasons)
    wrong = []
    if answer["code"] != (0 if used else 2):
        wrong.append(f"code {answer['code']}")
    if len(errors) != (0 if used else 1):
        wrong.append(f"{len(errors)} errors of ours")
    if re.search(FOREIGN, err):
        wrong.append("a message that is not ours")
    wrong += [f"unexpected line {line!r}" for line in lines if not re.fullmatch(f"{OURS}|{NOTES}", line)]
    wrong += [f"does not name {name}" for name in names if name.lower() not in said.lower()]
    if not used and answer["seconds"] > SECONDS:
        wrong.append(f"{answer['seconds']} s")
    return wrong


def judge_call(call: Callable[[], object], names: list[str]) -> dict[str, Any]:
    """The message of a call of the Python interface, and what is wrong with it."""
    start = time.process_time()
    try:
        message, wrong = f"returned {call()!r:.200}", ["no error"]
    except CurviregError as error:
        message = str(error)
        wrong = [f"does not name {name}" for name in names if name.lower() not in message.lower()]
        wrong += ["a message of several lines"] * ("\n" in message)
    except Exception as error:
        message, wrong = f"{type(error).__name__}: {error}", ["an error that is not ours"]
    return {"message": message, "wrong": wrong, "seconds": round(time.process_time() - start, 2)}


def interrupted(seconds: float) -> dict[str, Any]:
    """The answer of the command to Ctrl-C that long after its process has entered Python."""
    entry = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # as in a terminal
    entry += "import sys; sys.argv[1:] = ['demo', '--out', 'out', '--quiet']\n"
    entry += "from curvireg_torch.__main__ import main\nprint('entered', flush=True)\nsys.exit(main())"
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    options: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "env": environment}
    process = subprocess.Popen([sys.executable, "-c", entry], **options)
    assert process.stdout is not None
    process.stdout.readline()
    time.sleep(seconds)
    process.send_signal(signal.SIGINT)
    err = process.communicate(timeout=LIMIT)[1]
    quiet = (process.returncode, err) in ((130, "curvireg: interrupted\n"), (-signal.SIGINT, ""))
    return {"message": err.strip(), "wrong": [] if quiet else [f"code {process.returncode}"], "seconds": 0.0}


def run_cases(folder: Path, only: list[str]) -> Iterator[dict[str, Any]]:
    """The answers to all cases of these groups, in files of ``folder``."""
    write_files(folder)
    os.environ["CURVIREG_CACHE"] = str(folder / "cache")
    log = folder / "log"
    log.mkdir()
    with socket.create_server(("127.0.0.1", 0)) as taken:
        for group, text in read_cases():
            if group in only:
                line, _, names = text.removeprefix("? ").partition(" => ")
                used = text.startswith("? ")
                answer = run_line(line.replace("TAKEN", str(taken.getsockname()[1])), log)
                said = re.sub(r"(?m)^(usage:| {4,}).*\n", "", answer["err"])
                said += "".join(x for x in answer["out"].splitlines(True) if used or x.startswith("failed: "))
                row = {"group": group, "case": line, "message": " | ".join(said.splitlines())}
                yield {**row, "wrong": judge_line(answer, names.split(), used=used), "seconds": answer["seconds"]}
    for name, call, names in CALLS if "Python" in only else ():
        yield {"group": "Python", "case": name, **judge_call(call, names)}
    for moment in (0.0, 0.01, 0.03, 0.1, 0.5, 2.0) if "Ctrl-C" in only else ():
        yield {"group": "Ctrl-C", "case": f"after {moment} s", **interrupted(moment)}


def main() -> int:
    groups = [*dict.fromkeys(group for group, _ in read_cases()), "Python", "Ctrl-C"]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=groups, default=groups)
    parser.add_argument("--print", action="store_true", help="print every answer")
    parser.add_argument("--out", type=Path, help=f"default: {RESULT.name}, if all groups are run")
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    start, here = time.process_time(), Path.cwd()
    with tempfile.TemporaryDirectory() as temporary:
        os.chdir(temporary)
        try:
            for row in run_cases(Path(temporary), options.only):
                rows.append(row)
                if row["wrong"] or options.print:
                    print(f"{row['group']}: {row['case']}\n    {row['message']}\n    {row['wrong']}", flush=True)
        finally:
            os.chdir(here)
    clear = Counter(row["group"] for row in rows if not row["wrong"])
    counts = {group: [clear[group], sum(row["group"] == group for row in rows)] for group in options.only}
    total = [sum(clear.values()), len(rows)]
    print(f"{total[0]} of {total[1]} clear: {json.dumps(counts)}; {time.process_time() - start:.0f} s")
    if out := options.out or (RESULT if options.only == groups else None):
        record = {"date": today(), "commit": commit(), "clear": total, "groups": counts, "cases": rows}
        write_json(out, record)
    return int(total[0] < total[1])


if __name__ == "__main__":
    sys.exit(main())

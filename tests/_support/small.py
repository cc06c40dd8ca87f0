"""Short evaluations. ``python -m tests._support.small WORDS`` is the command line with a small
bank.

``CURVIREG_TEST_KILL=n`` kills the process with signal 9 in its n-th write of a result, whose last
bytes are lost. ``CURVIREG_TEST_KILL_WORKER=FILE`` so kills a worker with its first photographs,
once: FILE is made.
"""

import os
import signal
import sys
from pathlib import Path

from curvireg_torch.cli import main
from curvireg_torch.evaluation import evaluate
from curvireg_torch.jobs import runner
from curvireg_torch.pipeline import DEFAULT, PRESETS, BankSettings, Pipeline, ViewPolicy
from tests._support.lists import lines

SMALL = Pipeline(
    views=ViewPolicy(directions=18, theta_step=360.0, azimuth_step=60.0, elevations=(10.0,)),
    bank=BankSettings(image_size=32),
    terms=PRESETS["classical"].terms,
    search=False,
    contours=False,
)


def run(benchmark, out, **options):
    return evaluate(benchmark, out, progress=False, **options)


def rows_of(benchmark, out):
    rows = {row["key"]: row for row in lines(out)}
    return {entry.key: rows[entry.key] for entry in benchmark.entries if entry.key in rows}


def kill_in_write(count):
    """Kill this process in its ``count``-th write of a file that is neither a bank nor a
    picture."""
    sync = os.fsync
    writes = 0

    def sync_or_die(file):
        nonlocal writes
        name = Path(f"/proc/self/fd/{file}").readlink().name
        writes += not any(kind in name for kind in (".safetensors", ".jpg", ".probe"))
        if writes == count:
            os.truncate(file, os.fstat(file).st_size - 20)
            os.kill(os.getpid(), signal.SIGKILL)
        sync(file)

    os.fsync = sync_or_die


def kill_a_worker(marker):
    """Kill this process, a worker, when it gets photographs, unless another one did so."""
    register = runner._register_block

    def register_or_die(opened, tasks):
        try:
            marker.touch(exist_ok=False)
        except FileExistsError:
            return register(opened, tasks)
        os.kill(os.getpid(), signal.SIGKILL)
        raise AssertionError

    runner._register_block = register_or_die


if __name__ in ("__main__", "__mp_main__"):  # the second is that of its workers
    PRESETS[DEFAULT] = SMALL

if __name__ == "__mp_main__" and "CURVIREG_TEST_KILL_WORKER" in os.environ:
    kill_a_worker(Path(os.environ["CURVIREG_TEST_KILL_WORKER"]))

if __name__ == "__main__":
    if "CURVIREG_TEST_KILL" in os.environ:
        kill_in_write(int(os.environ["CURVIREG_TEST_KILL"]))
    sys.exit(main([*sys.argv[1:], "--quiet"]))

"""Python programs that read files of unknown origin in a process of their own, within a limit of
time and of memory: their libraries print, crash, or do not end."""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from ..errors import MAX_CAD_MEMORY, MAX_CAD_SECONDS

_OUT_OF_MEMORY = 77  # exit status of a program that was refused memory
# macOS and Windows have no such limit
_START = f"""
import runpy, sys
try:
    import resource
    resource.setrlimit(resource.RLIMIT_AS, (int(sys.argv[1]),) * 2)
except (ImportError, OSError, ValueError):
    pass
sys.argv = sys.argv[2:]
try:
    runpy.run_path(sys.argv[0], run_name="__main__")
except MemoryError:
    sys.exit({_OUT_OF_MEMORY})
"""
# Each thread of a library, and each arena of its allocator, would reserve memory
_ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "1"}


def run_program(program: Path, arguments: Sequence[str], *, name: str, advice: str) -> bool:
    """Run the Python program of a file, without its output; returns whether it ended well.

    Raises:
        ValueError: it took more time than ``MAX_CAD_SECONDS``, or more memory than
            ``MAX_CAD_MEMORY`` where the system can limit it; the message has the ``name`` of what
            it runs, and the ``advice``.
    """
    command = [sys.executable, "-P", "-c", _START, str(MAX_CAD_MEMORY), str(program), *arguments]
    try:
        ended = subprocess.run(
            command,
            capture_output=True,
            timeout=MAX_CAD_SECONDS,
            check=False,
            env={**os.environ, **_ONE_THREAD},
        )
    except subprocess.TimeoutExpired:
        raise ValueError(f"{name} took more than {MAX_CAD_SECONDS} seconds; {advice}") from None
    if ended.returncode == _OUT_OF_MEMORY or b"bad_alloc" in ended.stderr:
        raise ValueError(f"{name} needs more than {MAX_CAD_MEMORY:,} bytes of memory; {advice}")
    return ended.returncode == 0

"""Programs in a new process."""

import subprocess
import sys


def run_python(code, *words, **how):
    """The end of a process of Python with these words as its arguments."""
    command = [sys.executable, "-c", code, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=240, **how)

"""The stage of a single registration and its seconds, on one line of the terminal."""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

__all__ = ["show_stages"]

WORDS = {"detection": "detecting the object", "bank": "rendering views", "contours": "fitting contours"}
"""Stages that are called otherwise than in the library."""

INTERVAL = 0.5  # seconds between two updates


@contextmanager
def show_stages(*, enabled: bool) -> Iterator[Callable[[str, int, int], None] | None]:
    """A progress callback that shows stage, count and seconds on standard error; None if it is no terminal.

    The line is there from the first stage on, and removed at the end.
    """
    if not (enabled and sys.stderr.isatty()):
        yield None
        return
    stage, done, total, start = "", 0, 0, time.monotonic()
    ended = threading.Event()

    def report(now: str, count: int, of: int) -> None:
        nonlocal stage, done, total, start
        if now != stage:
            stage, start = now, time.monotonic()
        done, total = count, of

    def show() -> None:
        while not ended.wait(INTERVAL):
            if stage:
                count = f" {done} of {total}" if total > 1 else ""
                line = f"{WORDS.get(stage, stage)}{count}, {time.monotonic() - start:.0f} s"
                print(f"\r\033[K{line}", end="", file=sys.stderr, flush=True)

    thread = threading.Thread(target=show, daemon=True)
    thread.start()
    try:
        yield report
    finally:
        ended.set()
        thread.join()
        print("\r\033[K", end="", file=sys.stderr, flush=True)

"""Whether the time of a reader is linear in the size of its input."""

import gc
import math
import time
from contextlib import suppress

from curvireg_torch.errors import CurviregError

FACTOR = 4  # between the sizes; a quadratic reader takes 16 times as long
MOST = 9.0  # times as long, for that factor: linear, with some noise
SHORTEST = 0.005  # seconds of processor time of the smaller input that count


def check_linear(read, make, size):
    """Assert that ``read(make(4 * size))`` takes about four times as long as ``read(make(size))``.
    Errors of ours are results too."""
    small = math.inf
    large = math.inf
    for _ in range(3):  # again only where noise may have made the larger one slow
        content = make(size)
        small = min(small, _seconds(read, content), _seconds(read, content))
        large = min(large, _seconds(read, make(FACTOR * size)))
        if large < MOST * max(small, SHORTEST):
            return
    raise AssertionError(f"{small:.3f} s, and {large:.3f} s for {FACTOR} times the size")


def _seconds(read, content):
    gc.disable()  # what it takes depends on the tests before
    start = time.process_time()
    try:
        with suppress(CurviregError):
            read(content)
        return time.process_time() - start
    finally:
        gc.enable()

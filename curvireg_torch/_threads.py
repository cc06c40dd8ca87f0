"""Many small jobs on the threads that torch may use, each job on one of them."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import torch

__all__ = ["one_thread_each"]


@contextmanager
def one_thread_each() -> Iterator[ThreadPoolExecutor]:
    """A pool of ``torch.get_num_threads()`` threads, on each of which torch computes alone.

    Operations on a few images are too short to be shared among threads inside: waiting for each other then costs more
    than the work. An error, Ctrl-C among them, does not wait for jobs that have not begun.
    """
    threads = torch.get_num_threads()
    with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        try:
            yield pool
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
        finally:
            torch.set_num_threads(threads)  # some libraries underneath count for the whole process

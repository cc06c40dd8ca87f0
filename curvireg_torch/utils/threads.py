"""Many small jobs on the threads that torch may use, each job on one of them."""

import itertools
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

__all__ = ["available_threads", "for_each", "map_on_threads", "one_thread_each"]

Item = TypeVar("Item")
Result = TypeVar("Result")

_workers: tuple[int, ThreadPoolExecutor] | None = None
_here = threading.local()


def for_each(count: int, job: Callable[[int], object]) -> None:
    """Call ``job(0)`` to ``job(count - 1)`` on as many threads as torch may use; they are started once for the process.

    On a thread of :func:`one_thread_each`, and in a job, nothing is shared, unless :func:`map_on_threads` has threads
    to spare. For jobs that do not call torch. The first error ends all threads after their present job and is raised.
    """
    threads = min(available_threads(), count)
    numbers = itertools.count()
    stopped = False

    def work() -> None:
        nonlocal stopped
        _here.working = True
        try:
            while not stopped and (number := next(numbers)) < count:
                job(number)
        except BaseException:
            stopped = True
            raise

    if threads <= 1 or getattr(_here, "working", False):
        for number in range(count):
            job(number)
        return
    shared = [_pool().submit(work) for _ in range(threads)]
    try:
        for part in shared:
            part.result()
    finally:
        stopped = True  # also where this thread was interrupted while it waited


def _pool() -> ThreadPoolExecutor:
    """The process's threads for short jobs; a fork leaves them behind."""
    global _workers
    if _workers is None or _workers[0] != os.getpid():
        _workers = os.getpid(), ThreadPoolExecutor(max(os.cpu_count() or 1, torch.get_num_threads()))
    return _workers[1]


def available_threads() -> int:
    """Threads that a job may use here: those of torch, and on a thread of :func:`map_on_threads` those left over."""
    return max(getattr(_here, "threads", 1), torch.get_num_threads())


def map_on_threads(
    job: Callable[[Item], Result], items: Sequence[Item], *, device: torch.device | str = "cpu"
) -> list[Result]:
    """``job`` of every item, in their order, each on one thread on which torch computes alone.

    How torch divides an operation among threads decides how it rounds: a result that is computed by one thread does
    not depend on how many items there are, nor on how many threads torch may use. Threads that are left over, as with a
    single item, share the jobs of :func:`for_each`, which do not call torch.

    Args:
        device: where the jobs compute; on another than the CPU they follow each other on this thread.
    """
    threads = torch.get_num_threads()
    if threads == 1 or torch.device(device).type != "cpu":
        return [job(item) for item in items]
    share = max(1, threads // max(1, len(items)))

    def alone(item: Item) -> Result:
        _here.threads = share
        return job(item)

    with one_thread_each() as pool:
        return list(pool.map(alone, items))


@contextmanager
def one_thread_each() -> Iterator[ThreadPoolExecutor]:
    """A pool of :func:`available_threads` threads, on each of which torch computes alone.

    Operations on a few images are too short to be shared among threads inside: waiting for each other then costs more
    than the work. An error, Ctrl-C among them, does not wait for jobs that have not begun.
    """
    threads = torch.get_num_threads()
    with ThreadPoolExecutor(available_threads(), initializer=torch.set_num_threads, initargs=(1,)) as pool:
        try:
            yield pool
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
        finally:
            torch.set_num_threads(threads)  # some libraries underneath count for the whole process

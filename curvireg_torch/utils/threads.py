"""Many small jobs on as many threads as torch may use, up to a few, one job per thread."""

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

from .precision import full_precision

Item = TypeVar("Item")
Result = TypeVar("Result")

MAX_THREADS = 3
"""Jobs that run at a time. They share Python's interpreter lock: on 16 cores, two or three take
0.34 and 0.36 s a photograph, one takes 0.58, four 0.43, sixteen 0.60. Processes do not share it:
``--jobs`` of the commands."""

_this_thread = threading.local()
_threads_for_jobs = 1
# of the threads of a pool: meanwhile torch's number for the process is 1
_starting = threading.Lock()


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Within, torch computes on one thread in each job, and as many jobs run at a time as torch had
    threads before, up to ``MAX_THREADS``.

    Threads that divide an operation of torch all wait for the slowest, busily; threads with jobs of
    their own wait once, at the end. Commands compute like this; for its caller, a library changes
    nothing.

    Example:
        >>> with one_torch_thread():
        ...     torch.get_num_threads()
        1
    """
    global _threads_for_jobs
    threads = torch.get_num_threads()
    before = _threads_for_jobs
    _threads_for_jobs = available_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        _threads_for_jobs = before
        torch.set_num_threads(threads)


def for_each(count: int, job: Callable[[int], object]) -> None:
    """Call ``job(0)`` to ``job(count - 1)`` on :func:`available_threads`; jobs must not call torch.

    On threads of :func:`single_threaded_pool`, they run in sequence unless :func:`map_on_threads`
    left threads over. The first error stops all threads after their current job and is raised.
    """
    threads = min(available_threads(), count)
    if threads <= 1:
        for number in range(count):
            job(number)
        return
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(job, range(count)))


def available_threads() -> int:
    """Threads that jobs may use here, ``MAX_THREADS`` at most: those of torch or
    :func:`one_torch_thread`, in a job those left over."""
    return min(
        MAX_THREADS,
        max(getattr(_this_thread, "threads", _threads_for_jobs), torch.get_num_threads()),
    )


def map_on_threads(
    job: Callable[[Item], Result], items: Sequence[Item], *, device: torch.device | str = "cpu"
) -> list[Result]:
    """``job`` of every item, in order, on a CPU each on a thread on which torch computes
    single-threaded.

    There a result depends neither on the number of items nor on the number of threads, which would
    change its rounding. Threads that are left over help with :func:`for_each`. For other devices
    than the CPU, jobs run in sequence here. Autocast is off, as on a new thread.
    """
    threads = available_threads()
    if threads == 1 or torch.device(device).type != "cpu":
        with full_precision():
            return [job(item) for item in items]
    threads_each = max(1, threads // max(1, len(items)))
    with_gradients = torch.is_grad_enabled()
    for_inference = torch.is_inference_mode_enabled()

    def run(item: Item) -> Result:
        _this_thread.threads = threads_each
        # threads do not inherit them
        with torch.inference_mode(for_inference), torch.set_grad_enabled(with_gradients):
            return job(item)

    with single_threaded_pool() as pool:
        return list(pool.map(run, items))


@contextmanager
def single_threaded_pool() -> Iterator[ThreadPoolExecutor]:
    """A pool of :func:`available_threads`, on each of which torch computes single-threaded.

    Operations on a few images are too short to divide. After an error, jobs that have not started
    are cancelled.
    """
    workers = available_threads()
    with ThreadPoolExecutor(workers, initializer=_compute_single_threaded) as pool:
        try:
            _start(pool, workers)
            yield pool
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _start(pool: ThreadPoolExecutor, workers: int) -> None:
    """Start all threads of a pool, and let torch count threads for the process as before.

    A thread takes this number over with its first call of torch, and keeps it: those that the
    caller starts during the jobs would compute single-threaded ever after. One that starts in the
    moment before the number is set back still does.
    """
    with _starting:
        threads = _on_new_thread(torch.get_num_threads)
        started = threading.Barrier(workers + 1)
        try:
            for _ in range(workers):
                pool.submit(started.wait)
            started.wait()
        except BaseException:
            started.abort()  # a thread that cannot be started must not keep the others waiting
            raise
        finally:
            _on_new_thread(lambda: torch.set_num_threads(threads))


def _on_new_thread(function: Callable[[], Result]) -> Result:
    """The result of a function of a thread of its own: it reads and sets torch's number for the
    process, not the one that the calling thread has kept."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(function).result()


def _compute_single_threaded() -> None:
    _this_thread.threads = 1
    # a thread's first call takes over the number of the process, which is set back
    torch.get_num_threads()
    torch.set_num_threads(1)

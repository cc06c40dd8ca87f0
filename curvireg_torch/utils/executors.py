"""Blocks of tasks for the workers of a :class:`concurrent.futures.Executor`: processes of this
machine, or of a cluster."""

import os
import pickle
import signal
import threading
import traceback
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any, Generic, NamedTuple, TypeVar

from ..errors import CurviregWarning, InvalidInputError, WorkerError
from .extras import check_extras

Task = TypeVar("Task")
Result = TypeVar("Result")

MAX_ATTEMPTS = 3  # of a task: the first in its block, the others alone
MAX_GIVEN_UP = 5  # tasks in a row, from which the workers are at fault
BLOCKS_OF_A_PROCESS = 2  # one that it works on, and one that waits
SECONDS_TO_CONNECT = 10.0
BLOCKS_OF_A_CLUSTER = 256  # that wait or are worked on at a time
ENDED = (
    "workers: a process ended, perhaps for lack of memory; use fewer, and start them within "
    "'if __name__ == \"__main__\":'"
)


class Workers:
    """Workers that share blocks of tasks: ``count`` processes of this machine, which are started
    when they are needed, or those of an ``executor``.

    Processes are spawned, as threads and GPUs ask for: a script that starts them must do so within
    ``if __name__ == "__main__":``. They end with this one, however it ends. Tasks and results
    travel by pickle.

    Args:
        count: number of processes.
        executor: of another kind, such as ``distributed.Client(address).get_executor()``; it is not
            shut down.

    Example:
        >>> from concurrent.futures import ThreadPoolExecutor
        >>> with ThreadPoolExecutor(2) as executor:
        ...     doubled = Workers(executor=executor).map(_multiplied, 2, [[1, 2], [3]])
        ...     sorted(doubled)
        [(1, 2), (2, 4), (3, 6)]
    """

    def __init__(self, count: int = 1, executor: Executor | None = None) -> None:
        self.count = count
        self._executor = executor
        self._processes: _Processes | None = None
        self.generation = 0  # counts the processes that were started together
        if executor is not None and not callable(getattr(executor, "submit", None)):
            raise InvalidInputError(
                f"executor: expected a concurrent.futures.Executor, got {type(executor).__name__}; "
                f"that of a Dask client is client.get_executor()"
            )

    def map(
        self,
        function: Callable[[Any, Sequence[Task]], Sequence[Result]],
        state: object,
        blocks: Iterable[Sequence[Task]],
    ) -> Iterator[tuple[Task, Result | WorkerError]]:
        """Pairs of a task and its result, block by block as they are done.

        ``function(state, tasks)`` gives the results of a block; each worker gets ``state`` once.
        Blocks are taken from the iterable as workers become idle. What a worker was doing when it
        ended is done again, task by task without company, so that one which ends its workers does
        not cost others: its result is a :class:`.WorkerError`. A single process is this one.

        Raises:
            WorkerError: no worker has done anything, or none does any more.
            Exception: what ``function`` raised.
        """
        if self._executor is None and self.count == 1:
            for block in blocks:
                yield from zip(block, function(state, block), strict=True)
            return
        run = _Run(self, function, state)
        try:
            yield from run.results(iter(blocks))
        except BaseException:
            if self._executor is not None:  # a pool that ends reports on its futures itself
                run.cancel()
            self.end()  # what they are still working on belongs to no later call
            raise

    def submit(self, *arguments: Any) -> "Future[_Answer]":
        """Submit a block, to new processes if there are none."""
        if self._executor is not None:
            return self._executor.submit(_answer, *arguments)
        if self._processes is None:
            self._processes = _Processes(self.count)
            self.generation += 1
        return self._processes.submit(_answer, *arguments)

    @property
    def most_blocks(self) -> int:
        """Blocks that are submitted at a time."""
        return BLOCKS_OF_A_CLUSTER if self._executor else BLOCKS_OF_A_PROCESS * self.count

    def leave(self, generation: int) -> None:
        """Leave the processes of this generation, of which one has ended: the next block starts
        others."""
        if self._executor is not None:
            raise WorkerError("the workers of the executor ended; give another one")
        if generation == self.generation:
            self.end()

    def close(self) -> None:
        """Let processes end when they have done all that was submitted. They are started again if
        they are needed."""
        if self._processes is not None:
            self._processes.close()
            self._processes = None

    def end(self) -> None:
        """End processes at once."""
        if self._processes is not None:
            self._processes.end()
            self._processes = None

    def __reduce__(self) -> tuple[object, ...]:
        """A copy starts processes of its own; another executor is not copied."""
        return Workers, (self.count,)

    def __enter__(self) -> "Workers":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()
        else:
            self.end()

    def __del__(self) -> None:
        self.close()


@contextmanager
def opened_workers(count: int = 1, scheduler: str | None = None) -> Iterator[Workers]:
    """Context with ``count`` processes of this machine, or the workers of a Dask cluster by the
    address of its ``scheduler``, such as tcp://10.0.0.1:8786, which read files by the same paths.

    Raises:
        MissingDependencyError: a scheduler needs the extra "cluster".
        InvalidInputError: no scheduler answers.
    """
    if scheduler is None:
        with Workers(count) as workers:
            yield workers
        return
    check_extras(packages=["distributed"])
    from distributed import Client

    try:
        client = Client(scheduler, timeout=SECONDS_TO_CONNECT)
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InvalidInputError(
            f"no Dask scheduler answers ({reason}); start one by 'dask scheduler'",
            subject=scheduler,
        ) from error
    with client:
        yield Workers(executor=client.get_executor())


class _Processes:
    """A pool of processes that end with this one.

    Each watches a pipe that only this process holds open: it closes with the process, whatever
    signal that ends by.
    """

    def __init__(self, count: int) -> None:
        context = get_context("spawn")
        there, self._here = context.Pipe(duplex=False)
        self._pool = ProcessPoolExecutor(count, context, _begin_work, (there,))

    def submit(self, function: Callable[..., Result], *arguments: Any) -> "Future[Result]":
        with _as_workers_start():
            return self._pool.submit(function, *arguments)

    def close(self) -> None:
        self._pool.shutdown()
        self._here.close()

    def end(self) -> None:
        self._here.close()
        self._pool.shutdown(wait=False, cancel_futures=True)


@contextmanager
def _as_workers_start() -> Iterator[None]:
    """Context in which processes start that leave Ctrl-C in their terminal to this one, and compute
    on one thread each."""
    can_block = hasattr(signal, "pthread_sigmask")  # not on Windows
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT]) if can_block else set()
    is_given = "OMP_NUM_THREADS" in os.environ
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    try:
        yield
    finally:
        if not is_given:
            del os.environ["OMP_NUM_THREADS"]
        if can_block:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin_work(alive: Connection) -> None:
    """Prepare a new process: an end when the other end of the pipe closes, no Ctrl-C, and one
    thread."""

    def watch() -> None:
        with suppress(EOFError, OSError):
            alive.recv_bytes()
        os._exit(1)

    # before torch is imported, which takes seconds
    threading.Thread(target=watch, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    import torch

    torch.set_num_threads(1)


@dataclass
class _Block(Generic[Task]):
    """Tasks that are done together, and how often they were tried before."""

    tasks: Sequence[Task]
    attempts: int = 0
    generation: int = 0  # of the workers that have it


class _Run(Generic[Task, Result]):
    """One call of :meth:`Workers.map`."""

    def __init__(
        self,
        workers: Workers,
        function: Callable[[Any, Sequence[Task]], Sequence[Result]],
        state: object,
    ) -> None:
        self._workers = workers
        self._function = function
        self._content = pickle.dumps(state)
        self._key = os.urandom(16)
        self._running: dict[Future[_Answer], _Block[Task]] = {}
        self._suspects: deque[_Block[Task]] = deque()
        self._has_done_some = False
        self._given_up = 0  # tasks since a block was done

    def results(
        self, blocks: Iterator[Sequence[Task]]
    ) -> Iterator[tuple[Task, Result | WorkerError]]:
        is_more = True
        while True:
            while is_more and not self._suspects and len(self._running) < self._workers.most_blocks:
                tasks = next(blocks, None)
                if tasks is None:
                    is_more = False
                else:
                    self._submit(_Block(tasks))
            if self._suspects and not self._running:
                self._submit(self._suspects.popleft())
            if not self._running:
                return
            done, _ = wait(self._running, return_when=FIRST_COMPLETED)
            for future in done:
                yield from self._of_block(future, self._running.pop(future))

    def cancel(self) -> None:
        """Cancel what has not begun."""
        for future in self._running:
            future.cancel()

    def _submit(self, block: _Block[Task], content: bytes | None = None) -> None:
        arguments = self._key, content, self._function, block.tasks
        try:
            future = self._workers.submit(*arguments)
        except RuntimeError:  # an idle worker ended, or the executor was shut down
            self._workers.leave(self._workers.generation)
            future = self._workers.submit(*arguments)
        block.generation = self._workers.generation
        self._running[future] = block

    def _of_block(
        self, future: "Future[_Answer]", block: _Block[Task]
    ) -> Iterator[tuple[Task, Result | WorkerError]]:
        try:
            answer = future.result()
        except Exception as error:  # of the worker: those of the function are in its answer
            yield from self._of_lost(error, block)
            return
        if answer.lacks_state:
            self._submit(block, self._content)
            return
        self._has_done_some = True
        self._given_up = 0
        for category, text in answer.warnings:
            warnings.warn(text, category, stacklevel=2)
        if answer.error is not None:
            raise answer.error
        yield from zip(block.tasks, answer.results, strict=True)

    def _of_lost(
        self, error: Exception, block: _Block[Task]
    ) -> Iterator[tuple[Task, Result | WorkerError]]:
        """Tasks that have been tried too often, with the error; the others are tried again."""
        text = f"workers: {type(error).__name__}: {error}"
        if isinstance(error, BrokenExecutor):
            text = ENDED
            self._workers.leave(block.generation)
        attempts = block.attempts + 1
        for task in block.tasks:
            if attempts < MAX_ATTEMPTS:
                self._suspects.append(_Block([task], attempts))
                continue
            self._given_up += 1
            if not self._has_done_some or self._given_up == MAX_GIVEN_UP:
                raise WorkerError(text) from error
            yield task, WorkerError(text)


class _Answer(NamedTuple):
    """What a worker sends back."""

    results: Sequence[Any] = ()
    warnings: Sequence[tuple[type[Warning], str]] = ()
    error: Exception | None = None  # that the function raised
    lacks_state: bool = False


_states: dict[bytes, Any] = {}
"""In a worker: the state of the latest run."""


def _answer(
    key: bytes,
    content: bytes | None,
    function: Callable[[Any, Sequence[Any]], Sequence[Any]],
    tasks: Sequence[Any],
) -> _Answer:
    """Do a block in a worker."""
    if key not in _states:
        if content is None:
            return _Answer(lacks_state=True)
        _states.clear()
        _states[key] = pickle.loads(content)
    state = _states[key]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            results = function(state, tasks)
            error = None
        except Exception as raised:  # it is raised where the tasks came from
            raised.add_note(traceback.format_exc())
            results = ()
            error = raised
    ours = [
        (one.category, str(one.message))
        for one in caught
        if one.category is UserWarning or issubclass(one.category, CurviregWarning)
    ]
    return _Answer(results, ours, error)


def _multiplied(factor: int, numbers: Sequence[int]) -> list[int]:
    """An example of a function for :meth:`Workers.map`."""
    return [factor * number for number in numbers]

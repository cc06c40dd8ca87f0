"""Photographs registered by several processes, which do not share Python's interpreter lock."""

import multiprocessing
import pickle
import weakref
from collections.abc import Sequence
from copy import copy
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, Protocol, TypeVar

import torch

from ..errors import CurviregError, WorkerError
from .inputs import ImageItem
from .result import FailedRegistration, Registration

# attributes of a registrar that follow from the others
COMPUTED = (
    "describer",
    "detector",
    "mesh_warnings",
    "telling_symmetries",
    "_keypoints",
    "_mirror_image",
    "_workers",
)
SECONDS_TO_END = 20.0  # within which a process stores the features of views that it has described
ENDED = (
    "workers: a process ended, perhaps for lack of memory; use fewer, and start them within "
    "'if __name__ == \"__main__\":'"
)

Results = list[Registration | FailedRegistration]


class RegistersItems(Protocol):
    """What a process needs of a :class:`.Registrar`."""

    @property
    def others(self) -> Sequence[Any]:
        """Registrars of further meshes."""

    def register_items(
        self, items: Sequence[ImageItem | CurviregError], *, detects: bool = False
    ) -> list[Registration | FailedRegistration]:
        """See :meth:`.Registrar.register_items`."""


Copied = TypeVar("Copied", bound=RegistersItems)


class Workers:
    """Processes that hold a copy of a registrar each, until they are closed or forgotten.

    They are spawned, as threads and GPUs ask for: a script that starts them must do so within ``if
    __name__ == "__main__":``. Inputs and results travel by pickle, as bytes.

    Args:
        registrar: what is copied to each process.
        count: of processes.
    """

    def __init__(self, registrar: RegistersItems, count: int) -> None:
        context = multiprocessing.get_context("spawn")
        content = pickle.dumps(_without_renderers(registrar))
        self._connections: list[Connection] = []
        processes: list[BaseProcess] = []
        self.close = weakref.finalize(self, _end, processes, self._connections)
        for _ in range(count):
            here, there = context.Pipe()
            process = context.Process(target=_work, args=(there,), daemon=True)
            process.start()
            there.close()
            processes.append(process)
            self._connections.append(here)
        for connection in self._connections:
            _send(connection, content)

    @property
    def are_open(self) -> bool:
        """Whether the processes were not closed, by an error or by :attr:`close`."""
        return bool(self.close.alive)

    def register(self, items: Sequence[ImageItem | CurviregError], *, detects: bool) -> Results:
        """:meth:`.Registrar.register_items`; each process has one photograph at a time."""
        results: dict[int, Any] = {}
        waiting = list(range(len(items)))[::-1]
        working: dict[Connection, int] = {}
        idle = list(self._connections)
        try:
            while waiting or working:
                while waiting and idle:
                    index = waiting.pop()
                    connection = idle.pop()
                    _send(connection, pickle.dumps((items[index], index, detects)))
                    working[connection] = index
                for ready in wait(list(working)):
                    assert isinstance(ready, Connection)
                    result = pickle.loads(ready.recv_bytes())
                    results[working.pop(ready)] = result
                    idle.append(ready)
        except EOFError as error:
            self.close()
            raise WorkerError(ENDED) from error
        except BaseException:  # what they are still working on belongs to no later call
            self.close()
            raise
        for result in results.values():
            if isinstance(result, BaseException):
                raise result
        return [results[index] for index in range(len(items))]


def _send(connection: Connection, content: bytes) -> None:
    try:
        connection.send_bytes(content)
    except OSError as error:  # the other end is closed
        raise WorkerError(ENDED) from error


def _end(processes: Sequence[BaseProcess], connections: Sequence[Connection]) -> None:
    """Let processes end by themselves, or end them."""
    for connection in connections:
        connection.close()
    for process in processes:
        process.join(SECONDS_TO_END)
        if process.is_alive():
            process.terminate()


def _without_renderers(registrar: Copied) -> Copied:
    """A copy without what is computed from the rest, and cannot be pickled."""
    other: Any = copy(registrar)
    for name in COMPUTED:
        other.__dict__.pop(name, None)
    other.progress = False
    other.workers = 1
    other.others = [_without_renderers(one) for one in registrar.others]
    copied: Copied = other
    return copied


def _work(connection: Connection) -> None:
    """Register photographs until the connection is closed."""
    torch.set_num_threads(1)
    try:
        registrar: RegistersItems = pickle.loads(connection.recv_bytes())
        while True:
            item, index, detects = pickle.loads(connection.recv_bytes())
            connection.send_bytes(pickle.dumps(_result(registrar, item, index, detects)))
    except (EOFError, OSError):  # no more photographs
        return


def _result(
    registrar: RegistersItems, item: ImageItem | CurviregError, index: int, detects: bool
) -> Registration | FailedRegistration | Exception:
    try:
        result = registrar.register_items([item], detects=detects)[0]
    except Exception as error:  # raised where the photographs came from
        return error
    if isinstance(result, FailedRegistration) and isinstance(item, ImageItem):
        return FailedRegistration(result.error.of_image(index))
    return result

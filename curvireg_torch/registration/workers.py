"""Photographs registered by the workers of an executor, which do not share Python's interpreter
lock."""

from collections.abc import Sequence
from copy import copy
from typing import Any, NamedTuple, Protocol, TypeVar

from ..errors import CurviregError, WorkerError
from ..utils.executors import Workers
from .inputs import ImageItem
from .result import FailedRegistration, Registration

MAX_BLOCK = 8  # photographs that a worker gets at a time

Results = list[Registration | FailedRegistration]


class RegistersItems(Protocol):
    """What a worker needs of a :class:`.Registrar`."""

    @property
    def others(self) -> Sequence[Any]:
        """Registrars of further meshes."""

    def register_items(
        self, items: Sequence[ImageItem | CurviregError], *, detects: bool = False
    ) -> list[Registration | FailedRegistration]:
        """See :meth:`.Registrar.register_items`."""


Copied = TypeVar("Copied", bound=RegistersItems)


class _Task(NamedTuple):
    """A photograph, by its number in the call."""

    number: int
    item: ImageItem | CurviregError
    detects: bool


def register_by_workers(
    registrar: RegistersItems,
    workers: Workers,
    items: Sequence[ImageItem | CurviregError],
    *,
    detects: bool,
) -> Results:
    """:meth:`.Registrar.register_items` by workers, which get a copy of the registrar each; a
    photograph that ends them fails."""
    tasks = [_Task(number, item, detects) for number, item in enumerate(items)]
    size = max(1, min(MAX_BLOCK, len(tasks) // (2 * workers.count)))
    blocks = (tasks[start : start + size] for start in range(0, len(tasks), size))
    found: dict[int, Registration | FailedRegistration] = {}
    for task, result in workers.map(_register_block, _quiet_copy(registrar), blocks):
        if isinstance(result, WorkerError):
            found[task.number] = FailedRegistration(result.of_image(task.number))
        else:
            found[task.number] = result
    return [found[number] for number in range(len(items))]


def _register_block(registrar: RegistersItems, tasks: Sequence[_Task]) -> Results:
    """The results of a block, whose errors name the number of the photograph in the call."""
    items = [task.item for task in tasks]
    results = registrar.register_items(items, detects=tasks[0].detects)
    return [
        FailedRegistration(result.error.of_image(task.number))
        if isinstance(result, FailedRegistration) and isinstance(task.item, ImageItem)
        else result
        for task, result in zip(tasks, results, strict=True)
    ]


def _quiet_copy(registrar: Copied) -> Copied:
    """A copy that shows no progress and has no workers of its own."""
    other: Any = copy(registrar)
    other.progress = False
    other.workers = None
    other.others = [_quiet_copy(one) for one in registrar.others]
    copied: Copied = other
    return copied

"""Jobs that compute together what several of them need: for devices that are fast with many inputs
at a time, and slow with few."""

import threading
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar, cast

import torch

from .precision import full_precision
from .threads import single_threaded_pool

Item = TypeVar("Item")
Request = TypeVar("Request")
Result = TypeVar("Result")

JOBS_TOGETHER = 64

_this_thread = threading.local()


def compute_together(
    function: Callable[[Sequence[Request]], Sequence[Result]], request: Request
) -> Result:
    """The result of ``function``, which computes those of several requests at a time, for one
    request; within :func:`map_in_company`, for the requests of all jobs at once."""
    company: _Company | None = getattr(_this_thread, "company", None)
    if company is None:
        return function([request])[0]
    return cast(Result, company.result(function, request))


def by_key(
    requests: Sequence[Request],
    key: Callable[[Request], Hashable],
    function: Callable[[Sequence[Request]], Sequence[Result]],
) -> list[Result]:
    """Results of ``function``, which computes those of requests of the same ``key`` together, in
    the order of the requests."""
    groups: dict[Hashable, list[int]] = {}
    for number, request in enumerate(requests):
        groups.setdefault(key(request), []).append(number)
    results: dict[int, Result] = {}
    for numbers in groups.values():
        found = function([requests[number] for number in numbers])
        results.update(zip(numbers, found, strict=True))
    return [results[number] for number in range(len(requests))]


def map_in_company(job: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """``job`` of every item, in order, ``JOBS_TOGETHER`` at a time, each on a thread of its own.

    Where all jobs that have not ended wait for :func:`compute_together`, what they wait for is
    computed at once, on the thread of the caller: cuDNN chooses its kernels again for each thread,
    which takes longer than they do. Within a job, items follow each other.
    """
    if getattr(_this_thread, "company", None) is not None:
        return [job(item) for item in items]
    with_gradients = torch.is_grad_enabled()
    results: list[Result] = []
    for start in range(0, len(items), JOBS_TOGETHER):
        some = [items[k] for k in range(start, min(start + JOBS_TOGETHER, len(items)))]
        company = _Company(len(some))

        def run(item: Item, company: _Company = company) -> Result:
            with torch.set_grad_enabled(with_gradients), full_precision():
                _this_thread.company = company
                try:
                    return job(item)
                finally:
                    _this_thread.company = None
                    company.leave()

        with single_threaded_pool(len(some)) as pool:
            running = pool.map(run, some)
            with full_precision():
                company.serve()
            results += running
    return results


@dataclass
class _Place:
    """What one job waits for, and then its result or error."""

    function: Callable[[Sequence[Any]], Sequence[Any]]
    request: Any
    is_done: bool = False
    result: Any = None
    error: Exception | None = None


class _Company:
    """Jobs that wait until :meth:`serve` computes for all."""

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs
        self._waiting: list[_Place] = []
        self._changed = threading.Condition()
        self._failure: BaseException | None = None

    def result(self, function: Callable[[Sequence[Any]], Sequence[Any]], request: Any) -> Any:
        place = _Place(function, request)
        with self._changed:
            self._waiting.append(place)
            self._changed.notify_all()
            self._changed.wait_for(lambda: place.is_done or self._failure is not None)
        if self._failure is not None:
            raise self._failure
        if place.error is not None:
            raise place.error
        return place.result

    def leave(self) -> None:
        with self._changed:
            self._jobs -= 1
            self._changed.notify_all()

    def serve(self) -> None:
        """Compute, each time when all jobs wait, until they have ended; if this is interrupted,
        they are too."""
        with self._changed:
            try:
                while self._jobs:
                    self._changed.wait_for(lambda: len(self._waiting) >= self._jobs)
                    by_key(self._waiting, lambda place: place.function, _compute)
                    self._waiting = []
                    self._changed.notify_all()
            except BaseException as failure:
                self._failure = failure
                self._changed.notify_all()
                raise


def _compute(places: Sequence[_Place]) -> Sequence[_Place]:
    """Compute for places of one function; where that fails, for each alone, so that an error is
    that of its own job."""
    try:
        results = places[0].function([place.request for place in places])
    except Exception as error:  # an interrupt is for the caller
        if len(places) == 1:
            places[0].error = error
            places[0].is_done = True
            return places
        for place in places:
            _compute([place])
        return places
    for place, result in zip(places, results, strict=True):
        place.result = result
        place.is_done = True
    return places

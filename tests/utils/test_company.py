import threading

import pytest
import torch

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.utils import company
from curvireg_torch.utils.company import by_key, compute_together, map_in_company


class Doubling:
    """Doubles numbers, and remembers how many came together."""

    def __init__(self):
        self.batches = []

    def __call__(self, requests):
        self.batches.append(len(requests))
        if any(request < 0 for request in requests):
            raise InvalidInputError(f"negative among {len(requests)}")
        return [2 * request for request in requests]


def test_what_jobs_need_is_computed_together():
    double = Doubling()

    def job(x):
        for _ in range(x):
            x = compute_together(double, x)
        return x

    assert map_in_company(job, [1, 2, 0, 3]) == [2, 8, 0, 24]
    assert double.batches == [3, 2, 1]


def test_alone_a_request_is_computed_by_itself():
    double = Doubling()
    assert compute_together(double, 4) == 8
    assert double.batches == [1]


def test_different_functions_are_computed_apart():
    first = Doubling()
    second = Doubling()
    found = map_in_company(lambda x: compute_together(first if x % 2 else second, x), range(6))
    assert found == [0, 2, 4, 6, 8, 10]
    assert first.batches == second.batches == [3]


def test_an_error_is_that_of_its_own_job():
    double = Doubling()

    def job(x):
        try:
            return compute_together(double, x)
        except InvalidInputError as error:
            return str(error)

    assert map_in_company(job, [1, -1, 2]) == [2, "negative among 1", 4]


def test_an_error_of_a_job_does_not_keep_the_others_waiting():
    def job(x):
        if x == 1:
            raise RuntimeError("stop")
        return compute_together(Doubling(), x)

    with pytest.raises(RuntimeError, match="stop"):
        map_in_company(job, range(4))


def test_who_leaves_last_computes_without_gradients():
    def gradients(requests):
        return [torch.is_grad_enabled() for _ in requests]

    def job(x):
        if x == 0:
            while not waiting.wait(0.01):
                pass
            return None
        waiting.set()
        return compute_together(gradients, x)

    waiting = threading.Event()
    with torch.no_grad():
        assert map_in_company(job, range(3)) == [None, False, False]


def test_jobs_of_a_job_follow_each_other():
    def job(x):
        thread = threading.get_ident()
        inner = map_in_company(lambda y: (threading.get_ident(), x + y), range(3))
        assert {ident for ident, _ in inner} == {thread}
        return [number for _, number in inner]

    assert map_in_company(job, [10, 20]) == [[10, 11, 12], [20, 21, 22]]


def test_few_jobs_run_at_a_time(monkeypatch):
    monkeypatch.setattr(company, "JOBS_TOGETHER", 2)
    double = Doubling()
    with torch.no_grad():
        found = map_in_company(
            lambda x: (compute_together(double, x), torch.is_grad_enabled()), range(5)
        )
    assert found == [(2 * x, False) for x in range(5)]
    assert double.batches == [2, 2, 1]
    assert map_in_company(lambda x: x, []) == []


def test_requests_of_a_key_are_computed_together():
    found = by_key(range(7), lambda x: x % 3, lambda some: [(x, len(some)) for x in some])
    assert found == [(0, 3), (1, 2), (2, 2), (3, 3), (4, 2), (5, 2), (6, 3)]


def test_the_caller_computes_for_all():
    """cuDNN chooses kernels for each thread anew."""
    threads = set()

    def where(requests):
        threads.add(threading.current_thread())
        return requests

    for _ in range(3):
        assert map_in_company(lambda x: compute_together(where, x), range(4)) == [0, 1, 2, 3]
    assert threads == {threading.current_thread()}


@pytest.mark.parametrize("jobs", [1, 3])
def test_an_interrupt_while_several_are_computed_is_no_error_of_one_of_them(jobs):
    """Ctrl-C comes once, wherever the caller is."""
    calls = []

    def interrupted(requests):
        calls.append(len(requests))
        if len(calls) == 1:
            raise KeyboardInterrupt
        return requests

    with pytest.raises(KeyboardInterrupt):
        map_in_company(lambda x: compute_together(interrupted, x), range(jobs))
    assert calls == [jobs]


def test_an_interrupted_caller_ends_its_jobs(monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(company, "_compute", interrupted)
    with pytest.raises(KeyboardInterrupt):
        map_in_company(lambda x: compute_together(Doubling(), x), range(3))

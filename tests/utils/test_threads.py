import threading
import time
from collections.abc import Callable

import pytest
import torch

from curvireg_torch.utils import threads


@pytest.fixture(autouse=True)
def _two_threads(threads: Callable[[int], None]) -> None:
    threads(2)


def test_for_each_runs_every_job_once_and_two_at_a_time() -> None:
    both = threading.Barrier(2, timeout=20)  # times out unless two jobs run at the same time
    done: list[int] = []

    def job(number: int) -> None:
        both.wait()
        done.append(number)

    for _ in range(3):
        done.clear()
        threads.for_each(6, job)
        assert sorted(done) == list(range(6))


def test_for_each_stops_at_an_error_and_raises_it() -> None:
    done = []

    def job(number: int) -> None:
        if number == 2:
            raise ValueError("two")
        time.sleep(1e-4)
        done.append(number)

    with pytest.raises(ValueError, match="two"):
        threads.for_each(20_000, job)
    assert len(done) < 19_999
    threads.for_each(2, done.append)  # the threads survive


def test_map_on_threads_keeps_the_order_on_single_threads() -> None:
    def job(number: int) -> tuple[int, int, int]:
        return number, torch.get_num_threads(), threading.get_ident()

    out = threads.map_on_threads(job, range(5))
    assert [number for number, *_ in out] == list(range(5))
    assert {threads for _, threads, _ in out} == {1}
    assert threading.get_ident() not in {thread for *_, thread in out}
    assert torch.get_num_threads() == 2
    assert threads.map_on_threads(job, []) == []


def test_jobs_share_few_threads_on_many_cores() -> None:
    torch.set_num_threads(16)  # the fixture undoes it
    assert threads.available_threads() == threads.MAX_THREADS
    names = threads.map_on_threads(lambda _: (time.sleep(0.01), threading.get_ident())[1], range(16))
    assert len(set(names)) <= threads.MAX_THREADS


def test_one_torch_thread_gives_the_threads_of_torch_to_jobs() -> None:
    both = threading.Barrier(2, timeout=20)  # times out unless two jobs run at the same time

    def threads_in_job(_: int) -> tuple[int, int]:
        both.wait()
        return torch.get_num_threads(), threads.available_threads()

    assert (torch.get_num_threads(), threads.available_threads()) == (2, 2)
    with threads.one_torch_thread(), threads.one_torch_thread():
        assert (torch.get_num_threads(), threads.available_threads()) == (1, 2)
        threads.for_each(2, lambda _: both.wait())
        assert threads.map_on_threads(threads_in_job, [0, 1]) == [(1, 1)] * 2
        assert threads.map_on_threads(lambda _: (torch.get_num_threads(), threads.available_threads()), [0]) == [(1, 2)]
        with threads.single_threaded_pool() as pool:
            assert list(pool.map(threads_in_job, [0, 1])) == [(1, 1)] * 2
        assert (torch.get_num_threads(), threads.available_threads()) == (1, 2)
    assert (torch.get_num_threads(), threads.available_threads()) == (2, 2)
    torch.set_num_threads(1)
    assert threads.available_threads() == 1, "outside, the setting of the caller holds"

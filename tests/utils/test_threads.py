"""Jobs shared among the process's threads."""

import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from curvireg_torch.utils.threads import for_each, map_on_threads, single_threaded_pool


@pytest.fixture(autouse=True)
def two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_every_job_once_and_two_at_a_time() -> None:
    both = threading.Barrier(2, timeout=20)  # broken, unless two jobs run at the same time
    done: list[int] = []

    def job(number: int) -> None:
        both.wait()
        done.append(number)

    for _ in range(3):
        done.clear()
        for_each(6, job)
        assert sorted(done) == list(range(6))


def test_threads_are_started_once() -> None:
    seen = set()
    for _ in range(20):
        for_each(4, lambda _: seen.add(threading.get_ident()))
    assert 1 <= len(seen) <= max(2, os.cpu_count() or 1)
    assert threading.get_ident() not in seen


def test_where_torch_computes_alone_nothing_is_shared() -> None:
    here = []
    with single_threaded_pool() as pool:
        pool.submit(for_each, 3, lambda _: here.append(threading.get_ident())).result()
        mine = pool.submit(threading.get_ident)
        mine.result()
    assert len(set(here)) == 1
    torch.set_num_threads(1)
    for_each(2, lambda _: here.append(threading.get_ident()))
    assert here[3:] == [threading.get_ident()] * 2


def test_jobs_that_share_jobs_end() -> None:
    # Every thread waiting for others that never get one: that must not be.
    done = []
    for_each(40, lambda i: for_each(3, lambda k: done.append((i, k))))
    assert sorted(done) == [(i, k) for i in range(40) for k in range(3)]


def test_an_error_stops_and_is_raised() -> None:
    done = []

    def job(number: int) -> None:
        if number == 2:
            raise ValueError("two")
        done.append(number)

    with pytest.raises(ValueError, match="two"):
        for_each(100_000, job)
    assert len(done) < 99_999
    for_each(2, done.append)  # the threads live on


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_forked_process_starts_its_own() -> None:
    for_each(4, lambda _: None)
    child = os.fork()
    if child == 0:
        done: list[int] = []
        for_each(4, done.append)
        os._exit(0 if sorted(done) == [0, 1, 2, 3] else 1)
    for _ in range(200):
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            break
        threading.Event().wait(0.1)
    else:
        os.kill(child, 9)
        os.waitpid(child, 0)
        pytest.fail("the child hangs")
    assert os.waitstatus_to_exitcode(status) == 0


def test_the_process_has_its_threads_back_afterwards(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a library underneath counts threads for the whole process, a worker's one thread is everybody's."""
    threads = [2]
    monkeypatch.setattr(torch, "set_num_threads", lambda n: threads.__setitem__(0, n))
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads[0])
    with single_threaded_pool() as pool:
        pool.submit(threading.get_ident).result()
        assert threads == [1]
    assert threads == [2]


def test_the_process_has_its_threads_back_after_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr(torch, "set_num_threads", asked.append)

    def failing(pool: ThreadPoolExecutor) -> None:
        pool.submit(threading.get_ident).result()
        raise ValueError("within")

    with pytest.raises(ValueError, match="within"):
        with_pool(failing)
    assert asked == [1, 2]


def with_pool(job: Callable[[ThreadPoolExecutor], None]) -> None:
    with single_threaded_pool() as pool:
        job(pool)


def test_mapped_jobs_keep_their_order_and_each_has_one_thread_of_torch() -> None:
    def job(number: int) -> tuple[int, int, int]:
        return number, torch.get_num_threads(), threading.get_ident()

    out = map_on_threads(job, range(5))
    assert [number for number, *_ in out] == list(range(5))
    assert {threads for _, threads, _ in out} == {1}
    assert threading.get_ident() not in {thread for *_, thread in out}
    assert torch.get_num_threads() == 2
    assert map_on_threads(job, []) == []


def test_a_single_mapped_job_shares_its_rays_among_the_threads_that_are_left() -> None:
    both = threading.Barrier(2, timeout=20)
    assert map_on_threads(lambda _: for_each(2, lambda _: both.wait()), [0]) == [None]
    here: list[tuple[int, int]] = []

    def job(_: int) -> None:
        mine = threading.get_ident()
        for_each(3, lambda _: here.append((mine, threading.get_ident())))

    map_on_threads(job, [0, 1])
    assert len(here) == 6
    assert all(mine == other for mine, other in here), "with two jobs no thread is left over"


def test_an_error_in_a_mapped_job_is_raised_and_threads_are_restored() -> None:
    def job(number: int) -> None:
        raise ValueError(f"job {number}")

    with pytest.raises(ValueError, match="job 0"):
        map_on_threads(job, [0, 1, 2])
    assert torch.get_num_threads() == 2

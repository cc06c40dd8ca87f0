import threading
import time

import pytest
import torch

from curvireg_torch.utils import threads


@pytest.fixture(autouse=True)
def _two_threads(threads):
    threads(2)


def test_for_each_runs_every_job_once_and_two_at_a_time():
    both = threading.Barrier(2, timeout=20)  # times out unless two jobs run at the same time
    done = []

    def job(number):
        both.wait()
        done.append(number)

    for _ in range(3):
        done.clear()
        threads.for_each(6, job)
        assert sorted(done) == list(range(6))


def test_map_on_threads_keeps_the_order_on_single_threads():
    def job(number):
        return number, torch.get_num_threads(), threading.get_ident()

    out = threads.map_on_threads(job, range(5))
    assert [number for number, *_ in out] == list(range(5))
    assert {threads for _, threads, _ in out} == {1}
    assert threading.get_ident() not in {thread for *_, thread in out}
    assert torch.get_num_threads() == 2
    assert threads.map_on_threads(job, []) == []


def test_threads_that_start_during_jobs_keep_the_number_of_the_process():
    """A thread takes torch's number for the process over with its first call of torch, and keeps
    it."""
    found = []

    def on_a_new_thread():
        thread = threading.Thread(target=lambda: found.append(torch.get_num_threads()))
        with threads._starting:  # not while another job starts a pool
            thread.start()
            thread.join()

    def job(level):
        on_a_new_thread()
        if level:  # pools within jobs
            with threads.single_threaded_pool() as pool:
                assert list(pool.map(job, [level - 1, level - 1])) == [1, 1]
            on_a_new_thread()
        return torch.get_num_threads()

    assert threads.map_on_threads(job, [2, 0, 1]) == [1, 1, 1]
    on_a_new_thread()
    assert set(found) == {2}
    assert torch.get_num_threads() == 2


def test_the_caller_keeps_a_number_of_its_own():
    """Not the one that another thread set for the process since."""
    thread = threading.Thread(target=lambda: torch.set_num_threads(3))
    thread.start()
    thread.join()
    assert set(threads.map_on_threads(lambda _: torch.get_num_threads(), range(4))) == {1}
    assert torch.get_num_threads() == 2


def test_a_pool_whose_threads_cannot_start_fails_at_once(monkeypatch):
    start = threading.Thread.start
    calls = []

    def refuse_the_third(thread):
        calls.append(thread)
        if len(calls) == 3:  # the second of the pool, after the one that reads torch's number
            raise RuntimeError("can't start new thread")
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", refuse_the_third)
    with pytest.raises(RuntimeError, match="can't start"):
        threads.map_on_threads(lambda number: number, range(2))
    monkeypatch.undo()
    assert threads.map_on_threads(lambda _: torch.get_num_threads(), range(2)) == [1, 1]
    assert torch.get_num_threads() == 2


def fail_after_submission(count, job):
    with threads.single_threaded_pool() as pool:
        for number in range(1, count):
            pool.submit(job, number)
        job(0)


def mapped(count, job):
    threads.map_on_threads(job, range(count))


@pytest.mark.parametrize("run", [threads.for_each, mapped, fail_after_submission])
def test_jobs_that_have_not_started_are_cancelled_after_an_error(run):
    done = []

    def job(number):
        if number == 0:
            raise ValueError("zero")
        time.sleep(0.01)
        done.append(number)

    with pytest.raises(ValueError, match="zero"):
        run(200, job)
    assert len(done) < 100


@pytest.mark.parametrize("mode", [torch.enable_grad, torch.no_grad, torch.inference_mode])
def test_jobs_record_gradients_as_their_caller_does(mode):
    with mode():
        changed = torch.zeros(3)
        modes = torch.is_grad_enabled(), torch.is_inference_mode_enabled()

        def job(item):
            changed[item] = 1.0  # of inference: in inference mode only
            return torch.is_grad_enabled(), torch.is_inference_mode_enabled()

        assert threads.map_on_threads(job, range(3)) == [modes] * 3


def test_jobs_share_few_threads_on_many_cores():
    torch.set_num_threads(16)  # the fixture undoes it
    assert threads.available_threads() == threads.MAX_THREADS
    names = threads.map_on_threads(
        lambda _: (time.sleep(0.01), threading.get_ident())[1], range(16)
    )
    assert len(set(names)) <= threads.MAX_THREADS


def numbers(_=None):
    """Of the threads of torch, and of those for jobs."""
    return torch.get_num_threads(), threads.available_threads()


def test_one_torch_thread_gives_the_threads_of_torch_to_jobs():
    both = threading.Barrier(2, timeout=20)  # times out unless two jobs run at the same time

    def numbers_together(_):
        both.wait()
        return numbers()

    assert numbers() == (2, 2)
    with threads.one_torch_thread(), threads.one_torch_thread():
        assert numbers() == (1, 2)
        threads.for_each(2, numbers_together)
        assert threads.map_on_threads(numbers_together, [0, 1]) == [(1, 1)] * 2
        assert threads.map_on_threads(numbers, [0]) == [(1, 2)]
        with threads.single_threaded_pool() as pool:
            assert list(pool.map(numbers_together, [0, 1])) == [(1, 1)] * 2
        assert numbers() == (1, 2)
    assert numbers() == (2, 2)
    torch.set_num_threads(1)
    assert threads.available_threads() == 1, "outside, the setting of the caller holds"

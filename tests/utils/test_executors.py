"""Blocks of tasks and the workers that do them: none is lost, none done for nothing."""

import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from pathlib import Path

import pytest

from curvireg_torch.errors import CurviregWarning, InvalidInputError, WorkerError
from curvireg_torch.utils import executors
from curvireg_torch.utils.executors import Workers, opened_workers

REPOSITORY = Path(__file__).parents[2]


def doubled(state, tasks):
    """Twice each task; a negative one ends the process of the worker."""
    if min(tasks) < 0 and os.getpid() != state:
        os._exit(3)
    return [2 * task for task in tasks]


def warned(_, tasks):
    warnings.warn("a bank is not kept", CurviregWarning, stacklevel=1)
    warnings.warn("invalid value", RuntimeWarning, stacklevel=1)
    return tasks


def refused(_, tasks):
    raise InvalidInputError("cannot be used", subject=str(tasks))


class InlineExecutor:
    """An executor of this process, whose worker is lost with the tasks in ``ends``."""

    def __init__(self, ends=(), error=RuntimeError):
        self.ends = ends
        self.error = error
        self.blocks = []

    def submit(self, function, *arguments):
        future = Future()
        tasks = arguments[-1]
        self.blocks.append(list(tasks))
        if set(self.ends) & set(tasks):
            future.set_exception(self.error("the worker is gone"))
        else:
            future.set_result(function(*arguments))
        return future


def mapped(blocks, function=doubled, **how):
    """Tasks and results of an executor of this process, block by block."""
    return Workers(executor=InlineExecutor(**how)).map(function, None, blocks)


@pytest.fixture(autouse=True)
def no_states():
    yield
    executors._states.clear()


def test_one_process_is_this_one():
    blocks = iter([[1, 2], [3]])
    results = Workers(1).map(doubled, None, blocks)
    assert next(results) == (1, 2)
    assert next(blocks) == [3], "blocks are taken as they are needed"
    assert list(results) == [(2, 4)]


def test_a_state_is_sent_to_a_worker_once():
    executor = InlineExecutor()
    assert dict(Workers(executor=executor).map(doubled, "state", [[1], [2], [3]])) == {
        1: 2,
        2: 4,
        3: 6,
    }
    lacking = sum(len(block) for block in executor.blocks) - 3
    assert lacking >= 1, "the worker asks for it"
    assert list(executors._states.values()) == ["state"]
    dict(Workers(executor=executor).map(doubled, "other", [[1]]))
    assert list(executors._states.values()) == ["other"], "one at a time is in memory"


def test_what_is_lost_is_done_again_alone_and_costs_no_other():
    executor = InlineExecutor(ends={4})
    found = dict(Workers(executor=executor).map(doubled, None, [[1, 2], [3, 4, 5], [6]]))
    lost = found.pop(4)
    assert isinstance(lost, WorkerError)
    assert str(lost) == "workers: RuntimeError: the worker is gone"
    assert found == {1: 2, 2: 4, 3: 6, 5: 10, 6: 12}
    assert executor.blocks.count([4]) == 2, "three times altogether"
    assert executor.blocks.count([3]) == executor.blocks.count([5]) == 1


@pytest.mark.parametrize(("count", "ends", "failed"), [(2, {1, 2}, 0), (8, {2, 3, 4, 5, 6}, 4)])
def test_workers_that_do_nothing_more_are_an_error(count, ends, failed):
    """Not one failure after the other for the rest of a long list."""
    found = []
    with pytest.raises(WorkerError, match="the worker is gone"):
        found.extend(mapped([[task] for task in range(1, 1 + count)], ends=ends))
    assert sum(isinstance(result, WorkerError) for _, result in found) == failed


def test_an_executor_that_is_broken_is_not_renewed():
    with pytest.raises(WorkerError, match="the workers of the executor ended; give another one"):
        list(mapped([[1]], ends={1}, error=BrokenExecutor))


def test_what_is_no_executor_or_was_shut_down_is_refused():
    with pytest.raises(InvalidInputError, match=r"executor: expected .* got int"):
        Workers(executor=5)
    executor = ThreadPoolExecutor(1)
    executor.shutdown()
    with pytest.raises(WorkerError, match="the workers of the executor ended; give another one"):
        list(Workers(executor=executor).map(doubled, None, [[1]]))


def test_errors_of_the_function_are_raised_here():
    with pytest.raises(InvalidInputError, match="cannot be used") as raised:
        list(mapped([[1]], refused))
    assert "in refused" in raised.value.__notes__[0]


def test_our_warnings_are_given_here():
    with pytest.warns(CurviregWarning, match="a bank is not kept") as caught:
        list(mapped([[1]], warned))
    assert [warning.category for warning in caught] == [CurviregWarning]


def test_blocks_of_processes_are_left_to_their_pool(monkeypatch):
    """Where it finds cancelled ones while its processes end, it prints a traceback."""
    futures = []
    workers = Workers(2)
    monkeypatch.setattr(workers, "submit", lambda *_: futures.append(Future()) or futures[-1])

    def blocks():
        yield [1]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        list(workers.map(doubled, None, blocks()))
    assert [future.cancelled() for future in futures] == [False]


def test_few_blocks_wait_at_a_time(monkeypatch):
    monkeypatch.setattr(executors, "BLOCKS_OF_A_CLUSTER", 2)
    taken = []

    def blocks():
        for task in range(6):
            taken.append(task)
            yield [task]

    next(mapped(blocks()))
    assert len(taken) <= 3


def test_a_scheduler_that_does_not_answer_is_named(monkeypatch):
    pytest.importorskip("distributed", reason="the extra cluster")
    monkeypatch.setattr(executors, "SECONDS_TO_CONNECT", 0.5)
    with (
        pytest.raises(InvalidInputError, match=r"tcp://127\.0\.0\.1:1: no Dask scheduler answers"),
        opened_workers(scheduler="tcp://127.0.0.1:1"),
    ):
        pytest.fail("connected")


def slowly(folder, tasks):
    """Twice each task, whose process is noted; the third one waits to be killed, once."""
    for task in tasks:
        (folder / f"{task}-{os.getpid()}").touch()
        if task == 3 and not (folder / "killed").exists():
            time.sleep(60)
    return [2 * task for task in tasks]


@pytest.mark.slow
def test_a_worker_of_a_cluster_that_is_killed_costs_a_repetition(tmp_path):
    distributed = pytest.importorskip("distributed", reason="the extra cluster")
    cluster = distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, processes=True
    )

    def kill():
        while not (busy := list(tmp_path.glob("3-*"))):
            time.sleep(0.05)
        (tmp_path / "killed").touch()
        os.kill(int(busy[0].name.partition("-")[2]), signal.SIGKILL)

    with cluster, distributed.Client(cluster) as client:
        threading.Thread(target=kill, daemon=True).start()
        workers = Workers(executor=client.get_executor())
        results = list(workers.map(slowly, tmp_path, [[task] for task in range(8)]))
    assert (tmp_path / "killed").exists()
    assert sorted(results) == [(task, 2 * task) for task in range(8)]


PARENT = """
import os, signal, sys, time
from pathlib import Path
from curvireg_torch.utils.executors import Workers
from curvireg_torch.utils.files import terminable

def work(folder, tasks):
    (folder / str(os.getpid())).touch()
    time.sleep(300)

if __name__ == "__main__":
    # a shell ignores the first for jobs in the background, nohup the second
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    with terminable(), Workers(2) as workers:
        list(workers.map(work, Path(sys.argv[1]), [[1], [2]]))
"""


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT, signal.SIGKILL])
def test_workers_end_with_their_parent(tmp_path, number):
    """However it ends; and the pipe of its caller closes."""
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    folder = tmp_path / "work"
    folder.mkdir()
    parent = subprocess.Popen(
        [sys.executable, script, folder],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
    )
    deadline = time.monotonic() + 120
    while len(workers := [int(path.name) for path in folder.iterdir()]) < 2:
        assert time.monotonic() < deadline
        time.sleep(0.1)
    parent.send_signal(number)
    parent.communicate(timeout=60)  # reads to the end of its output
    assert parent.returncode != 0
    while any(map(is_running, workers)):
        assert time.monotonic() < deadline
        time.sleep(0.1)


def is_running(process):
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"

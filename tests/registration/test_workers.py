import os

import pytest
import torch

from curvireg_torch import Registrar, rotation_error
from curvireg_torch.errors import CurviregError, InvalidInputError, WorkerError
from curvireg_torch.registration import FailedRegistration
from curvireg_torch.registration.photograph import OnDemand
from curvireg_torch.registration.registrar import _register_by_workers
from curvireg_torch.utils.executors import Workers
from tests._support import (
    CAMERA,
    answer_to,
    exact_registrar,
    first_scenes,
    refused,
    scene,
    truck_bank,
    truck_registrar,
)


class EndsItsProcess:
    """An object whose copy ends the process that gets it."""

    def __reduce__(self):
        return os._exit, (3,)


@pytest.mark.slow
def test_processes_give_the_results_of_one_in_the_same_order(tmp_path):
    images, boxes, _ = first_scenes(3)
    images.append(str(tmp_path / "missing.png"))
    boxes = torch.cat([boxes, boxes[:1]])
    expected = Registrar(truck_bank())(images, boxes, CAMERA)
    registrar = Registrar(truck_bank(), workers=2)
    _ = registrar.describer  # renderers cannot be pickled
    both = [registrar(images, boxes, CAMERA) for _ in range(2)]
    *pairs, (lost, *others) = zip(expected, *both, strict=True)
    for other, one, again in pairs:  # one process registers all in one block: other rounding
        assert torch.equal(one.transform, again.transform)
        assert rotation_error(one.rotation, other.rotation) < 0.05
        assert one.translation.tolist() == pytest.approx(other.translation.tolist(), rel=1e-3)
        assert one.score == pytest.approx(other.score, abs=1e-3)
    assert isinstance(lost.error, CurviregError)
    assert [str(other.error) for other in others] == [str(lost.error)] * 2


@pytest.mark.slow
def test_a_process_that_ends_is_an_error():
    registrar = Registrar(truck_bank(), workers=2)
    items = [EndsItsProcess(), EndsItsProcess()]
    with refused("a process ended", WorkerError):
        registrar.register_prepared(items)
    images = [scene(0)[0]] * 2
    results = registrar(images, scene(0)[1].expand(2, 4), CAMERA)  # by new processes
    assert all(result.ok for result in results)


def test_photographs_for_workers_are_read_when_they_are_asked_for():
    """Not all at once: a block is in memory, and those that wait."""
    read = []

    def item(number):
        read.append(number)
        return InvalidInputError(f"dark {number}")

    class OneByOne(Workers):
        def map(self, function, state, blocks):
            for block in blocks:
                assert len(read) == block[-1].number + 1
                for task in reversed(block):
                    yield task, FailedRegistration(task.item)

    registrar = truck_registrar()
    results = _register_by_workers(registrar, OneByOne(2), OnDemand(item, 70), detects=False)
    assert [result.error.message for result in results] == [f"dark {k}" for k in range(70)]
    assert read == list(range(70)), "each once"


def test_one_photograph_needs_no_process(monkeypatch):
    monkeypatch.setattr(Workers, "map", None)  # would fail
    assert answer_to(0, exact_registrar(truck_bank(), workers=2)).ok


@pytest.mark.parametrize("count", [0, 1.5])
def test_workers_are_counted(count):
    with refused("workers"):
        Registrar(truck_bank(), workers=count)

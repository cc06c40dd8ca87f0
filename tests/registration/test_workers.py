import os

import pytest
import torch

from curvireg_torch import Registrar
from curvireg_torch.errors import CurviregError, InvalidInputError, WorkerError
from curvireg_torch.utils.executors import Workers
from tests._support.scenes import CAMERA, scene, truck_bank


class EndsItsProcess:
    """An object whose copy ends the process that gets it."""

    def __reduce__(self):
        return os._exit, (3,)


@pytest.mark.slow
def test_processes_give_the_results_of_one_in_the_same_order(tmp_path):
    images = [*(scene(seed)[0] for seed in range(3)), str(tmp_path / "missing.png")]
    boxes = torch.stack([scene(seed)[1] for seed in (0, 1, 2, 0)])
    expected = Registrar(truck_bank())(images, boxes, CAMERA)
    registrar = Registrar(truck_bank(), workers=2)
    _ = registrar.describer  # renderers cannot be pickled
    for results in (registrar(images, boxes, CAMERA), registrar(images, boxes, CAMERA)):
        for result, other in zip(results[:3], expected[:3], strict=True):
            assert torch.equal(result.transform, other.transform)
            assert result.score == other.score
        assert str(results[3].error) == str(expected[3].error)
        assert isinstance(results[3].error, CurviregError)


@pytest.mark.slow
def test_a_process_that_ends_is_an_error():
    registrar = Registrar(truck_bank(), workers=2)
    items = [EndsItsProcess(), EndsItsProcess()]
    with pytest.raises(WorkerError, match="a process ended"):
        registrar.register_prepared(items)
    images = [scene(0)[0]] * 2
    results = registrar(images, scene(0)[1].expand(2, 4), CAMERA)  # by new processes
    assert all(result.ok for result in results)


def test_one_photograph_needs_no_process(monkeypatch):
    monkeypatch.setattr(Workers, "map", None)  # would fail
    registrar = Registrar(truck_bank(), workers=2)
    assert registrar([scene(0)[0]], scene(0)[1][None], CAMERA)[0].ok


@pytest.mark.parametrize("count", [0, 1.5])
def test_workers_are_counted(count):
    with pytest.raises(InvalidInputError, match="workers"):
        Registrar(truck_bank(), workers=count)

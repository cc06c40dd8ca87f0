import sys

import pytest
import torch
from torch.nn.functional import normalize

from curvireg_torch.errors import InvalidInputError, MissingDependencyError
from curvireg_torch.matching import ViewIndex


def population(count: int) -> torch.Tensor:
    return torch.rand(count, 24, generator=torch.Generator().manual_seed(0)) ** 4


def test_without_faiss_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "faiss", None)
    with pytest.raises(MissingDependencyError, match=r"curvireg_torch\[faiss\]"):
        ViewIndex(population(4))


def test_looking_into_every_cell_is_brute_force():
    pytest.importorskip("faiss")
    views, queries = population(300), population(9) + 0.1
    similarity, found = ViewIndex(views, probes=300).search(queries, 5)
    best = (normalize(queries, dim=1) @ normalize(views, dim=1).T).topk(5, dim=1)
    assert found.equal(best.indices)
    torch.testing.assert_close(similarity, best.values)


def test_few_cells_find_the_view_itself_and_say_when_they_hold_too_little():
    pytest.importorskip("faiss")
    views = population(300)
    index = ViewIndex(views, probes=1)
    similarity, found = index.search(views[:40], 300)
    assert len(index) == 300
    assert found[:, 0].tolist() == list(range(40))
    assert bool((found[:, -1] == -1).all() and similarity[:, -1].isneginf().all())


def test_bad_input_is_named():
    pytest.importorskip("faiss")
    with pytest.raises(InvalidInputError, match="probes"):
        ViewIndex(population(4), probes=0)
    with pytest.raises(InvalidInputError, match="queries"):
        ViewIndex(population(4)).search(torch.rand(2, 3), 1)
    with pytest.raises(InvalidInputError, match="count"):
        ViewIndex(population(4)).search(torch.rand(2, 24), 0)

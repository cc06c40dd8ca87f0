"""Rows: columns are selected, joined and replaced together; the rest is shared."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor

from curvireg_torch.utils.rows import Rows


@dataclass(frozen=True)
class Inner(Rows):
    weight: Tensor


@dataclass(frozen=True)
class Outer(Rows):
    name: str
    value: Tensor
    inner: Inner
    absent: Tensor | None = None


def rows(*values, name="a"):
    column = torch.tensor(values)
    return Outer(name, column[:, None].repeat(1, 2), Inner(10.0 * column))


def test_an_index_selects_rows_of_every_column():
    three = rows(1.0, 2.0, 3.0)
    assert len(three) == 3
    for index in (torch.tensor([2, 0]), torch.tensor([True, False, True]), slice(1, None)):
        some = three[index]
        assert torch.equal(some.value, three.value[index])
        assert torch.equal(some.inner.weight, three.inner.weight[index])
        assert (some.name, some.absent) == ("a", None)


def test_parts_are_joined_and_the_first_has_what_they_share():
    joined = Outer.cat([rows(1.0, name="first"), rows(2.0, 3.0, name="second")])
    assert joined.value[:, 1].tolist() == [1.0, 2.0, 3.0]
    assert joined.inner.weight.tolist() == [10.0, 20.0, 30.0]
    assert joined.name == "first"
    within = Inner.cat_within([Inner(torch.zeros(2, 1)), Inner(torch.ones(2, 3))])
    assert within.weight.tolist() == [[0.0, 1.0, 1.0, 1.0]] * 2
    stacked = Inner.stack([Inner(torch.zeros(2)), Inner(torch.ones(2))])
    assert stacked.weight.tolist() == [[0.0, 0.0], [1.0, 1.0]]
    with pytest.raises(IndexError):
        Outer.cat([])


def test_rows_are_replaced_in_a_copy():
    three = rows(1.0, 2.0, 3.0)
    changed = three.replaced(torch.tensor([2, 0]), rows(30.0, 10.0))
    assert changed.value[:, 0].tolist() == [10.0, 2.0, 30.0]
    assert changed.inner.weight.tolist() == [100.0, 20.0, 300.0]
    assert three.value[:, 0].tolist() == [1.0, 2.0, 3.0]


def test_columns_may_be_numpy_arrays():
    @dataclass(frozen=True)
    class Arrays(Rows):
        x: np.ndarray

    joined = Arrays.cat([Arrays(np.arange(3)), Arrays(np.arange(2))])
    assert joined[np.array([3, 2])].x.tolist() == [0, 2]
    assert len(joined) == 5

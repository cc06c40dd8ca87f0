import inspect

import pytest
import torch
from torch.utils.data import DataLoader

from curvireg_torch import data
from curvireg_torch.data import collate
from curvireg_torch.errors import InvalidInputError


def test_collate_stacks_equal_tensors_and_lists_other_values():
    samples = [
        {"image": torch.zeros(3, 4, 5), "box": torch.zeros(4), "n": 1, "name": "a", "info": {"x": 1}},
        {"image": torch.zeros(3, 4, 6), "box": torch.ones(4), "n": 2, "name": "b", "info": {}},
    ]
    batch = collate(samples)
    assert batch["box"].tolist() == [[0] * 4, [1] * 4]
    assert [tuple(i.shape) for i in batch["image"]] == [(3, 4, 5), (3, 4, 6)]
    assert (batch["n"], batch["name"], batch["info"]) == ([1, 2], ["a", "b"], [{"x": 1}, {}])
    batch = collate([{"a": torch.zeros(2), "b": None}, {"a": torch.zeros(2).double(), "b": torch.zeros(1)}])
    assert isinstance(batch["a"], list)
    assert isinstance(batch["b"], list)


def test_collate_refuses_no_samples_and_other_keys():
    with pytest.raises(InvalidInputError, match="at least one"):
        collate([])
    with pytest.raises(InvalidInputError, match="keys"):
        collate([{"a": 1}, {"b": 1}])


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")  # Python 3.12 warns of fork beside threads
@pytest.mark.parametrize("context", ["spawn", None])
def test_datasets_work_with_loader_workers(bop, web, context):
    workers = 1 if context else 2  # a spawned worker imports everything again
    options = {"num_workers": workers, "collate_fn": collate, "multiprocessing_context": context}
    for dataset in [web] if context else [bop, web]:
        batches = list(DataLoader(dataset, batch_size=2, **options))
        assert sum(len(b["image"]) for b in batches) == len(dataset)
        assert batches[0]["box"].shape == (2, 4)
        alone = dataset[0]
        assert torch.equal(batches[0]["image"][0], alone["image"])
        assert batches[0]["image_path"][0] == alone["image_path"]


def test_data_names_are_sorted_and_options_are_keywords():
    assert data.__all__ == sorted(data.__all__)
    for name in data.__all__:
        for parameter in inspect.signature(getattr(data, name)).parameters.values():
            if parameter.default is not inspect.Parameter.empty and parameter.name != "split":
                assert parameter.kind is inspect.Parameter.KEYWORD_ONLY, f"{name}: {parameter.name}"

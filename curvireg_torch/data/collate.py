"""Batches of samples."""

from collections.abc import Sequence

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ._base import Sample


def collate(samples: Sequence[Sample]) -> Sample:
    """Join B >= 1 samples with the same keys into one batch, for ``DataLoader(..., collate_fn=collate)``.

    Tensors of equal shape and dtype are stacked to (B, ...). Other values become lists of length B, photographs of
    different sizes among them. :class:`InvalidInputError` if there is no sample, or their keys differ.

    Example:
        >>> batch = collate([{"box": torch.zeros(4), "category": "car"}, {"box": torch.ones(4), "category": "sofa"}])
        >>> batch["box"].shape, batch["category"]
        (torch.Size([2, 4]), ['car', 'sofa'])
    """
    if not samples:
        raise InvalidInputError("samples: expected at least one")
    for sample in samples:
        if sample.keys() != samples[0].keys():
            raise InvalidInputError(f"samples: expected the keys {sorted(samples[0])}, got {sorted(sample)}")
    return {key: _join([sample[key] for sample in samples]) for key in samples[0]}


def _join(values: list[object]) -> object:
    tensors = [v for v in values if isinstance(v, Tensor)]
    if len(tensors) == len(values) and len({(t.shape, t.dtype, t.device) for t in tensors}) == 1:
        return torch.stack(tensors)
    return values

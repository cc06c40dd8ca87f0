import math

import torch

import curvireg_torch as cr
from curvireg_torch import filters
from curvireg_torch.features.backbone import Backbone, describe


def test_fields_fill_missing_pixels() -> None:
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(1, 3, 64, 64, generator=generator)
    lost = image.clone()
    lost[0, :, 30:34, 30:34], lost[0, 2, 5, 5] = math.nan, math.inf
    where = filters.operations.missing_mask(lost).any(dim=1, keepdim=True)
    learned = cr.LearnedCurvilinearSaliency()
    field = learned(lost)
    assert bool(field.isfinite().all())
    assert not bool(field.masked_select(where).any())
    assert bool(field.masked_select(~where).any())
    assert bool(learned.mask(lost).isfinite().all())
    appearance_scores = describe(torch.cat([image, lost]), Backbone())
    assert bool(appearance_scores.isfinite().all())
    assert 0.5 < float((appearance_scores[0].float() * appearance_scores[1].float()).sum()) < 0.9999

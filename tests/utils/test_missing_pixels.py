import math
from typing import Any

import pytest
import torch
from torch import Tensor

import curvireg_torch as cr
from curvireg_torch import filters, geometry
from curvireg_torch.errors import ImageError
from curvireg_torch.features.appearance import describe
from curvireg_torch.features.backbone import Backbone
from tests.utils.conftest import CAMERA, Entries, refused

MATCHING = ("Registrar", "localize", "ViewMatcher", "Locator", "locate")


def holes(image: Tensor, where: tuple[slice, slice], value: float) -> Tensor:
    image = image.clone()
    image[(slice(None), *where)] = value
    return image


def hole_in_the_middle(image: Tensor, box: Tensor, value: float) -> Tensor:
    x, y = (int(v) for v in 0.5 * (box[:2] + box[2:]))
    return holes(image, (slice(y, y + 1), slice(x, x + 1)), value)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_check_pixels_refuses_missing_pixels_in_the_box(
    entries: Entries, photograph: tuple[Tensor, Tensor], value: float
) -> None:
    image, box = photograph
    for lost in (hole_in_the_middle(image, box, value), torch.full_like(image, value)):
        for name in MATCHING:
            assert isinstance(refused(name, entries.photographs[name], lost, "NaN or inf in the pixels"), ImageError)
        fit: Any = entries.photographs["fit_contours"](lost)  # fills them
        assert bool(fit.transform.isfinite().all())


def test_check_pixels_refuses_values_beyond_0_to_1(entries: Entries, photograph: tuple[Tensor, Tensor]) -> None:
    for name in MATCHING:
        for image in (255.0 * photograph[0], photograph[0] - 0.6):
            refused(name, entries.photographs[name], image, r"outside \[0, 1\].*255")


def test_matcher_ignores_missing_pixels_beside_the_box(
    default_registrar: cr.Registrar, registrar: cr.Registrar, photograph: tuple[Tensor, Tensor]
) -> None:
    image, box = photograph
    H, W = image.shape[-2:]
    square = geometry.square_boxes(box, registrar.bank.settings.margin)
    x = min(int(square[2]) + 3, W - 1)
    assert x < W - 1
    lost = holes(image, (slice(0, H), slice(x, W)), math.nan)
    exact = (registrar.matcher([x], box[None]).scores for x in (lost, image))  # boxes without jitter
    torch.testing.assert_close(*exact)
    found = default_registrar.matcher([lost], box[None])  # shifted crops have missing pixels
    assert bool(found.scores.isfinite().all())
    assert found.order[0, 0] == default_registrar.matcher([image], box[None]).order[0, 0]
    with_camera = [default_registrar([one], box[None], CAMERA)[0] for one in (image, lost)]
    assert float(cr.rotation_error(with_camera[0].rotation, with_camera[1].rotation)) < 5.0


def test_fields_fill_missing_pixels() -> None:
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(1, 3, 64, 64, generator=generator)
    lost = image.clone()
    lost[0, :, 30:34, 30:34], lost[0, 2, 5, 5] = math.nan, math.inf
    where = filters.inputs.missing_mask(lost).any(dim=1, keepdim=True)
    learned = cr.LearnedCurvilinearSaliency()
    field = learned(lost)
    assert bool(field.isfinite().all())
    assert not bool(field.masked_select(where).any())
    assert bool(field.masked_select(~where).any())
    assert bool(learned.mask(lost).isfinite().all())
    appearance_scores = describe(torch.cat([image, lost]), Backbone())
    assert bool(appearance_scores.isfinite().all())
    assert 0.5 < float((appearance_scores[0].float() * appearance_scores[1].float()).sum()) < 0.9999


def test_query_fills_missing_pixels_before_a_custom_field(
    registrar: cr.Registrar, photograph: tuple[Tensor, Tensor]
) -> None:
    image, box = photograph
    seen: list[Tensor] = []

    class Ones(torch.nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            seen.append(x)
            return torch.ones_like(x).expand(-1, 2, -1, -1)

    matcher = cr.ViewMatcher(registrar.bank, field=Ones())
    query = matcher.query([hole_in_the_middle(image, box, math.nan)], box[None])
    assert bool(seen[0].isfinite().all())
    lost = query.crops.isnan().any(dim=1, keepdim=True).expand_as(query.field)
    assert 0 < int(lost.sum()) < lost.numel()
    assert torch.equal(query.field == 0.0, lost)

"""Many photographs, many models, half precision, data loaders: one answer."""

import torch
from torch.utils.data import DataLoader

from curvireg_torch import ViewBank, ViewMatcher, sample_views
from curvireg_torch.matching import Ranking
from curvireg_torch.terms import DescriptorStatistics
from tests._support.scenes import scene, truck_bank


def photographs(count: int) -> list[tuple[torch.Tensor, torch.Tensor]]:
    return [scene(seed)[:2] for seed in range(count)]


def test_a_data_loader_loop_gives_what_one_batch_gives():
    matcher = ViewMatcher(truck_bank())
    pairs = photographs(5)
    with torch.no_grad():
        whole = matcher(torch.stack([p[0] for p in pairs]), torch.stack([p[1] for p in pairs]))
        parts = [matcher(images, boxes) for images, boxes in DataLoader(pairs, batch_size=2)]
        again = [matcher(images, boxes) for images, boxes in DataLoader(pairs, batch_size=2)]
    torch.testing.assert_close(Ranking.cat(parts).scores, whole.scores, rtol=1e-4, atol=1e-5)
    assert all(a.scores.equal(b.scores) and a.order.equal(b.order) for a, b in zip(parts, again, strict=True))


def test_one_photograph_among_several_models_scores_as_with_each_alone():
    import trimesh

    image, box, _ = scene(0)
    views = sample_views(azimuth_step=45, elevations=[20])
    meshes = truck_bank().mesh, trimesh.creation.box((1, 2, 3))
    banks = [ViewBank.build(m, views, settings=truck_bank().settings, progress=False) for m in meshes]
    together = ViewMatcher(ViewBank.join(banks))([image], box[None])
    for name in ("hog", "repeatability"):
        alone = [getattr(ViewMatcher(bank)([image], box[None]), name) for bank in banks]
        torch.testing.assert_close(getattr(together, name), torch.cat(alone, dim=1), rtol=1e-4, atol=1e-5)


def test_half_precision_moves_similarities_by_rounding_alone():
    image, box, _ = scene(0)
    bank = truck_bank()
    for whitening in (None, DescriptorStatistics.from_descriptors(bank.descriptors).whitening()):
        single = ViewMatcher(bank, whitening=whitening)([image], box[None])
        half = ViewMatcher(bank, whitening=whitening).half()([image], box[None])
        assert half.scores.dtype == torch.float32
        torch.testing.assert_close(half.hog, single.hog, rtol=0, atol=4e-3)
        torch.testing.assert_close(half.repeatability, single.repeatability, rtol=0, atol=4e-3)

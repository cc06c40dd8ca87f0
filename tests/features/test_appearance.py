"""Appearance descriptors and scores of photographs and shaded views."""

import pytest
import torch
import torch.nn.functional as F

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.features.appearance import describe, similarity
from curvireg_torch.features.backbone import Backbone
from curvireg_torch.geometry import crop_images, sample_views
from curvireg_torch.matching.describe import BankSettings, ViewDescriber
from curvireg_torch.mesh.mesh import mesh_radius
from curvireg_torch.rendering.colour import shade
from curvireg_torch.synthetic import example_mesh, procedural_background, synthesize_photograph


@pytest.fixture(scope="module")
def backbone():
    return Backbone()


def images(n, size=64, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.stack([procedural_background((size, size), generator) for _ in range(n)])


def test_similarity_is_the_mean_cosine_of_the_cells(backbone):
    pictures = images(3)
    expected = torch.zeros(3, 3)
    for features, spread in zip(backbone(pictures), backbone.spreads, strict=True):
        cells = features - features.mean(dim=(2, 3), keepdim=True)
        cells = F.normalize(cells / spread.view(1, -1, 1, 1), dim=1)
        expected += torch.einsum("achw,bchw->abhw", cells, cells).mean(dim=(2, 3)) / 2
    d = describe(pictures, backbone)
    assert d.dtype == torch.float16
    assert d.shape == (3, 40 * 8 * 8 + 112 * 4 * 4)
    torch.testing.assert_close(similarity(d[:, None], d), expected, atol=2e-3, rtol=0)
    torch.testing.assert_close(similarity(d[:, None], d).diagonal(), torch.ones(3), atol=2e-3, rtol=0)


def test_similarity_takes_the_best_crop(backbone):
    d = describe(images(4), backbone)
    both = similarity(d[:2][None], d[2:])
    assert torch.equal(both[0], similarity(d[:2, None], d[2:]).amax(dim=0))


def test_describe_of_constant_and_empty_input(backbone):
    constant = describe(torch.full((1, 3, 32, 32), 0.5), backbone)
    assert constant.isfinite().all()
    assert describe(torch.zeros(0, 3, 32, 32), backbone).shape == (0, constant.shape[1])
    assert similarity(constant[:0, None], constant).shape == (0, 1)


@pytest.mark.parametrize("shapes", [((2, 8), (3, 8)), ((2, 1, 8), (3, 9))])
def test_similarity_rejects_wrong_shapes(shapes):
    with pytest.raises(InvalidInputError):
        similarity(torch.ones(shapes[0]), torch.ones(shapes[1]))


def test_similarity_ranks_the_correct_view_first(backbone):
    mesh = example_mesh()
    views = sample_views(azimuth_step=45, elevations=[20])
    describer = ViewDescriber(mesh, BankSettings(image_size=128))
    T, K, _ = describer.cameras(views.rotations, views.distance * mesh_radius(mesh))
    shaded = describe(shade(describer.renderer.render(T, K, (128, 128)), K), backbone)
    camera = torch.tensor([[400.0, 0, 99.5], [0, 400.0, 99.5], [0, 0, 1]], dtype=torch.float64)
    crops = []
    for k in range(len(views)):
        photograph, box = synthesize_photograph(mesh, T[k], camera, (200, 200), torch.Generator().manual_seed(k))
        crops.append(crop_images(photograph[None], box[None], size=128)[0])
    found = similarity(describe(torch.cat(crops), backbone)[:, None], shaded).argmax(dim=1)
    assert (found == torch.arange(len(views))).float().mean() >= 0.75


def test_describe_is_bit_identical_in_any_batch_on_any_threads(backbone):
    before = torch.get_num_threads()
    grey = torch.rand(18, 1, 64, 64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    parts = []
    for threads, count in ((1, 18), (1, 1), (1, 3), (3, 17), (3, 1)):
        torch.set_num_threads(threads)
        parts.append(describe(grey[:count], backbone))
    torch.set_num_threads(before)
    assert all(torch.equal(part, parts[0][: len(part)]) for part in parts)
    assert not any(part.requires_grad for part in parts)

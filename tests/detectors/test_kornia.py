"""Layers and detectors in pipelines of kornia."""

from collections.abc import Callable

import pytest
import torch
from kornia.augmentation import AugmentationSequential, ImageSequential, RandomHorizontalFlip
from kornia.feature import LAFDescriptor, ScaleSpaceDetector, laf_from_center_scale_ori
from torch import Tensor, nn

from curvireg_torch import detectors, filters
from curvireg_torch.detectors import Response
from curvireg_torch.features import HOG

from ..filters.layer_cases import colour_photos, photos


def _discs() -> tuple[Tensor, Tensor]:
    """Two dark discs of radius 9 px on grey, and their centres x, y."""
    axis = torch.arange(96.0)
    centres = torch.tensor([[30.0, 40.0], [66.0, 58.0]])
    image = torch.full((96, 96), 0.8)
    for x, y in centres:
        image -= 0.6 * torch.sigmoid((9.0 - ((axis[:, None] - y) ** 2 + (axis - x) ** 2).sqrt()) / 0.7)
    return image[None, None], centres


@pytest.mark.parametrize(
    ("layer", "power"),
    [
        (filters.ImageGradient(), 1.0),
        (filters.ImageCurvilinearSaliency(), 2.0),
        (filters.MultiScaleCurvilinearSaliency(scales=2), 0.0),
        (filters.PrincipalCurvatureImage(sigmas=(1.0,)), 2.0),
        (detectors.harris, 4.0),
        (detectors.minimum_eigenvalue, 2.0),
        (detectors.sobel, 1.0),
    ],
    ids=lambda x: getattr(x, "__name__", type(x).__name__),
)
def test_response_in_kornias_scale_space_detector(
    layer: Callable[[Tensor], Tensor | detectors.Detection], power: float
) -> None:
    image, centres = _discs()
    lafs, responses = ScaleSpaceDetector(num_features=8, resp_module=Response(layer, power=power))(image)
    kept = lafs[0, responses[0] > 0.01 * responses.max()]
    assert len(kept) > 0
    # All points are inside a disc or near its edge.
    assert float(torch.cdist(kept[:, :, 2], centres).amin(dim=1).max()) < 9.0 + 5.0


def test_response_of_fields_detectors_and_maps() -> None:
    image = photos(2, 32)
    field = filters.image_gradient(image)
    torch.testing.assert_close(Response(filters.ImageGradient())(image), field.norm(dim=1, keepdim=True))
    by_scale = Response(filters.ImageGradient(), power=2.0)(image, torch.tensor([2.0, 3.0]))
    torch.testing.assert_close(by_scale, field.norm(dim=1, keepdim=True) * torch.tensor([4.0, 9.0]).view(2, 1, 1, 1))
    assert torch.equal(Response(detectors.harris)(image, torch.ones(2)), detectors.harris(image).response)
    single = Response(filters.EdgeBlur(reblur_sigmas=(1.0,)))(image)
    assert torch.equal(single, filters.edge_blur(image, reblur_sigmas=(1.0,)))


def test_hog_describes_local_affine_frames() -> None:
    describe = LAFDescriptor(nn.Sequential(filters.ImageGradient(), HOG(grid=4)), patch_size=32)
    image = photos(1, 96, seed=4)
    centres = torch.tensor([[[30.0, 40.0], [60.0, 50.0], [44.0, 66.0]]])
    scales = torch.full((1, 3, 1, 1), 12.0)
    lafs = laf_from_center_scale_ori(centres, scales)
    original = describe(image, lafs)
    assert original.shape == (1, 3, HOG(grid=4).length)
    # With other contrast and a translation of 5 px, each frame still matches itself.
    moved = torch.roll(0.1 + 0.8 * image, (5, 5), (-2, -1))
    translated = describe(moved, laf_from_center_scale_ori(centres + 5.0, scales))
    assert torch.cdist(original[0], translated[0]).argmin(dim=1).tolist() == [0, 1, 2]
    assert float((original - translated).abs().max()) < 0.02
    torch.testing.assert_close(describe(image.expand(-1, 3, -1, -1), lafs), original, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(
    "layer",
    [
        filters.ImageGradient(),
        filters.ImageCurvilinearSaliency(),
        filters.MultiScaleCurvilinearSaliency(scales=2),
        filters.MultiScaleFocusCurves(scales=3),
        filters.PrincipalCurvatureImage(sigmas=(1.0,)),
        filters.AnisotropicDiffusion(iterations=3),
    ],
    ids=lambda x: type(x).__name__,
)
def test_layers_in_kornias_augmentation_sequences(layer: nn.Module) -> None:
    colour = colour_photos(2, 32)
    flipped = colour.flip(-1)
    in_image = ImageSequential(RandomHorizontalFlip(p=1.0), layer)
    torch.testing.assert_close(in_image(colour), layer(flipped))
    augment = AugmentationSequential(RandomHorizontalFlip(p=1.0), layer, data_keys=["input", "mask"])
    mask = (colour[:, :1] > 0.5).float()
    image, flipped_mask = augment(colour, mask)
    torch.testing.assert_close(image, layer(flipped))
    torch.testing.assert_close(flipped_mask, mask.flip(-1))

"""Transforms of samples, ``sample -> sample``."""

from typing import Any

from ..geometry import crop_images


class CropBox:
    """Replace a sample's image by the square crop around its box, so that samples can be stacked.

    The box stays in pixels of the original image, ``crop_transform`` (3, 3) maps them to pixels of the crop, and the
    camera matrix, if there is one, becomes that of the crop.

    ``size``, ``margin`` and errors as in :func:`curvireg_torch.geometry.crop_images`.

    Example:
        >>> import torch
        >>> sample = {"image": torch.rand(3, 60, 80), "box": torch.tensor([10.0, 10.0, 50.0, 40.0])}
        >>> CropBox(size=32)(sample)["image"].shape
        torch.Size([3, 32, 32])
    """

    def __init__(self, *, size: int = 256, margin: float = 0.1) -> None:
        self.size, self.margin = size, margin

    def __call__(self, sample: dict[str, Any]) -> dict[str, Any]:
        crops, A = crop_images(sample["image"][None], sample["box"][None], size=self.size, margin=self.margin)
        changed = {"image": crops[0], "crop_transform": A[0]}
        if "camera_matrix" in sample:
            changed["camera_matrix"] = A[0].to(sample["camera_matrix"]) @ sample["camera_matrix"]
        return {**sample, **changed}

    def __repr__(self) -> str:
        return f"CropBox(size={self.size}, margin={self.margin})"

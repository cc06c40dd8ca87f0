"""Crops of a dataset's objects with training targets, tensors of one size that torch's own loader
takes."""

import math
from collections import Counter
from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.utils.data import Dataset

from ..errors import InvalidInputError
from ..geometry import viewpoint_from_rotation
from ..geometry.crops import crop_images
from ..utils.checks import check_integer, check_positive
from ._base import ObjectDataset, Sample

UNKNOWN_CLASS = -100
"""Bin of an unknown viewpoint: ``torch.nn.functional.cross_entropy`` leaves it out."""

_ANGLES = ("azimuth", "elevation", "theta")
_START = (0.0, -90.0, -180.0)  # Degrees at which the first bin of each angle begins
_RANGE = (360.0, 180.0, 360.0)


class ObjectCrops(Dataset[dict[str, Tensor]]):
    """The annotated objects of a dataset as square crops with training targets, for
    ``torch.utils.data.DataLoader``.

    Args:
        dataset: a dataset of this module; its ``transform`` is applied before cropping. To split
            it, take a ``torch.utils.data.Subset`` of the result.
        size: side of the crops in px.
        margin: around the box, as a fraction of its longer side.
        bins: number of equal bins of azimuth in [0, 360), elevation in [-90, 90] and theta in
            [-180, 180) degrees.
        transform: function of each crop (3, size, size), for instance an augmentation of colours.

    Attributes:
        dataset: the dataset that is cropped.
        classes: names of the classes, in the order of ``class_id``.
        bins: number of bins of azimuth, elevation and theta.

    Samples are dictionaries:
        - ``image`` (3, size, size) float32 in [0, 1]
        - ``rotation`` (3, 3) float32 model to OpenCV camera as annotated, NaN if unknown
        - ``viewpoint_bins`` (3,) int64, the bins of azimuth, elevation and theta from 0; -100 if
          unknown
        - ``class_id`` () int64, index of ``classes``: categories, or the object's numbers of a BOP
          set

    Objects without a box (``unknown_box``) and those of which nothing is visible
    (``invisible``) are left out and counted in ``skipped``.

    Raises:
        InvalidInputError: another kind of dataset, or an option is out of range.

    Example:
        >>> from torch.utils.data import DataLoader
        >>> cars = crops(Pascal3DPlus("data/PASCAL3D+_release1.1"), 128)  # doctest: +SKIP
        >>> next(iter(DataLoader(cars, batch_size=8)))["image"].shape  # doctest: +SKIP
        torch.Size([8, 3, 128, 128])
    """

    def __init__(
        self,
        dataset: ObjectDataset,
        size: int = 128,
        *,
        margin: float = 0.1,
        bins: Sequence[int] = (24, 12, 24),
        transform: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        if not isinstance(dataset, ObjectDataset):
            raise InvalidInputError(
                f"dataset: expected one of curvireg_torch.data, got {type(dataset).__name__}"
            )
        if dataset.transforms is not None:
            raise InvalidInputError(
                "dataset: crops are cut by the boxes as annotated, which its transforms may move; "
                "make it without transforms="
            )
        check_positive(margin, "margin", zero_ok=True)
        if not hasattr(bins, "__len__") or len(bins) != len(_ANGLES):
            raise InvalidInputError(
                f"bins: expected a number for each of {', '.join(_ANGLES)}, got {bins!r:.40}"
            )
        self.dataset = dataset
        self.size = check_integer(size, "size")
        self.margin = margin
        self.bins = tuple(
            check_integer(count, f"bins of {name}")
            for name, count in zip(_ANGLES, bins, strict=True)
        )
        self.transform = transform
        names = [str(item.get("category", item.get("obj_id"))) for item in dataset._items]
        self.classes = sorted(set(names), key=_numeric_order)
        class_ids = {name: number for number, name in enumerate(self.classes)}
        self._class_ids = [class_ids[name] for name in names]
        reasons = [_reason_to_leave_out(item) for item in dataset._items]
        self._indices = [index for index, reason in enumerate(reasons) if reason is None]
        self._left_out = Counter(filter(None, reasons))

    @property
    def skipped(self) -> Counter[str]:
        """Number of objects left out because their box is unknown, or nothing of them is visible,
        beside those that the dataset skipped."""
        return self.dataset.skipped + self._left_out

    def __len__(self) -> int:
        return len(self._indices)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.dataset!r}, size={self.size}, {len(self)} crops)"

    def annotation(self, index: int) -> Sample:
        """The dataset's sample of crop ``index``, without its ``image``."""
        return self.dataset.annotation(self._indices[index])

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        annotation = self.annotation(index)
        number = self._indices[index]
        sample = self.dataset[number]
        try:
            crop = crop_images(
                sample["image"][None], annotation["box"][None], size=self.size, margin=self.margin
            )[0][0]
        except InvalidInputError as error:  # in an epoch of thousands, a box alone is not found
            raise error.with_subject(annotation["image_path"]) from None
        return {
            "image": crop if self.transform is None else self.transform(crop),
            "rotation": annotation["rotation"],
            "viewpoint_bins": viewpoint_bins(annotation["rotation"], self.bins),
            "class_id": torch.tensor(self._class_ids[number]),
        }


crops = ObjectCrops


def viewpoint_bins(rotation: Tensor, bins: Sequence[int]) -> Tensor:
    """(3,) int64 bins of azimuth, elevation and theta of a rotation (3, 3); -100 for an unknown
    one."""
    if not rotation.isfinite().all():
        return torch.full((len(_ANGLES),), UNKNOWN_CLASS)
    # not as annotated, where an elevation may lie past the pole
    viewpoint = torch.stack(viewpoint_from_rotation(rotation.double()))
    # Rounded, so that 30 degrees that a rotation gives back as 29.9999 lie in the bin that begins
    # there.
    degrees = (viewpoint - torch.tensor(_START)).round(decimals=3) % 360.0
    counts = torch.tensor(bins)
    numbers = (degrees / torch.tensor(_RANGE) * counts).floor().long()
    return torch.minimum(numbers, counts - 1)


def _reason_to_leave_out(item: Sample) -> str | None:
    """Why no crop is made of an object, or None."""
    if not all(map(math.isfinite, item["box"])):
        return "unknown_box"
    return "invisible" if item.get("visib_fract") == 0.0 else None


def _numeric_order(name: str) -> tuple[int, str]:
    """Numbers by their value, then names."""
    return (int(name), name) if name.isdecimal() else (0, name)

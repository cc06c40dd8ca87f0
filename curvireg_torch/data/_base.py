"""Base class of the datasets: dict samples, images read on access, a record of skipped objects."""

import operator
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypedDict

import torch
from torch import Tensor
from torch.utils.data import Dataset

from ..errors import InvalidInputError, MissingFileError
from ..geometry import rotation_from_viewpoint
from ..utils.aliases import Fields, PathName
from .images import read_image

Sample = Fields
JointTransform = Callable[[Any, Sample], tuple[Any, Sample]]


class Transforms(TypedDict, total=False):
    """Functions of :class:`ObjectDataset`, which its subclasses take as well."""

    transform: Callable[[Tensor], Any] | None
    target_transform: Callable[[Sample], Sample] | None
    transforms: JointTransform | None


IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")  # in lower case


class ObjectDataset(Dataset[Sample]):
    """One dict per annotated object. The index is built once, photographs are read on access.

    ``skipped_items`` maps reasons to names of skipped objects and files.

    Args:
        root: the folder of the dataset.
        transform: function of the photograph (3, H, W), whose result becomes ``image``. It may
            change colours, not the geometry, since boxes, cameras and poses stay: a result of
            another size is refused, a flip cannot be seen. :func:`crops` cuts boxes out.
        target_transform: function of the sample without its ``image``, which returns a dict.
        transforms: function of both, which returns both, as in torchvision:
            ``transforms(image, sample) -> (image, sample)``; the place for what moves pixels. It
            comes last.
    """

    def __init__(
        self,
        root: Path,
        *,
        transform: Callable[[Tensor], Any] | None = None,
        target_transform: Callable[[Sample], Sample] | None = None,
        transforms: JointTransform | None = None,
    ) -> None:
        self.root = root
        self.transform = transform
        self.target_transform = target_transform
        self.transforms = transforms
        self.skipped_items: dict[str, list[str]] = {}
        # Numbers instead of tensors: thousands of small tensors exhaust file handles when a worker
        # is spawned.
        self._items: list[Sample] = []

    @property
    def skipped(self) -> Counter[str]:
        """Number of skipped items by reason; ``missing_``, ``corrupt_`` and ``bad_`` mean a defect
        of the data."""
        return Counter({reason: len(items) for reason, items in self.skipped_items.items()})

    def _skip(self, reason: str, item: str) -> None:
        self.skipped_items.setdefault(reason, []).append(item)

    def _add(self, parsed: Sample | str, item: str, **ids: Any) -> None:
        """Add a sample, or skip ``item`` for a reason."""
        if isinstance(parsed, str):
            self._skip(parsed, item)
        else:
            self._items.append({**parsed, **ids})

    def __len__(self) -> int:
        return len(self._items)

    def __repr__(self) -> str:
        split = getattr(self, "split", None)
        parts = [f"root={str(self.root)!r}"]
        parts += [] if split is None else [f"split={split!r}"]
        return f"{type(self).__name__}({', '.join(parts)}, {len(self)} objects)"

    def annotation(self, index: int) -> Sample:
        """Sample ``index`` without its ``image``, before ``target_transform``."""
        return {
            key: torch.tensor(value, dtype=torch.float32) if isinstance(value, tuple) else value
            for key, value in self._items[self._checked(index)].items()
        }

    def __getitem__(self, index: int) -> Sample:
        sample = self.annotation(index)
        image = read_image(sample["image_path"])
        if self.target_transform is not None:
            sample = self.target_transform(sample)
        pixels = image if self.transform is None else self.transform(image)
        is_picture = isinstance(pixels, Tensor) and pixels.ndim >= 2
        if is_picture and pixels.shape[-2:] != image.shape[-2:]:
            raise InvalidInputError(
                f"transform: made {tuple(pixels.shape)} of a photograph {tuple(image.shape)}, "
                "whose box, camera and pose do not follow; change the size by transforms=, a "
                "function of image and sample, or use cr.data.crops"
            )
        if self.transforms is not None:
            pixels, sample = self.transforms(pixels, sample)
        return {**sample, "image": pixels}

    def _checked(self, index: object) -> int:
        try:
            number = operator.index(index)  # type: ignore[arg-type]
        except TypeError:
            advice = "take several by torch.utils.data.Subset(dataset, numbers)"
            raise TypeError(
                f"{type(self).__name__}: expected a whole number, got {index!r:.60}; {advice}"
            ) from None
        if not -len(self) <= number < len(self):
            raise IndexError(f"{type(self).__name__}: has {len(self)} objects, got index {number}")
        return number


def existing_root(root: PathName, readme: str) -> Path:
    """``root`` as a path, if it is a folder."""
    path = Path(root)
    if not path.is_dir():
        raise MissingFileError(f"no such folder; {readme} says how to get the data", subject=path)
    return path


def pose_fields(*viewpoint: float) -> Sample:
    """The fields ``viewpoint`` and ``rotation`` of a sample, from azimuth, elevation and theta."""
    rotation = rotation_from_viewpoint(*torch.tensor(viewpoint, dtype=torch.float64).unbind())
    return {"viewpoint": viewpoint, "rotation": tuple(map(tuple, rotation.tolist()))}


def is_plain_name(name: str) -> bool:
    """Whether ``name`` cannot lead out of the folder that it is appended to."""
    return name not in ("", ".", "..") and len(name) <= 200 and not any(c in name for c in "/\\:\0")

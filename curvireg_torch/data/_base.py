"""Base class of the datasets: dict samples, images read on access, a record of skipped objects."""

import os
from collections import Counter
from pathlib import Path
from typing import Any

import torch
from torch.utils.data import Dataset

from ..errors import MissingFileError
from ..geometry import rotation_from_viewpoint
from .images import read_image

Sample = dict[str, Any]
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".JPEG", ".JPG", ".PNG", ".tif", ".tiff")


class ObjectDataset(Dataset[Sample]):
    """One dict per annotated object. The index is built once, photographs are read on access.

    ``skipped_items`` maps reasons to names of skipped objects and files.
    """

    def __init__(self) -> None:
        self.skipped_items: dict[str, list[str]] = {}
        # Numbers instead of tensors: thousands of small tensors exhaust file handles when a worker is spawned.
        self._items: list[Sample] = []

    @property
    def skipped(self) -> Counter[str]:
        """Number of skipped items by reason; ``missing_``, ``corrupt_`` and ``bad_`` mean a defect of the data."""
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

    def annotation(self, index: int) -> Sample:
        """Sample ``index`` without its ``image``."""
        return {
            key: torch.tensor(value, dtype=torch.float32) if isinstance(value, tuple) else value
            for key, value in self._items[index].items()
        }

    def __getitem__(self, index: int) -> Sample:
        sample = self.annotation(index)
        sample["image"] = read_image(sample["image_path"])
        return sample


def existing_root(root: str | os.PathLike[str], readme: str) -> Path:
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

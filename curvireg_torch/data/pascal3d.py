"""PASCAL3D+ 1.1: category-level CAD models aligned with photographs of PASCAL VOC 2012 and
ImageNet."""

import math
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Unpack

from ..errors import CurviregError, InvalidInputError, MissingFileError
from ..formats.pictures import picture_size
from ..utils.aliases import PathName
from ..utils.checks import check_option
from ..utils.files import finite_numbers
from ._base import (
    IMAGE_SUFFIXES,
    ObjectDataset,
    Sample,
    Transforms,
    existing_root,
    is_plain_name,
    pose_fields,
)
from .mat_files import MatStruct, MatValue, objects_of, read_mats

_README = "datasets/pascal3d/README.md"
_VOC_LISTS = Path("PASCAL", "VOCdevkit", "VOC2012", "ImageSets", "Main")


class Pascal3DPlus(ObjectDataset):
    """The annotated objects of PASCAL3D+, one sample each.

    The tree is that of the release: ``Annotations/<class>_<part>/<id>.mat``,
    ``Images/<class>_<part>/<id>.*``, ``CAD/<class>/<NN>.off``. The ids of a class are those not
    marked -1 in ``PASCAL/VOCdevkit/VOC2012/ImageSets/Main/<class>_<split>.txt``; without that list,
    and for the ImageNet part, those of ``Image_sets/<class>_<part>_<split>.txt``.

    Args:
        root: the folder that holds ``Annotations``, ``Images`` and ``CAD``.
        split: name of the image lists, ``"train"`` or ``"val"``.
        categories: class names; None for all that have a list for ``split``, in alphabetical order.
        part: ``"pascal"`` (photographs of VOC 2012) or ``"imagenet"``.
        occluded, truncated, difficult: False skips objects with that flag.
        pixel_origin: coordinate of the first pixel in ``bbox``, ``px`` and ``py``: 1 in the release
            (MATLAB), 0 in sets written from Python. It is subtracted.
        transform, target_transform, transforms: see :class:`ObjectDataset`.

    Samples are dicts (tensors are float32):
        - ``image`` (3, H, W) RGB in [0, 1]; ``image_path``, ``image_id`` str
        - ``box`` (4,) x0, y0, x1, y1: centres of the outermost labelled pixels; may extend beyond
          the image
        - ``viewpoint`` (3,) azimuth, elevation, theta in degrees; ``rotation`` (3, 3) model to
          OpenCV camera
        - ``distance`` float, ``translation`` (3,) = (0, 0, distance), in units of the CAD (about
          its diagonal)
        - ``camera_matrix`` (3, 3): the virtual camera of the annotation, its principal point at the
          object's centre
        - ``category`` str, ``cad_index`` int from 1, ``cad_path`` str
        - ``object_index`` int: index in the annotation file; ``truncated``, ``occluded``,
          ``difficult`` bool

    Reasons in ``skipped``: ``other_class`` (a file lists all objects of the photograph),
    ``occluded``, ``truncated``, ``difficult``, ``no_viewpoint``, ``coarse_viewpoint`` (only coarse
    bins were labelled), ``bad_box`` (no area), ``bad_image_size`` (another one than the annotation
    states), ``missing_annotation``, ``corrupt_annotation``, ``missing_image``, ``missing_mesh``.

    Raises:
        MissingFileError: the root or an image list does not exist.
        InvalidInputError: an option is out of range.

    Example:
        >>> Pascal3DPlus("data/PASCAL3D+_release1.1",
        ...     categories=["car"])[0]["rotation"]  # doctest: +SKIP
    """

    def __init__(
        self,
        root: PathName,
        split: str = "val",
        *,
        categories: Iterable[str] | None = None,
        part: str = "pascal",
        occluded: bool = True,
        truncated: bool = True,
        difficult: bool = True,
        pixel_origin: int = 1,
        **functions: Unpack[Transforms],
    ) -> None:
        super().__init__(existing_root(root, _README), **functions)
        check_option(part, ("pascal", "imagenet"), "part")
        if pixel_origin not in (0, 1):
            raise InvalidInputError(f"pixel_origin: expected 0 or 1, got {pixel_origin}")
        if isinstance(categories, str):
            raise InvalidInputError(
                f"categories: expected a list of names, got the text {categories!r}"
            )
        self.split = split
        self.part = part
        self.categories = sorted(self._listed() if categories is None else set(categories))
        self.pixel_origin = pixel_origin
        self._excluded = {
            "occluded": not occluded,
            "truncated": not truncated,
            "difficult": not difficult,
        }
        for name in (split, *self.categories):
            if not is_plain_name(name):
                raise InvalidInputError(f"split, categories: expected plain names, got {name!r}")
        self._index()

    def _list_files(self, category: str) -> list[Path]:
        own = self.root / "Image_sets" / f"{category}_{self.part}_{self.split}.txt"
        voc = self.root / _VOC_LISTS / f"{category}_{self.split}.txt"
        return [voc, own] if self.part == "pascal" else [own]

    def _listed(self) -> list[str]:
        ending = f"_{self.part}"
        folders = filter(Path.is_dir, (self.root / "Annotations").glob(f"*{ending}"))
        found = [folder.name.removesuffix(ending) for folder in folders]
        names = [name for name in found if any(map(Path.is_file, self._list_files(name)))]
        if not names:
            raise MissingFileError(
                f"no {self.part} image list for split {self.split!r}; {_README} shows the layout",
                subject=self.root,
            )
        return names

    def _ids(self, category: str) -> list[str]:
        for path in self._list_files(category):
            if path.is_file():
                text = path.read_text(encoding="utf-8-sig", errors="replace")
                rows = map(str.split, text.splitlines())
                ids = [row[0] for row in rows if row and row[1:2] != ["-1"]]
                return list(dict.fromkeys(ids))
        names = " or ".join(str(p.relative_to(self.root)) for p in self._list_files(category))
        raise MissingFileError(
            f"no image list {names}; {_README} shows the layout", subject=self.root
        )

    def _files(self) -> Iterator[tuple[str, str, Path, Path]]:
        """Class, id, annotation and photograph of what the lists name."""
        for category in self.categories:
            folder = f"{category}_{self.part}"
            for image_id in self._ids(category):
                annotation = self.root / "Annotations" / folder / f"{image_id}.mat"
                if not is_plain_name(image_id) or not annotation.is_file():
                    self._skip("missing_annotation", f"{folder}/{image_id}")
                    continue
                stem = self.root / "Images" / folder / image_id
                suffixes = (*IMAGE_SUFFIXES, *map(str.upper, IMAGE_SUFFIXES))
                candidates = (stem.with_name(image_id + suffix) for suffix in suffixes)
                image = next(filter(Path.is_file, candidates), None)
                if image is None:
                    self._skip("missing_image", f"{folder}/{image_id}")
                    continue
                yield category, image_id, annotation, image

    def _index(self) -> None:
        files = list(self._files())
        records = read_mats([annotation for _, _, annotation, _ in files], "record")
        for (category, image_id, _, image), record in zip(files, records, strict=True):
            item = f"{category}_{self.part}/{image_id}"
            objects = objects_of(record)
            if objects is None:
                self._skip("corrupt_annotation", item)
                continue
            if _is_resized(image, record):
                self._skip("bad_image_size", item)
                continue
            for index, entry in enumerate(objects):
                ids = {"image_path": str(image), "image_id": image_id, "object_index": index}
                self._add(self._parse(entry, category), f"{item} #{index}", **ids)

    def _parse(self, entry: MatStruct, category: str) -> Sample | str:
        """The sample of one object, or the reason to skip it."""
        name = entry.get("class")
        if not isinstance(name, str):
            return "corrupt_annotation"
        if name != category:
            return "other_class"
        flags = {name: _flag(entry.get(name)) for name in self._excluded}
        if None in flags.values():
            return "corrupt_annotation"
        for name, excluded in self._excluded.items():
            if excluded and flags[name]:
                return name
        box = _box(entry.get("bbox"), self.pixel_origin)
        if box is None:
            return "bad_box"
        views = entry.get("viewpoint")
        view = views[0] if isinstance(views, list) and views else None
        if not isinstance(view, dict):
            return "no_viewpoint"
        azimuth, elevation, distance = (
            _number(view.get(key)) for key in ("azimuth", "elevation", "distance")
        )
        if azimuth is None or elevation is None or not distance:
            return "coarse_viewpoint"
        if distance < 0.0:
            return "corrupt_annotation"
        cad_index = _number(entry.get("cad_index")) or 0.0
        cad = self.root / "CAD" / category / f"{int(cad_index):02d}.off"
        if not 1 <= cad_index < 1000 or not cad.is_file():
            return "missing_mesh"
        return {
            "box": box,
            **pose_fields(azimuth, elevation, _number(view.get("theta")) or 0.0),
            "distance": distance,
            "translation": (0.0, 0.0, distance),
            "camera_matrix": _camera(view, box, self.pixel_origin),
            "category": category,
            "cad_index": int(cad_index),
            "cad_path": str(cad),
            **flags,
        }


def _is_resized(image: Path, record: Any) -> bool:
    """Whether a photograph, as it is stored, has another size than its annotation states, if it
    states one; a file that cannot be read says so when its pixels are."""
    stated = record[0].get("imgsize")
    with suppress(CurviregError):
        height, width = picture_size(image).stored
        return isinstance(stated, list) and stated[:2] not in ([], [width, height])
    return False


def _number(value: MatValue) -> float | None:
    """The first number of ``value`` if it is finite, else None."""
    first = value[0] if isinstance(value, list) and value else None
    return first if isinstance(first, float) and math.isfinite(first) else None


def _flag(value: MatValue) -> bool | None:
    """Whether a flag is set, as a number or a text of one; None for another text."""
    if not isinstance(value, str):
        return bool(_number(value))
    with suppress(ValueError):
        return bool(float(value or 0))
    return None


def _box(value: MatValue, origin: int) -> tuple[float, ...] | None:
    numbers = finite_numbers(value, 4)
    if numbers is None:
        return None
    x0, y0, x1, y1 = (v - origin for v in numbers)
    return (x0, y0, x1, y1) if x1 > x0 and y1 > y0 else None


def _camera(view: MatStruct, box: tuple[float, ...], origin: int) -> tuple[tuple[float, ...], ...]:
    """K of the annotation. Defaults: focal 1, viewport 3000, principal point at the centre of the
    box."""
    focal = (_number(view.get("focal")) or 1.0) * (_number(view.get("viewport")) or 3000.0)
    px = _number(view.get("px"))
    py = _number(view.get("py"))
    cx = (box[0] + box[2]) / 2 if px is None else px - origin
    cy = (box[1] + box[3]) / 2 if py is None else py - origin
    return (focal, 0.0, cx), (0.0, focal, cy), (0.0, 0.0, 1.0)

"""Datasets in the layout of the BOP challenge (scenewise)."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Unpack

import torch

from ..errors import InvalidInputError, MissingFileError
from ..formats.cameras.record import flattened
from ..geometry.cameras import projected_boxes, transform
from ..utils.aliases import Fields, PathName
from ..utils.checks import check_camera_matrix, check_rotation
from ..utils.files import finite_numbers, read_json, without_zeros
from ._base import (
    IMAGE_SUFFIXES,
    ObjectDataset,
    Sample,
    Transforms,
    existing_root,
    is_plain_name,
)
from .bop_models import BOPModels

Matrix = tuple[tuple[float, ...], ...]
Counts = dict[tuple[int, int, int], int]
_README = "datasets/bop/README.md"
_TRUTH = "scene_gt"
_UNKNOWN_BOX = (math.nan,) * 4
MAX_TARGETS = 1000  # of one object in one image: each that is missing is counted by its name
MAX_DIAMETERS = 20.0  # of a mesh over its distance: beyond, it is in mm and the poses in metres


class BOPDataset(ObjectDataset):
    """The annotated object instances of a BOP dataset, one sample each.

    Args:
        root: the folder that holds ``models`` and the split's folder.
        split: folder of the scenes, such as ``"test"`` or ``"train_pbr"``.
        targets: True selects the instances of ``test_targets_bop19.json``, for each image and
            object the ``inst_count`` most visible ones; False selects all; None is True for
            ``"test"`` and splits such as ``"test_primesense"`` if the file exists.
        models: folder of the meshes, such as ``"models_cad"``.
        transform, target_transform, transforms: see :class:`ObjectDataset`.

    Attributes:
        models_info: obj_id -> entry of ``models/models_info.json``, symmetries included; without
            this file the diameters and sizes of the meshes.

    Samples are dicts (tensors are float32):
        - ``image`` (3, H, W) RGB in [0, 1], from ``rgb`` or ``gray``; ``image_path`` str
        - ``box`` (4,) x0, y0, x1, y1 of the whole silhouette, which may extend beyond the image;
          ``box_visible`` (4,) of its visible part, NaN if nothing is visible. BOP's width is x1 -
          x0. Without ``scene_gt_info.json`` the first is that of the mesh at the pose, the second
          NaN
        - ``camera_matrix`` (3, 3); ``rotation`` (3, 3), ``translation`` (3,) in mm: model to OpenCV
          camera; ``T_cam_from_world`` (4, 4) in mm, NaN if unknown
        - ``scene_id``, ``image_id``, ``obj_id`` int; ``instance_index`` int: index in the image's
          list of ``scene_gt``
        - ``visib_fract`` float in [0, 1], NaN if unknown; ``model_path`` str; ``model_info`` dict

    Reasons in ``skipped``: ``no_target``, ``bad_box`` (no area: the object is outside the image),
    ``behind_camera`` (a part of the object; translations may be in another unit than mm),
    ``missing_annotation``, ``corrupt_annotation``, ``missing_image``, ``missing_mesh``,
    ``missing_model_info``.

    Raises:
        MissingFileError: the root, the split's folder, models or a required target list does not
            exist.
        InvalidInputError: one of those files is damaged, two scenes have one number, or meshes have
            another unit than ``models_info.json``.

    Example:
        >>> BOPDataset("data/bop/lm")[0]["translation"]  # doctest: +SKIP
    """

    def __init__(
        self,
        root: PathName,
        split: str = "test",
        *,
        targets: bool | None = None,
        models: str = "models",
        **functions: Unpack[Transforms],
    ) -> None:
        super().__init__(existing_root(root, _README), **functions)
        self.split = split
        scenes = self.root / split
        if not is_plain_name(split) or not scenes.is_dir():
            raise _missing_split(self.root, scenes)
        if not is_plain_name(models):
            raise MissingFileError(
                f"no such folder; {_README} shows the layout", subject=self.root / models
            )
        self.models = models
        self._models = BOPModels(self.root / models)
        self.models_info = self._models.info
        target_file = self.root / "test_targets_bop19.json"
        if targets is None:
            is_test = split == "test" or split.startswith("test_")  # test_primesense
            targets = is_test and target_file.is_file()
        counts = _targets(target_file) if targets else None
        folders = sorted(p for p in scenes.iterdir() if p.is_dir())
        numbered = [folder for folder in folders if folder.name.isdecimal()]
        if folders and not numbered:
            raise MissingFileError(
                f"no scene, which is a folder with a number as 000001; {_README} shows the layout",
                subject=scenes,
            )
        _check_numbers(numbered)
        _check_sensors(scenes, numbered)
        for folder in numbered:
            self._index(folder, counts)
        self._check_unit()
        for (scene_id, image_id, obj_id), missing in sorted((counts or {}).items()):
            for _ in range(missing):
                self._skip(
                    "missing_annotation", f"{split}/{scene_id:06d}/{image_id:06d} object {obj_id}"
                )

    def _check_unit(self) -> None:
        """Refuse meshes that would be less than a pixel wide, or many times as large as they are
        far: their unit is not that of the poses."""
        for item in self._items[:1]:
            depth = item["translation"][2]
            diameter = item["model_info"]["diameter"]
            if 0 < depth < diameter / MAX_DIAMETERS:
                message = (
                    f"at the pose of image {item['image_id']} the mesh is {diameter:.4g} across "
                    f"and {depth:.2g} away: cam_t_m2c in metres? scale it to mm, as the models are"
                )
                raise InvalidInputError(message, subject=item["model_path"])
            width = diameter * item["camera_matrix"][0][0] / max(depth, 1e-9)
            if 0 < width < 1.0:
                message = (
                    f"at the pose of image {item['image_id']} the mesh is {width:.2g} px wide: in "
                    "metres? scale it to mm, as the poses are"
                )
                raise InvalidInputError(message, subject=item["model_path"])

    def _index(self, folder: Path, counts: Counts | None) -> None:
        scene = f"{self.split}/{folder.name}"
        contents: list[Fields] = []
        for name in ("scene_gt.json", "scene_camera.json", "scene_gt_info.json"):
            content = {}
            try:
                content = read_json(folder / name, dict, _README)
            except MissingFileError:
                if name != "scene_gt_info.json":
                    return self._skip("missing_annotation", f"{scene}/{name}")
            except InvalidInputError:
                return self._skip("corrupt_annotation", f"{scene}/{name}")
            contents.append({without_zeros(key): value for key, value in content.items()})
        ground_truth, cameras, infos = contents
        images = _images_by_number(folder)
        for key in sorted(ground_truth, key=lambda k: int(k) if k.isdecimal() else -1):
            item = f"{scene}/{key}"
            instances = ground_truth[key]
            if not key.isdecimal() or not isinstance(instances, list):
                self._skip("corrupt_annotation", item)
                continue
            scene_id = int(folder.name)
            image_id = int(key)
            image = images.get(image_id)
            seen = [entry_at(infos.get(key), index) for index in range(len(instances))]
            left_out = _no_targets(scene_id, image_id, instances, seen, counts)
            for index, (entry, info) in enumerate(zip(instances, seen, strict=True)):
                parsed: Sample | str = "no_target"
                if index not in left_out:
                    parsed = self._parse(entry, info, cameras.get(key))
                    if image is None and not isinstance(parsed, str):
                        parsed = "missing_image"
                ids = {"scene_id": scene_id, "image_id": image_id, "instance_index": index}
                self._add(parsed, f"{item} #{index}", **ids, image_path=str(image))
        return None

    def _parse(self, entry: object, info: Fields, camera: object) -> Sample | str:
        """The sample of one instance, or the reason to skip it."""
        obj_id = _obj_id(entry)
        if not isinstance(entry, dict) or obj_id is None:
            return "corrupt_annotation"
        if not isinstance(camera, dict):
            return "missing_annotation"
        rotation = _rotation(entry.get("cam_R_m2c"))
        translation = finite_numbers(flattened(entry.get("cam_t_m2c")), 3)
        matrix = finite_numbers(flattened(camera.get("cam_K")), 9)
        if rotation is None or translation is None or matrix is None:
            return "corrupt_annotation"
        try:
            check_camera_matrix(torch.tensor(_rows(matrix), dtype=torch.float64), "cam_K")
        except InvalidInputError:
            return "corrupt_annotation"
        if "bbox_obj" in info:
            box = bop_box(info["bbox_obj"])
        elif (box := self._box_of_mesh(obj_id, rotation, translation, _rows(matrix))) is None:
            return "behind_camera"
        if box is None or box[0] == box[2] or box[1] == box[3]:
            return "bad_box"
        model = self._models.files.get(obj_id)
        if model is None:
            return "missing_mesh"
        if obj_id not in self.models_info:
            return "missing_model_info"
        return {
            "box": box,
            "box_visible": bop_box(info.get("bbox_visib")) or _UNKNOWN_BOX,
            "camera_matrix": _rows(matrix),
            "rotation": rotation,
            "translation": translation,
            "T_cam_from_world": _camera_pose(camera),
            "obj_id": obj_id,
            "visib_fract": _visible_fraction(info),
            "model_path": str(model),
            "model_info": self.models_info[obj_id],
        }

    def _box_of_mesh(
        self, obj_id: int, *pose_and_camera: Sequence[Any]
    ) -> tuple[float, ...] | None:
        """The box around the mesh at a pose: (3, 3), (3,) and (3, 3) of rotation, translation and
        camera; None behind the camera, NaN without a mesh."""
        hull = self._models.hull(obj_id) if obj_id in self._models.files else None
        if hull is None:
            return _UNKNOWN_BOX
        R, t, K = (torch.tensor(numbers, dtype=torch.float64) for numbers in pose_and_camera)
        if (hull @ R.T + t)[:, 2].min() <= 0:
            return None
        return tuple(projected_boxes(hull, transform(R, t), K).tolist())


def _missing_split(root: Path, scenes: Path) -> MissingFileError:
    """The error about a split that is not there: it names those that are."""
    found = {file.parents[1] for file in root.glob(f"*/*/{_TRUTH}*.json")}
    # one level below, where the folder of all sets was given
    below = {file.parents[2] for file in root.glob(f"*/*/*/{_TRUTH}*.json")}
    advice = ""
    if found:
        names = ", ".join(sorted(folder.name for folder in found))
        advice = f"the set has {names}: choose {'it' if len(found) == 1 else 'one'} as split; "
    elif below:
        advice = f"give the folder of one set: {', '.join(sorted(map(str, below)))}; "
    return MissingFileError(f"no such folder; {advice}{_README} shows the layout", subject=scenes)


def _check_numbers(numbered: Sequence[Path]) -> None:
    """Refuse scenes whose numbers differ in their zeros alone."""
    by_number: dict[int, Path] = {}
    for folder in numbered:
        other = by_number.setdefault(int(folder.name), folder)
        if other != folder:
            raise InvalidInputError(
                f"has the number of the scene {other.name}; leave one of them out", subject=folder
            )


def _check_sensors(scenes: Path, numbered: Sequence[Path]) -> None:
    """Refuse scenes of several cameras, whose files are called by the camera."""
    if any((folder / f"{_TRUTH}.json").is_file() for folder in numbered):
        return
    files = [file for folder in numbered for file in folder.glob(f"{_TRUTH}_*.json")]
    names = {file.stem.removeprefix(f"{_TRUTH}_") for file in files}
    sensors = sorted(name for name in names if not name.startswith(("info", "coco")))
    if sensors:
        message = (
            f"scenes of several cameras: {', '.join(sensors)}; copy the files of one, such as "
            f"{_TRUTH}_{sensors[0]}.json and rgb_{sensors[0]}, to {_TRUTH}.json and rgb"
        )
        raise InvalidInputError(message, subject=scenes)


def _images_by_number(scene: Path) -> dict[int, Path]:
    """The pictures of a scene by their numbers, whatever zeros are in front; ``rgb`` takes
    precedence over ``gray``."""
    found = {}
    for name in ("gray", "rgb"):
        for path in sorted((scene / name).glob("*")):
            if path.suffix.lower() in IMAGE_SUFFIXES and path.stem.isdecimal():
                found[int(path.stem)] = path
    return found


def _camera_pose(camera: Fields) -> Matrix:
    """(4, 4) pose of the world in a camera of ``scene_camera.json``, NaN if it is not given or not
    rigid."""
    rotation = _rotation(camera.get("cam_R_w2c"))
    translation = finite_numbers(camera.get("cam_t_w2c"), 3)
    if rotation is None or translation is None:
        return ((math.nan,) * 4,) * 4
    rows = zip(rotation, translation, strict=True)
    return *((*row, t) for row, t in rows), (0.0, 0.0, 0.0, 1.0)


def _rotation(values: object) -> Matrix | None:
    """The rotation of 9 numbers; None if they are none."""
    numbers = finite_numbers(flattened(values), 9)
    if numbers is None:
        return None
    try:
        check_rotation(torch.tensor(_rows(numbers), dtype=torch.float64), "rotation")
    except InvalidInputError:
        return None
    return _rows(numbers)


def bop_box(values: object) -> tuple[float, ...] | None:
    """BOP's x, y, width, height as x0, y0, x1, y1; None for no box (BOP writes -1 four times)."""
    numbers = finite_numbers(values, 4)
    if numbers is None or numbers[2] < 0 or numbers[3] < 0:
        return None
    return numbers[0], numbers[1], numbers[0] + numbers[2], numbers[1] + numbers[3]


def _targets(path: Path) -> Counts:
    """(scene_id, im_id, obj_id) -> number of instances to estimate."""
    counts = {}
    for entry in read_json(path, list, _README):
        keys = ("scene_id", "im_id", "obj_id", "inst_count")
        if not isinstance(entry, dict) or not all(isinstance(entry.get(k), int) for k in keys):
            raise InvalidInputError(
                f"expected entries with the numbers {', '.join(keys)}, got {entry!r}", subject=path
            )
        if entry["inst_count"] > MAX_TARGETS:
            raise InvalidInputError(
                f"expected inst_count up to {MAX_TARGETS:,}, got {entry!r}", subject=path
            )
        counts[entry["scene_id"], entry["im_id"], entry["obj_id"]] = entry["inst_count"]
    return counts


def _no_targets(
    scene_id: int,
    image_id: int,
    instances: Sequence[object],
    infos: Sequence[Fields],
    counts: Counts | None,
) -> set[int]:
    """The indices of the instances of one image that are no targets, whether or not they can be
    used; takes those that are, the most visible ones, from ``counts``."""
    left_out: set[int] = set()
    if counts is None:
        return left_out
    visible = [_visible_fraction(info) for info in infos]
    # stable: ties keep their order
    for index in sorted(
        range(len(instances)), key=lambda i: 1.0 if math.isnan(visible[i]) else -visible[i]
    ):
        obj_id = _obj_id(instances[index])
        if obj_id is None:
            continue
        key = (scene_id, image_id, obj_id)
        if counts.get(key, 0) > 0:
            counts[key] -= 1
        else:
            left_out.add(index)
    return left_out


def _obj_id(entry: object) -> int | None:
    """The object of an entry of ``scene_gt.json``; None if it names none."""
    obj_id = entry.get("obj_id") if isinstance(entry, dict) else None
    return obj_id if isinstance(obj_id, int) else None


def _visible_fraction(info: Fields) -> float:
    """NaN if it is not known."""
    visible = finite_numbers([info.get("visib_fract")], 1)
    return math.nan if visible is None else visible[0]


def entry_at(infos: object, index: int) -> Fields:
    """Entry ``index`` of an image's list in ``scene_gt_info.json``, empty if there is none."""
    entry = infos[index] if isinstance(infos, list) and index < len(infos) else None
    return entry if isinstance(entry, dict) else {}


def _rows(values: tuple[float, ...]) -> Matrix:
    return values[:3], values[3:6], values[6:]

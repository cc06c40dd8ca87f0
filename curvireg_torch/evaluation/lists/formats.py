"""Readers of lists of photographs: CSV, JSON, COCO annotations, a scene of a BOP dataset."""

import csv
import io
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ...data.bop import bop_box, entry_at
from ...errors import InvalidInputError, MissingFileError
from ...utils.files import check_table_size, finite_numbers, read_json
from ..store import Row
from .entries import BOX, CAMERA, PhotoList, photo_list

__all__ = ["read_list"]


def read_list(path: Path, meshes: Sequence[Path] = (), limits: Mapping[str, Any] | None = None) -> PhotoList:
    """Read a list of photographs.

    - ``.csv``: a header and the columns of ``photo_list``; blank lines are ignored.
    - ``.json``: a list of objects ``{"photo": "a.jpg", "box": [x0, y0, x1, y1], "camera": [fx, fy, cx, cy], "mesh":
      "part.stl", "azimuth": [300, 60]}``, all but ``photo`` optional; other keys are columns. Or COCO annotations: one
      row each, with ``image_id``, ``annotation_id`` and ``category``; half a pixel is subtracted, as COCO measures from
      the corner.
    - a folder: a scene of a BOP dataset, with the boxes of whole objects, and the models of the dataset if present.

    Args:
        path: the file or folder; paths in it are relative to its folder.
        meshes, limits: for rows that do not give them, as in ``photo_list``.

    Raises:
        MissingFileError: no such file.
        InvalidInputError: another format, or no rows.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp(), "list.json")
        >>> _ = file.write_text('[{"photo": "a.jpg", "box": [1, 2, 30, 40.5], "mesh": "part.stl"}]')
        >>> read_list(file).entries[0].box
        (1.0, 2.0, 30.0, 40.5)
    """
    if path.is_dir():
        return _from_rows(path, _bop_rows(path), path, meshes, limits)
    if not path.is_file():
        raise MissingFileError(f"{path}: no such file; check the path of the list")
    check_table_size(path)
    is_json = path.suffix.lower() == ".json"
    try:
        text = path.read_text(encoding="utf-8-sig")
        if is_json:
            content = json.loads(text)
        else:
            table = csv.reader(io.StringIO(text, newline=""), strict=True)
            columns, *rows = [cells for cells in table if any(map(str.strip, cells))] or [[]]
    except UnicodeDecodeError as error:
        raise InvalidInputError(f"{path}: not a text in UTF-8 ({error}); save it as CSV in UTF-8") from error
    except csv.Error as error:
        raise InvalidInputError(f"{path}: not CSV ({error}); save it as CSV in UTF-8") from error
    except (ValueError, RecursionError) as error:
        raise InvalidInputError(f"{path}: not JSON ({error}); a table of commas is named .csv") from error
    if not is_json:
        return photo_list(str(path), columns, rows, path.parent, meshes, limits)
    if isinstance(content, dict) and {"images", "annotations"} <= set(content):
        return _from_rows(path, _coco_rows(path, content), path.parent, meshes, limits)
    if not isinstance(content, list) or not all(isinstance(row, dict) for row in content):
        raise InvalidInputError(f"{path}: expected a list of objects with photo, box, camera, mesh; or COCO's images")
    return _from_rows(path, [_row(entry) for entry in content], path.parent, meshes, limits)


def _from_rows(
    path: Path, rows: Sequence[Row], folder: Path, meshes: Sequence[Path], limits: Mapping[str, Any] | None
) -> PhotoList:
    columns = list(dict.fromkeys(["photo", *BOX, *(key for row in rows for key in row)]))
    texts = [[_text(row.get(name)) for name in columns] for row in rows]
    return photo_list(str(path), columns, texts, folder, meshes, limits)


def _text(value: Any) -> str:
    return "" if value is None else value if isinstance(value, str) else json.dumps(value)


def _row(entry: Mapping[str, Any]) -> Row:
    """``box`` and ``camera`` as columns; values that are not four numbers are refused later."""
    row: Row = {"photo": entry.get("photo")}
    for key, names in (("box", BOX), ("camera", CAMERA)):
        if (values := entry.get(key)) is not None:
            four = values if isinstance(values, list) and len(values) == 4 else [f"{key} {values}"] * 4
            row |= dict(zip(names, four, strict=True))
    return row | {key: value for key, value in entry.items() if key not in ("photo", "box", "camera")}


def _coco_rows(path: Path, content: Mapping[str, Any]) -> list[Row]:
    try:
        files = {image["id"]: image["file_name"] for image in content["images"]}
        kinds = {kind["id"]: kind["name"] for kind in content.get("categories", [])}
        return [
            {
                "photo": files[annotation["image_id"]],
                **dict(zip(BOX, _coco_corners(annotation.get("bbox")), strict=True)),
                "image_id": annotation["image_id"],
                "annotation_id": annotation.get("id"),
                "category": kinds.get(annotation.get("category_id")),
            }
            for annotation in content["annotations"]
        ]
    except (KeyError, TypeError, AttributeError) as error:
        raise InvalidInputError(f"{path}: not COCO annotations ({type(error).__name__}: {error})") from error


def _coco_corners(bbox: object) -> Sequence[float | str]:
    box = finite_numbers(bbox, 4)
    if box is None:
        return ["no bbox"] * 4
    return [box[0] - 0.5, box[1] - 0.5, box[0] + box[2] - 0.5, box[1] + box[3] - 0.5]


def _bop_rows(folder: Path) -> list[Row]:
    names = ("scene_camera.json", "scene_gt.json", "scene_gt_info.json")
    readme = "--list takes the folder of a BOP scene; datasets/README.md"
    contents = [read_json(folder / name, dict, readme) for name in names]
    try:
        return list(_bop_objects(folder, *contents))
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise InvalidInputError(f"{folder}: not a scene of a BOP set ({type(error).__name__}: {error})") from error


def _bop_objects(folder: Path, cameras: Any, truths: Any, infos: Any) -> Iterator[Row]:
    """Rows of a scene; a text in place of a missing or invalid value makes the row fail later."""
    for key, objects in truths.items():
        pictures = [f"{kind}/{key.zfill(6)}{end}" for kind in ("rgb", "gray") for end in (".png", ".jpg", ".tif")]
        photo = next((name for name in pictures if (folder / name).is_file()), pictures[0])
        camera = cameras.get(key)
        K = finite_numbers(camera.get("cam_K") if isinstance(camera, dict) else None, 9) or ["no cam_K"] * 9
        for index, truth in enumerate(objects):
            number = truth.get("obj_id") if isinstance(truth, dict) else None
            model = f"../../models/obj_{number:06d}.ply" if isinstance(number, int) else None
            box = bop_box(entry_at(infos.get(key), index).get("bbox_obj")) or ["no bbox_obj"] * 4
            yield {
                "photo": photo,
                **dict(zip(BOX, box, strict=True)),
                **dict(zip(CAMERA, (K[0], K[4], K[2], K[5]), strict=True)),
                "mesh": model if model and (folder / model).is_file() else None,
                "scene_id": int(folder.resolve().name),
                "im_id": int(key) if key.isdecimal() else key,
                "obj_id": number,
            }

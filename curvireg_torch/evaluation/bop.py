"""BOP sets: poses, their errors and the file of results for the BOP challenge."""

import os
import re
import warnings
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from ..data import BOPDataset
from ..data.bop_models import model_files, read_models_info
from ..errors import CurviregError, CurviregWarning, MeshError
from ..formats.meshes.files import read_mesh
from ..geometry import symmetry_transforms
from ..geometry.cameras import transform
from ..jobs.entry import Entry
from ..jobs.store import Row, Rows
from ..utils.files import write_csv
from . import metrics
from .benchmark import Benchmark, Errors, estimated_rotations, true_rotations
from .metrics import symmetric_rotation_error
from .protocol import Protocol, random_numbers

UNOCCLUDED = 0.95  # visible fraction from which an object of a BOP set counts as whole


NO_VSD = (
    "BOP's AR is the mean of VSD, MSSD and MSPD; VSD needs depth images, which are not used here: "
    "ar_rgb is without it"
)


# diameters within which the positions in the world of one instance agree, in different photographs
SAME_PLACE = 0.1


class BOPBenchmark(Benchmark):
    """Poses on one BOP dataset. The method gets the box of the whole silhouette and the camera
    matrix."""

    name = "bop"
    unit = "mm"
    mesh = "model_path"
    gives_camera = True
    groups = ("per_object", "obj_id")
    label = "{scene_id}/{image_id}/{instance_index}"
    page_error = "rotation"
    measures: ClassVar = {
        "acc_15_deg": ("rotation", (15.0,)),
        "acc_30_deg": ("rotation", (30.0,)),
        "add_recall_0.1d": ("add", metrics.ADD_THRESHOLDS),
        "mssd_ar": ("mssd", metrics.MSSD_THRESHOLDS),
        "mspd_ar": ("mspd", metrics.MSPD_THRESHOLDS),
    }
    dataset: BOPDataset

    def __init__(self, dataset: BOPDataset, protocol: Protocol) -> None:
        super().__init__(dataset, protocol)
        folder = dataset.root / "models_eval"
        infos = folder / "models_info.json"
        self._scored_files = model_files(folder)
        self._scored_infos = read_models_info(infos) if infos.is_file() else {}
        self._scored_points: dict[int, Tensor] = {}
        self._read_scored_models()
        if protocol.views > 1:
            for group in same_instances(self.samples):
                views = [self._views(i, group) for i in group]
                for i, others in zip(group, views, strict=True):
                    self.entries[i] = replace(self.entries[i], views=others)
            few = sum(len(entry.views) + 1 < protocol.views for entry in self.entries)
            if few:
                seen = f"{few} of {len(self.entries)} objects are seen in fewer photographs"
                warnings.warn(f"views={protocol.views}: {seen}", CurviregWarning, stacklevel=2)

    def _read_scored_models(self) -> None:
        """Read the models of ``models_eval`` before anything is registered, and leave out the
        objects whose model is damaged."""
        for number in sorted({s["obj_id"] for s in self.samples} & self._scored_files.keys()):
            try:
                self._scored_points[number] = read_points(self._scored_files[number])
            except CurviregError as error:
                message = f"{error}; object {number} is left out"
                warnings.warn(message, CurviregWarning, stacklevel=3)
                for i, sample in enumerate(self.samples):
                    if sample["obj_id"] == number:
                        self.entries[i] = replace(self.entries[i], error="unreadable_mesh")

    def settings(self) -> Row:
        return {**super().settings(), "models": self.dataset.models}

    def _views(self, first: int, group: Sequence[int]) -> tuple[Entry, ...]:
        """Photographs drawn from those of ``group`` to be registered together with that of the
        sample ``first``."""
        image = self.samples[first]["image_id"]
        others = [i for i in group if self.samples[i]["image_id"] != image]
        generator = random_numbers(self.protocol, f"views {self.entries[first].label}")
        order = torch.randperm(len(others), generator=generator).tolist()[: self.protocol.views - 1]
        return tuple(self._other_view(first, others[k]) for k in order)

    def _other_view(self, first: int, other: int) -> Entry:
        entry = self.entries[other]
        one, two = (self.samples[i] for i in (first, other))
        T_one = one["T_cam_from_world"].double()
        T_two = two["T_cam_from_world"].double()
        # the object stands still: it is the world
        if not bool((T_one.isfinite() & T_two.isfinite()).all()):
            T_one, T_two = (
                transform(s["rotation"].double(), s["translation"].double()) for s in (one, two)
            )
        box = None if entry.error else entry.box
        T = T_two @ torch.linalg.inv(T_one)
        return replace(entry, box=box, prior=None, T_cam_from_world=T)

    def errors(self, samples: Rows, rows: Rows) -> dict[str, Tensor]:
        """Rotation errors in degrees, ADD(-S) and MSSD in diameters, MSPD in image widths."""
        names = ("rotation", "add", "mssd", "mspd")
        errors = torch.full((len(names), len(rows)), torch.inf, dtype=torch.float64)
        objects: dict[int, list[int]] = defaultdict(list)
        for i, (sample, row) in enumerate(zip(samples, rows, strict=True)):
            if "rotation" in row:
                objects[sample["obj_id"]].append(i)
        for chosen in objects.values():
            errors[:, chosen] = self._errors_of_one_object(
                [samples[i] for i in chosen], [rows[i] for i in chosen]
            )
        return dict(zip(names, errors, strict=True))

    def _errors_of_one_object(self, samples: Rows, rows: Rows) -> Tensor:
        path, info = self._scored_model(samples[0])
        points = self._scored_points.get(samples[0]["obj_id"])
        if points is None:
            points = read_points(path)
        symmetries = symmetry_transforms(info)
        t = torch.tensor([row["translation"] for row in rows], dtype=torch.float64)
        t_true, K = (
            torch.stack([s[name].double() for s in samples])
            for name in ("translation", "camera_matrix")
        )
        R = estimated_rotations(rows)
        R_true = true_rotations(samples)
        T = transform(R, t)
        T_true = transform(R_true, t_true)
        rotation = symmetric_rotation_error(R, R_true, symmetries[:, :3, :3])
        add = (metrics.adds_error if len(symmetries) > 1 else metrics.add_error)(T, T_true, points)
        mssd = metrics.mssd_error(T, T_true, points, symmetries=symmetries)
        mspd = metrics.mspd_error(T, T_true, points, K, symmetries=symmetries)
        width = torch.tensor(
            [row["inputs"]["picture"]["width"] for row in rows], dtype=torch.float64
        )
        return torch.stack(
            [rotation, add / info["diameter"], mssd / info["diameter"], mspd / width]
        )

    def _scored_model(self, sample: Row) -> tuple[Path, Row]:
        """The model that errors are of, with its diameter and symmetries: that of ``models_eval``,
        as the BOP challenge has it, where there is one."""
        number = sample["obj_id"]
        info: Row = sample["model_info"]
        if number not in self._scored_files:
            return Path(sample["model_path"]), info
        return self._scored_files[number], self._scored_infos.get(number, info)

    def scores(self, rows: Rows, errors: Errors, chosen: list[int]) -> Row:
        """Rotation errors up to the symmetries, ADD(-S) recall, average recall of MSSD and MSPD,
        and ``ar_rgb``, the mean of these two."""
        recalls = {}
        for name in ("add_recall_0.1d", "mssd_ar", "mspd_ar"):
            error, thresholds = self.measures[name]
            recalls[name] = metrics.average_recall(errors[error][chosen], thresholds)
        both = (recalls["mssd_ar"] + recalls["mspd_ar"]) / 2.0
        return {**self.rotation_scores(errors["rotation"][chosen]), **recalls, "ar_rgb": both}

    def summary(self, samples: Rows, rows: Rows, errors: Errors) -> Row:
        folders = {s["obj_id"]: self._scored_model(s)[0].parent.name for s in samples}
        models = {
            name: sorted(key for key, folder in folders.items() if folder == name)
            for name in folders.values()
        }
        return {**super().summary(samples, rows, errors), "models": models, "vsd": NO_VSD}

    def results_name(self, settings: Row) -> str:
        """METHOD_DATASET-SPLIT.csv, which bop_toolkit takes apart at these signs."""
        method = f"curvireg-{settings.get('preset', 'custom')}"
        dataset = re.sub("[_-]", "", Path(os.path.abspath(self.dataset.root)).name)
        return f"{method}_{dataset}-{self.dataset.split.replace('_', '-')}.csv"

    def subsets(self, samples: Rows) -> dict[str, list[bool]]:
        return {"unoccluded": [s["visib_fract"] >= UNOCCLUDED for s in samples]}

    def write_predictions(self, path: Path, samples: Rows, rows: Rows, errors: Errors) -> None:
        """The results file of the BOP challenge, with all digits; it omits objects without an
        estimate."""
        images = [(s["scene_id"], s["image_id"]) for s in samples]
        # BOP wants equal seconds in all lines of an image
        times: dict[tuple[int, int], float] = defaultdict(float)
        for image, row in zip(images, rows, strict=True):
            times[image] += row["seconds"]["register"]
        lines: list[Sequence[object]] = [("scene_id", "im_id", "obj_id", "score", "R", "t", "time")]
        for image, s, row in zip(images, samples, rows, strict=True):
            if "rotation" in row:
                R, t = (
                    " ".join(map(str, v)) for v in (chain(*row["rotation"]), row["translation"])
                )
                lines.append((*image, s["obj_id"], row["score"], R, t, times[image]))
        write_csv(path, lines)


def read_points(path: Path) -> Tensor:
    """(V, 3) float64 vertices of a model, with those that no face uses, as bop_toolkit takes them;
    :class:`MeshError` if it is damaged."""
    vertices = np.asarray(read_mesh(path).vertices, dtype=np.float64)
    points = vertices[np.isfinite(vertices).all(axis=1)]
    if len(points) == 0:
        raise MeshError("has no vertices; re-export the file", subject=path)
    return torch.from_numpy(points)


def same_instances(samples: Rows) -> list[list[int]]:
    """Groups of the samples of a BOP set that show the same instance of an object in photographs of
    one scene.

    Where the poses of the cameras are known, an instance is told by its place in the world.
    Elsewhere, objects of one kind in the same photograph are told apart by their place in its list.
    """
    counts = Counter((s["scene_id"], s["obj_id"], s["image_id"]) for s in samples)
    repeated = {key[:2] for key, count in counts.items() if count > 1}
    groups: dict[tuple[int, ...], list[list[int]]] = defaultdict(list)
    worlds = [s["T_cam_from_world"].double() for s in samples]
    places = [
        T[:3, :3].mT @ (s["translation"].double() - T[:3, 3])
        for T, s in zip(worlds, samples, strict=True)
    ]
    for i, (sample, place) in enumerate(zip(samples, places, strict=True)):
        kind: tuple[int, ...] = (sample["scene_id"], sample["obj_id"])
        if bool(place.isnan().any()):
            kind = (*kind, sample["instance_index"] if kind in repeated else -1)
        reach = SAME_PLACE * sample["model_info"]["diameter"]
        for group in groups[kind]:
            if not float((place - places[group[0]]).norm()) > reach:  # or NaN
                group.append(i)
                break
        else:
            groups[kind].append([i])
    return [group for found in groups.values() for group in found]

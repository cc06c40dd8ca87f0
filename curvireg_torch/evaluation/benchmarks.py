"""Datasets as evaluation sees them: the objects to register, and the scores of the results."""

import math
import re
from abc import ABC, abstractmethod
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

from ..data import BOPDataset, Pascal3DPlus, PoseFolder
from ..data.bop_models import model_files, read_models_info
from ..errors import InvalidInputError
from ..geometry import Camera, symmetry_transforms, viewpoint_from_rotation
from ..geometry.cameras import transform
from ..geometry.crops import box_iou
from ..geometry.pose_prior import object_frame
from ..mesh import load_mesh
from ..mesh.mesh import format_up
from ..utils.files import write_csv
from . import metrics
from .metrics import symmetric_rotation_error
from .photograph import Entry
from .protocol import Protocol, hint_of_truth, perturbed_box, random_numbers
from .result_files import View
from .store import Row

MIN_IOU = 0.5  # intersection over union from which a box is right
UNOCCLUDED = 0.95  # visible fraction from which an object of a BOP set counts as whole
RESULTS_OF_BOP = "curvireg-*_*-*.csv"  # results by the name that bop_toolkit asks for
NO_VSD = (
    "BOP's AR is the mean of VSD, MSSD and MSPD; VSD needs depth images, which are not used "
    "here: "
    "ar_rgb is without it"
)
# diameters within which the positions in the world of one instance agree, in different photographs
SAME_PLACE = 0.1

Errors = Mapping[str, Tensor]


class Benchmark(ABC):
    """A dataset with the protocol of its evaluation, and its scores.

    Attributes:
        name, unit: kind of dataset, and unit of its meshes.
        label: format of the entries' labels, from a sample.
        mesh: key of the mesh in a sample.
        gives_camera: whether the method gets the camera matrix.
        thresholds: degrees of the accuracies in the summary.
        groups: name of the groups that are scored by themselves, and key of the group in a sample.
        columns: of the table of predictions.
        reports: names of the files that are written from all results.
        page_error: name of the error by which the page of the best and the worst marks an object:
            that up to symmetries, where they are known.
        measures: scores that are means over the objects: name of the error, and thresholds below
            which it is right.
        dataset, protocol: as given.
        samples, entries: annotations without photographs, and what is registered, in the order of
            the dataset.

    Raises:
        InvalidInputError: a ``cad`` that the dataset cannot offer, or ``views`` without poses of
            the cameras.
    """

    name: ClassVar[str]
    unit: ClassVar[str] = "m"
    label: ClassVar[str]
    mesh: ClassVar[str] = "mesh_path"
    gives_camera: ClassVar[bool] = False
    thresholds: ClassVar[Mapping[str, float]] = {"acc_15_deg": 15.0, "acc_30_deg": 30.0}
    groups: ClassVar[tuple[str, str]] = ("per_object", "category")
    columns: ClassVar[Sequence[str]] = ()
    reports: ClassVar[Sequence[str]] = (
        "summary.json",
        "predictions.csv",
        "errors.csv",
        "index.html",
    )
    page_error: ClassVar[str] = "error_deg"
    measures: ClassVar[Mapping[str, tuple[str, Sequence[float]]]] = {
        "acc_15_deg": ("error_deg", (15.0,)),
        "acc_30_deg": ("error_deg", (30.0,)),
    }

    def __init__(self, dataset: Pascal3DPlus | BOPDataset | PoseFolder, protocol: Protocol) -> None:
        if protocol.views > 1 and not self.gives_camera:
            raise InvalidInputError(
                "protocol: views needs a dataset with cameras, such as a BOP set; leave it out"
            )
        self.dataset = dataset
        self.protocol = protocol
        self.samples = [dataset.annotation(i) for i in range(len(dataset))]
        self.entries = [self._entry(sample) for sample in self.samples]

    def selection(self, limit: int | None) -> list[int]:
        """Indices of ``limit`` objects spread evenly over the dataset, or of all."""
        n = len(self.entries)
        count = n if limit is None else min(limit, n)
        return [i * n // count for i in range(count)]

    def copies(self, samples: Sequence[Row]) -> list[list[Row]]:
        """For each of some samples, all samples of the same object or class in its photograph,
        itself first."""
        groups = defaultdict[Any, list[Row]](list)
        key = self.groups[1]
        for sample in self.samples:
            groups[sample["image_path"], sample[key]].append(sample)
        return [
            [one, *(s for s in groups[one["image_path"], one[key]] if s is not one)]
            for one in samples
        ]

    def settings(self) -> Row:
        """What results depend on besides pipeline and protocol."""
        split = getattr(self.dataset, "split", None)  # folders of the user have none
        return {"dataset": self.name, "root": str(self.dataset.root.resolve()), "split": split}

    def meshes(self, sample: Row) -> tuple[Path, ...]:
        """Meshes that an object is registered to: its own; other datasets may offer more."""
        if self.protocol.cad != "annotated":
            raise InvalidInputError(
                f"protocol: each object of this dataset has one mesh, so cad=annotated; got "
                f"cad={self.protocol.cad}"
            )
        return (Path(sample[self.mesh]),)

    def _entry(self, sample: Row) -> Entry:
        label = self.label.format_map(sample)
        meshes = self.meshes(sample)
        photo = Path(sample["image_path"])
        box = sample["box"]
        protocol = self.protocol
        error = "" if meshes else "no_other_cad"
        if protocol.box is not None and not bool(box.isfinite().all()):
            error = "unknown_box"
        frame = object_frame(format_up(Path(sample[self.mesh]).suffix))
        return Entry(
            name=str(photo.relative_to(self.dataset.root)),
            photo=photo,
            meshes=meshes,
            box=None
            if protocol.box is None
            else tuple(perturbed_box(box, protocol, label).tolist()),
            camera=Camera(sample["camera_matrix"]) if self.gives_camera else None,
            prior=hint_of_truth(sample["rotation"], frame, protocol, label),
            as_stored=True,
            label=label,
            error=error,
        )

    def errors(self, samples: Sequence[Row], rows: Sequence[Row]) -> dict[str, Tensor]:
        """Errors (N,) by name, float64: ``inf`` for a miss, NaN where the truth is unknown."""
        R = estimated_rotations(rows)
        truth = true_rotations(samples)
        known = truth.isfinite().flatten(1).all(1)
        errors = torch.full((len(rows),), torch.nan, dtype=torch.float64)
        errors[known] = symmetric_rotation_error(R[known], truth[known], _HALF_TURN[:0])
        return {"error_deg": errors}

    @abstractmethod
    def scores(self, rows: Sequence[Row], errors: Errors, chosen: list[int]) -> Row:
        """Scores of the chosen results."""

    def subsets(self, samples: Sequence[Row]) -> dict[str, list[bool]]:
        """Which objects belong to each subset that is scored by itself."""
        return {}

    def summary(self, samples: Sequence[Row], rows: Sequence[Row], errors: Errors) -> Row:
        """Scores of the results ``rows``, none of them skipped: of all, of subsets, and of each
        group."""
        numbers, (name, key), groups = (
            range(len(rows)),
            self.groups,
            defaultdict[Any, list[int]](list),
        )
        for i, sample in enumerate(samples):
            groups[sample[key]].append(i)
        subsets = {
            subset: self.scores(rows, errors, [i for i in numbers if members[i]])
            for subset, members in self.subsets(samples).items()
        }
        return {
            **self.scores(rows, errors, list(numbers)),
            **({"subsets": subsets} if subsets else {}),
            name: {
                str(group): self.scores(rows, errors, groups[group]) for group in sorted(groups)
            },
        }

    def rotation_scores(self, errors: Tensor) -> Row:
        """``n``, an accuracy for each threshold, and ``med_err_deg``, of errors (N,) in degrees."""
        accuracies = {
            name: metrics.average_recall(errors, (degrees,))
            for name, degrees in self.thresholds.items()
        }
        return {"n": len(errors), **accuracies, "med_err_deg": metrics.median_error(errors)}

    def write_predictions(
        self, path: Path, samples: Sequence[Row], rows: Sequence[Row], errors: Errors
    ) -> None:
        """Write one line for each object: its annotation, the estimate, errors, the true angles,
        ``true_azimuth``..."""
        names = ("azimuth", "elevation", "theta")
        R = estimated_rotations(rows)
        lines: list[Sequence[object]] = [self.columns]
        for i, (sample, row) in enumerate(zip(samples, rows, strict=True)):
            line = {
                **sample,
                **row,
                "seconds": row["seconds"]["register"],
                "failed": row["message"],
            }
            line |= {
                f"true_{name}": float(v) for name, v in zip(names, sample["viewpoint"], strict=True)
            }
            line |= {name: float(values[i]) for name, values in errors.items()}
            if "rotation" in row:
                line |= {
                    n: float(v) for n, v in zip(names, viewpoint_from_rotation(R[i]), strict=True)
                }
                line["mesh"] = Path(row["mesh"]).name
            lines.append([_cell(line.get(name, "")) for name in self.columns])
        write_csv(path, lines)

    def write_errors(
        self, path: Path, keys: Sequence[str], samples: Sequence[Row], errors: Errors
    ) -> None:
        """Write one line for each object with all digits of its errors: ``inf`` for a miss, empty
        where the truth is unknown."""
        lines: list[Sequence[object]] = [("key", "group", *errors)]
        for i, (key, sample) in enumerate(zip(keys, samples, strict=True)):
            values = [float(error[i]) for error in errors.values()]
            cells = ["" if math.isnan(value) else repr(value) for value in values]
            lines.append((key, sample[self.groups[1]], *cells))
        write_csv(path, lines)

    def results_name(self, settings: Row) -> str | None:
        """Name of a copy of the predictions that a benchmark's own tools ask for, if there are such
        tools."""
        return None


def _cell(value: object) -> object:
    if isinstance(value, bool):
        return int(value)
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.6g}"
    return value


_HALF_TURN = torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64))[None]


def _axis_error(R: Tensor, truth: Tensor) -> Tensor:
    """Angles (N,) in degrees between the z axes of models: the least rotation error over all
    rotations about z.

    Computed from the chord, since ``acos`` loses digits near 0.
    """
    half_chord = (R[..., 2] - truth[..., 2]).norm(dim=-1) / 2.0
    return torch.rad2deg(2.0 * half_chord.clamp(max=1.0).asin())


SYMMETRIES: dict[str, tuple[str, Callable[[Tensor, Tensor], Tensor]]] = {
    "bottle": ("any rotation about z", _axis_error),
    "diningtable": (
        "half a rotation about z",
        lambda R, truth: symmetric_rotation_error(R, truth, _HALF_TURN),
    ),
}
"""Classes of PASCAL3D+ whose objects have the same, or nearly the same, appearance from several
azimuths."""


class Pascal3DBenchmark(Benchmark):
    """Viewpoints on PASCAL3D+. The method gets no camera: viewpoints are relative to a camera that
    looks at the box."""

    name = "pascal3d"
    label = "{category}/{image_id}/{object_index}"
    mesh = "cad_path"
    thresholds: ClassVar = {"acc_pi_6": 30.0, "acc_pi_18": 10.0}
    groups = ("per_class", "category")
    page_error = "symmetric_error_deg"
    measures: ClassVar = {
        "acc_pi_6": ("error_deg", (30.0,)),
        "acc_pi_18": ("error_deg", (10.0,)),
        "symmetric_acc_pi_6": ("symmetric_error_deg", (30.0,)),
        "symmetric_acc_pi_18": ("symmetric_error_deg", (10.0,)),
    }
    flags = ("truncated", "occluded", "difficult")
    columns = (
        *(
            "image_id",
            "object_index",
            "category",
            "cad_index",
            "mesh",
            "azimuth",
            "elevation",
            "theta",
        ),
        *(
            "true_azimuth",
            "true_elevation",
            "true_theta",
            "error_deg",
            "symmetric_error_deg",
            "score",
            "confidence",
        ),
        *(*flags, "failed", "seconds"),
    )
    dataset: Pascal3DPlus

    def meshes(self, sample: Row) -> tuple[Path, ...]:
        if self.protocol.cad == "annotated":
            return super().meshes(sample)
        annotated = Path(sample["cad_path"])
        cads = sorted(annotated.parent.glob("*.off"))
        if self.protocol.cad == "any":
            return tuple(cads)
        others = [cad for cad in cads if cad.name != annotated.name]
        generator = random_numbers(self.protocol, f"cad {self.label.format_map(sample)}")
        order = torch.randperm(len(others), generator=generator).tolist()
        return tuple(others[k] for k in order[:1])

    def settings(self) -> Row:
        return {
            **super().settings(),
            "part": self.dataset.part,
            "pixel_origin": self.dataset.pixel_origin,
        }

    def errors(self, samples: Sequence[Row], rows: Sequence[Row]) -> dict[str, Tensor]:
        R = estimated_rotations(rows)
        truth = true_rotations(samples)
        plain = symmetric = super().errors(samples, rows)["error_deg"]
        for category, (_, error) in SYMMETRIES.items():
            mask = torch.tensor([s["category"] == category for s in samples], dtype=torch.bool)
            symmetric = torch.where(mask & plain.isfinite(), error(R, truth), symmetric)
        return {"error_deg": plain, "symmetric_error_deg": symmetric}

    def scores(self, rows: Sequence[Row], errors: Errors, chosen: list[int]) -> Row:
        """Acc(pi/6), Acc(pi/18) and MedErr, also up to the symmetries of the classes."""
        plain, aware = (self.rotation_scores(each[chosen]) for each in errors.values())
        del aware["n"]
        return {**plain, "symmetry_aware": aware}

    def subsets(self, samples: Sequence[Row]) -> dict[str, list[bool]]:
        easy = [not any(s[flag] for flag in self.flags) for s in samples]
        return {"easy": easy, **{flag: [s[flag] for s in samples] for flag in self.flags}}

    def summary(self, samples: Sequence[Row], rows: Sequence[Row], errors: Errors) -> Row:
        """Scores as :meth:`Benchmark.summary`, also as plain means over the classes, and those of
        easy objects by class, as some tables have them."""
        summary = super().summary(samples, rows, errors)
        easy = self.subsets(samples)["easy"]
        classes = defaultdict[str, list[int]](list)
        for i, sample in enumerate(samples):
            if easy[i]:
                classes[sample["category"]].append(i)
        easy_scores = {name: self.scores(rows, errors, classes[name]) for name in sorted(classes)}
        summary["subsets"]["easy"] |= {
            "per_class": easy_scores,
            "mean_over_classes": mean_scores(easy_scores),
        }
        summary["mean_over_classes"] = mean_scores(summary["per_class"])
        summary["symmetries"] = {name: text for name, (text, _) in SYMMETRIES.items()}
        return summary


def mean_scores(groups: Mapping[str, Row]) -> Row:
    """Plain means of the scores of some groups, which may hold scores themselves, and
    ``n_classes``, their number.

    Groups of few objects count as much as others.
    """
    rows = list(groups.values())
    if not rows:
        return {"n_classes": 0}
    means: Row = {"n_classes": len(rows)}
    for name, value in rows[0].items():
        if isinstance(value, dict):
            means[name] = mean_scores({group: row[name] for group, row in groups.items()})
            del means[name]["n_classes"]
        elif name != "n":
            means[name] = sum(row[name] for row in rows) / len(rows)
    return means


class PoseFolderBenchmark(Benchmark):
    """Viewpoints in folders of the user. The method is given the box and the object's mesh, and no
    camera.

    Photographs of unknown pose are registered too. They count in ``n``, ``reliable`` and
    ``mean_confidence``; accuracy and errors are those of the ``n_posed`` others.
    """

    name = "web"
    label = "{category}/{object_index}"
    columns = (
        *(
            "category",
            "object_index",
            "image_id",
            "azimuth",
            "elevation",
            "theta",
            "true_azimuth",
            "true_elevation",
        ),
        *("true_theta", "error_deg", "score", "confidence", "reliable", "failed", "seconds"),
    )
    dataset: PoseFolder

    def scores(self, rows: Sequence[Row], errors: Errors, chosen: list[int]) -> Row:
        """Accuracy at 15 and 30 degrees and the median error where the pose is known; confidence of
        all."""
        posed = errors["error_deg"][chosen]
        posed = posed[~posed.isnan()]
        scores = (
            self.rotation_scores(posed)
            if len(posed)
            else dict.fromkeys((*self.thresholds, "med_err_deg"))
        )
        confidences = [rows[i].get("confidence") or 0.0 for i in chosen]
        return {
            **scores,
            "n": len(chosen),
            "n_posed": len(posed),
            "reliable": sum(bool(rows[i].get("reliable")) for i in chosen),
            "mean_confidence": sum(confidences) / len(chosen) if chosen else None,
        }


class BOPBenchmark(Benchmark):
    """Poses on one BOP dataset. The method gets the box of the whole silhouette and the camera
    matrix."""

    name = "bop"
    unit = "mm"
    mesh = "model_path"
    gives_camera = True
    groups = ("per_object", "obj_id")
    label = "{scene_id}/{image_id}/{instance_index}"
    reports = (*Benchmark.reports, RESULTS_OF_BOP)
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
        if protocol.views > 1:
            for group in same_instances(self.samples):
                views = [self._views(i, group) for i in group]
                for i, others in zip(group, views, strict=True):
                    self.entries[i] = replace(self.entries[i], views=others)

    def _views(self, first: int, group: Sequence[int]) -> tuple[View, ...]:
        """Photographs drawn from those of ``group`` to be registered together with that of the
        sample ``first``."""
        image = self.samples[first]["image_id"]
        others = [i for i in group if self.samples[i]["image_id"] != image]
        generator = random_numbers(self.protocol, f"views {self.entries[first].label}")
        order = torch.randperm(len(others), generator=generator).tolist()[: self.protocol.views - 1]
        return tuple(self._other_view(first, others[k]) for k in order)

    def _other_view(self, first: int, other: int) -> View:
        entry, (one, two) = self.entries[other], (self.samples[i] for i in (first, other))
        T_one = one["T_cam_from_world"].double()
        T_two = two["T_cam_from_world"].double()
        # the object stands still: it is the world
        if not bool((T_one.isfinite() & T_two.isfinite()).all()):
            T_one, T_two = (
                transform(s["rotation"].double(), s["translation"].double()) for s in (one, two)
            )
        assert isinstance(entry.camera, Camera)
        box = None if entry.error else entry.box
        return View(entry.name, entry.photo, box, entry.camera, T_two @ torch.linalg.inv(T_one))

    def errors(self, samples: Sequence[Row], rows: Sequence[Row]) -> dict[str, Tensor]:
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

    def _errors_of_one_object(self, samples: Sequence[Row], rows: Sequence[Row]) -> Tensor:
        path, info = self._scored_model(samples[0])
        points = torch.from_numpy(load_mesh(path, unit=self.unit).vertices.copy())
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

    def scores(self, rows: Sequence[Row], errors: Errors, chosen: list[int]) -> Row:
        """Rotation errors up to the symmetries, ADD(-S) recall, average recall of MSSD and MSPD,
        and ``ar_rgb``, the mean of these two."""
        recalls = {}
        for name in ("add_recall_0.1d", "mssd_ar", "mspd_ar"):
            error, thresholds = self.measures[name]
            recalls[name] = metrics.average_recall(errors[error][chosen], thresholds)
        both = (recalls["mssd_ar"] + recalls["mspd_ar"]) / 2.0
        return {**self.rotation_scores(errors["rotation"][chosen]), **recalls, "ar_rgb": both}

    def summary(self, samples: Sequence[Row], rows: Sequence[Row], errors: Errors) -> Row:
        folders = {s["obj_id"]: self._scored_model(s)[0].parent.name for s in samples}
        models = {
            name: sorted(key for key, folder in folders.items() if folder == name)
            for name in folders.values()
        }
        return {**super().summary(samples, rows, errors), "models": models, "vsd": NO_VSD}

    def results_name(self, settings: Row) -> str:
        """METHOD_DATASET-SPLIT.csv, which bop_toolkit takes apart at these signs."""
        method = f"curvireg-{settings.get('preset', 'custom')}"
        dataset = re.sub("[_-]", "", self.dataset.root.resolve().name)
        return f"{method}_{dataset}-{self.dataset.split.replace('_', '-')}.csv"

    def subsets(self, samples: Sequence[Row]) -> dict[str, list[bool]]:
        return {"unoccluded": [s["visib_fract"] >= UNOCCLUDED for s in samples]}

    def write_predictions(
        self, path: Path, samples: Sequence[Row], rows: Sequence[Row], errors: Errors
    ) -> None:
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


def copy_shown(copies: Sequence[Row], row: Row) -> Row:
    """Of the ``copies`` of an object in a photograph, that which the box of a result overlaps most;
    the first one if it overlaps none. Where no box is given, each of them is a right answer."""
    if "rotation" not in row:
        return copies[0]
    boxes = torch.stack([copy["box"].double() for copy in copies])
    overlap = box_iou(boxes, torch.tensor([row["inputs"]["box"]], dtype=torch.float64))[
        :, 0
    ].nan_to_num(0.0)
    return copies[int(overlap.argmax())]


def detection_recall(copies: Sequence[Sequence[Row]], rows: Sequence[Row]) -> Row:
    """``recall_1``, ``recall_5``, ``recall_20``: fractions of ``n`` objects one of whose annotated
    ``copies`` is among the best proposals.

    Boxes are clipped to the image on both sides: some datasets annotate the visible part, some the
    whole object. A row that failed has no proposals, unless the object was not found among them.
    Recalls are None if no box is annotated.
    """
    ranks = []
    for group, row in zip(copies, rows, strict=True):
        if boxes := [copy["box"] for copy in group if bool(copy["box"].isfinite().all())]:
            ranks.append(min(_rank(box, row) for box in boxes))
    recalls = {
        f"recall_{k}": sum(rank <= k for rank in ranks) / len(ranks) if ranks else None
        for k in (1, 5, 20)
    }
    return {"n": len(ranks), **recalls}


def _rank(box: Tensor, row: Row) -> float:
    """Rank of the first right proposal, from 1; infinite if none is right."""
    if "detection" not in row:
        return math.inf
    boxes = [proposal["box"] for proposal in row["detection"]["proposals"]]
    proposals = torch.tensor(boxes, dtype=torch.float64).view(-1, 4)
    picture = row["inputs"]["picture"]
    end = torch.tensor([picture["width"], picture["height"]] * 2, dtype=torch.float64) - 0.5
    clipped = [
        torch.minimum(boxes.clamp(min=-0.5), end) for boxes in (proposals, box.double()[None])
    ]
    right = (box_iou(*clipped)[:, 0] >= MIN_IOU).nonzero()[:, 0]
    return float(right[0]) + 1 if len(right) else math.inf


def same_instances(samples: Sequence[Row]) -> list[list[int]]:
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
        # or NaN
        near = [
            group for group in groups[kind] if not float((place - places[group[0]]).norm()) > reach
        ]
        if near:
            near[0].append(i)
        else:
            groups[kind].append([i])
    return [group for found in groups.values() for group in found]


def estimated_rotations(rows: Sequence[Row]) -> Tensor:
    """(N, 3, 3) float64; NaN for rows without an estimate."""
    missing = [[math.nan] * 3] * 3
    return torch.tensor([row.get("rotation", missing) for row in rows], dtype=torch.float64).view(
        -1, 3, 3
    )


def true_rotations(samples: Sequence[Row]) -> Tensor:
    """(N, 3, 3) float64; NaN where the pose is unknown."""
    return torch.cat([_HALF_TURN[:0], *(sample["rotation"].double()[None] for sample in samples)])

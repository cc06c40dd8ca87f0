"""Datasets as evaluation sees them: the conditions, the objects to register, and the scores of the results."""

import hashlib
import math
from abc import ABC, abstractmethod
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

from ..data import BOPDataset, Pascal3DPlus, PoseFolder
from ..errors import InvalidInputError
from ..geometry import Camera, rotation_from_axis_angle, symmetry_transforms, viewpoint_from_rotation
from ..geometry.cameras import transform
from ..geometry.crops import box_iou
from ..geometry.pose_prior import PosePrior, object_frame
from ..mesh import load_mesh
from ..mesh.mesh import format_up
from ..utils.checks import check_integer, check_option
from ..utils.files import write_csv
from . import metrics
from .metrics import symmetric_rotation_error
from .photograph import Entry
from .result_files import View
from .store import Row

MIN_IOU = 0.5  # intersection over union from which a box is right
UNOCCLUDED = 0.95  # visible fraction above which an object of a BOP set counts as whole
SAME_PLACE = 0.1  # diameters within which the positions in the world of one instance agree, in different photographs

Errors = Mapping[str, Tensor]


@dataclass(frozen=True)
class Protocol:
    """The information that the method gets about an object, besides the photograph.

    Attributes:
        cad: "annotated": that CAD. "any": all CADs of the class, the best wins.
        pose: pose prior: "upright" or "any".
        box: 0: as annotated; x > 0 moves each edge at random by up to x of the side; None: the object is detected.
        hint: "azimuth:45": the azimuth lies within 45 degrees of a value that is itself up to 45 degrees off;
            "pose:45": the same of the whole rotation; "none".
        views: photographs of one pose that are registered together, each once as the first; for datasets of cameras.
        seed: of the random numbers, which depend on the object's label besides.

    Raises:
        InvalidInputError: an unknown choice, a box outside [0, 0.45], a hint outside (0, 180), or fewer than one view.

    Example:
        >>> protocol = Protocol.parse(["cad=any", "box=0.1"])
        >>> str(protocol)
        'cad=any pose=upright box=0.1 seed=0'
        >>> str(Protocol(pose="any"))
        'cad=annotated pose=any box=annotated'
    """

    cad: str = "annotated"
    pose: str = "upright"
    box: float | None = 0.0
    hint: str = "none"
    views: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        check_option(self.cad, ("annotated", "any"), "cad")
        check_option(self.pose, ("upright", "any"), "pose")
        if self.box is not None and not 0.0 <= self.box <= 0.45:
            raise InvalidInputError(f"box: expected a fraction in [0, 0.45], got {self.box}")
        if self.hint != "none":
            self.hint_tolerance()
        check_integer(self.views, "views")
        if self.seed and str(self) == str(replace(self, seed=0)):
            raise InvalidInputError("protocol: seed: nothing is drawn at random; leave it out")
        if self.views > 1 and self.hint != "none":
            raise InvalidInputError("protocol: hints are given with one photograph; leave hint or views out")

    @classmethod
    def parse(cls, words: Iterable[str], *, pose: str = "upright") -> "Protocol":
        """Parse words KEY=VALUE; ``box=annotated`` is 0, ``box=none`` is None. ``pose`` is the default of that key."""
        values: dict[str, str | float | int | None] = {"pose": pose}
        named = {"annotated": 0.0, "none": None}
        for word in words:
            key, _, value = word.partition("=")
            check_option(key, [f.name for f in fields(cls)], "protocol")
            try:
                if key == "box":
                    values[key] = named[value] if value in named else float(value)
                else:
                    values[key] = int(value) if key in ("seed", "views") else value
            except ValueError as error:
                raise InvalidInputError(f"protocol: expected {key}=NUMBER, got {word!r}") from error
        return cls(**values)  # type: ignore[arg-type]

    def hint_tolerance(self) -> tuple[str, float]:
        """Kind of the hint and its tolerance in degrees."""
        kind, _, text = self.hint.partition(":")
        try:
            degrees = float(text)
        except ValueError as error:
            raise InvalidInputError(f"hint: expected azimuth:DEGREES or pose:DEGREES, got {self.hint!r}") from error
        check_option(kind, ("azimuth", "pose"), "hint")
        if not 0.0 < degrees < 180.0:
            raise InvalidInputError(f"hint: expected degrees in (0, 180), got {self.hint!r}")
        return kind, degrees

    def __str__(self) -> str:
        box = "none" if self.box is None else f"{self.box:g}" if self.box else "annotated"
        hint = "" if self.hint == "none" else f" hint={self.hint}"
        views = "" if self.views == 1 else f" views={self.views}"
        seed = f" seed={self.seed}" if self.box or hint or views else ""
        return f"cad={self.cad} pose={self.pose} box={box}{hint}{views}{seed}"


def perturbed_box(box: Tensor, protocol: Protocol, label: str) -> Tensor:
    """The box (4,) in px that the method gets for ``label``: edges move by up to ``protocol.box`` of a side."""
    if not protocol.box:
        return box
    offset = 2.0 * torch.rand(4, generator=random_numbers(protocol, label), dtype=torch.float64) - 1.0
    sides = (box[2:] - box[:2]).repeat(2)
    return (box + protocol.box * offset * sides).to(box.dtype)


def hint_of_truth(rotation: Tensor, frame: Tensor, protocol: Protocol, label: str) -> PosePrior | None:
    """The hint about the object ``label``: a range around its true pose moved at random by up to half its width.

    ``rotation`` (3, 3) is the true one, NaN where it is unknown, ``frame`` that of the mesh, see
    :func:`curvireg_torch.geometry.pose_prior.object_frame`.
    """
    if protocol.hint == "none" or not bool(rotation.isfinite().all()):
        return None
    kind, degrees = protocol.hint_tolerance()
    generator = random_numbers(protocol, f"hint {label}")
    R = rotation.double()
    if kind == "azimuth":
        offset = degrees * (2.0 * torch.rand((), generator=generator, dtype=torch.float64) - 1.0)
        centre = float(viewpoint_from_rotation(R @ frame.mT)[0] + offset)
        return PosePrior(azimuth=((centre - degrees) % 360.0, (centre + degrees) % 360.0))
    axis = torch.nn.functional.normalize(torch.randn(3, generator=generator, dtype=torch.float64), dim=0)
    angle = torch.deg2rad(degrees * torch.rand((), generator=generator, dtype=torch.float64))
    return PosePrior(rotation=rotation_from_axis_angle(axis * angle) @ R, within=degrees)


def random_numbers(protocol: Protocol, label: str) -> torch.Generator:
    """The generator that draws what the protocol leaves to chance about the object ``label``."""
    seed = int.from_bytes(hashlib.sha256(f"{protocol.seed} {label}".encode()).digest()[:7])
    return torch.Generator().manual_seed(seed)


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
        dataset, protocol: as given.
        samples, entries: annotations without photographs, and what is registered, in the order of the dataset.

    Raises:
        InvalidInputError: a ``cad`` that the dataset cannot offer, or ``views`` without poses of the cameras.
    """

    name: ClassVar[str]
    unit: ClassVar[str] = "m"
    label: ClassVar[str]
    mesh: ClassVar[str] = "mesh_path"
    gives_camera: ClassVar[bool] = False
    thresholds: ClassVar[Mapping[str, float]] = {"acc_15_deg": 15.0, "acc_30_deg": 30.0}
    groups: ClassVar[tuple[str, str]] = ("per_object", "category")
    columns: ClassVar[Sequence[str]] = ()
    reports: ClassVar[Sequence[str]] = ("summary.json", "predictions.csv", "errors.csv", "index.html")

    def __init__(self, dataset: Pascal3DPlus | BOPDataset | PoseFolder, protocol: Protocol) -> None:
        if protocol.views > 1 and not self.gives_camera:
            raise InvalidInputError("protocol: views needs a dataset with cameras, such as a BOP set; leave it out")
        self.dataset, self.protocol = dataset, protocol
        self.samples = [dataset.annotation(i) for i in range(len(dataset))]
        self.entries = [self._entry(sample) for sample in self.samples]

    def selection(self, limit: int | None) -> list[int]:
        """Indices of ``limit`` objects spread evenly over the dataset, or of all."""
        n = len(self.entries)
        count = n if limit is None else min(limit, n)
        return [i * n // count for i in range(count)]

    def copies(self, samples: Sequence[Row]) -> list[list[Row]]:
        """For each of some samples, all samples of the same object or class in its photograph, itself first."""
        groups, key = defaultdict[Any, list[Row]](list), self.groups[1]
        for sample in self.samples:
            groups[sample["image_path"], sample[key]].append(sample)
        return [[one, *(s for s in groups[one["image_path"], one[key]] if s is not one)] for one in samples]

    def settings(self) -> Row:
        """What results depend on besides pipeline and protocol."""
        split = getattr(self.dataset, "split", None)  # folders of the user have none
        return {"dataset": self.name, "root": str(self.dataset.root.resolve()), "split": split}

    def meshes(self, sample: Row) -> tuple[Path, ...]:
        """Meshes that an object is registered to: its own; other datasets may offer more."""
        if self.protocol.cad != "annotated":
            raise InvalidInputError(
                f"protocol: each object of this dataset has one mesh, so cad=annotated; got cad={self.protocol.cad}"
            )
        return (Path(sample[self.mesh]),)

    def _entry(self, sample: Row) -> Entry:
        label, meshes, photo = self.label.format_map(sample), self.meshes(sample), Path(sample["image_path"])
        box, protocol = sample["box"], self.protocol
        unknown = protocol.box is not None and not bool(box.isfinite().all())
        return Entry(
            name=str(photo.relative_to(self.dataset.root)),
            photo=photo,
            meshes=meshes,
            box=None if protocol.box is None else tuple(perturbed_box(box, protocol, label).tolist()),
            camera=Camera(sample["camera_matrix"]) if self.gives_camera else None,
            prior=hint_of_truth(sample["rotation"], object_frame(format_up(meshes[0].suffix)), protocol, label),
            as_stored=True,
            label=label,
            error="unknown_box" if unknown else "",
        )

    def errors(self, samples: Sequence[Row], rows: Sequence[Row]) -> dict[str, Tensor]:
        """Errors (N,) by name, float64: ``inf`` for a miss, NaN where the truth is unknown. The first one orders."""
        R, truth = estimated_rotations(rows), true_rotations(samples)
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
        """Scores of the results ``rows``, none of them skipped: of all, of subsets, and of each group."""
        numbers, (name, key), groups = range(len(rows)), self.groups, defaultdict[Any, list[int]](list)
        for i, sample in enumerate(samples):
            groups[sample[key]].append(i)
        subsets = {
            subset: self.scores(rows, errors, [i for i in numbers if members[i]])
            for subset, members in self.subsets(samples).items()
        }
        return {
            **self.scores(rows, errors, list(numbers)),
            **({"subsets": subsets} if subsets else {}),
            name: {str(group): self.scores(rows, errors, groups[group]) for group in sorted(groups)},
        }

    def rotation_scores(self, errors: Tensor) -> Row:
        """``n``, an accuracy for each threshold, and ``med_err_deg``, of errors (N,) in degrees."""
        accuracies = {name: metrics.average_recall(errors, (degrees,)) for name, degrees in self.thresholds.items()}
        return {"n": len(errors), **accuracies, "med_err_deg": metrics.median_error(errors)}

    def write_predictions(self, path: Path, samples: Sequence[Row], rows: Sequence[Row], errors: Errors) -> None:
        """Write one line for each object: its annotation, the estimate, errors, the true angles, ``true_azimuth``..."""
        names, R = ("azimuth", "elevation", "theta"), estimated_rotations(rows)
        lines: list[Sequence[object]] = [self.columns]
        for i, (sample, row) in enumerate(zip(samples, rows, strict=True)):
            line = {**sample, **row, "seconds": row["seconds"]["register"], "failed": row["message"]}
            line |= {f"true_{name}": float(v) for name, v in zip(names, sample["viewpoint"], strict=True)}
            line |= {name: float(values[i]) for name, values in errors.items()}
            if "rotation" in row:
                line |= {n: float(v) for n, v in zip(names, viewpoint_from_rotation(R[i]), strict=True)}
                line["mesh"] = Path(row["mesh"]).name
            lines.append([_cell(line.get(name, "")) for name in self.columns])
        write_csv(path, lines)


def _cell(value: object) -> object:
    if isinstance(value, bool):
        return int(value)
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.6g}"
    return value


_HALF_TURN = torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64))[None]


def _axis_error(R: Tensor, truth: Tensor) -> Tensor:
    """Angles (N,) in degrees between the z axes of models: the least rotation error over all rotations about z.

    Computed from the chord, since ``acos`` loses digits near 0.
    """
    half_chord = (R[..., 2] - truth[..., 2]).norm(dim=-1) / 2.0
    return torch.rad2deg(2.0 * half_chord.clamp(max=1.0).asin())


SYMMETRIES: dict[str, tuple[str, Callable[[Tensor, Tensor], Tensor]]] = {
    "bottle": ("any rotation about z", _axis_error),
    "diningtable": ("half a rotation about z", lambda R, truth: symmetric_rotation_error(R, truth, _HALF_TURN)),
}
"""Classes of PASCAL3D+ whose objects have the same, or nearly the same, appearance from several azimuths."""


class Pascal3DBenchmark(Benchmark):
    """Viewpoints on PASCAL3D+. The method gets no camera: viewpoints are relative to a camera that looks at the box."""

    name, label, mesh = "pascal3d", "{category}/{image_id}/{object_index}", "cad_path"
    thresholds: ClassVar = {"acc_pi_6": 30.0, "acc_pi_18": 10.0}
    groups = ("per_class", "category")
    flags = ("truncated", "occluded", "difficult")
    columns = (
        *("image_id", "object_index", "category", "cad_index", "mesh", "azimuth", "elevation", "theta"),
        *("true_azimuth", "true_elevation", "true_theta", "error_deg", "symmetric_error_deg", "score", "confidence"),
        *(*flags, "failed", "seconds"),
    )
    dataset: Pascal3DPlus

    def meshes(self, sample: Row) -> tuple[Path, ...]:
        if self.protocol.cad == "annotated":
            return super().meshes(sample)
        return tuple(sorted(Path(sample["cad_path"]).parent.glob("*.off")))

    def settings(self) -> Row:
        return {**super().settings(), "part": self.dataset.part, "pixel_origin": self.dataset.pixel_origin}

    def errors(self, samples: Sequence[Row], rows: Sequence[Row]) -> dict[str, Tensor]:
        R, truth = estimated_rotations(rows), true_rotations(samples)
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
        symmetries = {name: text for name, (text, _) in SYMMETRIES.items()}
        return {**super().summary(samples, rows, errors), "symmetries": symmetries}


class PoseFolderBenchmark(Benchmark):
    """Viewpoints in folders of the user. The method is given the box and the object's mesh, and no camera.

    Photographs of unknown pose are registered too. They count in ``n``, ``reliable`` and ``mean_confidence``; accuracy
    and errors are those of the ``n_posed`` others.
    """

    name, label = "web", "{category}/{object_index}"
    columns = (
        *("category", "object_index", "image_id", "azimuth", "elevation", "theta", "true_azimuth", "true_elevation"),
        *("true_theta", "error_deg", "score", "confidence", "reliable", "failed", "seconds"),
    )
    dataset: PoseFolder

    def scores(self, rows: Sequence[Row], errors: Errors, chosen: list[int]) -> Row:
        """Accuracy at 15 and 30 degrees and the median error where the pose is known; confidence of all."""
        posed = errors["error_deg"][chosen]
        posed = posed[~posed.isnan()]
        scores = self.rotation_scores(posed) if len(posed) else dict.fromkeys((*self.thresholds, "med_err_deg"))
        confidences = [rows[i].get("confidence") or 0.0 for i in chosen]
        return {
            **scores,
            "n": len(chosen),
            "n_posed": len(posed),
            "reliable": sum(bool(rows[i].get("reliable")) for i in chosen),
            "mean_confidence": sum(confidences) / len(chosen) if chosen else None,
        }


class BOPBenchmark(Benchmark):
    """Poses on one BOP dataset. The method gets the box of the whole silhouette and the camera matrix."""

    name, unit, mesh, gives_camera = "bop", "mm", "model_path", True
    groups = ("per_object", "obj_id")
    label = "{scene_id}/{image_id}/{instance_index}"
    dataset: BOPDataset

    def __init__(self, dataset: BOPDataset, protocol: Protocol) -> None:
        super().__init__(dataset, protocol)
        if protocol.views > 1:
            for group in same_instances(self.samples):
                views = [self._views(i, group) for i in group]
                for i, others in zip(group, views, strict=True):
                    self.entries[i] = replace(self.entries[i], views=others)

    def _views(self, first: int, group: Sequence[int]) -> tuple[View, ...]:
        """Photographs drawn from those of ``group`` to be registered together with that of the sample ``first``."""
        image = self.samples[first]["image_id"]
        others = [i for i in group if self.samples[i]["image_id"] != image]
        generator = random_numbers(self.protocol, f"views {self.entries[first].label}")
        order = torch.randperm(len(others), generator=generator).tolist()[: self.protocol.views - 1]
        return tuple(self._other_view(first, others[k]) for k in order)

    def _other_view(self, first: int, other: int) -> View:
        entry, (one, two) = self.entries[other], (self.samples[i] for i in (first, other))
        T_one, T_two = one["T_cam_from_world"].double(), two["T_cam_from_world"].double()
        if not bool((T_one.isfinite() & T_two.isfinite()).all()):  # the object stands still: it is the world
            T_one, T_two = (transform(s["rotation"].double(), s["translation"].double()) for s in (one, two))
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
            errors[:, chosen] = self._errors_of_one_object([samples[i] for i in chosen], [rows[i] for i in chosen])
        return dict(zip(names, errors, strict=True))

    def _errors_of_one_object(self, samples: Sequence[Row], rows: Sequence[Row]) -> Tensor:
        info = samples[0]["model_info"]
        points = torch.from_numpy(load_mesh(samples[0]["model_path"], unit=self.unit).vertices.copy())
        symmetries = symmetry_transforms(info)
        t = torch.tensor([row["translation"] for row in rows], dtype=torch.float64)
        t_true, K = (torch.stack([s[name].double() for s in samples]) for name in ("translation", "camera_matrix"))
        R, R_true = estimated_rotations(rows), true_rotations(samples)
        T, T_true = transform(R, t), transform(R_true, t_true)
        rotation = symmetric_rotation_error(R, R_true, symmetries[:, :3, :3])
        add = (metrics.adds_error if len(symmetries) > 1 else metrics.add_error)(T, T_true, points)
        mssd = metrics.mssd_error(T, T_true, points, symmetries=symmetries)
        mspd = metrics.mspd_error(T, T_true, points, K, symmetries=symmetries)
        width = torch.tensor([row["inputs"]["picture"]["width"] for row in rows], dtype=torch.float64)
        return torch.stack([rotation, add / info["diameter"], mssd / info["diameter"], mspd / width])

    def scores(self, rows: Sequence[Row], errors: Errors, chosen: list[int]) -> Row:
        """Rotation errors up to the symmetries, ADD(-S) recall, average recall of MSSD and MSPD."""
        return {
            **self.rotation_scores(errors["rotation"][chosen]),
            "add_recall_0.1d": metrics.average_recall(errors["add"][chosen], metrics.ADD_THRESHOLDS),
            "mssd_ar": metrics.average_recall(errors["mssd"][chosen], metrics.MSSD_THRESHOLDS),
            "mspd_ar": metrics.average_recall(errors["mspd"][chosen], metrics.MSPD_THRESHOLDS),
        }

    def subsets(self, samples: Sequence[Row]) -> dict[str, list[bool]]:
        return {"unoccluded": [s["visib_fract"] > UNOCCLUDED for s in samples]}

    def write_predictions(self, path: Path, samples: Sequence[Row], rows: Sequence[Row], errors: Errors) -> None:
        """The results file of the BOP challenge, with all digits; it omits objects without an estimate."""
        images = [(s["scene_id"], s["image_id"]) for s in samples]
        times: dict[tuple[int, int], float] = defaultdict(float)  # BOP wants equal seconds in all lines of an image
        for image, row in zip(images, rows, strict=True):
            times[image] += row["seconds"]["register"]
        lines: list[Sequence[object]] = [("scene_id", "im_id", "obj_id", "score", "R", "t", "time")]
        for image, s, row in zip(images, samples, rows, strict=True):
            if "rotation" in row:
                R, t = (" ".join(map(str, v)) for v in (chain(*row["rotation"]), row["translation"]))
                lines.append((*image, s["obj_id"], row["score"], R, t, times[image]))
        write_csv(path, lines)


def copy_shown(copies: Sequence[Row], row: Row) -> Row:
    """Of the ``copies`` of an object in a photograph, that which the box of a result overlaps most; the first one if it
    overlaps none. Where no box is given, each of them is a right answer."""
    if "rotation" not in row:
        return copies[0]
    boxes = torch.stack([copy["box"].double() for copy in copies])
    overlap = box_iou(boxes, torch.tensor([row["inputs"]["box"]], dtype=torch.float64))[:, 0].nan_to_num(0.0)
    return copies[int(overlap.argmax())]


def detection_recall(copies: Sequence[Sequence[Row]], rows: Sequence[Row]) -> Row:
    """``recall_1``, ``recall_5``, ``recall_20``: fractions of ``n`` objects one of whose annotated ``copies`` is among
    the best proposals.

    Boxes are clipped to the image on both sides: some datasets annotate the visible part, some the whole object. A row
    that failed has no proposals, unless the object was not found among them. Recalls are None if no box is annotated.
    """
    ranks = []
    for group, row in zip(copies, rows, strict=True):
        if boxes := [copy["box"] for copy in group if bool(copy["box"].isfinite().all())]:
            ranks.append(min(_rank(box, row) for box in boxes))
    recalls = {f"recall_{k}": sum(rank <= k for rank in ranks) / len(ranks) if ranks else None for k in (1, 5, 20)}
    return {"n": len(ranks), **recalls}


def _rank(box: Tensor, row: Row) -> float:
    """Rank of the first right proposal, from 1; infinite if none is right."""
    if "detection" not in row:
        return math.inf
    boxes = [proposal["box"] for proposal in row["detection"]["proposals"]]
    proposals = torch.tensor(boxes, dtype=torch.float64).view(-1, 4)
    picture = row["inputs"]["picture"]
    end = torch.tensor([picture["width"], picture["height"]] * 2, dtype=torch.float64) - 0.5
    clipped = [torch.minimum(boxes.clamp(min=-0.5), end) for boxes in (proposals, box.double()[None])]
    right = (box_iou(*clipped)[:, 0] >= MIN_IOU).nonzero()[:, 0]
    return float(right[0]) + 1 if len(right) else math.inf


def same_instances(samples: Sequence[Row]) -> list[list[int]]:
    """Groups of the samples of a BOP set that show the same instance of an object in photographs of one scene.

    Where the poses of the cameras are known, an instance is told by its place in the world. Elsewhere, objects of one
    kind in the same photograph are told apart by their place in its list.
    """
    counts = Counter((s["scene_id"], s["obj_id"], s["image_id"]) for s in samples)
    repeated = {key[:2] for key, count in counts.items() if count > 1}
    groups: dict[tuple[int, ...], list[list[int]]] = defaultdict(list)
    worlds = [s["T_cam_from_world"].double() for s in samples]
    places = [T[:3, :3].mT @ (s["translation"].double() - T[:3, 3]) for T, s in zip(worlds, samples, strict=True)]
    for i, (sample, place) in enumerate(zip(samples, places, strict=True)):
        kind: tuple[int, ...] = (sample["scene_id"], sample["obj_id"])
        if bool(place.isnan().any()):
            kind = (*kind, sample["instance_index"] if kind in repeated else -1)
        reach = SAME_PLACE * sample["model_info"]["diameter"]
        near = [group for group in groups[kind] if not float((place - places[group[0]]).norm()) > reach]  # or NaN
        if near:
            near[0].append(i)
        else:
            groups[kind].append([i])
    return [group for found in groups.values() for group in found]


def estimated_rotations(rows: Sequence[Row]) -> Tensor:
    """(N, 3, 3) float64; NaN for rows without an estimate."""
    missing = [[math.nan] * 3] * 3
    return torch.tensor([row.get("rotation", missing) for row in rows], dtype=torch.float64).view(-1, 3, 3)


def true_rotations(samples: Sequence[Row]) -> Tensor:
    """(N, 3, 3) float64; NaN where the pose is unknown."""
    return torch.cat([_HALF_TURN[:0], *(sample["rotation"].double()[None] for sample in samples)])

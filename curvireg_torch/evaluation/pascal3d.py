"""PASCAL3D+: viewpoints, also up to the symmetries of its classes."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from ..data import Pascal3DPlus
from ..jobs.store import Row, Rows
from .benchmark import VIEWPOINT_COLUMNS, Benchmark, Errors, estimated_rotations, true_rotations
from .metrics import symmetric_rotation_error
from .protocol import random_numbers

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
        "image_id",
        "object_index",
        "category",
        "cad_index",
        "mesh",
        *VIEWPOINT_COLUMNS,
        "symmetric_error_deg",
        "score",
        "confidence",
        *flags,
        "failed",
        "seconds",
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

    def errors(self, samples: Rows, rows: Rows) -> dict[str, Tensor]:
        R = estimated_rotations(rows)
        truth = true_rotations(samples)
        plain = symmetric = super().errors(samples, rows)["error_deg"]
        for category, (_, error) in SYMMETRIES.items():
            mask = torch.tensor([s["category"] == category for s in samples], dtype=torch.bool)
            symmetric = torch.where(mask & plain.isfinite(), error(R, truth), symmetric)
        return {"error_deg": plain, "symmetric_error_deg": symmetric}

    def scores(self, rows: Rows, errors: Errors, chosen: list[int]) -> Row:
        """Acc(pi/6), Acc(pi/18) and MedErr, also up to the symmetries of the classes."""
        plain, aware = (self.rotation_scores(each[chosen]) for each in errors.values())
        del aware["n"]
        return {**plain, "symmetry_aware": aware}

    def subsets(self, samples: Rows) -> dict[str, list[bool]]:
        easy = [not any(s[flag] for flag in self.flags) for s in samples]
        return {"easy": easy, **{flag: [s[flag] for s in samples] for flag in self.flags}}

    def summary(self, samples: Rows, rows: Rows, errors: Errors) -> Row:
        """Scores as :meth:`Benchmark.summary`, also as plain means over the classes, and those of
        easy objects by class, as some tables have them."""
        summary = super().summary(samples, rows, errors)
        easy = [i for i, is_easy in enumerate(self.subsets(samples)["easy"]) if is_easy]
        easy_scores = self.scores_of_groups(samples, rows, errors, easy)
        summary["subsets"]["easy"] |= {
            "per_class": easy_scores,
            "mean_over_classes": _mean_scores(easy_scores),
        }
        summary["mean_over_classes"] = _mean_scores(summary["per_class"])
        summary["symmetries"] = {name: text for name, (text, _) in SYMMETRIES.items()}
        return summary


def _mean_scores(groups: Mapping[str, Row]) -> Row:
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
            means[name] = _mean_scores({group: row[name] for group, row in groups.items()})
            del means[name]["n_classes"]
        elif name != "n":
            means[name] = sum(row[name] for row in rows) / len(rows)
    return means

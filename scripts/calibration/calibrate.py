"""Fit the constants of confidence, covariance, detection, refinement and following on generated
photographs.

    python scripts/calibration/calibrate.py WORK [--meshes FURNITURE] [--count 400] [--write]
        [--models instance]

The script renders the sets of sets.json that WORK lacks (the object's own mesh, also cut by the
border, half hidden, grey, or with several poses that look alike; a similar one; a wrong one, or one
with another print; and sequences), registers, refines, follows and detects their objects into
WORK/*.jsonl, and fits. Everything depends on the seeds in the file alone: an interrupted run goes
on, with any number of --jobs, as rows of the same photographs and code are kept. FURNITURE, the
folder of scripts/benchmark/meshes.py, adds real meshes to the procedural ones. Folds are by kind of
object, so every measure is of kinds that the fit has not seen. --write stores the constants in
curvireg_torch/calibration/calibration.json and their quality in scripts/results/calibration.json.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

from curvireg_torch.registration.confidence import RELIABLE
from scripts._shared import REPOSITORY, RESULTS, Record, read_json, run, stamp, write_json
from scripts.calibration.fits import first_probability, fit_logistic, fit_registrations
from scripts.calibration.measure import rows_of
from scripts.calibration.sets import KINDS, MODELS, render_sets, sets_of

LEVELS = (0.5, 0.9)  # of ellipsoids whose coverage is measured
CONSTANTS = REPOSITORY / "curvireg_torch" / "calibration" / "calibration.json"


def calibrate(
    work: Path,
    jobs: int,
    models: Sequence[str],
    meshes: Path | None,
) -> tuple[Record, Record]:
    """Constants, those of other ``models`` as they were, and quality of the new ones on held-out
    kinds of objects."""
    constants: Record = read_json(CONSTANTS)
    quality: Record = {}
    for name in models:
        if name in KINDS:
            rows = rows_of(work, KINDS[name], jobs)
            constants[name] = fit_logistic(rows, np.ones(len(rows)), {})
            continue
        rows = [row for chosen in sets_of([name], meshes) for row in rows_of(work, chosen, jobs)]
        constants[name], quality[name] = fit_registrations(rows, exact=name == "instance")
        sure = [row for row in rows if first_probability(row, constants[name]) >= RELIABLE]
        distances = [row["distance2"] for row in sure if row["first"] and "distance2" in row]
        if distances:
            quality[name] |= covariance_quality(distances, constants["covariance_scale"])
    return constants, quality


def covariance_quality(distances: ArrayLike, scale: float) -> Record:
    """What covariances are worth, from squared Mahalanobis distances (n,) of reliable and right
    poses to the truth: shares within the ellipsoids of 50 % and 90 %, and the ``covariance_scale``
    with which 90 % would lie within the latter."""
    distances = np.asarray(distances)
    within = {f"{level:.0%}": (distances < chi2.ppf(level, 6)).mean() for level in LEVELS}
    wanted = scale * np.quantile(distances, 0.9) / chi2.ppf(0.9, 6)
    return {
        "covariances": len(distances),
        "within": within,
        "covariance_scale": round(float(wanted), 3),
    }


def main(
    work: Path,
    *,
    meshes: Path | None = None,
    count: int = 400,
    models: list[Literal[*MODELS]] = tuple(MODELS),
    jobs: int = 1,
    write: bool = False,
) -> None:
    render_sets(work, meshes, count, jobs, models)
    constants, quality = calibrate(work, jobs, models, meshes)
    record = stamp() | {"constants": constants, "held out": quality}
    print(json.dumps(record, indent=2))
    if write:
        write_json(CONSTANTS, constants)
        write_json(RESULTS / "calibration.json", record)


if __name__ == "__main__":
    run(main)

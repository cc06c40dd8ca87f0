"""Compare the share of right answers that `curvireg inspect` predicts with what is measured.

    python scripts/inspection/validate.py WORK [--meshes FURNITURE] [--data BOP --rows EVAL]

Two tables. On generated scenes: of 30 meshes (procedural, tied and printed ones of scripts/scenes,
and, with FURNITURE, the folder of scripts/benchmark/meshes.py, those of its development half) the
prediction from --n photographs (default 12) of the inspection, without or with --clutter, and the
share in as many scenes of the generator that calibrates the confidence, with a room, clutter,
occlusion and a simulated camera. On real photographs: the prediction for the meshes of BOP sets in
the folder BOP, and the rows of `curvireg evaluate bop` in EVAL/SET. Rows are kept in WORK/*.jsonl:
an interrupted run goes on, and the shares of reliable answers follow the present constants of the
confidence. --write stores both tables in scripts/results/inspection.json and
docs/guides/inspect.md.
"""

import argparse
import hashlib
import json
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from scipy.stats import binomtest

import curvireg_torch as cr
from curvireg_torch.calibration import CALIBRATION
from curvireg_torch.evidence import Evidence
from curvireg_torch.inspection.photographs import Photograph, PhotographGenerator
from curvireg_torch.inspection.trial import RIGHT_DEGREES, Outcome, run_trial
from curvireg_torch.registration.confidence import RELIABLE, probability_of_any, shares
from curvireg_torch.utils.threads import one_torch_thread
from scripts._shared import REPOSITORY, RESULTS, commit, table_lines, today, update_page, write_json
from scripts.benchmark.make import Furniture, Packages, Shapes, Tied
from scripts.scenes.scene import simulate_camera, single

Row: TypeAlias = dict[str, Any]

PAGE = REPOSITORY / "docs" / "guides" / "inspect.md"
SIZE = (480, 640)
SEED = 4001  # of meshes and scenes: no other script has it
OCCLUDED = 0.3  # of the scenes have something in front of the object
MIN_PIXELS = 400  # of a visible object
MIN_VISIBLE = 0.4  # fraction of its silhouette
MOST_OBJECTS = 3  # of a real set
SETS = ("dino", "buddha", "lm", "hope28", "hope_print", "ycbv_mini")
# meshes of each kind, also those without their print; together 30
COUNTS = {"shapes": 8, "tied": 5, "printed": 4, "printed, grey": 4, "furniture": 9}
CONDITIONS = ("predicted", "predicted with clutter", "measured")
PREDICTIONS = CONDITIONS[:2]
RESAMPLED = 2000  # meshes, to get intervals


class GeneratedMesh:
    """A mesh of the benchmark, and photographs of it in scenes."""

    def __init__(self, kind: str, objects: Packages, number: int) -> None:
        self.kind = kind
        self.objects = objects
        self.number = number
        self.shown = objects.mesh(number)

    @property
    def name(self) -> str:
        return f"{self.kind} {self.number}"

    def write(self, folder: Path) -> Path:
        """Its file in mm."""
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{self.name.replace(', ', '_').replace(' ', '_')}.ply"
        if not path.exists():
            self.shown.save_ply(path)
        return path

    def __call__(self, index: int) -> Photograph:
        """Photograph ``index`` of it among others; hidden ones are drawn again."""
        for attempt in range(20):
            rng = np.random.default_rng((SEED, self.number, index, attempt))
            scene = single(
                self.shown,
                1,
                self.objects.clutter,
                self.objects.texture,
                rng,
                size=SIZE,
                upright=False,
                occluded=bool(rng.random() < OCCLUDED),
            )
            R, t, K = scene.views[0]
            picture = scene.render(scene.views[0], SIZE)
            seen = picture.seen[0]
            whole = int(picture.whole[0].sum())
            if seen.sum() >= MIN_PIXELS and seen.sum() >= MIN_VISIBLE * whole:
                break
        rows = np.flatnonzero(seen.any(axis=1))
        columns = np.flatnonzero(seen.any(axis=0))
        box = torch.tensor([columns[0] - 0.5, rows[0] - 0.5, columns[-1] + 0.5, rows[-1] + 0.5])
        rotation, translation = scene.shapes[0].pose(R, t)
        truth = torch.eye(4, dtype=torch.float64)
        truth[:3, :3] = torch.from_numpy(rotation)
        truth[:3, 3] = torch.from_numpy(1000.0 * translation)
        image = torch.from_numpy(simulate_camera(picture.linear, rng)).permute(2, 0, 1)
        return Photograph(image.contiguous(), box.float(), truth, torch.from_numpy(K), index)


class Rows:
    """Rows that are kept in a file, by what they are of."""

    def __init__(self, path: Path, key: Sequence[Any]) -> None:
        self.path = path
        self.key = json.loads(json.dumps(list(key)))

    @cached_property
    def known(self) -> dict[str, Row]:
        lines = self.path.read_text().splitlines() if self.path.exists() else []
        rows = [json.loads(line) for line in lines]
        return {row["name"]: row for row in rows if row["key"] == self.key}

    def get(self, name: str, measure: Callable[[], Row]) -> Row:
        """The row of a name, measured if there is none."""
        if name not in self.known:
            row = {"name": name, "key": self.key, **measure()}
            self.known[name] = row
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("a") as file:
                file.write(json.dumps(row) + "\n")
            shares = {k: expected(v) for k, v in row.items() if k in CONDITIONS}
            print(json.dumps({"name": name, **shares}), flush=True)
        return self.known[name]


def generated_meshes(furniture: Path | None) -> list[GeneratedMesh]:
    """Those of ``COUNTS``, as far as they are there."""
    options = argparse.Namespace(seed=SEED, models=40, cad="exact", meshes=furniture, half="train")
    kinds: dict[str, Packages] = {"shapes": Shapes(options), "tied": Tied(options)}
    kinds["printed"] = kinds["printed, grey"] = Packages(options)
    if furniture is not None:
        kinds["furniture"] = Furniture(options)
    meshes = []
    for kind, objects in kinds.items():
        chosen = np.random.default_rng(SEED).permutation(objects.ids)
        if kind in ("shapes", "tied"):  # one of each family after the other
            chosen = np.asarray(objects.ids)
        first = COUNTS["printed"] if kind == "printed, grey" else 0
        some = chosen[first : first + COUNTS[kind]]
        meshes += [(k, GeneratedMesh(kind, objects, int(n))) for k, n in enumerate(some)]
    # kinds in turn, so that a part of them has all
    return [mesh for _, mesh in sorted(meshes, key=lambda entry: entry[0])]


def registrar_of(path: Path, *, grey: bool = False) -> cr.Registrar:
    mesh = cr.load_mesh(path, unit="mm")
    if grey:
        mesh.metadata.pop("colours", None)
    return cr.Registrar(mesh, mesh_is="exact", progress=False)


def answers(registrar: cr.Registrar, generate: Callable[[int], Photograph], n: int) -> list[Row]:
    """What became of n photographs: error, and what the confidence depends on."""
    with one_torch_thread():
        outcomes = run_trial(registrar, generate, n, compare=False).outcomes
    return [answer(outcome, registrar) for outcome in outcomes]


def answer(outcome: Outcome, registrar: cr.Registrar) -> Row:
    result = outcome.result
    if result is None or result.confidence_features is None:
        return {"error": outcome.error_deg, "confidence": 0.0}
    # poses that merged with others have no share
    own = [
        each
        for each, probability in zip(result.hypotheses, result.probabilities, strict=True)
        if probability > 0.0
    ]
    evidence = Evidence.of_hypotheses([each.evidence for each in own])
    scores = evidence.scores(registrar.score_weights(exact=True)).tolist()
    features = dict(result.confidence_features)
    said = {"confidence": result.confidence}
    return {"error": outcome.error_deg, "features": features, "scores": scores, **said}


def confidence(row: Row) -> float:
    """Confidence in an answer, with the present constants."""
    if "features" not in row:
        return float(row["confidence"])
    first = shares(torch.tensor(row["scores"]), exact=True)[0]
    return probability_of_any(row["features"], exact=True) * float(first)


def expected(rows: Sequence[Row]) -> Row:
    """Shares of right and of reliable answers."""
    right = [row["error"] <= RIGHT_DEGREES for row in rows]
    reliable = [confidence(row) >= RELIABLE for row in rows]
    return {"n": len(rows), "right": float(np.mean(right)), "reliable": float(np.mean(reliable))}


def predictions(registrar: cr.Registrar, n: int, clutter: Sequence[bool]) -> Row:
    """What the inspection finds without clutter, with it, or both."""
    mesh = registrar.bank.mesh
    return {
        PREDICTIONS[some]: answers(registrar, PhotographGenerator(mesh, 0, clutter=some), n)
        for some in clutter
    }


def measure_generated(mesh: GeneratedMesh, work: Path, n: int, clutter: Sequence[bool]) -> Row:
    registrar = registrar_of(mesh.write(work / "meshes"), grey="grey" in mesh.kind)
    measured = answers(registrar, mesh, n)
    return {"kind": mesh.kind, **predictions(registrar, n, clutter), "measured": measured}


def real_objects(folder: Path, rows: Path) -> dict[int, int]:
    """Photographs by object of a set, the most frequent objects, no more than ``MOST_OBJECTS``."""
    summary = json.loads((rows / "summary.json").read_text())
    counts = {int(k): int(v["n"]) for k, v in summary["per_object"].items()}
    chosen = sorted(counts, key=lambda k: (-counts[k], k))[:MOST_OBJECTS]
    return {k: counts[k] for k in chosen if (folder / "models" / f"obj_{k:06d}.ply").exists()}


def measured_real(rows: Path, objects: Sequence[int]) -> Row:
    """What `curvireg evaluate bop` measured of some objects."""
    summary = json.loads((rows / "summary.json").read_text())
    per_object = [summary["per_object"][str(k)] for k in objects]
    n = sum(entry["n"] for entry in per_object)
    right = sum(entry["acc_30_deg"] * entry["n"] for entry in per_object)
    found = [json.loads(line) for line in (rows / "results.jsonl").read_text().splitlines()]
    names = {f"obj_{k:06d}" for k in objects}
    reliable = [bool(row.get("reliable")) for row in found if names & set(_words(row))]
    return {"n": n, "right": right / n, "reliable": float(np.mean(reliable))}


def _words(row: Row) -> list[str]:
    """File names without suffix of a row's mesh."""
    return [Path(str(part)).stem for part in (row.get("mesh"), *(row.get("inputs") or {}).values())]


def wilson(share: float, n: int) -> tuple[float, float]:
    interval = binomtest(round(share * n), n).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def correlation(first: Sequence[float], second: Sequence[float]) -> Row:
    """Pearson's correlation and the mean difference over meshes, with 95 % intervals by
    bootstrap."""
    pairs = np.array([first, second])
    rng = np.random.default_rng(0)
    draws = [pairs[:, rng.integers(len(first), size=len(first))] for _ in range(RESAMPLED)]
    drawn = [np.corrcoef(draw)[0, 1] for draw in draws if draw.std(axis=1).min() > 0] or [0.0]
    gaps = [float((draw[0] - draw[1]).mean()) for draw in draws]
    return {
        "meshes": len(first),
        "correlation": float(np.corrcoef(pairs)[0, 1]) if pairs.std(axis=1).min() > 0 else 0.0,
        "interval": np.quantile(drawn, [0.025, 0.975]).tolist(),
        "too rosy by": float((pairs[0] - pairs[1]).mean()),
        "too rosy interval": np.quantile(gaps, [0.025, 0.975]).tolist(),
    }


def pooled(entries: Sequence[tuple[Row, int]]) -> Row:
    """Shares of several meshes, weighted by their photographs."""
    weights = np.array([weight for _, weight in entries], float)
    shares = {
        name: float(np.average([row[name] for row, _ in entries], weights=weights))
        for name in ("right", "reliable")
    }
    return {"n": sum(row["n"] for row, _ in entries), **shares}


def of_generated(options: argparse.Namespace) -> Row:
    rows = Rows(options.work / "generated.jsonl", [options.n, options.clutter])
    entries = []
    for mesh in generated_meshes(options.meshes)[: options.most]:
        given = mesh, options.work, options.n, options.clutter
        row = rows.get(mesh.name, lambda given=given: measure_generated(*given))
        found = {name: expected(row[name]) for name in CONDITIONS if name in row}
        entries.append({"name": mesh.name, "kind": mesh.kind, **found})
    summary = {}
    for name in PREDICTIONS:
        for share in ("right", "reliable") if name in entries[0] else ():
            values = [[entry[key][share] for entry in entries] for key in (name, "measured")]
            summary[f"{name}: {share}"] = correlation(*values)
    return {"photographs of each mesh": options.n, "summary": summary, "meshes": entries}


def of_real(options: argparse.Namespace) -> Row:
    rows = Rows(options.work / "real.jsonl", [options.n, options.clutter])
    table = {}
    for name in options.sets:
        data = options.data / name
        evaluated = options.rows / name
        if not (evaluated / "summary.json").exists() or not data.exists():
            print(f"{name}: skipped, for want of its files")
            continue
        objects = real_objects(data, evaluated)
        entries = []
        for k, count in objects.items():
            path = data / "models" / f"obj_{k:06d}.ply"
            row = rows.get(
                f"{name} {k}",
                lambda path=path: predictions(registrar_of(path), options.n, options.clutter),
            )
            found = {key: expected(row[key]) for key in PREDICTIONS if key in row}
            entries.append((found, count))
        table[name] = {
            "objects": len(objects),
            **{key: pooled([(row[key], n) for row, n in entries]) for key in entries[0][0]},
            "measured": measured_real(evaluated, list(objects)),
        }
    return table


def calibration() -> str:
    """Digest of the constants of confidence, on which the share of reliable answers depends."""
    return hashlib.sha256(json.dumps(CALIBRATION, sort_keys=True).encode()).hexdigest()[:12]


def share_cell(entry: Row, name: str) -> str:
    low, high = wilson(entry[name], entry["n"])
    return f"{entry[name]:.2f} ({low:.2f} to {high:.2f}; {entry['n']})"


def tables(record: Row) -> str:
    """All tables in Markdown."""
    parts = []
    if "generated" in record:
        entries = record["generated"]["meshes"]
        parts += [summary_table(record["generated"]["summary"]), kinds_table(entries)]
    if "real" in record:
        parts.append(sets_table(record["real"]))
    return "\n\n".join(["", *parts, ""])


def summary_table(summary: Row) -> str:
    cells = [["prediction", "meshes", "correlation", "too rosy by"]]
    for name, entry in summary.items():
        low, high = entry["interval"]
        least, most = entry["too rosy interval"]
        shown = f"{entry['correlation']:.2f} ({low:.2f} to {high:.2f})"
        rosy = f"{entry['too rosy by']:+.2f} ({least:+.2f} to {most:+.2f})"
        cells.append([name, str(entry["meshes"]), shown, rosy])
    return "\n".join(table_lines(cells))


def kinds_table(entries: Sequence[Row]) -> str:
    kinds: dict[str, list[Row]] = {}
    for entry in entries:
        kinds.setdefault(entry["kind"], []).append(entry)
    conditions = [name for name in CONDITIONS if name in entries[0]]
    columns = [f"{share}: {name}" for share in ("right", "reliable") for name in conditions]
    cells = [["kind", "meshes", *columns]]
    for kind, members in kinds.items():
        shares = [
            share_cell(pooled([(entry[name], 1) for entry in members]), share)
            for share in ("right", "reliable")
            for name in conditions
        ]
        cells.append([kind, str(len(members)), *shares])
    return "\n".join(table_lines(cells))


def sets_table(sets: Row) -> str:
    first = next(iter(sets.values()))
    conditions = [name for name in CONDITIONS if name in first]
    columns = [f"{share}: {name}" for share in ("right", "reliable") for name in conditions]
    cells = [["set", "objects", *columns]]
    for name, entry in sets.items():
        shares = [
            share_cell(entry[key], share) for share in ("right", "reliable") for key in conditions
        ]
        cells.append([name, str(entry["objects"]), *shares])
    return "\n".join(table_lines(cells))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("work", type=Path)
    parser.add_argument("--n", type=int, default=12, help="photographs of each mesh, each time")
    parser.add_argument("--meshes", type=Path, help="folder of scripts/benchmark/meshes.py")
    parser.add_argument("--most", type=int, help="generated meshes, fewer than there are")
    parser.add_argument("--data", type=Path, help="folder of BOP sets")
    parser.add_argument(
        "--rows", type=Path, help="folder of `curvireg evaluate bop`, one for a set"
    )
    parser.add_argument("--sets", nargs="+", choices=SETS, default=list(SETS))
    parser.add_argument("--clutter", choices=("no", "yes", "both"), default="no")
    parser.add_argument("--only", choices=("generated", "real"))
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    options.clutter = {"no": [False], "yes": [True], "both": [False, True]}[options.clutter]
    record: Row = {"date": today(), "commit": commit(), "calibration": calibration()}
    if options.only != "real":
        record["generated"] = of_generated(options)
    if options.only != "generated" and options.data and options.rows:
        record["real"] = of_real(options)
    print(tables(record))
    if options.write:
        write_json(RESULTS / "inspection.json", record)
        update_page(PAGE, "validation", tables(record))


if __name__ == "__main__":
    main()

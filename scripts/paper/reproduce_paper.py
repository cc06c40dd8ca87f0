"""Measure the paper's tables and figures on a dataset, as Markdown and a picture.

    pip install 'curvireg_torch[paper]'
    python scripts/paper/reproduce_paper.py TABLE pascal3d|bop|web ROOT --out DIR [--jobs N]
        [--image-size PX] [--page docs/paper.md]

TABLE is one of

- detectors: intersection percentage and Hausdorff distances of every detector (the paper's IP and
  HD tables)
- repeatability: {CS, ASG, HFN} x {MFC, MCS, IG}
- curve: repeatability in 40 views around the right one
- sensitivity: intersection percentage by radius and share of points
- precision: {CS, ASG, AR} x {MFC, MCS, IG}, literally and corrected, also with S_hog as printed
- ranks: precision at rank 1, 3, 5, 10, 20
- angles: errors of elevation, azimuth, in-plane angle and distance, of the estimate and of the
  closest retrieved view
- grids: precision with descriptors of 4, 8 and 16 cells
- search: in how many photographs the paper's search has something to search, and its effect
- focus: focus curves by threshold, and precision by other protocols
- all

Every table states what was measured, the number of photographs, and 95 % intervals. Only objects
that are neither occluded nor truncated are used, as in the paper. DIR/records.jsonl holds a line
for each mesh: an interrupted run goes on where it was. --page writes all tables that DIR holds,
with the commit, into a page.
"""

import shutil
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal

REPOSITORY = Path(__file__).resolve().parents[2]
# with an installed wheel, scripts is not a package that Python finds
sys.path.insert(0, str(REPOSITORY))

from curvireg_torch.errors import MissingDependencyError
from curvireg_torch.evaluation import DATASETS
from curvireg_torch.mesh import load_mesh
from curvireg_torch.pipeline import BankSettings
from curvireg_torch.utils.files import write_file
from scripts._shared import (
    Record,
    commit,
    measured,
    read_lines,
    request_digest,
    run,
    update_page,
)
from scripts.paper import tables as paper
from scripts.paper.cases import Case, by_mesh, find_cases

PHASES: dict[str, dict[str, Callable[[paper.Records], list[paper.Table]]]] = {
    "focus": {"focus": paper.focus_tables},
    "points": {
        "detectors": paper.detector_tables,
        "repeatability": paper.repeatability_tables,
        "curve": paper.curve_tables,
        "sensitivity": paper.sensitivity_tables,
    },
    "views": {
        "precision": paper.precision_tables,
        "ranks": paper.rank_tables,
        "angles": paper.angle_tables,
        "grids": paper.grid_tables,
        "search": paper.search_tables,
    },
}
"""What is measured together, and the tables that are made of it."""

TABLES = [name for makers in PHASES.values() for name in makers]
ON_PAGE = ("detectors", "ip_classes", "sensitivity", "repeatability", "curve", "precision")
ON_PAGE += ("precision_classes", "ranks", "grids", "angles", "search")
BLOCKS = {"protocols": ("protocols", "thresholds"), "paper": ON_PAGE}
"""Tables between each pair of markers of the page; one that a folder has none of stays."""

MEASURED_BY = ("cases", "detectors", "measure", "measures")
RECORDS = "records.jsonl"
CURVE = "paper-curve.webp"


def measure(
    phase: str,
    settings: BankSettings,
    pose: str,
    cases: list[Case],
) -> list[Record]:
    """Records of the cases of one mesh."""
    from scripts.paper.measure import MEASURES

    mesh = load_mesh(cases[0].mesh_path, unit=cases[0].unit)
    found = MEASURES[phase](mesh, cases, settings, pose)
    same = {"cad": cases[0].mesh_path, "commit": commit()}
    return [
        {"category": case.category, **same, **record}
        for case, record in zip(cases, found, strict=True)
    ]


def main(
    table: Literal[*TABLES, "all"],
    kind: Literal[*DATASETS],
    root: Path,
    *,
    out: Path,
    jobs: int = 1,
    image_size: int = 128,
    page: Path | None = None,
) -> None:
    check_packages()
    cases = find_cases(kind, root)
    settings = BankSettings(image_size=image_size)
    what = f"{root.name}, crops of {image_size} px"
    for phase, makers in PHASES.items():
        chosen = [name for name in makers if table in ("all", name)]
        if not chosen:
            continue
        state = (phase, settings, DATASETS[kind].pose)
        groups = {request_of(*state, group): group for group in by_mesh(cases)}
        found = measured(out / RECORDS, partial(measure, *state), groups, jobs, phase)
        records = paper.Records(found, what)
        for name in chosen:
            for made in makers[name](records):
                text = made.markdown()
                write_file(out / f"{made.name}.md", text.encode())
                print(text, flush=True)
            if name == "curve":
                draw_curve(records, out / CURVE)
    if page is not None:
        write_page(out, page)


def request_of(
    phase: str,
    settings: BankSettings,
    pose: str,
    group: list[Case],
) -> str:
    """Digest of all that the records of a mesh depend on."""
    own = [Path(__file__).with_name(f"{name}.py") for name in MEASURED_BY]
    what = [phase, str(settings), pose, *(case.key for case in group)]
    return request_digest(what, own, group[0].mesh_path, [case.image_path for case in group])


def check_packages() -> None:
    """Say what is missing before anything is measured."""
    from importlib.util import find_spec

    for module, package in (("skimage", "scikit-image"), ("matplotlib", "matplotlib")):
        if find_spec(module) is None:
            raise MissingDependencyError(
                f"{package} is not installed; pip install 'curvireg_torch[paper]'"
            )


def draw_curve(records: paper.Records, path: Path) -> None:
    """Plot the repeatability in 40 views around the true one."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.0, 3.2), dpi=120)
    axes = figure.subplots()
    for name in records.records[0]["curve"]:
        means = [
            records.mean(paper.at("curve", name, k)).mean for k in range(len(paper.CURVE_OFFSETS))
        ]
        axes.plot(paper.CURVE_OFFSETS, means, label=name)
    axes.set_xlabel("degrees about z from the true view")
    axes.set_ylabel("repeatability")
    axes.legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, pil_kwargs={"quality": 80})


def write_page(folder: Path, page: Path) -> None:
    """Replace the parts of a page between its markers by the tables of a folder."""
    entries = read_lines(folder / RECORDS)
    commits = sorted({record["commit"] for entry in entries for record in entry["rows"]})
    for block, names in BLOCKS.items():
        paths = [folder / f"{name}.md" for name in names]
        found = [path.read_text(encoding="utf-8") for path in paths if path.exists()]
        if "curve" in names and (folder / CURVE).exists():
            images = page.parent / "images"
            images.mkdir(exist_ok=True)
            shutil.copy(folder / CURVE, images)
            found.append(f"![Repeatability in 40 views around the true one](images/{CURVE})\n")
        if found:
            lines = [f"Measured at commit {', '.join(commits)}.", "", *found]
            update_page(page, block, "\n".join(lines))


if __name__ == "__main__":
    run(main)

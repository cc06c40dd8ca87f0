"""Measure the paper's tables and figures on a dataset, as CSV, Markdown and pictures.

    python scripts/paper/reproduce_paper.py TABLE pascal3d|bop|web ROOT --out DIR

TABLE is one of

- detectors: intersection percentage and Hausdorff distances of every detector (the paper's IP and HD tables)
- repeatability: {CS, ASG, HFN} x {MFC, MCS, IG}
- curve: repeatability in 40 views around the right one
- precision: {CS, ASG, AR} x {MFC, MCS, IG}, per category
- angles: errors of elevation, azimuth and in-plane angle, of the estimate and of the closest view
- ranks: precision at rank 1, 3, 5, 10, 20
- all

Every table states what was measured and the number of photographs. Only objects that are neither occluded nor
truncated are used, as in the paper.
"""

import argparse
import sys
from pathlib import Path

from curvireg_torch.errors import CurviregError
from curvireg_torch.evaluation import DATASETS
from curvireg_torch.pipeline import BankSettings, Pipeline
from scripts.paper import tables as paper

TABLES = ("detectors", "repeatability", "curve", "precision", "angles", "ranks")


def run(arguments: argparse.Namespace) -> None:
    cases = paper.find_cases(arguments.kind, arguments.root, pixel_origin=arguments.pixel_origin, limit=arguments.limit)
    settings, progress = BankSettings(image_size=arguments.image_size), not arguments.quiet
    wanted = TABLES if arguments.table == "all" else (arguments.table,)
    tables: list[paper.Table] = []
    if "detectors" in wanted:
        tables += paper.detector_tables(cases, settings, arguments.eps, progress)
    if "repeatability" in wanted:
        tables.append(paper.repeatability_table(cases, settings, arguments.eps, progress))
    if "curve" in wanted:
        tables.append(paper.curve_table(cases, settings, arguments.eps, progress))
    if set(wanted) & {"precision", "angles", "ranks"}:
        views = Pipeline().with_pose_prior(arguments.pose or DATASETS[arguments.kind].pose).views.sphere()
        rankings = paper.rank_views(cases, views, settings, progress)
        tables += [paper.precision_table(rankings)] if "precision" in wanted else []
        tables += [paper.angle_table(rankings)] if "angles" in wanted else []
        tables += [paper.rank_table(rankings)] if "ranks" in wanted else []
    for table in tables:
        paper.write_table(table, arguments.out)
        print(table.markdown())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=(*TABLES, "all"), metavar="TABLE")
    parser.add_argument("kind", choices=DATASETS)
    parser.add_argument("root", type=Path, metavar="ROOT")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--limit", type=int, metavar="N", help="use N photographs, spread evenly over the set")
    parser.add_argument("--image-size", type=int, default=128, metavar="PX", help="side of crops (default: 128)")
    parser.add_argument("--eps", type=float, default=2.0, metavar="PX", help="radius of a hit in the crop (default: 2)")
    parser.add_argument("--pose", choices=("upright", "any"), help="views of the banks (default: the dataset's)")
    parser.add_argument("--pixel-origin", type=int, choices=(0, 1), default=1, help="of PASCAL3D+ (default: 1)")
    parser.add_argument("--quiet", action="store_true", help="no progress bars")
    try:
        run(parser.parse_args())
    except CurviregError as error:
        print(f"reproduce_paper: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

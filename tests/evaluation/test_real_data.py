"""Short evaluations of real photographs."""

import pytest

from curvireg_torch.data import Pascal3DPlus
from curvireg_torch.evaluation import Pascal3DBenchmark, Protocol, evaluate
from curvireg_torch.pipeline import BankSettings
from scripts.paper import tables as paper
from tests._support.real_data import real_data

pytestmark = pytest.mark.data


def test_evaluate_pascal3d(tmp_path):
    dataset = Pascal3DPlus(real_data("pascal3d_mini"), pixel_origin=0)
    summary = evaluate(Pascal3DBenchmark(dataset, Protocol()), tmp_path / "out", limit=8, progress=False)
    assert (summary["n"], summary["failed"], summary["skipped"]) == (8, 0, {})
    assert len(summary["per_class"]) > 4, "a limit is spread over the classes"


def test_curve_table_of_the_dinosaur_peaks_at_the_true_view():
    """Its poses are exact to less than a pixel: this covers crop, box, camera and true view together."""
    cases = paper.find_cases("bop", real_data("bop/dino"), limit=4)
    table = paper.curve_table(cases, BankSettings(image_size=128), 2.0, progress=False)
    for k, name in enumerate(table.columns[1:], start=1):
        if name in ("MFC", "MCS", "IG"):
            values = {row[0]: row[k] for row in table.rows}
            assert max(values, key=values.get) == 0, name
            assert values[0] > 1.5 * values[15], name
            assert values[0] > 1.5 * values[-15], name

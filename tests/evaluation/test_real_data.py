"""Short evaluations of real photographs."""

import pytest

from curvireg_torch.data import Pascal3DPlus
from curvireg_torch.evaluation import Pascal3DBenchmark, Protocol, evaluate
from tests._support.real_data import real_data

pytestmark = pytest.mark.data


def test_evaluate_pascal3d(tmp_path):
    dataset = Pascal3DPlus(real_data("pascal3d_mini"), pixel_origin=0)
    summary = evaluate(Pascal3DBenchmark(dataset, Protocol()), tmp_path / "out", limit=8, progress=False)
    assert (summary["n"], summary["failed"], summary["skipped"]) == (8, 0, {})
    assert len(summary["per_class"]) > 4, "a limit is spread over the classes"

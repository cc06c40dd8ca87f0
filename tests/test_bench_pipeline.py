"""``scripts/bench_pipeline.py``: it reads what the terms hold, and its table stands in docs/performance.md."""

import importlib
import json
import sys
from pathlib import Path

import pytest

from curvireg_torch import ViewMatcher
from tests._support.scenes import scene, truck_bank

ROOT = Path(__file__).parents[1]


@pytest.fixture
def script(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "scripts"))
    yield importlib.import_module("bench_pipeline")
    for name in ("bench_pipeline", "_record"):
        sys.modules.pop(name)


def test_ranking_is_compared_with_the_products_in_it(script):
    image, box, _ = scene(0)
    assert script.over_products(ViewMatcher(truck_bank()), [image], box[None]) > 0.0


def test_the_page_has_the_table_of_the_record(script):
    record = json.loads((ROOT / "scripts" / "results" / "bench_pipeline.json").read_text())
    page = (ROOT / "docs" / "performance.md").read_text()
    assert f"<!-- pipeline:begin -->\n{script.pipeline_table(record)}<!-- pipeline:end -->" in page
    record["times"]["open"] += 1.0
    assert script.pipeline_table(record) not in page

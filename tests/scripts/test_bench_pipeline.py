"""``scripts/speed/pipeline.py``: it reads what the terms hold, and its table stands in docs/performance.md."""

import json
from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch

from curvireg_torch import Pipeline, Registrar, ViewMatcher
from curvireg_torch.settings import BankSettings, ViewPolicy
from tests._support.pretended import PRETENDING, pretended_gpu
from tests._support.scenes import scene, truck_bank
from tests._support.scripts import ROOT, imported


@pytest.fixture
def script():
    with imported("scripts.speed.pipeline") as script:
        yield script


def test_ranking_is_compared_with_the_products_in_it(script):
    image, box, _ = scene(0)
    assert script.over_products(ViewMatcher(truck_bank()), [image], box[None]) > 0.0


@pytest.mark.parametrize("on_gpu", [False, pytest.param(True, marks=[*PRETENDING, pytest.mark.slow])])
def test_everything_is_timed_on_a_device(script, on_gpu, monkeypatch):
    few = replace(Pipeline(), search=False, contours=False)  # which tests/test_device.py has
    few = replace(few, views=ViewPolicy(directions=4, theta_step=180.0), bank=BankSettings(image_size=64))
    on = pretended_gpu() if on_gpu else nullcontext(torch.device("cpu"))
    used = []
    monkeypatch.setattr(script, "seconds", lambda call, *_: script.timed(call, 1)[0])
    monkeypatch.setattr(script, "Registrar", lambda bank, **o: used.append(bank.device.type) or Registrar(bank, **o))
    with on as device:
        times = script.pipeline_times(script.dented_sphere(200), few, 1, str(device))
    assert set(times) == set(json.loads((ROOT / "scripts" / "results" / "bench_pipeline.json").read_text())["times"])
    assert all(value > 0.0 for value in times.values())
    assert used[-3:] == [device.type] * 3  # the others are read from disk first


def test_the_page_has_the_table_of_the_record(script):
    record = json.loads((ROOT / "scripts" / "results" / "bench_pipeline.json").read_text())
    page = (ROOT / "docs" / "performance.md").read_text()
    assert f"<!-- pipeline:begin -->\n{script.pipeline_table(record)}<!-- pipeline:end -->" in page
    record["times"]["open"] += 1.0
    assert script.pipeline_table(record) not in page

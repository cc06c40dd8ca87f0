"""The table of what compiling costs and saves."""

import json

from scripts.speed import compiled_layers as script


def test_the_page_shows_the_record() -> None:
    record = json.loads(script.OUT.read_text())
    lines = script.table(record)
    page = script.PAGE.read_text(encoding="utf-8")
    assert "\n".join(lines) in page
    measured = {name for layers in record["layers"].values() for name in layers}
    assert measured == set(script.LAYERS)
    assert set(record["machines"]) == set(record["layers"])


def test_the_table_has_times_before_and_after() -> None:
    entry = {"compile_s": 61.4, "forward_eager_ms": 4.0, "forward_compiled_ms": 1.04}
    entry |= {"both_eager_ms": 20.0, "both_compiled_ms": 9.96}
    record = {"machines": {"cpu": "torch 9, a processor"}, "layers": {"cpu": {"HOG": entry}}}
    lines = script.table(record)
    assert lines[2] == "| HOG | cpu | 61 s | 4.0 to 1.0 ms | 20.0 to 10.0 ms |"
    assert "cpu: torch 9, a processor." in lines[4]

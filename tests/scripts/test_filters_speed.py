"""``scripts/speed/filters.py``: it measures building blocks that compute the same, and writes its tables."""

import json
from pathlib import Path

from tests._support.scripts import imported


def test_filters_speed_script_compares_equal_functions(tmp_path: Path) -> None:
    with imported("scripts.speed.filters") as script:
        out, page = tmp_path / "filters.json", tmp_path / "page.md"
        script.main(["--batch", "1", "--size", "48", "--repetitions", "1", "--no-compile", "--out", str(out)])
        record = json.loads(out.read_text(encoding="utf-8"))
        assert set(record["blocks"]) == set(script.BLOCKS)
        assert all(row["max_difference"] < 1e-5 for row in record["blocks"].values())
        assert set(record["layers"]) == set(script.LAYERS)
        assert all(row["near_contour"] > 0.7 for row in record["mcs_smoothing"].values())
        page.write_text("<!-- layers:begin -->\nold\n<!-- layers:end -->\n", encoding="utf-8")
        script.write_tables(record, page)
        text = page.read_text(encoding="utf-8")
    assert "old" not in text
    assert all(f"| {name} |" in text for name in (*script.BLOCKS, *script.LAYERS))

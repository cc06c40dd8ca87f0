"""``scripts/robustness/soak.py``: what it calls flat, and a short run of it."""

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from tests._support.scripts import SCRIPTS, imported


@pytest.fixture
def soak() -> Iterator[ModuleType]:
    with imported("scripts.robustness.soak") as script:
        yield script


def test_growth_is_seen(soak: ModuleType) -> None:
    def course(rss: float, files: float, threads: float) -> list[dict[str, float]]:
        return [
            {"rss_mb": 500 + rss * i + 300 * (i > 10), "files": 9 + int(files * i), "threads": 2 + int(threads * i)}
            for i in range(100)
        ]

    assert soak.is_flat(soak.growth(course(0.0, 0.0, 0.0)), 20.0)  # warming up is no growth
    assert soak.growth(course(1.0, 0.0, 0.0))["rss_mb"] == pytest.approx(50.0)
    for leak in ((1.0, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0, 0.0, 0.1)):
        assert not soak.is_flat(soak.growth(course(*leak)), 20.0)
    before = soak.resources()
    with open(__file__, "rb"):
        assert soak.resources()["files"] == before["files"] + 1


@pytest.mark.slow
def test_a_short_soak_of_two_processes_with_one_cache(tmp_path: Path) -> None:
    out = tmp_path / "soak.json"
    allowed = ["--allow", "100"]  # MB: so few registrations only warm up
    words = ["--count", "40", "--processes", "2", "--reopen", "5", *allowed, "--out", str(out)]
    done = subprocess.run(
        [sys.executable, str(SCRIPTS / "robustness" / "soak.py"), *words], capture_output=True, text=True, timeout=900
    )
    assert done.returncode == 0, done.stdout + done.stderr
    result = json.loads(out.read_text())
    assert result["flat"] is True
    assert [len(process["course"]) for process in result["processes"]] == [40, 40]

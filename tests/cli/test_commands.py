"""``curvireg demo``, ``bank``, ``cache`` and ``--help``."""

import json
import subprocess
import sys
import warnings
from dataclasses import replace

from curvireg_torch.cli import main
from curvireg_torch.errors import CurviregWarning
from curvireg_torch.matching import cached_bank
from curvireg_torch.mesh import load_mesh
from curvireg_torch.pipeline import PRESETS, ViewPolicy


def test_bank_is_registered_to(folder, register_one, tmp_path, capsys):
    out = tmp_path / "new.safetensors"
    assert main(["bank", str(folder / "truck.ply"), "--out", str(out), "--pose", "upright", "--quiet"]) == 0
    assert "288 views" in capsys.readouterr().out
    assert register_one("--no-refine", mesh=out) == 0


def test_cache_names_meshes_and_clears_banks(folder, capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path))
    pipeline = replace(PRESETS["fast"], views=ViewPolicy(pose="upright", azimuth_step=180.0, elevations=(10.0,)))
    cached_bank(load_mesh(folder / "truck.ply"), pipeline=pipeline, progress=False)
    (tmp_path / "banks" / f"bank-{'0' * 32}.safetensors").write_bytes(b"cut")
    assert main(["cache"]) == 0
    listed = capsys.readouterr().out
    assert listed.count("truck.ply") == 1
    assert "damaged" in listed
    assert "2 banks" in listed
    assert main(["cache", "--clear"]) == 0
    assert list((tmp_path / "banks").iterdir()) == []


def test_demo_runs_as_a_module(tmp_path, monkeypatch):
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path / "cache"))
    command = [sys.executable, "-m", "curvireg_torch", "demo", "--out", str(tmp_path / "demo"), "--quiet"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert json.loads((tmp_path / "demo" / "result.json").read_text())["rotation_error_deg"] < 2
    assert "error against the truth" in done.stdout
    assert (tmp_path / "demo" / "overlay.png").stat().st_size > 10_000


def test_main_prints_our_warnings_and_not_those_of_numpy(monkeypatch, capsys):
    def warn(_):
        warnings.simplefilter("always")
        warnings.warn("of ours", CurviregWarning, stacklevel=1)
        warnings.warn("of theirs", RuntimeWarning, stacklevel=1)

    monkeypatch.setattr("curvireg_torch.cli.commands.show_cache", warn)
    assert main(["cache"]) == 0
    assert capsys.readouterr().err == "curvireg: warning: of ours\n"

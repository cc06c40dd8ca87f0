"""``curvireg demo``, ``bank``, ``cache`` and ``plot``; and the wrong inputs of
scripts/robustness/wrong_inputs.txt."""

import gc
import json
import shlex
import warnings
from dataclasses import replace
from functools import cache

import cv2
import pytest
import torch
import trimesh

from curvireg_torch import __main__, cli
from curvireg_torch.cli import main
from curvireg_torch.errors import CurviregWarning
from curvireg_torch.geometry import rotation_error
from curvireg_torch.jobs.options import RegisterOptions
from curvireg_torch.matching import cached_bank
from curvireg_torch.mesh import load_mesh
from curvireg_torch.pipeline import DEFAULT, PRESETS, ViewPolicy
from scripts.robustness.wrong_inputs import cases
from tests._support import double, slow_after, truck_bank, unrefined
from tests._support.lists import box_of
from tests._support.new_process import run_python
from tests._support.small import SMALL


def test_the_process_seldom_looks_for_cycles(monkeypatch):
    usual = gc.get_threshold()
    monkeypatch.setattr(__main__, "run", lambda: gc.get_threshold()[0])
    try:
        assert __main__.main() > usual[0]
    finally:
        gc.set_threshold(*usual)


def end_of(outcome):
    """Exit code and output of a process whose command ends with ``outcome``."""
    code = f"""
import atexit, sys
from curvireg_torch import __main__

class Left:
    def __del__(self):
        print("taken apart")

left = Left()

def run():
    atexit.register(print, "released")
    print("written")
    {outcome}

__main__.run = run
sys.exit(__main__.start())
"""
    done = run_python(code)
    assert done.stderr == ""
    return done.returncode, done.stdout.split("\n")[:-1]


LOCK = "global lock; import multiprocessing; lock = multiprocessing.get_context('spawn').Lock()"
"""Such as that of progress bars: what is not released, Python warns of."""


@pytest.mark.parametrize(
    ("outcome", "code", "more"),
    [("return 3", 3, []), (f"{LOCK}; return 0", 0, []), ("sys.exit(2)", 2, ["taken apart"])],
)
def test_a_process_releases_all_and_is_taken_apart_after_a_mistake_alone(outcome, code, more):
    assert end_of(outcome) == (code, ["written", "released", *more])


def test_bank_is_registered_to(folder, register_one, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(PRESETS, DEFAULT, SMALL)
    out = tmp_path / "new.safetensors"
    words = ["--out", str(out), "--pose", "upright", "--quiet"]
    assert main(["bank", str(folder / "truck.ply"), *words]) == 0
    assert "6 views" in capsys.readouterr().out
    assert register_one("--no-refine", mesh=out) == 0


def test_cache_names_meshes_and_clears_banks(folder, capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path))
    pipeline = replace(
        PRESETS["fast"], views=ViewPolicy(pose="upright", azimuth_step=180.0, elevations=(10.0,))
    )
    cached_bank(load_mesh(folder / "truck.ply"), pipeline=pipeline, progress=False)
    damaged = tmp_path / "banks" / f"bank-{'0' * 32}.safetensors"
    damaged.write_bytes(b"cut")
    assert main(["cache"]) == 0
    listed = capsys.readouterr().out
    assert listed.count("truck.ply") == 1
    assert "damaged" in listed
    assert "2 banks" in listed
    assert main(["cache", "list"]) == 0
    assert capsys.readouterr().out == listed
    for words in (["--clear"], ["clear"]):
        damaged.write_bytes(b"cut")
        assert main(["cache", *words]) == 0
        assert list((tmp_path / "banks").iterdir()) == []


def test_without_a_command_the_help_is_printed(capsys):
    assert main([]) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith("usage: curvireg")
    assert "register" in printed.out
    assert printed.err == ""


def test_main_prints_our_warnings_and_not_those_of_numpy(monkeypatch, capsys):
    def warn(_):
        warnings.simplefilter("always")
        warnings.warn("of ours", CurviregWarning, stacklevel=1)
        warnings.warn("of theirs", RuntimeWarning, stacklevel=1)

    monkeypatch.setattr("curvireg_torch.cli.commands.show_cache", warn)
    assert main(["cache"]) == 0
    assert capsys.readouterr().err == "curvireg: warning: of ours\n"


@pytest.mark.usefixtures("drawn")
def test_demo_files_agree_with_its_truth(tmp_path, monkeypatch, capsys):
    """The true pose projects the mesh into the box, and the errors are those of the result."""
    options = {}
    monkeypatch.setattr(
        "curvireg_torch.jobs.opening.cached_bank",
        lambda _, **given: options.update(given) or truck_bank(),
    )
    monkeypatch.setattr(RegisterOptions, "open_pipeline", lambda _: unrefined(truck_bank()))
    assert main(["demo", "--out", str(tmp_path), "--quiet"]) == 0
    assert options["progress"] is False
    result = json.loads((tmp_path / "result.json").read_text())
    R, t = (double(result["truth"][name]) for name in ("rotation", "translation"))
    estimate = double(result["rotation"])
    assert result["rotation_error_deg"] == pytest.approx(float(rotation_error(estimate, R)))
    error = (double(result["translation"]) - t).norm() / t.norm()
    assert result["translation_error"] == pytest.approx(float(error))
    points = torch.tensor(trimesh.load(tmp_path / "mesh.ply").vertices.copy()) @ R.T + t
    pixels = 1040.0 * points[:, :2] / points[:, 2:] + torch.tensor([479.5, 359.5])
    box = torch.cat([pixels.amin(dim=0), pixels.amax(dim=0)])
    assert (torch.tensor(result["inputs"]["box"]) - box).abs().max() < 1.5
    photo = cv2.imread(str(tmp_path / "photo.png"))
    assert (photo.shape, result["inputs"]["seed"]) == ((720, 960, 3), 2)
    assert photo.max() > 150
    assert (tmp_path / "overlay.png").stat().st_size > 10_000
    printed = capsys.readouterr().out
    assert "error against the truth" in printed
    assert f"rotation {result['rotation_error_deg']:.1f} degrees" in printed
    assert f"translation: {', '.join(f'{v:.4g}' for v in result['translation'])} m\n" in printed


@pytest.mark.parametrize("kind", slow_after(1, ["overlay", "fields", "viewpoints"]))
def test_plot_draws_a_registration(folder, tmp_path, kind):
    out = tmp_path / f"{kind}.png"
    (tmp_path / "quick.json").write_text(unrefined(truck_bank()).to_json())
    files = [str(folder / "photos" / "0.png"), str(folder / "truck.safetensors")]
    words = ["--out", str(out), "--quiet", "--pipeline", str(tmp_path / "quick.json")]
    assert main(["plot", kind, *files, *words, "--box", *box_of(0)]) == 0
    assert cv2.imread(str(out)).std() > 10


def test_wrong_inputs_are_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(PRESETS, DEFAULT, SMALL)
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(cli, "build_parser", cache(cli.build_parser))
    monkeypatch.chdir(tmp_path)
    wrong = []
    for line, expected in cases(tmp_path):
        try:
            quiet = [] if line.startswith(("view", "frobnicate", "compare")) else ["--quiet"]
            code = main([*shlex.split(line), *quiet])
        except SystemExit as stop:  # of argparse
            code = stop.code
        printed = capsys.readouterr().err.splitlines()
        if code != 2 or expected not in printed[-1]:
            wrong.append((line, code, printed[-1:], expected))
    assert not wrong, "\n".join(map(str, wrong))

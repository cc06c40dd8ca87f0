import subprocess
import sys
from argparse import Namespace
from pathlib import Path
from unittest.mock import Mock

import pytest

from curvireg_torch import cli
from curvireg_torch.cli import main, parse
from curvireg_torch.errors import CurviregError

HEAVY = {
    "torch",
    "numpy",
    "scipy",
    "kornia",
    "trimesh",
    "cv2",
    "sklearn",
    "matplotlib",
    "safetensors",
    "tqdm",
}
UNUSED = {
    "sklearn",
    "matplotlib",
    "skimage",
    "pyrender",
    "OpenGL",
    "timm",
    "torchvision",
    "pandas",
    "IPython",
}


def imported_by(code):
    """Top-level modules after ``code`` has run in a new process."""
    ending = "except SystemExit:\n    pass\nprint('\\n'.join(sys.modules), file=sys.stderr)"
    script = f"import sys\ntry:\n    {code}\n{ending}"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=120
    )
    return {name.split(".")[0] for name in done.stderr.split()}


@pytest.mark.parametrize(
    "words", ["--help", "--version", "register -h", "evaluate bop --help", "register --unit mile"]
)
def test_help_imports_nothing_heavy(words):
    assert not imported_by(f"from curvireg_torch.cli import main; main({words.split()!r})") & HEAVY


def test_errors_and_options_import_nothing_heavy():
    light = imported_by(
        "import curvireg_torch as cr, curvireg_torch.jobs.options; cr.CurviregError"
    )
    assert not light & HEAVY


@pytest.mark.slow
def test_a_registration_imports_what_it_uses():
    """kornia takes 0.3 s, which the filters of photographs need; sympy takes a second, and torch
    imports it where it emulates an operation."""
    loaded = imported_by(
        "import numpy, trimesh, curvireg_torch as cr, curvireg_torch.jobs.result_files; "
        "from curvireg_torch.geometry import sample_views; "
        "views = sample_views(azimuth_step=180, elevations=[20]); "
        "bank = cr.ViewBank.build(trimesh.creation.box((1, 2, 3)), views, progress=False); "
        "picture = numpy.random.default_rng(0).random((48, 64, 3)); K = cr.camera_matrix(60, 60, "
        "32, 24); "
        "assert 'kornia' not in sys.modules; "
        "assert cr.Registrar(bank)([picture], [[4, 4, 40, 30]], K)[0].ok"
    )
    assert {"torch", "trimesh"} <= loaded
    assert not loaded & (UNUSED | {"sympy"})


def test_options_accept_numbers_with_commas():
    box = ["--box", "10,", "20,", "30.5,", "40"]
    arguments = parse(["register", "a,1.jpg", *box, "--camera=1e3,1000,-.5,2", "5,6", "--out", "o"])
    assert (
        arguments.box == parse(["view", "--box=10, 20, 30.5, 40"]).box == (10.0, 20.0, 30.5, 40.0)
    )
    assert (arguments.camera, arguments.paths) == (
        (1000.0, 1000.0, -0.5, 2.0),
        [Path("a,1.jpg"), Path("5,6")],
    )


def test_main_reports_errors_in_one_line_with_a_code(monkeypatch, capsys):
    denied = (
        PermissionError(13, "denied", "x.ply"),
        2,
        "error: [Errno 13] denied: 'x.ply'; check that it exists",
    )
    refused = CurviregError("no good"), 2, "error: no good\n"
    for raised, code, message in ((KeyboardInterrupt(), 130, "interrupted\n"), denied, refused):
        command = Namespace(run=Mock(side_effect=raised), debug=False)
        monkeypatch.setattr(cli, "parse", lambda _, command=command: command)
        assert main(["cache"]) == code
        assert capsys.readouterr().err.startswith(f"curvireg: {message}")

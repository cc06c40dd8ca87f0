import subprocess
import sys

import pytest

import curvireg_torch
from curvireg_torch import evaluation
from curvireg_torch.pipeline import PRESETS
from curvireg_torch.utils import choices

HEAVY = {"torch", "numpy", "scipy", "kornia", "trimesh", "cv2", "sklearn", "matplotlib", "safetensors", "tqdm"}
UNUSED = {"sklearn", "matplotlib", "skimage", "pyrender", "OpenGL", "timm", "torchvision", "pandas", "IPython"}


def imported_by(code: str) -> set[str]:
    """Top-level modules after ``code`` has run in a new process."""
    script = (
        f"import sys\ntry:\n    {code}\nexcept SystemExit:\n    pass\nprint('\\n'.join(sys.modules), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=120)
    return {name.split(".")[0] for name in done.stderr.split()}


@pytest.mark.parametrize(
    "words",
    [["--help"], ["--version"], ["register", "--help"], ["evaluate", "bop", "--help"], ["register", "--unit", "mile"]],
    ids=" ".join,
)
def test_help_imports_nothing_heavy(words):
    assert not imported_by(f"from curvireg_torch.cli import main; main({words!r})") & HEAVY


def test_imports_are_only_those_of_what_is_used():
    assert not imported_by("import curvireg_torch; curvireg_torch.CurviregError") & HEAVY
    loaded = imported_by("import curvireg_torch.evaluation.opening")
    assert {"torch", "trimesh"} <= loaded
    assert not loaded & UNUSED


def test_a_registration_imports_no_slow_library_that_it_hardly_uses():
    """kornia takes 0.3 s, sympy a second: torch imports it where it emulates an operation."""
    loaded = imported_by(
        "import numpy, trimesh, curvireg_torch as cr; from curvireg_torch.geometry import sample_views; "
        "views = sample_views(azimuth_step=90, elevations=[20]); "
        "bank = cr.ViewBank.build(trimesh.creation.box((1, 2, 3)), views, progress=False); "
        "picture = numpy.random.default_rng(0).random((48, 64, 3)); K = cr.camera_matrix(60, 60, 32, 24); "
        "assert cr.Registrar(bank)([picture], [[4, 4, 40, 30]], K)[0].ok"
    )
    assert {"torch", "trimesh"} <= loaded
    assert not loaded & (UNUSED | {"kornia", "sympy"})


@pytest.mark.parametrize("package", [curvireg_torch, evaluation], ids=lambda p: p.__name__)
def test_every_lazy_name_can_be_imported(package):
    for name in package.__all__:
        assert getattr(package, name) is not None
    assert set(package.__all__) <= set(dir(package))


def test_choices_agree_with_the_presets():
    assert list(PRESETS) == list(choices.PRESET_NAMES)
    assert choices.DEFAULT in PRESETS

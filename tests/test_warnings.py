"""Whose warnings turn the suite red: our own, not those of the packages that we use."""

import subprocess
import sys
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
TINY = '''
import warnings

import pytest

def warn_as(module, category):
    """What ``warnings.warn`` does in a module of that name."""
    exec("import warnings; warnings.warn('seen', category)", {"__name__": module, "category": category})

@pytest.mark.parametrize("category", [UserWarning, FutureWarning, DeprecationWarning, RuntimeWarning])
@pytest.mark.parametrize("module", MODULES)
def test_warning(module, category):
    warn_as(module, category)

class Leak:
    def __del__(self):
        raise OSError("a leak")

def test_unraisable():
    Leak()
'''
OURS = ["curvireg_torch", "curvireg_torch.filters.focus", "tests", "tests.filters.test_focus"]
OTHERS = ["torch.jit._script", "numpy", "curvireg_torch_of_somebody_else", "testsuite", "kornia.curvireg_torch"]


def outcomes(folder: Path, modules: list[str]) -> list[str]:
    (folder / "test_tiny.py").write_text(TINY.replace("MODULES", repr(modules)))
    options = ["-c", str(REPOSITORY / "pyproject.toml"), "--rootdir", str(folder), "-p", "no:cacheprovider", "-q"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options, "-rA", "test_tiny.py"],
        capture_output=True, text=True, cwd=folder, timeout=100,
    )  # fmt: skip
    lines = [line.split() for line in done.stdout.splitlines() if line.startswith(("PASSED", "FAILED", "ERROR"))]
    assert len(lines) == 4 * len(modules) + 1, done.stdout
    assert ["FAILED", "test_tiny.py::test_unraisable"] in [line[:2] for line in lines]
    return [line[0] for line in lines if "test_warning" in line[1]]


def test_our_warnings_are_errors(tmp_path: Path) -> None:
    assert set(outcomes(tmp_path, OURS)) == {"FAILED"}


def test_warnings_of_other_packages_are_not(tmp_path: Path) -> None:
    assert set(outcomes(tmp_path, OTHERS)) == {"PASSED"}

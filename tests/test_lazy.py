"""What is imported when: help at once, names when they are asked for."""

import ast
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import curvireg_torch
from curvireg_torch import _choices, evaluation
from curvireg_torch.pipeline import PRESETS

HEAVY = {"torch", "numpy", "scipy", "kornia", "trimesh", "cv2", "sklearn", "matplotlib", "safetensors", "tqdm"}
UNUSED = {"sklearn", "matplotlib", "skimage", "pyrender", "OpenGL", "timm", "torchvision", "pandas", "IPython"}


def imported_by(code: str) -> set[str]:
    """Top-level modules that are there after ``code`` has run in a fresh process."""
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


def test_the_package_alone_imports_nothing_heavy():
    assert not imported_by("import curvireg_torch; curvireg_torch.CurviregError") & HEAVY


def test_commands_import_no_more_than_they_use():
    loaded = imported_by("import curvireg_torch.commands")
    assert {"torch", "trimesh"} <= loaded
    assert not loaded & UNUSED


def lists(package) -> tuple[dict[str, set[str]], dict[str, set[str]]]:
    """Names by submodule: as checkers see them, and as they are found at run time."""
    block = next(n for n in ast.parse(Path(package.__file__).read_text()).body if isinstance(n, ast.If))
    seen = {
        "." * (n.level - 1) + (n.module or ""): {alias.name for alias in n.names}
        for n in block.body
        if isinstance(n, ast.ImportFrom)
    }
    table = next(n for n in ast.walk(ast.Module(block.orelse, [])) if isinstance(n, ast.Dict))
    return seen, {place: set(names.split()) for place, names in ast.literal_eval(table).items()}


@pytest.mark.parametrize("package", [curvireg_torch, evaluation], ids=lambda p: p.__name__)
def test_lists_of_lazy_names_agree(package):
    seen, found = lists(package)
    assert seen == found
    assert sorted(n for names in found.values() for n in names) == sorted(package.__all__)
    for place, names in found.items():
        for name in names:
            assert getattr(package, name) is getattr(import_module(f".{place}", package.__name__), name)
    assert set(package.__all__) <= set(dir(package))


def test_unknown_names_are_attribute_errors():
    with pytest.raises(AttributeError, match=r"'curvireg_torch' has no attribute 'registrar_of'"):
        curvireg_torch.registrar_of  # noqa: B018
    assert curvireg_torch.filters is import_module("curvireg_torch.filters")


def test_names_on_the_command_line_are_those_of_the_library():
    assert list(PRESETS) == list(_choices.PRESET_NAMES)
    assert _choices.DEFAULT in PRESETS

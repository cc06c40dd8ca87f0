import subprocess
import sys

import pytest

from curvireg_torch.utils.modules import postpone_imports


def output_of(code: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    return done.stdout


def test_a_postponed_module_is_loaded_when_it_is_used() -> None:
    printed = output_of(
        "import sys; from curvireg_torch.utils.modules import postpone_imports; "
        "postpone_imports('xmlrpc.client'); import xmlrpc.client as m; "
        "print('http.client' in sys.modules); m.dumps((1,)); "
        "print('http.client' in sys.modules)"
    )
    assert printed.split() == ["False", "True"]


@pytest.mark.parametrize("name", ["sys", "no_such_module"])
def test_loaded_and_missing_modules_are_left_alone(name: str) -> None:
    before = dict(sys.modules)
    postpone_imports(name)
    assert sys.modules == before


def test_a_command_does_not_load_what_trimesh_imports_in_vain() -> None:
    printed = output_of(
        "import sys; from curvireg_torch.cli import main; main(['cache']); import trimesh; "
        "print('scipy.ndimage' in sys.modules, 'scipy.ndimage._filters' in sys.modules)"
    )
    assert printed.splitlines()[-1] == "True False"

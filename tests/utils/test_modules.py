import subprocess
import sys

import pytest

from curvireg_torch.utils.modules import postponed_imports

POSTPONED = """
import sys
from curvireg_torch.utils.modules import postponed_imports

def loaded():
    return "http.client" in sys.modules  # what xmlrpc.client imports

with postponed_imports("xmlrpc.client"):
    import xmlrpc.client as module
    from xmlrpc.client import dumps
print(loaded(), hasattr(module, "__path__"))
"""


def output_of(code: str) -> list[str]:
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    return done.stdout.split()


@pytest.mark.parametrize("use", ["module.dumps((1,))", "dumps((1,))", "module.DateTime"])
def test_a_postponed_module_is_loaded_when_it_is_used(use: str) -> None:
    assert output_of(f"{POSTPONED}\n{use}; print(loaded())") == ["False", "False", "True"]


def test_later_importers_get_the_module_itself() -> None:
    code = f"{POSTPONED}\nimport xmlrpc.client; print(type(xmlrpc.client).__name__, loaded())"
    assert output_of(code) == ["False", "False", "module", "True"]


def test_a_function_that_is_called_while_its_module_is_postponed_loads_it() -> None:
    code = """
from curvireg_torch.utils.modules import postponed_imports
with postponed_imports("colorsys"):
    from colorsys import rgb_to_hsv
    print(rgb_to_hsv(1.0, 1.0, 1.0)[2])
"""
    assert output_of(code) == ["1.0"]


def test_a_module_that_its_package_loads_on_demand_is_postponed() -> None:
    code = """
import sys, numpy
from curvireg_torch.utils.modules import postponed_imports
with postponed_imports("numpy.f2py"):
    numpy.f2py
print("numpy.f2py.crackfortran" in sys.modules, numpy.f2py.get_include is not None)
print("numpy.f2py.crackfortran" in sys.modules)
"""
    assert output_of(code) == ["False", "True", "True"]


@pytest.mark.parametrize("name", ["sys", "no_such_module", "no_such_module.part"])
def test_loaded_and_missing_modules_are_left_alone(name: str) -> None:
    before = dict(sys.modules)
    with postponed_imports(name):
        assert sys.modules == before
    assert sys.modules == before

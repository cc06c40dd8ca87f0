"""Public names are documented, their options keyword-only, and every Module repeats its function's
options."""

import inspect

import pytest
from torch import nn

import curvireg_torch as cr

# The documented API passes these by position.
POSITIONAL = {"mask", "views", "thetas", "theta", "camera_matrices", "unit"}
FUNCTIONS = [n for n in cr.__all__ if inspect.isfunction(getattr(cr, n))]
CLASSES = [n for n in cr.__all__ if inspect.isclass(getattr(cr, n))]
MODULES = {n.lower(): n for n in CLASSES if issubclass(getattr(cr, n), nn.Module)}
TWINS = {MODULES[n.replace("_", "")]: n for n in FUNCTIONS if n.replace("_", "") in MODULES}


def test_public_names_are_documented_and_every_filter_has_a_twin():
    assert "Registrar" in cr.__all__
    for name in cr.__all__:
        assert getattr(cr, name).__doc__, name
    assert len(TWINS) >= 12


@pytest.mark.parametrize("name", FUNCTIONS)
def test_options_of_functions_are_keyword_only(name):
    for parameter in inspect.signature(getattr(cr, name)).parameters.values():
        if parameter.default is not inspect.Parameter.empty and parameter.name not in POSITIONAL:
            assert parameter.kind is inspect.Parameter.KEYWORD_ONLY, parameter.name


@pytest.mark.parametrize(("module", "function"), TWINS.items())
def test_module_has_the_options_of_its_function(module, function):
    def options(function):
        parameters = inspect.signature(function).parameters.values()
        return {p.name: p.default for p in parameters if p.kind is inspect.Parameter.KEYWORD_ONLY}

    of_function = options(getattr(cr, function))
    of_function.pop("bin_weights", None)  # a parameter of the module
    assert of_function.items() <= options(getattr(cr, module).__init__).items()

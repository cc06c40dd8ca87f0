"""Tests of which one example is quick enough for every run."""

import pytest


def slow_after(count, cases):
    """The parameters of a test, a value or a tuple each; those after the first ``count`` are
    marked ``slow``."""
    cases = list(cases)
    later = [case if isinstance(case, tuple) else (case,) for case in cases[count:]]
    return [*cases[:count], *(pytest.param(*case, marks=pytest.mark.slow) for case in later)]

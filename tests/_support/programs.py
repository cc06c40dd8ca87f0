"""Programs of other libraries, in this process: one of their own takes a second to start."""

import runpy
import sys
from unittest.mock import patch


def run_here(program, arguments, **_):
    """Stands in for ``run_program``."""
    with patch.object(sys, "argv", [str(program), *arguments]):
        runpy.run_path(str(program), run_name="__main__")
    return True

import os
from pathlib import Path

import pytest

from tests._support.new_process import run_python


def run(code, environment=None):
    """What a program prints that ends without an error."""
    done = run_python(code, env=environment)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


@pytest.mark.slow
def test_libraries_are_loaded_whole_and_their_objects_are_no_longer_searched_for_cycles():
    code = """
import gc
from curvireg_torch.cli.libraries import load_libraries
load_libraries()
print(gc.isenabled(), gc.get_freeze_count() > 100_000)
import torch
import trimesh
print(torch.Generator().manual_seed(0).initial_seed())
print(len(trimesh.creation.box().vertex_adjacency_graph))
"""
    assert run(code).split() == ["True", "True", "0", "8"]


@pytest.mark.parametrize(
    "module",
    [
        "numpy.exceptions",
        *(pytest.param(m, marks=pytest.mark.slow) for m in ("torch._C", "trimesh")),
    ],
)
def test_ctrl_c_while_libraries_are_loaded_interrupts_the_command(tmp_path, module):
    """Not each library survives an exception in its import: numpy recurses without end. What else
    takes seconds is empty then."""
    if module == "numpy.exceptions":
        (tmp_path / "torch.py").write_text("import numpy")
        (tmp_path / "trimesh.py").write_text("")
    code = f"""
import signal, sys
from curvireg_torch.cli.libraries import load_libraries

# a shell's background jobs ignore it
signal.signal(signal.SIGINT, signal.default_int_handler)

class Interrupting:
    @staticmethod
    def find_spec(name, *_):
        if name == {module!r}:
            signal.raise_signal(signal.SIGINT)

sys.meta_path.insert(0, Interrupting)
try:
    load_libraries()
except KeyboardInterrupt:
    print("interrupted", signal.getsignal(signal.SIGINT) is signal.default_int_handler)
"""
    assert run(code, {**os.environ, "PYTHONPATH": str(tmp_path)}) == "interrupted True\n"


def test_a_command_computes_small_products_on_one_thread(tmp_path):
    """The thread pool is that of numpy: the libraries that take seconds are empty here."""
    code = """
import os
from curvireg_torch.cli.libraries import load_libraries
load_libraries()
import numpy as np
matrix = np.ones((600, 600))
matrix @ matrix
print(len(os.listdir("/proc/self/task")))
"""
    if not Path("/proc/self/task").exists() or (os.cpu_count() or 1) < 2:
        pytest.skip("threads are counted in /proc, with two cores or more")
    for name in ("torch.py", "trimesh.py"):
        (tmp_path / name).write_text("")
    environment = {name: value for name, value in os.environ.items() if "NUM_THREADS" not in name}
    environment["PYTHONPATH"] = str(tmp_path)
    usual = run(code, environment)
    given = run(code, {**environment, "OPENBLAS_NUM_THREADS": "2"})
    assert int(usual) < int(given), "a number that is given counts"

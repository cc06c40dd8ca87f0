import os
import subprocess
import sys
from pathlib import Path

import pytest


def test_commands_load_no_more_than_they_use_and_trimesh_still_finds_the_rest() -> None:
    code = """
import sys
from pathlib import Path

import pytest
from curvireg_torch.cli.libraries import UNUSED, load_libraries
load_libraries()
print([name for name in UNUSED if name in sys.modules])
import trimesh
box = trimesh.creation.box()
print(len(box.vertex_adjacency_graph), box.bounding_cylinder.is_volume)
print(trimesh.nsphere.fit_nsphere(box.vertices)[1].round(6))
print([name for name in UNUSED if name in sys.modules])
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    before, graph, radius, after = done.stdout.splitlines()
    assert before == "[]"
    assert graph == "8 True"
    assert radius == "0.866025"
    assert after == "['networkx', 'scipy.optimize']"


def test_a_command_computes_small_products_on_one_thread() -> None:
    code = """
import os
from curvireg_torch.cli.libraries import load_libraries
load_libraries()
import numpy as np
matrix = np.ones((2000, 2000))
matrix @ matrix
print(len(os.listdir("/proc/self/task")))
"""
    if not Path("/proc/self/task").exists() or (os.cpu_count() or 1) < 2:
        pytest.skip("threads are counted in /proc, with two cores or more")
    environment = {name: value for name, value in os.environ.items() if "NUM_THREADS" not in name}
    counts = []
    for more in ({}, {"OPENBLAS_NUM_THREADS": "2"}):
        done = subprocess.run(
            [sys.executable, "-c", code],
            env={**environment, **more},
            capture_output=True,
            text=True,
            check=True,
            timeout=60,
        )
        counts.append(int(done.stdout))
    assert counts[0] < counts[1], "a number that is given counts"

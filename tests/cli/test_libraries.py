import subprocess
import sys


def test_commands_load_no_more_than_they_use_and_trimesh_still_finds_the_rest() -> None:
    code = """
import sys
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

"""Renderers in threads and forked processes, and OpenGL's context at exit."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
import trimesh

from curvireg_torch.rendering import make_renderer

from .conftest import camera, require


def test_threads_share_a_renderer(backend):
    renderer = make_renderer(trimesh.creation.icosphere(subdivisions=3), backend)
    T, K, size = camera(6)
    expected = renderer.render(T, K, size)
    with ThreadPoolExecutor(2) as pool:
        results = list(pool.map(lambda _: renderer.render(T, K, size), range(6)))
    assert all(torch.equal(result, expected) for result in results)


SCRIPT = """
import os, sys, torch, trimesh
from curvireg_torch.errors import RenderingError
from curvireg_torch.rendering import make_renderer

T = torch.eye(4)[None]; T[0, 2, 3] = 4.0
K = torch.tensor([[60.0, 0, 19.5], [0, 60.0, 14.5], [0, 0, 1]])
for backend in sys.argv[1:]:
    renderer = make_renderer(trimesh.creation.box(), backend)
    before = renderer.render(T, K, (30, 40))
    child = os.fork()
    if child == 0:
        code = 1
        try:
            shared = torch.equal(renderer.render(T, K, (30, 40)), before)
            built = torch.equal(make_renderer(trimesh.creation.box(), backend).render(T, K, (30, 40)), before)
            code = 0 if shared and built else 2
        except RenderingError as error:
            code = 3 if "spawn" in str(error) else 4
        finally:
            os._exit(code)
    _, status = os.waitpid(child, 0)
    assert torch.equal(renderer.render(T, K, (30, 40)), before)  # the parent still works
    print(os.waitstatus_to_exitcode(status))
"""  # noqa: E501


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
@pytest.mark.parametrize(
    ("backends", "codes"), [(["auto", "embree"], ["0", "0"]), (["pyrender"], ["3"])]
)
def test_renderers_after_a_fork(backends, codes):
    """embree and OpenCV work in the child; OpenGL cannot, and the error says what to do."""
    require(*backends)
    command = [sys.executable, "-c", SCRIPT, *backends]
    environment = {**os.environ, "OMP_NUM_THREADS": "2"}
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=120, env=environment, check=False
    )
    assert (done.returncode, done.stderr, done.stdout.split()) == (0, "", codes)

"""Renderers in threads, in forked processes, and their contexts at the end."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
import trimesh

from curvireg_torch.rendering import make_renderer

from .conftest import BACKENDS, camera, require


@pytest.mark.parametrize("backend", BACKENDS)
def test_threads_share_a_renderer(backend: str) -> None:
    require(backend)
    renderer = make_renderer(trimesh.creation.icosphere(subdivisions=3), backend)
    T, K, size = camera(6)
    expected = renderer.render(T, K, size)
    with ThreadPoolExecutor(2) as pool:
        results = list(pool.map(lambda _: renderer.render(T, K, size), range(6)))
    assert all(torch.equal(result, expected) for result in results)


@pytest.mark.parametrize("backend", BACKENDS)
def test_threads_make_their_own_renderers(backend: str) -> None:
    require(backend)
    T, K, size = camera(2)

    def task(edge: int) -> torch.Tensor:
        return make_renderer(trimesh.creation.box([edge] * 3), backend).render(T, K, size)

    with ThreadPoolExecutor(2) as pool:
        for edge, depth in zip((1, 2, 1, 2), pool.map(task, (1, 2, 1, 2)), strict=True):
            assert torch.equal(depth, task(edge))


_FORK = """
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
        torch.set_num_threads(1)                                 # as torch's own DataLoader does in its workers
        try:
            same = torch.equal(renderer.render(T, K, (30, 40)), before)
            made = torch.equal(make_renderer(trimesh.creation.box(), backend).render(T, K, (30, 40)), before)
            code = 0 if same and made else 2
        except RenderingError as error:
            code = 3 if "spawn" in str(error) else 4
        finally:
            os._exit(code)
    _, status = os.waitpid(child, 0)
    assert torch.equal(renderer.render(T, K, (30, 40)), before)  # the parent is none the worse
    print(os.waitstatus_to_exitcode(status))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
@pytest.mark.parametrize(("backends", "codes"), [(["embree", "torch"], ["0", "0"]), (["pyrender"], ["3"])])
def test_fork_after_use(backends: list[str], codes: list[str]) -> None:
    # embree and torch go on in a child; OpenGL cannot, and the error says what to do.
    require(*backends)
    environment = {**os.environ, "OMP_NUM_THREADS": "2"}
    done = subprocess.run(
        [sys.executable, "-c", _FORK, *backends], capture_output=True, text=True, timeout=60, env=environment
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == codes


def test_context_is_released_at_exit_and_renderers_may_come_and_go() -> None:
    require("pyrender")
    script = """
import atexit
import torch, trimesh
from curvireg_torch.rendering import make_renderer, opengl
atexit.register(lambda: print(opengl._context))                  # runs last: registered first
T = torch.eye(4)[None]; T[0, 2, 3] = 4.0
K = torch.tensor([[60.0, 0, 19.5], [0, 60.0, 14.5], [0, 0, 1]])
for i in range(30):
    make_renderer(trimesh.creation.box(), "pyrender").render(T, K, (30 + i % 3, 40))
print(len(opengl._context[1]._renderer._meshes))
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout.split(), done.stderr) == (0, ["1", "None"], "")


def test_torch_may_compile_after_opengl_has_drawn():
    """Mesa's LLVM and triton's in one process: a crash, unless triton's was there first."""
    pytest.importorskip("triton")
    require("pyrender")
    code = (
        "import torch, trimesh; from curvireg_torch.rendering import render_depth\n"
        "K = torch.tensor([[50.0, 0, 15], [0, 50, 15], [0, 0, 1]]); T = torch.eye(4); T[2, 3] = 4\n"
        "render_depth(trimesh.creation.box(), T, K, (32, 32), renderer='pyrender'); import triton"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=120).returncode == 0

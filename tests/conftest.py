"""Fixtures that many tests share. Tests must not change them; a copy is cheap."""

import gc
import os
from functools import cache

# Nearly all that the tests compute is too small for several threads. Set before torch is imported,
# and for processes that tests start.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
import torch

from curvireg_torch import ViewBank, sample_views, synthetic
from curvireg_torch.data import BOPDataset, Pascal3DPlus, PoseFolder, mat_files
from curvireg_torch.synthetic import example_mesh
from tests._support import scenes
from tests._support.miniature import write_bop, write_pascal3d, write_web
from tests._support.programs import run_here


@pytest.hookimpl(hookwrapper=True)
def pytest_collection():
    """The modules of a session stay: they are not searched for cycles while they are loaded, nor
    where the code under test asks for it. Scenes of the demo are drawn once."""
    gc.disable()
    yield
    gc.freeze()
    gc.enable()
    scene_of = cache(synthetic.demo_scene)
    synthetic.demo_scene = lambda seed=2: scene_of(seed)


def pytest_collection_modifyitems(config, items):
    """Leave out tests marked ``browser`` unless ``-m`` names them: they take long.

    Skip tests marked ``cuda`` where there is no GPU."""
    if "browser" not in config.option.markexpr:
        left_out = [item for item in items if item.get_closest_marker("browser")]
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in left_out]
    if not torch.cuda.is_available():
        for item in items:
            if item.get_closest_marker("cuda"):
                item.add_marker(pytest.mark.skip(reason="torch finds no GPU"))


@pytest.fixture(scope="session")
def truck():
    """The example mesh, in metres."""
    return example_mesh()


@pytest.fixture(scope="session")
def bank():
    """120 views of the truck at 96 px, preset "classical"."""
    return scenes.truck_bank()


@pytest.fixture(scope="session")
def small_bank(truck):
    """24 views of the truck at 64 px, default pipeline."""
    views = sample_views(azimuth_step=30, elevations=[0, 30])
    return ViewBank.build(truck, views, image_size=64, progress=False)


@pytest.fixture
def threads():
    """``torch.set_num_threads``, undone after the test."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.fixture
def mats_here(monkeypatch):
    """MATLAB files are read in this process."""
    monkeypatch.setattr(mat_files, "run_program", run_here)


@pytest.fixture
def pascal(tmp_path, monkeypatch):
    """Five objects, of which one has a damaged photograph and one a damaged CAD; MATLAB files are
    read in this process."""
    monkeypatch.setattr(mat_files, "run_program", run_here)
    root = tmp_path / "pascal"
    write_pascal3d(root)
    photograph = root / "Images" / "car_pascal" / "2008_000003.jpg"
    photograph.write_bytes(photograph.read_bytes()[:300])
    root.joinpath("CAD", "sofa", "01.off").write_text("OFF\n8 12 0\n1 2\n")
    return Pascal3DPlus(root)


@pytest.fixture
def bop(tmp_path):
    """Four instances, one of them without a box."""
    write_bop(tmp_path / "bop")
    return BOPDataset(tmp_path / "bop", targets=False)


@pytest.fixture
def web(tmp_path):
    """Four photographs of two objects, two of them with a pose."""
    write_web(tmp_path / "web")
    return PoseFolder(tmp_path / "web")

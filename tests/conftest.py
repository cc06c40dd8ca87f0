"""Fixtures of all tests. One thread: nearly all that tests compute is too small to be shared among threads."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported, and for the processes that tests start

import pytest

from curvireg_torch.data import BOPDataset, Pascal3DPlus, WebCollection
from tests._support.miniature import write_bop, write_pascal3d, write_web


@pytest.fixture
def pascal(tmp_path):
    """Five objects, of which one has a damaged photograph and one a damaged CAD."""
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
    return WebCollection(tmp_path / "web")

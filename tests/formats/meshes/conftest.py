"""What tests of meshes share."""

import pytest

import curvireg_torch as cr
from curvireg_torch.errors import MeshError
from curvireg_torch.formats.meshes import cad, usd
from tests._support.meshes import load as load
from tests._support.programs import run_here
from tests._support.refusals import refused as refused_input
from tests.formats.meshes.packages import robot, stage, threemf


@pytest.fixture
def here(monkeypatch):
    """OpenUSD and OpenCascade read in this process."""
    for module in (cad, usd):
        monkeypatch.setattr(module, "run_program", run_here)


@pytest.fixture
def read(tmp_path, load):
    """Write a glTF file under construction, and load it."""
    return lambda tree: load(tree.write(tmp_path / "a.gltf"))


@pytest.fixture
def loaded(tmp_path):
    """Write a glTF file under construction, and load it without any warning."""
    return lambda tree: cr.load_mesh(tree.write(tmp_path / "a.gltf"))


@pytest.fixture
def read_3mf(tmp_path, load):
    """Write a 3MF file, and load it."""
    return lambda *content, **more: load(threemf(tmp_path / "a.3mf", *content, **more))


@pytest.fixture
def read_urdf(tmp_path, load):
    """Write a URDF file of one link, and load it; its warnings do not count."""
    return lambda *visuals, **more: load(robot(tmp_path / "a.urdf", *visuals, **more))[0]


@pytest.fixture
def read_usd(write, load):
    """Write a USD file of these parts, and load it."""
    return lambda *parts, **about: load(write("part.usda", stage(*parts, **about)))


@pytest.fixture
def bounded(monkeypatch):
    """Check that a mesh is refused in these words where a limit of a module is so low."""

    def check(path, words, module, limit, value):
        with monkeypatch.context() as patch:
            patch.setattr(module, limit, value)
            with refused_input(words, MeshError):
                cr.load_mesh(path)

    return check


@pytest.fixture
def refused(write):
    """Write a file, and check that it is refused as a mesh with a message that matches."""

    def check(name, content, match, **options):
        path = write(name, content)
        with pytest.raises(MeshError, match=match):
            cr.load_mesh(path, **options)

    return check

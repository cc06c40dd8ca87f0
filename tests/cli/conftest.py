import json

import numpy as np
import pytest

from curvireg_torch.cli import main
from curvireg_torch.jobs import photograph
from tests._support.lists import box_of, write_files

PICTURE = np.zeros((8, 8, 3), np.uint8)


@pytest.fixture(scope="package")
def folder(tmp_path_factory):
    """Photographs, a mesh and a bank on disk, see :func:`write_files`."""
    return write_files(tmp_path_factory.mktemp("cli"))


@pytest.fixture(autouse=True)
def _overlay(request, monkeypatch):
    """It takes as long as a registration: it is drawn where a test asks for ``drawn``."""
    if "drawn" not in request.fixturenames:
        monkeypatch.setattr(photograph, "registration_sheet", lambda *_, **__: PICTURE)


@pytest.fixture
def drawn():
    """The overlay is drawn."""


@pytest.fixture
def refused(capsys):
    """Check that a command was refused with code 2 and one line that contains these texts."""

    def check(code, *messages):
        (error,) = capsys.readouterr().err.splitlines()
        assert code == 2
        for message in messages:
            assert message in error

    return check


@pytest.fixture
def register_one(folder, tmp_path):
    """Run ``curvireg register`` on one photograph, by default with its box; results go to
    ``tmp_path / "out"``."""

    def run(*words, photo="photos/0.png", mesh="truck.safetensors", box=None):
        box = box_of(0) if box is None else box
        boxes = ["--box", *box] if box else []
        command = ["register", folder / photo, folder / mesh, *boxes, *words]
        return main([*map(str, command), "--out", str(tmp_path / "out"), "--quiet"])

    return run


@pytest.fixture
def document(tmp_path):
    """Read ``result.json``, by default of :func:`register_one`."""
    return lambda out="out": json.loads((tmp_path / out / "result.json").read_text())


@pytest.fixture
def registered(register_one, document):
    """:func:`register_one` of what can be registered; returns its document."""

    def run(*words, **files):
        assert register_one(*words, **files) == 0
        return document()

    return run


@pytest.fixture
def register(tmp_path):
    """Run ``curvireg register`` without refinement; results go to ``tmp_path / out``."""

    def run(*words, out="out"):
        return main(
            ["register", *map(str, words), "--out", str(tmp_path / out), "--quiet", "--no-refine"]
        )

    return run

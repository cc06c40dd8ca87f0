"""The files that are to be sent to trimesh are what they say: our readers find what is right."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from curvireg_torch.formats import read_mesh

FOLDER = Path(__file__).parents[2] / "scripts" / "upstream"
CASES = json.loads((FOLDER / "cases.json").read_text())


@pytest.mark.parametrize("name", CASES)
def test_our_readers_find_what_is_right(name):
    found = read_mesh(FOLDER / name)
    mesh = trimesh.Trimesh(found.vertices, found.faces, process=False)
    right = CASES[name]["right"]
    assert found.warnings == ()
    assert len(mesh.faces) == right.get("faces", len(mesh.faces))
    assert mesh.area == pytest.approx(right.get("area", mesh.area))
    np.testing.assert_allclose(mesh.bounds, right.get("bounds", mesh.bounds), atol=1e-6)

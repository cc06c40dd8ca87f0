"""The axis that points up: noted by meshes, used by banks."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

import curvireg_torch as cr
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.mesh import mesh_up, with_z_up
from curvireg_torch.mesh.mesh import as_mesh
from curvireg_torch.pipeline import PRESETS


@pytest.mark.parametrize(("suffix", "up"), [("glb", "y"), ("ply", "z"), ("stl", "z"), ("off", "z"), ("obj", "z")])
def test_load_mesh_notes_the_up_axis(tmp_path, suffix: str, up: str) -> None:
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    box.export(tmp_path / f"a.{suffix}")
    mesh = cr.load_mesh(tmp_path / f"a.{suffix}")
    assert mesh_up(mesh) == mesh_up(as_mesh(mesh)) == up
    np.testing.assert_allclose(mesh.extents, [1, 2, 3], rtol=1e-6)  # not rotated
    given = cr.load_mesh(tmp_path / f"a.{suffix}", up="-x")
    assert mesh_up(given) == "-x"
    np.testing.assert_allclose(with_z_up(given).extents, [3, 2, 1], rtol=1e-6)
    with pytest.raises(InvalidInputError, match="up: expected one of 'x'"):
        cr.load_mesh(tmp_path / f"a.{suffix}", up="w")


def test_registrar_renders_upright_views_of_y_up_meshes(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path))
    trimesh.creation.box((0.1, 0.2, 0.3)).export(tmp_path / "a.glb")
    few = cr.Pipeline(
        views=replace(cr.Pipeline().views, pose="upright", azimuth_step=180.0), terms=PRESETS["classical"].terms
    )
    rotations = cr.Registrar(tmp_path / "a.glb", pipeline=few).bank.rotations
    up = rotations @ torch.tensor([0.0, 1.0, 0.0])
    assert float(up[:, 1].max()) <= -0.5  # y of the file points up in the picture in every view

import numpy as np
import pytest
import torch
import trimesh

import curvireg_torch as cr
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.geometry import up_rotation
from curvireg_torch.mesh import mesh_up, with_z_up
from curvireg_torch.mesh.mesh import as_mesh
from curvireg_torch.pipeline import PRESETS
from curvireg_torch.pipeline import ViewPolicy
from curvireg_torch.utils.choices import UP_AXES

AXES = {s + a: (-1 if s else 1) * np.eye(3)[i] for i, a in enumerate("xyz") for s in ("", "-")}


@pytest.mark.parametrize("up", UP_AXES)
def test_up_rotation_takes_the_axis_to_z(up: str) -> None:
    R = up_rotation(up).numpy()
    assert np.linalg.det(R) == 1
    assert np.array_equal(R @ R.T, np.eye(3))
    assert np.array_equal(R @ AXES[up], [0, 0, 1])
    assert (up_rotation("y").numpy() @ [0, 0, 1]).tolist() == [0, -1, 0], "from glTF's front to that of PASCAL3D+"


@pytest.mark.parametrize("up", UP_AXES)
def test_for_up_shows_the_same_views_of_a_rotated_object(up: str) -> None:
    views = cr.sample_views(azimuth_step=40, elevations=[-20, 30, 90], thetas=[0, 25])
    seen = views.for_up(up).rotations.double() @ up_rotation(up).T
    torch.testing.assert_close(seen, views.rotations.double(), rtol=0, atol=2e-6)


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
    few = cr.Pipeline(views=ViewPolicy(pose="upright", azimuth_step=180.0), terms=PRESETS["classical"].terms)
    rotations = cr.Registrar(tmp_path / "a.glb", pipeline=few).bank.rotations
    up = rotations @ torch.tensor([0.0, 1.0, 0.0])
    assert float(up[:, 1].max()) <= -0.5  # y of the file points up in the picture in every view

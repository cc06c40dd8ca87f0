"""The mirror image of a mesh beside the mesh."""

import pytest
import torch
import trimesh

from curvireg_torch.mesh.mesh import MIRROR, mesh_centre, mirrored
from curvireg_torch.registration import judging
from tests._support import (
    CAMERA,
    answer_to,
    bank_around,
    double,
    exact_registrar,
    learned_registrar,
    scene,
)
from tests._support.hypotheses import placed_at
from tests._support.poses import poses as random_poses


def chiral_mesh():
    parts = [
        trimesh.creation.box((1.0, 0.6, 0.4)),
        trimesh.creation.box((0.3, 0.3, 0.5)).apply_translation((0.5, 0.2, 0.3)),
        trimesh.creation.box((0.2, 0.7, 0.2)).apply_translation((-0.4, 0.4, 0.1)),
    ]
    return trimesh.util.concatenate(parts)


def test_mirrored_mesh_is_inside_out_nowhere():
    mesh = chiral_mesh()
    image = mirrored(mesh)
    assert image.volume == pytest.approx(mesh.volume)
    assert image.bounds[0, 0] == -mesh.bounds[1, 0]


def test_reflected_poses_show_the_mesh_reflected():
    mesh = chiral_mesh()
    T = random_poses(1, seed=4)
    rotation = T[0, :3, :3]
    plane = double([0.0, 0.6, 0.8])
    centres = mesh_centre(mesh), mesh_centre(mirrored(mesh))
    found = judging.reflected_poses(placed_at(T, centres[0]), plane, *centres).T
    vertices = torch.from_numpy(mesh.vertices.copy())
    seen = vertices @ rotation.T + T[0, :3, 3]
    position = rotation @ mesh_centre(mesh) + T[0, :3, 3]
    normals = torch.nn.functional.normalize(position, dim=0), rotation @ plane
    for T_image, normal in zip(found, normals, strict=True):
        away = (seen - position) @ normal
        expected = seen - 2.0 * away[:, None] * normal
        image = (vertices @ MIRROR) @ T_image[:3, :3].T + T_image[:3, 3]
        torch.testing.assert_close(image, expected)
        assert torch.linalg.det(T_image[:3, :3]) == pytest.approx(1.0)


def test_confidence_falls_where_the_mirror_image_fits_better(monkeypatch):
    for gain, is_doubted in ((-1.0, False), (0.4, False), (1.5, True)):
        monkeypatch.setattr(judging, "mirror_gain", lambda *_, gain=gain: torch.tensor([gain]))
        result = answer_to(0, learned_registrar())
        assert (judging.MIRROR_WARNING in result.warnings) == is_doubted
        assert result.reliable != is_doubted
        if is_doubted:
            assert result.confidence < 0.5


def test_mirrored_mesh_is_told_from_the_mesh(monkeypatch):
    gains = []
    measure = judging.mirror_gain

    def recorded(*given):
        gain = measure(*given)
        gains.extend(gain.tolist())
        return gain

    monkeypatch.setattr(judging, "mirror_gain", recorded)
    assert answer_to(0, learned_registrar()).reliable
    assert gains == [-torch.inf], "the mirror image has less edge support"
    bank = bank_around(mirrored(learned_registrar().bank.mesh), 30, [0, 30, 60])
    monkeypatch.setattr(judging, "LEAST_CONFIDENCE", 0.0)
    image, box, _ = scene(0)
    last = image.shape[-1] - 1
    x0, y0, x1, y1 = box.tolist()
    boxes = torch.tensor([[x0, y0, x1, y1], [last - x1, y0, last - x0, y1]])
    both = exact_registrar(bank)([image, image.flip(-1)], boxes, CAMERA)
    assert [judging.MIRROR_WARNING in result.warnings for result in both] == [True, False]
    assert gains[1] > 0.0 > gains[2]

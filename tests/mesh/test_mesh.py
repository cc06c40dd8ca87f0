import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from curvireg_torch import geometry as g
from curvireg_torch.matching import ViewBank
from curvireg_torch.mesh import normalization_transform
from curvireg_torch.mesh.mesh import extreme_points
from curvireg_torch.pipeline import BankSettings


def moved(mesh: trimesh.Trimesh, rotation: torch.Tensor, scale: float, offset: list[float]) -> trimesh.Trimesh:
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3], T[:3, 3] = scale * rotation, torch.tensor(offset, dtype=torch.float64)
    return mesh.copy().apply_transform(T.numpy())


@pytest.mark.parametrize("seed", range(4))
def test_normalization_transform_is_invariant_to_similarities(truck: trimesh.Trimesh, seed: int) -> None:
    R = torch.from_numpy(Rotation.random(random_state=seed).as_matrix())
    meshes = truck, moved(truck, R, 7.0, [3.0, -2.0, 5.0])
    transforms = [normalization_transform(mesh, align_axes=True) for mesh in meshes]
    first, second = (
        torch.tensor(mesh.copy().apply_transform(T.numpy()).vertices)
        for mesh, T in zip(meshes, transforms, strict=True)
    )
    torch.testing.assert_close(first, second, rtol=0, atol=1e-9)
    spread = first.square().mean(dim=0)
    assert spread[0] > spread[1] > spread[2]
    assert float(first.norm(dim=1).max()) == pytest.approx(1.0)
    assert float(torch.linalg.det(transforms[0][:3, :3])) > 0, "not mirrored"


def test_bank_of_a_moved_copy_holds_the_same_views(truck: trimesh.Trimesh) -> None:
    # A quarter rotation about z maps the box, and a grid of azimuths, onto themselves.
    settings = BankSettings(image_size=64)
    quarter = torch.from_numpy(Rotation.from_euler("z", 90, degrees=True).as_matrix())
    copy = moved(truck, quarter, 12.0, [30.0, -7.0, 2.0])
    views = g.sample_views(azimuth_step=30, elevations=[-20, 40])
    first, second = (ViewBank.build(m, views, settings=settings, progress=False) for m in (truck, copy))
    rotated = (first.rotations.double() @ quarter.T).flatten(1) @ second.rotations.double().flatten(1).T
    assert float(rotated.amax(dim=1).min()) > 3.0 - 1e-5  # traces: every view is there
    order = rotated.argmax(dim=1)
    assert order.tolist() != list(range(len(views)))
    similarity = torch.cosine_similarity(first.descriptors, second.descriptors[order])
    assert float(similarity.min()) > 0.999
    torch.testing.assert_close(second.boxes[order], first.boxes, rtol=0, atol=1e-6)
    differ = (first.silhouettes != second.silhouettes[order]).flatten(1).sum(dim=1)
    assert int(differ.max()) <= 4  # pixels on rims


@pytest.mark.parametrize("scale", [(1.0, 1.0, 1.0), (1.0, 0.9, 0.02), (1.0, 0.05, 0.05)])
def test_extreme_points_of_a_large_hull_keep_the_boxes(scale: tuple[float, float, float]) -> None:
    mesh = trimesh.creation.icosphere(subdivisions=5)  # 10 242 vertices, all on the hull
    mesh.apply_scale(scale)
    points = extreme_points(mesh)
    assert len(points) <= 2562
    assert {tuple(p) for p in points.tolist()} <= {tuple(p) for p in mesh.vertices.tolist()}
    directions = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    whole, few = (x @ directions.double().T for x in (torch.from_numpy(np.array(mesh.vertices)), points))
    width = whole.amax(dim=0) - whole.amin(dim=0)
    assert float(((whole.amax(dim=0) - few.amax(dim=0)) / width).max()) < 0.0015


def test_extreme_points_are_the_hull_of_a_small_mesh_and_all_of_a_flat_one() -> None:
    box = trimesh.creation.box().subdivide()
    assert len(extreme_points(box)) == 8
    flat = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    assert len(extreme_points(flat)) == 4

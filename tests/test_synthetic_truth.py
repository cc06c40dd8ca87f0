"""Ranking on synthetic photographs: real meshes before real backgrounds, random texture and light."""

import pytest
import torch
import torch.nn.functional as F
import trimesh

import curvireg_torch as cr
from curvireg_torch.data import read_image
from curvireg_torch.geometry import pose_from_box
from curvireg_torch.synthetic import random_pose, synthesize_photograph
from tests._support.real_data import real_data

SIZE = (360, 480)
CAMERA = cr.camera_matrix(600.0, 600.0, 239.5, 179.5, dtype=torch.float64)
PHOTOGRAPHS = 40


def fraction_within_30_degrees(field: torch.nn.Module, bank: cr.ViewBank, scenes: list) -> float:
    matcher = cr.ViewMatcher(bank, field=field)
    images, boxes = [image for image, _, _ in scenes], torch.stack([box for _, box, _ in scenes])
    best = bank.rotations[matcher(images, boxes).order[:, 0]]
    points = torch.from_numpy(bank.mesh.convex_hull.vertices.copy())
    found = [pose_from_box(points, R, box, CAMERA)[0] for R, (_, box, _) in zip(best, scenes, strict=True)]
    errors = [cr.rotation_error(R, T[:3, :3]) for R, (_, _, T) in zip(found, scenes, strict=True)]
    return float((torch.stack(errors) < 30).float().mean())


@pytest.mark.data
@pytest.mark.slow
def test_focus_curves_rank_better_than_simpler_fields():
    folder, backgrounds = real_data("meshes"), sorted(real_data("backgrounds").glob("*.jpg"))
    pictures = [F.interpolate(read_image(p)[None], SIZE, mode="bilinear", antialias=True)[0] for p in backgrounds]
    fields = {
        "MFC": cr.MultiScaleFocusCurves(),
        "MCS": cr.MultiScaleCurvilinearSaliency(),
        "gradient": cr.ImageGradient(),
    }
    fractions: dict[str, list[float]] = {name: [] for name in fields}
    for name in ("spot", "rocker-arm", "beetle"):
        mesh = cr.load_mesh(folder / f"{name}.obj")
        mesh.apply_transform(trimesh.transformations.rotation_matrix(torch.pi / 2, [1, 0, 0]))  # y up to z up
        bank = cr.ViewBank.build(mesh, cr.sample_views(), settings=cr.BankSettings(image_size=128), progress=False)
        scenes = []
        for seed in range(PHOTOGRAPHS):
            generator = torch.Generator().manual_seed(seed)
            T = random_pose(mesh, CAMERA, SIZE, generator)
            background = pictures[seed % len(pictures)]
            scenes.append((*synthesize_photograph(mesh, T, CAMERA, SIZE, generator, background=background), T))
        for field_name, field in fields.items():
            fractions[field_name].append(fraction_within_30_degrees(field, bank, scenes))
    mean = {name: sum(values) / len(values) for name, values in fractions.items()}
    print(f"fraction within 30 degrees, N = 3 x {PHOTOGRAPHS}: {mean}  per mesh: {fractions}")
    assert mean["MFC"] >= 0.6
    assert mean["MFC"] >= mean["MCS"] >= mean["gradient"]

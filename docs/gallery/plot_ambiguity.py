"""
Ambiguity, on the view sphere
=============================

The scores of all views show which poses a photograph cannot distinguish. Three objects are
photographed from the same side: a truck without symmetry, a box that looks the same after a half
turn, and a bottle that looks the same from all sides. The cross marks the true viewpoint.
"""

import matplotlib.pyplot as plt
import torch
import trimesh

import curvireg_torch as cr
from curvireg_torch.geometry import transform
from curvireg_torch.mesh import mesh_centre, mesh_radius
from curvireg_torch.pipeline import PRESETS
from curvireg_torch.synthetic import example_mesh, synthesize_photograph

size = (180, 180)
K = cr.camera_matrix(500.0, 500.0, 89.5, 89.5, dtype=torch.float64)
azimuth = 35.0
elevation = 20.0
R = cr.rotation_from_viewpoint(torch.tensor(azimuth, dtype=torch.float64), elevation, 0.0)
profile = [[0, 0], [0.04, 0], [0.04, 0.15], [0.015, 0.2], [0.015, 0.25], [0, 0.25]]
objects = {
    "truck": example_mesh(),
    "box": trimesh.creation.box((0.1, 0.2, 0.06)),
    "bottle": trimesh.creation.revolve(profile),
}
pipeline = PRESETS["classical"].with_pose_prior("upright")  # the paper's terms alone

fig, axes = plt.subplots(3, 2, figsize=(9, 7), layout="constrained", width_ratios=(1, 3))
for row, (name, mesh) in zip(axes, objects.items(), strict=True):
    generator = torch.Generator().manual_seed(2)
    away = torch.tensor([0.0, 0.0, 8.0 * mesh_radius(mesh)], dtype=torch.float64)
    photograph, box = synthesize_photograph(
        mesh, transform(R, away - R @ mesh_centre(mesh)), K, size, generator
    )
    registrar = cr.Registrar(mesh, pipeline=pipeline, progress=False)
    ranking = registrar.matcher([photograph], box[None])
    views = registrar.bank.views
    order = (views.elevation * 1000 + views.azimuth).argsort()
    azimuths = views.azimuth.unique()
    elevations = views.elevation.unique()
    scores = ranking.scores[0][order].reshape(len(elevations), len(azimuths))
    row[0].imshow(photograph.permute(1, 2, 0))
    row[0].set(title=name, xticks=[], yticks=[])
    picture = row[1].pcolormesh(azimuths, elevations, scores.log10().clamp(min=-6))
    row[1].plot(azimuth, elevation, "rx", markersize=12, markeredgewidth=2)
    row[1].set(
        xlabel="azimuth, degrees", ylabel="elevation, degrees", title="log10 of the views' scores"
    )
    fig.colorbar(picture, ax=row[1])
plt.show()

# %%
# One peak: the photograph determines the pose. Two peaks: both poses are reported as hypotheses. A
# ridge: the rotation about the axis is undetermined. :doc:`/guides/how-sure` shows how to declare
# a symmetry.

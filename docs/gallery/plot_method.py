"""
The method in pictures
======================

Photograph and mesh are both converted to vector fields and then to descriptors; matching them gives
a pose.
"""

# %%
# Input
# -----
#
# A photograph, a box around the object, the camera matrix if known, and a mesh. Here all are
# generated, so that the true pose is known.

from dataclasses import replace

import matplotlib.pyplot as plt
import torch

import curvireg_torch as cr
from curvireg_torch.mesh import mesh_radius
from curvireg_torch.synthetic import example_mesh, random_pose, synthesize_photograph
from curvireg_torch.visualization import contour_overlay

mesh = example_mesh()
size = (360, 480)
K = cr.camera_matrix(520.0, 520.0, 239.5, 179.5, dtype=torch.float64)
generator = torch.Generator().manual_seed(1)
truth = random_pose(mesh, K, size, generator, elevations=(12.0, 45.0))
photograph, box = synthesize_photograph(example_mesh(painted=True), truth, K, size, generator)


def show(axes, picture, title="", **options):
    axes.imshow(picture, **options)
    axes.set(title=title, xticks=[], yticks=[])


_, axes = plt.subplots(figsize=(6, 4.6), layout="constrained")
show(axes, photograph.permute(1, 2, 0), "photograph and box")
x0, y0, x1, y1 = box.tolist()
axes.add_patch(plt.Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, color="white"))
plt.show()

# %%
# The photograph's side: a field
# ------------------------------
#
# The square crop around the box becomes a vector field: its length is the edge strength, its
# direction points across the edge. Focus curves respond to every edge in focus; the default, a
# small network trained on generated scenes, responds to the edges of the object's shape only.

crop = cr.crop_images([photograph], box[None], size=128)[0]
focus = cr.MultiScaleFocusCurves()(crop)
learned = cr.LearnedCurvilinearSaliency()(crop).detach()

_, axes = plt.subplots(1, 3, figsize=(9, 3.3), layout="constrained")
show(axes[0], crop[0].permute(1, 2, 0), "crop")
show(axes[1], focus[0].norm(dim=0).sqrt(), "focus curves", cmap="gray_r")
show(axes[2], learned[0].norm(dim=0).sqrt(), "learned field", cmap="gray_r")
plt.show()

# %%
# The mesh's side: depth views and their curvilinear saliency
# -----------------------------------------------------------
#
# The depth of the mesh is rendered from many viewpoints. The curvilinear saliency of a depth image
# is the difference of the principal curvatures of its graph: large at occluding contours and
# creases, zero on planes and spheres.

registrar = cr.Registrar(mesh, pipeline=cr.Pipeline().with_pose_prior("upright"), progress=False)
bank = registrar.bank
describer = registrar.matcher.describer
distances = bank.views.distance * mesh_radius(mesh)
some = torch.arange(20, len(bank), len(bank) // 6)[:6]
depth = describer.depth(bank.rotations[some], distances[some])[0]
saliency = cr.DepthCurvilinearSaliency(sigma=0.8)(depth)

_, axes = plt.subplots(2, 6, figsize=(9, 3.2), layout="constrained")
for k in range(6):
    show(axes[0, k], torch.where(depth[k, 0] > 0, depth[k, 0], torch.nan), cmap="bone")
    show(axes[1, k], saliency[k].norm(dim=0).sqrt(), cmap="gray_r")
axes[0, 0].set_ylabel("depth")
axes[1, 0].set_ylabel("saliency")
plt.show()

# %%
# Both become HOG descriptors
# ---------------------------
#
# HOG accumulates orientations modulo 180 degrees in 8 x 8 cells, so a field and its negative have
# equal descriptors. The drawing shows the directions *along* the edges in each cell, for the
# photograph and for the right view.

query = registrar.matcher.query([photograph], box[None])
with torch.no_grad():
    ranking = registrar.matcher.rank(query)
right = int(cr.rotation_error(bank.rotations, truth[:3, :3].to(bank.rotations)).argmin())
view_field = cr.DepthCurvilinearSaliency(sigma=0.8)(
    describer.depth(bank.rotations[[right]], distances[[right]])[0]
)


def draw_cells(axes, field, title):
    cells = cr.hog(field, block=8).reshape(8, 8, 9)
    cells = cells / cells.max()
    for y in range(8):
        for x in range(8):
            for k, weight in enumerate(cells[y, x]):
                angle = torch.tensor((k + 0.5) * torch.pi / 9 + torch.pi / 2)
                dx = 0.45 * angle.cos()
                dy = 0.45 * angle.sin()
                axes.plot(
                    [x - dx, x + dx], [y - dy, y + dy], color="black", alpha=float(weight), lw=1.5
                )
    axes.set(title=title, xticks=[], yticks=[], aspect="equal", xlim=(-0.6, 7.6), ylim=(7.6, -0.6))


_, axes = plt.subplots(1, 2, figsize=(8, 4.2), layout="constrained")
draw_cells(axes[0], learned, "photograph")
draw_cells(axes[1], view_field, "the right view")
plt.show()

# %%
# A score for every view
# ----------------------
#
# The product of the ranking terms for all azimuths and elevations of the bank. The cross marks the
# true viewpoint. Other high scores become hypotheses, too.

azimuths = bank.views.azimuth.unique()
elevations = bank.views.elevation.unique()
order = (bank.views.elevation * 1000 + bank.views.azimuth).argsort()
scores = ranking.scores[0][order].reshape(len(elevations), len(azimuths)).log10().clamp(min=-12)
azimuth, elevation, _ = cr.viewpoint_from_rotation(truth[:3, :3])

_, axes = plt.subplots(figsize=(9, 3), layout="constrained")
picture = axes.pcolormesh(azimuths, elevations, scores, shading="nearest", cmap="viridis")
axes.plot(float(azimuth) % 360, float(elevation), "rx", markersize=12, markeredgewidth=2)
axes.set(xlabel="azimuth, degrees", ylabel="elevation, degrees", title="log10 of the views' scores")
plt.colorbar(picture, ax=axes)
plt.show()

# %%
# From the best views to a pose
# -----------------------------
#
# From the best distinct views, the contour fit moves the mesh's contours onto the photograph's
# edges. Left: the best view of the bank, placed into the box; a pose that is not fitted has no
# calibrated confidence. Right: the final pose.

coarse = cr.Registrar(bank, pipeline=replace(bank.pipeline, contours=False))
before = coarse([photograph], box[None], K)[0]
after = registrar([photograph], box[None], K)[0]

_, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
for ax, which, result in ((axes[0], coarse, before), (axes[1], registrar, after)):
    error = float(cr.rotation_error(result.rotation, truth[:3, :3]))
    title = f"{error:.1f}° from the truth"
    if result.confidence is not None:
        title += f", confidence {result.confidence:.2f}"
    show(ax, contour_overlay(which, result, photograph, box), title)
    ax.set(xlim=(x0 - 40, x1 + 40), ylim=(y1 + 30, y0 - 30))
plt.show()

# %%
# :doc:`/method` gives the equations of each step.

"""
A pose for my part
==================

You have one part, its mesh, and a calibrated camera, and need to know where the part is: to grasp
it, to measure it, or to draw something on it. Here part and photograph are generated, so that the
true pose is known. Put the path of your own mesh in place of ``mesh``, and that of your photograph
in place of ``photograph``.
"""

import matplotlib.pyplot as plt
import torch

import curvireg_torch as cr
from curvireg_torch.synthetic import example_mesh, random_pose, synthesize_photograph
from curvireg_torch.visualization import contour_overlay

mesh = example_mesh()
size = (360, 480)
K = cr.camera_matrix(520.0, 520.0, 239.5, 179.5, dtype=torch.float64)
generator = torch.Generator().manual_seed(2)
truth = random_pose(mesh, K, size, generator, elevations=(12.0, 45.0), fill=(0.75, 0.95))
photograph, box = synthesize_photograph(example_mesh(painted=True), truth, K, size, generator)

# %%
# Register it
# -----------
#
# The registrar renders the views of the mesh when it is made, and keeps them on disk: make it once
# for each mesh. The truck stands upright, as in its file, and is compared with upright views only.

registrar = cr.Registrar(mesh, pipeline=cr.Pipeline().with_pose_prior("upright"), progress=False)
result = registrar([photograph], [box], K)[0]
print("rotation, from the mesh's axes to the camera's:", result.rotation, sep="\n")
print("translation in metres:", result.translation.tolist())

# %%
# Look at it
# ----------
#
# The numbers are worth nothing if the contours miss the object.

fig, ax = plt.subplots(figsize=(6, 4.6), layout="constrained")
ax.imshow(contour_overlay(registrar, result, photograph, box))
ax.set(title=f"confidence {result.confidence:.2f}", xticks=[], yticks=[])
plt.show()

# %%
# Use it
# ------
#
# A point of the mesh, here the top of the chimney, in the camera's frame and in the photograph.
# ``reliable`` says whether to trust the pose; the covariance, how far.

chimney = torch.tensor([-0.035, -0.05, 0.18], dtype=torch.float64)
in_camera = result.rotation @ chimney + result.translation
u, v = (K @ in_camera / in_camera[2])[:2].tolist()
deviation = result.covariance.diagonal()[3:].sqrt()
print(
    f"{1000 * in_camera[2]:.1f} mm in front of the camera, at pixel {u:.1f}, {v:.1f}; reliable: "
    f"{result.reliable}"
)
print(
    f"standard deviations of the position: "
    f"{', '.join(f'{1000 * d:.1f}' for d in deviation.tolist())} mm"
)

true_chimney = truth[:3, :3] @ chimney + truth[:3, 3]
print(f"error: {1000 * float((in_camera - true_chimney).norm()):.1f} mm")

# %%
# :doc:`/guides/known-pose` refines such a pose in the next photograph, and :doc:`/guides/follow`
# goes through a video.

"""
A gallery of failures
=====================

A generated photograph of a toy truck is registered with its own mesh and camera. The first picture
shows a correct pose. Each of the others violates one condition of the method, and the estimated
pose, drawn by its contours, is wrong.

**Check the confidence.** It was fitted on generated photographs that meet most of these conditions.
Where they are violated, confidence and edge support drop: none of the wrong poses below is called
reliable (0.9 or more). This is no guarantee, so check the overlay first.
"""

import matplotlib.pyplot as plt
import numpy as np
import torch
import trimesh

import curvireg_torch as cr
from curvireg_torch.synthetic import (
    example_mesh,
    procedural_background,
    random_pose,
    synthesize_photograph,
)
from curvireg_torch.visualization import contour_overlay
from scripts.scenes.families import random_shape

mesh = example_mesh()
size = (360, 480)
K = cr.camera_matrix(520.0, 520.0, 239.5, 179.5, dtype=torch.float64)
upright = cr.Pipeline().with_pose_prior("upright")
truck = cr.Registrar(mesh, pipeline=upright, progress=False)


def photograph(seed):
    generator = torch.Generator().manual_seed(seed)
    truth = random_pose(mesh, K, size, generator)
    picture, box = synthesize_photograph(mesh, truth, K, size, generator)
    return picture, box, truth[:3, :3]


def show(picture, box, truth, title, registrar=truck):
    result = registrar([picture], box[None], K)[0]
    error = float(cr.rotation_error(result.rotation, truth))
    numbers = f"confidence {result.confidence:.2f}, support {result.edge_support:.2f}"
    _, ax = plt.subplots(figsize=(5, 4.1), layout="constrained")
    ax.imshow(contour_overlay(registrar, result, picture, box))
    ax.set(title=f"{title}\n{error:.0f}° from the truth; {numbers}", xticks=[], yticks=[])
    (x0, y0, x1, y1), room = box.tolist(), 50
    height, width = picture.shape[1:]
    ax.set(
        xlim=(max(x0 - room, 0), min(x1 + room, width)),
        ylim=(min(y1 + room, height), max(y0 - room, 0)),
    )
    plt.show()


# %%
# All conditions met
# ------------------
#
# The object is fully visible, the box is tight, and the mesh is exact.

picture, box, truth = photograph(3)
show(picture, box, truth, "all conditions met")

# %%
# Cut off by the border of the photograph
# ---------------------------------------
#
# The box contains the visible half of the object, but views show the whole object.

x0, y0, x1, y1 = box.tolist()
middle = int((x0 + x1) / 2)
show(picture[:, :, :middle], torch.tensor([x0, y0, middle - 0.5, y1]), truth, "cut off")

# %%
# Upside down, declared upright
# ------------------------------
#
# ``--pose upright`` compares upright views only, and the right view is not among them.

show(
    picture.rot90(2, (1, 2)),
    torch.tensor([479 - x1, 359 - y1, 479 - x0, 359 - y0]),
    torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)) @ truth,
    "upside down",
)

# %%
# The mesh of another object
# --------------------------
#
# The mesh is a car's, with its front along -y like the truck's. A similar mesh works sometimes;
# here front and back are confused.

vertices, faces, _ = random_shape(np.random.default_rng(3), "car")
car = trimesh.Trimesh(vertices, faces, process=False)
show(
    picture,
    box,
    truth,
    "another object's mesh",
    cr.Registrar(car, pipeline=upright, progress=False),
)

# %%
# A box that is far too large
# ---------------------------
#
# It is 30 and 40 % too large on the left and at the bottom. About 10 % is tolerated.

picture, box, truth = photograph(1)
x0, y0, x1, y1 = box.tolist()
wide = x1 - x0
high = y1 - y0
show(
    picture,
    torch.tensor([x0 - 0.3 * wide, y0 - 0.1 * high, x1 + 0.1 * wide, y1 + 0.4 * high]),
    truth,
    "a wrong box",
)

# %%
# The whole image as the box
# --------------------------
#
# A given box is trusted: the object is assumed to fill it. Without a box, the object would be
# detected.

picture, box, truth = photograph(5)
show(picture, torch.tensor([-0.5, -0.5, 479.5, 359.5]), truth, "the whole image")

# %%
# Four fifths hidden
# ------------------
#
# An occluder covers the object; the box is that of the whole object. With six tenths hidden, this
# truck is still registered.

picture, box, truth = photograph(2)
x0, y0, x1, y1 = box.tolist()
seen = int(x0 + 0.2 * (x1 - x0))
screen = procedural_background(size, torch.Generator().manual_seed(102))
picture[:, :, seen : int(x1 + 10)] = screen[:, :, seen : int(x1 + 10)]
show(picture, box, truth, "hidden")

# %%
# :doc:`/limits` lists the conditions.

"""
A row for my table
==================

You have a folder of photographs of one thing, and want a table: where it was seen from, and how
sure that is. No camera is known: it is estimated in each photograph. The photographs are generated
here; one of them is damaged, as in real folders.
"""

import csv
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import torch

import curvireg_torch as cr
from curvireg_torch.synthetic import example_mesh, random_pose, synthesize_photograph

folder = Path(tempfile.mkdtemp())
mesh = example_mesh()
size = (180, 240)
K = cr.camera_matrix(260.0, 260.0, 119.5, 89.5, dtype=torch.float64)
boxes = []
true_azimuths = []
for seed in range(6):
    generator = torch.Generator().manual_seed(seed)
    truth = random_pose(mesh, K, size, generator, elevations=(12.0, 45.0), fill=(0.75, 0.95))
    photograph, box = synthesize_photograph(example_mesh(painted=True), truth, K, size, generator)
    plt.imsave(folder / f"{seed}.png", photograph.permute(1, 2, 0).numpy())
    boxes.append(box.tolist())
    true_azimuths.append(float(cr.viewpoint_from_rotation(truth[:3, :3])[0]))
(folder / "4.png").write_bytes(b"not a picture")
photographs = sorted(folder.glob("*.png"))

# %%
# One call
# --------
#
# Photographs are registered in parallel. One that cannot be read does not stop the others: its
# result is not ``ok``.

registrar = cr.Registrar(mesh, pipeline=cr.Pipeline().with_pose_prior("upright"), progress=False)
results = registrar([str(path) for path in photographs], boxes)

# %%
# One row each
# ------------
#
# ``ambiguous`` says in words how the answers differ that could also be right.

rows = []
for path, result, true_azimuth in zip(photographs, results, true_azimuths, strict=True):
    row = {"photo": path.name, "azimuth": "", "elevation": "", "confidence": "", "note": ""}
    if result.ok:
        azimuth, elevation, _ = result.viewpoint
        row["azimuth"], row["elevation"] = f"{float(azimuth):.0f}", f"{float(elevation):.0f}"
        row["confidence"], row["note"] = f"{result.confidence:.2f}", result.ambiguous or ""
    else:
        row["note"] = type(result.error).__name__
    rows.append(row | {"true azimuth": f"{true_azimuth:.0f}"})

with (folder / "results.csv").open("w", newline="") as file:
    table = csv.DictWriter(file, list(rows[0]))
    table.writeheader()
    table.writerows(rows)
print((folder / "results.csv").read_text())

# %%
# Which rows to check by hand
# ---------------------------
#
# Sort by confidence and look at the least certain ones.

usable = [k for k, result in enumerate(results) if result.ok]
usable.sort(key=lambda k: results[k].confidence)
fig, axes = plt.subplots(1, len(usable), figsize=(2.2 * len(usable), 2.2), layout="constrained")
for ax, k in zip(axes, usable, strict=True):
    ax.imshow(plt.imread(photographs[k]))
    ax.set(title=f"{rows[k]['azimuth']}°, {rows[k]['confidence']}", xticks=[], yticks=[])
plt.show()

# %%
# ``curvireg register --list`` writes such a table, with overlays, and continues after an
# interruption: see :doc:`/results`.

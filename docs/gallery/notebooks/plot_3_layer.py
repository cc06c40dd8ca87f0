"""
A layer in my model
===================

You have a network of your own, and want to show it edges rather than brightness. Every filter of
the library is an ``nn.Module`` that passes gradients. Here a small classifier learns which of two
shapes a picture shows; the light changes from picture to picture.
"""

import matplotlib.pyplot as plt
import torch
from torch import nn

import curvireg_torch as cr

torch.manual_seed(0)


def pictures(count):
    """Pictures (count, 1, 32, 32) of a square or a disc, and their labels; light and contrast
    vary."""
    y, x = torch.meshgrid(torch.linspace(-1, 1, 32), torch.linspace(-1, 1, 32), indexing="ij")
    labels = torch.randint(2, (count,))
    centre = torch.rand(count, 2, 1, 1) * 0.6 - 0.3
    radius = torch.rand(count, 1, 1) * 0.2 + 0.4
    dx = x - centre[:, 0]
    dy = y - centre[:, 1]
    disc = (dx**2 + dy**2).sqrt() / radius
    square = torch.maximum(dx.abs(), dy.abs()) / (0.89 * radius)
    inside = torch.sigmoid(20 * (1 - torch.where(labels[:, None, None] == 1, disc, square)))
    contrast = (0.2 + 0.6 * torch.rand(count, 1, 1)) * (2 * torch.randint(2, (count, 1, 1)) - 1)
    light = torch.randn(count, 2, 1, 1) * 0.5
    noise = 0.03 * torch.randn(count, 32, 32)
    return (0.5 + 0.5 * contrast * inside + 0.3 * (light[:, 0] * x + light[:, 1] * y) + noise)[
        :, None
    ].clamp(0, 1), labels


x_train, y_train = pictures(256)
x_test, y_test = pictures(512)

# %%
# What the layer shows
# --------------------
#
# A vector field of edges: its length hardly depends on the light.

field = cr.ImageCurvilinearSaliency()(x_test[:6]).norm(dim=1)
fig, axes = plt.subplots(2, 6, figsize=(9, 3.2), layout="constrained")
for k in range(6):
    axes[0, k].imshow(x_test[k, 0], cmap="gray", vmin=0, vmax=1)
    axes[1, k].imshow(field[k].detach())
for ax in axes.flat:
    ax.set(xticks=[], yticks=[])
plt.show()

# %%
# Pixels or edges
# ---------------
#
# ``HOG`` turns the field into a descriptor; ``learnable=True`` makes its options parameters of the
# network.

models = {
    "pixels": nn.Sequential(nn.Flatten(), nn.Linear(32 * 32, 64), nn.ReLU(), nn.Linear(64, 2)),
    "edges": nn.Sequential(
        cr.ImageGradient(learnable=True), cr.HOG(grid=4, learnable=True), nn.LazyLinear(2)
    ),
}
for name, model in models.items():
    model(x_train[:1])  # decides the size of the lazy layer
    optimiser = torch.optim.Adam(model.parameters(), lr=0.02)
    for _ in range(60):
        optimiser.zero_grad()
        loss = nn.functional.cross_entropy(model(x_train), y_train)
        loss.backward()
        optimiser.step()
    with torch.no_grad():
        right = (model(x_test).argmax(dim=1) == y_test).float().mean()
    print(f"{name}: {100 * right:.0f} % of {len(y_test)} new pictures right")

# %%
# The width of the smoothing was learned with the rest:

print(f"sigma: {models['edges'][0].sigma.item():.2f} px, from 1 px")

# %%
# :doc:`/guides/layers` lists the layers and what can be learned in them.

"""A can with a label, without it, and with another one; and photographs of it."""

import cv2
import numpy as np
import torch
import trimesh
from PIL import Image

from curvireg_torch.rendering import render_colour
from tests._support.scenes import CAMERA, SIZE


def can(word="BEANS"):
    """A closed cylinder about y with a label."""
    label = np.full((128, 256, 3), 235, np.uint8)
    label[:36] = (170, 30, 40)
    cv2.putText(label, word, (20, 100), cv2.FONT_HERSHEY_SIMPLEX, 1.6, (20, 60, 130), 5)
    angle = np.linspace(0, 2 * np.pi, 49)
    ring = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    side = [np.c_[ring[:, 0], np.full(49, y), ring[:, 1]] for y in (-1.3, 1.3)]
    lids = [*side, [[0, -1.3, 0], [0, 1.3, 0]]]
    places = [np.c_[angle / (2 * np.pi), np.full(49, v)] for v in (0.0, 1.0)]
    k = np.arange(48)
    faces = [np.c_[k, k + 1, k + 50], np.c_[k, k + 50, k + 49]]
    faces += [np.c_[k + 99, k + 98, k * 0 + 196], np.c_[k + 147, k + 148, k * 0 + 197]]
    uv = np.concatenate([*places, np.full((100, 2), (0.5, 0.02))])
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(label))
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return trimesh.Trimesh(
        np.concatenate([*side, *lids]), np.concatenate(faces), visual=visual, process=False
    )


def photograph(mesh, T):
    """In other light than the views, in front of a floor and a wall, blurred and with noise."""
    picture, (H, W) = render_colour(mesh, T, CAMERA, SIZE)[0], SIZE
    room = torch.full((H, W), 0.45)
    room[2 * H // 3 :] = 0.75
    lit = picture * torch.linspace(0.95, 0.6, W) * torch.tensor([1.0, 0.95, 0.85])[:, None, None]
    image = torch.where(picture.amin(dim=0) < 0.999, lit, room)
    image = torch.from_numpy(cv2.GaussianBlur(image.permute(1, 2, 0).numpy(), (0, 0), 0.8)).permute(
        2, 0, 1
    )
    noise = torch.randn(image.shape, generator=torch.Generator().manual_seed(0))
    return (image + 0.02 * noise).clamp(0, 1)

"""Generated scenes as a dataset: crops of procedural objects, with the depth of the object
alone."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
import trimesh
from torch import Tensor
from torch.utils.data import Dataset

from curvireg_torch.geometry.crops import crop_transforms, square_boxes
from scripts.scenes.families import random_shape
from scripts.scenes.materials import Material, random_texture
from scripts.scenes.scene import simulate_camera, single, towards
from scripts.scenes.surfaces import Array, Rng
from scripts.scenes.textured import Placed, TexturedMesh

CLUTTER = 500  # shapes that clutter is drawn from; each process builds them once
MARGIN = 0.1  # around the object's box, as in BankSettings
SIZE = 128  # side of the crops in px


@dataclass(frozen=True)
class GeneratedScenes(Dataset[dict[str, Tensor]]):
    """Photograph-like crops of objects among clutter. Sample i depends only on ``seed`` and i.

    Args:
        length: number of samples.
        seed: another seed gives other objects.
        upright: fraction of the objects that stand upright.

    Items (a dict): ``image`` (3, S, S) float32 in [0, 1], ``depth`` (1, S, S) float32 in radii of
    the object, 0 = background, ``rotation`` (3, 3) float32 of a camera that looks straight at the
    object, ``distance`` () float32 in radii.
    """

    length: int
    seed: int = 0
    upright: float = 0.6

    def __len__(self) -> int:
        return self.length

    def mesh(self, index: int) -> trimesh.Trimesh:
        """The object of sample ``index``, of radius 1 around the origin."""
        vertices, faces, _ = random_shape(np.random.default_rng((self.seed, index)))
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        return mesh.apply_scale(1.0 / np.linalg.norm(0.5 * mesh.extents))

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        if not 0 <= index < self.length:
            raise IndexError(index)
        rng = np.random.default_rng((self.seed, index, 1))
        shape = _painted(np.random.default_rng((self.seed, index)), rng)
        upright = rng.random() < self.upright
        occluded = rng.random() < 0.3
        scene = single(shape, 1, _clutter, random_texture, rng, upright=upright, occluded=occluded)
        R, t, _ = scene.views[0]
        target = scene.shapes[0]
        centre = R @ target.points(shape.centre) + t
        straight = towards(centre).T
        R = straight @ R
        t = straight @ t
        K, (x0, y0, x1, y1) = _crop_camera(target, R, t, rng)
        picture = scene.render((R, t, K), (SIZE, SIZE))
        # hidden objects are of no use for training
        if picture.seen.sum() < 0.1 * picture.whole.sum():
            picture = replace(scene, shapes=[target]).render((R, t, K), (SIZE, SIZE))
        inside = picture.linear[y0:y1, x0:x1]
        border = ((y0, SIZE - y1), (x0, SIZE - x1), (0, 0))
        image = simulate_camera(np.pad(inside, border, mode="edge"), rng)
        return {
            "image": torch.from_numpy(image).permute(2, 0, 1).float() / 255.0,
            "depth": torch.from_numpy(picture.depth)[None],
            "rotation": torch.from_numpy(R @ target.rotation).float(),
            "distance": torch.tensor(np.linalg.norm(centre), dtype=torch.float32),
        }


def _painted(rng: Rng, paint: Rng) -> TexturedMesh:
    vertices, faces, materials = random_shape(rng)
    plain = paint.uniform(0.2, 0.8)
    paints = [Material(paint, plain=plain) for _ in range(materials.max() + 1)]
    return TexturedMesh.from_arrays(vertices, faces, paints, paint=materials)


def _clutter(rng: Rng) -> TexturedMesh:
    return _numbered(rng.integers(CLUTTER))


@lru_cache(maxsize=CLUTTER)
def _numbered(number: int) -> TexturedMesh:
    rng = np.random.default_rng((0xC1077E12, number))
    return _painted(rng, rng)


def _crop_camera(
    target: Placed,
    R: Array,
    t: Array,
    rng: Rng,
) -> tuple[Array, tuple[int, int, int, int]]:
    """Camera matrix of the crop around a jittered box, and the part of the crop that lies within
    the photograph."""
    placed = target.hull @ R.T + t
    flat = placed[:, :2] / np.maximum(placed[:, 2:], 0.1)
    side = np.ptp(flat, axis=0)
    box = np.concatenate([flat.min(axis=0), flat.max(axis=0)])
    deviation = rng.choice([0.01, 0.05])
    box += rng.normal(0, deviation, 4) * np.tile(side, 2)
    cut = None  # the side of the box at which the photograph's border cuts the object
    if rng.random() < 0.2:
        cut = rng.integers(4)
        inwards = 1 - 2 * (cut // 2)
        box[cut] += inwards * rng.uniform(0.1, 0.45) * side[cut % 2]
    A = crop_transforms(square_boxes(torch.from_numpy(box), MARGIN), SIZE).numpy()
    area = [0, 0, SIZE, SIZE]
    if cut is not None:
        axis = cut % 2
        place = A[axis, axis] * box[cut] + A[axis, 2]
        area[cut] = int(np.clip(np.round(place + 0.5), 0, SIZE))
    return A, tuple(area)

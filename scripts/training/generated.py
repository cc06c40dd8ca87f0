"""Generated scenes as a dataset."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
import trimesh
from torch import Tensor
from torch.utils.data import Dataset

from ...utils.checks import check_positive
from .arrangement import arrange
from .scene import render_scene
from .shapes import Shape, random_shape, shape_from_mesh

__all__ = ["GeneratedScenes"]

CLUTTER = 500  # shapes that clutter is drawn from; each process builds them once


class GeneratedScenes(Dataset[dict[str, Tensor]]):
    """Photograph-like crops of procedural objects among clutter, with the depth of the object alone.

    Sample i depends only on ``seed`` and i, in whatever process or order it is generated.

    Args:
        length: number of samples.
        seed: another seed gives other objects.
        image_size: side of the crops in px.
        upright: fraction of the objects that stand upright.
        meshes: use these instead of procedural objects.

    Items (a dict): ``image`` (3, S, S) float32 in [0, 1], ``depth`` (1, S, S) float32 in radii of the object, 0 =
    background, ``visible`` (1, S, S) bool, ``rotation`` (3, 3) float32, ``distance`` () float32 in radii.

    Raises:
        InvalidInputError: ``length`` is below 1.

    Example:
        >>> sample = GeneratedScenes(1000, seed=1, image_size=64)[7]
        >>> sample["image"].shape, bool((sample["depth"] > 0).any())
        (torch.Size([3, 64, 64]), True)
    """

    def __init__(
        self,
        length: int,
        *,
        seed: int = 0,
        image_size: int = 128,
        upright: float = 0.6,
        meshes: Sequence[trimesh.Trimesh] = (),
    ) -> None:
        check_positive(length, "length")
        self._length, self._seed, self._size, self._upright = length, seed, image_size, upright
        self._shapes = [shape_from_mesh(mesh) for mesh in meshes]

    def __len__(self) -> int:
        return self._length

    def shape(self, index: int) -> Shape:
        """The object of sample ``index``."""
        if self._shapes:
            return self._shapes[index % len(self._shapes)]
        return random_shape(np.random.default_rng((self._seed, index)))

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        if not 0 <= index < self._length:
            raise IndexError(index)
        rng = np.random.default_rng((self._seed, index, 1))
        clutter = [_clutter(int(k)) for k in rng.integers(0, CLUTTER, int(rng.choice([0, 1, 2, 4, 7])))]
        arrangement = arrange(self.shape(index), clutter, rng, size=self._size, upright=self._upright)
        image, depth, visible = render_scene(arrangement, rng)
        return {
            "image": torch.from_numpy(image).permute(2, 0, 1).float() / 255.0,
            "depth": torch.from_numpy(depth)[None],
            "visible": torch.from_numpy(visible)[None],
            "rotation": torch.from_numpy(arrangement.rotation).float(),
            "distance": torch.tensor(arrangement.distance, dtype=torch.float32),
        }


@lru_cache(maxsize=CLUTTER)
def _clutter(number: int) -> Shape:
    return random_shape(np.random.default_rng((0xC1077E12, number)))

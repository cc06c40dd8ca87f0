"""Training data and losses of the learned field."""

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.data import Dataset

from curvireg_torch.features.learned_field import WORK_SIZE, doubled_angle, halved_angle
from curvireg_torch.geometry import rotation_from_axis_angle
from curvireg_torch.matching import ViewDescriber
from curvireg_torch.matching.describe import depth_filter, hog_layer
from curvireg_torch.pipeline import BankSettings
from scripts.training.generated import GeneratedScenes

SETTINGS = BankSettings(image_size=WORK_SIZE, sigma=0.8)
"""Settings of the depth views that the network learns to imitate."""

# of the ranking losses: about the difference between the correlations of right and wrong views
TEMPERATURE = 0.05
OTHER_VIEWS = 5


class FieldDataset(Dataset[dict[str, Tensor]]):
    """Generated scenes of ``WORK_SIZE`` px with the targets of the learned field.

    Items (a dict): ``image`` (3, S, S) uint8, and in half precision

    - ``code`` (2, S/2, S/2), the field of the clean depth encoded by :func:`doubled_angle`, of
      length about 1 on edges;
    - ``mask`` (1, S/2, S/2), the object's silhouette, occluded parts included;
    - ``descriptors`` (7, D): of that field, of the true view as a bank describes it, and of five
      other views.
    """

    def __init__(self, scenes: GeneratedScenes) -> None:
        self.scenes = scenes
        self._filter = depth_filter(SETTINGS)
        self._descriptor = hog_layer(SETTINGS)

    def __len__(self) -> int:
        return len(self.scenes)

    @torch.no_grad()
    def __getitem__(self, index: int) -> dict[str, Tensor]:
        sample = self.scenes[index]
        field = self._filter(sample["depth"][None])
        code = F.avg_pool2d(doubled_angle(field), 2)
        length = code.norm(dim=1)
        code = code * length.sum() / (length.square().sum() + 1e-6)
        describe = ViewDescriber(self.scenes.mesh(index), SETTINGS)
        rotations = sample["rotation"] @ _view_rotations(torch.Generator().manual_seed(index))
        depth, *_ = describe.depth(rotations, sample["distance"].expand(len(rotations)))
        views = self._filter(depth)
        return {
            "image": (255 * sample["image"]).round().to(torch.uint8),
            "code": code[0].half(),
            "mask": F.avg_pool2d((sample["depth"] > 0).half(), 2),
            "descriptors": self._descriptor(torch.cat([field, views])).half(),
        }


def mirrored_descriptors(descriptors: Tensor) -> Tensor:
    """Descriptors (..., D) of the mirror images of the fields of ``descriptors`` (..., D).

    Example:
        >>> field = torch.randn(1, 2, 128, 128)
        >>> mirror = field.flip(3) * torch.tensor([-1.0, 1.0])[:, None, None]
        >>> hog = hog_layer(SETTINGS)
        >>> torch.allclose(hog(mirror), mirrored_descriptors(hog(field)), atol=1e-5)
        True
    """
    blocks = SETTINGS.grid - SETTINGS.block + 1
    layout = (blocks, blocks, SETTINGS.block, SETTINGS.block, SETTINGS.bins)
    return descriptors.unflatten(-1, layout).flip((-4, -2, -1)).flatten(-5)


def _view_rotations(generator: torch.Generator) -> Tensor:
    """(1 + OTHER_VIEWS, 3, 3) model rotations: identity, half and quarter turns about z, then
    random ones."""
    z = torch.tensor([0.0, torch.pi, 0.5 * torch.pi, -0.5 * torch.pi])
    about_z = torch.stack([torch.zeros(4), torch.zeros(4), z], dim=1)
    angles = torch.deg2rad(20.0 + 60.0 * torch.rand(OTHER_VIEWS - 3, 1, generator=generator))
    others = angles * F.normalize(torch.randn(OTHER_VIEWS - 3, 3, generator=generator), dim=1)
    return rotation_from_axis_angle(torch.cat([about_z, others]))


class ReplayBuffer:
    """The latest ``capacity`` samples, reused so that training does not wait for the scene
    generator."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.added = 0
        self._store = {}

    def add(self, batch: dict[str, Tensor]) -> None:
        """Store a batch, in place of the oldest samples when the buffer is full."""
        if not self._store:
            self._store = {k: v.new_zeros(self.capacity, *v.shape[1:]) for k, v in batch.items()}
        index = torch.arange(self.added, self.added + len(batch["image"])) % self.capacity
        for name, values in batch.items():
            self._store[name][index] = values
        self.added += len(index)

    def draw(self, fresh: int, count: int, generator: torch.Generator) -> dict[str, Tensor]:
        """The ``fresh`` latest samples and random others, ``count`` in all, as float32 with images
        in [0, 1]."""
        stored = min(self.added, self.capacity)
        latest = torch.arange(self.added - fresh, self.added) % self.capacity
        index = torch.cat([latest, torch.randint(stored, (count - fresh,), generator=generator)])
        batch = {name: values[index].float() for name, values in self._store.items()}
        return {**batch, "image": batch["image"] / 255.0}


def augment(batch: dict[str, Tensor], generator: torch.Generator) -> dict[str, Tensor]:
    """Mirror the samples and change colours, contrast and noise, each at random. Targets are
    mirrored with images."""

    def draw(*shape: int) -> Tensor:
        return torch.rand(len(batch["image"]), *shape, generator=generator)

    mirror = draw(1, 1, 1) < 0.5
    sign = torch.tensor([1.0, -1.0])[:, None, None]  # of the two parts of a code
    mirrored = {
        "image": batch["image"].flip(3),
        "code": batch["code"].flip(3) * sign,
        "mask": batch["mask"].flip(3),
    }
    found = {name: torch.where(mirror, other, batch[name]) for name, other in mirrored.items()}
    descriptors = batch["descriptors"]
    other = mirrored_descriptors(descriptors)
    found["descriptors"] = torch.where(mirror[:, 0], other, descriptors)
    images = found["image"]
    grey = images.mean(dim=1, keepdim=True)
    images = grey + (images - grey) * (1.4 * draw(1, 1, 1))
    images = torch.where(draw(1, 1, 1) < 0.3, images.flip(1), images)
    images = torch.where(draw(1, 1, 1) < 0.1, 1.0 - images, images)
    contrast = 0.6 + 0.7 * draw(1, 1, 1)
    tint = 0.2 * (draw(3, 1, 1) - 0.5)
    images = (images - 0.5) * contrast + 0.5 + tint
    noise = 0.02 * draw(1, 1, 1)
    images = images + noise * torch.randn(images.shape, generator=generator)
    return found | {"image": images.clamp(0, 1)}


def losses(output: Tensor, batch: dict[str, Tensor]) -> dict[str, Tensor]:
    """Terms of the training loss, to be added up.

    ``field``: squared error of the code, relative to predicting no field. ``mask``: cross entropy.
    ``descriptor``: one minus the correlation with the true view. ``ranking``: cross entropy of
    picking the true view among those of the batch and their mirror images. ``other_views``: of
    picking it among other views of the same object.

    Args:
        output: (B, 3, S/2, S/2) of :class:`FieldNetwork`.
        batch: samples of :class:`FieldDataset` as float32.
    """
    code = output[:, :2]
    target = batch["code"]
    predicted = F.normalize(hog_layer(SETTINGS)(halved_angle(code)))
    true = batch["descriptors"][:, 0]
    candidates = F.normalize(torch.cat([true, mirrored_descriptors(true)]))
    correlation = predicted @ candidates.T
    labels = torch.arange(len(predicted), device=predicted.device)
    views = F.normalize(batch["descriptors"][:, 1:], dim=2)
    among_views = (views @ predicted[..., None])[..., 0]
    error = (code - target).square().sum(dim=1).mean()
    return {
        "field": error / target.square().sum(dim=1).mean(),
        "mask": F.binary_cross_entropy_with_logits(output[:, 2:], batch["mask"]),
        "descriptor": (1.0 - correlation.diagonal()).mean(),
        "ranking": 0.1 * F.cross_entropy(correlation / TEMPERATURE, labels),
        "other_views": 0.2 * F.cross_entropy(among_views / TEMPERATURE, torch.zeros_like(labels)),
    }

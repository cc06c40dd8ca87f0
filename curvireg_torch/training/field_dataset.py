"""What the network is shown and what it is asked for."""

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.data import Dataset

from ..geometry import rotation_from_axis_angle
from ..matching import ViewDescriber
from ..matching.fields import depth_filter, hog_layer
from ..models.learned_field import WORK_SIZE, doubled_angle, halved_angle
from ..settings import BankSettings
from ..terms import normalized_correlation
from .scenes import GeneratedScenes

__all__ = ["SETTINGS", "FieldDataset", "ReplayBuffer", "augment", "losses", "mirrored_descriptors"]

SETTINGS = BankSettings(image_size=WORK_SIZE, sigma=0.8)
"""Of the depth views that the network is to imitate."""

TEMPERATURE = 0.05
"""Of the ranking loss: correlations of right and wrong views lie about so far apart."""

RIVALS = 5
"""Other views of the same object in a lesson."""


class FieldDataset(Dataset[dict[str, Tensor]]):
    """Generated scenes with the right answers.

    Args:
        scenes: of ``WORK_SIZE`` px.

    Items: ``image`` (3, S, S) uint8; in half precision ``code`` (2, S/2, S/2), the clean depth's field by
    :func:`doubled_angle`, of length about 1 on its edges; ``mask`` (1, S/2, S/2), hidden parts included;
    ``descriptors`` (2 + RIVALS, D) of that field, and of views of the object as a bank would hold them, the right one
    first.
    """

    def __init__(self, scenes: GeneratedScenes) -> None:
        self.scenes = scenes
        self._filter, self._descriptor = depth_filter(SETTINGS), hog_layer(SETTINGS)

    def __len__(self) -> int:
        return len(self.scenes)

    @torch.no_grad()
    def __getitem__(self, index: int) -> dict[str, Tensor]:
        sample = self.scenes[index]
        field = self._filter(sample["depth"][None])
        code = F.avg_pool2d(doubled_angle(field), 2)
        length = code.norm(dim=1)
        describe = ViewDescriber(self.scenes.shape(index).mesh(), SETTINGS)
        turns = _rival_turns(torch.Generator().manual_seed(index))
        views = self._filter(describe.depth(sample["rotation"] @ turns, sample["distance"].expand(len(turns)))[0])
        return {
            "image": (255 * sample["image"]).round().to(torch.uint8),
            "code": (code * length.sum() / (length.square().sum() + 1e-6))[0].half(),
            "mask": F.avg_pool2d((sample["depth"] > 0).half(), 2),
            "descriptors": self._descriptor(torch.cat([field, views])).half(),
        }


def mirrored_descriptors(descriptors: Tensor) -> Tensor:
    """(..., D) descriptors of the mirror images: blocks, cells and bins change sides.

    Example:
        >>> field = torch.randn(1, 2, 128, 128)
        >>> mirror = field.flip(3) * torch.tensor([-1.0, 1.0])[:, None, None]
        >>> hog = hog_layer(SETTINGS)
        >>> torch.allclose(hog(mirror), mirrored_descriptors(hog(field)), atol=1e-5)
        True
    """
    blocks = SETTINGS.grid - SETTINGS.block + 1
    layout = (blocks, blocks, SETTINGS.block, SETTINGS.block, SETTINGS.bins)
    mirrored: Tensor = descriptors.unflatten(-1, layout).flip((-4, -2, -1)).flatten(-5)
    return mirrored


def _rival_turns(generator: torch.Generator) -> Tensor:
    """(1 + RIVALS, 3, 3) turns of the model: none, half a turn and a quarter about z, others at random."""
    z = torch.tensor([0.0, torch.pi, 0.5 * torch.pi, -0.5 * torch.pi])
    about_z = torch.stack([torch.zeros(4), torch.zeros(4), z], dim=1)
    angles = torch.deg2rad(20.0 + 60.0 * torch.rand(RIVALS - 3, 1, generator=generator))
    others = angles * F.normalize(torch.randn(RIVALS - 3, 3, generator=generator), dim=1)
    return rotation_from_axis_angle(torch.cat([about_z, others]))


class ReplayBuffer:
    """The latest ``capacity`` lessons, so that the network need not wait for the generator."""

    def __init__(self, capacity: int) -> None:
        self.capacity, self.seen = capacity, 0
        self._store: dict[str, Tensor] = {}

    def add(self, batch: dict[str, Tensor]) -> None:
        """Keep a batch, in place of the oldest where there is no room."""
        if not self._store:
            self._store = {k: v.new_zeros(self.capacity, *v.shape[1:]) for k, v in batch.items()}
        at = torch.arange(self.seen, self.seen + len(batch["image"])) % self.capacity
        for name, values in batch.items():
            self._store[name][at] = values
        self.seen += len(at)

    def draw(self, fresh: int, count: int, generator: torch.Generator) -> dict[str, Tensor]:
        """The ``fresh`` latest lessons and others at random, ``count`` in all; float32, images in [0, 1]."""
        held = min(self.seen, self.capacity)
        latest = torch.arange(self.seen - fresh, self.seen) % self.capacity
        at = torch.cat([latest, torch.randint(held, (count - fresh,), generator=generator)])
        batch = {name: values[at].float() for name, values in self._store.items()}
        return {**batch, "image": batch["image"] / 255.0}


def augment(batch: dict[str, Tensor], generator: torch.Generator) -> dict[str, Tensor]:
    """The same lessons mirrored, with other colours, contrast and noise, each at random."""
    images = batch["image"]
    B = len(images)

    def draw(*shape: int) -> Tensor:
        return torch.rand(B, *shape, generator=generator)

    mirror = draw(1, 1, 1) < 0.5
    images = torch.where(mirror, images.flip(3), images)
    code = torch.where(mirror, batch["code"].flip(3) * torch.tensor([1.0, -1.0])[:, None, None], batch["code"])
    mask = torch.where(mirror, batch["mask"].flip(3), batch["mask"])
    descriptors = torch.where(mirror[:, 0], mirrored_descriptors(batch["descriptors"]), batch["descriptors"])
    grey = images.mean(dim=1, keepdim=True)
    images = grey + (images - grey) * (1.4 * draw(1, 1, 1))
    images = torch.where(draw(1, 1, 1) < 0.3, images.flip(1), images)
    images = torch.where(draw(1, 1, 1) < 0.1, 1.0 - images, images)
    images = (images - 0.5) * (0.6 + 0.7 * draw(1, 1, 1)) + 0.5 + 0.2 * (draw(3, 1, 1) - 0.5)
    images = images + 0.02 * draw(1, 1, 1) * torch.randn(images.shape, generator=generator)
    return {"image": images.clamp(0, 1), "code": code, "mask": mask, "descriptors": descriptors}


def losses(
    answer: Tensor,
    batch: dict[str, Tensor],
    *,
    descriptor_weight: float = 1.0,
    ranking_weight: float = 0.1,
    rivals_weight: float = 0.2,
) -> dict[str, Tensor]:
    """What is to be small, to be added up.

    ``field``: squared error of the code, 1 for no field at all; ``mask``: cross entropy; ``descriptor``: one minus the
    correlation with the right view's; ``ranking``: cross entropy of picking the right view among those of the batch and
    their mirror images; ``rivals``: of picking it among other views of the same object.

    Args:
        answer: (B, 3, S/2, S/2) of :class:`FieldNetwork`.
        batch: of :class:`FieldDataset`, float32.
        descriptor_weight, ranking_weight, rivals_weight: factors of the last three.
    """
    code, wanted = answer[:, :2], batch["code"]
    ours = hog_layer(SETTINGS)(halved_angle(code))
    own = batch["descriptors"][:, 0]
    similar = normalized_correlation(ours, torch.cat([own, mirrored_descriptors(own)]))
    right = torch.arange(len(ours), device=ours.device)
    views = F.normalize(batch["descriptors"][:, 1:], dim=2)
    among_views = (views @ F.normalize(ours, dim=1)[..., None])[..., 0]
    return {
        "field": (code - wanted).square().sum(dim=1).mean() / wanted.square().sum(dim=1).mean(),
        "mask": F.binary_cross_entropy_with_logits(answer[:, 2:], batch["mask"]),
        "descriptor": descriptor_weight * (1.0 - similar.diagonal()).mean(),
        "ranking": ranking_weight * F.cross_entropy(similar / TEMPERATURE, right),
        "rivals": rivals_weight * F.cross_entropy(among_views / TEMPERATURE, torch.zeros_like(right)),
    }

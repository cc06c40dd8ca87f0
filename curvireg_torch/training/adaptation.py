"""Fine-tuning of the learned field on renders of one mesh."""

from typing import Any

import torch
from torch.utils.data import DataLoader
from tqdm import tqdm

from ..features.learned_field import LearnedCurvilinearSaliency
from ..mesh.mesh import as_mesh
from ..mesh.up import with_z_up
from ..utils.checks import check_positive
from .field_dataset import FieldDataset, augment, losses
from .scenes import GeneratedScenes

__all__ = ["adapt"]

BATCH, RATE = 16, 5e-4


def adapt(
    mesh: Any,
    *,
    scenes: int = 3000,
    upright: float = 0.0,
    field: LearnedCurvilinearSaliency | None = None,
    seed: int = 0,
    workers: int = 0,
    progress: bool = True,
) -> LearnedCurvilinearSaliency:
    """Fine-tune the learned field on generated photographs of one mesh. This takes some minutes on a CPU.

    No photograph of the object is needed, see :class:`curvireg_torch.training.scenes.GeneratedScenes`. Batch statistics
    are not updated. Save the result with :meth:`LearnedCurvilinearSaliency.save`.

    Args:
        mesh: a mesh or the path of one.
        scenes: number of photographs to generate; each is used once.
        upright: fraction of them in which the object stands upright, with the mesh's ``up`` axis pointing up.
        field: starting point, modified in place; default: the packaged weights.
        seed: of the scenes.
        workers: processes that generate scenes; 0 uses this one. Processes are spawned, so a script that uses them
            needs ``if __name__ == "__main__":``.
        progress: show a progress bar.

    Raises:
        InvalidInputError: ``scenes`` is not positive.
    """
    check_positive(scenes, "scenes")
    field = LearnedCurvilinearSaliency() if field is None else field
    dataset = FieldDataset(GeneratedScenes(scenes, seed=seed, upright=upright, meshes=[with_z_up(as_mesh(mesh))]))
    loader = DataLoader(dataset, BATCH, num_workers=workers, multiprocessing_context="spawn" if workers else None)
    network = field.network
    network.eval().requires_grad_(True)
    optimizer = torch.optim.AdamW(network.parameters(), lr=RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=len(loader), pct_start=0.1)
    generator = torch.Generator().manual_seed(seed)
    for batch in tqdm(loader, desc="adapting", unit="batch", disable=not progress):
        batch = {name: values.float() for name, values in batch.items()}
        batch = augment({**batch, "image": batch["image"] / 255.0}, generator)
        loss = torch.stack(list(losses(network(batch["image"]), batch).values())).sum()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        schedule.step()
    network.requires_grad_(False)
    return field

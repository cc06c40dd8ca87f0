"""Train the learned field on generated scenes, without photographs, annotations or pretrained
weights.

    python scripts/training/train_learned_field.py --out runs/field --minutes 90

OUT gets weights and a log; --workers processes generate scenes for --minutes.

A batch consists of fresh scenes and of earlier ones, with new colours and mirrored. The losses are
those of field_dataset.py; one of them is backpropagated through HOG.
"""

import json
import math
import time
from collections import Counter
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.optim.swa_utils import AveragedModel
from torch.utils.data import DataLoader
from tqdm import tqdm

from curvireg_torch.features import FieldNetwork, halved_angle
from curvireg_torch.features.learned_field import save_weights
from curvireg_torch.geometry import rotation_error, sample_views
from curvireg_torch.matching import ViewDescriber
from curvireg_torch.matching.describe import depth_filter, hog_layer
from scripts._shared import run
from scripts.training.field_dataset import SETTINGS, FieldDataset, ReplayBuffer, augment, losses
from scripts.training.generated import GeneratedScenes

VALIDATION_SEED = 1_000_003


BATCH = 32  # scenes in a step
FRESH = 8  # of them new ones
REPLAY = 15_000  # scenes that are stored for reuse, 100 kB each
RATE = 3e-3  # highest learning rate
HELD_OUT = 60  # scenes
EVERY = 10.0  # minutes between validations


class Validation:
    """Held-out scenes of upright objects, each ranked against the views of its mesh."""

    def __init__(self) -> None:
        scenes = GeneratedScenes(HELD_OUT, seed=VALIDATION_SEED, upright=1.0)
        views = sample_views()
        distances = torch.full((len(views),), 5.0)
        self.samples = []
        for i in tqdm(range(HELD_OUT), desc="validation banks", mininterval=10):
            sample = scenes[i]
            describe = ViewDescriber(scenes.mesh(i), SETTINGS)
            bank = describe(views.rotations, distances)["descriptors"].half()
            errors = rotation_error(views.rotations.float(), sample["rotation"])
            self.samples.append((sample["image"], sample["depth"], errors, bank))

    @torch.no_grad()
    def __call__(self, network: FieldNetwork) -> dict[str, float]:
        descriptor = hog_layer(SETTINGS)
        saliency = depth_filter(SETTINGS)
        errors = []
        cosines = []
        for image, depth, error, bank in self.samples:
            code = network(image[None])[:, :2]
            field = F.interpolate(halved_angle(code), scale_factor=2.0, mode="bilinear")
            query = descriptor(field)
            errors.append(float(error[F.cosine_similarity(query, bank.float()).argmax()]))
            target = descriptor(saliency(depth[None]))
            cosines.append(float(F.cosine_similarity(query, target)))
        e = np.array(errors)
        return {
            "accuracy_30": (e < 30).mean(),
            "accuracy_15": (e < 15).mean(),
            "median": np.median(e),
            "cosine": np.mean(cosines),
        }


def learning_rate(step: int, done: float) -> float:
    """It rises for 200 steps, and falls as a cosine; ``done`` is the fraction of the time."""
    rise = min(1.0, (step + 1) / 200)
    return RATE * rise * 0.5 * (1 + math.cos(math.pi * done))


def averaged(mean: Tensor, now: Tensor, step: Tensor) -> Tensor:
    """Of weights: the running mean after one more step."""
    keep = min(0.998, float(step / (step + 10)))
    return mean + (1 - keep) * (now - mean)


def main(
    *,
    out: Path,
    minutes: float = 90.0,
    workers: int = 1,
    seed: int = 0,
    device: str = "cuda" if torch.cuda.is_available() else "cpu",
) -> None:
    out.mkdir(parents=True, exist_ok=True)
    weights = out / "field.safetensors"
    log = out / "log.jsonl"
    log.unlink(missing_ok=True)

    torch.manual_seed(seed)
    network = FieldNetwork()
    average = AveragedModel(network, device="cpu", avg_fn=averaged, use_buffers=True)
    average.n_averaged.fill_(1)  # the first weights count
    network.to(device, memory_format=torch.channels_last)
    optimizer = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=0.02)
    validation = Validation()
    loader = DataLoader(
        FieldDataset(GeneratedScenes(10**9, seed=seed)),
        FRESH,
        num_workers=workers,
        multiprocessing_context="spawn" if workers else None,
    )
    replay = ReplayBuffer(REPLAY)
    generator = torch.Generator().manual_seed(seed)
    means = Counter()
    start = time.monotonic()
    passed = 0.0  # minutes
    validated = 0.0
    for step, fresh in enumerate(loader):
        replay.add(fresh)
        batch = augment(replay.draw(FRESH, BATCH, generator), generator)
        batch = {name: values.to(device) for name, values in batch.items()}
        for group in optimizer.param_groups:
            group["lr"] = learning_rate(step, passed / minutes)
        network.train()
        with torch.autocast(torch.device(device).type, torch.bfloat16):
            output = network(batch["image"].contiguous(memory_format=torch.channels_last))
        parts = losses(output.float(), batch)
        optimizer.zero_grad(set_to_none=True)
        torch.stack(list(parts.values())).sum().backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimizer.step()
        average.update_parameters(network)
        means.update({name: float(value.detach()) for name, value in parts.items()})
        means["steps"] += 1
        passed = (time.monotonic() - start) / 60
        if passed - validated <= EVERY and passed < minutes:
            continue
        steps = means.pop("steps")
        entry = {"step": step + 1, "minutes": passed, "scenes": (step + 1) * FRESH}
        entry |= {name: value / steps for name, value in means.items()}
        entry |= validation(average.module.eval())
        entry = {name: round(value, 4) for name, value in entry.items()}
        save_weights(average.module, weights)
        with log.open("a") as lines:
            lines.write(json.dumps(entry) + "\n")
        print(json.dumps(entry), flush=True)
        means.clear()
        validated = passed
        if passed >= minutes:
            break
    print(f"weights: {weights}")


if __name__ == "__main__":
    run(main)

"""Train the learned field on generated scenes, without photographs, annotations or pretrained
weights.

    python scripts/training/train_learned_field.py --out runs/field --minutes 90

A batch consists of fresh scenes and of earlier ones, with new colours and mirrored. The losses are
those of field_dataset.py; one of them is backpropagated through HOG.
"""

import json
import math
import time
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.data import DataLoader
from tqdm import tqdm

from curvireg_torch.features import FieldNetwork, halved_angle
from curvireg_torch.features.learned_field import save_weights
from curvireg_torch.geometry import rotation_error, sample_views
from curvireg_torch.matching import ViewDescriber
from curvireg_torch.matching.describe import depth_filter, hog_layer
from scripts._shared import parser_of
from scripts.training.field_dataset import SETTINGS, FieldDataset, ReplayBuffer, augment, losses
from scripts.training.generated import GeneratedScenes

VALIDATION_SEED = 1_000_003


class Validation:
    """Held-out scenes of upright objects, each ranked against the views of its mesh."""

    def __init__(self, count: int) -> None:
        scenes = GeneratedScenes(count, seed=VALIDATION_SEED, upright=1.0)
        views = sample_views()
        self.images = []
        self.depths = []
        self.errors = []
        self.banks = []
        for i in tqdm(range(count), desc="validation banks", mininterval=10):
            sample = scenes[i]
            describe = ViewDescriber(scenes.mesh(i), SETTINGS)
            described = describe(views.rotations, torch.full((len(views),), 5.0))
            self.images.append(sample["image"])
            self.depths.append(sample["depth"])
            self.errors.append(
                rotation_error(views.rotations.float(), sample["rotation"].expand(len(views), 3, 3))
            )
            self.banks.append(described["descriptors"].half())

    @torch.no_grad()
    def __call__(self, field: torch.nn.Module) -> dict[str, float]:
        descriptor = hog_layer(SETTINGS)
        errors = []
        cosines = []
        for image, depth, error, bank in zip(
            self.images, self.depths, self.errors, self.banks, strict=True
        ):
            query = descriptor(field(image[None]))
            errors.append(float(error[F.cosine_similarity(query, bank.float()).argmax()]))
            target = descriptor(depth_filter(SETTINGS)(depth[None]))
            cosines.append(float(F.cosine_similarity(query, target)))
        e = np.array(errors)
        return {
            "accuracy_30": float((e < 30).mean()),
            "accuracy_15": float((e < 15).mean()),
            "median": float(np.median(e)),
            "cosine": float(np.mean(cosines)),
        }


class _Field(torch.nn.Module):
    def __init__(self, network: FieldNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor) -> Tensor:
        return F.interpolate(
            halved_angle(self.network(image)[:, :2]), scale_factor=2.0, mode="bilinear"
        )


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of weights and log")
    parser.add_argument("--minutes", type=float, default=90.0, help="training time")
    parser.add_argument("--batch", type=int, default=32, help="scenes in a step")
    parser.add_argument("--fresh", type=int, default=8, help="fresh scenes among them")
    parser.add_argument(
        "--replay", type=int, default=15_000, help="scenes stored for reuse, 100 kB each"
    )
    parser.add_argument("--workers", type=int, default=1, help="processes that generate scenes")
    parser.add_argument("--rate", type=float, default=3e-3, help="highest learning rate")
    parser.add_argument("--validate", type=int, default=60, help="held-out scenes")
    parser.add_argument("--every", type=float, default=10.0, help="minutes between validations")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)

    torch.manual_seed(options.seed)
    network = FieldNetwork()
    average = FieldNetwork()
    average.load_state_dict(network.state_dict())
    average.eval().requires_grad_(False)
    network.to(options.device, memory_format=torch.channels_last)
    optimizer = torch.optim.AdamW(network.parameters(), lr=options.rate, weight_decay=0.02)
    log = options.out / "log.jsonl"
    log.unlink(missing_ok=True)
    validation = Validation(options.validate)
    generated = GeneratedScenes(10**9, seed=options.seed)
    workers = {
        "num_workers": options.workers,
        "multiprocessing_context": "spawn" if options.workers else None,
    }
    loader = iter(DataLoader(FieldDataset(generated), options.fresh, **workers))
    replay = ReplayBuffer(options.replay)
    generator = torch.Generator().manual_seed(options.seed)
    totals = {}
    start = time.monotonic()
    spent = 0.0
    validated = 0.0
    step = 0
    step_at_mark = 0
    while spent < options.minutes:
        replay.add(next(loader))
        batch = augment(replay.draw(options.fresh, options.batch, generator), generator)
        batch = {name: values.to(options.device) for name, values in batch.items()}
        rate = (
            options.rate
            * min(1.0, (step + 1) / 200)
            * 0.5
            * (1 + math.cos(math.pi * spent / options.minutes))
        )
        for group in optimizer.param_groups:
            group["lr"] = rate
        network.train()
        with torch.autocast(torch.device(options.device).type, torch.bfloat16):
            output = network(batch["image"].contiguous(memory_format=torch.channels_last))
        parts = losses(output.float(), batch)
        optimizer.zero_grad(set_to_none=True)
        torch.stack(list(parts.values())).sum().backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimizer.step()
        step += 1
        keep = min(0.998, step / (step + 10))
        for mean, now in zip(
            average.state_dict().values(), network.state_dict().values(), strict=True
        ):
            if mean.is_floating_point():
                mean.lerp_(now.float().to(mean.device), 1 - keep)
        for name, value in parts.items():
            totals[name] = totals.get(name, 0.0) + float(value.detach())
        spent = (time.monotonic() - start) / 60
        if spent - validated > options.every or spent >= options.minutes:
            entry = {"step": step, "minutes": round(spent, 2), "scenes": step * options.fresh}
            entry |= {
                name: round(value / (step - step_at_mark), 4) for name, value in totals.items()
            }
            entry |= {name: round(value, 4) for name, value in validation(_Field(average)).items()}
            save_weights(average, options.out / "field.safetensors")
            with log.open("a") as lines:
                lines.write(json.dumps(entry) + "\n")
            print(json.dumps(entry), flush=True)
            totals = {}
            validated = spent
            step_at_mark = step
    print(f"weights: {options.out / 'field.safetensors'}")


if __name__ == "__main__":
    main()

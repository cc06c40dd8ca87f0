"""Train a small viewpoint head on fixed layers, for an epoch on PASCAL3D+, and evaluate it.

    python scripts/training/train_viewpoint_head.py data/PASCAL3D+_release1.1 --out runs/head.json

Crops of photographs become the learned field and its HOG, which are not trained. From these and the
class, a head of two linear layers predicts a bin each of azimuth, elevation and theta. Every second
photograph is for the evaluation.
"""

import argparse
import json
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.data import DataLoader, Subset

import curvireg_torch as cr
from curvireg_torch.data.crops import UNKNOWN_CLASS, ObjectCrops


class ViewpointHead(nn.Module):
    """Logits of the bins of azimuth, elevation and theta, from crops (B, 3, S, S) and class numbers
    (B,)."""

    def __init__(self, classes: int, bins: tuple[int, ...], width: int = 256) -> None:
        super().__init__()
        self.layers = nn.Sequential(cr.LearnedCurvilinearSaliency(), cr.HOG()).requires_grad_(False)
        descriptor = self.layers[1].length
        self.classes = classes
        self.hidden = nn.Sequential(
            nn.LayerNorm(descriptor), nn.Linear(descriptor, width), nn.ReLU(), nn.Dropout(0.2)
        )
        self.logits = nn.ModuleList(nn.Linear(width + classes, count) for count in bins)

    def forward(self, image: Tensor, class_id: Tensor) -> list[Tensor]:
        with torch.no_grad():
            descriptors = self.layers(image)
        known = torch.cat(
            [self.hidden(descriptors), F.one_hot(class_id, self.classes).float()], dim=1
        )
        return [layer(known) for layer in self.logits]


def loss_of(logits: list[Tensor], bins: Tensor) -> Tensor:
    """Sum of the cross entropies of the three angles; objects of unknown pose are left out."""
    losses = [F.cross_entropy(each, target) for each, target in zip(logits, bins.T, strict=True)]
    return torch.stack(losses).sum()


def rotations_of(logits: list[Tensor], bins: tuple[int, ...]) -> Tensor:
    """(B, 3, 3) rotations at the centres of the most probable bins."""
    ranges = (0.0, 360.0), (-90.0, 90.0), (-180.0, 180.0)
    angles = []
    for each, count, (low, high) in zip(logits, bins, ranges, strict=True):
        number = each.argmax(dim=1)
        angles.append(low + (number + 0.5) * (high - low) / count)
    return cr.rotation_from_viewpoint(*angles)


@torch.no_grad()
def evaluate(head: ViewpointHead, loader: DataLoader, bins: tuple[int, ...]) -> dict[str, float]:
    """Mean loss, accuracy of the azimuth's bin, and errors of the rotation."""
    head.eval()
    losses = []
    right = []
    errors = []
    for batch in loader:
        known = (batch["viewpoint_bins"] != UNKNOWN_CLASS).all(dim=1)
        batch = {name: values[known] for name, values in batch.items()}
        if not len(batch["image"]):
            continue
        logits = head(batch["image"], batch["class_id"])
        losses += [float(loss_of(logits, batch["viewpoint_bins"]))] * len(batch["image"])
        right += (logits[0].argmax(dim=1) == batch["viewpoint_bins"][:, 0]).tolist()
        errors += cr.rotation_error(rotations_of(logits, bins), batch["rotation"]).tolist()
    error = torch.tensor(errors)
    return {
        "n": len(errors),
        "loss": round(sum(losses) / len(losses), 4),
        "accuracy_azimuth_bin": round(sum(right) / len(right), 4),
        "acc_pi_6": round(float((error < 30.0).float().mean()), 4),
        "med_err_deg": round(float(error.median()), 2),
    }


def halves(crops: ObjectCrops) -> tuple[Subset, Subset]:
    """Objects of every second photograph to train on, and the others: no photograph is in both."""
    paths = [crops.annotation(index)["image_path"] for index in range(len(crops))]
    order = {path: number for number, path in enumerate(dict.fromkeys(paths))}
    parts = [
        [index for index, path in enumerate(paths) if order[path] % 2 == part] for part in (0, 1)
    ]
    return Subset(crops, parts[0]), Subset(crops, parts[1])


def main(arguments: list[str] | None = None) -> dict[str, dict[str, float]]:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("root", type=Path, help="folder of PASCAL3D+")
    parser.add_argument("--split", default="val", help="whose photographs are halved")
    parser.add_argument("--epochs", type=int, default=1)
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--size", type=int, default=128, help="side of the crops in px")
    parser.add_argument("--rate", type=float, default=1e-3, help="learning rate")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="JSON file of the results")
    options = parser.parse_args(arguments)

    torch.manual_seed(options.seed)
    crops = cr.data.crops(cr.Pascal3DPlus(options.root, options.split), options.size)
    training, held_out = halves(crops)
    if not len(training) or not len(held_out):
        raise SystemExit(f"{crops.dataset!r}: expected at least two photographs")
    head = ViewpointHead(len(crops.classes), crops.bins)
    optimizer = torch.optim.AdamW(head.parameters(), lr=options.rate, weight_decay=0.01)
    known = DataLoader(training, options.batch)
    others = DataLoader(held_out, options.batch)
    results = {
        "before": evaluate(head, known, crops.bins),
        "held out before": evaluate(head, others, crops.bins),
    }
    for _ in range(options.epochs):
        head.train()
        for batch in DataLoader(training, options.batch, shuffle=True):
            loss = loss_of(head(batch["image"], batch["class_id"]), batch["viewpoint_bins"])
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
    results |= {
        "after": evaluate(head, known, crops.bins),
        "held out after": evaluate(head, others, crops.bins),
    }
    for name, values in results.items():
        print(f"{name}: {json.dumps(values)}")
    if options.out is not None:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(results, indent=2) + "\n")
    return results


if __name__ == "__main__":
    main()

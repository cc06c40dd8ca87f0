"""The datasets on the real photographs, against the counts and conventions of their README."""

from functools import cache

import pytest
import torch
import trimesh

from curvireg_torch.data import BOPDataset, Pascal3DPlus
from tests._support.real_data import real_data

pytestmark = pytest.mark.data


@cache
def vertices(path):
    return torch.tensor(
        trimesh.load(path, process=False, force="mesh").vertices, dtype=torch.float32
    )


def projected_box(path, sample):
    p = (vertices(path) @ sample["rotation"].T + sample["translation"]) @ sample["camera_matrix"].T
    pixels = p[:, :2] / p[:, 2:]
    return torch.cat([pixels.min(0).values, pixels.max(0).values])


def test_pascal3d_counts():
    dataset = Pascal3DPlus(real_data("pascal3d_mini"), pixel_origin=0)
    samples = [dataset.annotation(i) for i in range(len(dataset))]
    assert not dataset.skipped
    assert (sum(s["truncated"] for s in samples), sum(s["difficult"] for s in samples)) == (21, 19)
    assert sum(not s["truncated"] and not s["difficult"] for s in samples) == 64
    assert len(list(dataset.root.glob("CAD/*/*.off"))) == 63


@pytest.mark.slow
def test_pascal3d_projection_fills_the_labelled_box():
    """Offset and distance were fitted to the box; the CAD model of the category has another
    shape."""
    dataset = Pascal3DPlus(
        real_data("pascal3d_mini"), pixel_origin=0, truncated=False, difficult=False
    )
    centre = []
    edges = []
    for sample in map(dataset.annotation, range(0, len(dataset), 3)):
        box = projected_box(sample["cad_path"], sample)
        labelled = sample["box"]
        size = (labelled[2:] - labelled[:2]).max()
        centre.append((box[:2] + box[2:] - labelled[:2] - labelled[2:]).abs().max() / 2)
        edges.append((box - labelled).abs().max() / size)
    assert max(centre) < 0.1
    assert torch.stack(edges).median() < 0.02
    assert max(edges) < 0.06


@pytest.mark.parametrize(("name", "count"), [("dino", 105), ("hope", 80), ("lm", 8)])
def test_bop_counts_and_projection(name, count):
    dataset = BOPDataset(real_data(f"bop/{name}"))
    assert len(dataset) == count
    assert not dataset.skipped
    for sample in map(dataset.annotation, range(count)):
        assert (projected_box(sample["model_path"], sample) - sample["box"]).abs().max() < 2, (
            "pixels"
        )

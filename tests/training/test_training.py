"""Training samples, losses and fine-tuning."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import trimesh

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.matching.fields import depth_filter, hog_layer
from curvireg_torch.models import FieldNetwork, LearnedCurvilinearSaliency, doubled_angle
from curvireg_torch.training import FieldDataset, ReplayBuffer, adapt, augment, losses
from curvireg_torch.training.field_dataset import SETTINGS
from curvireg_torch.training.scenes import GeneratedScenes


@pytest.fixture(scope="module")
def batch():
    lessons = FieldDataset(GeneratedScenes(4, seed=1))
    items = [lessons[i] for i in range(4)]
    stacked = {k: torch.stack([item[k] for item in items]).float() for k in items[0]}
    return {**stacked, "image": stacked["image"] / 255}


def test_the_answers_are_those_of_the_banks_filters(batch):
    scenes = GeneratedScenes(4, seed=1)
    field = depth_filter(SETTINGS)(scenes[2]["depth"][None])
    assert torch.allclose(batch["descriptors"][2, 0], hog_layer(SETTINGS)(field)[0], atol=1e-3)
    direction = torch.nn.functional.avg_pool2d(doubled_angle(field), 2)[0]
    same = torch.nn.functional.cosine_similarity(direction.flatten(), batch["code"][2].flatten(), dim=0)
    assert same == pytest.approx(1.0, abs=1e-3)


def test_the_right_answer_has_no_loss(batch):
    mask = torch.logit(batch["mask"].clamp(1e-6, 1 - 1e-6))
    right = losses(torch.cat([batch["code"], mask], dim=1), batch)
    nothing = losses(torch.zeros(4, 3, 64, 64), batch)
    assert right["field"] == 0
    assert nothing["field"] == pytest.approx(1.0)
    assert right["mask"] < nothing["mask"]
    assert right["descriptor"] < 0.1 < nothing["descriptor"]
    assert right["ranking"] < 0.01 < nothing["ranking"]


def test_mirroring_keeps_answers_right(batch):
    """All samples are mirrored, or none: the code's loss of a mirrored right answer stays 0."""
    found = set()
    for seed in range(6):
        one = {k: v[:1] for k, v in batch.items()}
        other = augment(one, torch.Generator().manual_seed(seed))
        reflection = not torch.equal(other["mask"], one["mask"])
        found.add(reflection)
        expected = one["code"].flip(3) * torch.tensor([1.0, -1.0])[:, None, None] if reflection else one["code"]
        assert torch.equal(other["code"], expected)
        answer = torch.cat([other["code"], torch.zeros_like(other["mask"])], dim=1)
        assert losses(answer, other)["descriptor"] < 0.1
    assert found == {False, True}


def test_replay_keeps_the_latest(batch):
    replay = ReplayBuffer(6)
    for k in range(4):
        replay.add({name: values[:2] * 0 + k for name, values in batch.items()})
    drawn = replay.draw(2, 40, torch.Generator().manual_seed(0))
    assert set(drawn["mask"].flatten(1)[:, 0].tolist()) == {1.0, 2.0, 3.0}
    assert (drawn["mask"][:2] == 3).all()


def test_a_few_steps_lower_the_loss(batch):
    torch.manual_seed(0)
    network = FieldNetwork((8, 8, 16, 16))
    optimizer = torch.optim.AdamW(network.parameters(), lr=3e-3)
    history = []
    for _ in range(25):
        parts = losses(network(batch["image"]), batch)
        loss = torch.stack(list(parts.values())).sum()
        history.append(float(loss.detach()))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert history[-1] < 0.7 * history[0]


def test_adapting_changes_the_network_and_leaves_its_statistics():
    mesh = trimesh.creation.box((1, 2, 3))
    before = FieldNetwork().state_dict().keys()
    field = adapt(mesh, scenes=8, workers=0, progress=False)
    again = adapt(mesh, scenes=8, workers=0, progress=False)
    packaged = LearnedCurvilinearSaliency().network.state_dict()
    adapted = field.network.state_dict()
    assert adapted.keys() == before
    assert not torch.equal(adapted["head.weight"], packaged["head.weight"])
    means = [k for k in before if k.endswith("running_mean")]
    assert all(torch.equal(adapted[k], packaged[k]) for k in means)
    assert torch.equal(adapted["head.weight"], again.network.state_dict()["head.weight"])
    assert not any(p.requires_grad for p in field.network.parameters())


def test_adapting_works_from_a_plain_script(tmp_path):
    """One without ``if __name__ == "__main__":``, which a spawned process would run again."""
    script = tmp_path / "plain.py"
    script.write_text(
        "import trimesh\n"
        "from curvireg_torch.training import adapt\n"
        "adapt(trimesh.creation.box(), scenes=1, progress=False).save('adapted.safetensors')\n"
        "print('done')\n"
    )
    root = Path(__file__).parents[2]
    found = subprocess.run(
        [sys.executable, script],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
    )
    assert found.returncode == 0, found.stderr
    assert found.stdout == "done\n"
    assert (tmp_path / "adapted.safetensors").is_file()


def test_errors():
    with pytest.raises(InvalidInputError, match="scenes"):
        adapt(trimesh.creation.box(), scenes=0)


def test_pictures_are_mirrored_with_their_answers():
    """What is drawn in one half of a picture stays on the side of the mask, whatever becomes of its colours."""
    B = 32
    image, mask = torch.full((B, 3, 16, 16), 0.5), torch.zeros(B, 1, 8, 8)
    image[..., ::2, :8] = 0.9
    mask[..., :4] = 1.0
    width = hog_layer(SETTINGS)(torch.zeros(1, 2, 128, 128)).shape[1]
    batch = {"image": image, "mask": mask, "code": torch.zeros(B, 2, 8, 8), "descriptors": torch.zeros(B, 7, width)}
    found = augment(batch, torch.Generator().manual_seed(0))
    left, right = (half.std(dim=2).mean(dim=(1, 2)) for half in found["image"].split(8, dim=3))
    reflection = found["mask"][:, 0, 0, 0] == 0
    assert 5 < int(reflection.sum()) < B - 5
    assert torch.equal(right > left, reflection)

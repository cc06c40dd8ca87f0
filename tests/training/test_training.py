"""Training samples, losses and fine-tuning."""

import os
import subprocess
import sys

import pytest
import torch
import trimesh

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.features import FieldNetwork, LearnedCurvilinearSaliency, doubled_angle
from curvireg_torch.matching.fields import depth_filter, hog_layer
from curvireg_torch.training import FieldDataset, ReplayBuffer, adapt, augment, losses
from curvireg_torch.training.field_dataset import SETTINGS
from curvireg_torch.training.scenes import GeneratedScenes
from tests._support.scripts import ROOT


@pytest.fixture(scope="module")
def batch():
    dataset = FieldDataset(GeneratedScenes(4, seed=1))
    stacked = torch.utils.data.default_collate([dataset[i] for i in range(4)])
    return {name: values.float() / (255 if name == "image" else 1) for name, values in stacked.items()}


def test_field_dataset_targets_are_those_of_a_bank(batch):
    scenes = GeneratedScenes(4, seed=1)
    field = depth_filter(SETTINGS)(scenes[2]["depth"][None])
    assert torch.allclose(batch["descriptors"][2, 0], hog_layer(SETTINGS)(field)[0], atol=1e-3)
    direction = torch.nn.functional.avg_pool2d(doubled_angle(field), 2)[0]
    same = torch.nn.functional.cosine_similarity(direction.flatten(), batch["code"][2].flatten(), dim=0)
    assert same == pytest.approx(1.0, abs=1e-3)


def test_losses_of_the_target_are_small(batch):
    mask = torch.logit(batch["mask"].clamp(1e-6, 1 - 1e-6))
    right = losses(torch.cat([batch["code"], mask], dim=1), batch)
    zero = losses(torch.zeros(4, 3, 64, 64), batch)
    assert right["field"] == 0
    assert zero["field"] == pytest.approx(1.0)
    assert right["mask"] < zero["mask"]
    assert right["descriptor"] < 0.1 < zero["descriptor"]
    assert right["ranking"] < 0.01 < zero["ranking"]


def test_augment_mirrors_targets(batch):
    """All samples are mirrored, or none: the code's loss of a mirrored right answer stays 0."""
    found = set()
    for seed in range(6):
        one = {k: v[:1] for k, v in batch.items()}
        other = augment(one, torch.Generator().manual_seed(seed))
        reflection = not torch.equal(other["mask"], one["mask"])
        found.add(reflection)
        expected = one["code"].flip(3) * torch.tensor([1.0, -1.0])[:, None, None] if reflection else one["code"]
        assert torch.equal(other["code"], expected)
        output = torch.cat([other["code"], torch.zeros_like(other["mask"])], dim=1)
        assert losses(output, other)["descriptor"] < 0.1
    assert found == {False, True}


def test_replay_buffer_keeps_the_latest(batch):
    replay = ReplayBuffer(6)
    for k in range(4):
        replay.add({name: values[:2] * 0 + k for name, values in batch.items()})
    drawn = replay.draw(2, 40, torch.Generator().manual_seed(0))
    assert set(drawn["mask"].flatten(1)[:, 0].tolist()) == {1.0, 2.0, 3.0}
    assert (drawn["mask"][:2] == 3).all()


def test_losses_decrease_in_training(batch):
    torch.manual_seed(0)
    network = FieldNetwork((8, 8, 16, 16))
    optimizer = torch.optim.AdamW(network.parameters(), lr=3e-3)
    history = []
    for _ in range(25):
        history.append(sum(losses(network(batch["image"]), batch).values()))
        optimizer.zero_grad()
        history[-1].backward()
        optimizer.step()
    assert history[-1] < 0.7 * history[0]


def test_adapt_changes_weights_but_no_statistics():
    networks = [adapt(trimesh.creation.box((1, 2, 3)), scenes=8, progress=False).network for _ in range(2)]
    adapted, again = (network.state_dict() for network in networks)
    packaged = LearnedCurvilinearSaliency().network.state_dict()
    assert adapted.keys() == packaged.keys()
    assert not torch.equal(adapted["head.weight"], packaged["head.weight"])
    assert torch.equal(adapted["head.weight"], again["head.weight"])
    assert all(torch.equal(adapted[k], packaged[k]) for k in packaged if k.endswith("running_mean"))
    assert not any(p.requires_grad for p in networks[0].parameters())


def test_adapt_works_in_a_script_without_main_guard(tmp_path):
    """A spawned process would run such a script again."""
    script = tmp_path / "plain.py"
    script.write_text(
        "import trimesh\n"
        "from curvireg_torch.training import adapt\n"
        "adapt(trimesh.creation.box(), scenes=1, progress=False).save('adapted.safetensors')\n"
        "print('done')\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, script], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "done\n"), done.stderr
    assert (tmp_path / "adapted.safetensors").is_file()


def test_adapt_rejects_zero_scenes():
    with pytest.raises(InvalidInputError, match="scenes"):
        adapt(trimesh.creation.box(), scenes=0)


def test_augment_mirrors_images_with_their_masks():
    """A pattern in one half of an image stays on the side of the mask, whatever its new colours."""
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

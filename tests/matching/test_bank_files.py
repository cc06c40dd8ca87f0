"""Banks in memory, on disk, in parts and in collections."""

import os
import stat
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from safetensors.torch import load_file, save_file

from curvireg_torch.errors import BankError, InvalidInputError, MissingFileError
from curvireg_torch.geometry import sample_views, uniform_views
from curvireg_torch.io.meshes.up import mesh_up
from curvireg_torch.matching import ViewBank, ViewMatcher
from curvireg_torch.pipeline import Pipeline
from curvireg_torch.registration import Registrar
from curvireg_torch.settings import BankSettings, ViewPolicy
from curvireg_torch.synthetic import example_mesh
from curvireg_torch.terms import normalized_correlation

SETTINGS = BankSettings(image_size=64)
VIEWS = sample_views(azimuth_step=30, elevations=[0, 40])


@pytest.fixture(scope="module")
def bank() -> ViewBank:
    return ViewBank.build(example_mesh(), VIEWS, settings=SETTINGS, progress=False)


def same(a: ViewBank, b: ViewBank, *, atol: float = 0.0) -> None:
    torch.testing.assert_close(a.descriptors, b.descriptors, rtol=0, atol=atol)
    for name in ("points", "silhouettes", "boxes", "rotations"):
        assert torch.equal(getattr(a, name), getattr(b, name))
    assert a.settings == b.settings


def test_bank_comes_back_from_disk(bank: ViewBank, tmp_path: Path) -> None:
    bank.save(tmp_path / "new" / "bank.safetensors")
    loaded = ViewBank.load(tmp_path / "new" / "bank.safetensors")
    same(loaded, bank, atol=5e-4)
    np.testing.assert_array_equal(loaded.mesh.vertices, bank.mesh.vertices)
    np.testing.assert_array_equal(loaded.mesh.faces, bank.mesh.faces)
    assert loaded.mesh.units == "m"
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["bank.safetensors"]
    if os.name == "posix":
        mask = os.umask(0)
        os.umask(mask)
        assert stat.S_IMODE((tmp_path / "new" / "bank.safetensors").stat().st_mode) == 0o666 & ~mask


def test_float16_storage_leaves_the_ranking_as_it_is(bank: ViewBank, tmp_path: Path) -> None:
    # Queries as unlike the views as photographs are: noise of half the descriptors' length.
    bank.save(tmp_path / "bank.safetensors")
    loaded = ViewBank.load(tmp_path / "bank.safetensors")
    noise = torch.rand(200, bank.descriptors.shape[1], generator=torch.Generator().manual_seed(0))
    noise *= 0.5 * bank.descriptors.norm(dim=1).mean() / noise.norm(dim=1, keepdim=True)
    queries = bank.descriptors[torch.arange(200) % len(bank)] + noise
    exact, stored = (normalized_correlation(queries, b.descriptors) for b in (bank, loaded))
    assert float((exact - stored).abs().max()) < 1e-4
    assert float((exact.argmax(dim=1) == stored.argmax(dim=1)).float().mean()) == 1.0


def test_chunks_and_threads_change_nothing(bank: ViewBank) -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        other = ViewBank.build(example_mesh(), VIEWS, settings=SETTINGS, progress=False, chunk_size=5)
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
    same(other, bank, atol=1e-5)


def test_parts_are_unpacked_alone(bank: ViewBank) -> None:
    index = torch.tensor([3, 0])
    assert torch.equal(bank.points_at(index), bank.points[index])
    assert torch.equal(bank.silhouettes_at(slice(2, 5)), bank.silhouettes[2:5])
    assert bank.silhouettes.dtype == torch.bool
    assert 0.1 < float(bank.silhouettes.float().mean()) < 0.6


def test_interrupted_build_and_save_leave_nothing(
    bank: ViewBank, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(_: int) -> None:
        raise KeyboardInterrupt

    bank.save(tmp_path / "bank.safetensors")
    whole = (tmp_path / "bank.safetensors").read_bytes()
    monkeypatch.setattr(os, "fsync", interrupted)  # the content is written, the name not yet given
    for name in ("bank.safetensors", "other.safetensors"):
        with pytest.raises(KeyboardInterrupt):
            bank.save(tmp_path / name)
    assert [p.name for p in tmp_path.iterdir()] == ["bank.safetensors"]
    assert (tmp_path / "bank.safetensors").read_bytes() == whole


def test_an_error_in_one_view_ends_the_build() -> None:
    class Broken:
        name = "broken"

        def render(self, T: torch.Tensor, *_: object, **__: object) -> torch.Tensor:
            raise KeyboardInterrupt

    before = torch.get_num_threads()
    with pytest.raises(KeyboardInterrupt):
        ViewBank.build(example_mesh(), VIEWS, settings=SETTINGS, progress=False, renderer=Broken(), chunk_size=1)
    assert torch.get_num_threads() == before


def edited(path: Path, out: Path, tensors: dict[str, torch.Tensor] | None = None, **metadata: str) -> Path:
    from safetensors import safe_open

    with safe_open(path, framework="pt") as file:
        kept = dict(file.metadata())
    content = {**load_file(path), **(tensors or {})}
    save_file({k: v for k, v in content.items() if v.numel()}, out, {**kept, **metadata})
    return out


def written(bank: ViewBank, out: Path, **tensors: torch.Tensor) -> Path:
    """A bank of nonsense, with a checksum that fits."""
    ViewBank(bank.meshes, bank.views, bank.pipeline, {**bank.tensors, **tensors}).save(out)
    return out


def test_every_changed_bit_is_found(bank: ViewBank, tmp_path: Path) -> None:
    path = tmp_path / "bank.safetensors"
    bank.save(path)
    content = bytearray(path.read_bytes())
    for place in torch.linspace(len(content) // 3, len(content) - 1, 12).long().tolist():
        content[place] ^= 1
        path.write_bytes(content)
        with pytest.raises(BankError, match="checksum"):
            ViewBank.load(path)
        content[place] ^= 1


def test_a_bank_of_another_pipeline_is_refused(bank: ViewBank) -> None:
    with pytest.raises(BankError, match=r"made with other settings \(image_size 64, asked for 128\)"):
        ViewMatcher(bank, pipeline=Pipeline())


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"pose": "any"}, "pose upright, asked for any"),
        ({"pose": "given"}, "pose upright, asked for given"),
        ({"azimuth_step": 60.0}, r"azimuth_step 120\.0, asked for 60\.0"),
        ({"elevations": (5.0,)}, r"elevations \(10\.0,\), asked for \(5\.0,\)"),
        ({"distance": 6.0}, r"distance 5\.0, asked for 6\.0"),
    ],
)
def test_a_bank_of_another_pose_is_refused(change: dict[str, object], told: str) -> None:
    policy = ViewPolicy(pose="upright", azimuth_step=120.0, elevations=(10.0,))
    pipeline = Pipeline(views=policy, bank=SETTINGS)
    bank = ViewBank.build(example_mesh(), pipeline=pipeline, progress=False)
    other = replace(pipeline, views=replace(policy, **change))
    for make in (ViewMatcher, Registrar):
        with pytest.raises(BankError, match=told):
            make(bank, pipeline=other)
    beside_the_point = replace(pipeline, views=replace(policy, directions=9, theta_step=9.0))  # of pose="any"
    assert ViewMatcher(bank, pipeline=beside_the_point).pipeline.views == policy


def test_views_that_came_with_the_call_go_with_every_policy(bank: ViewBank) -> None:
    for pose in ("any", "upright", "given"):
        assert ViewMatcher(bank, pipeline=Pipeline(bank=SETTINGS).with_pose_prior(pose)).pipeline.views.pose == "given"


def test_banks_of_different_poses_are_not_joined(bank: ViewBank) -> None:
    policy = ViewPolicy(pose="upright", azimuth_step=120.0, elevations=(10.0,))
    upright = ViewBank.build(example_mesh(), pipeline=Pipeline(views=policy, bank=SETTINGS), progress=False)
    with pytest.raises(InvalidInputError, match=r"one view policy, but bank 1 has .*upright.* and bank 0 .*given"):
        ViewBank.join([bank, upright])


def test_files_that_do_not_fit_are_refused(bank: ViewBank, tmp_path: Path) -> None:
    good = tmp_path / "bank.safetensors"
    bank.save(good)
    cut = tmp_path / "cut.safetensors"
    cut.write_bytes(good.read_bytes()[:-100])
    wider = Pipeline(bank=replace(SETTINGS, image_size=128)).to_json()
    infinite = bank.descriptors.half()
    infinite[3, 5] = torch.nan
    cases = [
        (cut, "truncated"),
        (edited(good, tmp_path / "a", format="x"), "not a view bank"),
        (edited(good, tmp_path / "b", version="0"), "bank format 0"),
        (edited(good, tmp_path / "c", pipeline="{"), "incomplete"),
        (edited(good, tmp_path / "d", pipeline='{"bank": {"image_size": 64, "colour": 1}}'), "incomplete"),
        (edited(good, tmp_path / "e", pipeline=wider), "points, silhouettes: not of the shape"),
        (edited(good, tmp_path / "f", {"descriptors": torch.zeros(len(bank), 7)}), "checksum"),
        (edited(good, tmp_path / "g", {"boxes": torch.zeros(len(bank) - 1, 4)}), "checksum"),
        (edited(good, tmp_path / "h", {"points": torch.zeros(0)}), "checksum"),
        (written(bank, tmp_path / "i", descriptors=infinite), "not finite"),
        (written(bank, tmp_path / "j", descriptors=torch.zeros_like(bank.descriptors)), "all zero"),
        (written(bank, tmp_path / "k", boxes=bank.boxes[:, [2, 1, 0, 3]]), "empty"),
        (written(bank, tmp_path / "l", model=bank.model + 1), "meshes that do not exist"),
    ]
    for path, match in cases:
        with pytest.raises(BankError, match=match):
            ViewBank.load(path)
    with pytest.raises(MissingFileError, match="no such bank"):
        ViewBank.load(tmp_path / "none")


def test_collection_is_its_banks_one_after_the_other(bank: ViewBank) -> None:
    second = ViewBank.build(trimesh.creation.box((0.1, 0.2, 0.1)), uniform_views(7), settings=SETTINGS, progress=False)
    both = ViewBank.join([bank, second])
    assert len(both) == len(bank) + 7
    for name in ("descriptors", "points", "silhouettes", "boxes", "rotations"):
        assert torch.equal(getattr(both, name), torch.cat([getattr(bank, name), getattr(second, name)]))
    assert torch.equal(
        both.points_at(torch.tensor([len(bank) + 2, 1])), torch.stack([second.points[2], bank.points[1]])
    )
    assert [both.locate(i) for i in (0, len(bank) - 1, len(bank), len(both) - 1)] == [
        (0, 0),
        (0, len(bank) - 1),
        (1, 0),
        (1, 6),
    ]
    with pytest.raises(InvalidInputError, match="index"):
        both.locate(len(both))


def test_matcher_finds_the_right_model_in_a_collection(bank: ViewBank) -> None:
    box = ViewBank.build(trimesh.creation.box((0.1, 0.2, 0.1)), VIEWS, settings=SETTINGS, progress=False)
    both = ViewBank.join([box, bank])
    matcher = ViewMatcher(both)
    index = len(box) + 5
    picture = bank.silhouettes[5].float()[None, None].repeat(1, 3, 1, 1)
    edges = torch.tensor([[-0.5, -0.5, 63.5, 63.5]])
    ranking = matcher(picture, edges / 1.2 + 63.0 * (1 - 1 / 1.2) / 2)  # the crop's margin gives the whole view
    best = [both.locate(int(i)) for i in ranking.top(3)[0]]
    assert (1, 5) in best, (index, best)


def test_collections_that_cannot_be_compared_are_refused(bank: ViewBank) -> None:
    coarse = ViewBank.build(example_mesh(), uniform_views(3), settings=replace(SETTINGS, sigma=2.0), progress=False)
    with pytest.raises(InvalidInputError, match="one set of settings"):
        ViewBank.join([bank, coarse])
    with pytest.raises(InvalidInputError, match="at least one bank"):
        ViewBank.join([])


def test_any_device(bank: ViewBank) -> None:
    devices = ["cpu"] + (["cuda"] if torch.cuda.is_available() else [])
    for device in devices:
        moved = bank.to(device)
        assert moved.device.type == moved.rotations.device.type == moved.points.device.type == device
        assert torch.equal(moved.silhouettes.cpu(), bank.silhouettes)


def test_a_joined_bank_can_be_joined_again() -> None:
    """Models are numbered through, as the list of meshes is."""
    meshes = [trimesh.creation.box((1, 1, height)) for height in (1, 2, 3, 4)]
    views = sample_views(azimuth_step=180, elevations=[20])
    banks = [ViewBank.build(mesh, views, settings=SETTINGS, progress=False) for mesh in meshes]
    nested = ViewBank.join([ViewBank.join(banks[:2]), ViewBank.join(banks[2:])])
    flat = ViewBank.join(banks)
    assert nested.model.tolist() == flat.model.tolist() == sorted([0, 1, 2, 3] * len(views))
    assert [float(mesh.extents[2]) for mesh in nested.meshes] == [1.0, 2.0, 3.0, 4.0]
    same(nested, flat)


@pytest.mark.parametrize("up", ["y", "z"])
def test_a_mesh_comes_back_with_the_axis_that_points_up(up: str, tmp_path: Path) -> None:
    mesh = example_mesh()
    mesh.metadata["up"] = up
    views = sample_views(azimuth_step=180, elevations=[20])
    ViewBank.build(mesh, views, settings=SETTINGS, progress=False).save(tmp_path / "bank.safetensors")
    assert mesh_up(ViewBank.load(tmp_path / "bank.safetensors").mesh) == up


def test_a_bank_with_an_empty_box_is_refused(bank: ViewBank, tmp_path: Path) -> None:
    boxes = bank.boxes.clone()
    boxes[3, 3] = boxes[3, 1]
    ViewBank(bank.meshes, bank.views, bank.pipeline, {**bank.tensors, "boxes": boxes}).save(tmp_path / "bank.st")
    with pytest.raises(BankError, match="boxes that are empty"):
        ViewBank.load(tmp_path / "bank.st")

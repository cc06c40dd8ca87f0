import multiprocessing
import os
import time
import uuid
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
import trimesh
from PIL import Image

from curvireg_torch.geometry import sample_views
from curvireg_torch.matching import ViewBank, bank_key, cache, cache_folder, cached_bank, list_cache
from curvireg_torch.matching.cache import clear_cache
from curvireg_torch.mesh import symmetry
from curvireg_torch.mesh.mesh import as_mesh
from curvireg_torch.pipeline import PRESETS, BankSettings, FitSettings

PIPELINE = replace(PRESETS["classical"], bank=BankSettings(image_size=64))  # quickly built
VIEWS = sample_views(azimuth_step=90, elevations=[20])


@pytest.fixture(autouse=True)
def _no_symmetries(monkeypatch):
    """Their search takes most of the time of a small bank."""
    monkeypatch.setattr(symmetry._Surface, "aligned", lambda *_: None)


def cached(mesh, folder):
    return cached_bank(mesh, VIEWS, pipeline=PIPELINE, folder=folder, progress=False)


def cached_box(folder, edge=1.0):
    return cached(trimesh.creation.box((edge, 1.0, 1.0)), folder)


def key(mesh, views=VIEWS, **options):
    return bank_key(mesh, views, **{"pipeline": PIPELINE, **options})


def textured(*, uv=0.0, level=0, side=4):
    """A box with a texture of 16 pixels and texture coordinates that float16 cannot represent."""
    mesh = trimesh.creation.box()
    pixels = np.arange(48, dtype=np.uint8).reshape(side, 16 // side, 3) + np.uint8(level)
    coordinates = np.random.default_rng(0).random((len(mesh.vertices), 2)) + uv
    mesh.visual = trimesh.visual.TextureVisuals(uv=coordinates, image=Image.fromarray(pixels))
    return mesh


def standing():
    return replace(as_mesh(trimesh.creation.box()), up="y")


def test_bank_key_depends_on_everything(monkeypatch):
    mesh = trimesh.creation.box()
    moved, flipped, painted = (mesh.copy() for _ in range(3))
    moved.vertices[0] += 1e-9
    flipped.faces = flipped.faces[::-1]
    painted.visual.vertex_colors[0] = (9, 8, 7, 255)
    meshes = [mesh, moved, flipped, painted, standing()]
    meshes += [textured(), textured(uv=1e-4), textured(level=1), textured(side=8), textured(side=2)]
    keys = [key(m) for m in meshes]
    keys += [key(mesh, VIEWS[:3]), key(mesh, renderer="embree")]
    keys += [key(mesh, pipeline=replace(PIPELINE, bank=replace(PIPELINE.bank, sigma=1.5)))]
    assert key(textured().copy()) in keys
    fit = FitSettings(screened_views=15)
    assert key(mesh, pipeline=replace(PIPELINE, fit=fit)) == keys[0]
    monkeypatch.setattr(cache, "package_digest", lambda **_: "another version")
    keys.append(key(mesh))
    assert len(set(keys)) == len(keys)


def test_bank_of_another_unit_is_not_rendered_again(tmp_path, monkeypatch):
    mesh = trimesh.creation.box()
    assert cached(mesh, tmp_path).mesh.unit is None
    monkeypatch.setattr(ViewBank, "build", None)  # would fail
    for unit in ("mm", "m"):
        mesh.units = unit
        bank = cached(mesh, tmp_path)
        assert bank.mesh.unit == unit
    mesh = trimesh.creation.box()
    assert cached(mesh, tmp_path).mesh.unit is None
    assert len(list_cache(tmp_path)) == 1


def test_a_bank_from_the_cache_has_the_warnings_of_this_mesh(tmp_path):
    """The same surface in another file, of which a leftover was left out; and the other way."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    leftover = trimesh.Trimesh([[40.0, 0, 0], [40.01, 0, 0], [40.0, 0.01, 0]], [[0, 1, 2]])
    with_leftover = trimesh.util.concatenate([ball, leftover])
    found = [cached(mesh, tmp_path).mesh for mesh in (ball, with_leftover, ball)]
    assert len(list_cache(tmp_path)) == 1
    kinds = [[warning.kind for warning in mesh.warnings] for mesh in found]
    assert kinds == [[], ["stray"], []]


def test_cached_bank_is_loaded_the_second_time(tmp_path, monkeypatch):
    meshes = [trimesh.creation.box(), standing(), textured(uv=100.0), textured(uv=100.0, level=1)]
    banks = [cached(mesh, tmp_path) for mesh in meshes]
    monkeypatch.setattr(ViewBank, "build", None)  # would fail
    for mesh, bank in zip(meshes, banks, strict=True):
        again = cached(mesh, tmp_path)
        assert torch.equal(again.descriptors, bank.descriptors)
        found = ViewBank.load(list_cache(tmp_path)[0].path).mesh
        given = as_mesh(mesh)
        assert found.up == again.mesh.up == given.up
        if given.colours is None:
            assert found.colours is again.mesh.colours is None
        else:
            for colours in (found.colours, again.mesh.colours):
                np.testing.assert_array_equal(colours.uv, given.colours.uv)
                np.testing.assert_array_equal(colours.textures[0], given.colours.textures[0])


def test_cached_bank_replaces_damaged_and_mislabelled_files(tmp_path):
    bank = cached_box(tmp_path)
    (path,) = (tmp_path / "banks").iterdir()
    whole = path.read_bytes()
    no_bank = safetensors.torch.save({"w": torch.zeros(9)}, {"format": "pt"})
    cached_box(tmp_path / "other", 9.0)
    (other,) = (tmp_path / "other" / "banks").iterdir()
    for damaged in (whole[:-10], b"", no_bank, other.read_bytes()):
        path.write_bytes(damaged)
        assert torch.equal(cached_box(tmp_path).descriptors, bank.descriptors)
        assert path.stat().st_size == len(whole)


def test_cached_bank_removes_the_least_recently_used(tmp_path, monkeypatch):
    for i, edge in enumerate((1.5, 2.0, 3.0)):
        cached_box(tmp_path, edge)
        for file in list_cache(tmp_path):
            if file.used > time.time() - 50:  # the new one
                os.utime(file.path, (1000.0 + i, 1000.0 + i))
    first, second, third = sorted(list_cache(tmp_path), key=lambda file: file.used)
    cached_box(tmp_path, 1.5)  # used again
    assert list_cache(tmp_path)[0].path == first.path
    incomplete = [first.path.with_name(f"{first.path.name}.{k:08x}.tmp") for k in range(2)]
    for path in incomplete:
        path.write_bytes(first.path.read_bytes()[:9000])
    # of a killed process; another process may be writing the first
    os.utime(incomplete[1], (1000.0, 1000.0))
    monkeypatch.setenv("CURVIREG_CACHE_LIMIT", str(int(3.1 * first.size)))
    cached_box(tmp_path, 4.0)
    left = {file.path for file in list_cache(tmp_path)}
    assert first.path in left
    assert not left & {second.path, third.path}
    assert [path.exists() for path in incomplete] == [True, False]
    monkeypatch.setenv("CURVIREG_CACHE_LIMIT", "10")  # less than one bank: the newest stays
    cached_box(tmp_path, 5.0)
    (newest,) = list_cache(tmp_path)
    assert newest.path not in left


def test_cache_never_touches_foreign_files(tmp_path, monkeypatch):
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path))
    assert cache_folder() == tmp_path
    assert (list_cache(), clear_cache()) == ([], 0)  # the folder does not exist
    cached_box(None)
    (bank,) = list_cache()
    assert bank.size == bank.path.stat().st_size > 1000
    # the second is a bank in another folder
    foreign = [tmp_path / "model.safetensors", tmp_path / bank.path.name]
    foreign += map(
        bank.path.with_name, ("my bank.safetensors", f"{bank.path.name}.orig", "notes.txt")
    )
    for path in foreign:
        path.write_bytes(b"notes")
    assert list_cache() == [bank]
    bank.path.with_name(f"{bank.path.name}.{uuid.uuid4().hex[:8]}.tmp").touch()
    assert clear_cache() == 1
    assert sorted(path for path in tmp_path.rglob("*") if path.is_file()) == sorted(foreign)


def test_cached_bank_warns_of_an_unwritable_folder(tmp_path):
    (tmp_path / "file").write_text("a file where the folder should be")
    with pytest.warns(
        UserWarning, match=r"file/banks/bank-.*cannot be written \(.*by CURVIREG_CACHE=FOLDER"
    ):
        assert len(cached_box(tmp_path / "file")) == len(VIEWS)
    assert (list_cache(tmp_path / "file"), clear_cache(tmp_path / "file")) == ([], 0)


def _build_all(folder, edges):
    torch.set_num_threads(1)
    return sum(float(cached_box(Path(folder), edge).descriptors.sum()) for edge in edges)


@pytest.mark.slow
# Spawned processes would import everything again, some seconds each. Python 3.12 warns of fork
# beside threads.
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
def test_cached_bank_in_concurrent_processes(tmp_path):
    edges = (1.0, 2.0, 3.0)
    with multiprocessing.get_context("fork").Pool(2) as pool:
        sums = pool.starmap(_build_all, [(str(tmp_path), edges)] * 4, chunksize=1)
    assert max(sums) - min(sums) < 1e-3 * sums[0]
    assert len(list((tmp_path / "banks").iterdir())) == len(edges)  # no incomplete file
    assert {len(ViewBank.load(file.path)) for file in list_cache(tmp_path)} == {len(VIEWS)}

"""The cache of banks: found again, trimmed, cleared, shared among processes."""

import errno
import multiprocessing
import os
import tempfile
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
from curvireg_torch.io.meshes.colours import SurfaceColours
from curvireg_torch.io.meshes.mesh import as_mesh
from curvireg_torch.matching import ViewBank, bank_key, cache_folder, cached_bank, clear_cache, list_cache, trim_cache
from curvireg_torch.pipeline import Pipeline
from curvireg_torch.rendering import make_renderer
from curvireg_torch.settings import BankSettings

SETTINGS = BankSettings(image_size=64)
PIPELINE = Pipeline(bank=SETTINGS)
VIEWS = sample_views(azimuth_step=90, elevations=[20])


def build(folder: Path, edge: float = 1.0, **options: object) -> ViewBank:
    mesh = trimesh.creation.box((edge, 1.0, 1.0))
    return cached_bank(mesh, VIEWS, pipeline=PIPELINE, folder=folder, progress=False, **options)


def test_second_time_from_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = build(tmp_path)
    monkeypatch.setattr(ViewBank, "build", None)  # would fail
    again = build(tmp_path)
    torch.testing.assert_close(again.descriptors, first.descriptors, rtol=0, atol=5e-4)


def test_key_depends_on_everything(monkeypatch: pytest.MonkeyPatch) -> None:
    from curvireg_torch.matching import cache

    mesh = trimesh.creation.box()
    millimetres, metres, moved, flipped = (mesh.copy() for _ in range(4))
    millimetres.units, metres.units = "mm", "m"  # and none
    moved.vertices[0] += 1e-9
    flipped.faces = flipped.faces[::-1]
    standing = mesh.copy()
    standing.metadata["up"] = "y"
    keys = [bank_key(m, VIEWS, pipeline=PIPELINE) for m in (mesh, millimetres, metres, moved, flipped, standing)]
    keys += [bank_key(mesh, VIEWS[:3], pipeline=PIPELINE)]
    keys += [bank_key(mesh, VIEWS, pipeline=Pipeline(bank=replace(SETTINGS, sigma=1.5)))]
    keys.append(bank_key(mesh, VIEWS, pipeline=PIPELINE, renderer="torch"))
    monkeypatch.setattr(cache, "code_digest", lambda *_: "another version")
    keys.append(bank_key(mesh, VIEWS, pipeline=PIPELINE))
    assert len(set(keys)) == 10


def textured(*, uv: float = 0.0, shade: int = 0, side: int = 4) -> trimesh.Trimesh:
    """A box with a texture of 16 pixels, whose coordinates no half-precision number holds."""
    mesh = trimesh.creation.box()
    pixels = np.arange(48, dtype=np.uint8).reshape(side, 16 // side, 3) + np.uint8(shade)
    places = np.random.default_rng(0).random((len(mesh.vertices), 2)) + uv
    mesh.visual = trimesh.visual.TextureVisuals(uv=places, image=Image.fromarray(pixels))
    return mesh


def test_key_depends_on_colours() -> None:
    painted = trimesh.creation.box()
    painted.visual.vertex_colors[0] = (9, 8, 7, 255)
    meshes = [trimesh.creation.box(), painted]
    meshes += [textured(), textured(uv=1e-4), textured(shade=1), textured(side=8), textured(side=2)]
    assert len({bank_key(mesh, VIEWS, pipeline=PIPELINE) for mesh in meshes}) == len(meshes)


def test_the_cached_bank_of_a_mesh_shows_that_mesh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Found again with its own up axis and its own texture, to the last digit of its coordinates."""
    standing = trimesh.creation.box()
    standing.metadata["up"] = "y"
    meshes = [trimesh.creation.box(), standing, textured(uv=100.0), textured(uv=100.0, shade=1)]
    options = {"folder": tmp_path, "progress": False}
    for mesh in meshes:
        cached_bank(mesh, VIEWS, pipeline=PIPELINE, **options)
    monkeypatch.setattr(ViewBank, "build", None)  # would fail
    for mesh in meshes:
        found, given = cached_bank(mesh, VIEWS, pipeline=PIPELINE, **options).mesh, as_mesh(mesh)
        assert found.metadata["up"] == given.metadata["up"]
        assert ("colours" in found.metadata) == ("colours" in given.metadata)
        if "colours" in given.metadata:
            mine, theirs = found.metadata["colours"], given.metadata["colours"]
            np.testing.assert_array_equal(mine.uv, theirs.uv)
            np.testing.assert_array_equal(mine.textures[0], theirs.textures[0])


def test_a_renderer_of_ones_own_neither_fills_the_cache_nor_takes_from_it(tmp_path: Path) -> None:
    class Half:
        name = "embree"

        def __init__(self) -> None:
            self.inner = make_renderer(trimesh.creation.box())

        def render(self, *arguments: object, **options: object) -> torch.Tensor:
            depth = self.inner.render(*arguments, **options)
            depth[..., depth.shape[-1] // 2 :] = 0.0
            return depth

    own = build(tmp_path, renderer=Half())
    assert list_cache(tmp_path) == []
    whole = build(tmp_path)
    again = build(tmp_path, renderer=Half())
    assert torch.equal(again.silhouettes, own.silhouettes)
    assert int(whole.silhouettes.sum()) > 1.5 * int(own.silhouettes.sum())


def test_damaged_and_mislabelled_files_are_built_again(tmp_path: Path) -> None:
    bank = build(tmp_path)
    (path,) = (tmp_path / "banks").iterdir()
    whole = path.stat().st_size
    for damaged in (path.read_bytes()[:-10], b""):
        path.write_bytes(damaged)
        assert torch.equal(build(tmp_path).descriptors, bank.descriptors)
        assert path.stat().st_size == whole
    ViewBank.build(trimesh.creation.box((9, 1, 1)), VIEWS, settings=SETTINGS, progress=False).save(path)
    assert torch.equal(build(tmp_path).descriptors, bank.descriptors)


def test_least_recently_used_go_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for i, edge in enumerate((1.0, 2.0, 3.0)):
        build(tmp_path, edge)
        for file in list_cache(tmp_path):
            if file.used > time.time() - 50:  # the new one
                os.utime(file.path, (1000.0 + i, 1000.0 + i))
    first, second, third = sorted(list_cache(tmp_path), key=lambda file: file.used)
    build(tmp_path, 1.0)  # used again: now the youngest
    assert list_cache(tmp_path)[0].path == first.path
    assert trim_cache(tmp_path, limit=2 * first.size + 100) == 1
    assert {file.path for file in list_cache(tmp_path)} == {first.path, third.path}
    monkeypatch.setenv("CURVIREG_CACHE_LIMIT", "10")  # less than one bank: the newest stays all the same
    build(tmp_path, 5.0)
    assert len(list_cache(tmp_path)) == 1
    assert second.path not in {file.path for file in list_cache(tmp_path)}


def test_list_and_clear(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path / "cache"))
    assert cache_folder() == tmp_path / "cache"
    assert (list_cache(), clear_cache(), trim_cache()) == ([], 0, 0)  # not even a folder
    cached_bank(trimesh.creation.box(), VIEWS, pipeline=PIPELINE, progress=False)
    (file,) = list_cache()
    left = file.path.with_name(f"{file.path.name}.{uuid.uuid4().hex[:8]}.tmp")
    left.write_bytes(file.path.read_bytes()[:9000])  # of a killed process
    assert list_cache() == [file]
    assert file.size == file.path.stat().st_size > 1000
    trim_cache()
    assert left.exists()  # it may belong to a builder at work
    os.utime(left, (1000.0, 1000.0))
    trim_cache()
    assert not left.exists()
    left.touch()
    assert clear_cache() == 1
    assert [p.name for p in cache_folder().rglob("*")] == ["banks"]


def test_foreign_files_are_never_touched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    build(tmp_path)
    (bank,) = list_cache(tmp_path)
    other = bank.path.with_name(f"bank-{uuid.uuid4().hex}.safetensors")
    foreign = {
        tmp_path / "model.safetensors": safetensors.torch.save({"w": torch.zeros(9)}),
        tmp_path / "model.safetensors.1234.tmp": b"",
        tmp_path / bank.path.name: bank.path.read_bytes(),  # ours by name and content, but not in our folder
        bank.path.with_name("my bank.safetensors"): bank.path.read_bytes(),  # not by name
        bank.path.with_name(f"{bank.path.name}.orig"): bank.path.read_bytes(),
        other: safetensors.torch.save({"w": torch.zeros(9)}, {"format": "pt"}),  # not by content
        bank.path.with_name(f"{other.name}.{uuid.uuid4().hex[:8]}.tmp"): b"{" * 100,
        bank.path.with_name("notes.txt"): b"notes",
    }
    for path, content in foreign.items():
        path.write_bytes(content)
        os.utime(path, (1000.0, 1000.0))
    assert [file.path for file in list_cache(tmp_path)] == [bank.path]
    assert trim_cache(tmp_path, limit=0) == 1
    monkeypatch.setenv("CURVIREG_CACHE_LIMIT", "0")
    build(tmp_path, 2.0)
    assert clear_cache(tmp_path) == 1
    bank.path.write_bytes(foreign[other])  # in the bank's own place
    with pytest.warns(UserWarning, match=r"not a view bank, so it stays"):
        build(tmp_path)
    assert bank.path.read_bytes() == foreign[other]
    for path, content in foreign.items():
        assert path.read_bytes() == content
    bank.path.unlink()
    assert {path for path in tmp_path.rglob("*") if path.is_file()} == set(foreign)


def test_unwritable_cache_is_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("a file where the folder should be")
    with pytest.warns(UserWarning, match=r"file/banks/bank-.*cannot be written \(.*by CURVIREG_CACHE=FOLDER"):
        assert len(build(tmp_path / "file")) == len(VIEWS)
    assert (list_cache(tmp_path / "file"), clear_cache(tmp_path / "file")) == ([], 0)

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", "it")

    for name in ("listdir", "utime"):
        monkeypatch.setattr(os, name, refuse)
    build(tmp_path / "new")
    build(tmp_path / "new")
    assert list_cache(tmp_path / "new") == []


def test_a_cache_whose_files_may_not_be_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path, missing_ok: bool = False) -> None:
        if path.suffix == ".safetensors":
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        real(path, missing_ok=missing_ok)

    real = Path.unlink
    build(tmp_path)
    monkeypatch.setattr(Path, "unlink", refuse)
    monkeypatch.setenv("CURVIREG_CACHE_LIMIT", "10")
    with pytest.warns(UserWarning, match=r"exceeds its limit: .*bank-.* cannot be removed \(Permission denied"):
        assert len(build(tmp_path, 2.0)) == len(VIEWS)


def test_users_without_a_home(monkeypatch: pytest.MonkeyPatch) -> None:
    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    for name in ("CURVIREG_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", homeless)
    assert cache_folder() == Path(tempfile.gettempdir()) / "curvireg_torch"


def _builder(folder: str, edges: tuple[float, ...]) -> float:
    torch.set_num_threads(1)
    return sum(float(build(Path(folder), edge).descriptors.sum()) for edge in edges)


# Forked processes: spawned ones would import everything again, some seconds each.
forking = pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")


@forking
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")  # Python 3.12 warns of fork beside threads
def test_concurrent_builders(tmp_path: Path) -> None:
    edges = (1.0, 2.0, 3.0)
    with multiprocessing.get_context("fork").Pool(2) as pool:
        sums = pool.starmap(_builder, [(str(tmp_path), edges)] * 4, chunksize=1)
    assert max(sums) - min(sums) < 1e-3 * sums[0]
    assert len(list((tmp_path / "banks").iterdir())) == len(edges)  # nothing half-written is left
    for file in list_cache(tmp_path):
        assert len(ViewBank.load(file.path)) == len(VIEWS)


def _die_while_saving(folder: str) -> None:
    torch.set_num_threads(1)

    def die(file: int) -> None:
        os.truncate(file, os.stat(file).st_size // 2)
        os._exit(9)

    os.fsync = die  # type: ignore[assignment]
    build(Path(folder))


@forking
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_killed_builder_leaves_no_bank(tmp_path: Path) -> None:
    process = multiprocessing.get_context("fork").Process(target=_die_while_saving, args=(str(tmp_path),))
    process.start()
    process.join(60)
    assert process.exitcode == 9
    assert [path.suffix for path in (tmp_path / "banks").iterdir()] == [".tmp"]
    assert list_cache(tmp_path) == []
    assert len(build(tmp_path)) == len(VIEWS)
    assert len(list_cache(tmp_path)) == 1


def test_key_depends_on_each_texture() -> None:
    """Two meshes that differ in one px of one of two textures have two keys."""
    mesh, other = trimesh.creation.box(), trimesh.creation.box()
    for one, level in ((mesh, 10), (other, 11)):
        textures = np.full((4, 4, 3), 200, np.uint8), np.full((4, 4, 3), 10, np.uint8)
        textures[1][3, 3, 2] = level
        F = len(one.faces)
        corners, uv = np.full((F, 3, 3), 255, np.uint8), np.zeros((F, 3, 2), np.float32)
        one.metadata["colours"] = SurfaceColours(corners, uv, (np.arange(F) % 2).astype(np.int32), textures)
    assert bank_key(mesh, VIEWS, pipeline=PIPELINE) != bank_key(other, VIEWS, pipeline=PIPELINE)
    assert bank_key(mesh, VIEWS, pipeline=PIPELINE) == bank_key(mesh.copy(), VIEWS, pipeline=PIPELINE)

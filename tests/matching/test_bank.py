import os
import stat
from dataclasses import replace
from types import SimpleNamespace

import fast_simplification
import numpy as np
import pytest
import scipy.spatial
import torch
import trimesh
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from curvireg_torch.errors import BankError, MissingFileError
from curvireg_torch.geometry import sample_views
from curvireg_torch.matching import ViewBank, ViewMatcher
from curvireg_torch.matching import bank as bank_module
from curvireg_torch.matching.describe import view_mesh
from curvireg_torch.mesh import MeshWarning, mesh_symmetries, reflections, symmetry
from curvireg_torch.mesh.mesh import extreme_points
from curvireg_torch.mesh.reflections import is_its_own_mirror_image
from curvireg_torch.mesh.round_axis import round_axis
from curvireg_torch.pipeline import PRESETS, Pipeline, ViewPolicy
from curvireg_torch.registration import Registrar
from curvireg_torch.terms import Correlation
from curvireg_torch.utils.files import tensor_checksum
from tests._support import learned_registrar, refused, scene, seeded

TWO = sample_views(azimuth_step=180, elevations=[0])
UPRIGHT = ViewPolicy(pose="upright", azimuth_step=120.0, elevations=(10.0,))


def build(mesh, views=None, **options):
    return ViewBank.build(mesh, views, progress=False, image_size=64, **options)


@pytest.fixture
def saved(small_bank, tmp_path):
    small_bank.save(tmp_path / "bank.safetensors")
    return tmp_path / "bank.safetensors"


def rewrite(path, tensors, **metadata):
    with safe_open(path, framework="pt") as file:
        original = file.metadata()
    save_file(tensors, path, {**original, **metadata})


def change(path, name, by):
    """Change a tensor of a bank, and its checksum."""
    tensors = load_file(path)
    tensors[name] = by(tensors[name]).contiguous()
    rewrite(path, tensors, checksum=tensor_checksum(tensors))


def assert_same(a, b, *, atol=0.0):
    torch.testing.assert_close(a.descriptors, b.descriptors, rtol=0, atol=atol)
    for name in ("points_at", "silhouettes_at"):
        assert torch.equal(getattr(a, name)(slice(None)), getattr(b, name)(slice(None)))
    assert torch.equal(a.boxes, b.boxes)
    assert torch.equal(a.rotations, b.rotations)
    assert a.settings == b.settings


def test_build_computes_in_full_precision_under_autocast(truck):
    with torch.autocast("cpu", dtype=torch.bfloat16):
        bank = build(truck, TWO)
    assert_same(bank, build(truck, TWO))


def test_build_does_not_depend_on_chunks_and_threads(small_bank, truck, monkeypatch, threads):
    monkeypatch.setattr(bank_module, "TURNS", 5)
    monkeypatch.setattr(bank_module, "PIXELS_AT_A_TIME", 1)
    threads(3)
    other = build(truck, small_bank.views)
    assert torch.get_num_threads() == 3
    assert_same(other, small_bank, atol=1e-5)
    assert torch.equal(
        other.points_at(torch.tensor([3, 0])), small_bank.points_at(slice(None))[[3, 0]]
    )


def test_a_bank_with_views_of_a_sheet_from_its_edge_is_read_again(tmp_path):
    corners = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]
    sheet = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]])
    bank = build(sheet, sample_views(azimuth_step=180, elevations=[0, 30]))
    assert (bank.boxes[:, 1] == bank.boxes[:, 3]).tolist() == [True, True, False, False]
    bank.save(tmp_path / "sheet.safetensors")
    assert_same(ViewBank.load(tmp_path / "sheet.safetensors"), bank, atol=1e-3)


def test_check_compatible_refuses_another_view_policy(truck):
    upright = build(truck, pipeline=Pipeline(views=UPRIGHT))
    for change, message in (
        ({"pose": "any"}, "pose upright, expected any"),
        ({"azimuth_step": 60.0}, r"azimuth_step 120\.0, expected 60\.0"),
        ({"distance": 6.0}, r"distance 5\.0, expected 6\.0"),
    ):
        other = replace(upright.pipeline, views=replace(UPRIGHT, **change))
        for constructor in (ViewMatcher, Registrar):
            with refused(message, BankError):
                constructor(upright, pipeline=other)


def test_a_file_keeps_the_views_and_what_is_known_of_the_mesh(small_bank, tmp_path):
    known = {"unit": "in", "up": "-y", "file_name": "truck.ply"}
    known["warnings"] = (MeshWarning("stray", "far away"),)
    mesh = replace(small_bank.mesh, **known)
    path = tmp_path / "new" / "bank.safetensors"
    ViewBank(mesh, small_bank.views, small_bank.pipeline, small_bank.tensors).save(path)
    bank = ViewBank.load(path)
    assert_same(bank, small_bank, atol=5e-4)
    assert {name: getattr(bank.mesh, name) for name in known} == known
    slow = {"extreme_points", "mesh_symmetries", "is_its_own_mirror_image", "round_axis"}
    assert slow <= set(bank.mesh.measures)
    for part in ("vertices", "faces"):
        np.testing.assert_array_equal(getattr(bank.mesh, part), getattr(mesh, part))
    assert [file.name for file in path.parent.iterdir()] == [path.name]
    if os.name == "posix":
        mask = os.umask(0)
        os.umask(mask)
        assert stat.S_IMODE(path.stat().st_mode) == 0o666 & ~mask


def test_load_refuses_changed_bits_and_truncated_and_missing_files(saved):
    content = bytearray(saved.read_bytes())
    for position in torch.linspace(len(content) // 3, len(content) - 1, 12).long().tolist():
        content[position] ^= 1
        saved.write_bytes(content)
        with refused("checksum", BankError):
            ViewBank.load(saved)
        content[position] ^= 1
    saved.write_bytes(saved.read_bytes()[:-100])
    with refused("truncated", BankError):
        ViewBank.load(saved)
    with refused("no such bank", MissingFileError):
        ViewBank.load(saved.with_name("none"))


@pytest.mark.parametrize("device", ["foo", "cuda:99", torch.float16])
def test_banks_refuse_what_is_no_device_of_this_machine(small_bank, saved, device):
    message = f"device: torch cannot use '{device}' on this machine"
    with refused(message):
        small_bank.to(device)
    with refused(message):
        ViewBank.load(saved, device=device)
    with refused(message):
        ViewBank.build(small_bank.mesh, device=device)


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        ({"format": "x"}, "not a view bank"),
        ({"version": "0"}, "bank format 0"),
        ({"pipeline": '{"bank": {"image_size": 64, "colour": 1}}'}, "incomplete"),
        ({"pipeline": Pipeline().to_json()}, "points: not of the shape"),
        ({"pipeline": "[" * 100_000}, "incomplete"),
        ({"warnings": "[" * 100_000}, "incomplete"),
        ({"warnings": "[1]"}, "incomplete"),
        ({"up": "q"}, "up: expected one of"),
        ({"up": ""}, "up: expected one of"),
        ({"unit": "q"}, "unit: expected one of"),
    ],
)
def test_load_refuses_other_metadata(saved, metadata, message):
    rewrite(saved, load_file(saved), **metadata)
    with refused(message, BankError):
        ViewBank.load(saved)


def with_nan(x):
    x[3, 1] = torch.nan
    return x


@pytest.mark.parametrize(
    ("name", "by", "message"),
    [
        ("descriptors", with_nan, "not finite"),
        ("descriptors", lambda x: 0 * x, "descriptors that are all zero"),
        ("boxes", lambda x: x[:, [2, 1, 0, 3]], "boxes of negative size"),
        ("boxes", lambda x: x[1:], "boxes: not of the shape"),
        ("points", lambda x: x[:, 1:], "points: not of the shape"),
        ("appearance", with_nan, "appearance: .* not finite"),
        ("mesh.faces", lambda x: x + 10**6, "mesh: faces name vertices that do not exist"),
        ("mesh.faces", lambda x: x.long(), "mesh: not a mesh"),
        ("mesh.faces", lambda x: x[:0], "mesh: not a mesh"),
        ("mesh.faces", lambda x: x.flatten(), "mesh: not a mesh"),
        ("mesh.faces", lambda x: x[:, :2], "mesh: not a mesh"),
        ("mesh.vertices", lambda x: 0 * x, "every face is degenerate"),
        ("mesh.vertices", lambda x: 0 * x + 1e200, "vertices farther than"),
        ("mesh.vertices", lambda x: 1e-9 * x, "units across"),
        ("mesh.vertices", with_nan, "NaN or infinite vertices"),
        ("mesh.vertices", lambda x: x.flatten(), r"mesh\.vertices: expected shape"),
        ("points", lambda x: x.float(), "expected uint8"),
        ("silhouettes", lambda x: x.bool(), "expected uint8"),
        ("extreme_points", with_nan, "extreme_points: expected finite"),
        ("extreme_points", lambda x: x[:0], "extreme_points: those of another mesh"),
        ("extreme_points", lambda x: 1.1 * x, "extreme_points: those of another mesh"),
        ("extreme_points", lambda x: 0.9 * x, "extreme_points: those of another mesh"),
        ("extreme_points", lambda x: x.float(), "extreme_points: expected float64"),
        ("extreme_points", lambda x: x[:, 1:], "extreme_points: expected shape"),
        ("mesh_symmetries", lambda x: 2 * x, "symmetries: expected"),
    ],
)
def test_load_refuses_contents_that_no_bank_has(saved, name, by, message):
    change(saved, name, by)
    with refused(message, BankError):
        ViewBank.load(saved)


@pytest.mark.parametrize("is_lopsided", [False, True])
def test_load_restores_whether_a_mesh_is_its_own_mirror_image(is_lopsided, tmp_path, monkeypatch):
    mesh = trimesh.creation.box((1.0, 2.0, 3.0))
    if is_lopsided:
        lump = trimesh.creation.box((0.5, 0.6, 0.7)).apply_translation((0.7, 0.6, 0.5))
        mesh = trimesh.util.concatenate([mesh, lump])
    build(mesh, TWO).save(path := tmp_path / "bank")
    monkeypatch.setattr(reflections, "cKDTree", None)  # would fail
    assert is_its_own_mirror_image(ViewBank.load(path).mesh) is not is_lopsided


@pytest.mark.parametrize("radii", [(1.0, 1.0), (1.0, 0.5), (1.0, 2.0)])
def test_load_restores_the_axis_of_a_round_mesh(radii, tmp_path, monkeypatch):
    cone = trimesh.creation.revolve([(0.0, 0.0), (radii[0], 0.0), (radii[1], 3.0), (0.0, 3.0)])
    bank = build(cone.apply_translation((4.0, 5.0, 6.0)), TWO)
    bank.save(path := tmp_path / "bank.safetensors")
    known = round_axis(bank.mesh)
    monkeypatch.setattr("curvireg_torch.mesh.round_axis.cKDTree", None)  # would fail
    loaded = round_axis(ViewBank.load(path).mesh)
    assert loaded.ends_are_alike is known.ends_are_alike is (radii[0] == radii[1])
    torch.testing.assert_close(loaded[:2], known[:2], rtol=0.0, atol=0.0)
    change(path, "round_axis", lambda x: x[:, :2])
    with refused("round_axis: expected shape", BankError):
        ViewBank.load(path)


def test_load_restores_what_is_slow_to_find_about_a_mesh(tmp_path, monkeypatch):
    bank = build(trimesh.creation.icosphere(5, radius=3.0), TWO)
    bank.save(path := tmp_path / "bank.safetensors")
    for module, name in (
        (scipy.spatial, "ConvexHull"),
        (fast_simplification, "simplify"),
        (symmetry, "_Surface"),
    ):
        monkeypatch.setattr(module, name, None)  # would fail
    mesh = ViewBank.load(path).mesh
    for of in (extreme_points, mesh_symmetries):
        of(mesh).zero_()  # a copy
    for of in (extreme_points, mesh_symmetries):
        assert torch.equal(of(mesh), of(bank.mesh))
    for part in ("vertices", "faces"):
        np.testing.assert_array_equal(
            getattr(view_mesh(mesh), part), getattr(view_mesh(bank.mesh), part)
        )
    other = replace(mesh, surface=bank.mesh.surface)  # which has no measures yet
    for function in (extreme_points, mesh_symmetries, view_mesh):
        with pytest.raises(TypeError):
            function(other)
    change(path, "view_mesh.faces", lambda x: x + 10**6)
    with refused("view_mesh: faces name vertices", BankError):
        ViewBank.load(path)


def test_float16_storage_changes_no_ranking(small_bank, saved):
    # Queries differ from views as photographs do: noise of half the descriptors' length.
    noise = torch.rand(200, small_bank.descriptors.shape[1], generator=seeded(0))
    noise *= 0.5 * small_bank.descriptors.norm(dim=1).mean() / noise.norm(dim=1, keepdim=True)
    queries = small_bank.descriptors[torch.arange(200) % len(small_bank)] + noise
    query = SimpleNamespace(descriptors=queries[:, None])
    exact, stored = (
        Correlation().build(bank)(query) for bank in (small_bank, ViewBank.load(saved))
    )
    assert (exact - stored).abs().max() < 1e-4
    assert torch.equal(exact.argmax(dim=1), stored.argmax(dim=1))


def test_features_of_another_network_are_a_bank_error(saved):
    registrar = learned_registrar()
    registrar.bank.save(saved)
    change(saved, "appearance", lambda x: x[:, :-1])
    image, box, _ = scene(0)
    (result,) = Registrar(ViewBank.load(saved))([image], box[None])
    assert isinstance(result.error, BankError)
    assert "appearance of" in str(result.error)


@pytest.fixture(scope="module")
def packed(truck):
    """A bank of which some views stand for the others."""
    pipeline = Pipeline(views=UPRIGHT).with_term("appearance", exhaustive_limit=0, min_angle=50.0)
    return build(truck, pipeline=pipeline)


def test_a_bank_stores_the_views_that_stand_for_the_others(packed, tmp_path, monkeypatch):
    packed.save(path := tmp_path / "bank.safetensors")
    monkeypatch.setattr(bank_module, "packing_of_views", None)  # would fail
    stored = ViewBank.load(path).packing(50.0)
    for part, expected in zip(stored, packed.packing(50.0), strict=True):
        assert torch.equal(part, expected)
    with pytest.raises(TypeError):
        ViewBank.load(path).packing(40.0)


@pytest.mark.parametrize(
    ("name", "by"),
    [
        ("representatives", lambda x: x + 1000),
        ("representatives", lambda x: x[:, None]),
        ("cells", lambda x: -1 - x),
        ("cells", lambda x: x.int()),
        ("cells", lambda x: x[1:]),
    ],
)
def test_load_refuses_a_packing_of_other_views(packed, tmp_path, name, by):
    packed.save(path := tmp_path / "bank.safetensors")
    change(path, f"packing.{name}", by)
    with refused("packing: not of the bank's views", BankError):
        ViewBank.load(path)


@pytest.mark.parametrize("camera", ["orthographic", "perspective"])
def test_the_covariance_counts_a_picture_of_an_orthographic_camera_once(truck, camera):
    """Its views at several distances are the same picture, which are no more data."""
    banks = []
    for distances in ([3.0, 5.0, 9.0], [3.0]):
        views = sample_views(azimuth_step=40.0, elevations=[0.0, 40.0], distances=distances)
        banks.append(build(truck, views, camera=camera, pipeline=PRESETS["classical"]))
    query = torch.rand(3, banks[0].descriptors.shape[1], generator=seeded(0))
    for name in ("precision", "whitening"):
        found = [getattr(bank, name)(query) for bank in banks]
        agrees = torch.allclose(*found, rtol=1e-3, atol=1e-3)
        assert agrees == (camera == "orthographic"), name
    means = [bank.precision.mean for bank in banks]
    assert torch.allclose(*means, atol=1e-5) == (camera == "orthographic")

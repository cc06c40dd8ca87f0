"""``cr.register``: one photograph in one line, and what its result can do."""

import json
from dataclasses import replace
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

import curvireg_torch as cr
from curvireg_torch.cli import main
from curvireg_torch.data import Photo
from curvireg_torch.jobs import photograph
from curvireg_torch.jobs.entry import Entry, prepare
from curvireg_torch.jobs.outputs import MARKER
from tests._support import degrees_off, found_in, learned_registrar, refused, scene, two_trucks
from tests._support.exif import exif, with_exif
from tests._support.lists import CAMERA, box_of, write_files
from tests._support.results import registration

BOX = [*map(float, box_of(0))]
FOUR = [*map(float, CAMERA)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_files(tmp_path_factory.mktemp("one"))


@pytest.fixture(scope="module")
def result(folder):
    photo = folder / "photos" / "0.png"
    return cr.register(str(photo), str(folder / "learned.safetensors"), box=BOX, camera=FOUR)


def test_register_equals_the_command_to_the_last_digit_and_saves_its_files(
    folder, result, tmp_path
):
    files = [str(folder / "photos" / "0.png"), str(folder / "learned.safetensors")]
    words = ["--box", *box_of(0), "--camera", *CAMERA, "--out", str(tmp_path), "--quiet"]
    assert main(["register", *files, *words]) == 0
    document = json.loads((tmp_path / "result.json").read_text())
    for name in ("rotation", "translation", "quaternion", "T_cam_from_model"):
        assert getattr(result, name).tolist() == document[name]
    assert result.confidence == document["confidence"]
    assert cr.camera_matrix(*map(float, CAMERA)).dtype == torch.float64
    result.save(tmp_path / "out")
    files = {path.name for path in (tmp_path / "out").iterdir()} - {MARKER}
    of_command = {path.name for path in tmp_path.iterdir()} - {"out", MARKER}
    assert files == of_command == {"result.json", "overlay.png", "pose.glb"}
    saved = json.loads((tmp_path / "out" / "result.json").read_text())
    assert saved["rotation"] == document["rotation"]


@pytest.mark.slow
def test_register_takes_pictures_of_other_kinds(folder, result):
    registrar = learned_registrar()
    four = np.array(FOUR)
    with Image.open(folder / "photos" / "0.png") as picture:
        pixels = np.array(picture.convert("RGB"))
        for image, camera in (
            (picture, cr.camera_matrix(*four)),
            (pixels, four),
            (torch.from_numpy(pixels).permute(2, 0, 1), torch.from_numpy(four)),
        ):
            same = cr.register(image, registrar, box=BOX, camera=camera)
            assert same.rotation.equal(result.rotation)


@pytest.mark.slow
def test_register_detects_the_object_without_a_box(folder):
    found = cr.register(folder / "photos" / "0.png", learned_registrar(), camera=FOUR)
    assert degrees_off(found, scene(0)[2]) < 5
    assert (found.box - torch.tensor(BOX)).abs().max() < 12


def test_register_takes_the_camera_from_exif(folder, monkeypatch):
    photo = folder / "exif.png"
    cv2.imwrite(str(photo), cv2.imread(str(folder / "photos" / "0.png")))
    with_exif(photo, exif(1, 38))
    register = Mock()
    monkeypatch.setattr(photograph, "register_entry", register)
    cr.register(photo, learned_registrar(), box=BOX, camera="exif")
    assert register.call_args.args[1].camera.source == "exif"


def test_a_box_that_was_replaced_is_that_of_the_result(folder, monkeypatch):
    fits = torch.tensor([1.0, 2.0, 30.0, 40.0]).double()
    answer = replace(registration(), corrected_box=fits)
    monkeypatch.setattr(cr.Registrar, "register_prepared", lambda *_, **__: [answer])
    found = cr.register(folder / "photos" / "0.png", learned_registrar(), box=BOX)
    assert found.box.equal(fits)


def test_result_is_shown_in_ten_lines_and_in_notebooks(result):
    lines = repr(result).splitlines()
    assert len(lines) <= 10
    assert lines[0].startswith("Registration: reliable, confidence ")
    assert len(repr(result)) < 800
    shown = result._repr_html_()
    assert shown.startswith('<img alt="contours on the photograph" src="data:image/jpeg;base64,')
    assert "confidence" in shown
    drawn = np.asarray(result.plot().axes[0].images[0].get_array())
    np.testing.assert_array_equal(drawn, result.overlay())
    w, x, y, z = result.quaternion.tolist()
    np.testing.assert_allclose(
        Rotation.from_quat([x, y, z, w]).as_matrix(), result.rotation.numpy(), atol=1e-9
    )
    assert result.T_cam_from_model[:3, 3].equal(result.translation)


@pytest.mark.parametrize("given", [{"unit": "mm"}, {"up": "y"}])
def test_a_bank_and_a_registrar_have_the_unit_and_the_axis_of_their_mesh(folder, given):
    photo = folder / "photos" / "0.png"
    with refused(r"learned\.safetensors: built with", cr.errors.BankError):
        cr.register(photo, folder / "learned.safetensors", **given)
    with refused("unit, up: of a mesh file"):
        cr.register(photo, learned_registrar(), **given)
    with refused("pipeline: a Registrar has its own"):
        cr.register(photo, learned_registrar(), pipeline=cr.Pipeline())


@pytest.mark.slow
def test_every_copy_is_drawn_and_saved(tmp_path, monkeypatch):
    image, boxes = two_trucks()
    registrar = learned_registrar()
    found = found_in(registrar, image, boxes)
    monkeypatch.setattr(photograph, "detect_prepared", lambda *_, **__: [found])
    entry = Entry(name="two.png", photo=tmp_path / "two.png", meshes=(), instances=2)
    picture = Photo((255 * image).round().byte())
    result = photograph.register_entry(entry, prepare(entry, picture), registrar)
    assert [copy.detection.box.tolist() for copy in result.copies] == [boxes[1].tolist()]
    instances = result.document["detection"]["instances"]
    assert [one["verdict"] for one in instances] == [one.verdict for one in found]
    assert [one["reliable"] for one in instances] == [one.reliable for one in found]
    result.save(tmp_path)
    W = image.shape[2]
    for drawn in (result.overlay(), cv2.imread(str(tmp_path / "overlay.png"))):
        scale = drawn.shape[1] / W
        outline = (drawn[: int(scale * image.shape[1])] == (0, 255, 80)).all(axis=2)
        outline |= (drawn[: len(outline)] == (80, 255, 0)).all(axis=2)  # OpenCV's order
        for box in boxes:
            x0, _, x1, _ = (scale * box).int().tolist()
            columns = np.nonzero(outline[:, x0:x1].any(axis=0))[0]
            assert np.ptp(columns) > 0.8 * (x1 - x0)

"""scripts/docs_pictures.py and what it draws: the poses of a registration, the cup, and the credited pictures."""

import re
import sys

import numpy as np
import pytest
import torch
from PIL import Image

import curvireg_torch as cr
from curvireg_torch.geometry import rotation_error
from curvireg_torch.pipeline import PRESETS
from curvireg_torch.registration.poses import lift_to_poses
from curvireg_torch.synthetic import example_mesh, random_pose, synthesize_photograph
from scripts import docs_pictures
from scripts._cup import INSIDE, OUTSIDE, cup
from scripts._poses import recorded

from .._support.pages import DOCS, PAGES

IMAGES = DOCS / "images"
K = cr.camera_matrix(420.0, 420.0, 119.5, 89.5, dtype=torch.float64)


@pytest.fixture(scope="module")
def registration():
    """A registered photograph: registrar, record, result, box, true pose."""
    mesh, generator = example_mesh(), torch.Generator().manual_seed(4)
    truth = random_pose(mesh, K, (180, 240), generator, elevations=(20.0, 30.0))
    photograph, box = synthesize_photograph(mesh, truth, K, (180, 240), generator)
    pipeline = PRESETS["classical"].with_pose_prior("upright")
    views = cr.sample_views(azimuth_step=15, elevations=[10, 25, 40])
    bank = cr.ViewBank.build(mesh, views, settings=pipeline.bank, progress=False)
    registrar = cr.Registrar(bank, pipeline=pipeline)
    with recorded() as record:
        result = registrar([photograph], box[None], K)[0]
    return registrar, record, result, box, truth


def test_path_leads_from_the_best_view_to_the_result(registration):
    registrar, record, result, box, truth = registration
    path = record.path(registrar, result, box)
    stages = [stage for stage, _ in path]
    assert stages == sorted(stages, key=["view", "search", "contours"].index)
    assert set(stages) == {"view", "search", "contours"}
    view = record.searches[0][0]
    starts = lift_to_poses(registrar.describers, view, box[None].double(), K[None]).T
    mine = view.view.tolist().index(result.hypotheses[0].view)
    assert torch.equal(path[0][1], starts[mine])
    assert torch.equal(path[-1][1], result.projection[0])
    poses = torch.stack([T for _, T in path])
    fine = record.fits[-1]  # the last part of the fit, at full size, ends with the result
    mine = (fine[-1] == poses[-1]).flatten(1).all(dim=1).nonzero()[0, 0]
    last = list(dict.fromkeys(tuple(T[mine].flatten().tolist()) for T in fine[1:]))
    assert len(last) >= 3
    assert [tuple(T.flatten().tolist()) for T in poses[-len(last) :]] == last
    steps = rotation_error(poses[1:, :3, :3], poses[:-1, :3, :3])
    assert float(steps.max()) < 25.0
    assert not any(torch.equal(a, b) for a, b in zip(poses[1:], poses[:-1], strict=True))
    errors = rotation_error(poses[:, :3, :3], truth[:3, :3])
    assert float(errors[-1]) < 1.0 < float(errors[0])


def test_recording_changes_neither_result_nor_library(registration):
    registrar, record, result, box, truth = registration
    generator = torch.Generator().manual_seed(4)
    random_pose(example_mesh(), K, (180, 240), generator)
    photograph, _ = synthesize_photograph(example_mesh(), truth, K, (180, 240), generator)
    searches, fits = len(record.searches), len(record.fits)
    again = registrar([photograph], box[None], K)[0]
    assert torch.equal(again.rotation, result.rotation)
    assert (len(record.searches), len(record.fits)) == (searches, fits)


def test_cup_has_its_handle_in_front():
    mesh = cup()
    body, handle = mesh.split(only_watertight=False)
    assert body.is_watertight
    assert len(mesh.faces) == len(body.faces) + len(handle.faces)
    assert body.bounds[1].tolist() == pytest.approx([OUTSIDE[-1][0], OUTSIDE[-1][0], OUTSIDE[-1][1]], abs=0.1)
    assert handle.bounds[0, 1] < body.bounds[0, 1] - 15.0
    assert handle.bounds[:, 0] == pytest.approx([-6.0, 6.0], abs=0.2)
    heights = np.array([z for _, z in OUTSIDE])
    wall = np.interp(handle.vertices[:, 2], heights, [r for r, _ in OUTSIDE])
    bore = np.interp(handle.vertices[:, 2], [z for _, z in INSIDE][-2::-1], [r for r, _ in INSIDE][-2::-1])
    inside = np.hypot(*handle.vertices[:, :2].T)
    assert (inside < wall).any(), "its ends are in the wall"
    assert (inside > bore).all(), "and do not reach into the cup"


def test_drawn_window_shows_the_pose_where_the_photograph_does(registration):
    registrar, _, _, box, truth = registration
    window = (30, 20, 230, 170)
    picture = docs_pictures.drawn(registrar.describers[0].renderer, (truth, K), torch.zeros(3, 180, 240), window)
    assert picture.shape == (150, 200, 3)
    rows, columns = np.nonzero(picture[..., 1] > 200)
    expected = box.numpy() - np.array([30, 20, 30, 20])
    assert [columns.min(), rows.min(), columns.max(), rows.max()] == pytest.approx(expected, abs=2.5)


def test_pictures_of_real_photographs_need_their_folder(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["docs_pictures.py", "buddha"])
    with pytest.raises(SystemExit):
        docs_pictures.main()
    assert "need --buddha DIR" in capsys.readouterr().err


@pytest.mark.parametrize(("name", "width", "bytes_"), [("buddha", 960, 150_000), ("closing-in", 960, 400_000)])
def test_pictures_of_the_front_page_are_small(name, width, bytes_):
    path = IMAGES / f"{name}.webp"
    with Image.open(path) as picture:
        assert picture.width <= width
    assert path.stat().st_size <= bytes_


def test_photographs_of_others_are_credited():
    text = (IMAGES / "SOURCES.txt").read_text("utf-8")
    credited = []
    for names, credit in re.findall(r"^(\S[^\n]*\.webp)\n((?:    .*\n)+)", text, flags=re.MULTILINE):
        licence = re.search(r"CC BY 4\.0|CC0", credit)[0]
        author = re.search(r"Gasparini|Michetti", credit)[0]
        credited += names.split(", ")
        for name in names.split(", "):
            assert (IMAGES / name).is_file()
            shown = [page.read_text("utf-8") for page in PAGES if f"images/{name})" in page.read_text("utf-8")]
            assert any(licence in page and author in page for page in shown), name
    assert sorted(credited) == ["buddha-all.webp", "buddha.webp", "closing-in.webp", "cup.webp", "known-pose.webp"]

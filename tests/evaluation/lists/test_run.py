"""The loop over a list: what a result depends on, and what it may say of a guessed camera."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from curvireg_torch import Registrar, ViewBank, sample_views
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.evaluation.lists import run
from curvireg_torch.evaluation.lists.listing import Entry, Listing
from curvireg_torch.io import read_photo
from curvireg_torch.pipeline import PRESETS
from curvireg_torch.registration import Registration
from curvireg_torch.synthetic import example_mesh
from tests._support.scenes import SIZE, scene, unrefined


@pytest.fixture(scope="module")
def registrar():
    """The example's mesh seen from eight sides, without a refinement."""
    views = sample_views(azimuth_step=45, elevations=[20])
    bank = ViewBank.build(example_mesh(), views, pipeline=PRESETS["classical"], image_size=64, progress=False)
    return Registrar(bank, pipeline=unrefined(bank))


@pytest.fixture
def entry(tmp_path):
    """A photograph with its box."""
    picture = (scene(0)[0].permute(1, 2, 0).numpy()[..., ::-1] * 255).round().astype(np.uint8)
    cv2.imwrite(str(tmp_path / "photo.png"), picture)
    (tmp_path / "mesh.ply").write_text("a mesh")
    return Entry((), "photo.png", tmp_path / "photo.png", (tmp_path / "mesh.ply",), box=tuple(scene(0)[1].tolist()))


def test_what_was_asked_otherwise_is_done_again(registrar, entry, tmp_path, monkeypatch):
    """Each part of a row's request counts; the same request is answered from the file."""
    K = (260.0, 260.0, 119.5, 89.5)
    looked_for = replace(entry, box=None, camera=K)
    rows = [
        entry,
        replace(entry, box=(1.0, 1.0, 100.0, 90.0)),
        replace(entry, camera=K),
        replace(entry, guess=50.0),
        looked_for,
        replace(looked_for, instances=2),
        replace(looked_for, distance=(1.0, 2.0)),
        replace(looked_for, distance=(1.0, 3.0)),
    ]
    asked = []

    def register_entry(one, photo, registrar, **_):
        asked.append(one)
        return registered(replace(one, box=entry.box, instances=1, distance=None), photo, registrar, bank_seconds=0.0)

    registered = run.register_entry
    monkeypatch.setattr(run, "register_entry", register_entry)
    for settings in ({"top": 1}, {"top": 2}):
        asked.clear()
        for _ in range(2):
            listing = Listing((), tuple(rows))
            run.register_list(listing, tmp_path / "out", lambda _: registrar, settings=settings, progress=False)
        assert asked == rows


@pytest.mark.parametrize(
    ("camera", "guess", "source"),
    [((260.0, 260.0, 119.5, 89.5), None, "given"), (None, 50.0, "fov"), (None, "exif", "exif"), (None, None, None)],
)
def test_a_guessed_camera_has_no_covariance(registrar, entry, monkeypatch, camera, guess, source):
    """Of a registration that has one, it is said for a camera that was given, and for no other."""

    def with_covariance(image, box, K):
        (result,) = registrar(image, box, K)
        assert isinstance(result, Registration)
        best, *rest = result.hypotheses
        best = replace(best, covariance=None if K is None else torch.eye(6, dtype=torch.float64))
        return [replace(result, confidence=1.0, hypotheses=(best, *rest))]

    class Sure:
        bank, pipeline = registrar.bank, registrar.pipeline
        __call__ = staticmethod(with_covariance)

    photo = read_photo(entry.photo)
    monkeypatch.setattr(type(photo), "guessed_camera_matrix", lambda _: run.camera_of_view(40.0, SIZE), raising=True)
    one = replace(entry, camera=camera, guess=guess)
    result, document = run.register_entry(one, photo, Sure(), bank_seconds=0.0)
    assert document["inputs"]["camera_source"] == source
    known = source == "given"
    assert document["covariance"] == (torch.eye(6).tolist() if known else None)
    assert (document["squared_radius"] is not None) == known
    assert (document["standard_deviations"] is not None) == known
    assert (result.translation is not None) == (source is not None)
    json.dumps(document, allow_nan=False)


def test_the_page_shows_reliable_answers_first_and_failures_last(registrar, entry, tmp_path, monkeypatch):
    """Among alike ones the more confident, and of equals the one that the list names first."""
    told = {"a": 0.3, "b": 0.95, "c": None, "d": 0.85, "e": 0.5, "f": 0.95}
    rows = [replace(entry, name=name) for name in told]

    def register_entry(one, photo, registrar, **_):
        if told[one.name] is None:
            raise InvalidInputError("dark")
        plain = replace(one, name="photo.png")
        result, document = registered(plain, photo, registrar, bank_seconds=0.0)
        return result, {**document, "confidence": told[one.name], "reliable": told[one.name] >= 0.8}

    shown = []
    registered = run.register_entry
    monkeypatch.setattr(run, "register_entry", register_entry)
    monkeypatch.setattr(run, "write_sheet", lambda _path, _title, some, **_: shown.extend(some))
    counts = run.register_list(
        Listing((), tuple(rows)), tmp_path / "out", lambda _: registrar, settings={}, progress=False
    )
    assert [one.name for one in shown] == ["b", "f", "d", "e", "a", "c"]
    assert [one.kind for one in shown] == ["reliable"] * 3 + ["doubtful"] * 2 + ["failed"]
    assert (counts.ok, counts.failed, counts.reliable) == (5, 1, 3)

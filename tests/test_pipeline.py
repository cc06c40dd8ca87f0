import json
from dataclasses import FrozenInstanceError, fields, replace

import numpy as np
import pytest
import torch
import trimesh

from curvireg_torch import Pipeline, Registrar, ViewBank
from curvireg_torch.errors import MissingFileError
from curvireg_torch.evidence import EvidenceWeights
from curvireg_torch.features import LearnedCurvilinearSaliency
from curvireg_torch.filters import MultiScaleFocusCurves
from curvireg_torch.geometry import paper_views, sample_views
from curvireg_torch.matching.describe import depth_filter
from curvireg_torch.pipeline import (
    DEFAULT,
    DEPTH_FIELDS,
    FIELDS,
    PRESETS,
    BankSettings,
    FitSettings,
    ViewPolicy,
    preset_named,
)
from curvireg_torch.terms import TERMS, Correlation, Repeatability
from curvireg_torch.utils import choices
from tests._support import refused


@pytest.mark.parametrize("name", [*FIELDS, *DEPTH_FIELDS])
def test_fields_return_vector_fields(name):
    x = torch.zeros(1, 3, 48, 48)
    x[..., 12:36, 8:40] = torch.linspace(0.2, 1, 32)
    field = (
        Pipeline(field=name).photograph_field()
        if name in FIELDS
        else depth_filter(BankSettings(depth_field=name))
    )
    out = field(x if getattr(field, "colour", False) else x[:, :1])
    assert out.shape == (1, 2, 48, 48)
    assert out.isfinite().all()


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_presets_register_and_survive_json(name):
    pipeline = PRESETS[name]
    assert Pipeline.from_json(pipeline.to_json()) == pipeline
    views = sample_views(azimuth_step=60, elevations=[20])
    bank = ViewBank.build(trimesh.creation.box((1, 2, 3)), views, pipeline=pipeline, progress=False)
    registrar = Registrar(bank, pipeline=replace(pipeline, search=False, contours=False))
    result = registrar([torch.rand(3, 80, 100)], torch.tensor([[20.0, 10, 80, 70]]))[0]
    assert result.rotation.isfinite().all()
    assert set(result.ranking.terms) == {term.name for term in pipeline.terms if term.weight}
    assert Registrar(bank).pipeline == pipeline.with_pose_prior("given")


def test_presets_have_the_stated_settings():
    assert preset_named(DEFAULT) == Pipeline()
    assert (list(PRESETS), choices.DEFAULT) == (list(choices.PRESET_NAMES), DEFAULT)
    with refused("'classical'"):
        preset_named("best")
    for name in ("classical", "paper"):  # nothing learned
        assert isinstance(PRESETS[name].photograph_field(), MultiScaleFocusCurves)
        assert {term.name for term in PRESETS[name].terms} >= {"hog", "repeatability"}
    assert isinstance(PRESETS["learned"].photograph_field(), LearnedCurvilinearSaliency)
    paper = PRESETS["paper"]
    assert (paper.bank.camera, paper.bank.formula) == ("orthographic", "paper")
    assert paper.views == ViewPolicy(pose="paper", frame="principal")
    assert paper.terms == (Correlation(whitening="paper"), Repeatability(mode="paper"))
    field = paper.photograph_field()
    assert (field.saliency_weight, field.mode) == (0.0, "reblur-saliency")
    assert [name for name, preset in PRESETS.items() if preset.search] == ["paper"]


OTHER = {"any": "paper", "own": "principal", "perspective": "orthographic", "CS": "HFN"}
OTHER |= {"geometric": "paper", "none": "bank", "monotone": "paper"}
OTHER |= {EvidenceWeights(): EvidenceWeights(details=2.0)}


def other(value):
    """Another value of a setting; the same one, of a digest."""
    if isinstance(value, int | float):
        return value + 1 if isinstance(value, int) else 0.9 * value
    return value[:1] if isinstance(value, tuple) else OTHER.get(value, value)


def varied(settings):
    """Changes of one setting each."""
    changes = ({f.name: other(getattr(settings, f.name))} for f in fields(settings))
    copies = [replace(settings, **change) for change in changes]
    return [one for one in copies if one != settings]


def test_json_contains_every_setting():
    base = Pipeline()
    settings = [{"field": "focus", "weights": ""}, {"weights": "0123"}, {"terms": base.terms[:2]}]
    settings += [{"box_jitter": 0.2}, {"box_is": "visible"}, {"hypotheses": 6}]
    settings += [{"search": True, "contours": False}, {"contours": False}]
    for part in ("views", "bank", "detection", "fit"):
        settings += [{part: one} for one in varied(getattr(base, part))]
    for place, term in enumerate(base.terms):
        others = base.terms[:place], base.terms[place + 1 :]
        settings += [{"terms": (*others[0], one, *others[1])} for one in varied(term)]
    changed = [replace(base, **setting) for setting in settings]
    texts = {pipeline.to_json() for pipeline in changed}
    assert len(texts) == len(changed)
    assert base.to_json() not in texts
    for pipeline in changed:
        assert Pipeline.from_json(pipeline.to_json()) == pipeline
    with pytest.raises(FrozenInstanceError):
        base.box_jitter = 0.0


def test_integers_of_numpy_become_those_of_json():
    bank = BankSettings(image_size=np.int64(64), bins=np.int32(9))
    fit = FitSettings(kept_starts=np.int64(4), close_rivals=np.int64(0))
    pipeline = Pipeline(bank=bank, fit=fit, hypotheses=np.int64(3))
    assert Pipeline.from_json(pipeline.to_json()) == pipeline
    with refused("image_size: expected an integer"):
        BankSettings(image_size=64.0)


WRONG = """\
{ => not JSON
{"version": 99} => version 3
{"field": "nope"} => field: expected one of 'learned'
{"colour": 1} => colour
{"views": {"theta_step": 0}} => theta_step
{"bank": {"image_size": 4}} => image_size
{"bank": {"block": 9}} => hog: expected 1 <= block
{"fit": {"screened_views": 0}} => fit: screened_views
{"fit": {"reliable": 2}} => fit: reliable
{"fit": {"wide_angles": [-1]}} => fit: wide_angles
{"fit": {"weights": {"detail": 1}}} => fit: weights: unknown key 'detail'
{"terms": {"hug": {}}} => term: expected one of 'hog'
{"box_jitter": 0.6} => box_jitter
{"box_is": "half"} => box_is: expected one of 'whole', 'visible'
{"terms": {"appearance": {}}} => each term once, and 'hog'
{"box_jitter": "0.1"} => box_jitter
{"hypotheses": 2.5} => hypotheses
{"hypotheses": null} => hypotheses
{"search": "yes"} => search
{"bank": {"image_size": [64]}} => image_size
{"terms": {"repeatability": {}}} => each term once, and 'hog'
{"terms": {"hog": {}, "appearance": {"weights": "0"}}} => expected weights 0"""


def test_read_completes_a_partial_file_with_defaults_and_names_the_file_and_the_mistake(tmp_path):
    path = tmp_path / "mine.json"
    fit = {"screened_views": 15, "weights": {"appearance": 5.0}}
    text = json.dumps({"box_jitter": 0.0, "terms": {"hog": {"weight": 2.0}}, "fit": fit})
    path.write_text("\ufeff" + text, encoding="utf-8")  # as editors of Windows write it
    settings = FitSettings(screened_views=15, weights=EvidenceWeights(appearance=5.0))
    terms = (Correlation(weight=2.0),)
    assert Pipeline.read(path) == Pipeline(box_jitter=0.0, terms=terms, fit=settings)
    with refused("no such pipeline", MissingFileError):
        Pipeline.read(tmp_path / "none.json")
    rows = [row.split(" => ") for row in WRONG.splitlines()]
    rows += [[f'{{"terms": {{"{name}": {{"weight": -1}}}}}}', f"{name}: weight"] for name in TERMS]
    for text, message in rows:
        path = tmp_path / "mine.json"
        path.write_text(text)
        with refused(message) as caught:
            Pipeline.read(path)
        assert "mine.json" in str(caught.value)


def test_photograph_field_refuses_other_weights():
    with refused("expected weights feed"):
        Pipeline(weights="feed").photograph_field()
    custom = Pipeline().with_field(torch.nn.Conv2d(1, 2, 3, padding=1))
    assert custom.field == "custom:Conv2d"
    assert custom.weights != Pipeline().with_field(torch.nn.Conv2d(1, 2, 3, padding=1)).weights
    with refused("passed by the caller"):
        custom.photograph_field()


def test_view_policy_sphere():
    assert len(ViewPolicy(directions=50, theta_step=90).sphere()) == 200
    upright = ViewPolicy(pose="upright", azimuth_step=90, elevations=(0.0,), distance=3.0).sphere()
    assert upright.distance.tolist() == [3.0] * 4
    with refused("passed by the caller"):
        ViewPolicy(pose="given").sphere()
    assert torch.equal(ViewPolicy(pose="paper").sphere().rotations, paper_views().rotations)
    with refused("frame"):
        ViewPolicy(frame="mine")

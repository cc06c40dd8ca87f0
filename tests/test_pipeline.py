"""The one value that decides a result."""

import json
from dataclasses import FrozenInstanceError, asdict, fields, replace

import pytest
import torch
import trimesh

from curvireg_torch import Pipeline, Registrar, ViewBank
from curvireg_torch.errors import InvalidInputError, MissingFileError
from curvireg_torch.filters import MultiScaleFocusCurves
from curvireg_torch.geometry import sample_views
from curvireg_torch.matching.fields import depth_filter
from curvireg_torch.models import LearnedCurvilinearSaliency
from curvireg_torch.pipeline import DEFAULT, FIELDS, PRESETS, preset_named
from curvireg_torch.settings import DEPTH_FIELDS, BankSettings, ViewPolicy
from curvireg_torch.terms import TERMS, BoxShape, Correlation, Repeatability, Term
from tests._support.scenes import unrefined


def test_the_default_pipeline_is_the_default_preset():
    assert preset_named(DEFAULT) == Pipeline()
    with pytest.raises(InvalidInputError, match="'classical'"):
        preset_named("best")


@pytest.mark.parametrize("name", sorted(FIELDS))
def test_every_field_keeps_the_contract(name):
    field = Pipeline(field=name).photograph_field()
    channels = 3 if getattr(field, "colour", False) else 1
    out = field(torch.rand(2, channels, 64, 64))
    assert out.shape == (2, 2, 64, 64)
    assert out.isfinite().all()


@pytest.mark.parametrize("name", sorted(DEPTH_FIELDS))
def test_every_depth_field_keeps_the_contract(name):
    depth = torch.zeros(1, 1, 48, 48)
    depth[..., 12:36, 8:40] = torch.linspace(2, 3, 32)
    assert depth_filter(BankSettings(image_size=48, depth_field=name))(depth).shape == (1, 2, 48, 48)


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_every_preset_registers_and_goes_through_json(name):
    pipeline = PRESETS[name]
    assert Pipeline.from_json(pipeline.to_json()) == pipeline
    views = sample_views(azimuth_step=60, elevations=[20])
    bank = ViewBank.build(trimesh.creation.box((1, 2, 3)), views, pipeline=pipeline, progress=False)
    registrar = Registrar(bank, pipeline=unrefined(bank))
    result = registrar([torch.rand(3, 80, 100)], torch.tensor([[20.0, 10, 80, 70]]))[0]
    assert result.rotation.isfinite().all()
    assert set(result.ranking.terms) == {term.name for term in pipeline.terms}
    assert (registrar.pipeline.search, registrar.pipeline.contours) == (False, False)
    assert Registrar(bank).pipeline == pipeline.with_pose_prior("given")


def test_classical_and_paper_learn_nothing():
    for name in ("classical", "paper"):
        assert isinstance(PRESETS[name].photograph_field(), MultiScaleFocusCurves)
        assert {term.name for term in PRESETS[name].terms} == {"hog", "repeatability", "box"}
    assert isinstance(PRESETS["learned"].photograph_field(), LearnedCurvilinearSaliency)


def test_paper_preset_has_the_papers_settings():
    paper = PRESETS["paper"]
    assert (paper.bank.camera, paper.bank.formula) == ("orthographic", "paper")
    assert paper.terms == (Correlation(whitening="bank"), Repeatability(mode="paper"), BoxShape(weight=0.0))


def other(value):
    if isinstance(value, bool):
        return not value
    return {"learned": "focus", "": "feedbeef"}.get(value, value) if isinstance(value, str) else value + 1


def test_a_description_says_all_that_decides():
    """Whatever is changed in a pipeline is seen in its JSON, and nothing can be changed in place."""
    base = Pipeline()
    changed = [
        replace(base, field="focus", weights=""),
        base.with_pose_prior("upright"),
        replace(base, terms=base.terms[:2]),
    ]
    changed += [replace(base, **{n: other(getattr(base, n))}) for n in ("hypotheses", "search", "contours")]
    changed += [replace(base, box_jitter=0.2), replace(base, weights="0123")]
    changed += [
        replace(base, views=replace(base.views, **{n: 7})) for n in ("directions", "theta_step", "azimuth_step")
    ]
    changed += [replace(base, bank=replace(base.bank, **{n: 40})) for n in ("image_size", "sigma", "margin", "bins")]
    for term in base.terms:
        for f in fields(term):
            value = {"none": "bank", "monotone": "paper", 1000: 7, 32: 7}.get(getattr(term, f.name), 0.3)
            if f.name != "weights":
                changed.append(base.with_term(term.name, **{f.name: value}))
    texts = {pipeline.to_json() for pipeline in changed}
    assert len(texts) == len(changed)
    assert base.to_json() not in texts
    for pipeline in changed:
        assert Pipeline.from_json(pipeline.to_json()) == pipeline
    with pytest.raises(FrozenInstanceError):
        base.box_jitter = 0.0  # type: ignore[misc]


def test_part_of_a_json_text_keeps_the_other_defaults(tmp_path):
    path = tmp_path / "own.json"
    path.write_text(json.dumps({"box_jitter": 0.0, "terms": {"hog": {"weight": 2.0}}}))
    assert Pipeline.read(path) == Pipeline(box_jitter=0.0, terms=(Correlation(weight=2.0),))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not JSON"),
        ("[1]", "JSON object"),
        ('{"version": 99}', "version 1"),
        ('{"field": "nope"}', "field: expected one of 'learned'"),
        ('{"colour": 1}', "colour"),
        ('{"views": {"pose": "sideways"}}', "pose"),
        ('{"views": 3}', "compare with"),
        ('{"bank": {"image_size": 4}}', "image_size"),
        ('{"bank": {"depth_field": "XX"}}', "depth_field"),
        ('{"bank": {"formula": "mine"}}', "formula"),
        ('{"terms": {"hug": {}}}', "term: expected one of 'hog'"),
        ('{"terms": {}}', "terms"),
        ('{"terms": {"hog": {"weight": -1}}}', "weight"),
        ('{"terms": {"box": {"sigma": 0}}}', "sigma"),
        ('{"box_jitter": 0.6}', "box_jitter"),
        ('{"hypotheses": 0}', "hypotheses"),
        ('{"terms": {"appearance": {}}}', "compare all views"),
        ('{"terms": {"hog": {}, "appearance": {"top": 0}}}', "top"),
        ('{"terms": {"hog": {}, "appearance": {"weights": "0"}}}', "made with weights 0"),
    ],
)
def test_what_is_wrong_with_a_pipeline_is_said_when_it_is_made(tmp_path, text, message):
    path = tmp_path / "own.json"
    path.write_text(text)
    with pytest.raises(InvalidInputError, match=message) as caught:
        Pipeline.read(path)
    assert "own.json" in str(caught.value)


def test_a_pipeline_that_is_not_there_is_named(tmp_path):
    with pytest.raises(MissingFileError, match="no such pipeline"):
        Pipeline.read(tmp_path / "none.json")


def test_weights_that_are_not_there_are_never_replaced_by_others():
    with pytest.raises(InvalidInputError, match="made with weights feed"):
        Pipeline(weights="feed").photograph_field()
    own = Pipeline().with_field(torch.nn.Conv2d(1, 2, 3, padding=1))
    assert own.field == "custom:Conv2d"
    assert own.weights != Pipeline().with_field(torch.nn.Conv2d(1, 2, 3, padding=1)).weights
    with pytest.raises(InvalidInputError, match="came with the call"):
        own.photograph_field()


def test_terms_are_frozen_plain_values():
    for name, make in TERMS.items():
        term = make()
        assert isinstance(term, Term)
        assert term.name == name
        json.dumps(asdict(term))


def test_views_of_a_policy():
    assert len(ViewPolicy(directions=50, theta_step=90).sphere()) == 200
    upright = ViewPolicy(pose="upright", azimuth_step=90, elevations=(0.0,), distance=3.0).sphere()
    assert upright.distance.tolist() == [3.0] * 4
    with pytest.raises(InvalidInputError, match="came with the call"):
        ViewPolicy(pose="given").sphere()

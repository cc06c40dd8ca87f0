"""The table of presets."""

import pytest
import torch
import trimesh

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.filters import MultiScaleFocusCurves
from curvireg_torch.geometry import sample_views
from curvireg_torch.learned import LearnedCurvilinearSaliency
from curvireg_torch.matching import ViewBank
from curvireg_torch.presets import DEFAULT, FIELDS, PRESETS, Preset, preset_named


def test_the_default_is_in_the_table():
    assert preset_named(DEFAULT) is PRESETS[DEFAULT]
    with pytest.raises(InvalidInputError, match="'classical'"):
        preset_named("best")


@pytest.mark.parametrize("name", sorted(FIELDS))
def test_every_field_keeps_the_contract(name):
    field = FIELDS[name]()
    channels = 3 if getattr(field, "colour", False) else 1
    out = field(torch.rand(2, channels, 64, 64))
    assert out.shape == (2, 2, 64, 64)
    assert out.isfinite().all()


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_every_preset_registers(name):
    preset = PRESETS[name]
    bank = ViewBank.build(
        trimesh.creation.box((1, 2, 3)),
        sample_views(azimuth_step=60, elevations=[20]),
        settings=preset.bank,
        progress=False,
    )
    registrar = preset.registrar(bank, refine=False)
    result = registrar([torch.rand(3, 80, 100)], torch.tensor([[20.0, 10, 80, 70]]))[0]
    assert result.rotation.isfinite().all()
    assert registrar.refine is False
    assert preset.registrar(bank).refine is preset.refine


def test_classical_learns_nothing():
    assert isinstance(PRESETS["classical"].photograph_filter(), MultiScaleFocusCurves)
    assert isinstance(PRESETS["learned"].photograph_filter(), LearnedCurvilinearSaliency)


def test_a_description_says_all_that_decides():
    assert Preset(matcher={"slack": 0.0}).describe() != Preset().describe()
    assert Preset(field="focus").describe() != Preset().describe()


def test_paper_preset_has_the_papers_settings():
    paper = PRESETS["paper"]
    assert (paper.bank.camera, paper.bank.formula) == ("orthographic", "paper")
    assert paper.matcher["repeatability_mode"] == "paper"
    assert paper.matcher["box_sigma"] is None

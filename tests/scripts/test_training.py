"""The example that trains a viewpoint head on fixed layers."""

import json
from pathlib import Path

import pytest
import torch

import curvireg_torch as cr
from scripts.training import train_viewpoint_head as script
from tests._support.miniature import write_pascal3d


def test_an_epoch_lowers_the_loss_and_leaves_the_layers_as_they_were(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_pascal3d(tmp_path / "pascal")
    heads: list[script.ViewpointHead] = []
    make = script.ViewpointHead
    monkeypatch.setattr(
        script, "ViewpointHead", lambda *args: heads.append(make(*args)) or heads[0]
    )
    out = tmp_path / "runs" / "head.json"
    results = script.main(
        [str(tmp_path / "pascal"), "--batch", "1", "--size", "64", "--out", str(out)]
    )
    assert json.loads(out.read_text()) == results
    assert results["before"]["n"] + results["held out before"]["n"] == 5
    assert results["after"]["loss"] < 0.9 * results["before"]["loss"]
    assert {"loss", "accuracy_azimuth_bin", "acc_pi_6", "med_err_deg", "n"} == set(
        results["held out after"]
    )
    (head,) = heads
    fresh = cr.LearnedCurvilinearSaliency()
    for trained, fixed in zip(head.layers[0].parameters(), fresh.parameters(), strict=True):
        assert torch.equal(trained, fixed)


def test_no_photograph_is_in_both_halves(tmp_path: Path) -> None:
    write_pascal3d(tmp_path)
    crops = cr.data.crops(cr.Pascal3DPlus(tmp_path), 32)
    parts = [
        {crops.annotation(index)["image_path"] for index in half.indices}
        for half in script.halves(crops)
    ]
    assert not parts[0] & parts[1]
    assert all(parts)


def test_rotations_are_those_of_the_bins_centres() -> None:
    logits = [torch.zeros(1, count) for count in (24, 12, 24)]
    for each, number in zip(logits, (2, 7, 11), strict=True):
        each[0, number] = 1.0
    expected = cr.rotation_from_viewpoint(37.5, 22.5, -7.5)
    torch.testing.assert_close(script.rotations_of(logits, (24, 12, 24))[0], expected)


def test_one_photograph_is_too_few(tmp_path: Path) -> None:
    write_pascal3d(tmp_path)
    (tmp_path / "PASCAL" / "VOCdevkit" / "VOC2012" / "ImageSets" / "Main" / "car_val.txt").unlink()
    with pytest.raises(SystemExit, match="at least two photographs"):
        script.main([str(tmp_path)])

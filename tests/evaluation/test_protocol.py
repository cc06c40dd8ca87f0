import pytest
import torch

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.evaluation import Protocol
from curvireg_torch.evaluation.protocol import perturbed_box

BOX = torch.tensor([10.0, 20.0, 110.0, 70.0])


def test_no_box_at_all():
    protocol = Protocol.parse(["box=none"])
    assert protocol.box is None
    assert str(protocol) == "cad=annotated pose=upright box=none"
    assert Protocol.parse(["box=annotated"]).box == 0.0


@pytest.mark.parametrize(
    "words", [[], ["cad=fused", "pose=any"], ["box=0.2", "seed=7"], ["box=annotated"], ["box=none"]]
)
def test_text_is_what_was_parsed(words):
    protocol = Protocol.parse(words)
    assert Protocol.parse(str(protocol).split()) == protocol


def test_default_pose_can_be_overruled():
    assert Protocol.parse([], pose="any").pose == "any"
    assert Protocol.parse(["pose=upright"], pose="any").pose == "upright"


@pytest.mark.parametrize(
    "word", ["cad=best", "pose", "box=0.5", "box=-0.1", "box=nan", "box=big", "seed=1.5", "mesh=1"]
)
def test_bad_words(word):
    with pytest.raises(InvalidInputError):
        Protocol.parse([word])


def test_box_moves_by_name_and_seed():
    assert torch.equal(perturbed_box(BOX, Protocol(), "a"), BOX)
    moves = {
        tuple((perturbed_box(BOX, Protocol(box=0.1, seed=seed), key) - BOX).tolist())
        for key in "abc"
        for seed in (0, 1)
    }
    assert len(moves) == 6
    again = perturbed_box(BOX, Protocol(box=0.1), "a")
    assert torch.equal(again, perturbed_box(BOX, Protocol(box=0.1), "a"))
    assert again.dtype == BOX.dtype


def test_box_moves_fill_the_stated_range():
    shifts = torch.stack([perturbed_box(BOX, Protocol(box=0.1), str(i)) - BOX for i in range(400)])
    share = shifts / torch.tensor([100.0, 50.0, 100.0, 50.0])
    assert share.abs().max() <= 0.1
    assert share.abs().amax(0).min() > 0.095
    assert share.mean(0).abs().max() < 0.01

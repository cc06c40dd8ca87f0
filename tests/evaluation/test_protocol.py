import pytest
import torch

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.evaluation import Protocol
from curvireg_torch.evaluation.protocol import perturbed_box

BOX = torch.tensor([10.0, 20.0, 110.0, 70.0])


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ([], "cad=annotated pose=upright box=annotated"),
        (["cad=fused", "pose=any"], "cad=fused pose=any box=annotated"),
        (["box=0.2", "seed=7"], "cad=annotated pose=upright box=0.2 seed=7"),
        (["box=annotated"], "cad=annotated pose=upright box=annotated"),
        (["box=none"], "cad=annotated pose=upright box=none"),
    ],
)
def test_parse_and_str_are_inverse(words, text):
    protocol = Protocol.parse(words)
    assert str(protocol) == text
    assert Protocol.parse(text.split()) == protocol


def test_parse_defaults():
    assert Protocol.parse([], pose="any").pose == "any"
    assert Protocol.parse(["pose=upright"], pose="any").pose == "upright"
    assert Protocol.parse(["box=none"]).box is None
    assert Protocol.parse(["box=annotated"]).box == 0.0


@pytest.mark.parametrize(
    "word", ["cad=best", "pose", "box=0.5", "box=-0.1", "box=nan", "box=big", "seed=1.5", "mesh=1"]
)
def test_parse_refuses_bad_words(word):
    with pytest.raises(InvalidInputError):
        Protocol.parse([word])


def test_perturbed_box_depends_on_key_and_seed():
    assert torch.equal(perturbed_box(BOX, Protocol(), "a"), BOX)
    boxes = [perturbed_box(BOX, Protocol(box=0.1, seed=seed), key) for key in "abc" for seed in (0, 1)]
    assert len({tuple(box.tolist()) for box in boxes}) == 6
    assert torch.equal(boxes[0], perturbed_box(BOX, Protocol(box=0.1), "a"))
    assert boxes[0].dtype == BOX.dtype


def test_perturbed_box_fills_the_range():
    offsets = torch.stack([perturbed_box(BOX, Protocol(box=0.1), str(i)) - BOX for i in range(400)])
    fraction = offsets / torch.tensor([100.0, 50.0, 100.0, 50.0])
    assert fraction.abs().max() <= 0.1
    assert fraction.abs().amax(0).min() > 0.095
    assert fraction.mean(0).abs().max() < 0.01

from dataclasses import replace

import pytest
import torch

from curvireg_torch.evaluation import Protocol
from curvireg_torch.evaluation.protocol import hint_of_truth, perturbed_box
from curvireg_torch.geometry import rotation_from_viewpoint
from curvireg_torch.geometry.pose_prior import object_frame
from tests._support import refused

BOX = torch.tensor([10.0, 20.0, 110.0, 70.0])


def test_parse_and_str_are_inverse():
    for words, box in {
        "": "annotated",
        "box=0.2 seed=7": "0.2 seed=7",
        "box=annotated": "annotated",
        "box=none": "none",
        "box_is=visible": "annotated box_is=visible",
        "views=3 seed=2": "annotated views=3 seed=2",
    }.items():
        protocol = Protocol.parse(words.split())
        text = f"cad=annotated pose=upright box={box}"
        assert (str(protocol), Protocol.parse(text.split())) == (text, protocol)


def test_perturbed_boxes_fill_the_range_and_depend_on_key_and_seed():
    assert torch.equal(perturbed_box(BOX, Protocol(), "a"), BOX)
    boxes = torch.stack([perturbed_box(BOX, Protocol(box=0.1), str(i)) for i in range(400)])
    assert boxes.dtype == BOX.dtype
    assert torch.equal(boxes[0], perturbed_box(BOX, Protocol(box=0.1), "0"))
    assert not torch.equal(boxes[0], perturbed_box(BOX, Protocol(box=0.1, seed=1), "0"))
    fraction = (boxes - BOX) / torch.tensor([100.0, 50.0, 100.0, 50.0])
    assert len(fraction.unique(dim=0)) == 400
    assert fraction.abs().max() <= 0.1
    assert fraction.abs().amax(0).min() > 0.095
    assert fraction.mean(0).abs().max() < 0.01


@pytest.mark.parametrize("hint", ["azimuth:45", "azimuth:5", "pose:30"])
def test_hint_of_truth_holds_the_truth_and_is_off_centre(hint):
    frame = object_frame("y")
    protocol = Protocol(hint=hint)
    degrees = protocol.hint_tolerance()[1]
    R = rotation_from_viewpoint(torch.linspace(0, 350, 30, dtype=torch.float64), 20.0) @ frame
    hints = [hint_of_truth(r, frame, protocol, str(i)) for i, r in enumerate(R)]
    missed = torch.stack([hint.excess(r, frame) for hint, r in zip(hints, R, strict=True)])
    assert missed.max() <= 0.0
    assert missed.min() >= -degrees
    assert missed.std() > 0.15 * degrees
    assert missed.max() > -0.25 * degrees, "offsets fill the range"
    first, again, other = (
        hint_of_truth(R[0], frame, one, "a")
        for one in (protocol, protocol, replace(protocol, seed=1))
    )
    assert first == again != other


def test_a_seed_that_draws_nothing_and_a_key_that_is_given_twice_are_refused():
    with refused("protocol: seed: nothing is drawn"):
        Protocol.parse(["seed=3"])
    for word in ("box=0.1", "hint=pose:5", "views=2"):
        assert Protocol.parse([word, "seed=3"]).seed == 3
    with refused("protocol: box is given twice"):
        Protocol.parse(["box=0.1", "box=0.2"])


def test_hint_of_truth_is_none_without_truth_or_hint():
    eye = torch.eye(3, dtype=torch.float64)
    assert hint_of_truth(eye, eye, Protocol(), "a") is None
    assert hint_of_truth(torch.nan * eye, eye, Protocol(hint="pose:5"), "a") is None

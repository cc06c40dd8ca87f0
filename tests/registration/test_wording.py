"""Results in plain words."""

import pytest
import torch

from curvireg_torch.geometry import rotation_from_viewpoint
from curvireg_torch.geometry.pose_prior import object_frame
from curvireg_torch.registration import AnswerSet
from curvireg_torch.registration.wording import pose_in_words, verdict


@pytest.mark.parametrize(
    ("viewpoint", "words"),
    [
        ((0, 0, 0), "seen from the front (azimuth 0°), level"),
        ((359.8, 12, 0), "seen from the front (azimuth 0°), 12° above the horizon"),
        ((88, -12, 5), "seen from the right (azimuth 88°), 12° below the horizon, tilted by 5° to the left"),
        ((225, 30, -40), "seen from the back-left (azimuth 225°), 30° above the horizon, tilted by 40° to the right"),
        ((340, 20, 0), "seen from the front (azimuth 340°), 20° above the horizon"),
        ((45, 80, 0), "seen from above (azimuth 45°), 80° above the horizon"),
        ((45, -80, 0), "seen from below (azimuth 45°), 80° below the horizon"),
    ],
)
def test_pose_in_words(viewpoint, words):
    R = rotation_from_viewpoint(*torch.tensor(viewpoint, dtype=torch.float64))
    assert pose_in_words(R) == words
    for up, front in (("y", None), ("-x", None), ("z", "x")):
        assert pose_in_words(R @ object_frame(up, front), up=up, front=front) == words


def test_pose_in_words_tilts_as_the_photograph_shows():
    """Tilted to the left: the object's up axis points to the left in the picture."""
    R = rotation_from_viewpoint(10.0, 20.0, 30.0)
    assert float(R[0, 2]) < 0
    assert "to the left" in pose_in_words(R)


def test_verdict_has_three_words():
    """A high confidence that is not reliable, because of a questionable camera, is no reason to be sure."""
    cases = {
        ((0.95, 0.02), True): "likely",
        ((0.95, 0.02), False): "unsure",
        ((0.4, 0.3), False): "unsure",
        ((0.4, 0.1), False): "no match",
    }
    assert {case: verdict(AnswerSet(case[0]), case[1]) for case in cases} == cases

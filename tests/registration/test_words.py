"""Results in words."""

from collections import Counter

from curvireg_torch.geometry import rotation_from_viewpoint
from curvireg_torch.geometry.pose_prior import object_frame
from curvireg_torch.registration.confidence import two_decimals
from curvireg_torch.visualization.words import (
    AXIS_ALONE,
    VERDICTS,
    pose_in_words,
    remarks,
    verdict_counts,
)
from tests._support import double


def said(**document):
    return remarks({"corrected_box": None} | document)


def test_remarks_name_a_contradicted_prior_and_the_replaced_box_in_whole_pixels():
    prior = {"azimuth": [0, 9], "contradiction": None}
    assert said() == said(prior=prior) == []
    for contradiction, words in (
        ("better outside", "much better outside"),
        ("at the limit", "at one of"),
    ):
        (line,) = said(prior={**prior, "contradiction": contradiction})
        assert words in line
    (line,) = said(corrected_box=[1.4, 2.6, 30.49, 40.51])
    assert line.endswith(": 1 3 30 41")


def test_pose_in_words():
    for viewpoint, words in (
        ((0, 0, 0), "the front (azimuth 0°), level"),
        ((88, -12, 5), "the right (azimuth 88°), 12° below the horizon, tilted by 5° to the left"),
        (
            (225, 30, -40),
            "the back-left (azimuth 225°), 30° above the horizon, tilted by 40° to the right",
        ),
        ((45, 80, 0), "above (azimuth 45°), 80° above the horizon"),
        ((45, -80, 0), "below (azimuth 45°), 80° below the horizon"),
    ):
        R = rotation_from_viewpoint(*double(viewpoint))
        for up, front in (("z", None), ("y", None), ("-x", None), ("z", "x")):
            said_of = pose_in_words(R @ object_frame(up, front), up=up, front=front)
            assert said_of == f"seen from {words}"


def test_verdicts_are_counted_in_words():
    assert VERDICTS[4:] == ("lost", "failed")
    for counted, words in (
        ({"lost": 1, "reliable": 2}, "2 reliable, 0 unsure, 0 no match, 1 lost, 0 failed"),
        (
            {"reliable axis": 1, "unsure": 1},
            "0 reliable, 1 reliable axis, 1 unsure, 0 no match, 0 lost, 0 failed",
        ),
    ):
        assert verdict_counts(Counter(counted)) == words


def test_an_axis_that_alone_is_certain_is_said():
    assert said(verdict="reliable axis") == [AXIS_ALONE]


def test_confidence_is_never_shown_as_more_than_it_is():
    shown = [two_decimals(p) for p in (0.897, 0.8999, 0.9, 0.29, 0.57, 0.0, 1.0)]
    assert shown == ["0.89", "0.89", "0.90", "0.29", "0.57", "0.00", "1.00"]

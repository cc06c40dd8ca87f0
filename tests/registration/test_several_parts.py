"""The joint result of a rig in closed cases: probabilities, contributions, doubts."""

from types import SimpleNamespace

import pytest
import torch

from curvireg_torch.errors import InvalidInputError, LostObjectError
from curvireg_torch.geometry import Camera
from curvireg_torch.pipeline import PRESETS, Pipeline
from curvireg_torch.registration import several
from curvireg_torch.registration.confidence import hypothesis_probabilities
from curvireg_torch.registration.photograph import as_photograph, copies_of
from curvireg_torch.registration.rig import JointPoses
from tests._support import double, eye, refused
from tests._support.hypotheses import evidence_of

ANY_RIGHT = 0.8
EYE = eye(4)


def photograph(index, *, angle=0.0, ranking_share=0.5, **changes):
    """A photograph that was registered alone, with a ``confidence`` and an ``angle`` from the joint
    pose."""
    result = {
        "confidence": 0.5,
        "probabilities": (0.5,),
        "detection": None,
        "warnings": (),
        "distance": 2.0,
        "notes": (),
        "feature_is_hidden": False,
        "ranking": None,
        "confidence_features": {"ranking_share": ranking_share},
    }
    box = torch.tensor([10.0, 10.0, 50.0, 50.0])
    return SimpleNamespace(
        index=index,
        result=SimpleNamespace(**result | changes),
        poses=torch.full((2, 4, 4), angle),
        camera=EYE,
        printed=lambda _: 0.0,
        photograph=SimpleNamespace(K=eye(3), size=(100, 200), box=box),
    )


class FakeRig:
    """A rig whose photographs have the ``scores`` (V, M) of M poses; some are ``missing`` the best
    one."""

    scores: dict[int, list[float]]
    missing: dict[int, str]
    vote: dict[int, float]
    exact = True
    describer = SimpleNamespace(hull=None)
    symmetries = eye(3)[None]
    feature_is_hidden = False

    def __init__(self, _, photographs):
        self.photographs = photographs
        self.eyes = double([[0.0, 0.0, -2.0]] * len(photographs))

    @staticmethod
    def of(_, found):
        usable = [one for one in found.values() if not isinstance(one, LostObjectError)]
        return FakeRig(None, usable)

    def answer(self):
        rows = double([self.scores[p.index] for p in self.photographs])
        evidence = evidence_of(similarity=(0.1 * rows).tolist())
        M = rows.shape[1]
        C = torch.full((M, 6, 6), torch.nan).double()
        return JointPoses(EYE.repeat(M, 1, 1), evidence, rows, C)

    def lost(self, _):
        there = [p.index for p in self.photographs]
        return {index: why for index, why in self.missing.items() if index in there}

    def weights(self, _):
        return double([self.vote.get(p.index, 1.0) for p in self.photographs])

    def angles(self, poses, _, *, shape_alone):
        return poses[:, 0, 0] * (not shape_alone)

    def centres(self, poses):
        return poses[:, :3, 3]

    def hypothesis(self, _, m, mean):
        return SimpleNamespace(number=m, similarity=float(mean.similarity[m]))


def joint(
    monkeypatch, found, scores, *, missing=None, vote=None, count=5, pipeline=None, exact=True
):
    monkeypatch.setattr(FakeRig, "exact", exact)
    FakeRig.scores = scores
    FakeRig.missing = missing or {}
    FakeRig.vote = vote or {}
    monkeypatch.setattr(several, "Rig", FakeRig)
    monkeypatch.setattr(several, "probability_of_any", lambda *_, **__: ANY_RIGHT)
    monkeypatch.setattr(several, "outside_fraction", lambda _, __, ___, size: size[0] / 1000.0)
    target = SimpleNamespace(pipeline=pipeline or Pipeline())
    return several._registration(target, found, EYE.repeat(len(found), 1, 1), count)


def two(**changes):
    return {0: photograph(0, **changes), 1: photograph(1)}


SCORES = {0: [9.0, 7.0, 4.0], 1: [8.0, 7.0, 6.0]}
TOTAL = double([17.0, 14.0, 10.0])
TOGETHER = hypothesis_probabilities(ANY_RIGHT, TOTAL, exact=True)


def test_probabilities_are_those_of_the_sums_of_scores(monkeypatch):
    result = joint(monkeypatch, two(), SCORES)
    assert result.probabilities == pytest.approx(TOGETHER)
    assert [view.contribution for view in result.views] == [2.0, 1.0]
    assert result.hypotheses[0].similarity == pytest.approx(0.85)
    few = joint(monkeypatch, two(), SCORES, count=2)
    assert few.probabilities == pytest.approx(TOGETHER[:2])
    assert len(few.hypotheses) == 2
    assert joint(monkeypatch, two(), SCORES, pipeline=PRESETS["classical"]).probabilities == (0.5,)


def test_votes_weight_scores_and_contributions(monkeypatch):
    result = joint(monkeypatch, two(), SCORES, vote={0: 0.5, 1: 0.25})
    total = double([6.5, 5.25, 3.5])
    expected = hypothesis_probabilities(ANY_RIGHT, total, exact=True)
    assert result.probabilities == pytest.approx(expected)
    assert [view.contribution for view in result.views] == [1.0, 0.25]
    assert result.hypotheses[0].similarity == pytest.approx((0.5 * 0.9 + 0.25 * 0.8) / 0.75)
    assert result.confidence_features["margin"] == pytest.approx(1.25)


def test_one_pose_of_all_hypotheses_has_the_largest_margin(monkeypatch):
    result = joint(monkeypatch, two(), {0: [9.0], 1: [8.0]})
    assert result.confidence_features["margin"] == 5.0
    assert [view.contribution for view in result.views] == [5.0, 5.0]
    one = joint(monkeypatch, {0: photograph(0)}, {0: [9.0]})
    assert one.confidence_features["margin"] is None
    assert one.probabilities == (0.5,), "that of the photograph alone"


def test_an_object_that_was_searched_for_is_as_likely_as_its_clearest_place(monkeypatch):
    found = {k: photograph(k, detection=SimpleNamespace(score=s)) for k, s in ((0, 0.5), (1, 0.7))}
    result = joint(monkeypatch, found, SCORES)
    assert result.probabilities == pytest.approx([0.7 * p for p in TOGETHER])


@pytest.mark.parametrize(
    ("confidence", "angle", "is_hidden", "factor"),
    [
        (0.9, 90.0, False, 1.0 / 9.0),
        (0.9, 90.0, True, 1.0),
        (0.9, 20.0, False, 1.0),
        (0.3, 90.0, False, 1.0),
        (0.5, 31.0, False, 1.0),
    ],
)
def test_photographs_that_are_confident_of_another_pose_lower_the_odds(
    monkeypatch, confidence, angle, is_hidden, factor
):
    """Not of another turn whose feature they hide."""
    other = photograph(2, confidence=confidence, angle=angle, feature_is_hidden=is_hidden)
    scores = SCORES | {2: [1.0, 5.0, 1.0]}
    result = joint(monkeypatch, two() | {2: other}, scores, missing={2: "elsewhere"})
    odds = factor * TOGETHER[0] / (1.0 - TOGETHER[0])
    ratio = odds / (1.0 + odds) / TOGETHER[0]
    assert result.probabilities == pytest.approx([ratio * p for p in TOGETHER])
    assert [view.failure for view in result.views] == [None, None, "elsewhere"]
    assert [view.contribution for view in result.views] == [2.0, 1.0, 0.0]


def test_failed_photographs_say_why_and_do_not_count(monkeypatch):
    found = two() | {2: LostObjectError("dark")}
    result = joint(monkeypatch, found, SCORES)
    assert [view.failure for view in result.views] == [None, None, "dark"]
    assert result.probabilities == pytest.approx(TOGETHER)


def test_doubts_are_means_by_votes_and_warnings_those_of_most(monkeypatch):
    """The fraction outside is a thousandth of the height here."""
    first = photograph(0, ranking_share=0.2, warnings=("b 400", "a", "own"))
    second = photograph(1, ranking_share=None, warnings=("a", "b 405"))
    third = photograph(2, ranking_share=0.6, warnings=("x", "a"))
    second.photograph.size = (300, 200)
    second.photograph.box = torch.tensor([-0.5, 10.0, 199.5, 50.0])
    second.printed = lambda _: 3.5
    found = {0: first, 1: second, 2: third}
    scores = SCORES | {2: [1.0, 1.0, 1.0]}
    result = joint(monkeypatch, found, scores, vote={0: 0.5, 1: 1.0, 2: 0.5})
    features = result.confidence_features
    assert features["ranking_share"] == pytest.approx(0.4), "of those that know it"
    assert features["outside"] == pytest.approx(0.25 * 0.1 + 0.5 * 0.3 + 0.25 * 0.1)
    assert features["border"] == pytest.approx(0.5 * 2)
    assert features["undetermined"] == 3.0
    assert features["unmatched"] == pytest.approx(3.5 - features["keypoints"])
    assert result.warnings == ("a", "b 400")
    assert joint(monkeypatch, {0: first, 1: third}, scores).warnings == ("a",), "not of one of two"


@pytest.mark.parametrize(
    ("against", "is_named"),
    [([0.49], False), ([0.5], True), ([0.5, 0.49], True), ([0.9, 0.9], True)],
)
@pytest.mark.parametrize("counted", [1, 2])
def test_as_many_photographs_that_contradict_the_pose_are_a_warning(
    monkeypatch, against, is_named, counted
):
    """Those that are convinced of another one."""
    confidences = [0.9] * counted + against
    found = {k: photograph(k, confidence=confidences[k]) for k in range(len(confidences))}
    missing = {k: "elsewhere" for k in found if k >= counted}
    scores = {k: [9.0, 7.0, 4.0] for k in found}
    warnings = joint(monkeypatch, found, scores, missing=missing).warnings
    is_named = is_named and (counted == 1 or against == [0.9, 0.9])
    assert ["photographs contradict the pose" in text for text in warnings] == [True] * is_named


@pytest.mark.parametrize(
    ("distances", "said"),
    [
        ((2.0, 2.0), ""),
        ((2.2, 2.12), ""),
        ((2.2, 2.16), "1.09 times as far away as by the places"),
        ((1.8, 1.9), ""),
        ((1.8, 1.86), "0.92 times as far"),
        ((2.2, 1.8), ""),
        ((3.0,), ""),  # one photograph tells no scale
    ],
)
def test_distances_that_all_differ_from_those_of_the_cameras_are_a_warning(
    monkeypatch, distances, said
):
    found = {k: photograph(k, distance=distance) for k, distance in enumerate(distances)}
    warnings = joint(monkeypatch, found, {k: [9.0, 7.0] for k in found}).warnings
    assert len(warnings) == bool(said)
    assert said in "".join(warnings)
    scores = {k: [9.0, 7.0] for k in found}
    assert not joint(monkeypatch, found, scores, exact=False).warnings, "of another size anyway"


@pytest.mark.parametrize("away", [0.0, 0.01, 100.0])
def test_copies_are_of_one_camera_in_one_place(away):
    """Up to 1e-4 of the distance; what differs from the very same place is a mistake."""
    image = torch.rand(1, 40, 60)
    wide = Camera([[50.0, 0, 29.5], [0, 50, 19.5], [0, 0, 1]], size=(40, 60))
    one = as_photograph(image, None, wide)
    T = eye(4).repeat(2, 1, 1)
    T[:, 2, 3] = away
    assert copies_of(T, [one, one]) == {1: 0}
    assert copies_of(T, [InvalidInputError("dark"), one]) == {}
    assert copies_of(T, [one, as_photograph(image[:, :30, :45], None, wide)]) == {}
    assert copies_of(T, [one, one.by(wide.at((44, 66)).matrix)]) == {}
    other = as_photograph(1.0 - image, None, wide)
    with refused(r"image 1 and image 0: .* show different"):
        copies_of(T, [one, other])
    for shift, expected in ((0.5e-4, {1: 0}), (2e-4, {})):
        moved = T.clone()
        moved[1, 0, 3] = shift * away
        if away:
            assert copies_of(moved, [one, other]) == expected
        turned = T.clone()
        turned[1, 0, 1] = shift
        assert copies_of(turned, [one, other]) == expected
    three = T[[0, 0, 1]]
    assert copies_of(three, [one, one, one]) == {1: 0, 2: 0}

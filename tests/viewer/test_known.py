"""What is known about the pose, on the page: the map of directions, and the fields, without a browser."""

from types import SimpleNamespace
from xml.etree import ElementTree

import pytest

from curvireg_torch.evaluation.opening import RegisterOptions
from curvireg_torch.geometry.pose_prior import SIDES, PosePrior
from curvireg_torch.viewer.directions import HEIGHT, WIDTH, limits_of_box, map_svg
from curvireg_torch.viewer.session import Session


def blue(limits):
    """Left, right, upper and lower border of each coloured rectangle on the map."""
    parts = [p for p in ElementTree.fromstring(f"<svg>{map_svg(limits)}</svg>") if p.get("fill") == "#1976d2"]
    corners = [[float(p.get(name)) for name in ("x", "y", "width", "height")] for p in parts]
    return [(x, x + w, y, y + h) for x, y, w, h in corners]


@pytest.mark.parametrize(
    ("box", "limits"),
    [
        ((120, 30, 240, 100), {"azimuth": (300, 60), "elevation": (-10, 60)}),
        ((270.4, 0, 320, 180), {"azimuth": (90, 140), "elevation": None}),
        ((0, 80, 360, 90), {"azimuth": None, "elevation": (0, 10)}),
        ((-30, -20, 90, 400), {"azimuth": (180, 270), "elevation": None}),
    ],
)
def test_limits_of_box_are_those_that_the_map_shows(box, limits):
    assert limits_of_box(box) == limits
    x0, y0, x1, y1 = (round(min(max(v, 0), end)) for v, end in zip(box, (WIDTH, HEIGHT) * 2, strict=True))
    assert blue(limits) == [(x0, x1, y0, y1)]


def test_map_shows_a_range_through_the_back_in_two_parts():
    assert blue({"azimuth": (150.0, 200.0)}) == [(330, 360, 0, 180), (0, 20, 0, 180)]
    assert blue({}) == [(0, 360, 0, 180)]
    assert blue({"azimuth": (0, 360)}) == [(180, 360, 0, 180), (0, 180, 0, 180)]
    for name, azimuth in SIDES.items():
        middle = (azimuth + 180.0) % 360.0
        parts = blue({"azimuth": PosePrior.side(name).azimuth})
        assert sum(right - left for left, right, *_ in parts) == 90
        assert any(left <= middle <= right for left, right, *_ in parts)


@pytest.fixture
def known():
    """The fields on a page that no browser shows, of a session whose command line named the front."""
    pytest.importorskip("nicegui", reason="nicegui is not installed")
    from nicegui.client import Client
    from nicegui.page import page

    from curvireg_torch.viewer.known import KnownPose

    session = Session(RegisterOptions(limits={"front": "-x", "theta": (-10.0, 10.0)}))
    with Client(page(""), request=None):
        yield KnownPose(session)


def event(kind, x, y):
    return SimpleNamespace(type=kind, image_x=x, image_y=y, buttons=1)


def test_known_pose_is_drawn_typed_and_removed(known):
    session = known.session

    def limits():
        return {name: value for name, value in session.options.limits.items() if name not in ("front", "theta")}

    for one in (event("mousedown", 240, 30), event("mousemove", 130, 110), event("mousemove", 120, 100)):
        known._handle_mouse(one)
    assert limits() == {}, "not before the button is released"
    assert known.map.content == map_svg({"azimuth": (300, 60), "elevation": (-10, 60)})
    known._handle_mouse(event("mouseup", 120, 100))
    assert limits() == {"azimuth": (300, 60), "elevation": (-10, 60)}
    assert [number.value for number in known.numbers["azimuth"]] == [300, 60]
    known.numbers["azimuth"][1].set_value(75)
    assert limits() == {"azimuth": (300, 75), "elevation": (-10, 60)}
    assert known.map.content == map_svg(limits())
    known.numbers["elevation"][0].set_value(None)
    assert limits() == {"azimuth": (300, 75)}
    known._set(azimuth=PosePrior.side("left").azimuth)
    assert session.command().endswith(" --front=-x --theta -10 10 --azimuth 225 315 --out result")
    known._set(azimuth=None, elevation=None)
    assert limits() == {}
    assert known.map.content == map_svg({})

"""scripts/benchmark/vehicles.py and ac3d.py: AC3D files, and vehicles converted from them."""

import numpy as np
import pytest

from scripts.benchmark import vehicles
from scripts.benchmark.ac3d import read_ac3d

CORNERS = """mat 0
refs 4
0 0 0
1 1 0
2 1 1
3 0 1
"""
FILE = f"""AC3Db
MATERIAL "paint" rgb 1 0.5 0  amb 1 1 1  emis 0 0 0  spec 0.4 0.4 0.4  shi 10  trans 0
OBJECT world
kids 2
OBJECT group
name "body"
loc 10 0 0
data 3
ab
kids 1
OBJECT poly
name "hull"
texture "paint.png"
texrep 2 1
texoff 0 0.5
rot 0 1 0 -1 0 0 0 0 1
loc 0 1 0
numvert 4
0 0 0
2 0 0
2 1 0
0 1 0
numsurf 3
SURF 0x20
{CORNERS}SURF 0x14
{CORNERS}SURF 0x2
mat 0
refs 2
0 0 0
1 1 0
kids 0
OBJECT poly
name "navlight glow"
numvert 3
0 0 0
1 0 0
0 1 0
numsurf 1
SURF 0x0
mat 0
refs 3
0 0 0
1 0 0
2 0 0
kids 0
"""


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "a.ac"
    path.write_text(FILE)
    return path


def test_read_ac3d_places_objects_in_the_frame_of_their_parent(path):
    (part,) = read_ac3d(path)
    assert (part.colour, part.gloss, part.texture) == ([1.0, 0.5, 0.0], 0.4, "paint.png")
    # x is mapped to y ("rot" lists the images of the axes); then up by 1, then 10 along x
    corners = np.array([[10, 1, 0], [10, 3, 0], [9, 3, 0], [9, 1, 0]], float)
    fan, strip = corners[[[0, 1, 2], [0, 2, 3]]], corners[[[0, 1, 2], [2, 1, 3]]]
    assert part.corners.tolist() == [*fan.tolist(), *strip.tolist()], "lines and glow are left out"
    assert part.uv[0].tolist() == [[0.0, 0.5], [2.0, 0.5], [2.0, 1.5]]


def test_read_ac3d_accepts_missing_children(path):
    path.write_text(FILE.replace("kids 2", "kids 3"))
    assert len(read_ac3d(path)) == 1


@pytest.mark.parametrize("content", ["", "solid\n", FILE[: len(FILE) // 2], FILE.replace("SURF 0x20", "SURF")])
def test_read_ac3d_rejects_malformed_files(path, content):
    path.write_text(content)
    with pytest.raises(ValueError, match=r"a\.ac"):
        read_ac3d(path)


def test_convert_puts_a_vehicle_on_the_floor_with_its_front_along_minus_y(path, tmp_path, monkeypatch):
    row = {"id": "aircraft-b", "file": path}
    assert vehicles.convert(row, tmp_path / "out") == "few faces"
    monkeypatch.setattr(vehicles, "MIN_FACES", 1)
    assert vehicles.convert(row, tmp_path / "out") is None
    lines = (tmp_path / "out" / "model.obj").read_text().splitlines()
    points = np.array([line.split()[1:] for line in lines if line.startswith("v ")], float)
    assert np.ptp(points, axis=0).tolist() == [0.0, 1.0, 2.0], "the file's z, x and y"
    assert points[:, 2].min() == 0.0
    assert points[:3, 1].tolist() == [0.5, 0.5, -0.5], "x points aft"
    assert "Kd 1.0 0.5 0.0" in (tmp_path / "out" / "model.mtl").read_text(), "the material's colour, without texture"


def test_wheels_have_the_position_and_size_of_the_description(tmp_path):
    axles = "".join(
        f'<section name="{axle} Axle"><attnum name="xpos" val="{x}"/></section>'
        + "".join(
            f'<section name="{axle} {side} Wheel"><attnum name="ypos" unit="m" val="{y}"/>'
            '<attnum name="rim diameter" unit="in" val="20"/><attnum name="tire width" unit="mm" val="200"/>'
            '<attnum name="tire height-width ratio" val=".5"/></section>'
            for side, y in (("Right", -0.8), ("Left", 0.7))
        )
        for axle, x in (("Front", 1.5), ("Rear", -1.0))
    )
    (tmp_path / "car.xml").write_text(axles)
    tyre, hub = vehicles.wheels(tmp_path / "car.acc")
    radius = 0.5 * 20 * 0.0254 + 0.1
    low, high = tyre.corners.reshape(-1, 3).min(axis=0), tyre.corners.reshape(-1, 3).max(axis=0)
    np.testing.assert_allclose(low, [-1.0 - radius, 0.0, -0.8], atol=1e-9)
    np.testing.assert_allclose(high, [1.5 + radius, 2 * radius, 0.9], atol=1e-9)
    assert len(tyre.corners) == 4 * 16 * 6
    assert len(hub.corners) == 4 * 16 * 2
    (tmp_path / "car.xml").write_text(axles.replace("rim diameter", "rim"))
    with pytest.raises(ValueError, match="Front Right Wheel has no rim diameter"):
        vehicles.wheels(tmp_path / "car.acc")


def test_kind_of():
    kind = vehicles.kind_of
    assert [kind("aircraft", n) for n in ("f16", "cub", "738", "sr71")] == [
        "fighter",
        "propeller aircraft",
        "airliner",
        None,
    ]
    assert [kind("ship", "tanker"), kind("ship", "barge"), kind("car", "p406")] == ["ship", None, "car"]

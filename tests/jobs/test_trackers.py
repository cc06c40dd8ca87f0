"""Start poses for other trackers, read back by the rules of these: OpenCV's file storage for M3T,
and the order of numbers that ViSP's reader expects."""

import cv2
import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from curvireg_torch.formats.exports.trackers import polygons_of
from curvireg_torch.jobs.trackers import write_start
from curvireg_torch.mesh import load_mesh
from tests._support import refused

ANGLE = np.array([0.3, -0.5, 0.2])
TRANSLATION = [30.0, -20.0, 900.0]
K = [[800.0, 0.0, 319.5], [0.0, 790.0, 239.5], [0.0, 0.0, 1.0]]
DOCUMENT = {
    "rotation": cv2.Rodrigues(ANGLE)[0].tolist(),
    "quaternion": Rotation.from_rotvec(ANGLE).as_quat(scalar_first=True).tolist(),
    "translation": TRANSLATION,
    "unit": "mm",
    "frame": "camera",
    "camera": {"matrix": K},
}
POINTS = 12


def box():
    """A block of 120 x 80 x 40 mm, off its origin."""
    mesh = trimesh.creation.box((120.0, 80.0, 40.0))
    mesh.apply_translation([10.0, 5.0, 0.0])
    mesh.units = "mm"
    return mesh


def numbers(path):
    """The numbers of a file of ViSP, without comments, in their order."""
    lines = [line.partition("#")[0] for line in path.read_text().splitlines()]
    return iter(" ".join(lines).split())


def points(words, columns):
    """The number of points, and these."""
    count = int(next(words))
    return np.array([float(next(words)) for _ in range(count * columns)]).reshape(count, columns)


def read_body(folder):
    return cv2.FileStorage(str(folder / "object.yaml"), cv2.FILE_STORAGE_READ)


def read_cao(path):
    words = numbers(path)
    assert next(words) == "V1"
    vertices = points(words, 3)
    assert next(words) == next(words) == "0"
    polygons = [
        [int(next(words)) for _ in range(int(next(words)))] for _ in range(int(next(words)))
    ]
    assert [*words] == ["0", "0"]
    return vertices, polygons


def test_m3t_reads_the_pose_in_metres_and_the_mesh_in_its_unit(tmp_path):
    write_start("m3t", tmp_path, box(), DOCUMENT)
    detector = cv2.FileStorage(str(tmp_path / "object_detector.yaml"), cv2.FILE_STORAGE_READ)
    T = detector.getNode("link2world_pose").mat()
    assert_allclose(T[:3, :3], DOCUMENT["rotation"], atol=1e-9)
    assert_allclose(T[:3, 3], [0.03, -0.02, 0.9])
    assert T[3].tolist() == [0, 0, 0, 1]
    body = read_body(tmp_path)
    assert body.getNode("geometry_unit_in_meter").real() == pytest.approx(0.001)
    for name in ("counterclockwise", "enable_culling"):
        assert body.getNode(f"geometry_{name}").real() == 1
    np.testing.assert_array_equal(body.getNode("geometry2body_pose").mat(), np.eye(4))
    mesh = load_mesh(tmp_path / body.getNode("geometry_path").string(), unit="mm")
    assert_allclose(mesh.bounds, box().bounds)
    assert mesh.surface.volume == pytest.approx(box().volume)


def test_m3t_shows_both_sides_of_an_open_surface(tmp_path):
    mesh = box()
    mesh.update_faces(np.arange(10))
    write_start("m3t", tmp_path, mesh, DOCUMENT)
    assert read_body(tmp_path).getNode("geometry_enable_culling").real() == 0


def test_visp_reads_polygons_counter_clockwise_from_outside(tmp_path):
    write_start("visp", tmp_path, box(), DOCUMENT)
    vertices, polygons = read_cao(tmp_path / "object.cao")
    assert_allclose(vertices.min(axis=0), [-0.05, -0.035, -0.02])
    assert_allclose(vertices.max(axis=0), [0.07, 0.045, 0.02])
    assert [len(polygon) for polygon in polygons] == [4] * 6
    for polygon in polygons:
        a, b, c, _ = vertices[polygon]
        outside = a - vertices.mean(axis=0)
        assert np.cross(b - a, c - a) @ outside > 0


def test_visp_finds_the_pose_from_points_and_reads_it(tmp_path):
    write_start("visp", tmp_path, box(), DOCUMENT)
    words = numbers(tmp_path / "object.init")
    model = points(words, 3)
    pixels = points(words, 2)[:, ::-1].copy()  # row and column
    assert not [*words]
    assert len(model) == len(pixels) == 8, "the corners of the box"
    found, angle, translation = cv2.solvePnP(model, pixels, np.array(K), None)
    assert found
    assert_allclose(angle[:, 0], ANGLE, atol=1e-4)
    assert_allclose(translation[:, 0], [0.03, -0.02, 0.9], atol=1e-4)
    quaternion = np.array(DOCUMENT["quaternion"])
    for same in (quaternion, -quaternion):
        write_start("visp", tmp_path, box(), {**DOCUMENT, "quaternion": same.tolist()})
        pose = [float(x) for x in (tmp_path / "object.pos").read_text().split()]
        assert_allclose(pose, [0.03, -0.02, 0.9, *ANGLE], atol=1e-9)
    write_start("visp", tmp_path, box(), {**DOCUMENT, "quaternion": [-1.0, 0.0, 0.0, 0.0]})
    assert [float(x) for x in (tmp_path / "object.pos").read_text().split()[3:]] == [0.0] * 3


def test_visp_gets_few_faces_and_points_of_a_large_mesh(tmp_path):
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=50.0)
    write_start("visp", tmp_path, mesh, DOCUMENT)
    vertices, polygons = read_cao(tmp_path / "object.cao")
    assert 500 < len(polygons) <= 2000
    assert_allclose(np.linalg.norm(vertices, axis=1), 0.05, rtol=0.02)
    assert int(next(numbers(tmp_path / "object.init"))) == POINTS


def test_a_face_with_a_hole_stays_triangles():
    inner = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]
    outer = [[3 * x, 3 * y, 0] for x, y, _ in inner]
    faces = [[k, (k + 1) % 4, 4 + k] for k in range(4)]
    faces += [[(k + 1) % 4, 4 + (k + 1) % 4, 4 + k] for k in range(4)]
    mesh = trimesh.Trimesh([*outer, *inner], faces, process=False)
    assert sorted(polygons_of(mesh)) == sorted(faces)


@pytest.mark.parametrize("tracker", ["m3t", "visp"])
@pytest.mark.parametrize(
    ("changes", "message"),
    [({"translation": None}, "give a camera"), ({"frame": "world"}, "one camera")],
)
def test_poses_that_no_tracker_can_start_from_are_refused(tmp_path, tracker, changes, message):
    with refused(message):
        write_start(tracker, tmp_path, box(), {**DOCUMENT, **changes})
    assert not [*tmp_path.iterdir()]

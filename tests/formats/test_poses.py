"""Poses as other tools write them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from curvireg_torch.data.poses import read_pose
from curvireg_torch.errors import MissingFileError
from tests._support.refusals import refused

R = Rotation.from_euler("xyz", [20, -30, 50], degrees=True).as_matrix()
t = np.array([0.02, -0.01, 0.6])
T = np.block([[R, t[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
QUATERNION = Rotation.from_matrix(R).as_quat().tolist()  # x, y, z, w


MINE = {"rotation": R.tolist(), "translation": t.tolist()}


def check(found, unit=None, confidence=None, expected=T):
    np.testing.assert_allclose(found.T, expected, atol=1e-12, rtol=0)
    assert (found.unit, found.confidence) == (unit, confidence)


@pytest.fixture
def read(write):
    """Write a file of poses, and read the one of a name, or the only one."""

    def written_and_read(content, name="", **options):
        path = write("pose.json", content)
        return read_pose(f"{path}{name and ':'}{name}", **options)

    return written_and_read


@pytest.mark.parametrize(
    "content",
    [
        MINE,
        {"R": R.flatten().tolist(), "t": t[:, None].tolist()},
        {"T_cam_from_model": T.tolist()},
        {"pose": T[:3].flatten().tolist()},
        {"transform_matrix": T.T.tolist()},
        T.tolist(),
    ],
    ids=["result", "short", "transform", "3 x 4", "column by column", "list"],
)
def test_json(read, content):
    check(read(content))


@pytest.mark.parametrize("pose", [MINE, {"T_cam_from_model": T.tolist()}], ids=["R t", "T"])
def test_a_result_states_its_unit(read, pose):
    check(read({"schema": 1, "unit": "in", **pose}), "in")
    for fields in ({"unit": "in"}, {"schema": 1}, {"schema": 1, "unit": None}):
        check(read({**fields, **pose}))
    for unit in ("ell", ["in"]):
        check(read({"schema": 1, "unit": unit, **pose}))


def test_text_of_numpy_and_arrays(tmp_path):
    for matrix in (T, T[:3], T.T):
        np.savetxt(tmp_path / "pose.txt", matrix)
        check(read_pose(tmp_path / "pose.txt"))
    np.save(tmp_path / "pose.npy", T)
    check(read_pose(tmp_path / "pose.npy"))


def test_a_pose_without_translation_is_read_row_by_row(read):
    """Row by row and column by column it has 0 0 0 1 at its end."""
    centred = T.copy()
    centred[:3, 3] = 0.0
    check(read(centred.tolist()), expected=centred)


def test_megapose_writes_quaternions_and_metres(read):
    mine = {"label": "can", "TWO": [QUATERNION, t.tolist()]}
    check(read([mine]), "m")
    both = [{"label": "box", "TWO": [[0, 0, 0, 1], [0, 0, 1]]}, mine]
    for how in ({"name": "can"}, {"name": "1"}, {"mesh": "can"}):
        check(read(both, **how), "m")
    for content, words in (
        (both, "expected one pose, got 2 of 2; choose one as FILE:NAME: box, can"),
        ([{**mine, "TWC": [[0, 0, 0, 1], [0, 0, 1]]}], "in the world of TWC"),
        ([{"TWO": [[0, 0, 0, 2], [0, 0, 1]]}], "a quaternion x, y, z, w of length 1, got 2"),
    ):
        with refused(words):
            read(content)


def test_bop_writes_millimetres_and_several_objects(read):
    def entry(number, rotation):
        return {"cam_R_m2c": rotation.flatten().tolist(), "cam_t_m2c": t.tolist(), "obj_id": number}

    other = np.eye(3)
    truth = {"3": [entry(1, other), entry(5, R)], "12": [entry(5, other), entry(5, R)]}
    check(read(truth, "000003", mesh="obj_000005"), "mm")
    check(read(truth, "12:1"), "mm")
    with refused("poses of several images; choose one as FILE:IMAGE_ID from 3, 12"):
        read(truth)
    with refused("expected one pose of object 5, got 2 of 2"):
        read(truth, "12", mesh="obj_000005")
    check(read({"7": [entry(1, R)]}), "mm")
    with refused("expected one pose of object 7, got 0 of 1; choose one as FILE:NAME: 0"):
        read({"7": [entry(1, R)]}, mesh="obj_000007")
    check(read({"7": [entry(1, R)]}, "7:0", mesh="obj_000007"), "mm")
    check(read(entry(1, R)), "mm")


def test_ros_writes_metres(read):
    q = dict(zip("xyzw", QUATERNION, strict=True))
    pose = {"position": dict(zip("xyz", t.tolist(), strict=True)), "orientation": q}
    check(read({"header": {"frame_id": "camera"}, "pose": pose}), "m")
    check(read({"header": {}, "pose": {"pose": pose, "covariance": [0.0] * 36}}), "m")
    with refused("expected position and orientation"):
        read({"header": {}, "pose": [1]})


def test_opengl_poses_look_along_minus_z(read):
    flipped = np.diag([1.0, -1.0, -1.0, 1.0]) @ T
    check(read(flipped.tolist(), convention="opengl"))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({**MINE, "translation": None}, "register with a camera first"),
        ({**MINE, "frame": "world"}, "whose pose is in the world; .* as in 'photographs'"),
        ({"T": (2 * T).tolist()}, "a last row of 0 0 0 1"),
        ({"T": np.diag([2.0, 1, 1, 1]).tolist()}, "rigid"),
        ({**MINE, "rotation": [1.0, 0, 0, 0]}, "rotation: expected 9 finite numbers"),
        ({"quaternion": [0, 0, 0, 1], "translation": [0, 0, 1]}, "no rotation of 3 x 3 numbers"),
        ({"rotation": R.tolist()}, "no translation; expected JSON"),
        ([], "expected JSON with rotation and translation, or T_cam_from_model"),
        ("text", "expected JSON with rotation"),
        ('{"a": 1}}', "cannot be read: Extra data.*; write it again as JSON with rotation"),
        ('{"a": }', "cannot be read: Expecting .*; write it again as JSON with rotation"),
        (
            '{"a": 1}\n{"a": 2}\n',
            "several documents of JSON.*; give one line as a file",
        ),
    ],
)
def test_what_is_no_pose_is_refused(read, content, words):
    with refused(rf"pose\.json: .*{words}"):
        read(content)


def test_a_missing_file_is_named(tmp_path):
    with refused(r"lost\.json:3: no such file", MissingFileError):
        read_pose(tmp_path / "lost.json:3")


def test_results_are_start_poses_with_a_confidence(read):
    of_others = {"rotation": np.eye(3).tolist()}
    more = {"schema": 4, "frame": "camera", "top": [of_others], "hypotheses": [of_others]}
    check(read({**more, **MINE, "confidence": 0.8}), confidence=0.8)

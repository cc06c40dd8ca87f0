"""Poses as other tools write them."""

import json
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from curvireg_torch.data.poses import read_pose
from curvireg_torch.errors import InvalidInputError, MissingFileError
from tests._support.refusals import raises

R = Rotation.from_euler("xyz", [20, -30, 50], degrees=True).as_matrix()
t = np.array([0.02, -0.01, 0.6])
T = np.block([[R, t[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
QUATERNION = Rotation.from_matrix(R).as_quat().tolist()  # x, y, z, w


def check(found, unit=None, confidence=None, expected=T):
    np.testing.assert_allclose(found.T, expected, atol=1e-12, rtol=0)
    assert (found.unit, found.confidence) == (unit, confidence)


def written(tmp_path, content):
    file = tmp_path / "pose.json"
    file.write_text(json.dumps(content))
    return file


@pytest.mark.parametrize(
    "content",
    [
        {"rotation": R.tolist(), "translation": t.tolist()},
        {"R": R.flatten().tolist(), "t": t[:, None].tolist()},
        {"T_cam_from_model": T.tolist()},
        {"pose": T[:3].flatten().tolist()},
        {"transform_matrix": T.T.tolist()},
        T.tolist(),
    ],
    ids=["result", "short", "transform", "3 x 4", "column by column", "list"],
)
def test_json(tmp_path, content):
    check(read_pose(written(tmp_path, content)))


def test_text_of_numpy_and_arrays(tmp_path):
    for matrix in (T, T[:3], T.T):
        np.savetxt(tmp_path / "pose.txt", matrix)
        check(read_pose(tmp_path / "pose.txt"))
    np.save(tmp_path / "pose.npy", T)
    check(read_pose(tmp_path / "pose.npy"))


def test_a_pose_without_translation_is_read_row_by_row(tmp_path):
    """Row by row and column by column it has 0 0 0 1 at its end."""
    centred = T.copy()
    centred[:3, 3] = 0.0
    check(read_pose(written(tmp_path, centred.tolist())), expected=centred)


def test_the_confidence_of_a_result_is_kept(tmp_path):
    content = {"rotation": R.tolist(), "translation": t.tolist(), "confidence": 0.5}
    check(read_pose(written(tmp_path, content)), confidence=0.5)


def test_megapose_writes_quaternions_and_metres(tmp_path):
    mine = {"label": "can", "TWO": [QUATERNION, t.tolist()]}
    check(read_pose(written(tmp_path, [mine])), "m")
    file = written(tmp_path, [{"label": "box", "TWO": [[0, 0, 0, 1], [0, 0, 1]]}, mine])
    check(read_pose(tmp_path / "pose.json:can"), "m")
    check(read_pose(tmp_path / "pose.json:1"), "m")
    check(read_pose(file, mesh="can"), "m")
    raises(
        InvalidInputError,
        "expected one pose, got 2 of 2; choose one as FILE:NAME: box, can",
        read_pose,
        file,
    )
    raises(
        InvalidInputError,
        r"in the world of TWC",
        read_pose,
        written(tmp_path, [{**mine, "TWC": [[0, 0, 0, 1], [0, 0, 1]]}]),
    )
    raises(
        InvalidInputError,
        "a quaternion x, y, z, w of length 1, got 2",
        read_pose,
        written(tmp_path, [{"TWO": [[0, 0, 0, 2], [0, 0, 1]]}]),
    )


def test_bop_writes_millimetres_and_several_objects(tmp_path):
    def entry(number, rotation):
        return {"cam_R_m2c": rotation.flatten().tolist(), "cam_t_m2c": t.tolist(), "obj_id": number}

    truth = {"3": [entry(1, np.eye(3)), entry(5, R)], "12": [entry(5, np.eye(3)), entry(5, R)]}
    file = written(tmp_path, truth)
    check(read_pose(tmp_path / "pose.json:000003", mesh="obj_000005"), "mm")
    check(read_pose(tmp_path / "pose.json:12:1"), "mm")
    raises(
        InvalidInputError,
        "poses of several images; choose one as FILE:IMAGE_ID from 3, 12",
        read_pose,
        file,
    )
    raises(
        InvalidInputError,
        "expected one pose, got 2 of 2",
        read_pose,
        tmp_path / "pose.json:12",
        mesh="obj_000005",
    )
    check(read_pose(written(tmp_path, {"7": [entry(1, R)]})), "mm")
    check(read_pose(written(tmp_path, entry(1, R))), "mm")


def test_ros_writes_metres(tmp_path):
    q = dict(zip("xyzw", QUATERNION, strict=True))
    pose = {"position": dict(zip("xyz", t.tolist(), strict=True)), "orientation": q}
    check(read_pose(written(tmp_path, {"header": {"frame_id": "camera"}, "pose": pose})), "m")
    check(
        read_pose(
            written(tmp_path, {"header": {}, "pose": {"pose": pose, "covariance": [0.0] * 36}})
        ),
        "m",
    )
    raises(
        InvalidInputError,
        "expected position and orientation",
        read_pose,
        written(tmp_path, {"header": {}, "pose": [1]}),
    )


def test_opengl_poses_look_along_minus_z(tmp_path):
    flipped = np.diag([1.0, -1.0, -1.0, 1.0]) @ T
    check(read_pose(written(tmp_path, flipped.tolist()), convention="opengl"))


def test_what_is_no_pose_is_refused(tmp_path):
    for content, words in (
        ({"rotation": R.tolist(), "translation": None}, "register with a camera first"),
        (
            {"frame": "world", "rotation": R.tolist(), "translation": [0, 0, 1]},
            "whose pose is in the world",
        ),
        ({"T": (2 * T).tolist()}, "a last row of 0 0 0 1"),
        ({"T": np.diag([2.0, 1, 1, 1]).tolist()}, "rigid"),
        (
            {"rotation": [1.0, 0, 0, 0], "translation": [0, 0, 1]},
            "rotation: expected 9 finite numbers",
        ),
        ({"quaternion": [0, 0, 0, 1], "translation": [0, 0, 1]}, "no rotation of 3 x 3 numbers"),
        ({"rotation": R.tolist()}, "no translation; expected JSON"),
        ([], "expected JSON with rotation and translation, or T_cam_from_model"),
        ("text", "expected JSON with rotation"),
    ):
        raises(
            InvalidInputError,
            re.escape("pose.json: ") + ".*" + words,
            read_pose,
            written(tmp_path, content),
        )
    raises(MissingFileError, r"lost\.json:3: no such file", read_pose, tmp_path / "lost.json:3")


@pytest.mark.parametrize(
    "keys",
    [
        {"schema": 3, "views": 9, "top": [{"rotation": np.eye(3).tolist()}], "none": 0.1},
        {"schema": 4, "frame": "camera", "bank_views": 9, "hypotheses": [{"rotation": 1}]},
    ],
    ids=["schema 3", "schema 4"],
)
def test_results_of_both_schemas_are_start_poses(tmp_path, keys):
    pose = {"rotation": R.tolist(), "translation": t.tolist(), "confidence": 0.8}
    check(read_pose(written(tmp_path, {**keys, **pose})), confidence=0.8)


def test_poses_in_the_world_are_no_start_poses(tmp_path):
    pose = {"rotation": R.tolist(), "translation": t.tolist(), "frame": "world"}
    raises(InvalidInputError, "as in 'photographs'", read_pose, written(tmp_path, pose))

import math

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from curvireg_torch import geometry as g
from tests._support import double, eye, refused
from tests._support.poses import poses


def test_opengl_cameras_look_backward_with_y_up():
    T = poses(7, 0)
    flipped = torch.diag(double([1.0, -1.0, -1.0, 1.0])) @ T
    assert torch.equal(g.opengl_from_opencv(T), flipped)
    assert torch.equal(g.opencv_from_opengl(flipped), T)


def test_rotation_from_viewpoint_agrees_with_the_definition_of_pascal3d():
    # p = diag(f, f, -1) Rx(e - 90) Rz(-a) (X - C), rotated by theta; v = py - y.
    X = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    for a, e, t, d in ((30.0, 20.0, -10.0, 5.0), (200.0, -35.0, 100.0, 4.0), (0.0, 0.0, 0.0, 9.0)):
        (ca, ce, ct), (sa, se, st) = (f(np.radians([a, e, t])) for f in (np.cos, np.sin))
        C = d * np.array([ce * sa, -ce * ca, se])
        camera = Rotation.from_euler("zx", [-a, e - 90.0], degrees=True)
        p = camera.apply(X - C) * [3000.0, 3000.0, -1.0]
        xy = p[:, :2] / p[:, 2:] @ [[ct, st], [-st, ct]]
        R = g.rotation_from_viewpoint(a, e, t)
        T = g.transform(R, double([0.0, 0.0, d]))
        K = g.camera_matrix(3000.0, 3000.0, 70.3, 51.8)
        ours = g.project_points(torch.from_numpy(X), T, K)
        assert_allclose(ours, [70.3, 51.8] + xy * [1.0, -1.0], atol=1e-8)
        back = [float(v) for v in g.viewpoint_from_rotation(R)]
        assert_allclose(back, (a, e, t), atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-8, 1e-4, 1.0, math.pi - 1e-4, math.pi - 1e-8, math.pi])
def test_axis_angle_agrees_with_scipy(angle):
    axes = np.random.default_rng(0).normal(size=(40, 3))
    vectors = axes / np.linalg.norm(axes, axis=1, keepdims=True) * angle
    R = Rotation.from_rotvec(vectors).as_matrix()
    ours = g.rotation_from_axis_angle(torch.from_numpy(vectors))
    assert_allclose(ours, R, atol=1e-14)
    back = g.axis_angle_from_rotation(torch.from_numpy(R))
    assert_allclose(g.rotation_from_axis_angle(back), R, atol=1e-14)
    assert back.norm(dim=1).max() <= math.pi + 1e-12
    with torch.autocast("cpu", dtype=torch.bfloat16):
        single = g.rotation_from_axis_angle(torch.from_numpy(vectors).float())
    assert_allclose(single, R, atol=2e-6)


AXIS = [1.0, 2.0, -2.0]
OFFSET = [10.0, -4.0, 3.0]
CONTINUOUS = {"symmetries_continuous": [{"axis": AXIS, "offset": OFFSET}]}
# about the vertical line through (4, 3)
HALF_TURN = [-1, 0, 0, 8, 0, -1, 0, 6, 0, 0, 1, 0, 0, 0, 0, 1]


def test_symmetry_transforms_reads_matrices_and_axes_and_refuses_malformed_input():
    assert torch.equal(g.symmetry_transforms({"diameter": 3.0}), eye(4)[None])
    transforms = g.symmetry_transforms({"symmetries_discrete": [HALF_TURN]})
    assert transforms.shape == (2, 4, 4)
    np.testing.assert_array_equal(transforms[1], np.reshape(HALF_TURN, (4, 4)))
    assert_allclose(transforms[1] @ double([4.0, 3.0, 7.0, 1.0]), [4.0, 3.0, 7.0, 1.0])
    for info, step, match in (
        ({"symmetries_discrete": [[1.0] * 12]}, 0.1, "expected 16"),
        ({"symmetries_continuous": [{"axis": [0, 0, 0], "offset": [0, 0, 0]}]}, 0.1, "length > 0"),
        *[({}, step, "max_step_fraction") for step in (0.0, 1.5, -0.1)],
    ):
        with refused(match):
            g.symmetry_transforms(info, max_step_fraction=step)
    transforms = g.symmetry_transforms(CONTINUOUS, max_step_fraction=0.1).numpy()
    assert len(transforms) == 32  # ceil(pi / 0.1)
    unit = np.array(AXIS) / 3.0
    turns = Rotation.from_rotvec(np.outer(np.arange(32) * 2 * np.pi / 32, unit)).as_matrix()
    assert_allclose(transforms[:, :3, :3], turns, atol=1e-12)
    on_axis = np.transpose(OFFSET + np.outer([-5.0, 0.0, 2.0], unit))
    moved = turns @ on_axis + transforms[:, :3, 3:]
    assert_allclose(moved, np.broadcast_to(on_axis, moved.shape), atol=1e-12)

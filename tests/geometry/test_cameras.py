import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from curvireg_torch import geometry as g

K = torch.tensor([[240.0, 0.0, 70.3], [0, 260.0, 51.8], [0, 0, 1]], dtype=torch.float64)


def test_camera_matrix_by_hand() -> None:
    assert g.camera_matrix(1.0, 2.0, 3.0, 4.0).tolist() == [[1, 0, 3], [0, 2, 4], [0, 0, 1]]
    assert g.camera_matrix(1.0, 2.0, 3.0, 4.0).dtype == torch.float64
    assert g.camera_matrix(1.0, 2.0, 3.0, 4.0, dtype=torch.float32).dtype == torch.float32


def test_transform_joins_rotation_and_translation() -> None:
    R = torch.arange(18.0).view(2, 3, 3)
    t = torch.arange(6.0).view(2, 3) + 100.0
    T = g.transform(R, t)
    assert torch.equal(T[:, :3], torch.cat([R, t[..., None]], -1))
    assert T[:, 3].tolist() == [[0, 0, 0, 1]] * 2


def test_project_points_agrees_with_opencv() -> None:
    X = np.random.default_rng(0).uniform(-1, 1, (40, 3))
    rotation, t = np.array([0.3, -0.8, 0.2]), np.array([0.2, -0.1, 5.0])
    expected = cv2.projectPoints(X, rotation, t, K.numpy(), None)[0][:, 0]
    T = g.transform(torch.from_numpy(Rotation.from_rotvec(rotation).as_matrix()), torch.from_numpy(t))
    ours = g.project_points(torch.from_numpy(X), T, K)
    np.testing.assert_allclose(ours, expected, atol=1e-9)
    box = g.projected_boxes(torch.from_numpy(X), T, K)
    np.testing.assert_allclose(box, [*expected.min(0), *expected.max(0)], atol=1e-9)


def test_project_points_orthographic_ignores_depth() -> None:
    X = torch.tensor([[1.0, 2.0, 3.0], [1.0, 2.0, 30.0]], dtype=torch.float64)
    uv = g.project_points(X, torch.eye(4, dtype=torch.float64), K, orthographic=True)
    expected = torch.tensor([240.0 + 70.3, 520.0 + 51.8], dtype=torch.float64)
    torch.testing.assert_close(uv, expected.expand(2, 2))
    box = g.projected_boxes(X, torch.eye(4, dtype=torch.float64), K, orthographic=True)
    torch.testing.assert_close(box, expected.repeat(2))

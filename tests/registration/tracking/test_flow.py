"""Tracked points: corners on the surface, their flow in moved pictures, and poses from them."""

import numpy as np
import pytest
import torch
import trimesh

from curvireg_torch.geometry.cameras import transform
from curvireg_torch.registration.contours.descent import apply_twist, pixels
from curvireg_torch.registration.tracking.flow import (
    Flow,
    flow_equations,
    flow_share,
    make_keyframe,
    pose_from_flow,
    track_points,
)
from curvireg_torch.registration.tracking.window import SIZE, Window
from curvireg_torch.rendering import make_renderer

K = torch.tensor([[[400.0, 0, 127.5], [0, 400.0, 127.5], [0, 0, 1]]], dtype=torch.float64)
CENTRE = torch.zeros(3, dtype=torch.float64)


def plate(x: float = 0.0, y: float = 0.0):
    """A plate with a print, 160 px wide, moved in its plane by (x, y): its window, pose, and depth."""
    T = transform(torch.eye(3, dtype=torch.float64), torch.tensor([x, y, 5.0], dtype=torch.float64))[None]
    depth = make_renderer(trimesh.creation.box((2.0, 2.0, 0.01))).render(T, K, (SIZE, SIZE))
    smooth = torch.nn.functional.interpolate(
        torch.rand(1, 1, 64, 64, generator=torch.Generator().manual_seed(0)), size=1024, mode="bicubic"
    )[0, 0]
    v, u = torch.meshgrid(torch.arange(256.0), torch.arange(256.0), indexing="ij")
    shift = 80.0 * torch.tensor([x, y])
    look = smooth[(v - shift[1] + 300).long(), (u - shift[0] + 300).long()]  # shifts of whole pixels
    grey = (255 * torch.where(depth[0, 0] > 0, look, 0.5)).clamp(0, 255).byte().numpy()
    return Window(torch.zeros(1, 3, SIZE, SIZE), grey, K), T, depth


def test_corners_lie_on_the_surface_inside_the_outline():
    window, T, depth = plate()
    keyframe = make_keyframe(window, T, depth)
    assert len(keyframe.uv) > 50
    assert np.abs(keyframe.uv - 127.5).max() < 80 - 2
    assert torch.allclose(
        keyframe.model[..., 2], torch.full((1, len(keyframe.uv)), -0.005, dtype=torch.float64), atol=1e-5
    )
    again = pixels(keyframe.model, T, K, CENTRE)[0].numpy()
    assert np.abs(again - keyframe.uv).max() < 1e-3


def test_flow_finds_the_corners_of_a_moved_plate_and_their_pose():
    window, T, depth = plate()
    moved, truth, _ = plate(0.15, -0.1)  # 12 px and -8 px
    keyframe = make_keyframe(window, T, depth)
    flow = track_points(keyframe, moved, T, CENTRE, levels=3)
    assert flow.uv.shape[1] > 0.8 * flow.corners
    error = (flow.uv - pixels(flow.model, truth, K, CENTRE)).norm(dim=-1)
    assert float(error.median()) < 0.1
    found = pose_from_flow(flow, T, K, CENTRE)
    assert torch.allclose(found, truth, atol=5e-3)
    assert flow_share(flow, truth, K, CENTRE) > 0.8
    assert flow_share(flow, T, K, CENTRE) < 0.05  # 14 px beside


def test_uniform_surface_has_no_corners_and_no_flow():
    window, T, depth = plate()
    bare = Window(window.colours, np.full_like(window.grey, 90), K)
    keyframe = make_keyframe(bare, T, depth)
    flow = track_points(keyframe, window, T, CENTRE, levels=1)
    assert (flow.corners, flow.uv.shape) == (0, (1, 0, 2))
    assert flow_share(flow, T, K, CENTRE) == 0.0
    assert torch.equal(pose_from_flow(flow, T, K, CENTRE), T)


def test_flow_moves_to_another_window():
    points = torch.rand(1, 5, 3, dtype=torch.float64) - 0.5
    T = plate()[1]
    other = torch.tensor([[[600.0, 0, 90.0], [0, 600.0, 20.0], [0, 0, 1]]], dtype=torch.float64)
    moved = Flow(points, pixels(points, T, K, CENTRE), 5).moved(K, other)
    assert torch.allclose(moved.uv, pixels(points, T, other, CENTRE))


def test_equations_are_those_of_least_squares():
    points = torch.rand(1, 30, 3, dtype=torch.float64) - 0.5
    T = plate()[1]
    twist = torch.tensor([[1e-4, -2e-4, 1e-4, 3e-4, -1e-4, 2e-4]], dtype=torch.float64)
    uv = pixels(points, apply_twist(T, twist, CENTRE), K, CENTRE)
    A, b = flow_equations(Flow(points, uv, 30), T, K, CENTRE)
    assert torch.linalg.solve(A, b)[0].tolist() == pytest.approx(twist[0].tolist(), abs=2e-6)

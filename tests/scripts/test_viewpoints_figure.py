"""The picture of viewpoints agrees with the library."""

import pytest
import torch

from curvireg_torch.geometry import rotation_from_viewpoint
from curvireg_torch.geometry.pose_prior import object_frame
from scripts.viewpoints_figure import FRONTS, axes_from_above, viewpoints_figure


@pytest.mark.parametrize(("up", "front"), [(up, front) for up, fronts in FRONTS.items() for front in fronts])
def test_axes_from_above_point_at_the_cameras_of_their_azimuths(up, front):
    places = {(0.0, -1.0): 0.0, (1.0, 0.0): 90.0, (0.0, 1.0): 180.0, (-1.0, 0.0): 270.0}
    axes = axes_from_above(up, front)
    assert sorted([*axes, up]) == ["x", "y", "z"]
    for name, place in axes.items():
        R = rotation_from_viewpoint(*torch.tensor([places[place], 0.0, 0.0], dtype=torch.float64))
        towards_camera = object_frame(up, front).T @ R.T @ torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
        assert towards_camera["xyz".index(name)] == pytest.approx(1.0)
    assert axes[front[-1]] == ((0.0, 1.0) if "-" in front else (0.0, -1.0))


def test_viewpoints_figure_can_be_drawn(tmp_path):
    viewpoints_figure().savefig(tmp_path / "viewpoints.png", dpi=20)
    assert (tmp_path / "viewpoints.png").stat().st_size > 1000

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from curvireg_torch.geometry import Camera, project_points
from curvireg_torch.synthetic import example_mesh
from curvireg_torch.visualization import sheet
from curvireg_torch.visualization.contours import close_up
from tests._support import CAMERA, SIZE, scene, truck_registrar


@pytest.mark.parametrize("scale", [1, 4])
def test_thumbnail_draws_contours_on_the_object(scale):
    """The outline is the projection of the mesh after crop and resize."""
    _, box, T = scene(1)
    edges = ((box + 0.5) * scale - 0.5).tolist()
    H, W = SIZE
    K = Camera(CAMERA, size=SIZE).at((H * scale, W * scale)).matrix
    grey = torch.full((3, H * scale, W * scale), 100, dtype=torch.uint8)
    describer = truck_registrar().describer
    jpeg = sheet.thumbnail(describer, (T, K), grey, edges)
    pixels = cv2.imdecode(np.frombuffer(jpeg, np.uint8), 1)
    y, x = np.nonzero(pixels[..., 1].astype(int) - pixels[..., 2] > 60)  # the outline's green
    assert len(x) > 50
    # Project the vertices into the thumbnail.
    vertices = torch.as_tensor(example_mesh().vertices)
    uv = project_points(vertices, T[None], K)[0]
    left, top, right, _ = close_up(grey.shape[-2:], edges)
    shrink = pixels.shape[1] / (right - left)
    expected = [
        (v + 0.5 - start) * shrink - 0.5 for v, start in zip(uv.T, (left, top), strict=True)
    ]
    for drawn, projected in zip((x, y), expected, strict=True):
        # The box is drawn over the outermost pixels.
        assert abs(drawn.min() - float(projected.min())) <= 3
        assert abs(drawn.max() - float(projected.max())) <= 3


def test_write_sheet_shows_the_best_and_the_worst(tmp_path):
    entry = sheet.SheetEntry(
        number=0, name="a.png", caption="", kind="unsure", picture=tmp_path / "none.jpg"
    )
    rows = [replace(entry, number=k) for k in range(7, 0, -1)]
    sheet.write_sheet(tmp_path / "index.html", "7 photographs", rows, table="results.csv", each=2)
    page = (tmp_path / "index.html").read_text()
    assert [int(n) for n in re.findall(r"<b>(\d+)</b>", page)] == [7, 6, 2, 1]
    assert "The 2 best, then the 2 worst; results.csv has them all" in page

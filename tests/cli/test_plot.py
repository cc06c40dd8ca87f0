"""``curvireg plot``."""

import cv2
import pytest

from curvireg_torch.cli import main
from tests.viewer.test_session import write_scene


@pytest.mark.parametrize("kind", ["overlay", "fields", "viewpoints"])
def test_plot_draws_a_registration(tmp_path, monkeypatch, kind):
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path / "cache"))
    box, _ = write_scene(tmp_path)
    words = ["--pipeline", str(tmp_path / "small.json"), "--quiet", "--box", *map(str, box)]
    out = tmp_path / f"{kind}.png"
    assert (
        main(["plot", kind, str(tmp_path / "photo.png"), str(tmp_path / "truck.ply"), "--out", str(out), *words]) == 0
    )
    assert cv2.imread(str(out)).std() > 10

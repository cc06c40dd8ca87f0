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


def test_plot_refuses_other_formats(tmp_path, refused):
    words = ["plot", "overlay", "photo.png", "truck.ply", "--out"]
    refused(main([*words, str(tmp_path / "a.txt")]), "no such file", "photo.png")
    for name in words[2:4]:
        (tmp_path / name).write_text("")
    words[2:4] = [str(tmp_path / name) for name in words[2:4]]
    refused(main([*words, str(tmp_path / "a.txt")]), "expected a name that ends in .png, .svg, .pdf")

import itertools
import json
import re
import threading
import time
import urllib.error
import urllib.request
import webbrowser
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
import torch

pytest.importorskip("nicegui", reason="nicegui is not installed")

from curvireg_torch.cli import main
from curvireg_torch.errors import LostObjectError
from curvireg_torch.registration import FailedRegistration, Follower
from curvireg_torch.viewer.live import LivePage
from curvireg_torch.visualization.contours import OUTLINE
from tests._support import bytes_bgr, learned_registrar, sequence
from tests._support.lists import CAMERA


def camera(frames, taken):
    """Delivers the frames of a sequence, each once the one before was taken."""
    numbers = itertools.count()

    def read():
        number = next(numbers)
        while len(taken) < number:
            time.sleep(0.01)
        return (True, frames[number]) if number < len(frames) else (False, None)

    return SimpleNamespace(
        isOpened=lambda: True, get=lambda _: 0.0, release=lambda: None, read=read
    )


def test_a_frame_is_drawn_once_the_one_before_is_with_a_browser():
    page = LivePage(learned_registrar())
    result = FailedRegistration(LostObjectError("gone"))
    grey = torch.full((3, 60, 120), 0.5)
    page.show(None, result)
    assert page.number == 0, "it could not be read"
    for level, number in ((0.5, 1), (0.1, 1), (0.2, 1)):
        page.show(torch.full_like(grey, level), result)
        assert (page.number, page.ratio) == (number, 2.0)
    picture = cv2.imdecode(np.frombuffer(page._send().body, np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (60, 120, 3)
    assert abs(int(picture[50, 60, 0]) - 128) < 5, "the first one"
    page.show(torch.full_like(grey, 0.9), result)
    assert page.number == 2


@pytest.mark.slow
def test_the_page_shows_each_pose_until_ctrl_c(tmp_path, monkeypatch, capsys):
    scenes = sequence(4)
    learned_registrar().bank.save(tmp_path / "truck.safetensors")
    pictures = [bytes_bgr(image) for image, _, _ in scenes]
    seen = []
    pages = []
    threads = []
    call = Follower.__call__

    def watch(address):
        with urllib.request.urlopen(address) as answer:
            pages.append(
                (address, answer.read().decode(), answer.headers["content-security-policy"])
            )
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(
                urllib.request.Request(address, headers={"Origin": "http://evil.example"})
            )
        while len(seen) < 3:
            picture = urllib.request.urlopen(f"{address}frame").read()
            if picture and picture not in seen:
                seen.append(picture)

    def interrupted(self, *arguments):
        if len(seen) == 3:
            raise KeyboardInterrupt
        return call(self, *arguments)

    def open_browser(page):
        (address,) = {*re.findall(r"http://[^\"]+", Path(urlsplit(page).path).read_text())}
        threads.append(threading.Thread(target=watch, args=(address,)))
        threads[0].start()

    monkeypatch.setattr(webbrowser, "open", open_browser)
    monkeypatch.setattr(Follower, "__call__", interrupted)
    monkeypatch.setattr(cv2, "VideoCapture", lambda _: camera(pictures, seen))
    box = map(str, scenes[0][1].tolist())
    words = ["follow", "0", str(tmp_path / "truck.safetensors"), "--camera", *map(str, CAMERA)]
    assert main([*words, "--box", *box, "--show", "--json"]) == 0
    threads[0].join(10)
    printed = capsys.readouterr()
    assert [json.loads(line)["frame"] for line in printed.out.splitlines()] == [
        f"frame-00000{k}" for k in range(3)
    ]
    assert "3 frames: 3 reliable" in printed.err
    ((address, page, policy),) = pages
    assert address in printed.err
    assert "live" in page
    assert policy.startswith("default-src 'none'")
    for picture in seen:
        pixels = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(
            int
        )
        assert pixels.shape == (180, 240, 3)
        assert (np.abs(pixels - OUTLINE).sum(axis=2) < 120).sum() > 50, "the outline"
    with pytest.raises(urllib.error.URLError):  # it has ended
        urllib.request.urlopen(address, timeout=5)

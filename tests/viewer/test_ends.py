"""How the page begins and ends: its address is no argument of the browser, and no signal leaves the
uploads behind."""

import os
import re
import signal
import sys
import time
import urllib.request

import pytest

pytest.importorskip("nicegui", reason="nicegui is not installed")

from tests._support import scene, write_photo
from tests.viewer.conftest import started

BROWSER = """#!/bin/sh
printf '%s' "$*" > "$SEEN.new"
mv "$SEEN.new" "$SEEN"
"""


@pytest.mark.slow  # tests/viewer/test_server.py ends one by SIGINT
@pytest.mark.skipif(os.name != "posix", reason="POSIX signals")
@pytest.mark.parametrize(
    ("host", "number"), [("::1", signal.SIGHUP), ("127.0.0.1", signal.SIGTERM)]
)
def test_a_signal_removes_the_uploads_and_no_program_is_told_the_address(tmp_path, host, number):
    browser = tmp_path / "browser"
    browser.write_text(BROWSER)
    browser.chmod(0o700)
    seen = tmp_path / "seen"
    command = [sys.executable, "-m", "curvireg_torch", "view", "--host", host]
    before = signal.signal(number, signal.SIG_DFL)  # a process below nohup inherits that it ignores
    try:
        process = started(command, tmp_path, BROWSER=f"{browser} %s", SEEN=str(seen))
    finally:
        signal.signal(number, before)
    try:
        address = re.search(r"http://\S+", process.stdout.readline())[0]
        deadline = time.monotonic() + 60
        while not seen.is_file():
            assert time.monotonic() < deadline
            time.sleep(0.05)
        (page,) = tmp_path.glob("curvireg-view-*/*.html")
        assert seen.read_text() == page.as_uri()
        assert page.stat().st_mode & 0o777 == 0o600
        assert page.parent.stat().st_mode & 0o777 == 0o700
        assert re.findall(r"http://[^\"<]+", page.read_text()) == [address, address]
        with urllib.request.urlopen(address) as answer:
            assert answer.status == 200
        write_photo(tmp_path / "a.png", scene(0)[0])
        content = (tmp_path / "a.png").read_bytes()
        upload = urllib.request.Request(f"{address}upload", content, {"x-file-name": "a.png"})
        with urllib.request.urlopen(upload) as answer:
            assert answer.status == 204
        assert list(tmp_path.glob("curvireg-view-*/upload-*/a.png"))
        process.send_signal(number)
        process.wait(20)
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
    assert not list(tmp_path.glob("curvireg-view-*"))
    assert (tmp_path / "log").read_text() == ""

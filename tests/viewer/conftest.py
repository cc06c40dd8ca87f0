import os
import re
import shutil
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest

from curvireg_torch.jobs.options import RegisterOptions
from curvireg_torch.viewer.workspace import Workspace
from tests._support.exif import exif, with_exif
from tests.viewer.browser import Browser, wait_for
from tests.viewer.test_session import new_session, write_scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("browser")
    write_scene(folder)
    with_exif(folder / "photo.png", exif(1, 37))
    (folder / "broken.png").write_bytes((folder / "photo.png").read_bytes()[:3000])
    (folder / "hostile.obj").write_text("v 0 0 0\nv 1 0 nan\nv 0 1 0\nf 1 2 3\n")
    return folder


@pytest.fixture(scope="module")
def address(folder):
    """Address of a viewer that was started without a photograph."""
    with running([sys.executable, "-m", "curvireg_torch", "view", "--no-browser"], folder) as found:
        yield found


def started(command, folder, **more):
    """A process whose errors go to the file ``log`` of a folder, below which its own files lie."""
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith("PYTEST")
    }
    environment |= {"CURVIREG_CACHE": str(folder / "cache"), "PYTHONPATH": str(Path.cwd())}
    environment |= {"TMPDIR": str(folder), **more}
    with (folder / "log").open("w") as log:
        pipes = {"stdout": subprocess.PIPE, "stderr": log, "text": True, "bufsize": 1}
        return subprocess.Popen(command, cwd=folder, env=environment, **pipes)


@contextmanager
def running(command, folder):
    """Address of a viewer that a command starts, which ends without an error."""
    (folder / "temporary").mkdir()
    server = started(command, folder, TMPDIR=str(folder / "temporary"))
    try:
        line = server.stdout.readline()
        assert "http://127.0.0.1:" in line, (folder / "log").read_text()
        address = re.search(r"http://\S+", line)[0]
        wait_for(address)
        yield address
    finally:
        server.send_signal(signal.SIGINT)
        try:
            server.wait(20)
        except subprocess.TimeoutExpired:
            server.kill()
            server.wait()
        server.stdout.close()
    # one test sends it
    log = (folder / "log").read_text().replace("WARNING:  Invalid HTTP request received.\n", "")
    assert (server.returncode, log) == (0, "")
    assert not list((folder / "temporary").glob("curvireg-view-*")), "the server removes its folder"


@pytest.fixture(scope="module")
def browser(folder, address):
    browser = Browser(folder, address)
    yield browser
    errors = [entry for entry in browser.driver.get_log("browser") if entry["level"] == "SEVERE"]
    browser.driver.quit()
    assert not errors


@pytest.fixture(scope="package")
def registered(tmp_path_factory):
    """A session with a result, its folder and the true pose."""
    folder = tmp_path_factory.mktemp("viewer")
    box, T = write_scene(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CURVIREG_CACHE", str(folder / "cache"))
        session = new_session("--pipeline", str(folder / "small.json"))
        shutil.copy(folder / "photo.png", folder / "my photo.png")
        session.open_photo(folder / "my photo.png").set_box(tuple(round(v, 1) for v in box))
        session.open_mesh(folder / "truck.ply")
        session.set_camera((260.0, 260.0, 119.5, 89.5))
        session.register()
        yield session, folder, T


@pytest.fixture
def session(registered):
    """The session at its first hypothesis; its options, photographs and result are restored
    afterwards."""
    session = registered[0]
    shot = session.shot
    kept = dict(vars(session.shot))
    options = session.options
    shot.choose(0)
    yield session
    vars(shot).update(kept)
    session.options = options
    session.shots = [shot]
    session.shot = shot


@pytest.fixture
def scene(tmp_path):
    """A folder with a scene."""
    write_scene(tmp_path)
    return tmp_path


@pytest.fixture
def workspace(tmp_path):
    (tmp_path / "uploads").mkdir()
    return Workspace(RegisterOptions(), tmp_path / "uploads")

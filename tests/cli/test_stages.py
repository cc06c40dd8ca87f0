"""Progress of a single registration on a terminal."""

import io
import time
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from curvireg_torch.cli import stages
from curvireg_torch.cli.stages import show_stages


@pytest.fixture
def terminal(monkeypatch):
    """Standard error, as a terminal whose line is updated at once."""
    screen = io.StringIO()
    monkeypatch.setattr(screen, "isatty", lambda: True)
    monkeypatch.setattr(stages, "sys", SimpleNamespace(stderr=screen))
    monkeypatch.setattr(stages, "INTERVAL", 0.01)
    return screen


def wait_for(text, terminal):
    deadline = time.monotonic() + 20.0
    while text not in terminal.getvalue():
        assert time.monotonic() < deadline, terminal.getvalue()
        time.sleep(0.01)


def test_show_stages_shows_stage_count_and_seconds(terminal):
    with show_stages(enabled=True) as report:
        report("bank", 20, 288)
        wait_for("rendering views 20 of 288, 0 s", terminal)
        report("detection", 0, 1)
        wait_for("detecting the object, 1 s", terminal)
    assert terminal.getvalue().endswith("\r\033[K")


def test_show_stages_removes_its_line_after_an_error(terminal):
    def interrupted():
        with show_stages(enabled=True) as report:
            report("search", 0, 1)
            wait_for("search, 0 s", terminal)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert terminal.getvalue().endswith("\r\033[K")


def test_show_stages_shows_nothing_in_a_file_or_if_disabled(terminal):
    with show_stages(enabled=False) as report:
        assert report is None
    terminal.isatty = Mock(return_value=False)
    with show_stages(enabled=True) as report:
        assert report is None
    assert terminal.getvalue() == ""

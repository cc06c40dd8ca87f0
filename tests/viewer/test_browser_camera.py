"""The camera of the page as people type it, on a server that takes its time."""

import sys

import pytest

from tests.viewer.browser import MISSING
from tests.viewer.conftest import running

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(bool(MISSING), reason=f"not installed: {', '.join(MISSING)}"),
]

SLOW = """
import sys, time
from curvireg_torch.viewer.session import Session

def slowed(method, seconds):
    def call(*given, **options):
        time.sleep(seconds)
        return method(*given, **options)
    return call

Session.set_camera = slowed(Session.set_camera, 1.0)
Session.request = slowed(Session.request, 0.03)
sys.argv = ["curvireg", "view", "--no-browser"]
from curvireg_torch.__main__ import start
start()
"""


@pytest.fixture(scope="module")
def address(folder):
    with running([sys.executable, "-c", SLOW], folder) as found:
        yield found


def clear(browser, name):
    from selenium.webdriver import Keys

    browser.part(name).send_keys(Keys.CONTROL, "a")
    browser.part(name).send_keys(Keys.DELETE)


def test_the_camera_that_is_typed_is_the_camera_that_is_used(browser, folder):
    browser.emulate(1280, 800)
    browser.drop(folder / "photo.png", folder / "truck.ply")
    browser.begins("photograph-facts", "photo.png: ")
    browser.begins("mesh-facts", "truck.ply: ")
    browser.unfold("camera")
    browser.unfold("command-line")
    typed = "260,5 260,5 119,5 89,5"
    browser.part("camera").send_keys(typed)
    browser.part("camera").send_keys("\n")
    browser.contains("command", "--camera 260.5 260.5 119.5 89.5")
    assert browser.text("camera") == typed, "nothing is written where one types"
    browser.part("fov").click()
    clear(browser, "camera")
    browser.part("fov").send_keys("65\n")  # leaves the other field, which is sent empty
    browser.contains("command", "--fov 65 ")
    browser.part("register").send_keys("")
    clear(browser, "fov")
    browser.part("fov").send_keys("\n")
    browser.contains("command", "--fov", 0)
    browser.part("camera").send_keys("260 260 119,5 89,5")
    browser.register()  # at once
    assert browser.text("used-camera") == "camera: 260 260 119.5 89.5 px, as given"

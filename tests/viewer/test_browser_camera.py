"""The camera of the page as people type it, on a server that takes its time."""

import json
import sys

import pytest

from tests.viewer.browser import MISSING, Browser
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


@pytest.fixture(scope="module")
def browser(folder, address):
    browser = Browser(folder, address)
    yield browser
    errors = [entry for entry in browser.driver.get_log("browser") if entry["level"] == "SEVERE"]
    browser.driver.quit()
    assert not errors


def clear(browser, name):
    from selenium.webdriver import Keys

    browser.part(name).send_keys(Keys.CONTROL, "a")
    browser.part(name).send_keys(Keys.DELETE)


def test_the_camera_that_is_typed_is_the_camera_that_is_used(browser, folder):
    browser.emulate(1280, 800)
    browser.drop(folder / "photo.png", folder / "truck.ply")
    browser.wait(lambda: browser.text("photograph-facts").startswith("photo.png: "), "photograph")
    browser.wait(lambda: browser.text("mesh-facts").startswith("truck.ply: "), "mesh")
    browser.unfold("camera")
    browser.unfold("command-line")
    for typed in ("260.5 260.5 119.5 89.5", "260,5 260,5 119,5 89,5", "260.5, 260.5, 119.5, 89.5"):
        browser.part("camera").send_keys(typed)
        assert "--fov" not in browser.text("command")
        browser.part("camera").send_keys("\n")
        browser.wait(lambda: "--camera 260.5 260.5 119.5 89.5" in browser.text("command"), typed)
        assert browser.text("camera") == typed, "nothing is written where one types"
        browser.part("fov").click()
        clear(browser, "camera")
        browser.part("fov").send_keys("65\n")  # leaves the other field, which is sent empty
        browser.wait(lambda: "--fov 65 " in browser.text("command"), "field of view")
        browser.part("register").send_keys("")
        clear(browser, "fov")
        browser.part("fov").send_keys("\n")
        browser.wait(lambda: "--fov" not in browser.text("command"), "no camera")
    calibration = {
        "camera_matrix": [300, 0, 319.5, 0, 300, 89.5, 0, 0, 1],
        "image_size": [640, 180],
    }
    (folder / "cam.json").write_text(json.dumps(calibration))
    browser.part("camera").send_keys("260 260 119.5 89.5")
    browser.click("mode-box")
    browser.wait(lambda: "--camera 260 260" in browser.text("command"), "by leaving the field")
    browser.drop(folder / "cam.json")
    browser.wait(lambda: browser.text("message-camera"), "refused")
    assert "calibrated for 640 x 180 px" in browser.text("message-camera")
    assert "--camera 260 260 119.5 89.5" in browser.text("command"), "the former one stays"
    browser.click("mode-box")
    browser.part("camera").clear()
    browser.part("camera").send_keys("260 260 119,5 89,5")
    browser.click("register")  # at once
    browser.wait(lambda: browser.text("progress") == "done", "result")
    assert browser.text("used-camera") == "camera: 260 260 119.5 89.5 px, as given"

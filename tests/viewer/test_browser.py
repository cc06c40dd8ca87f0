"""The viewer in a headless browser."""

import json

import pytest

from tests.viewer.browser import MISSING
from tests.viewer.test_session import run_command

OPTIONS = ["--pipeline", "small.json"]  # of the command that starts the viewer

pytestmark = [pytest.mark.browser, pytest.mark.skipif(bool(MISSING), reason=f"not installed: {', '.join(MISSING)}")]


def test_page_from_upload_to_download(browser, folder):
    browser.upload("photograph", folder / "photo.png")
    browser.wait(lambda: browser.text("photograph-facts") == "photo.png: 240 x 180 px", "photograph")
    browser.unfold("camera")
    browser.unfold("command-line")
    assert browser.text("camera-facts").startswith("unknown")
    browser.part("camera").send_keys("65")
    browser.wait(lambda: browser.text("camera-facts").startswith("guessed from the field of view"), "field of view")
    browser.wait(lambda: "--fov 65" in browser.text("command"), "command")
    browser.click("exif")
    browser.wait(lambda: browser.text("camera") == "", "field of view cleared")
    caption = "guessed from the photograph's EXIF, 37 mm of a 35 mm camera: no covariance"
    browser.wait(lambda: browser.text("camera-facts") == caption, "EXIF")
    assert browser.part("register").get_attribute("disabled")
    browser.upload("mesh", folder / "truck.ply")
    browser.wait(lambda: browser.text("mesh-facts").startswith("truck.ply: 968 faces"), "mesh")
    browser.wait(lambda: browser.part("photograph").size["height"] > 300, "a large photograph")

    # Draw a rough box, then correct one edge.
    x0, y0, x1, y1 = json.loads((folder / "box.json").read_text())
    browser.drag((x0, y0), (x1 + 15, y1), 240)
    browser.wait(lambda: browser.box() == pytest.approx([x0, y0, x1 + 15, y1], abs=0.5), "drawn box")
    browser.drag((x1 + 15, (y0 + y1) / 2), (x1, (y0 + y1) / 2), 240)
    browser.wait(lambda: browser.box() == pytest.approx([x0, y0, x1, y1], abs=0.7), "corrected box")
    drawn = browser.box()

    browser.click("register")
    browser.wait(lambda: browser.text("progress") == "done", "result")
    browser.wait(lambda: "azimuth" in browser.text("facts"), "answer")
    assert browser.text("verdict") in ("likely", "unsure", "no match")
    assert not browser.messages()
    command = browser.text("command")
    document = saved(browser)
    assert document["inputs"]["box"] == pytest.approx(drawn)
    assert document["viewer"]["command"] == command
    assert "--camera exif" in command
    assert "registrar = cr.Registrar(" in browser.text("python")

    # The command line gives the same result to the last digit.
    written = run_command(folder, command)
    for key in ("rotation", "translation", "viewpoint", "score", "confidence", "top", "pipeline"):
        assert document[key] == written[key], key
    assert document["translation"] is not None


def saved(browser):
    """The result.json that the page saves now."""
    browser.click("download-result.json")
    return json.loads(browser.downloaded("result.json"))


def test_the_mesh_over_the_photograph_can_be_made_less_transparent(browser):
    layer = browser.part("photograph").find_elements("css selector", "img")[1]
    browser.wait(lambda: layer.get_attribute("naturalWidth") == "240", "layer")
    assert layer.value_of_css_property("opacity") == "0.35"
    browser.part("mesh").click()  # in the middle
    browser.wait(lambda: 0.45 < float(layer.value_of_css_property("opacity")) < 0.55, "opacity", 20)


def test_the_card_that_is_clicked_is_the_answer_that_is_shown_and_saved(browser):
    first = saved(browser)
    browser.click("answer-2")
    browser.wait(lambda: browser.part("answer-2").get_attribute("aria-pressed") == "true", "chosen")
    assert browser.part("answer-1").get_attribute("aria-pressed") == "false"
    second = saved(browser)
    assert second["rotation"] == first["top"][1]["rotation"] != first["rotation"]
    assert second["viewer"]["hypothesis"] == 1
    for name, start in (("pose.glb", b"glTF"), ("overlay.png", b"\x89PNG")):
        browser.click(f"download-{name.replace('overlay.png', 'picture')}")
        assert browser.downloaded(name).startswith(start)
    browser.click("answer-1")
    browser.wait(lambda: browser.part("answer-1").get_attribute("aria-pressed") == "true", "the first again")
    assert saved(browser)["rotation"] == first["rotation"]


def test_the_pose_is_corrected_on_the_photograph(browser, folder):
    x0, y0, x1, y1 = json.loads((folder / "box.json").read_text())
    middle, before = ((x0 + x1) / 2, (y0 + y1) / 2), saved(browser)
    image = browser.part("photograph")

    def follows():
        moved = pytest.approx([x0 + 12, y0, x1 + 12, y1], abs=4)
        browser.wait(lambda: browser.extent() == moved, "the mesh follows", 20)

    browser.drag(middle, (middle[0] + 12, middle[1]), 240, held=follows)
    browser.wait(lambda: "moved: rotated 0.0 degrees" in browser.text("facts"), "moved")
    assert browser.text("verdict") == "by hand"
    moved = saved(browser)
    shift = (moved["translation"][0] - before["translation"][0]) * 240 * 37 / 43.27 * 1.25 / before["translation"][2]
    assert shift == pytest.approx(12, abs=2)
    browser.drag((5, 5), (25, 5), 240)  # beside the mesh
    browser.wait(lambda: browser.text("facts").count("moved: ") == 2, "turned")
    browser.click("undo")
    browser.wait(lambda: browser.text("facts").count("moved: ") == 1, "undone")
    assert saved(browser)["rotation"] == moved["rotation"]
    scroll(browser, image, 200)
    browser.wait(lambda: browser.text("facts").count("moved: ") == 2, "further away")
    further = saved(browser)
    assert further["translation"][2] > 1.05 * moved["translation"][2]
    browser.click("fit")
    browser.wait(lambda: "contours fitted" in browser.text("facts"), "contours")
    browser.click("answer-1")
    browser.wait(lambda: "moved" not in browser.text("facts"), "as it was found")
    assert saved(browser)["rotation"] == before["rotation"]


def scroll(browser, element, amount):
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.actions.wheel_input import ScrollOrigin

    ActionChains(browser.driver).scroll_from_origin(ScrollOrigin.from_element(element), 0, amount).perform()


def test_without_a_box_the_object_is_found_in_the_whole_photograph(browser, folder):
    browser.click("no-box")
    browser.wait(lambda: browser.text("register") == "Find the object and its pose", "no box")
    browser.wait(lambda: browser.text("progress") == "the inputs have changed since this answer", "outdated")
    browser.click("register")
    browser.wait(lambda: browser.text("progress") == "done", "result without a box")
    assert browser.messages() == []
    assert browser.box() is None
    command = browser.text("command")
    assert "--box" not in command
    document = saved(browser)
    assert document["rotation"] == run_command(folder, command)["rotation"]
    assert document["detection"]["instances"][0]["rotation"] == document["rotation"]
    browser.click("answer-2")
    browser.wait(lambda: browser.part("answer-2").get_attribute("aria-pressed") == "true", "chosen")
    second = saved(browser)
    assert second["detection"]["instances"][0]["rotation"] == second["rotation"] != document["rotation"]

"""The page as people use it: dropped files, mistakes, a reload, keys, small screens, and readers of
screens."""

import json
import re
from pathlib import Path

import pytest

from curvireg_torch.synthetic import demo_scene, example_mesh
from curvireg_torch.visualization.encoding import png, to_uint8
from tests.viewer.browser import MISSING

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(bool(MISSING), reason=f"not installed: {', '.join(MISSING)}"),
]


def saved(browser):
    """The result.json that the page saves now."""
    browser.click("download-result.json")
    return json.loads(browser.downloaded("result.json"))


@pytest.fixture(autouse=True)
def _own_screen(browser):
    """A test that fails leaves no small screen, and none begins scrolled down."""
    yield
    browser.emulate(0, 0)
    browser.script("scrollTo(0, 0)")


def test_the_empty_page_says_what_to_do_and_the_sample_loads_in_one_click(browser):
    assert browser.find("html").get_attribute("lang") == "en-US"
    assert [browser.text(name) for name in ("sample", "register")] == [
        "Try the sample",
        "Find the pose",
    ]
    assert browser.part("register").get_attribute("disabled")
    browser.emulate(1440, 900)
    browser.picture("viewer-empty")
    browser.click("sample")
    browser.begins("photograph-facts", "coffee.jpg: 600 x 400 px")
    assert "CC0" in browser.text("photograph-facts")
    browser.wait(lambda: "done" in browser.part("step-box").get_attribute("class"), "box")
    browser.wait(lambda: not browser.part("register").get_attribute("disabled"), "ready")
    browser.picture("viewer-sample")


def hinted_azimuth(browser):
    """Say that it looks like this; returns the azimuth of the prior."""
    browser.click("looks-like-this")
    browser.begins("prior-facts", "Pose prior: seen from azimuth")
    return float(re.search(r"azimuth ([\d.]+)", browser.text("prior-facts"))[1])


def turn(browser, canvas, dx, dy):
    """Drag from the middle of a scene."""
    drag = browser.mouse().move_to_element(canvas).click_and_hold().move_by_offset(dx, dy)
    drag.release().perform()


def test_the_model_turned_with_the_mouse_is_a_hint(browser):
    browser.emulate(1440, 900)
    browser.unfold("command-line")
    canvas = browser.canvas("preview")
    labels = """
        const all = [...document.querySelectorAll('.nicegui-scene div')];
        return all.filter(e => !e.children.length && e.textContent).map(e => e.textContent)"""
    browser.wait(lambda: {"up", "front"} <= set(browser.script(labels)), "axes")
    before = hinted_azimuth(browser)
    assert f"--near {before:g} " in browser.text("command")
    turn(browser, canvas, 45, 0)
    browser.wait(lambda: 20 < (before - hinted_azimuth(browser)) % 360 < 120, "turned")
    turn(browser, canvas, -45, 20)
    browser.wait(
        lambda: abs(before - hinted_azimuth(browser)) < 20, "turned back, and seen from higher up"
    )
    browser.picture("viewer-model", "fold-model")
    browser.click("no-prior")
    browser.contains("command", "--near", 0)
    browser.click("mark-front")
    browser.shows("prior-facts", "Click on the side that is front.")
    browser.mouse().move_to_element_with_offset(canvas, -22, 0).click().perform()
    browser.contains("prior-facts", "Click", 0)


STOP_ONCE_IT_RUNS = """
    const seconds = document.querySelector('[data-testid="seconds"]');
    window.shown = [];
    new MutationObserver(() => {
      window.shown.push(seconds.textContent);
      if (window.shown.length === 1) document.querySelector('[data-testid="stop"]').click();
    }).observe(seconds, {childList: true, characterData: true, subtree: true})"""
"""Presses Stop in the page itself: the views may be ready, for the mesh is examined beforehand, and
then a search ends sooner than a driver under load looks twice."""


def test_a_search_can_be_stopped_and_started_again(browser):
    browser.script(STOP_ONCE_IT_RUNS)
    browser.click("register")
    browser.wait(lambda: browser.messages() == ["stopped"], "stopped")
    browser.wait(lambda: not browser.part("stop").is_displayed(), "nothing to stop")
    browser.register()
    assert browser.messages() == []
    seconds = [text for text in browser.script("return window.shown") if text]
    assert seconds.count("0 s") > 1, "of both searches"
    assert all(re.fullmatch(r"\d+ s", text) for text in seconds)


def test_a_reload_keeps_photograph_mesh_box_and_answer(browser):
    names = ("photograph-facts", "mesh-facts", "box-facts", "verdict", "facts")
    browser.wait(lambda: browser.text("facts"), "answer")
    before = [browser.text(name) for name in names]
    browser.driver.refresh()
    browser.wait(lambda: [browser.text(name) for name in names] == before, "everything again")
    images = browser.images("photograph")
    browser.wait(
        lambda: [int(image.get_attribute("naturalWidth")) for image in images] == [600] * 3,
        "layers",
    )
    browser.wait(lambda: len(browser.images("panel-answer")) > 1, "cards")
    assert browser.text("progress") == "done"
    browser.picture("viewer", "answer-1")


def test_the_card_that_is_clicked_is_the_answer_that_is_shown_and_saved(browser):
    browser.unfold("command-line")
    first = saved(browser)
    assert first["viewer"]["command"] == browser.text("command")
    browser.choose("answer-2")
    assert not browser.is_pressed("answer-1")
    second = saved(browser)
    assert second["rotation"] == first["hypotheses"][1]["rotation"] != first["rotation"]
    for name, start in (("pose.glb", b"glTF"), ("overlay.png", b"\x89PNG")):
        browser.click(f"download-{name.replace('overlay.png', 'picture')}")
        assert browser.downloaded(name).startswith(start)
    assert browser.text("verdict") == "your choice"
    browser.choose("answer-1")
    assert browser.text("used-camera").endswith(": the camera is known by its field of view")


def test_the_pose_is_corrected_on_the_photograph(browser):
    browser.emulate(1440, 900)
    before = saved(browser)
    at_rest = browser.extent(600)
    x0, y0, x1, y1 = at_rest
    middle = ((x0 + x1) / 2, (y0 + y1) / 2)
    right = [x0 + 36, y0, x1 + 36, y1]

    def follows():
        browser.wait(
            lambda: browser.extent(600) == pytest.approx(right, abs=4), "the mesh follows", 20
        )

    browser.drag(middle, (middle[0] + 36, middle[1]), 600, held=follows)
    browser.contains("facts", "moved: rotated 0.0 degrees")
    assert browser.text("verdict") == "by hand"
    moved = saved(browser)
    pixels = (moved["translation"][0] - before["translation"][0]) * before["inputs"]["camera"][0]
    assert pixels / before["translation"][2] == pytest.approx(36, abs=4)
    browser.drag((20, 20), (60, 45), 600)  # beside the mesh
    browser.contains("facts", "moved: ", 2)
    browser.picture("viewer-hand")
    browser.click("undo")
    browser.contains("facts", "moved: ")
    assert saved(browser)["rotation"] == moved["rotation"]
    scroll(browser, browser.part("photograph"), 200)
    browser.contains("facts", "moved: ", 2)
    assert saved(browser)["translation"][2] > 1.05 * moved["translation"][2]
    browser.click("fit")
    browser.contains("facts", "contours fitted")
    browser.click("answer-1")
    browser.wait(lambda: browser.extent(600) == at_rest, "as it was found")
    layer = browser.images("photograph")[1]
    assert layer.value_of_css_property("opacity") == "0.35"
    browser.part("mesh").click()  # in the middle
    browser.wait(lambda: 0.45 < float(layer.value_of_css_property("opacity")) < 0.55, "opacity", 20)


def scroll(browser, element, amount):
    from selenium.webdriver.common.actions.wheel_input import ScrollOrigin

    browser.mouse().scroll_from_origin(ScrollOrigin.from_element(element), 0, amount).perform()


def test_the_program_is_copied(browser):
    permissions = {"permissions": ["clipboardReadWrite", "clipboardSanitizedWrite"]}
    browser.driver.execute_cdp_cmd("Browser.grantPermissions", permissions)
    browser.find(".verdict [data-copy=python]").click()
    script = "navigator.clipboard.readText().then(arguments[0], arguments[0])"
    copied = browser.driver.execute_async_script(script)
    assert copied.startswith("import curvireg_torch as cr\n")
    files = re.findall(r"'([^']+coffee\.jpg|[^']+cup\.ply)'", copied)
    assert [Path(file).is_file() for file in files] == [True, True], (
        "it runs as long as the page is open"
    )


def test_a_hint_that_is_the_wrong_way_round_is_turned_around_with_one_click(browser):
    browser.emulate(1440, 900)
    before = browser.text("certainty")
    canvas = browser.canvas("preview")
    start = hinted_azimuth(browser)
    browser.script("arguments[0].scrollIntoView({block: 'center'})", canvas)
    turn(browser, canvas, 120, 0)  # half the height is half a turn
    browser.wait(lambda: 140 < (start - hinted_azimuth(browser)) % 360 < 220, "seen from behind")
    browser.register()
    browser.wait(lambda: browser.part("turn-the-prior-around"), "repair")
    assert browser.text("verdict") != "reliable"
    browser.click("turn-the-prior-around")
    browser.shows("verdict", "reliable")
    browser.click("no-prior")
    browser.register()
    browser.shows("certainty", before)
    assert browser.messages() == []


@pytest.mark.parametrize("size", [(1440, 900), (390, 844)])
def test_the_photograph_fits_the_window_and_stays_in_view(browser, size):
    browser.emulate(*size)
    viewport = browser.find(".viewport")
    inside = """
        const frame = arguments[0].getBoundingClientRect();
        return frame.top >= 0 && frame.left >= 0 && frame.bottom <= innerHeight && frame.right <= innerWidth"""  # noqa: E501
    for end in (0, 300, 100000):
        browser.script("scrollTo(0, arguments[0])", end)
        browser.wait(lambda: browser.script(inside, viewport), f"in view at {end}", 5)
    assert browser.script("return scrollY") > 300
    assert viewport.rect["width"] > 0.5 * size[0]


def test_a_small_screen_stacks_everything_and_dark_colours_follow_the_system(browser):
    browser.emulate(390, 844)
    wide = """
        const all = [...document.querySelectorAll('*:not(.preview *)')];
        return all.filter(e => e.getBoundingClientRect().right > 391)"""
    browser.wait(
        lambda: browser.script("return document.documentElement.scrollWidth") == 390,
        "narrow",
    )
    assert browser.script(wide) == []
    parts = [
        browser.part(name).rect
        for name in ("photograph", "step-photograph", "step-mesh", "register", "verdict")
    ]
    assert [part["y"] for part in parts] == sorted(part["y"] for part in parts)
    assert browser.part("photograph").rect["width"] > 300
    small = """
        const all = [...document.querySelectorAll('button, .button, summary, [role=combobox], input:not([type=file])')];
        const seen = all.filter(e => e.checkVisibility() && !e.closest('.preview') && !e.matches('.q-field input'));
        return seen.filter(e => {
            const {width, height} = e.getBoundingClientRect();
            return width < 44 || height < 44;
        }).map(e => e.outerHTML.slice(0, 200))"""  # noqa: E501
    for fold in ("options", "camera", "command-line", "model"):
        browser.unfold(fold)
    assert browser.script(small) == [], "fingers need 44 px"
    browser.emulate(1440, 900, dark=True)
    body = browser.find("body")
    browser.wait(
        lambda: body.value_of_css_property("background-color") == "rgba(20, 23, 26, 1)", "dark"
    )


def test_keys_undo_and_zoom_change_the_box(browser):
    from selenium.webdriver import Keys

    browser.click("mode-box")
    x0, y0, x1, y1 = browser.box()
    viewport = browser.find(".viewport")

    def press(key, *held):
        browser.script("arguments[0].focus()", viewport)
        chain = browser.mouse()
        for name in held:
            chain.key_down(name)
        chain.send_keys(key)
        for name in held:
            chain.key_up(name)
        chain.perform()

    def becomes(*box):
        browser.has_box(*box, within=0.01)

    press(Keys.ARROW_RIGHT)
    becomes(x0 + 1, y0, x1 + 1, y1)
    press(Keys.ARROW_LEFT, Keys.SHIFT)
    becomes(x0 - 9, y0, x1 - 9, y1)
    press("z", Keys.CONTROL)
    becomes(x0 + 1, y0, x1 + 1, y1)
    browser.click("no-box")
    browser.shows("register", "Find the object and its pose")
    assert browser.text("progress") == "the inputs have changed since this answer"
    browser.click("undo")
    becomes(x0 + 1, y0, x1 + 1, y1)
    press(Keys.DELETE)
    browser.wait(lambda: browser.box() is None, "no box")
    browser.click("undo")
    becomes(x0 + 1, y0, x1 + 1, y1)

    # The wheel zooms at the mouse; a box that is drawn then is where the mouse was.
    image = browser.part("photograph")
    width = image.size["width"]
    scroll(browser, image, -300)
    browser.wait(lambda: image.size["width"] > 1.5 * width, "zoomed")
    assert browser.script("return arguments[0].scrollLeft", viewport) > 100
    browser.find("[data-zoom=fit]").click()
    browser.wait(lambda: image.size["width"] == width, "as before")
    browser.drag((10, 250), (120, 350), 600)
    browser.has_box(10, 250, 120, 350)
    browser.drag((120, 300), (150, 300), 600)
    browser.has_box(10, 250, 150, 350)


def test_files_are_dropped_together_chosen_again_and_named_when_they_are_wrong(browser, folder):
    browser.drop(folder / "truck.ply", folder / "photo.png")
    browser.shows("photograph-facts", "photo.png: 240 x 180 px")
    browser.begins("mesh-facts", "truck.ply: ")

    advice = "grey mesh: its sides differ in shape"
    browser.wait(lambda: browser.text("mesh-advice") == advice, "advice", 600)
    (folder / "other.png").write_bytes((folder / "photo.png").read_bytes())
    for name in ("other.png", "photo.png"):  # photo.png for the second time
        browser.upload("photograph", folder / name)
        browser.begins("photograph-facts", f"{name}: ")
    assert browser.messages() == []
    browser.shows("camera-facts", "from the photograph's EXIF, 37 mm of a 35 mm camera")
    browser.unfold("camera")
    browser.unfold("command-line")
    browser.part("fov").send_keys("65\n")
    browser.contains("command", "--fov 65")
    (folder / "notes.txt").write_text("nothing to see")
    browser.drop(folder / "broken.png", folder / "hostile.obj", folder / "notes.txt")
    browser.wait(lambda: len(browser.messages()) == 3, "three messages")
    for part, name in (
        ("photograph", "broken.png"),
        ("mesh", "hostile.obj"),
        ("camera", "notes.txt"),
    ):
        assert browser.text(f"message-{part}").startswith(f"{name}: ")
    assert browser.text("photograph-facts") == "photo.png: 240 x 180 px", "the former one stays"
    browser.drop(folder / "photo.png")
    browser.wait(lambda: browser.messages() == [], "all gone with the next files")
    mesh = example_mesh()
    mesh.apply_scale(1000.0)
    mesh.export(folder / "large.ply")
    browser.upload("mesh", folder / "large.ply")
    browser.contains("message-mesh", "give the unit (mm?)")
    browser.picture("viewer-repair", "step-mesh")
    browser.click("use-mm")
    browser.wait(lambda: browser.text("mesh-facts").endswith(" mm, rendered in grey"), "in mm")
    browser.wait(lambda: browser.messages() == [], "all gone")


def test_each_of_several_photographs_keeps_its_box(browser, folder):
    scenes = {f"table-{seed}.png": demo_scene(seed) for seed in (4, 5)}
    for name, scene in scenes.items():
        (folder / name).write_bytes(png(to_uint8(scene.image)))
    scene.mesh.apply_scale(1000.0)  # the page still has the unit mm
    scene.mesh.export(folder / "table.ply")
    browser.drop(*map(folder.joinpath, [*scenes, "table.ply"]))
    browser.begins("mesh-facts", "table.ply: ")
    x0, y0, x1, y1 = scene.box.tolist()
    browser.drag((x0, y0), (x1, y1), 960)
    browser.has_box(x0, y0, x1, y1)
    thumbnails = browser.images("strip")
    assert [image.get_attribute("alt") for image in thumbnails][-2:] == list(scenes)
    browser.click(f"photograph-{len(thumbnails) - 1}")
    browser.wait(lambda: browser.box() is None, "no box")
    for left in range(len(thumbnails) - 1, 1, -1):  # those of the tests before
        browser.choose("photograph-1")
        browser.click("no-photo")
        browser.wait(lambda n=left: len(browser.images("strip")) == n, f"{left} left")
    browser.click("photograph-2")
    browser.wait(lambda: browser.box() is not None, "the last one")
    browser.picture("viewer-box", "step-box")
    browser.click("no-photo")
    browser.wait(lambda: not browser.part("strip").is_displayed(), "one photograph needs no strip")


def test_an_answer_is_zoomed_to_and_the_pointer_shows_what_a_drag_does(browser, folder):
    """The object is 54 px of 240 wide; the key Z shows the whole photograph again."""
    browser.emulate(1280, 800)
    browser.drop(folder / "photo.png", folder / "truck.ply")
    browser.begins("mesh-facts", "truck.ply: ")
    browser.begins("photograph-facts", "photo.png: ")
    canvas = browser.part("photograph")
    browser.wait(lambda: browser.images("photograph")[0].size["width"] > 100, "shown")
    browser.drag((102, 70), (156, 147), 240)
    browser.wait(lambda: browser.box() is not None, "box")
    browser.register()
    browser.wait(lambda: canvas.get_attribute("data-object"), "its extent")

    def extent():
        return [float(value) for value in canvas.get_attribute("data-object").split()]

    def zoom_to_object():
        x0, y0, x1, y1 = extent()
        return max(1.0, 0.6 / max(x1 - x0, y1 - y0))

    def is_zoomed():
        zoom = float(canvas.get_attribute("data-zoom"))
        return zoom == pytest.approx(zoom_to_object(), abs=0.01)

    assert zoom_to_object() > 1.1, "the test needs a small object"
    browser.wait(is_zoomed, "the object")
    large = canvas.size["width"]
    browser.mouse().send_keys("z").perform()
    browser.wait(lambda: canvas.get_attribute("data-zoom") == "1", "the whole photograph")
    whole = canvas.size["width"]
    assert large == pytest.approx(zoom_to_object() * whole, rel=0.03)  # a scroll bar takes some
    browser.find("[data-zoom=fit]").click()
    browser.wait(lambda: canvas.size["width"] > 1.05 * whole, "the object again")
    browser.find("[data-zoom=fit]").click()
    browser.wait(lambda: canvas.size["width"] == whole, "the whole photograph")

    def aim(x, y):
        middle = canvas.size["width"] / 2, canvas.size["height"] / 2
        offset = round(2 * middle[0] * x - middle[0]), round(2 * middle[1] * y - middle[1])
        browser.mouse().move_to_element_with_offset(canvas, *offset).perform()
        return canvas.get_attribute("data-aim")

    x0, y0, x1, y1 = extent()
    browser.wait(lambda: aim((x0 + x1) / 2, (y0 + y1) / 2) == "move", "the mesh would move")
    browser.wait(lambda: aim(0.02, 0.02) == "turn", "the mesh would turn")
    lines = browser.images("photograph")[2]
    assert lines.is_displayed()
    browser.part("contours").click()
    browser.wait(lambda: not lines.is_displayed(), "without contours")
    browser.part("contours").click()
    browser.wait(lambda: lines.is_displayed(), "with contours")
    browser.click("show-space")
    assert browser.canvas("space"), "the answer in 3D"
    browser.find("[data-zoom=fit]").click()
    browser.wait(lambda: canvas.size["width"] > 1.05 * whole, "the object")
    (folder / "next.png").write_bytes((folder / "photo.png").read_bytes())
    browser.drop(folder / "next.png")
    browser.begins("photograph-facts", "next.png: ")
    browser.wait(lambda: canvas.get_attribute("data-zoom") == "1", "it is shown whole")
    browser.click("no-photo")
    browser.wait(lambda: browser.text("verdict"), "the former one and its answer")
    browser.click("no-photo")
    browser.click("restore-photo")
    browser.wait(lambda: browser.text("verdict"), "the photograph and its answer are back")


def test_a_rig_file_makes_several_photographs_one_pose(browser, folder):

    def is_empty():
        if browser.part("no-photo").is_displayed():
            browser.click("no-photo")
        return browser.part("sample").is_displayed()

    browser.wait(is_empty, "empty again")
    scenes = [demo_scene(seed) for seed in (4, 5)]  # the world is the mesh's own frame
    lines = ["photo,x0,y0,x1,y1,fx,fy,cx,cy,r11,r12,r13,r21,r22,r23,r31,r32,r33,tx,ty,tz"]
    for seed, scene in zip((4, 5), scenes, strict=True):
        # in mm
        R = scene.truth[:3, :3].flatten().tolist()
        t = (1000.0 * scene.truth[:3, 3]).tolist()
        box = scene.box.tolist() if seed == 4 else [""] * 4
        lines.append(
            ",".join(map(str, [f"table-{seed}.png", *box, 1040, 1040, 479.5, 359.5, *R, *t]))
        )
    (folder / "rig.csv").write_text("\n".join(lines))
    browser.drop(*map(folder.joinpath, ["table-4.png", "table-5.png", "table.ply", "rig.csv"]))
    browser.shows("rig-facts", "rig.csv: one pose in 2 photographs")
    browser.begins("mesh-facts", "table.ply: ")
    assert browser.text("register") == "Find the pose in 2 photographs"
    browser.register()
    for number, scene in enumerate(scenes, start=1):
        browser.click(f"photograph-{number}")
        box = pytest.approx(scene.box.tolist(), abs=4)
        browser.wait(lambda box=box: browser.extent(960) == box, f"mesh {number}")
        assert browser.part("answers").is_displayed()
    browser.picture("viewer-rig")
    browser.click("no-rig")
    browser.shows("register", "Find the object and its pose")

"""The viewer in a headless browser."""

import http.client
import json
import os
import re
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

from curvireg_torch.limits import MAX_VIEWER_PAGES
from curvireg_torch.viewer.session import MAX_PROPOSALS
from tests._support.exif import exif, with_exif
from tests.viewer.browser import MISSING, Browser, wait_for
from tests.viewer.test_session import run_command, write_scene

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(bool(MISSING), reason=f"not installed: {', '.join(MISSING)}"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("browser")
    folder.joinpath("box.json").write_text(json.dumps(write_scene(folder)[0]))
    with_exif(folder / "photo.png", exif(1, 37))
    (folder / "broken.png").write_bytes((folder / "photo.png").read_bytes()[:3000])
    (folder / "hostile.obj").write_text("v 0 0 0\nv 1 0 nan\nv 0 1 0\nf 1 2 3\n")
    return folder


@pytest.fixture(scope="module")
def address(folder):
    """Address of a viewer that was started without a photograph."""
    command = [sys.executable, "-m", "curvireg_torch", "view", "--pipeline", "small.json", "--no-browser"]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")}
    environment |= {"CURVIREG_CACHE": str(folder / "cache"), "PYTHONPATH": str(Path.cwd())}
    with (folder / "log").open("w") as log:
        server = subprocess.Popen(
            command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=log, text=True, bufsize=1
        )
    try:
        line = server.stdout.readline()
        assert "http://127.0.0.1:" in line, (folder / "log").read_text()
        address = re.search(r"http://\S+", line)[0]
        wait_for(address)
        yield address
    finally:
        server.send_signal(signal.SIGTERM)
        try:
            server.wait(20)
        except subprocess.TimeoutExpired:
            server.kill()
            server.wait()
        server.stdout.close()
    assert "Traceback" not in (folder / "log").read_text()


@pytest.fixture(scope="module")
def browser(folder, address):
    browser = Browser(folder, address)
    yield browser
    errors = [entry for entry in browser.driver.get_log("browser") if entry["level"] == "SEVERE"]
    browser.driver.quit()
    assert not errors


def test_server_requires_the_token_and_limits_uploads(address):
    host, port = re.search(r"//([\d.]+):(\d+)/", address).groups()
    token = address.rstrip("/").rsplit("/", 1)[1]
    assert len(token) >= 20
    for _ in range(MAX_VIEWER_PAGES + 1):  # they take no place: the tests below open a page
        with urllib.request.urlopen(address) as answer:
            assert answer.status == 200
            assert answer.headers["x-frame-options"] == "DENY"
            assert answer.headers["server"] is None
    for path in ("/", f"/{token[:-1]}/", f"/{token}/file/none/photograph.jpg"):
        connection = http.client.HTTPConnection(host, int(port))
        connection.request("GET", path)
        assert connection.getresponse().status == 404, path
        connection.close()
    # Bodies that are too large or have no length are refused before they are read.
    for headers in ({"Content-Length": str(1 << 40)}, {"Transfer-Encoding": "chunked"}):
        connection = http.client.HTTPConnection(host, int(port))
        connection.putrequest("POST", f"/{token}/_nicegui/client/none/upload/1")
        for name, value in headers.items():
            connection.putheader(name, value)
        connection.endheaders()
        assert connection.getresponse().status == 413
        connection.close()


def test_page_from_upload_to_download(browser, folder):
    browser.upload("photograph", folder / "photo.png")
    browser.wait(lambda: browser.text("photo-facts") == "240 x 180 px", "photograph")
    assert browser.text("camera-facts").startswith("unknown")
    browser.part("fov").send_keys("65")
    browser.wait(lambda: browser.text("camera-facts").startswith("guessed from the field of view"), "field of view")
    browser.wait(lambda: "--fov 65" in browser.text("command"), "command")
    browser.click("exif")
    browser.wait(lambda: browser.text("fov") == "", "field of view cleared")
    caption = "guessed from the photograph's EXIF, 37 mm of a 35 mm camera: no covariance"
    browser.wait(lambda: browser.text("camera-facts") == caption, "EXIF")
    browser.upload("mesh", folder / "truck.ply")
    browser.wait(lambda: "968 faces" in browser.text("mesh-facts"), "mesh")
    browser.wait(lambda: browser.part("photograph").find_element("css selector", "img").size["height"] > 100, "image")

    # Draw a rough box, then correct one edge.
    x0, y0, x1, y1 = json.loads((folder / "box.json").read_text())
    browser.drag((x0, y0), (x1 + 15, y1), 240)
    browser.wait(lambda: browser.box() == pytest.approx([x0, y0, x1 + 15, y1], abs=0.5), "drawn box")
    browser.drag((x1 + 15, (y0 + y1) / 2), (x1, (y0 + y1) / 2), 240)
    browser.wait(lambda: browser.box() == pytest.approx([x0, y0, x1, y1], abs=0.7), "corrected box")
    drawn = browser.box()

    browser.click("register")
    browser.wait(lambda: browser.text("stage") == "done", "result")
    assert "azimuth" in browser.text("facts")
    assert browser.text("message") == ""
    command = browser.text("command")
    browser.click("download-JSON")
    document = json.loads(browser.downloaded("result.json"))
    assert document["inputs"]["box"] == pytest.approx(drawn)
    assert document["viewer"]["command"] == command
    assert "--camera exif" in command

    # The command line gives the same result to the last digit.
    written = run_command(folder, command)
    for key in ("rotation", "translation", "viewpoint", "score", "confidence", "top", "pipeline"):
        assert document[key] == written[key], key
    assert document["translation"] is not None


def test_page_shows_the_result(browser, folder):
    layer = browser.part("photograph").find_elements("css selector", "img")[1]
    assert layer.get_attribute("naturalWidth") == "240"
    assert "opacity: 0.35" in layer.get_attribute("style")
    slider = browser.part("wipe")
    browser.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", slider)
    slider.click()  # in the middle
    browser.wait(lambda: re.search(r"inset\(0(px)? (4\d|5\d)(\.\d)?% 0", layer.get_attribute("style")), "wipe", 20)
    for tab, pictures in (("answer", 2), ("fields", 4), ("views", 12), ("view sphere", 1)):
        browser.click(f"tab-{tab}")
        panel = browser.wait(lambda tab=tab: browser.part(f"panel-{tab}"), tab)
        browser.wait(lambda p=panel: len(p.find_elements("css selector", "img")), f"pictures of {tab}")
        images = panel.find_elements("css selector", "img")
        assert len(images) == pictures
        browser.wait(lambda i=images: all(int(x.get_attribute("naturalWidth")) > 50 for x in i), "loaded")
        if tab == "answer":  # thumbnails show the box with a margin
            x0, y0, x1, y1 = json.loads((folder / "box.json").read_text())
            margin = 0.25 * max(x1 - x0, y1 - y0)
            width = min(240, int(x1 + margin) + 1) - max(0, int(x0 - margin))
            assert width < 200
            assert [int(x.get_attribute("naturalWidth")) for x in images] == pytest.approx([width] * 2, abs=2)
        if tab == "views":
            assert re.search(r"S 0\.\d+\n.*\nhog 0\.\d+\nrepeatability 0\.\d+\nbox", panel.text)
    browser.click("tab-3D")
    browser.wait(lambda: browser.part("panel-3D").find_elements("css selector", "canvas"), "scene")
    # The loader put the mesh and the plane of the photograph into the scene.
    count = """
        const id = document.querySelector('.nicegui-scene').id.slice(1);
        let n = 0; getElement(id).scene.traverse(x => { if (x.isMesh) n++; }); return n;"""
    browser.wait(lambda: browser.driver.execute_script(count) == 2, "mesh and photograph in the scene")


def test_page_moves_fits_and_downloads_the_pose(browser):
    before = browser.text("facts")
    browser.click("tab-answer")
    browser.click("+roll")
    browser.wait(lambda: "rotated 4 degrees about z" in browser.text("facts"), "nudge")
    assert browser.text("facts").splitlines()[0] != before.splitlines()[0]
    browser.click("fit")
    browser.wait(lambda: "contours fitted" in browser.text("facts"), "contours")
    browser.click("show-2")
    browser.wait(lambda: "by hand" not in browser.text("facts") and browser.text("facts") != before, "second")
    for name, start in (("GLB", b"glTF"), ("PNG", b"\x89PNG")):
        browser.click(f"download-{name}")
        assert browser.downloaded({"GLB": "pose.glb", "PNG": "overlay.png"}[name]).startswith(start)


def test_page_refuses_broken_and_hostile_files(browser, folder):
    browser.upload("photograph", folder / "broken.png")
    browser.wait(lambda: "broken.png" in browser.text("message"), "refusal")
    assert str(folder.parent) not in browser.text("message")
    assert browser.text("photo-facts") == "240 x 180 px"
    browser.upload("mesh", folder / "hostile.obj")
    browser.wait(lambda: "hostile.obj" in browser.text("message"), "refusal")
    assert "NaN" in browser.text("message")
    browser.click("register")  # the previous photograph and mesh remain
    browser.wait(lambda: browser.text("message") == "" and browser.text("stage") == "done", "answer")


def test_page_draws_proposals_and_a_click_chooses_one(browser, folder):
    watch = """
        const stage = document.querySelector('[data-testid=stage]');
        window.stages = [];
        new MutationObserver(() => stages.push(stage.textContent)).observe(
            stage, {childList: true, subtree: true, characterData: true})"""
    browser.driver.execute_script(watch)

    def stages():
        return browser.driver.execute_script("return stages")

    assert browser.box() == pytest.approx(json.loads((folder / "box.json").read_text()), abs=0.7)
    browser.wait(lambda: "starting" in stages() or browser.click("find"), "pressed")
    browser.wait(lambda: stages()[-1] == "done", "result without a box")
    assert "localizing the object" in stages()
    assert browser.text("message") == browser.text("box-x0") == ""
    command = browser.text("command")
    assert "--box" not in command
    written = run_command(folder, command)
    proposals = [proposal["box"] for proposal in written["localization"]["proposals"]][:MAX_PROPOSALS]
    assert proposals[0] == written["inputs"]["box"]
    assert len(proposals) > 1

    def dashed():
        """Corners of the dashed boxes."""
        photograph = browser.part("photograph")
        assert photograph.find_element("css selector", "img").get_attribute("naturalWidth") == "240"
        shown = photograph.find_elements("css selector", 'rect[stroke="white"][stroke-dasharray="4 6"]')
        sides = [[float(rect.get_attribute(name)) for name in ("x", "y", "width", "height")] for rect in shown]
        return [[x - 0.5, y - 0.5, x + w - 0.5, y + h - 0.5] for x, y, w, h in sides]

    drawn = browser.wait(dashed, "proposals")
    assert len(drawn) == len(proposals)
    for one, other in zip(drawn, proposals, strict=True):
        assert one == pytest.approx(other)
    x0, y0, x1, y1 = proposals[0]
    middle = ((x0 + x1) / 2, (y0 + y1) / 2)
    browser.drag(middle, middle, 240)
    browser.wait(lambda: browser.box() == [round(v, 1) for v in proposals[0]], "clicked box")
    assert not dashed()
    browser.wait(lambda: "--box" in browser.text("command"), "command with the box")
    assert browser.text("stage") == "the inputs have changed since this result"

"""The viewer in a headless browser."""

import http.client
import json
import re
import urllib.request

import pytest

from curvireg_torch.errors import MAX_VIEWER_PAGES
from curvireg_torch.viewer.session import MAX_PROPOSALS
from tests.viewer.browser import MISSING
from tests.viewer.test_session import run_command

OPTIONS = ["--pipeline", "small.json"]  # of the command that starts the viewer

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(bool(MISSING), reason=f"not installed: {', '.join(MISSING)}"),
]


def test_server_requires_the_token_and_limits_uploads(address, browser):
    host, port = re.search(r"//([\d.]+):(\d+)/", address).groups()
    token = address.rstrip("/").rsplit("/", 1)[1]
    assert len(token) >= 20
    for _ in range(MAX_VIEWER_PAGES + 1):  # they take no place: the tests below open a page
        with urllib.request.urlopen(address) as answer:
            assert answer.status == 200
            assert answer.headers["x-frame-options"] == "DENY"
            assert answer.headers["server"] is None
    for path in ("/", f"/{token[:-1]}/", f"/{token}/none", f"/{token}/{browser.page}/file/photograph.jpg"):
        connection = http.client.HTTPConnection(host, int(port))
        connection.request("GET", path)
        assert connection.getresponse().status == 404, path
        connection.close()
    # Bodies that are too large or have no length are refused before they are read, and those for no page too.
    connection = http.client.HTTPConnection(host, int(port))
    connection.request("POST", f"/{token}/{'x' * 16}/upload", body=b"1")
    assert connection.getresponse().status == 404
    connection.close()
    for headers in ({"Content-Length": str(1 << 40)}, {"Transfer-Encoding": "chunked"}):
        connection = http.client.HTTPConnection(host, int(port))
        connection.putrequest("POST", f"/{token}/{browser.page}/upload")
        for name, value in headers.items():
            connection.putheader(name, value)
        connection.endheaders()
        assert connection.getresponse().status == 413
        connection.close()


def test_page_from_upload_to_download(browser, folder):
    browser.upload("photograph", folder / "photo.png")
    browser.wait(lambda: browser.text("photograph-facts") == "photo.png: 240 x 180 px", "photograph")
    browser.unfold("camera")
    browser.unfold("command-line")
    browser.unfold("box-numbers")
    assert browser.text("camera-facts").startswith("unknown")
    browser.part("fov").send_keys("65")
    browser.wait(lambda: browser.text("camera-facts").startswith("guessed from the field of view"), "field of view")
    browser.wait(lambda: "--fov 65" in browser.text("command"), "command")
    browser.click("exif")
    browser.wait(lambda: browser.text("fov") == "", "field of view cleared")
    caption = "guessed from the photograph's EXIF, 37 mm of a 35 mm camera: no covariance"
    browser.wait(lambda: browser.text("camera-facts") == caption, "EXIF")
    assert browser.part("register").get_attribute("disabled")
    browser.upload("mesh", folder / "truck.ply")
    browser.wait(lambda: browser.text("mesh-facts").startswith("truck.ply: 968 faces"), "mesh")
    assert not browser.messages(), "the upload that the server refused is forgotten"
    browser.wait(lambda: browser.part("photograph").size["height"] > 300, "a large photograph")

    # Draw a rough box, then correct one edge.
    x0, y0, x1, y1 = json.loads((folder / "box.json").read_text())
    browser.drag((x0, y0), (x1 + 15, y1), 240)
    browser.wait(lambda: browser.box() == pytest.approx([x0, y0, x1 + 15, y1], abs=0.5), "drawn box")
    browser.drag((x1 + 15, (y0 + y1) / 2), (x1, (y0 + y1) / 2), 240)
    browser.wait(lambda: browser.box() == pytest.approx([x0, y0, x1, y1], abs=0.7), "corrected box")
    drawn = browser.box()

    browser.click("register")
    browser.wait(lambda: browser.text("stage") == "done", "result")
    browser.wait(lambda: "azimuth" in browser.text("facts"), "answer")
    assert browser.text("verdict") in ("likely", "unsure", "no match")
    assert not browser.messages()
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
    browser.wait(lambda: layer.get_attribute("naturalWidth") == "240", "layer")
    assert layer.value_of_css_property("opacity") == "0.35"
    slider = browser.part("wipe")
    browser.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", slider)
    slider.click()  # in the middle
    browser.wait(
        lambda: re.search(r" (49|50|51)%", layer.value_of_css_property("clip-path")),
        f"wipe: {layer.value_of_css_property('clip-path')}",
        20,
    )
    for tab, pictures in (("answer", 2), ("fields", 4), ("views", 12), ("view sphere", 1)):
        if tab != "answer":
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
    browser.unfold("by-hand")
    browser.click("+roll")
    browser.wait(lambda: "rotated 4 degrees about z" in browser.text("facts"), "nudge")
    assert browser.text("facts").splitlines()[0] != before.splitlines()[0]
    browser.click("fit")
    browser.wait(lambda: "contours fitted" in browser.text("facts"), "contours")
    browser.click("show-2")
    browser.wait(lambda: browser.text("facts").startswith("answer 2: "), "second")
    assert "by hand" not in browser.text("facts")
    for name, start in (("GLB", b"glTF"), ("PNG", b"\x89PNG")):
        browser.click(f"download-{name}")
        assert browser.downloaded({"GLB": "pose.glb", "PNG": "overlay.png"}[name]).startswith(start)


def test_page_draws_proposals_and_a_click_chooses_one(browser, folder):
    assert browser.box() == pytest.approx(json.loads((folder / "box.json").read_text()), abs=0.7)
    watch = """
        const stage = document.querySelector('[data-testid=stage]');
        window.stages = [];
        new MutationObserver(() => stages.push(stage.textContent)).observe(
            stage, {childList: true, subtree: true, characterData: true})"""
    browser.driver.execute_script(watch)

    def stages():
        return browser.driver.execute_script("return stages")

    browser.click("no-box")
    browser.wait(lambda: browser.text("register") == "Find the object and its pose", "no box")
    browser.click("register")
    looking = "looking for the object in the photograph"
    browser.wait(lambda: looking in stages() and stages()[-1] == "done", "result without a box")
    assert browser.messages() == []
    assert browser.text("box-x0") == ""
    command = browser.text("command")
    assert "--box" not in command
    written = run_command(folder, command)
    proposals = [proposal["box"] for proposal in written["detection"]["proposals"]][:MAX_PROPOSALS]
    assert proposals[0] == written["inputs"]["box"]
    assert len(proposals) > 1

    def dashed():
        """Corners of the dashed boxes."""
        shown = browser.part("photograph").find_elements("css selector", "rect.line[stroke-dasharray='4 6']")
        sides = [[float(rect.get_attribute(name)) for name in ("x", "y", "width", "height")] for rect in shown]
        return [[x, y, x + w, y + h] for x, y, w, h in sides]

    drawn = browser.wait(dashed, "proposals")
    assert len(drawn) == len(proposals)
    for one, other in zip(drawn, proposals, strict=True):
        assert one == pytest.approx(other, abs=0.001)
    x0, y0, x1, y1 = proposals[0]
    middle = ((x0 + x1) / 2, (y0 + y1) / 2)
    browser.drag(middle, middle, 240)
    browser.wait(lambda: browser.box() == [round(v, 1) for v in proposals[0]], "clicked box")
    assert not dashed()
    browser.wait(lambda: "--box" in browser.text("command"), "command with the box")
    browser.wait(lambda: browser.text("stage") == "the inputs have changed since this answer", "outdated")

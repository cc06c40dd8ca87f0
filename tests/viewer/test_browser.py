"""The viewer as a person uses it, in a real browser without a screen."""

import http.client
import importlib.util
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest

from curvireg_torch.cli import main
from curvireg_torch.viewer.session import MAX_PROPOSALS
from tests._support.exif import exif, with_exif
from tests.viewer.test_session import write_scene

PROGRAMS = [next(filter(None, map(shutil.which, names)), None)
            for names in (("chromium", "chromium-browser", "google-chrome"), ("chromedriver",))]  # fmt: skip
MISSING = [name for name in ("nicegui", "selenium") if importlib.util.find_spec(name) is None]
MISSING += [name for name, path in zip(("chromium", "chromedriver"), PROGRAMS, strict=True) if path is None]
pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(bool(MISSING), reason=f"not installed: {', '.join(MISSING)}"),
]

OPTIONS = (
    "headless=new", "no-sandbox", "disable-gpu", "disable-quic", "no-first-run", "disable-background-networking",
    "disable-component-update", "disable-sync", "window-size=1500,1400", "use-angle=swiftshader",
    "enable-unsafe-swiftshader",
)  # fmt: skip


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
    """Of a viewer that was started without a photograph."""
    command = [sys.executable, "-m", "curvireg_torch", "view", "--pipeline", "small.json", "--no-browser"]
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")}
    environment = {**kept, "CURVIREG_CACHE": str(folder / "cache"), "PYTHONPATH": str(Path.cwd())}
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


def wait_for(address):
    for _ in range(100):
        try:
            urllib.request.urlopen(address).close()
            return
        except OSError:
            time.sleep(0.1)
    raise AssertionError("the server does not answer")


class Browser:
    """A page, by the names its parts have for tests."""

    def __init__(self, folder, address):
        from selenium import webdriver

        options = webdriver.ChromeOptions()
        options.binary_location = PROGRAMS[0]
        for option in (*OPTIONS, f"user-data-dir={folder / 'profile'}"):
            options.add_argument(f"--{option}")
        options.add_experimental_option("prefs", {"download.default_directory": str(folder / "downloads")})
        self.driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(PROGRAMS[1]))
        self.folder = folder
        self.driver.get(address)

    def part(self, name):
        return self.driver.find_element("css selector", f'[data-testid="{name}"]')

    def text(self, name):
        return self.part(name).get_attribute("value") or self.part(name).text

    def until(self, true, what, seconds=90):
        deadline, error = time.monotonic() + seconds, None
        while True:
            try:
                if found := true():
                    return found
            except Exception as found:  # not there yet
                error = found
            assert time.monotonic() < deadline, f"{what}; page says {self.text('message')!r}; {error}"
            time.sleep(0.1)

    def click(self, name):
        button = self.part(name)
        self.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", button)
        self.until(lambda: button.click() or True, f"click {name}", 20)

    def upload(self, what, path):
        self.part(f"upload-{what}").find_element("css selector", "input[type=file]").send_keys(str(path))

    def drag(self, start, end, size):
        """With the mouse on the photograph, from and to pixels of it; ``size``: its width in px."""
        from selenium.webdriver import ActionChains

        image = self.part("photograph")
        self.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", image)
        zoom = image.size["width"] / size
        middle = image.size["width"] / 2, image.size["height"] / 2
        (x0, y0), (x1, y1) = (
            tuple(round((v + 0.5) * zoom - m) for v, m in zip(point, middle, strict=True)) for point in (start, end)
        )
        chain = ActionChains(self.driver, duration=50).move_to_element_with_offset(image, x0, y0).click_and_hold()
        chain.move_by_offset((x1 - x0) // 2, (y1 - y0) // 2)
        chain.move_to_element_with_offset(image, x1, y1).release().perform()

    def box(self):
        return [float(self.text(f"box-{name}") or "nan") for name in ("x0", "y0", "x1", "y1")]

    def downloaded(self, name):
        path = self.folder / "downloads" / name
        self.until(lambda: path.is_file() and not list(path.parent.glob("*.crdownload")), f"download of {name}")
        return path.read_bytes()


@pytest.fixture(scope="module")
def browser(folder, address):
    browser = Browser(folder, address)
    yield browser
    errors = [entry for entry in browser.driver.get_log("browser") if entry["level"] == "SEVERE"]
    browser.driver.quit()
    assert not errors


def test_the_address_needs_its_token(address):
    host, port = re.search(r"//([\d.]+):(\d+)/", address).groups()
    token = address.rstrip("/").rsplit("/", 1)[1]
    assert len(token) >= 20
    with urllib.request.urlopen(address) as answer:
        assert answer.status == 200
    for path in ("/", f"/{token[:-1]}/", f"/{token}/file/none/photograph.jpg"):
        connection = http.client.HTTPConnection(host, int(port))
        connection.request("GET", path)
        assert connection.getresponse().status == 404, path
        connection.close()
    # What is too large is refused before it is read, and so is what does not say how large it is.
    for headers in ({"Content-Length": str(1 << 40)}, {"Transfer-Encoding": "chunked"}):
        connection = http.client.HTTPConnection(host, int(port))
        connection.putrequest("POST", "/_nicegui/client/none/upload/1")
        for name, value in headers.items():
            connection.putheader(name, value)
        connection.endheaders()
        assert connection.getresponse().status == 413
        connection.close()


def test_from_upload_to_download(browser, folder):
    browser.upload("photograph", folder / "photo.png")
    browser.until(lambda: browser.text("photo-facts") == "240 x 180 px", "photograph")
    assert browser.text("camera-facts").startswith("unknown")
    browser.part("fov").send_keys("65")
    browser.until(lambda: browser.text("camera-facts").startswith("guessed from the field of view"), "field of view")
    browser.until(lambda: "--fov 65" in browser.text("command"), "command")
    browser.click("exif")
    browser.until(lambda: browser.text("fov") == "", "the camera goes before it")
    told = "guessed from the photograph's EXIF, 37 mm of a 35 mm camera: no covariance"
    browser.until(lambda: browser.text("camera-facts") == told, "EXIF")
    browser.upload("mesh", folder / "truck.ply")
    browser.until(lambda: "968 faces" in browser.text("mesh-facts"), "mesh")
    browser.until(lambda: browser.part("photograph").find_element("css selector", "img").size["height"] > 100, "image")

    # The box: drawn roughly, then one edge corrected.
    x0, y0, x1, y1 = json.loads((folder / "box.json").read_text())
    browser.drag((x0, y0), (x1 + 15, y1), 240)
    browser.until(lambda: browser.box() == pytest.approx([x0, y0, x1 + 15, y1], abs=0.5), "drawn box")
    browser.drag((x1 + 15, (y0 + y1) / 2), (x1, (y0 + y1) / 2), 240)
    browser.until(lambda: browser.box() == pytest.approx([x0, y0, x1, y1], abs=0.7), "corrected box")
    drawn = browser.box()

    browser.click("register")
    browser.until(lambda: browser.text("stage") == "done", "answer")
    assert "azimuth" in browser.text("facts")
    assert browser.text("message") == ""
    command = browser.text("command")
    browser.click("download-JSON")
    ours = json.loads(browser.downloaded("result.json"))
    assert ours["inputs"]["box"] == pytest.approx(drawn)
    assert ours["viewer"]["command"] == command
    assert "--camera exif" in command

    # The command line, in the folder of the files, gives the same to the digit.
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("CURVIREG_CACHE", str(folder / "cache"))
        assert main([*shlex.split(command)[1:], "--quiet"]) == 0
    written = json.loads((folder / "result" / "result.json").read_text())
    for key in ("rotation", "translation", "viewpoint", "score", "confidence", "top", "pipeline"):
        assert ours[key] == written[key], key
    assert ours["translation"] is not None


def test_what_was_found_is_shown(browser, folder):
    layer = browser.part("photograph").find_elements("css selector", "img")[1]
    assert layer.get_attribute("naturalWidth") == "240"
    assert "opacity: 0.35" in layer.get_attribute("style")
    slider = browser.part("wipe")
    browser.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", slider)
    slider.click()  # in the middle
    browser.until(lambda: re.search(r"inset\(0(px)? (4\d|5\d)(\.\d)?% 0", layer.get_attribute("style")), "wipe", 20)
    for tab, pictures in (("answer", 2), ("fields", 4), ("views", 12), ("view sphere", 1)):
        browser.click(f"tab-{tab}")
        panel = browser.until(lambda tab=tab: browser.part(f"panel-{tab}"), tab)
        browser.until(lambda p=panel: len(p.find_elements("css selector", "img")), f"pictures of {tab}")
        images = panel.find_elements("css selector", "img")
        assert len(images) == pictures
        browser.until(lambda i=images: all(int(x.get_attribute("naturalWidth")) > 50 for x in i), "loaded")
        if tab == "answer":  # the object, not the whole photograph
            x0, y0, x1, y1 = json.loads((folder / "box.json").read_text())
            room = 0.25 * max(x1 - x0, y1 - y0)
            wide = min(240, int(x1 + room) + 1) - max(0, int(x0 - room))
            assert wide < 200
            assert [int(x.get_attribute("naturalWidth")) for x in images] == pytest.approx([wide] * 2, abs=2)
        told = panel.text if tab == "views" else ""
        assert tab != "views" or re.search(r"S 0\.\d+\n.*\nhog 0\.\d+\nrepeatability 0\.\d+\nbox", told)
    browser.click("tab-3D")
    browser.until(lambda: browser.part("panel-3D").find_elements("css selector", "canvas"), "scene")
    # Something is drawn: the loader put the mesh and the photograph's plane into the scene.
    count = """
        const id = document.querySelector('.nicegui-scene').id.slice(1);
        let n = 0; getElement(id).scene.traverse(x => { if (x.isMesh) n++; }); return n;"""
    browser.until(lambda: browser.driver.execute_script(count) == 2, "mesh and photograph in the scene")


def test_by_hand_and_pulled_in(browser):
    before = browser.text("facts")
    browser.click("tab-answer")
    browser.click("+roll")
    browser.until(lambda: "rotated 4 degrees about z" in browser.text("facts"), "nudge")
    assert browser.text("facts").splitlines()[0] != before.splitlines()[0]
    browser.click("fit")
    browser.until(lambda: "contours fitted" in browser.text("facts"), "contours")
    browser.click("show-2")
    browser.until(lambda: "by hand" not in browser.text("facts") and browser.text("facts") != before, "second")
    for name, start in (("GLB", b"glTF"), ("PNG", b"\x89PNG")):
        browser.click(f"download-{name}")
        assert browser.downloaded({"GLB": "pose.glb", "PNG": "overlay.png"}[name]).startswith(start)


def test_broken_and_hostile_files_are_refused_and_nothing_is_lost(browser, folder):
    browser.upload("photograph", folder / "broken.png")
    browser.until(lambda: "broken.png" in browser.text("message"), "refusal")
    assert str(folder.parent) not in browser.text("message")
    assert browser.text("photo-facts") == "240 x 180 px"
    browser.upload("mesh", folder / "hostile.obj")
    browser.until(lambda: "hostile.obj" in browser.text("message"), "refusal")
    assert "NaN" in browser.text("message")
    browser.click("register")  # the photograph and the mesh from before are still there
    browser.until(lambda: browser.text("message") == "" and browser.text("stage") == "done", "answer")


def test_find_it_draws_what_it_thought_of_and_a_click_takes_it(browser, folder):
    watch = """
        const stage = document.querySelector('[data-testid=stage]');
        window.stages = [];
        new MutationObserver(() => stages.push(stage.textContent)).observe(
            stage, {childList: true, subtree: true, characterData: true})"""
    browser.driver.execute_script(watch)

    def stages():
        return browser.driver.execute_script("return stages")

    assert browser.box() == pytest.approx(json.loads((folder / "box.json").read_text()), abs=0.7)
    browser.until(lambda: "starting" in stages() or browser.click("find"), "pressed")
    browser.until(lambda: stages()[-1] == "done", "answer without a box")
    assert "localizing the object" in stages()
    assert browser.text("message") == browser.text("box-x0") == ""
    command = browser.text("command")
    assert "--box" not in command
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("CURVIREG_CACHE", str(folder / "cache"))
        assert main([*shlex.split(command)[1:], "--quiet"]) == 0
    written = json.loads((folder / "result" / "result.json").read_text())
    proposals = [place["box"] for place in written["localization"]["proposals"]][:MAX_PROPOSALS]
    assert proposals[0] == written["inputs"]["box"]
    assert len(proposals) > 1

    def dashed():
        """Boxes that are drawn for choice, each once."""
        photograph = browser.part("photograph")
        zoom = int(photograph.find_element("css selector", "img").get_attribute("naturalWidth")) / 240
        assert zoom == 1
        shown = photograph.find_elements("css selector", 'rect[stroke="white"][stroke-dasharray="4 6"]')
        sides = [[float(rect.get_attribute(name)) for name in ("x", "y", "width", "height")] for rect in shown]
        return [[x - 0.5, y - 0.5, x + w - 0.5, y + h - 0.5] for x, y, w, h in sides]

    drawn = browser.until(dashed, "proposals")
    assert len(drawn) == len(proposals)
    for one, other in zip(drawn, proposals, strict=True):
        assert one == pytest.approx(other)
    x0, y0, x1, y1 = proposals[0]
    middle = ((x0 + x1) / 2, (y0 + y1) / 2)
    browser.drag(middle, middle, 240)
    browser.until(lambda: browser.box() == [round(v, 1) for v in proposals[0]], "the box that was clicked on")
    assert not dashed()
    browser.until(lambda: "--box" in browser.text("command"), "the command has it")
    assert browser.text("stage") == "the inputs have changed since this result"

import importlib.util
import os
import shutil
import time
import urllib.request
from pathlib import Path

import cv2
import numpy as np
import pytest

PROGRAMS = [
    next(filter(None, map(shutil.which, names)), None)
    for names in (("chromium", "chromium-browser", "google-chrome"), ("chromedriver",))
]
MISSING = [name for name in ("nicegui", "selenium") if importlib.util.find_spec(name) is None]
MISSING += [
    name for name, path in zip(("chromium", "chromedriver"), PROGRAMS, strict=True) if path is None
]
OPTIONS = (
    "headless=new", "no-sandbox", "disable-gpu", "disable-quic", "no-first-run", "disable-background-networking",  # noqa: E501
    "disable-component-update", "disable-sync", "window-size=1500,1400", "use-angle=swiftshader",
    "enable-unsafe-swiftshader",
)  # fmt: skip


def wait_for(address):
    for _ in range(100):
        try:
            urllib.request.urlopen(address).close()
            return
        except OSError:
            time.sleep(0.1)
    raise AssertionError("the server does not answer")


class Browser:
    """A page; its parts are known by their test ids."""

    def __init__(self, folder, address):
        from selenium import webdriver

        options = webdriver.ChromeOptions()
        options.binary_location = PROGRAMS[0]
        for option in (*OPTIONS, f"user-data-dir={folder / 'profile'}"):
            options.add_argument(f"--{option}")
        options.add_experimental_option(
            "prefs", {"download.default_directory": str(folder / "downloads")}
        )
        self.driver = webdriver.Chrome(
            options=options, service=webdriver.ChromeService(PROGRAMS[1])
        )
        self.folder = folder
        self.driver.get(address)
        self.wait(lambda: self.part("register"), "the page")

    def find(self, selector):
        return self.driver.find_element("css selector", selector)

    def part(self, name):
        return self.find(f'[data-testid="{name}"]')

    def images(self, name):
        return self.part(name).find_elements("css selector", "img")

    def canvas(self, name):
        return self.wait(lambda: self.part(name).find_element("css selector", "canvas"), name)

    def is_pressed(self, name):
        return self.part(name).get_attribute("aria-pressed") == "true"

    def script(self, code, *arguments):
        return self.driver.execute_script(code, *arguments)

    def mouse(self, duration=250):
        """What the mouse does, each move in so many milliseconds."""
        from selenium.webdriver import ActionChains

        return ActionChains(self.driver, duration)

    def text(self, name):
        return self.part(name).get_attribute("value") or self.part(name).text

    def messages(self):
        parts = self.driver.find_elements("css selector", '[data-testid^="message-"]')
        return [part.text for part in parts if part.text]

    def wait(self, condition, what, seconds=300):
        deadline = time.monotonic() + seconds
        error = None
        while True:
            try:
                if value := condition():
                    return value
                error = None
            except Exception as caught:  # the page is not ready
                error = caught
            if time.monotonic() > deadline:
                said = f"{self.text('progress')!r}, {self.messages()!r}"
                raise AssertionError(f"{what}; page says {said}; {error}")
            time.sleep(0.1)

    def shows(self, name, text):
        self.wait(lambda: self.text(name) == text, f"{name}: {text}")

    def contains(self, name, text, count=1):
        """Wait until a part shows a text so many times."""
        self.wait(lambda: self.text(name).count(text) == count, f"{name}: {count} {text}")

    def has_box(self, *box, within=2.0):
        self.wait(lambda: self.box() == pytest.approx(box, abs=within), f"box {box}")

    def begins(self, name, text):
        self.wait(lambda: self.text(name).startswith(text), f"{name}: {text}...")

    def click(self, name):
        button = self.part(name)
        self.script("arguments[0].scrollIntoView({block: 'center'})", button)
        self.wait(lambda: button.click() or True, f"click {name}", 20)

    def choose(self, name):
        self.click(name)
        self.wait(lambda: self.is_pressed(name), f"{name} is chosen")

    def register(self):
        self.click("register")
        self.shows("progress", "done")

    def unfold(self, name):
        self.script("arguments[0].open = true", self.part(f"fold-{name}"))

    def upload(self, what, *paths):
        self.part(f"upload-{what}").send_keys("\n".join(map(str, paths)))

    def drop(self, *paths):
        """Drop files on the window, as a file manager does."""
        import base64

        files = [[path.name, base64.b64encode(path.read_bytes()).decode()] for path in paths]
        script = """
            const transfer = new DataTransfer();
            for (const [name, data] of arguments[0])
              transfer.items.add(new File([Uint8Array.from(atob(data), c => c.charCodeAt(0))], name));
            for (const type of ["dragover", "drop"])
              document.querySelector("footer, main").dispatchEvent(
                new DragEvent(type, {dataTransfer: transfer, bubbles: true, cancelable: true}))"""  # noqa: E501
        self.script(script, files)

    def emulate(self, width, height, *, dark=False):
        """Show the page as a screen of that size does, until it is called with a width of 0."""
        command = self.driver.execute_cdp_cmd
        if width:
            metrics = {
                "width": width,
                "height": height,
                "deviceScaleFactor": 1,
                "mobile": width < 600,
            }
            command("Emulation.setDeviceMetricsOverride", metrics)
        else:
            command("Emulation.clearDeviceMetricsOverride", {})
        value = "dark" if dark else "light"
        command(
            "Emulation.setEmulatedMedia",
            {"features": [{"name": "prefers-color-scheme", "value": value}]},
        )

    def picture(self, name, part=None):
        """Write pictures for the documentation, in light and in dark colours and on a phone, where
        ``part`` is in view, into the folder that CURVIREG_PICTURES names, if it does."""
        if folder := os.environ.get("CURVIREG_PICTURES"):
            for end, size in (("", (1440, 900)), ("-dark", (1440, 900)), ("-phone", (390, 844))):
                self.emulate(*size, dark=end == "-dark")
                self.driver.execute_cdp_cmd(
                    "Input.dispatchMouseEvent", {"type": "mouseMoved", "x": 1, "y": 1}
                )
                self.script("document.activeElement.blur(); scrollTo(0, 0)")
                if part and end == "-phone":
                    self.script("arguments[0].scrollIntoView({block: 'end'})", self.part(part))
                time.sleep(1)
                pixels = cv2.imdecode(
                    np.frombuffer(self.driver.get_screenshot_as_png(), np.uint8), cv2.IMREAD_COLOR
                )
                cv2.imwrite(
                    str(Path(folder) / f"{name}{end}.webp"), pixels, [cv2.IMWRITE_WEBP_QUALITY, 60]
                )
            self.emulate(1440, 900)

    def drag(self, start, end, size, held=None):
        """Drag the mouse between pixels of the photograph, whose width is ``size`` px; call
        ``held`` before the end."""
        image = self.part("photograph")
        self.script("arguments[0].scrollIntoView({block: 'center'})", image)
        zoom = image.size["width"] / size
        middle = image.size["width"] / 2, image.size["height"] / 2
        (x0, y0), (x1, y1) = (
            tuple(round((v + 0.5) * zoom - m) for v, m in zip(point, middle, strict=True))
            for point in (start, end)
        )
        chain = self.mouse(50).move_to_element_with_offset(image, x0, y0).click_and_hold()
        chain.move_by_offset((x1 - x0) // 2, (y1 - y0) // 2)
        chain.move_to_element_with_offset(image, x1, y1).perform()
        if held is not None:
            held()
        self.mouse(50).release().perform()

    def extent(self, width):
        """Box of the mesh that is drawn over the photograph, which is ``width`` px wide."""
        script = """
            const image = document.querySelectorAll('.canvas img')[1], canvas = document.createElement('canvas');
            [canvas.width, canvas.height] = [image.naturalWidth, image.naturalHeight];
            const context = canvas.getContext('2d');
            context.drawImage(image, 0, 0);
            const alpha = context.getImageData(0, 0, canvas.width, canvas.height).data.filter((_, k) => k % 4 === 3);
            const drawn = [...alpha.keys()].filter(k => alpha[k]), x = drawn.map(k => k % canvas.width);
            const least = values => values.reduce((a, b) => Math.min(a, b), 1e9);
            const y = drawn.map(k => Math.floor(k / canvas.width));
            const box = [least(x), least(y), -least(x.map(v => -v)), -least(y.map(v => -v))];
            return box.map(v => v * arguments[0] / canvas.width)"""  # noqa: E501
        return self.script(script, width)

    def box(self):
        facts = self.text("box-facts")
        return [float(v) for v in facts.split()] if facts[:1].isdigit() else None

    def downloaded(self, name):
        path = self.folder / "downloads" / name
        self.wait(
            lambda: path.is_file() and not list(path.parent.glob("*.crdownload")),
            f"download of {name}",
        )
        content = path.read_bytes()
        path.unlink()
        return content

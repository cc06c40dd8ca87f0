"""A page with the latest frame of a video and the contours of its pose:
``curvireg follow --show``."""

import sys
import tempfile
import threading
from pathlib import Path
from typing import Any, Self

from nicegui import app, ui
from starlette.responses import Response
from torch import Tensor

from ..registration import FailedRegistration, Registrar, Registration
from ..visualization.encoding import jpeg
from ..visualization.video import annotated_frame
from .server import listen, make_server

HOST = "127.0.0.1"
TICK_SECONDS = 0.04  # between two looks for a new frame
QUALITY = 80  # of the JPEG files
STOP_SECONDS = 5.0  # that the server may take to end
WAITING = "Waiting for the first frame."
ENDED = "The video has ended. This was its last frame; you can close the page."


class LivePage:
    """Opens a page that shows the latest frame; a frame is drawn only once the one before has
    reached a browser.

    As a context manager, it serves the page on this machine, in a thread.
    """

    def __init__(self, registrar: Registrar) -> None:
        self.registrar = registrar
        self.frame = b""
        self.number = 0
        self.ratio = 1.0
        self._wanted = True
        self._ended = False

    def __enter__(self) -> Self:
        app.get("/frame")(self._send)
        ui.page("/")(self._build)
        self._listener = listen(HOST, 0)
        self._folder = tempfile.TemporaryDirectory(prefix="curvireg-follow-")
        self._server = make_server(
            self._listener, HOST, browser_folder=Path(self._folder.name), printed_to=sys.stderr
        )
        self._thread = threading.Thread(
            target=self._server.run, args=([self._listener],), daemon=True
        )
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended = True
        self._thread.join(5 * TICK_SECONDS)  # windows show it
        self._server.should_exit = True
        self._thread.join(STOP_SECONDS)
        self._listener.close()
        self._folder.cleanup()

    def show(self, image: Tensor | None, result: Registration | FailedRegistration) -> None:
        """Take the next frame; dropped while the one before is on its way."""
        if self._wanted and image is not None:
            self._wanted = False
            self.ratio = image.shape[-1] / image.shape[-2]
            self.frame = jpeg(annotated_frame(self.registrar, image, result), QUALITY)
            self.number += 1

    def _send(self) -> Response:
        self._wanted = True
        return Response(self.frame, media_type="image/jpeg", headers={"Cache-Control": "no-store"})

    def _build(self) -> None:
        ui.dark_mode(None)
        ui.add_css("body:has(.ended) #popup { display: none !important }")  # not reconnecting
        note = ui.label(WAITING).props("data-testid=note")
        picture: Any = ui.interactive_image().props("data-testid=live")
        picture.shown = 0

        def refresh() -> None:
            note.set_visibility(self._ended or not self.number)
            if self._ended:
                note.set_text(ENDED)
                note.classes("ended")
            if picture.shown != self.number:
                picture.shown = self.number
                picture.set_source(f"frame?{self.number}")
                picture.style(f"width: min(100%, {95 * self.ratio:.1f}vh)")

        ui.timer(TICK_SECONDS, refresh)

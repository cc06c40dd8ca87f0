"""The server of the viewer: its secret address, its limits on requests and its files."""

import secrets
import shutil
import socket
import sys
import tempfile
import warnings
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from nicegui import app, ui
from starlette.responses import PlainTextResponse, Response

from ..evaluation.opening import RegisterOptions
from ..limits import MAX_MESH_BYTES, MAX_VIEWER_PAGES
from .page import Page
from .session import Session

__all__ = ["serve"]

_FORM_BYTES = 1 << 16  # of an upload, besides the file
_RECONNECT_SECONDS = 60.0


class _UploadLimit:
    """Refuse a request body without a length, or longer than any file may be, before it is read."""

    def __init__(self, inner: Callable[..., Awaitable[None]]) -> None:
        self.inner = inner

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] == "http" and scope["method"] not in ("GET", "HEAD", "OPTIONS"):
            length = dict(scope["headers"]).get(b"content-length", b"")
            if not length.isdigit() or int(length) > MAX_MESH_BYTES + _FORM_BYTES:
                await PlainTextResponse("too large", status_code=413)(scope, receive, send)
                return
        await self.inner(scope, receive, send)


def serve(options: RegisterOptions, *, host: str, port: int, browser: bool) -> None:
    """Serve pages with these inputs until Ctrl-C; the printed address contains a random token.

    Raises:
        CurviregError: a file of the options cannot be used.
    """
    Session(options).load()  # errors come before anything opens
    token = secrets.token_urlsafe(16)
    pages: dict[str, Page] = {}

    def build() -> None:
        if len(pages) >= MAX_VIEWER_PAGES:
            ui.label(f"{MAX_VIEWER_PAGES} pages are open already; close one and load this again")
            return
        name, folder = secrets.token_urlsafe(16), Path(tempfile.mkdtemp(prefix="curvireg-view-"))
        page = pages[name] = Page(Session(options), folder, f"/{token}/file/{name}")

        def close() -> None:
            page.session.cancel()
            pages.pop(name, None)
            shutil.rmtree(folder, ignore_errors=True)

        ui.context.client.on_delete(close)
        app.on_shutdown(lambda: shutil.rmtree(folder, ignore_errors=True))
        page.build()

    def file(page: str, name: str) -> Response:
        content, media_type = pages[page].files.get(name, (b"", "")) if page in pages else (b"", "")
        if not media_type:
            return PlainTextResponse("no such file", status_code=404)
        return Response(content, media_type=media_type, headers={"Cache-Control": "no-store"})

    ui.page(f"/{token}/", reconnect_timeout=_RECONNECT_SECONDS)(build)
    app.get(f"/{token}/file/{{page}}/{{name}}")(file)
    app.add_middleware(_UploadLimit)
    port = port or _free_port(host)
    address = f"http://{host}:{port}/{token}/"
    app.on_startup(lambda: print(f"curvireg: {address}   (Ctrl-C ends it)", flush=True))
    if host not in ("127.0.0.1", "localhost", "::1"):
        print("curvireg: everyone who can reach this machine and has this address can use the page", file=sys.stderr)
    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = Page.show_warning
        show = f"/{token}/" if browser else False
        ui.run(host=host, port=port, title="curvireg", reload=False, show=show, show_welcome_message=False)


def _free_port(host: str) -> int:
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
        probe.bind((host, 0))
        return int(probe.getsockname()[1])

"""The page's server: who may come in, how much may be sent, what files there are."""

import argparse
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

from ..limits import MAX_MESH_BYTES, MAX_VIEWER_PAGES
from .page import Page
from .session import Session

__all__ = ["serve"]

_FORM = 1 << 16  # bytes of a form around a file
_FOREVER = 60.0  # seconds after which a page that lost its browser is forgotten


class _UploadLimit:
    """Refuses what is sent before it is read, where it says no length or is longer than any file may be."""

    def __init__(self, inner: Callable[..., Awaitable[None]]) -> None:
        self.inner = inner

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] == "http" and scope["method"] not in ("GET", "HEAD", "OPTIONS"):
            length = dict(scope["headers"]).get(b"content-length", b"")
            if not length.isdigit() or int(length) > MAX_MESH_BYTES + _FORM:
                await PlainTextResponse("too large", status_code=413)(scope, receive, send)
                return
        await self.inner(scope, receive, send)


def serve(arguments: argparse.Namespace) -> None:
    """Serve the page until Ctrl-C; the address, with a token that nobody can guess, is printed.

    Raises:
        CurviregError: a photograph, mesh, box or camera was named that cannot be used.
    """
    Page.load(Session(arguments), arguments)  # says what is wrong before anything opens
    token = secrets.token_urlsafe(16)
    pages: dict[str, Page] = {}

    def build() -> None:
        if len(pages) >= MAX_VIEWER_PAGES:
            ui.label(f"{MAX_VIEWER_PAGES} pages are open already; close one and load this again")
            return
        name, folder = secrets.token_urlsafe(16), Path(tempfile.mkdtemp(prefix="curvireg-view-"))
        page = pages[name] = Page(Session(argparse.Namespace(**vars(arguments))), folder, f"/{token}/file/{name}")

        def forget() -> None:
            page.session.stop()
            pages.pop(name, None)
            shutil.rmtree(folder, ignore_errors=True)

        ui.context.client.on_delete(forget)
        app.on_shutdown(lambda: shutil.rmtree(folder, ignore_errors=True))
        page.build(arguments)

    def file(page: str, name: str) -> Response:
        content, kind = pages[page].files.get(name, (b"", "")) if page in pages else (b"", "")
        if not kind:
            return PlainTextResponse("not here", status_code=404)
        return Response(content, media_type=kind, headers={"Cache-Control": "no-store"})

    ui.page(f"/{token}/", reconnect_timeout=_FOREVER)(build)
    app.get(f"/{token}/file/{{page}}/{{name}}")(file)
    app.add_middleware(_UploadLimit)
    port = arguments.port or _free_port(arguments.host)
    address = f"http://{arguments.host}:{port}/{token}/"
    app.on_startup(lambda: print(f"curvireg: {address}   (Ctrl-C ends it)", flush=True))
    if arguments.host not in ("127.0.0.1", "localhost", "::1"):
        print("curvireg: whoever has this address and reaches this machine can use the page", file=sys.stderr)
    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = Page.show_warning
        show = False if arguments.no_browser else f"/{token}/"
        ui.run(host=arguments.host, port=port, title="curvireg", reload=False, show=show, show_welcome_message=False)


def _free_port(host: str) -> int:
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
        probe.bind((host, 0))
        return int(probe.getsockname()[1])

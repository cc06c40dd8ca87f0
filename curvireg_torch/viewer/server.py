"""The server of the viewer: its secret address, its limits on requests and its files."""

import errno
import os
import secrets
import shutil
import socket
import sys
import tempfile
import threading
import warnings
import webbrowser
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import uvicorn
from fastapi import FastAPI
from nicegui import app, ui
from starlette.responses import PlainTextResponse, Response

from ..errors import InvalidInputError
from ..evaluation.opening import RegisterOptions
from ..limits import MAX_MESH_BYTES, MAX_VIEWER_PAGES
from .guard import Guard, allowed_hosts, public_addresses
from .page import Page
from .session import Session

__all__ = ["serve"]

_FORM_BYTES = 1 << 16  # of an upload, besides the file
_RECONNECT_SECONDS = 60.0
_CONNECT_SECONDS = 20.0


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
        InvalidInputError: nothing can listen on that host and port.
    """
    listener = listen(host, port)
    with listener:
        Session(options).load()  # errors come before anything opens
        token = secrets.token_urlsafe(16)
        prefix = f"/{token}"
        site = FastAPI(openapi_url=None)
        add_pages(options)
        ui.run_with(
            site, mount_path=prefix, title="curvireg", language="en-US", tailwind=True, show_welcome_message=False
        )
        addresses = [f"http://{name}{prefix}/" for name in public_addresses(host, listener.getsockname()[1])]
        guard = Guard(site, prefix=prefix, hosts=allowed_hosts(host))
        server = uvicorn.Server(uvicorn.Config(guard, log_level="warning", server_header=False, ws="wsproto"))
        print(f"curvireg: {addresses[0]}   (Ctrl-C ends it)", flush=True)
        if allowed_hosts(host) != allowed_hosts("127.0.0.1"):
            print(
                "curvireg: everyone who can reach this machine and has this address can use the page", file=sys.stderr
            )
        if browser:
            threading.Timer(0.5, webbrowser.open, (addresses[-1],)).start()
        with warnings.catch_warnings():
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = Page.show_warning
            server.run(sockets=[listener])


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens on a host and a port, 0 for a free one."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listener = socket.socket(family, kind, protocol)
    except OSError as error:
        raise InvalidInputError(f"--host {host}: {error.strerror}") from None
    try:
        if os.name == "posix":
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen()
    except OSError as error:
        listener.close()
        if error.errno == errno.EADDRINUSE:
            raise InvalidInputError(f"--port {port}: in use by another program; leave it out for a free one") from None
        raise InvalidInputError(f"--host {host} --port {port}: {error.strerror}") from None
    return listener


def add_pages(options: RegisterOptions) -> None:
    """Add the page and its files to the application of NiceGUI."""
    pages: dict[str, Page] = {}

    async def build() -> None:
        client = ui.context.client
        await client.connected(timeout=_CONNECT_SECONDS)  # a request without a browser takes no place
        if len(pages) >= MAX_VIEWER_PAGES:
            ui.label(f"{MAX_VIEWER_PAGES} pages are open already; close one and load this again")
            return
        name, folder = secrets.token_urlsafe(16), Path(tempfile.mkdtemp(prefix="curvireg-view-"))
        page = pages[name] = Page(Session(options), folder, f"file/{name}")

        def close() -> None:
            page.session.cancel()
            pages.pop(name, None)
            shutil.rmtree(folder, ignore_errors=True)

        client.on_delete(close)
        app.on_shutdown(lambda: shutil.rmtree(folder, ignore_errors=True))
        page.build()

    def file(page: str, name: str) -> Response:
        content, media_type = pages[page].files.get(name, (b"", "")) if page in pages else (b"", "")
        if not media_type:
            return PlainTextResponse("no such file", status_code=404)
        return Response(content, media_type=media_type, headers={"Cache-Control": "no-store"})

    ui.page("/", reconnect_timeout=_RECONNECT_SECONDS)(build)
    app.get("/file/{page}/{name}")(file)
    app.add_middleware(_UploadLimit)
    app.add_exception_handler(404, lambda *_: PlainTextResponse("not found", status_code=404))

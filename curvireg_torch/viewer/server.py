"""The server of the viewer: its secret address, its pages, their files and uploads."""

import errno
import os
import re
import secrets
import socket
import sys
import tempfile
import threading
import warnings
import webbrowser
from pathlib import Path
from urllib.parse import unquote

import uvicorn
from fastapi import FastAPI
from nicegui import app, ui
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response

from ..errors import MAX_VIEWER_PAGES, InvalidInputError
from ..evaluation.opening import RegisterOptions
from ..utils.threads import one_torch_thread
from .guard import Guard, allowed_hosts, public_addresses
from .page import Page, add_assets
from .session import Session
from .uploads import file_name, size_limit
from .workspace import Workspaces, show_warning

__all__ = ["serve"]

_RECONNECT_SECONDS = 5.0  # a reload takes less; the work is kept longer
_SWEEP_SECONDS = 10.0
_CONNECT_SECONDS = 20.0
_NAME_BYTES = 12
_PAGE_NAME = re.compile(r"[-\w]{16}")  # of token_urlsafe
_ICON = (
    "<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 16 16'><path d='M8 1l6 3.5v7L8 15l-6-3.5v-7z' "
    "fill='none' stroke='#0a7d3c' stroke-width='2'/></svg>"
)


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
        add_pages(Workspaces(options, Path(tempfile.mkdtemp(prefix="curvireg-view-"))))
        ui.run_with(
            site,
            mount_path=prefix,
            title="curvireg",
            favicon=_ICON,
            language="en-US",
            dark=None,
            tailwind=False,
            show_welcome_message=False,
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
        with one_torch_thread(), warnings.catch_warnings():
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = show_warning
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


def add_pages(spaces: Workspaces) -> None:
    """Add the page, its files and its uploads to the application of NiceGUI."""

    async def build(page: str) -> Response | None:
        if _PAGE_NAME.fullmatch(page) is None:
            return PlainTextResponse("not found", status_code=404)
        add_assets()
        client = ui.context.client
        await client.connected(timeout=_CONNECT_SECONDS)  # a request without a browser takes no place
        workspace = spaces.join(page)
        if workspace is None:
            ui.label(f"{MAX_VIEWER_PAGES} pages are open already; close one and load this again").classes("full")
            return None
        client.on_delete(lambda: spaces.leave(page))
        Page(workspace).build()
        if not workspace.loaded:
            await workspace.load()
        return None

    def new_page() -> Response:
        return RedirectResponse(secrets.token_urlsafe(_NAME_BYTES))

    def send_file(page: str, name: str) -> Response:
        content, media_type = spaces.items[page].files.get(name, (b"", "")) if page in spaces.items else (b"", "")
        if not media_type:
            return PlainTextResponse("no such file", status_code=404)
        return Response(content, media_type=media_type, headers={"Cache-Control": "no-store"})

    async def receive_file(page: str, request: Request) -> Response:
        workspace = spaces.items.get(page)
        if workspace is None or workspace.pages == 0:
            return PlainTextResponse("no such page", status_code=404)
        name = file_name(unquote(request.headers.get("x-file-name", "")))
        length = request.headers.get("content-length", "")
        try:
            kind, limit = size_limit(name)
            if not length.isdigit() or int(length) > limit:
                raise InvalidInputError(f"{name}: a {kind} may have {limit:,} bytes")
            await workspace.receive(name, int(length), request.stream())
        except InvalidInputError as error:
            workspace.messages["file"] = str(error)
            return PlainTextResponse(str(error), status_code=413)
        except ClientDisconnect:
            workspace.messages["file"] = f"{name}: it did not arrive; send it again"
        return Response(status_code=204)

    app.get("/", include_in_schema=False)(new_page)
    ui.page("/{page}", reconnect_timeout=_RECONNECT_SECONDS)(build)
    app.get("/{page}/file/{name}")(send_file)
    app.post("/{page}/upload")(receive_file)
    app.add_exception_handler(404, lambda *_: PlainTextResponse("not found", status_code=404))
    app.timer(_SWEEP_SECONDS, spaces.sweep)
    app.on_shutdown(spaces.close)

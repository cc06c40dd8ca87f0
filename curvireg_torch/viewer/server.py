"""The server of the viewer: its secret address, what it refuses, the page, its files and uploads."""

import errno
import secrets
import socket
import sys
import tempfile
import threading
import warnings
import webbrowser
from contextlib import suppress
from pathlib import Path
from typing import TextIO
from urllib.parse import unquote, urlsplit

import uvicorn
from fastapi import FastAPI
from nicegui import app, ui
from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ..errors import MAX_MESH_BYTES, InvalidInputError
from ..evaluation.opening import RegisterOptions
from ..utils.files import file_name
from ..utils.threads import one_torch_thread
from .page import build_page
from .workspace import Workspace, show_warning

SECURITY_HEADERS = {
    # Vue compiles templates in the browser, which takes "unsafe-eval"; NiceGUI's scripts are inline and have no nonce.
    "content-security-policy": "default-src 'none'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self' blob:; "
    "worker-src 'self' blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",  # the address is a secret
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}
"""Of every answer."""

_LOOPBACK = ("127.0.0.1", "localhost", "::1", "[::1]")
_EVERYONE = ("0.0.0.0", "::")


def serve(options: RegisterOptions, *, host: str, port: int, browser: bool) -> None:
    """Serve the page with these inputs until Ctrl-C; the printed address contains a random token."""
    with listen(host, port) as listener, tempfile.TemporaryDirectory(prefix="curvireg-view-") as folder:
        workspace = Workspace(options, Path(folder))
        workspace.load()  # errors come before anything opens
        add_page(workspace)
        server = make_server(listener, host, browser=browser)
        with one_torch_thread(), warnings.catch_warnings():
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = show_warning
            with suppress(KeyboardInterrupt):  # uvicorn raises it again once the server has ended
                server.run(sockets=[listener])


def make_server(
    listener: socket.socket, host: str, *, browser: bool, printed_to: TextIO | None = None
) -> uvicorn.Server:
    """A guarded server of the application of NiceGUI, whose secret address is printed, and perhaps opened."""
    prefix = f"/{secrets.token_urlsafe(16)}"
    site = FastAPI(openapi_url=None)
    ui.run_with(
        site,
        mount_path=prefix,
        title="curvireg",
        favicon="📐",
        language="en-US",
        dark=None,
        tailwind=False,
        show_welcome_message=False,
    )
    # h11 refuses requests with two hosts.
    config = uvicorn.Config(guarded(site, host), log_level="warning", server_header=False, ws="wsproto", http="h11")
    name = socket.gethostname() if host in _EVERYONE else f"[{host}]" if ":" in host else host
    address = f"http://{name}:{listener.getsockname()[1]}{prefix}/"
    print(f"curvireg: {address}   (Ctrl-C ends it)", flush=True, file=printed_to)
    if host not in _LOOPBACK:
        print("curvireg: everyone who reaches this machine with this address can use the page", file=sys.stderr)
    if browser:
        threading.Timer(0.5, webbrowser.open, (address,)).start()
    return uvicorn.Server(config)


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens on a host and a port, 0 for a free one."""
    try:
        return socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise InvalidInputError(f"--port {port}: in use by another program; leave it out for a free one") from None
        raise InvalidInputError(f"--host {host} --port {port}: {error.strerror}") from None


def guarded(site: ASGIApp, host: str) -> ASGIApp:
    """The site, without requests of other sites, and with :data:`SECURITY_HEADERS` on every answer.

    A browser that is led here by another site's name (DNS rebinding) sends that name as Host, which must be that of
    ``host``; anything goes if everyone may connect. A script of another site sends its own Origin.
    """
    names = ["*"] if host in _EVERYONE else list(_LOOPBACK) if host in _LOOPBACK else [host.lower()]
    trusted = TrustedHostMiddleware(site, names, www_redirect=False)

    async def guard(scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with_headers(message: Message) -> None:
            if message["type"].endswith("response.start"):
                MutableHeaders(scope=message).update(SECURITY_HEADERS)
            await send(message)

        headers = Headers(scope=scope) if scope["type"] != "lifespan" else Headers()
        own = headers.get("host", "").lower()
        if any(urlsplit(origin).netloc.lower() != own for origin in headers.getlist("origin")):
            refusal = PlainTextResponse("requests of other sites are refused", status_code=403)
            await refusal(scope, receive, send_with_headers)
        else:
            await trusted(scope, receive, send_with_headers)

    return guard


def add_page(workspace: Workspace) -> None:
    """Add the page, its files and its uploads to the application of NiceGUI."""

    def send_file(name: str) -> Response:
        content, media_type = workspace.files.get(name, (b"", ""))
        if not media_type:
            return PlainTextResponse("no such file", status_code=404)
        return Response(content, media_type=media_type, headers={"Cache-Control": "no-store"})

    async def receive_file(request: Request) -> Response:
        name = file_name(unquote(request.headers.get("x-file-name", "")))
        length = request.headers.get("content-length", "")
        try:
            if not length.isdigit() or int(length) > MAX_MESH_BYTES:
                raise InvalidInputError(f"{name}: a file may have {MAX_MESH_BYTES:,} bytes")
            await workspace.receive(name, int(length), request.stream())
        except InvalidInputError as error:
            workspace.messages["file"] = str(error)
            return PlainTextResponse(str(error), status_code=413)
        except ClientDisconnect:
            workspace.messages["file"] = f"{name}: it did not arrive; send it again"
        return Response(status_code=204)

    ui.page("/")(lambda: build_page(workspace))
    app.get("/file/{name}")(send_file)
    app.post("/upload")(receive_file)
    app.add_exception_handler(404, lambda *_: PlainTextResponse("not found", status_code=404))
    app.on_shutdown(workspace.stop)

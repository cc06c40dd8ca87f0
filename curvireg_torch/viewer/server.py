"""The server of the viewer: its secret address, what it refuses, its pages, their files and uploads."""

import errno
import ipaddress
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
from urllib.parse import unquote, urlsplit

import uvicorn
from fastapi import FastAPI
from nicegui import app, ui
from starlette.datastructures import Headers
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ..errors import MAX_MESH_BYTES, MAX_VIEWER_PAGES, InvalidInputError
from ..evaluation.opening import RegisterOptions
from ..utils.threads import one_torch_thread
from .page import Page, add_assets
from .session import Session
from .workspace import Workspaces, file_name, show_warning

__all__ = ["SECURITY_HEADERS", "guarded", "listen", "serve"]

RECONNECT_SECONDS = 5.0
"""How long a page may be away; a reload takes less. The work is kept longer."""

CONNECT_SECONDS = 20.0
"""How long a request may take to become a page."""

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
_PAGE_NAME = re.compile(r"[-\w]{16}")  # of token_urlsafe
_NAME_BYTES = 12
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
        prefix = f"/{secrets.token_urlsafe(16)}"
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
        # h11 refuses requests with two hosts.
        config = uvicorn.Config(guarded(site, host), log_level="warning", server_header=False, ws="wsproto", http="h11")
        addresses = [f"http://{name}{prefix}/" for name in public_addresses(host, listener.getsockname()[1])]
        print(f"curvireg: {addresses[0]}   (Ctrl-C ends it)", flush=True)
        if host not in _LOOPBACK:
            print(
                "curvireg: everyone who can reach this machine and has this address can use the page", file=sys.stderr
            )
        if browser:
            threading.Timer(0.5, webbrowser.open, (addresses[-1],)).start()
        with one_torch_thread(), warnings.catch_warnings():
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = show_warning
            uvicorn.Server(config).run(sockets=[listener])


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


def public_addresses(host: str, port: int) -> list[str]:
    """Hosts with ports under which a server that listens on ``host`` is reached, the best first.

    Example:
        >>> public_addresses("::1", 8080)
        ['[::1]:8080']
    """
    if not _is_everyone(host):
        return [f"[{host}]:{port}" if ":" in host else f"{host}:{port}"]
    names = ["127.0.0.1"]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # an address for documentation; a datagram socket only chooses the route
            names.insert(0, probe.getsockname()[0])
        except OSError:  # no network
            pass
    return [f"{name}:{port}" for name in dict.fromkeys(names)]


def _is_everyone(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_unspecified
    except ValueError:
        return False


def guarded(site: ASGIApp, host: str) -> ASGIApp:
    """The site, without requests of other sites, and with :data:`SECURITY_HEADERS` on every answer.

    A browser that is led here by another site's name (DNS rebinding) sends that name as Host, which must be that of
    ``host``; anything goes if everyone may connect. A script of another site sends its own Origin.
    """
    names = ["*"] if _is_everyone(host) else list(_LOOPBACK) if host in _LOOPBACK else [host.lower()]
    trusted = TrustedHostMiddleware(site, names, www_redirect=False)
    own_headers = [(name.encode(), value.encode()) for name, value in SECURITY_HEADERS.items()]
    replaced = {b"server", *(name for name, _ in own_headers)}

    async def guard(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await site(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"].endswith("response.start"):
                theirs = [(name.lower(), value) for name, value in message["headers"]]
                kept = [(n, v) for n, v in theirs if n not in replaced and not n.startswith(b"access-control-")]
                message = {**message, "headers": [*kept, *own_headers]}
            await send(message)

        headers = Headers(scope=scope)
        own = headers.get("host", "").lower()
        if any(urlsplit(origin).netloc.lower() != own for origin in headers.getlist("origin")):
            refusal = PlainTextResponse("requests of other sites are refused", status_code=403)
            await refusal(scope, receive, send_with_headers)
        else:
            await trusted(scope, receive, send_with_headers)

    return guard


def add_pages(spaces: Workspaces) -> None:
    """Add the page, its files and its uploads to the application of NiceGUI."""

    async def build(page: str) -> Response | None:
        if _PAGE_NAME.fullmatch(page) is None:
            return PlainTextResponse("not found", status_code=404)
        add_assets()
        client = ui.context.client
        await client.connected(timeout=CONNECT_SECONDS)  # a request without a browser takes no place
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
            if not length.isdigit() or int(length) > MAX_MESH_BYTES:
                raise InvalidInputError(f"{name}: a file may have {MAX_MESH_BYTES:,} bytes")
            await workspace.receive(name, int(length), request.stream())
        except InvalidInputError as error:
            workspace.messages["file"] = str(error)
            return PlainTextResponse(str(error), status_code=413)
        except ClientDisconnect:
            workspace.messages["file"] = f"{name}: it did not arrive; send it again"
        return Response(status_code=204)

    app.get("/", include_in_schema=False)(new_page)
    ui.page("/{page}", reconnect_timeout=RECONNECT_SECONDS)(build)
    app.get("/{page}/file/{name}")(send_file)
    app.post("/{page}/upload")(receive_file)
    app.add_exception_handler(404, lambda *_: PlainTextResponse("not found", status_code=404))
    app.on_shutdown(spaces.close)

"""The server of the viewer: its secret address, what it refuses, the page, its files and
uploads."""

import asyncio
import errno
import ipaddress
import logging
import os
import re
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
from urllib.parse import unquote

import uvicorn
from fastapi import FastAPI
from nicegui import app, ui
from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ..errors import MAX_MESH_BYTES, InvalidInputError, OutputError
from ..jobs.options import RegisterOptions
from ..utils.files import file_name, hangup_signals, signals_handled, terminable
from .page import build_page
from .workspace import Workspace, show_warning

SECURITY_HEADERS = {
    # Vue compiles templates in the browser, which takes "unsafe-eval"; NiceGUI's scripts are inline
    # and have no nonce.
    "content-security-policy": "default-src 'none'; script-src 'self' 'unsafe-inline' "
    "'unsafe-eval'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
    "connect-src 'self' blob:; "
    "worker-src 'self' blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",  # the address is a secret
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}
"""Of every answer."""

SECONDS_TO_END = 3  # that requests on their way may take once the server ends
_LOOPBACK = ("127.0.0.1", "localhost", "::1")
# a header Host: name, or address in brackets, and port
_HOST = re.compile(r"(\[[^][]*\]|[^][:@/?#]+)(?::\d*)?")


def serve(options: RegisterOptions, *, host: str, port: int, browser: bool) -> None:
    """Serve the page with these inputs until Ctrl-C; the printed address contains a random
    token."""
    # The page's shutdown removes what is in the folder; a job that still runs may add to it.
    uploads = tempfile.TemporaryDirectory(prefix="curvireg-view-", ignore_cleanup_errors=True)
    for name in ("nicegui", "uvicorn.error"):
        logging.getLogger(name).addFilter(is_worth_saying)
    with terminable(), listen(host, port) as listener, uploads as folder:
        workspace = Workspace(options, Path(folder))
        workspace.load()  # errors come before anything opens
        _add_page(workspace)
        server = make_server(listener, host, browser_folder=Path(folder) if browser else None)
        hangup = signals_handled(hangup_signals(), server.handle_exit)  # uvicorn handles the others
        with warnings.catch_warnings(), hangup:
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = show_warning
            with suppress(KeyboardInterrupt):  # uvicorn raises it again once the server has ended
                server.run(sockets=[listener])


def is_worth_saying(record: logging.LogRecord) -> bool:
    """False for complaints that tasks end late when the page ends: of NiceGUI on a busy machine,
    and of uvicorn about uploads on their way."""
    error = record.exc_info[1] if record.exc_info else None
    return not (
        isinstance(error, asyncio.CancelledError)
        or record.getMessage().startswith(("Could not cancel", "Cancel "))
    )


def make_server(
    listener: socket.socket,
    host: str,
    *,
    browser_folder: Path | None,
    printed_to: TextIO | None = None,
) -> uvicorn.Server:
    """A guarded server of the application of NiceGUI, whose secret address is printed; it opens in
    the browser by a file in ``browser_folder``, if that is given."""
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
    config = uvicorn.Config(
        guarded(site, host, listener.getsockname()[0]),
        log_level="warning",
        server_header=False,
        ws="wsproto",
        http="h11",
        timeout_graceful_shutdown=SECONDS_TO_END,
    )
    address = print_address(listener, host, prefix, printed_to)
    if browser_folder is not None:
        page = redirect_file(browser_folder, address)
        threading.Timer(0.5, webbrowser.open, (page.as_uri(),)).start()
    return uvicorn.Server(config)


def print_address(
    listener: socket.socket, host: str, prefix: str, printed_to: TextIO | None = None
) -> str:
    """Print and return the address of the page, and say who may use it."""
    bound, number = listener.getsockname()[:2]
    name = socket.gethostname() if _is_everyone(bound) else _plain_host(host)
    name = f"[{name}]" if ":" in name else name
    address = f"http://{name}:{number}{prefix}/"
    print(f"curvireg: {address}   (Ctrl-C ends it)", flush=True, file=printed_to)
    if not _is_loopback(bound):
        print(
            "curvireg: everyone who reaches this machine with this address can use the page",
            file=sys.stderr,
        )
    return address


def redirect_file(folder: Path, address: str) -> Path:
    """A page that leads to the secret address, which only this user can read: what a program is
    started with, such as the address that a browser is to open, all users of a machine can see."""
    page = folder / "open.html"
    content = f"""<!DOCTYPE html>
<meta charset="utf-8"><meta name="referrer" content="no-referrer"><meta http-equiv="refresh" content="0; url={address}">
<title>curvireg</title><a href="{address}">To the page</a>
"""  # noqa: E501
    with os.fdopen(
        os.open(page, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8"
    ) as file:
        file.write(content)
    return page


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens on a host, perhaps an IPv6 address in brackets, and a port, 0 for a
    free one."""
    host = host.strip("[]")
    try:
        return socket.create_server(
            (host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET
        )
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise InvalidInputError(
                f"--port {port}: in use by another program; leave it out for a free one"
            ) from None
        raise InvalidInputError(f"--host {host} --port {port}: {error.strerror}") from None


def guarded(site: ASGIApp, *hosts: str) -> ASGIApp:
    """The site, without requests of other sites, and with :data:`SECURITY_HEADERS` on every answer.

    A browser that is led here by another site's name (DNS rebinding) sends that name as Host, which
    must be one of ``hosts``; anything goes if everyone may connect. A script of another site sends
    its own Origin.
    """
    names = set(map(_plain_host, hosts))
    if any(map(_is_loopback, hosts)):
        names |= set(_LOOPBACK)
    is_open = any(map(_is_everyone, hosts))

    async def guard(scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with_headers(message: Message) -> None:
            if message["type"].endswith("response.start"):
                MutableHeaders(scope=message).update(SECURITY_HEADERS)
            await send(message)

        if scope["type"] == "lifespan":
            await site(scope, receive, send)
            return
        headers = Headers(scope=scope)
        own = headers.get("host", "").lower()
        named = _HOST.fullmatch(own)
        is_known = is_open or (named is not None and _plain_host(named[1]) in names)
        answer = site
        if any(origin.partition("://")[2].lower() != own for origin in headers.getlist("origin")):
            answer = PlainTextResponse("requests of other sites are refused", status_code=403)
        elif not is_known:
            words = "this is not the name of the page's machine"
            answer = PlainTextResponse(words, status_code=400)
        await answer(scope, receive, send_with_headers)

    return guard


def _plain_host(host: str) -> str:
    """A host in the one way in which it is compared: of IPv6 addresses there are many spellings."""
    # the zone behind % has a meaning on this machine only
    host = host.strip("[]").partition("%")[0].lower()
    try:
        return ipaddress.ip_address(host).compressed
    except ValueError:
        return host


def _is_everyone(host: str) -> bool:
    return _plain_host(host) in ("0.0.0.0", "::")


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(_plain_host(host)).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def _add_page(workspace: Workspace) -> None:
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
            is_first = request.headers.get("x-first", "1") == "1"
            await workspace.receive(name, int(length), request.stream(), is_first=is_first)
        except InvalidInputError as error:
            workspace.errors["file"] = str(error)
            return PlainTextResponse(
                str(error), status_code=507 if isinstance(error, OutputError) else 413
            )
        except ClientDisconnect:
            workspace.errors["file"] = f"{name}: it did not arrive; send it again"
        return Response(status_code=204)

    ui.page("/")(lambda: build_page(workspace))
    app.get("/file/{name}")(send_file)
    app.post("/upload")(receive_file)
    app.add_exception_handler(404, lambda *_: PlainTextResponse("not found", status_code=404))
    app.on_shutdown(workspace.close)

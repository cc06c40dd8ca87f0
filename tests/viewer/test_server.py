import asyncio
import logging
import os
import re
import socket
from http.client import HTTPConnection
from urllib.parse import urlsplit

import pytest

from tests._support import refused

pytest.importorskip("nicegui", reason="nicegui is not installed")

from curvireg_torch.viewer.server import (
    SECURITY_HEADERS,
    guarded,
    is_worth_saying,
    listen,
    print_address,
    redirect_file,
)


async def page(scope, _, send):
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
    else:
        await send(
            {
                "type": "http.response.start",
                "status": 200,
                "headers": [(b"x-frame-options", b"ALLOWALL")],
            }
        )
        await send({"type": "http.response.body", "body": b"page"})


def answer(site, kind="http", also=None, **headers):
    """The first message that answers a request to a site for one host."""
    pairs = [
        (name.encode(), value.encode())
        for name, value in {"host": "127.0.0.1:8080", **headers}.items()
    ]
    scope = {"type": kind, "path": "/", "method": "GET", "headers": pairs}
    scope["extensions"] = {"websocket.http.response": {}}
    sent = []

    async def receive():
        return {"type": f"{kind}.{'connect' if kind == 'websocket' else 'request'}"}

    async def send(message):
        sent.append(message)

    hosts = [site] if also is None else [site, also]
    asyncio.run(guarded(page, *hosts)(scope, receive, send))
    return sent[0]


def status(site, host="127.0.0.1:8080", **headers):
    """Status of the answer; that of a request for a channel is the same."""
    found = answer(site, host=host, **headers)["status"]
    assert answer(site, "websocket", host=host, **headers).get("status", 200) == found
    return found


def test_a_page_answers_to_its_own_names_and_origins_only():
    for host in ("127.0.0.1:8080", "localhost:9000", "[::1]:8080", "LOCALHOST"):
        assert (
            status("127.0.0.1", host) == status("127.0.0.1", host, origin=f"http://{host}") == 200
        ), host
    for host in ("evil.example", "127.0.0.1.evil.example:8080", "192.168.1.7", "[::1", ""):
        assert status("127.0.0.1", host) == 400, host
    for origin in (
        "http://evil.example",
        "null",
        "http://127.0.0.1:9000",
        "http://localhost:8080",
        "http://[",
        "",
    ):
        assert status("127.0.0.1", origin=origin) == status("0.0.0.0", origin=origin) == 403, origin
    for host in ("192.168.1.7:80", "[fe80::1]:80", "bench"):
        assert status("0.0.0.0", host) == 200
    assert (status("bench.lan", "BENCH.lan:80"), status("bench.lan", "192.168.1.7")) == (200, 400)


def test_ipv6_addresses_are_hosts_in_any_spelling():
    for host in ("fe80::1", "FE80:0::1", "[fe80::1]", "fe80::1%eth0"):
        assert status(host, "[fe80::1]:8080") == status(host, "[fe80:0:0::1]") == 200, host
        for other in ("[fe80::2]:8080", "fe80", "[fe80::1", "fe80::1", "[]", "127.0.0.1", "[::1]"):
            assert status(host, other) == 400, other
    assert status("::1", "[::1]:8080") == status("0:0::1", "localhost:9") == 200
    assert status("::1", "evil.example") == 400
    for host in ("::", "0::0", "[::]"):
        assert status(host, "bench:80") == 200


def test_a_host_header_is_a_name_and_a_port_alone():
    for header in (
        "evil@127.0.0.1",
        "127.0.0.1/x",
        "127.0.0.1:80:80",
        "127.0.0.1?",
        "127.0.0.1#",
        "127.0.0.1:x",
    ):
        assert status("127.0.0.1", header) == 400, header


@pytest.mark.parametrize(
    ("host", "own"),
    [
        ("127.0.0.1", "127.0.0.1"),
        ("localhost", "localhost"),
        ("127.1", "127.1"),
        ("::1", "[::1]"),
        ("[::1]", "[::1]"),
        ("0.0.0.0", None),
        ("0", None),
        ("::", None),
    ],
)
def test_the_printed_address_names_the_host(capsys, host, own):
    """The machine's name where everyone may connect, who is warned."""
    shown = own or socket.gethostname()
    with listen(host, 0) as listener:
        bound, port = listener.getsockname()[:2]
        address = print_address(listener, host, "/secret")
    assert address == f"http://{shown}:{port}/secret/"
    printed = capsys.readouterr()
    assert printed.out == f"curvireg: {address}   (Ctrl-C ends it)\n"
    assert ("everyone who reaches this machine" in printed.err) is (own is None)
    address = f"[{bound}]" if ":" in bound else bound
    for header in (f"{shown}:{port}", f"{address}:{port}"):
        assert answer(host, also=bound, host=header)["status"] == 200, header
    assert answer(host, also=bound, host="evil.example")["status"] == (400 if own else 200)


@pytest.mark.skipif(os.name != "posix", reason="files of other systems have no such mode")
def test_the_file_with_the_secret_address_is_for_its_user_alone(tmp_path):
    before = os.umask(0)
    try:
        page = redirect_file(tmp_path, "http://127.0.0.1:8080/secret")
    finally:
        os.umask(before)
    assert page.stat().st_mode & 0o777 == 0o600
    assert "http://127.0.0.1:8080/secret" in page.read_text(encoding="utf-8")
    with pytest.raises(FileExistsError):  # what somebody else has put there is not written to
        redirect_file(tmp_path, "http://127.0.0.1:8080/secret")


def test_every_answer_has_the_security_headers():
    for headers in ({}, {"host": "evil.example"}, {"origin": "http://evil.example"}):
        pairs = [
            (name.decode(), value.decode())
            for name, value in answer("127.0.0.1", **headers)["headers"]
        ]
        assert sorted(pair for pair in pairs if pair[0] in SECURITY_HEADERS) == sorted(
            SECURITY_HEADERS.items()
        )
    policy = dict(
        part.strip().split(" ", 1)
        for part in SECURITY_HEADERS["content-security-policy"].split(";")
    )
    assert policy["default-src"] == policy["frame-ancestors"] == policy["base-uri"] == "'none'"
    allowed = {"'self'", "'none'", "'unsafe-inline'", "'unsafe-eval'", "data:", "blob:"}
    assert {source for sources in policy.values() for source in sources.split()} <= allowed
    assert "data:" not in policy["script-src"]


def test_listen_names_a_used_port_and_a_host_that_is_not_ours():
    with listen("127.0.0.1", 0) as listener:
        port = listener.getsockname()[1]
        with refused(rf"^--port {port}: in use by another program"):
            listen("127.0.0.1", port)
    for host in ("192.0.2.1", "no.such.host.invalid"):
        with refused(re.escape(f"--host {host}")):
            listen(host, 0)


def test_the_server_answers_plain_requests(address):
    parts = urlsplit(address)

    def request(path, method="GET", body=b"1", **headers):
        connection = HTTPConnection(parts.hostname, parts.port, timeout=60)
        connection.request(method, path, headers=headers, body=body if method == "POST" else None)
        answer = connection.getresponse()
        body = answer.read()
        connection.close()
        assert {name: answer.headers[name] for name in SECURITY_HEADERS} == SECURITY_HEADERS
        assert answer.headers["server"] is None
        return answer.status, body

    assert len(parts.path) >= 20
    status, body = request(parts.path)
    assert status == 200
    assert b'<html lang="en-US">' in body
    for path in (
        "/",
        "/docs",
        parts.path[:-2] + "/",
        parts.path + "page",
        f"{parts.path}file/photograph.jpg",
    ):
        status, body = request(path)
        assert status == 404, path
        assert len(body) < 100
    assert request("/upload", "POST")[0] == 404, "without the token"
    assert request(parts.path, host="evil.example")[0] == 400
    for method in ("GET", "POST"):
        assert request(parts.path + "upload", method, origin="http://evil.example")[0] == 403
    assert (
        request(parts.path + "upload", "POST", None, **{"content-length": str(1 << 40)})[0] == 413
    )
    assert request(parts.path + "upload", "POST", iter([b"of no length"]))[0] == 413
    with socket.create_connection((parts.hostname, parts.port), timeout=60) as plain:
        plain.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nHost: evil.example\r\n\r\n")
        assert plain.recv(100).startswith(b"HTTP/1.1 400 ")


def test_ctrl_c_on_a_busy_machine_says_nothing(caplog):
    log = logging.getLogger("nicegui")
    log.addFilter(is_worth_saying)
    cancelled = asyncio.CancelledError()
    try:
        log.error("Could not cancel %s tasks within timeout: %s", 7, "")
        log.error("Cancel %s running task(s), timeout graceful shutdown exceeded", 1)
        log.error("Exception in ASGI application\n", exc_info=cancelled)
        log.error("disk full")
    finally:
        log.removeFilter(is_worth_saying)
    assert [record.getMessage() for record in caplog.records] == ["disk full"]

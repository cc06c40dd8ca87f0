"""The server of the viewer, without a browser."""

import re
import socket
from http.client import HTTPConnection
from urllib.parse import urlsplit

import pytest

pytest.importorskip("nicegui", reason="nicegui is not installed")

from curvireg_torch.errors import MAX_VIEWER_PAGES, InvalidInputError
from curvireg_torch.viewer.guard import SECURITY_HEADERS, public_addresses
from curvireg_torch.viewer.server import listen

OPTIONS = []  # of the command that starts the viewer


def test_listen_names_a_used_port_and_a_host_that_is_not_ours():
    with listen("127.0.0.1", 0) as listener:
        port = listener.getsockname()[1]
        with pytest.raises(InvalidInputError, match=rf"^--port {port}: in use by another program"):
            listen("127.0.0.1", port)
    with listen("127.0.0.1", port):
        pass
    with pytest.raises(InvalidInputError, match=re.escape("--host 192.0.2.1 ")):
        listen("192.0.2.1", 0)
    with pytest.raises(InvalidInputError, match=re.escape("--host no.such.host.invalid: ")):
        listen("no.such.host.invalid", 0)


def test_the_printed_address_of_ipv6_works():
    try:
        listener = listen("::1", 0)
    except InvalidInputError:
        pytest.skip("no IPv6")
    with listener:
        (address,) = public_addresses("::1", listener.getsockname()[1])
        host, port = re.fullmatch(r"\[(.+)\]:(\d+)", address).groups()
        socket.create_connection((host, int(port)), timeout=5).close()


def test_the_server_answers_plain_requests_without_giving_them_a_place(address, folder):
    parts = urlsplit(address)

    def request(path, method="GET", **headers):
        connection = HTTPConnection(parts.hostname, parts.port, timeout=60)
        connection.request(method, path, headers=headers, body=b"1" if method == "POST" else None)
        answer = connection.getresponse()
        body = answer.read()
        connection.close()
        assert {name: answer.headers[name] for name in SECURITY_HEADERS} == SECURITY_HEADERS
        assert answer.headers["server"] is None
        return answer.status, answer.headers.get("location", ""), body

    for _ in range(MAX_VIEWER_PAGES + 1):
        status, page, _ = request(parts.path)
        assert (status, len(page)) == (307, 16)
        status, _, body = request(parts.path + page)
        assert status == 200
        assert b'<html lang="en-US">' in body
    (spaces,) = (folder / "temporary").glob("curvireg-view-*")
    assert not list(spaces.iterdir()), "no place was taken"
    for path in ("/", parts.path[:-2] + "/", parts.path + "page", f"{parts.path}{page}/file/photograph.jpg"):
        status, _, body = request(path)
        assert status == 404, path
        assert len(body) < 100
    assert request(f"{parts.path}{page}/upload", "POST")[0] == 404, "no browser shows this page"
    assert request(parts.path, host="evil.example")[0] == 421
    assert request(parts.path, origin="http://evil.example")[0] == 403

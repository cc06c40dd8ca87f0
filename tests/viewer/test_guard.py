"""The guard before the viewer's page, with requests of a test client; no browser and no NiceGUI."""

import asyncio

import pytest

from curvireg_torch.viewer.guard import SECURITY_HEADERS, Guard, allowed_hosts, public_addresses

PREFIX = "/secret"


class Site:
    """A guarded application that records which requests reach it."""

    def __init__(self, host):
        self.guard, self.reached = Guard(self.page, prefix=PREFIX, hosts=allowed_hosts(host)), []

    async def page(self, scope, _, send):
        self.reached.append(scope["path"])
        if scope["type"] == "websocket":
            await send({"type": "websocket.accept"})
            return
        foreign = [(b"Access-Control-Allow-Origin", b"*"), (b"server", b"x"), (b"X-Frame-Options", b"ALLOWALL")]
        await send({"type": "http.response.start", "status": 200, "headers": foreign})
        await send({"type": "http.response.body", "body": b"page"})

    def request(self, path=f"{PREFIX}/", kind="http", **headers):
        """The messages that answer a request."""
        sent = []

        async def receive():
            return {"type": f"{kind}.{'connect' if kind == 'websocket' else 'request'}"}

        async def send(message):
            sent.append(message)

        pairs = [(name.encode(), value.encode()) for name, value in {"host": "127.0.0.1:8080", **headers}.items()]
        asyncio.run(self.guard({"type": kind, "path": path, "method": "GET", "headers": pairs}, receive, send))
        return sent

    def status(self, path=f"{PREFIX}/", **headers):
        return self.request(path, **headers)[0]["status"]

    def opens_channel(self, **headers):
        (message,) = self.request(f"{PREFIX}/ws", "websocket", **headers)
        return message["type"] == "websocket.accept"


@pytest.mark.parametrize("host", ["127.0.0.1:8080", "localhost:9000", "[::1]:8080", "LOCALHOST"])
def test_local_names_reach_the_page(host):
    site = Site("127.0.0.1")
    assert site.status(host=host) == 200
    assert site.status(host=host, origin=f"http://{host}") == 200
    assert site.opens_channel(host=host, origin=f"http://{host}")
    assert site.reached == [f"{PREFIX}/", f"{PREFIX}/", f"{PREFIX}/ws"]


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example:8080", "192.168.1.7", "[::1", ""])
def test_other_hosts_are_refused(host):
    site = Site("127.0.0.1")
    assert site.status(host=host) == 421
    assert not site.opens_channel(host=host)
    assert site.reached == []


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "http://127.0.0.1:9000", "http://localhost:8080", ""]
)
def test_other_origins_are_refused(origin):
    site = Site("127.0.0.1")
    assert site.status(origin=origin) == 403
    assert not site.opens_channel(origin=origin)
    assert site.reached == []


@pytest.mark.parametrize("path", ["/", "/secre/", "/secret", "/secretly/", "/docs", "/openapi.json"])
def test_unknown_addresses_get_a_short_text_and_reach_nothing(path):
    site = Site("127.0.0.1")
    start, body = site.request(path)
    assert (start["status"], body["body"]) == (404, b"not found")
    assert site.reached == []


def test_every_answer_has_the_security_headers_and_no_others_for_other_sites():
    site = Site("127.0.0.1")
    for path, headers in ((f"{PREFIX}/", {}), ("/", {}), (f"{PREFIX}/", {"origin": "http://evil.example"})):
        pairs = [(name.decode().lower(), value.decode()) for name, value in site.request(path, **headers)[0]["headers"]]
        assert {name: value for name, value in pairs if not name.startswith("content-")} == {
            name: value for name, value in SECURITY_HEADERS.items() if not name.startswith("content-")
        }
        assert dict(pairs)["content-security-policy"] == SECURITY_HEADERS["content-security-policy"]
        assert len(pairs) == len(dict(pairs))


def test_policy_forbids_other_sites_and_frames():
    policy = dict(part.strip().split(" ", 1) for part in SECURITY_HEADERS["content-security-policy"].split(";"))
    assert policy["default-src"] == policy["frame-ancestors"] == policy["base-uri"] == "'none'"
    allowed = {"'self'", "'none'", "'unsafe-inline'", "'unsafe-eval'", "data:", "blob:"}
    assert {source for sources in policy.values() for source in sources.split()} <= allowed
    assert "data:" not in policy["script-src"]


def test_a_server_for_others_answers_to_addresses_but_not_to_foreign_names(monkeypatch):
    monkeypatch.setattr("socket.gethostname", lambda: "Bench")
    for host in ("0.0.0.0", "::"):
        site = Site(host)
        for name in ("192.168.1.7:8080", "[fe80::1]:8080", "bench:8080", "bench.local", "localhost"):
            assert site.status(host=name) == 200, name
        assert site.status(host="evil.example") == 421
    assert Site("bench.lan").status(host="BENCH.lan:80") == 200
    assert Site("bench.lan").status(host="192.168.1.7") == 421


def test_public_addresses_can_be_used(monkeypatch):
    monkeypatch.setattr("curvireg_torch.viewer.guard._outward_address", lambda: "192.168.1.7")
    assert public_addresses("0.0.0.0", 80) == public_addresses("::", 80) == ["192.168.1.7:80", "127.0.0.1:80"]
    assert public_addresses("127.0.0.1", 80) == ["127.0.0.1:80"]
    assert public_addresses("bench.lan", 80) == ["bench.lan:80"]
    monkeypatch.setattr("curvireg_torch.viewer.guard._outward_address", lambda: None)
    assert public_addresses("0.0.0.0", 80) == ["127.0.0.1:80"]

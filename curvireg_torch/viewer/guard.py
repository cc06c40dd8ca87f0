"""Checks of addresses, hosts and origins before the page sees a request, and the headers of answers. No NiceGUI."""

import ipaddress
import socket
from collections.abc import Awaitable, Callable, Iterable, MutableMapping
from typing import Any
from urllib.parse import urlsplit

__all__ = ["SECURITY_HEADERS", "Guard", "allowed_hosts", "public_addresses"]

Scope = MutableMapping[str, Any]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
Application = Callable[[Scope, Callable[..., Awaitable[Any]], Send], Awaitable[None]]
Headers = list[tuple[bytes, bytes]]

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

_LOOPBACK = frozenset({"127.0.0.1", "localhost", "::1"})


class Guard:
    """Pass on requests below ``prefix`` whose Host is in ``hosts`` and whose Origin, if any, is that host.

    Everything else ends here with a short text. A browser that is led here by another site's name (DNS rebinding) sends
    that name as Host; a script of another site sends its own Origin. ``hosts`` of None allows every IP address.
    """

    def __init__(self, inner: Application, *, prefix: str, hosts: frozenset[str] | None) -> None:
        self.inner, self.prefix, self.hosts = inner, prefix, hosts

    async def __call__(self, scope: Scope, receive: Callable[..., Awaitable[Any]], send: Send) -> None:
        if scope["type"] == "lifespan":
            await self.inner(scope, receive, send)
            return
        status, text = self._refusal(scope)
        if status == 0:
            await self.inner(scope, receive, _with_headers(send))
        elif scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008, "reason": text})  # before acceptance: HTTP 403
        else:
            headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"content-length", b"%d" % len(text))]
            await _with_headers(send)({"type": "http.response.start", "status": status, "headers": headers})
            await send({"type": "http.response.body", "body": text.encode()})

    def _refusal(self, scope: Scope) -> tuple[int, str]:
        """Status and text of the answer to a request that is not passed on; 0 if it is."""
        hosts = _values(scope, b"host")
        if len(hosts) != 1 or not self._is_allowed(hosts[0]):
            return 421, "unknown host"
        for origin in _values(scope, b"origin"):
            if urlsplit(origin).netloc.lower() != hosts[0].lower():
                return 403, "requests of other sites are refused"
        if not scope["path"].startswith(self.prefix + "/"):
            return 404, "not found"
        return 0, ""

    def _is_allowed(self, host: str) -> bool:
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        return name in self.hosts if self.hosts is not None else name in _own_names() or _is_ip(name)


def allowed_hosts(host: str) -> frozenset[str] | None:
    """Names in the address of a server that listens on ``host``; None if others reach it, by an address of theirs."""
    if host in _LOOPBACK:
        return _LOOPBACK
    return None if _is_ip(host) and ipaddress.ip_address(host).is_unspecified else frozenset({host.lower()})


def public_addresses(host: str, port: int) -> list[str]:
    """Hosts with ports under which a server that listens on ``host`` is reached, the best first.

    Example:
        >>> public_addresses("::1", 8080)
        ['[::1]:8080']
    """
    if not _is_ip(host) or not ipaddress.ip_address(host).is_unspecified:
        return [f"[{host}]:{port}" if ":" in host else f"{host}:{port}"]
    outward = _outward_address()
    names = [name for name in (outward, "127.0.0.1") if name is not None]
    return [f"{name}:{port}" for name in names]


def _outward_address() -> str | None:
    """The IPv4 address by which this machine is seen in its network; None without a network. Nothing is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # an address for documentation; a datagram socket only chooses the route
        except OSError:
            return None
        address = str(probe.getsockname()[0])
    return None if ipaddress.ip_address(address).is_loopback else address


def _own_names() -> Iterable[str]:
    name = socket.gethostname().lower()
    return ("localhost", name, f"{name}.local")


def _is_ip(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _values(scope: Scope, name: bytes) -> list[str]:
    return [value.decode("latin-1") for key, value in scope["headers"] if key == name]


def _with_headers(send: Send) -> Send:
    """A ``send`` that adds the security headers and removes those that open the answer to other sites."""
    ours = [(name.encode(), value.encode()) for name, value in SECURITY_HEADERS.items()]

    async def send_with_headers(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            replaced = {*SECURITY_HEADERS, "server"}
            theirs: Headers = [
                (name, value)
                for name, value in message.get("headers", [])
                if (key := name.decode("latin-1").lower()) not in replaced and not key.startswith("access-control-")
            ]
            message = {**message, "headers": [*theirs, *ours]}
        await send(message)

    return send_with_headers

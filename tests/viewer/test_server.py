"""The server of the viewer, without a browser."""

import re
import socket

import pytest

pytest.importorskip("nicegui", reason="nicegui is not installed")

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.viewer.guard import public_addresses
from curvireg_torch.viewer.server import listen


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

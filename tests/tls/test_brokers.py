"""Certificates of brokers: connections to NATS and MQTT judge them as all other clients do."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
from typing import TYPE_CHECKING
from urllib.parse import urlparse

import pytest
from nats.errors import Error

from holdfast.net.mqtt.dial import dial
from holdfast.net.mqtt.waiter import Waiter
from holdfast.net.nats.connection import Servers
from holdfast.net.nats.tolerant_client import SafeClient
from holdfast.net.secure_channel import TlsRefused
from holdfast.net.tls import Tls
from holdfast.runtime.stop import Stop
from support import wire
from support.certificate_cases import ACCEPTED, CASES, made
from support.secured import context

if TYPE_CHECKING:
    import ssl
    from collections.abc import Callable, Iterator

    from support.certificate_cases import Case, Mint, Shown

INFO = b'INFO {"tls_required": true, "headers": true}\r\n'


@contextlib.contextmanager
def serving(
    secure: ssl.SSLContext, greeting: bytes, serve: Callable[[ssl.SSLSocket], None]
) -> Iterator[int]:
    """A server for one connection, which begins with a greeting and goes on with TLS."""
    listening = socket.create_server(("127.0.0.1", 0))

    def run() -> None:
        with contextlib.suppress(OSError), listening:
            connection, _ = listening.accept()
            with connection:
                connection.settimeout(wire.DEADLINE)
                connection.sendall(greeting)
                with secure.wrap_socket(connection, server_side=True) as secured:
                    serve(secured)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield listening.getsockname()[1]
    finally:
        thread.join()


def answer_pings(connection: ssl.SSLSocket) -> None:
    """Does what a NATS server does until the client goes."""
    seen = b""
    while data := connection.recv(4096):
        seen += data
        if seen.endswith(b"PING\r\n"):
            connection.sendall(b"PONG\r\n")


def nats(secure: ssl.SSLContext, tls: Tls) -> str:
    """The answer of the scanner's client."""

    async def connect(port: int) -> None:
        client = SafeClient(requires_tls=True)
        servers = Servers((f"nats://127.0.0.1:{port}",), tls=tls)
        try:
            await client.connect(
                **servers.options(), allow_reconnect=False, error_cb=_ignored, connect_timeout=60
            )
        finally:
            await client.close()

    with serving(secure, INFO, answer_pings) as port:
        try:
            asyncio.run(connect(port))
        except TlsRefused as refused:
            return refused.reason
    return ACCEPTED


async def _ignored(_: Exception) -> None: ...


def mqtt(secure: ssl.SSLContext, tls: Tls) -> str:
    """The answer of adapters and outputs."""
    with Waiter(Stop()) as waiter, serving(secure, b"", lambda _: None) as port:
        try:
            dial("127.0.0.1", port, tls, waiter).close()
        except TlsRefused as refused:
            return refused.reason
    return ACCEPTED


@pytest.mark.parametrize("client", [mqtt, nats], ids=["mqtt", "nats"])
@pytest.mark.parametrize("case", CASES, ids=str)
def test_a_broker_is_judged_as_a_device_is(
    case: Case, client: Callable[..., str], mint: Mint, shown: dict[str, Shown]
) -> None:
    show = made(case, mint, shown)
    secure = context((show.chain, show.key), weak=True)
    assert client(secure, Tls(ca=str(show.trusted))) == case.device


def test_what_waits_does_not_go_to_a_server_that_was_refused() -> None:
    """nats-py sends it when it closes a connection."""

    async def refused(port: int) -> None:
        client = SafeClient(requires_tls=True)
        await client.transport.connect(urlparse(f"nats://127.0.0.1:{port}"), 4096, 60)
        with pytest.raises(Error, match="does not use TLS"):
            await client.transport.readline()
        client.transport.writelines([b"PUB a 6\r\nsecret\r\n"])
        client.transport.close()

    with socket.create_server(("127.0.0.1", 0)) as listening:
        connecting = threading.Thread(
            target=asyncio.run, args=[refused(listening.getsockname()[1])]
        )
        connecting.start()
        with listening.accept()[0] as connection:
            connection.settimeout(wire.DEADLINE)
            connection.sendall(b"INFO {}\r\n")
            assert connection.recv(100) == b""
        connecting.join()

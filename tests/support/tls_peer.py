"""A client of Modbus and HTTPS that controls its TLS records, and appliances for it."""

from __future__ import annotations

import contextlib
import socket
import ssl
from typing import TYPE_CHECKING, Any

from support import web, wire
from support.config_folder import written
from support.running import endpoint

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path
    from types import TracebackType
    from typing import Self

    import pytest

    from holdfast.appliance import Appliance
    from support.certificates import Issued

READ = bytes.fromhex("0300000001")
ZERO = bytes.fromhex("03020000")
HEALTH = web.head("GET", "/api/v1/health", "Connection: close")
VERSIONS = {"1.2": ssl.TLSVersion.TLSv1_2, "1.3": ssl.TLSVersion.TLSv1_3}


def context(
    ca: Path, issued: Issued | None = None, version: str | None = None, *, weak: bool = False
) -> ssl.SSLContext:
    """Trusts `ca`, and presents a certificate; with `weak`, even one that OpenSSL refuses."""
    made = ssl.create_default_context(cafile=str(ca))
    # Debian's Python 3.11 sets it, and then takes a cut connection for one with close_notify.
    made.options &= ~ssl.OP_IGNORE_UNEXPECTED_EOF
    if weak:
        made.set_ciphers("DEFAULT:@SECLEVEL=0")
    if issued is not None:
        made.load_cert_chain(issued.certificate, issued.key)
    if version is not None:
        made.minimum_version = made.maximum_version = VERSIONS[version]
    return made


class Refused(Exception):
    """The server closed the connection, with or without an alert."""


class Peer:
    """A connection; `shake` starts TLS on it."""

    def __init__(
        self,
        address: tuple[str, int],
        trust: ssl.SSLContext,
        *,
        source: str | None = None,
        receive_buffer: int | None = None,
        session: ssl.SSLSession | None = None,
    ) -> None:
        self.wire = wire.Connection(address, source=source, receive_buffer=receive_buffer)
        self._in, self._out = ssl.MemoryBIO(), ssl.MemoryBIO()
        self.tls = trust.wrap_bio(self._in, self._out, server_hostname="localhost", session=session)
        self.drips = False
        """Whether bytes are sent one by one."""
        self._received = b""
        self._transaction = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.wire.close()

    def shake(self) -> Self:
        """Performs the handshake, as far as the client takes part in it."""
        self._send(self.shake_unsent())
        return self

    def shake_unsent(self) -> bytes:
        """As `shake`, but returns the last records of the client without sending them."""
        while True:
            try:
                self.tls.do_handshake()
            except ssl.SSLWantReadError:
                self.flush()
                self._fill()
            except ssl.SSLError as error:
                raise Refused(error.reason) from None
            else:
                return self._out.read()

    def hello(self) -> bytes:
        """Returns the ClientHello without sending it."""
        with contextlib.suppress(ssl.SSLWantReadError):
            self.tls.do_handshake()
        return self._out.read()

    def goodbye(self) -> bytes:
        """Returns the close_notify without sending it."""
        with contextlib.suppress(ssl.SSLWantReadError):
            self.tls.unwrap()
        return self._out.read()

    def seal(self, data: bytes) -> bytes:
        """Returns the records for some bytes without sending them."""
        self.tls.write(data)
        return self._out.read()

    def send(self, data: bytes) -> None:
        """Sends bytes in separate records."""
        self._send(self.seal(data))

    def flush(self) -> None:
        """Sends pending TLS data."""
        self._send(self._out.read())

    def _send(self, records: bytes) -> None:
        for piece in (bytes([byte]) for byte in records) if self.drips else (records,):
            self.wire.send(piece)

    def ask(self, pdu: bytes, unit: int = 1) -> bytes:
        """Returns the PDU of the reply to one request."""
        self._transaction = (self._transaction + 1) & 0xFFFF
        self.send(wire.frame(pdu, unit, self._transaction))
        [reply] = self.receive_many(1)
        assert (reply.transaction, reply.unit) == (self._transaction, unit)
        return reply.pdu

    def ask_many(self, pdus: Iterable[bytes]) -> list[bytes]:
        """Returns the PDUs of the replies to pipelined requests, in order."""
        asked = list(pdus)
        self.send(wire.frames(asked))
        return [reply.pdu for reply in self.receive_many(len(asked))]

    def receive_many(self, count: int) -> list[wire.Frame]:
        """Returns exactly `count` frames; raises `Refused` if the connection ends before."""
        got: list[wire.Frame] = []
        while len(got) < count:
            got += self.receive_some()
        assert len(got) == count
        return got

    def receive_some(self) -> list[wire.Frame]:
        """Returns the frames that have arrived, possibly none."""
        piece = self._read()
        if not piece:
            raise Refused("close_notify")
        whole, self._received = wire.split(self._received + piece)
        return whole

    def end(self) -> str:
        """Returns how the server closes the connection: `close_notify`, an alert, or `cut`."""
        try:
            while self._read():
                pass
        except Refused as refused:
            return str(refused)
        return "close_notify"

    def rest(self) -> bytes:
        """Returns all plain text until the end of the connection."""
        return b"".join(iter(self._read, b""))

    def _read(self) -> bytes:
        """Returns decrypted bytes; empty at the end of the connection."""
        while True:
            try:
                return self.tls.read(65536)
            except ssl.SSLWantReadError:
                self._fill()
            except ssl.SSLZeroReturnError:
                return b""
            except ssl.SSLEOFError:
                raise Refused("cut") from None
            except ssl.SSLError as error:
                # Some versions of Python have this reason instead of SSLEOFError.
                cut = error.reason == "UNEXPECTED_EOF_WHILE_READING"
                raise Refused("cut" if cut else error.reason) from None

    def _fill(self) -> None:
        self.wire.socket.settimeout(wire.DEADLINE)
        try:
            piece = self.wire.socket.recv(65536)
        except (ConnectionResetError, BrokenPipeError):
            piece = b""
        if piece:
            self._in.write(piece)
        elif self._in.eof:
            raise Refused("cut")
        else:
            self._in.write_eof()


def configuration(tls: dict[str, Path], rules: list[dict[str, Any]], **listener: Any) -> str:
    """Builds a configuration with one listener, `secure`, for the memory `plant`."""
    secure = {
        "type": "modbus-tls",
        "bind": "127.0.0.1:0",
        "tls": {key: str(path) for key, path in tls.items()},
        "rules": [{"units": {1: "plant"}, **rule} for rule in rules],
        **listener,
    }
    memories = {"plant": {"coils": 1000, "holding_registers": 1000}}
    return written({"memories": memories, "listeners": {"secure": secure}})


def rest_configuration(tls: dict[str, Any]) -> str:
    """Builds a configuration with a REST service for the memory `plant`."""
    rest = {
        "bind": "127.0.0.1:0",
        "sources": ["127.0.0.0/8"],
        "tokens": "none",
        "tls": {key: str(path) for key, path in tls.items()},
    }
    return written({"memories": {"plant": {"holding_registers": 8}}, "rest": rest})


def connections(appliance: Appliance) -> dict[str, int]:
    """Returns the listener's counts of connections."""
    counted: dict[str, int] = appliance.diagnostics.stats()["listeners"]["secure"]["connections"]
    return counted


def address(appliance: Appliance) -> tuple[str, int]:
    return endpoint(appliance, "secure")


def verdict(appliance: Appliance, trust: ssl.SSLContext) -> str:
    """Returns `served`, `without rights` for exception 01, or the reason of a refusal.

    Over TLS 1.3, a refusal follows the client's handshake.
    """
    verdicts = {ZERO: "served", bytes([READ[0] | 0x80, 1]): "without rights"}
    with Peer(address(appliance), trust) as client:
        try:
            return verdicts.get(client.shake().ask(READ), "answered")
        except Refused as refused:
            return str(refused)


def rest_verdict(appliance: Appliance, trust: ssl.SSLContext) -> str:
    """Returns what the REST service says to a client: `served`, or the reason that it counts."""

    def counted() -> dict[str, int]:
        status: dict[str, Any] = appliance.diagnostics.stats()["adapters"]["rest"]
        return dict(status.get("tls_failures", {}))  # A service that only starts has none.

    before = counted()
    with Peer(endpoint(appliance, "rest"), trust) as peer, contextlib.suppress(Refused):
        peer.shake().send(HEALTH)
        answers = web.answers(peer.rest())
        if answers:
            assert [answer.status for answer in answers] == [200]
            return "served"
    wire.until(lambda: counted() != before, "the failure is counted")
    [reason] = [key for key, times in counted().items() if times != before.get(key, 0)]
    return reason


def secure_reply(to: tuple[str, int], trust: ssl.SSLContext, packet: bytes) -> bytes:
    """Returns all that a Raw Ingest listener sends for a packet; nothing if it refuses TLS."""
    with socket.create_connection(to, wire.DEADLINE) as plain:
        try:
            with trust.wrap_socket(plain, server_hostname="localhost") as secured:
                secured.sendall(packet)
                return b"".join(iter(lambda: secured.recv(16), b""))
        except (ssl.SSLError, ConnectionError):
            return b""


def failures(appliance: Appliance) -> dict[str, int]:
    """Returns the counted TLS failures by reason. Their sum is that of the connections."""
    [listener] = appliance.diagnostics.stats()["listeners"].values()
    counted: dict[str, int] = listener["tls_failures"]
    assert sum(counted.values()) == listener["connections"]["tls_failed"]
    return counted


def reasons(appliance: Appliance, caplog: pytest.LogCaptureFixture, count: int = 1) -> list[str]:
    """Returns the logged reasons of TLS failures, once there are `count`."""
    wire.until(lambda: connections(appliance)["tls_failed"] >= count, "failures are counted")

    def told() -> list[Any]:
        appliance.log_events(0.0)
        return [
            record.fields["reason"]  # type: ignore[attr-defined]
            for record in caplog.records
            if record.message == "tls_failed"
        ]

    wire.until(lambda: len(told()) >= count, "failures are logged")
    found = told()
    assert set(found) <= set(failures(appliance)), "each is counted by its reason"
    return found

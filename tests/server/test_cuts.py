"""Requests cut at every byte, and joined, over each stream that carries Modbus: replies, memory and
counters are as if each had come whole.

Each first piece is read before the second one is sent. What becomes of disturbed frames in all
pieces is tested without sockets, in `crates/engine/src/server/connections/connection.rs`.
"""

from __future__ import annotations

import itertools
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, Protocol

import pytest

from holdfast.types import AREAS
from support import lines, wire
from support.certificates import Certificates
from support.config_folder import written
from support.running import content, endpoint
from support.tls_peer import Peer as TlsPeer
from support.tls_peer import context
from support.transports import TYPES, AsciiConnection, RtuConnection, counters
from support.vectors import cases, overlay

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    import holdfast
    from holdfast.appliance import Appliance
    from holdfast.types import Area
    from support.running import Run

PATIENT = {"request_timeout": wire.DEADLINE, "idle_timeout": 0}
NOT_OF_THEIR_LENGTH = {"PDU too short", "PDU too long"}
"""An RTU frame with such a PDU has another length: it follows from function and byte count."""

READ = bytes.fromhex("0300000001")


class Client(Protocol):
    """A connection to a listener."""

    socket: Any

    def frame(self, pdu: bytes) -> bytes: ...

    def send(self, data: bytes) -> None: ...

    def reply(self) -> bytes: ...

    def close(self) -> None: ...


class Tcp(wire.Connection):
    def frame(self, pdu: bytes) -> bytes:
        return wire.frame(pdu, 1, 0x1234)

    def reply(self) -> bytes:
        received = self.receive()
        assert (received.transaction, received.unit) == (0x1234, 1)
        return received.pdu


class Rtu(RtuConnection):
    def frame(self, pdu: bytes) -> bytes:
        return lines.rtu(pdu, 1)

    def reply(self) -> bytes:
        [(unit, pdu)] = self.replies(1)
        assert unit == 1
        return pdu


class Ascii(AsciiConnection):
    def frame(self, pdu: bytes) -> bytes:
        return lines.ascii_frame(pdu, 1)

    reply = Rtu.reply


class Tls:
    """Each request is a record of its own, which is cut too."""

    def __init__(self, to: tuple[str, int], trust: Any) -> None:
        self._peer = TlsPeer(to, trust).shake()
        self.socket = self._peer.wire.socket
        self.send, self.close = self._peer.wire.send, self._peer.wire.close
        self._received: list[wire.Frame] = []

    def frame(self, pdu: bytes) -> bytes:
        return self._peer.seal(wire.frame(pdu, 1, 0x1234))

    def reply(self) -> bytes:
        while not self._received:
            self._received = self._peer.receive_some()
        return self._received.pop(0).pdu


class Listener:
    """A listener of one kind, for the memory `plant` as unit 1."""

    def __init__(self, kind: str, run: Run, folder: Path, opened: ExitStack) -> None:
        self.kind, self._opened = kind, opened
        self.appliance: Appliance
        rule: dict[str, Any] = {"sources": ["127.0.0.1"], "units": {1: "plant"}}
        listener: dict[str, Any] = {"bind": "127.0.0.1:0", **PATIENT}
        listener["rules"] = [{**rule, "access": "read-write"}]
        framed: dict[str, Callable[[tuple[str, int]], Client]] = {"rtu": Rtu, "ascii": Ascii}
        make = framed.get(kind, Tcp)
        listener["type"] = TYPES.get(kind, "modbus-tcp")
        if kind == "rtu":
            listener["frame_timeout"] = wire.DEADLINE
        if kind == "shared":
            listener["raw_ingest"] = {"rules": [{**rule, "areas": list(AREAS)}]}
        if kind == "tls":
            authority = Certificates(folder)
            server = authority.issue("server", "DNS:localhost,IP:127.0.0.1")
            own = authority.issue(
                "client", "DNS:client", extensions=("extendedKeyUsage=clientAuth",)
            )
            files = (server.certificate, server.key, authority.ca)
            keys = ("cert_file", "key_file", "ca_file")
            listener["tls"] = dict(zip(keys, map(str, files), strict=True))
            listener["type"] = "modbus-tls"
            trust = context(authority.ca, own)
            make = lambda to: Tls(to, trust)  # noqa: E731
        memories = {"plant": dict.fromkeys(AREAS, 1000)}
        self.appliance = run(written({"memories": memories, "listeners": {"scada": listener}}))
        self.memory: holdfast.Memory = self.appliance.memories["plant"]
        self._make = make

    def connect(self) -> Client:
        client = self._make(endpoint(self.appliance, "scada"))
        self._opened.callback(client.close)
        return client

    def requests(self) -> int:
        return sum(counters(self.appliance)["requests"].values())


KINDS = ["tcp", "tls", "rtu", "ascii", "shared"]


@pytest.fixture(params=KINDS)
def listener(request: pytest.FixtureRequest, run: Run, tmp_path: Path) -> Iterator[Listener]:
    with ExitStack() as opened:
        yield Listener(request.param, run, tmp_path, opened)


def served(kind: str) -> list[dict[str, Any]]:
    """The vectors for a kind of listener, without the longest requests."""
    left_out = NOT_OF_THEIR_LENGTH if kind == "rtu" else set()
    found = [case for case in cases("pdu.json") if case["name"] not in left_out]
    return [case for case in found if len(case["request"]) < 2 * 100]


def before_and_after(case: dict[str, Any]) -> tuple[dict[Area, list[int]], dict[Area, list[int]]]:
    contents: list[dict[Area, list[int]]] = []
    for changes in ([case["setup"]], [case["setup"], case["after"]]):
        areas: dict[Area, list[int]] = {area: [0] * 1000 for area in AREAS}
        for change in changes:
            overlay(areas, change)
        contents.append(areas)
    return contents[0], contents[1]


def fill(memory: holdfast.Memory, areas: dict[Area, list[int]]) -> None:
    for area, values in areas.items():
        memory.write(area, 0, values)


def test_a_request_may_be_cut_at_every_byte(listener: Listener) -> None:
    probe, client = listener.connect(), listener.connect()
    for case in served(listener.kind):
        pdu, expected = bytes.fromhex(case["request"]), bytes.fromhex(case["response"])
        before, after = before_and_after(case)
        whole = client.frame(pdu)
        fill(listener.memory, before)
        client.send(whole)
        assert client.reply() == expected, case["name"]
        assert content(listener.memory) == after, case["name"]
        for cut in range(1, len(whole)):
            if listener.kind == "shared":  # The first bytes of a connection decide.
                client.close()
                client = listener.connect()
            fill(listener.memory, before)
            request = client.frame(pdu)
            client.send(request[:cut])
            # The server reads one connection after the other.
            probe.send(probe.frame(READ))
            probe.reply()
            wire.until_taken(client.socket)
            assert content(listener.memory) == before
            answered = listener.requests()
            client.send(request[cut:])
            assert client.reply() == expected, (case["name"], cut)
            assert content(listener.memory) == after, (case["name"], cut)
            assert listener.requests() == answered + 1
    assert not any(counters(listener.appliance)["frames"].values())


def test_requests_may_be_joined(listener: Listener) -> None:
    client = listener.connect()
    for case, other in itertools.pairwise(served(listener.kind)):
        before, _ = before_and_after(case)
        pdus = [bytes.fromhex(each["request"]) for each in (case, other)]
        fill(listener.memory, before)
        replies = []
        for pdu in pdus:
            client.send(client.frame(pdu))
            replies.append(client.reply())
        apart = content(listener.memory)
        fill(listener.memory, before)
        client.send(b"".join(client.frame(pdu) for pdu in pdus))
        assert [client.reply(), client.reply()] == replies, (case["name"], other["name"])
        assert content(listener.memory) == apart
    assert not any(counters(listener.appliance)["frames"].values())

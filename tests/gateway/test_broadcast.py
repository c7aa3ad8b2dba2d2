"""Broadcasts through the gateway: writes to unit id 0 of a serial line, which nobody answers."""

from __future__ import annotations

import asyncio
import queue
from typing import TYPE_CHECKING, Any, cast

import pytest

import holdfast
from holdfast import _core
from holdfast.gateway.broadcast import send
from support import gateways, lines, wire
from support.fake_device import HANG_UP, FakeDevice, Stream, Udp, silent

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from support import web
    from support.fake_device import Asked
    from support.gateways import Running


WRITES: dict[str, tuple[dict[str, Any], bytes]] = {
    "/write/coil": ({"address": 3, "value": True}, bytes.fromhex("05 0003 ff00")),
    "/write/coils": ({"address": 3, "values": [1, 0, 1]}, bytes.fromhex("0f 0003 0003 01 05")),
    "/write/register": ({"address": 3, "value": 7}, bytes.fromhex("06 0003 0007")),
    "/write/registers": ({"address": 3, "values": [7]}, bytes.fromhex("10 0003 0001 02 0007")),
    "/write/mask": (
        {"address": 3, "andMask": 0xFFF0, "orMask": 5},
        bytes.fromhex("16 0003 fff0 0005"),
    ),
    "/write/file": (
        {"file": 4, "record": 7, "values": [7]},
        bytes.fromhex("15 09 06 0004 0007 0001 0007"),
    ),
}


class Line(Stream):
    """A serial gateway that takes frames and, unless told, says nothing."""

    is_modelled = False

    def __init__(self) -> None:
        super().__init__("rtu+tcp", then=self._take, in_turn=True)
        self.frames: queue.Queue[bytes] = queue.Queue()
        self.reply: bytes | None = None
        """What is sent back."""

    def _take(self, asked: Asked) -> None:
        self.frames.put(asked.raw)
        asked.end_with(self.reply)


@pytest.fixture
def line() -> Iterator[Line]:
    with Line() as made:
        yield made


@pytest.fixture
def gateway() -> Iterator[Running]:
    with gateways.running() as running:
        yield running


def to_all(line: Line, **body: Any) -> dict[str, Any]:
    where = {"host": "127.0.0.1", "port": line.port, "transport": "rtu+tcp", "unitId": 0}
    return {**where, **body}


@pytest.mark.parametrize("path", WRITES)
def test_a_broadcast_is_sent_and_not_waited_for(
    gateway: Running, line: Line, log: web.Records, path: str
) -> None:
    body, pdu = WRITES[path]
    answer = gateway.ask(path, to_all(line, **body, timeout=60000))
    assert (answer.status, answer.json["success"]) == (200, True)
    assert answer.json["note"] == "the broadcast was sent; devices do not confirm broadcasts"
    assert line.frames.get(timeout=wire.DEADLINE) == lines.rtu(pdu, unit=0)
    assert line.frames.empty()
    assert [each["outcome"] for each in log.of("gateway_write")] == ["sent"]


@pytest.mark.parametrize(
    ("device", "frame"),
    [
        (lambda: Stream("rtu+tcp", then=silent), bytes.fromhex("00 06 0001 0007 9819")),
        (lambda: Stream("ascii+tcp", then=silent), b":000600010007F2\r\n"),
        (lambda: Udp(kind="rtu+udp", then=silent), bytes.fromhex("00 06 0001 0007 9819")),
    ],
    ids=["rtu+tcp", "ascii+tcp", "rtu+udp"],
)
def test_a_broadcast_has_the_form_of_its_transport(
    gateway: Running, device: Callable[[], Stream | Udp], frame: bytes
) -> None:
    with device() as line:
        kind, _, port = line.url.replace("://127.0.0.1", "").partition(":")
        where = {"host": "127.0.0.1", "port": int(port), "transport": kind, "unitId": 0}
        answer = gateway.ask("/write/register", {**where, "address": 1, "value": 7})
        assert answer.json["success"] is True
        line.await_requests(1)
        assert line.requests[0].raw == frame


def test_another_unit_of_the_line_is_asked_afterwards(gateway: Running, line: Line) -> None:
    """On one connection at a time."""
    pdu = bytes.fromhex("06 0003 0007")
    one = {"address": 3, "value": 7}
    line.reply = lines.rtu(pdu, unit=5)
    for unit in (5, 0, 5):
        if unit == 0:
            line.reply = None
        answer = gateway.ask("/write/register", to_all(line, **{**one, "unitId": unit}))
        assert answer.json["success"] is True, unit
        assert ("note" in answer.json) == (unit == 0)
        line.reply = lines.rtu(pdu, unit=5)
    assert line.connections == 3


def test_a_line_that_is_not_there_is_told(gateway: Running, line: Line) -> None:
    with FakeDevice(lambda _: None) as gone:
        port = gone.port
    answer = gateway.ask("/write/coil", to_all(line, port=port, address=0, value=1))
    assert (answer.status, answer.headers["holdfast-reason"]) == (500, "no_connection")
    assert answer.json["error"] == f"can't connect to 127.0.0.1:{port}: Connection refused"


@pytest.mark.parametrize(
    ("reply", "reason", "says"),
    [
        (HANG_UP, "connection_lost", "closed by the peer"),
        (lines.rtu(b"\x85\x02", unit=0), "invalid_reply", "exception 02"),
    ],
)
def test_a_line_that_refuses_is_told(
    gateway: Running, line: Line, reply: bytes | None, reason: str, says: str
) -> None:
    line.reply = reply
    answer = gateway.ask("/write/coil", to_all(line, address=0, value=1))
    assert (answer.status, answer.headers["holdfast-reason"]) == (500, reason)
    assert says in answer.json["error"]


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("/connect", {}),
        ("/read", {"functionCode": 3, "address": 0}),
        ("/readwrite", {"readAddress": 0, "readQuantity": 1, "writeAddress": 0, "values": [1]}),
        ("/diagnostics", {}),
        ("/identify", {}),
        ("/map", {}),
    ],
)
def test_what_needs_an_answer_is_no_broadcast(
    gateway: Running, line: Line, path: str, body: dict[str, Any]
) -> None:
    answer = gateway.ask(path, to_all(line, **body))
    assert (answer.status, answer.headers["holdfast-reason"]) == (400, "malformed")
    assert "which has no response" in answer.json["error"]
    assert line.connections == 0


def test_over_tcp_unit_0_is_a_unit_as_any(gateway: Running) -> None:
    body = {"host": "127.0.0.1", "unitId": 0, "address": 3, "value": 7}
    with FakeDevice(lambda pdu: pdu) as device:
        answer = gateway.ask("/write/register", {**body, "port": device.port})
        assert (answer.status, "note" in answer.json) == (200, False)
    with FakeDevice(lambda _: None) as mute:
        answer = gateway.ask("/write/register", {**body, "port": mute.port, "timeout": 100})
    assert (answer.status, answer.headers["holdfast-reason"]) == (500, "timeout")
    assert answer.json["error"] == (
        "Connection timeout: unit id 0 is the broadcast of serial lines, which has no response"
    )


def test_a_broadcast_without_a_connection_is_not_sent() -> None:
    class Unconnected:
        async def call(self, *_: Any) -> None:
            raise holdfast.RequestTimeout("no connection", maybe_sent=False)

        async def close(self) -> None:
            pass

    request = _core.Request.write_register(0, 1)
    with pytest.raises(holdfast.RequestTimeout, match="no connection"):
        asyncio.run(send(cast("Any", Unconnected()), request, 1.0))


@pytest.mark.parametrize(
    "outcomes",
    [
        [holdfast.RequestTimeout("no connection", maybe_sent=False), holdfast.RequestTimeout()],
        [holdfast.InvalidResponse("unit id 7", "unit_id")],
    ],
    ids=["over a slow connection", "confirmed"],
)
def test_a_broadcast_is_sent(outcomes: list[Exception]) -> None:
    waits = []

    class Slow:
        async def call(self, _request: _core.Request, _unit: int, timeout: float) -> None:
            waits.append(timeout)
            raise outcomes[len(waits) - 1]

        async def close(self) -> None:
            pass

    asyncio.run(send(cast("Any", Slow()), _core.Request.write_register(0, 1), 5.0))
    assert waits == [0.5, 4.0][: len(outcomes)]

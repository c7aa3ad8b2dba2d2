"""Requests that listeners pass on: what the device receives, and what the client gets."""

from __future__ import annotations

import select
import socket
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.config import load
from support import routed, wire
from support.audits import await_writes
from support.fake_device import FakeDevice, Serial, Stream, Udp, exception, good, silent
from support.lines import ASCII, RTU, Line, Mode
from support.routed import Held, await_count, configuration, counters
from support.running import endpoint, log_events
from support.transports import TRANSPORTS, Client, Datagrams, FramedConnection, client

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from holdfast.appliance import Appliance
    from support.fake_device import Asked
    from support.running import Connect, Run

READ = bytes.fromhex("0300050001")
FIVE = bytes.fromhex("03020005")
ZERO = bytes.fromhex("03020000")
SIXTH = bytes.fromhex("0300060001")
SIX = bytes.fromhex("03020006")
WRITE = bytes.fromhex("0600051234")
VENDOR = bytes.fromhex("4101020304")

ends_are_found = pytest.mark.skipif(
    sys.platform == "win32", reason="an end behind bytes that are not read is not found"
)

BESIDE_MEMORY: dict[int | str, Any] = {1: {"route": "bus"}, 2: "plant"}
MEMORY = {"plant": {"holding_registers": 9}}

EXCHANGES = {
    "1": ("0100000009", "0102ff01"),
    "2": ("0200000008", "020155"),
    "3": ("0300010002", "030400070008"),
    "4": ("0400010001", "04020009"),
    "5": ("050001ff00", "050001ff00"),
    "6": ("0600011234", "0600011234"),
    "7": ("07", "076d"),
    "8": ("08000000aa", "08000000aa"),
    "12": ("0c", "0c080000010801212000"),
    "15": ("0f000000080155", "0f00000008"),
    "16": ("1000010001020007", "1000010001"),
    "20": ("140706000400010002", "140605060dfe0020"),
    "21": ("15090600040007000106af", "15090600040007000106af"),
    "22": ("16000400f20025", "16000400f20025"),
    "23": ("170003000100010001020007", "17020009"),
    "24": ("1804de", "180006000201020304"),
    "43": ("2b0e0100", "2b0e01010000010003616263"),
    "65, listed": ("4101020304", "41ffee"),
}
"""Requests and replies by function code. Replies that differ from what memories would answer."""


@pytest.fixture
def unmodelled() -> Iterator[FakeDevice]:
    """A device that answers what its test sets."""
    with FakeDevice(lambda pdu: pdu) as device:
        yield device


@pytest.fixture
def device() -> Iterator[Stream]:
    """A device over TCP: unit 1 whose holding register N holds N."""
    with Stream("tcp") as made:
        yield made


@pytest.fixture
def meter(device: Stream, run: Run) -> Appliance:
    """All unit ids lead to `device`."""
    return run(configuration(device.url))


def scada(appliance: Appliance) -> tuple[str, int]:
    return endpoint(appliance, "scada")


def pauses(front: Client) -> bool:
    """Waits until the next request counts as sent after a pause. Returns whether no reply came."""
    return not select.select([front.socket], [], [], 0.3)[0]


def await_nobody(appliance: Appliance, others: int = 0) -> None:
    """Waits until no more than so many clients are connected."""
    stats = appliance.diagnostics.stats
    wire.until(
        lambda: stats()["listeners"]["scada"]["connections"]["open"] == others, "the client is gone"
    )


# What passes


@pytest.mark.parametrize(("request_", "reply"), EXCHANGES.values(), ids=EXCHANGES)
def test_request_and_reply_pass_unchanged(
    unmodelled: FakeDevice, run: Run, connect: Connect, request_: str, reply: str
) -> None:
    unmodelled.answer = lambda _: bytes.fromhex(reply)
    functions = {"functions": [int(request_[:2], 16)]}
    front = connect(scada(run(configuration(unmodelled.url, rule=functions))))

    assert front.ask(bytes.fromhex(request_), unit=9).hex() == reply
    assert [(asked.unit, asked.pdu.hex()) for asked in unmodelled.requests] == [(9, request_)]


@pytest.mark.parametrize("data", ["0000", "0001", ""])
def test_listen_only_mode_does_not_reach_the_device(
    device: Stream, meter: Appliance, connect: Connect, data: str
) -> None:
    front = connect(scada(meter))

    assert front.ask(bytes.fromhex("080004" + data)) == b"\x88\x01"
    assert front.ask(READ) == FIVE
    assert [asked.pdu for asked in device.requests] == [READ]
    connections = meter.diagnostics.stats()["listeners"]["scada"]["connections"]
    assert connections["refused_listen_only"] == 1


def test_listen_only_mode_reaches_the_device_if_the_listener_allows_it(
    unmodelled: FakeDevice, run: Run, connect: Connect
) -> None:
    unmodelled.answer = lambda _: bytes.fromhex("0800040000")
    front = connect(scada(run(configuration(unmodelled.url, listener={"listen_only": True}))))

    assert front.ask(bytes.fromhex("0800040000")).hex() == "0800040000"
    assert [asked.pdu.hex() for asked in unmodelled.requests] == ["0800040000"]


@pytest.mark.parametrize("code", [name for name in EXCHANGES if "," not in name])
def test_functions_of_the_standard_need_no_list(
    unmodelled: FakeDevice, run: Run, connect: Connect, code: str
) -> None:
    request, reply = (bytes.fromhex(text) for text in EXCHANGES[code])
    unmodelled.answer = lambda _: reply

    assert connect(scada(run(configuration(unmodelled.url)))).ask(request) == reply


def test_a_function_of_a_vendor_that_is_not_listed_is_refused(
    device: Stream, meter: Appliance, connect: Connect
) -> None:
    front = connect(scada(meter))

    assert front.ask(VENDOR) == exception(VENDOR, 1)
    assert front.ask(READ) == FIVE
    assert [asked.pdu for asked in device.requests] == [READ]


def test_function_43_passes_with_another_mei_type_only_if_it_is_listed(
    unmodelled: FakeDevice, run: Run, connect: Connect, caplog: pytest.LogCaptureFixture
) -> None:
    """CANopen, as type 13, has no known length: a line could find a write to another unit in it."""
    canopen = bytes.fromhex("2b0d00 714c 63 0600071234")
    for rule in ({}, {"deny": [5]}):
        appliance = run(configuration(unmodelled.url, rule=rule))
        assert connect(scada(appliance)).ask(canopen) == exception(canopen, 1)
        log_events(appliance)
    assert not unmodelled.asked
    fields = [vars(each)["fields"] for each in caplog.records if each.message == "refused_function"]
    assert [refused["function"] for refused in fields] == [43, 43]

    listed = run(configuration(unmodelled.url, rule={"functions": [3, 43]}))
    assert connect(scada(listed)).ask(canopen) == canopen
    assert unmodelled.asked == [canopen]


@pytest.mark.parametrize("code", [1, 2, 4, 6, 10, 11, 0x63, 0xFF])
def test_the_exceptions_of_the_device_come_through(
    unmodelled: FakeDevice, run: Run, connect: Connect, code: int
) -> None:
    unmodelled.answer = lambda pdu: exception(pdu, code)
    appliance = run(configuration(unmodelled.url))

    assert connect(scada(appliance)).ask(WRITE) == exception(WRITE, code)
    assert counters(appliance)["exceptions"] == 1


@pytest.mark.parametrize(
    ("request_", "reply"),
    [
        ("07", "0700ff"),
        ("140706000400010002", "140405060dfe"),
        ("15090600040007000106af", "15090600040007000106ae"),
        ("1804de", "180006000301b81284"),
    ],
)
def test_a_reply_that_contradicts_its_request_is_exception_0b(
    unmodelled: FakeDevice, run: Run, connect: Connect, request_: str, reply: str
) -> None:
    unmodelled.answer = lambda _: bytes.fromhex(reply)
    asked = bytes.fromhex(request_)

    assert connect(scada(run(configuration(unmodelled.url)))).ask(asked) == exception(asked, 11)


def test_a_request_that_a_memory_would_refuse_is_for_the_device_to_judge(
    unmodelled: FakeDevice, run: Run, connect: Connect
) -> None:
    beyond = bytes.fromhex("0300000fff")
    unmodelled.answer = lambda pdu: exception(pdu, 3)

    assert connect(scada(run(configuration(unmodelled.url)))).ask(beyond) == exception(beyond, 3)
    assert unmodelled.asked == [beyond]


def test_a_read_only_rule_passes_on_no_write(device: Stream, run: Run, connect: Connect) -> None:
    front = connect(scada(run(configuration(device.url, rule={"access": "read-only"}))))

    for text in ["0500010000", "0600011234", "15090600040007000106af", "4101020304"]:
        write = bytes.fromhex(text)
        assert front.ask(write) == exception(write, 1)
    assert front.ask(READ) == FIVE
    assert [asked.pdu for asked in device.requests] == [READ]


READ_AND_WRITE = READ + bytes.fromhex("0000 01 0600011234 0000")
"""A read, and what a line could take for its checksum and a write after it."""


@pytest.mark.parametrize("kind", ["tcp", "rtu+tcp"])
@pytest.mark.parametrize(
    "rule", [{"access": "read-only"}, {"functions": [3, 6, 8, 16]}], ids=["read-only", "functions"]
)
def test_what_a_line_could_take_for_several_requests_is_not_sent(
    rule: dict[str, Any],
    kind: str,
    run: Run,
    connect: Connect,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Also over TCP: a gateway may be in between."""
    echo_and_write = bytes.fromhex("08 0000 a537 0000 01 0600011234 0000")
    with Stream(kind) as device:
        text = configuration(device.url, rule=rule, audit={"file": "audit.log"})
        appliance = run(text)
        front = connect(scada(appliance))
        for request in (READ_AND_WRITE, echo_and_write, READ[:-1]):
            assert front.ask(request) == exception(request, 3)
        if "functions" in rule:
            longer = [WRITE + bytes(count) for count in (1, 3, 4)]
            for request in (WRITE[:-1], *longer, bytes.fromhex("100001000102")):
                assert front.ask(request) == exception(request, 3)
        assert front.ask(READ) == FIVE
        assert [asked.pdu for asked in device.requests] == [READ]
        [line, *_] = await_writes(tmp_path / "audit.log", 1)
    assert (line["function"], line["outcome"]) == (3, "illegal_data_value")
    log_events(appliance)
    [refused] = [
        vars(each)["fields"] for each in caplog.records if each.message == "refused_function"
    ]
    assert (refused["unit"], refused["function"]) == (1, 3)


@pytest.mark.parametrize("request_", ["06 0005 00012345", "08 0000 a537 a538", "03 0005 0001 0000"])
def test_two_bytes_more_pass_unless_the_rule_is_read_only(
    request_: str, unmodelled: FakeDevice, run: Run, connect: Connect
) -> None:
    """Some devices have such requests, as a write of 32 bits. No other request fits into them."""
    request = bytes.fromhex(request_)
    connect(scada(run(configuration(unmodelled.url)))).ask(request)
    assert unmodelled.asked == [request]

    read_only = run(configuration(unmodelled.url, rule={"access": "read-only"}))
    assert connect(scada(read_only)).ask(request) == exception(request, 1)
    assert unmodelled.asked == [request]


def test_a_route_to_a_device_sends_its_unit_id_and_a_link_keeps_that_of_the_request(
    device: Stream, run: Run, connect: Connect
) -> None:
    units: dict[int | str, Any] = {5: {"route": "drive"}, "6-9": {"route": "bus"}}
    devices = {"drive": {"url": device.url, "unit": 1}}
    front = connect(scada(run(configuration(device.url, units=units, devices=devices))))

    for unit in (5, 6, 9):
        front.ask(READ, unit)
    assert [asked.unit for asked in device.requests] == [1, 6, 9]
    assert device.connections == 1


def test_a_unit_id_without_a_route_is_answered_as_before(
    device: Stream, run: Run, connect: Connect
) -> None:
    front = connect(scada(run(configuration(device.url, units={5: {"route": "bus"}}))))

    assert front.ask(READ, unit=6) == exception(READ, 0x0B)
    assert device.requests == []


def test_a_device_that_is_polled_has_routes_over_the_same_connection(
    device: Stream, run: Run, connect: Connect
) -> None:
    polled = {
        "url": device.url,
        "unit": 1,
        "interval": 0.05,
        "reads": [{"area": "coils", "address": 0, "count": 8}],
        "forward": [{"url": "raw://127.0.0.1:1", "unit": 1}],
    }
    appliance = run(
        configuration(
            device.url,
            units={5: {"route": "meter"}, 6: "plant"},
            devices={"meter": polled},
            memories={"plant": {"coils": 8}},
        )
    )

    assert connect(scada(appliance)).ask(READ, unit=5) == FIVE
    polls = len(device.requests) + 2
    wire.until(lambda: len(device.requests) >= polls, "the device is polled")
    assert device.connections == 1


# Order


def test_replies_have_the_order_of_their_requests(device: Stream, run: Run) -> None:
    held = Held()
    device.script = [held]
    appliance = run(configuration(device.url, units=BESIDE_MEMORY, memories=MEMORY))
    units = [1, 2, 1, 1, 2, 2, 1]
    requests = b"".join(wire.frame(READ, unit, number) for number, unit in enumerate(units))
    with wire.Connection(scada(appliance)) as front:
        front.send(requests)
        wire.until(lambda: device.requests, "the first request is passed on")
        held.release()
        replies = front.receive_many(len(units))

    zero = bytes.fromhex("03020000")
    assert [(reply.transaction, reply.unit, reply.pdu) for reply in replies] == [
        (number, unit, FIVE if unit == 1 else zero) for number, unit in enumerate(units)
    ]


@pytest.mark.parametrize("kind", ["tcp", "udp"])
def test_a_write_that_is_sent_again_before_its_reply_reaches_the_device_once(
    device: Stream, run: Run, tmp_path: Path, kind: str
) -> None:
    held = Held()
    device.script = [held]
    appliance = run(configuration(device.url, kind=kind, audit={"file": "audit.log"}))
    write = wire.frame(WRITE, transaction=7)
    with client(kind, scada(appliance)) as other, client(kind, scada(appliance)) as front:
        other.send(wire.frame(READ))
        device.await_requests(1)
        for sent in (write, write, write, wire.frame(SIXTH, transaction=8)):
            front.send(sent)
        await_count(appliance, "waiting", 3)
        held.release()
        replies = [(reply.transaction, reply.pdu) for reply in (front.receive() for _ in range(4))]
        assert sorted(replies) == [(7, WRITE), (7, WRITE), (7, WRITE), (8, SIX)]
        assert [asked.pdu for asked in device.requests] == [READ, WRITE, SIXTH]

        front.send(write)
        assert front.receive().pdu == WRITE, "it is answered, so the same write is a new one"
    assert [asked.pdu for asked in device.requests] == [READ, WRITE, SIXTH, WRITE]
    assert [line["outcome"] for line in await_writes(tmp_path / "audit.log", 2)] == ["done"] * 2


def test_a_write_that_is_sent_again_behind_a_request_that_waits_reaches_the_device_once(
    device: Stream, run: Run
) -> None:
    held = Held()
    device.script = [held]
    appliance = run(configuration(device.url, units=BESIDE_MEMORY, memories=MEMORY))
    other = wire.frame(bytes.fromhex("0600064321"), transaction=9)
    write, of_memory = wire.frame(WRITE, transaction=7), wire.frame(READ, 2, 8)
    with wire.Connection(scada(appliance)) as front:
        front.send(write + of_memory + other)
        device.await_requests(1)
        for sent in (write, other):
            front.send(sent)
            wire.until_taken(front.socket)
        held.release()
        replies = front.receive_many(5)

    assert [reply.transaction for reply in replies] == [7, 7, 8, 9, 9]
    assert [asked.pdu for asked in device.requests] == [WRITE, other[7:]]


def test_a_repetition_behind_sixteen_requests_that_wait_is_not_sent(
    device: Stream, run: Run
) -> None:
    held = Held()
    device.script = [held]
    appliance = run(configuration(device.url))
    writes = [bytes.fromhex("060005") + bytes([0, number]) for number in range(16)]
    with wire.Connection(scada(appliance)) as front:
        front.send(wire.frames(writes) + wire.frames(writes[:8]) + wire.frame(READ, 1, 16))
        await_count(appliance, "waiting", 16)
        held.release()
        assert [reply.transaction for reply in front.receive_many(17)] == [*range(17)]

    assert [asked.pdu for asked in device.requests] == [*writes, READ]


@pytest.mark.parametrize("kind", ["tcp", "udp"])
def test_a_client_with_one_transaction_id_for_all_may_return_to_an_earlier_value(
    device: Stream, run: Run, kind: str
) -> None:
    held = Held()
    device.script = [held]
    appliance = run(configuration(device.url, kind=kind, link={"coalesce": False}))
    other = bytes.fromhex("0600054321")
    requests = [WRITE, other, WRITE, SIXTH, SIXTH]
    with client(kind, scada(appliance)) as front:
        for request in requests:
            front.send(wire.frame(request))
        device.await_requests(1)
        await_count(appliance, "waiting", 5)
        held.release()
        replies = [front.receive().pdu for _ in requests]

    assert sorted(replies) == sorted([WRITE, other, WRITE, SIX, SIX])
    assert [asked.pdu for asked in device.requests] == requests


@pytest.mark.parametrize(
    ("kind", "units"),
    [("rtu", [1]), ("rtu", [1, 2]), ("ascii", [1]), ("ascii", [1, 2, 1]), ("rtu-udp", [1])],
    ids=str,
)
def test_a_client_without_transaction_ids_that_asks_again_gets_no_earlier_reply(
    device: Stream, run: Run, kind: str, units: list[int]
) -> None:
    """Also of a request to a memory that waits for others."""
    held = Held()
    device.script = [held]
    appliance = run(configuration(device.url, kind=kind, units=BESIDE_MEMORY, memories=MEMORY))
    frame = TRANSPORTS[kind].frame
    with client(kind, scada(appliance)) as front:
        assert isinstance(front, FramedConnection | Datagrams)
        front.send(b"".join(frame(READ, unit) for unit in units))
        device.await_requests(1)
        assert pauses(front)
        assert front.ask(READ, unit=2) == bytes.fromhex("03020000")
        held.release()
        assert front.ask(SIXTH) == SIX

        together = [frame(READ), frame(SIXTH)]
        for each in together if kind == "rtu-udp" else [b"".join(together)]:
            front.send(each)
        assert sorted(front.replies(2)) == [(1, FIVE), (1, SIX)], "they were sent together"
        assert front.is_quiet()


@pytest.mark.parametrize("kind", ["rtu", "rtu-udp"])
def test_only_a_broadcast_is_sent_although_its_client_asks_again(
    device: Stream, run: Run, kind: str
) -> None:
    held = Held()
    device.script = [held]
    appliance = run(configuration(device.url, kind=kind))
    frame = TRANSPORTS[kind].frame
    to = scada(appliance)
    with client(kind, to, "127.0.0.2") as other, client(kind, to) as front:
        assert isinstance(front, FramedConnection | Datagrams)
        other.send(frame(READ))
        device.await_requests(1)
        front.send(frame(WRITE, 2))
        front.send(frame(WRITE, 0))
        await_count(appliance, "waiting", 3)
        assert pauses(front)
        front.send(frame(READ))
        await_count(appliance, "withdrawn", 1)
        held.release()
        assert front.replies(1) == [(1, FIVE)]

    assert [asked.unit for asked in device.requests] == [1, 0, 1]


def test_a_request_to_memory_waits_for_the_write_before_it(
    device: Stream, run: Run, connect: Connect
) -> None:
    held = Held()
    device.script = [held]
    appliance = run(configuration(device.url, units=BESIDE_MEMORY, memories=MEMORY))
    connect(scada(appliance)).send(wire.frame(WRITE, 1) + wire.frame(WRITE, 2))
    device.await_requests(1)
    assert appliance.memories["plant"].read("holding_registers", 5, 1) == [0]
    held.release()
    wire.until(
        lambda: appliance.memories["plant"].read("holding_registers", 5, 1) == [0x1234], "written"
    )


@pytest.mark.parametrize("link", [{"in_flight": 1}, {"in_flight": 8}, {"cache": 3600}], ids=str)
@pytest.mark.parametrize("pattern", ["WR", "RW", "WWR", "RWR", "WRWR", "RRWRR", "WRRW", "RWRWR"])
def test_what_a_client_sends_together_has_the_outcome_of_its_order(
    device: Stream, run: Run, connect: Connect, pattern: str, link: dict[str, Any]
) -> None:
    """Also while equal reads of others wait, or have been answered."""
    appliance = run(configuration(device.url, link=link))
    first, other, front = (connect(scada(appliance)) for _ in range(3))
    assert first.ask(READ) == FIVE
    held = Held()
    device.script = [held]
    first.send(wire.frame(bytes.fromhex("0300060001")))
    device.await_requests(2)
    other.send(wire.frame(READ))
    value, requests, expected = 5, [], []
    for number, kind in enumerate(pattern):
        value = 100 + number if kind == "W" else value
        write = bytes.fromhex("060005") + value.to_bytes(2)
        requests.append(write if kind == "W" else READ)
        expected.append(write if kind == "W" else b"\x03\x02" + value.to_bytes(2))
    front.send(wire.frames(requests))
    wire.until(lambda: counters(appliance)["requests"] >= 3 + len(pattern), "all have come")
    held.release()

    assert [reply.pdu for reply in front.receive_many(len(pattern))] == expected


def test_a_request_waits_until_the_write_before_it_is_answered(
    device: Stream, run: Run, connect: Connect
) -> None:
    """A device that answers several requests at once may carry them out in another order."""
    unanswered: list[Asked] = []
    device.script = [unanswered.append]
    appliance = run(configuration(device.url, link={"in_flight": 8}))
    front, other = connect(scada(appliance)), connect(scada(appliance))
    front.send(wire.frame(WRITE) + wire.frame(READ))
    device.await_requests(1)
    assert other.ask(bytes.fromhex("0300060001")) == bytes.fromhex("03020006")
    assert [asked.pdu for asked in device.requests] == [WRITE, bytes.fromhex("0300060001")]
    unanswered[0].answer()

    replies = [reply.pdu for reply in front.receive_many(2)]
    assert replies == [WRITE, bytes.fromhex("03021234")]


@pytest.mark.parametrize("in_flight", [1, 8])
def test_many_clients_never_get_the_reply_of_another(
    device: Stream, run: Run, in_flight: int
) -> None:
    appliance = run(configuration(device.url, link={"in_flight": in_flight}))

    def ask(number: int) -> bool:
        with wire.Connection(scada(appliance)) as front:
            for turn in range(100):
                address = 100 * number + turn % 100
                reply = front.ask(b"\x03" + address.to_bytes(2) + b"\0\1")
                if reply != b"\x03\x02" + address.to_bytes(2):
                    return False
        return True

    with ThreadPoolExecutor(8) as threads:
        assert all(threads.map(ask, range(8)))
    assert counters(appliance)["replies"] == len(device.requests)


# Transports


@pytest.mark.parametrize("kind", ["tcp", "udp", "rtu", "rtu-udp", "ascii"])
def test_every_listener_passes_requests_on(device: Stream, run: Run, kind: str) -> None:
    appliance = run(configuration(device.url, kind=kind))
    missing = bytes.fromhex("03ffff0001")
    with client(kind, scada(appliance)) as front:
        assert isinstance(front, wire.Connection | Datagrams | FramedConnection)
        assert front.ask(READ) == FIVE
        assert front.ask(WRITE) == WRITE
        assert front.ask(READ) == bytes.fromhex("03021234")
        assert front.ask(missing) == exception(missing, 2)
    assert [asked.pdu for asked in device.requests] == [READ, WRITE, READ, missing]


@pytest.mark.parametrize("mode", [RTU, ASCII], ids=lambda mode: mode.name)
def test_a_serial_listener_passes_requests_on(
    device: Stream, run: Run, tmp_path: Path, mode: Mode
) -> None:
    with Line(tmp_path / "line", mode) as line:
        run(routed.serial_configuration(device.url, mode.listener, line.device))
        assert line.ask(READ, unit=1) == FIVE
        assert line.ask(WRITE, unit=1) == WRITE
    assert [asked.pdu for asked in device.requests] == [READ, WRITE]


@pytest.mark.parametrize("kind", ["udp", "rtu+tcp", "ascii+tcp", "rtu+udp"])
def test_every_network_transport_leads_to_devices(run: Run, connect: Connect, kind: str) -> None:
    device = Udp(kind=kind) if "udp" in kind else Stream(kind)
    with device:
        front = connect(scada(run(configuration(device.url))))
        assert front.ask(READ) == FIVE
        assert front.ask(WRITE) == WRITE
        assert front.ask(READ) == bytes.fromhex("03021234")


def test_a_client_that_waits_for_a_device_gives_way_only_to_another_if_all_wait(
    device: Stream, run: Run, connect: Connect
) -> None:
    first, second = Held(), Held()
    device.script = [first, second]
    limits = {"max_connections": 2, "when_full": "evict"}
    text = configuration(device.url, units=BESIDE_MEMORY, memories=MEMORY, listener=limits)
    appliance = run(text)

    def idle() -> wire.Connection:
        made = connect(scada(appliance))
        assert made.ask(READ, unit=2) == ZERO
        return made

    waiting = connect(scada(appliance))
    waiting.send(wire.frame(READ))
    device.await_requests(1)
    one, other = idle(), idle()
    assert one.rest() == b""
    first.release()
    assert waiting.receive().pdu == FIVE
    third = idle()
    assert other.rest() == b"", "its request is older than the reply"
    fourth = idle()
    assert waiting.rest() == b"", "it waits no longer"

    third.send(wire.frame(READ))
    device.await_requests(2)
    fourth.send(wire.frame(SIXTH))
    await_count(appliance, "waiting", 2)
    idle()
    assert third.rest() == b"", "all wait"
    second.release()
    assert fourth.receive().pdu == SIX


class OnLine:
    """An appliance whose link is a serial line, and the device on it."""

    def __init__(self, device: Serial, appliance: Appliance) -> None:
        self.device = device
        self.appliance = appliance


@pytest.fixture(params=[RTU, ASCII], ids=lambda mode: mode.name)
def on_line(request: pytest.FixtureRequest, tmp_path: Path, run: Run) -> Iterator[OnLine]:
    device = Serial(request.param, tmp_path / "device")
    with device:
        rule = {"functions": [3, 6, 8, 16, 43, 65]}
        yield OnLine(device, run(configuration(device.url, rule=rule)))


def test_a_serial_line_leads_to_devices(on_line: OnLine, connect: Connect) -> None:
    front = connect(scada(on_line.appliance))
    many = bytes.fromhex("100001000204 0007 0008")

    assert front.ask(READ) == FIVE
    assert front.ask(WRITE) == WRITE
    assert front.ask(many) == many[:5]
    assert front.ask(bytes.fromhex("0300010002")) == bytes.fromhex("030400070008")
    missing = bytes.fromhex("03ffff0001")
    assert front.ask(missing) == exception(missing, 2)


def test_a_function_of_a_vendor_passes_over_a_serial_line(
    on_line: OnLine, connect: Connect
) -> None:
    on_line.device.is_modelled = False
    on_line.device.then = lambda asked: asked.answer(b"\x41\xff\xee")

    assert connect(scada(on_line.appliance)).ask(VENDOR) == b"\x41\xff\xee"
    assert on_line.device.requests[0].pdu == VENDOR


def test_a_broadcast_on_a_serial_line_has_no_reply(on_line: OnLine, connect: Connect) -> None:
    on_line.device.script = [silent]
    front = connect(scada(on_line.appliance))

    front.send(wire.frame(WRITE, unit=0, transaction=1) + wire.frame(READ, 1, 2))

    assert front.receive() == wire.Frame(2, 1, FIVE)
    assert [(asked.unit, asked.pdu) for asked in on_line.device.requests] == [
        (0, WRITE),
        (1, READ),
    ]


@pytest.mark.parametrize("request_", ["0300050001", "170003000100010001020007", "080001ff00", "41"])
def test_only_a_write_is_broadcast_on_a_serial_line(
    on_line: OnLine, connect: Connect, request_: str
) -> None:
    asked = bytes.fromhex(request_)
    front = connect(scada(on_line.appliance))

    assert front.ask(asked, unit=0) == exception(asked, 1)
    assert front.ask(READ) == FIVE
    assert [asked.unit for asked in on_line.device.requests] == [1]


def test_unit_0_behind_tcp_is_a_unit_like_any_other(
    unmodelled: FakeDevice, run: Run, connect: Connect
) -> None:
    unmodelled.answer = lambda _: FIVE
    assert connect(scada(run(configuration(unmodelled.url)))).ask(READ, unit=0) == FIVE


def test_clients_of_a_serial_line_never_overlap(on_line: OnLine) -> None:
    def ask(number: int) -> bool:
        with wire.Connection(scada(on_line.appliance)) as front:
            for address in range(number, 1000, 50):
                expected = b"\x03\x02" + address.to_bytes(2)
                if front.ask(b"\x03" + address.to_bytes(2) + b"\0\1") != expected:
                    return False
        return True

    with ThreadPoolExecutor(4) as threads:
        assert all(threads.map(ask, range(4)))


def test_a_line_that_vanishes_is_opened_again(tmp_path: Path, run: Run, connect: Connect) -> None:
    path = tmp_path / "line"
    with Serial(RTU, path) as device:
        appliance = run(configuration(device.url))
        front = connect(scada(appliance))
        assert front.ask(READ) == FIVE
    assert front.ask(READ) in (exception(READ, 0x0A), exception(READ, 0x0B))
    with Serial(RTU, path):
        wire.until(lambda: front.ask(READ) == FIVE, "the line is opened again")


def test_the_reply_of_another_unit_is_no_answer(tmp_path: Path, run: Run, connect: Connect) -> None:
    with Serial(RTU, tmp_path / "line", lambda asked: asked.answer(unit=9)) as device:
        front = connect(scada(run(configuration(device.url, link={"timeout": 1.0}))))
        assert front.ask(READ) == exception(READ, 0x0B)
        assert front.ask(READ) == FIVE


# Failures


def closed_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port: int = listener.getsockname()[1]
    return port


def test_a_device_that_can_t_be_reached_is_exception_0a(run: Run, connect: Connect) -> None:
    appliance = run(configuration(f"tcp://127.0.0.1:{closed_port()}"))
    front = connect(scada(appliance))

    assert front.ask(READ) == exception(READ, 0x0A)
    await_count(appliance, "failures", 1)
    assert front.ask(WRITE) == exception(WRITE, 0x0A)


@pytest.mark.parametrize("kind", ["tcp", "rtu+tcp", "ascii+tcp"])
def test_a_device_whose_machine_drops_packets_is_exception_0a(
    run: Run, connect: Connect, kind: str
) -> None:
    with wire.dead_address() as (host, port):
        appliance = run(configuration(f"{kind}://{host}:{port}", link={"timeout": 0.1}))
        front = connect(scada(appliance))

        assert front.ask(READ) == exception(READ, 0x0A)
        await_count(appliance, "timeouts", 1)
        assert front.ask(WRITE) == exception(WRITE, 0x0A)


@pytest.mark.parametrize("kind", ["tcp", "rtu+tcp", "ascii+tcp"])
def test_a_silent_device_is_exception_0b_once_it_is_connected(
    run: Run, connect: Connect, kind: str
) -> None:
    with Stream(kind, then=silent, port=closed_port()) as device:
        device.stop()
        front = connect(scada(run(configuration(device.url, link={"timeout": 0.1}))))
        assert front.ask(READ) == exception(READ, 0x0A)
        device.start()
        wire.until(lambda: front.ask(READ) == exception(READ, 0x0B), "it is connected")


def test_a_line_that_is_not_silent_is_exception_0a(
    tmp_path: Path, run: Run, connect: Connect
) -> None:
    with Serial(RTU, tmp_path / "line", silence=10) as device:
        front = connect(scada(run(configuration(device.url, link={"timeout": 0.1}))))
        assert front.ask(WRITE) == exception(WRITE, 0x0A)
    assert not device.requests


def test_a_device_that_is_back_is_asked_again(run: Run, connect: Connect) -> None:
    with Stream("tcp", port=closed_port()) as device:
        device.stop()
        front = connect(scada(run(configuration(device.url))))
        assert front.ask(READ) == exception(READ, 0x0A)
        device.start()
        wire.until(lambda: front.ask(READ) == FIVE, "the device is asked again")


def test_a_silent_unit_is_exception_0b_and_the_others_are_served(
    run: Run, connect: Connect
) -> None:
    def only_one(asked: Asked) -> None:
        if asked.unit == 1:
            good(asked)

    def are_served(timeout: float) -> bool:
        with Stream("tcp", then=only_one) as device:
            appliance = run(configuration(device.url, link={"timeout": timeout}))
            with wire.Connection(scada(appliance)) as other:
                front = connect(scada(appliance))
                for number in range(4):
                    # The last one is not sent, if the pause is not over.
                    codes = [0x0B] if number < 3 else [0x0A, 0x0B]
                    assert front.ask(READ, unit=2) in [exception(READ, code) for code in codes]
                    reply = other.ask(READ, unit=1)
                    if reply == exception(READ, 0x0B):
                        return False
                    assert reply == FIVE
            assert counters(appliance)["timeouts"] + counters(appliance)["refused_down"] == 4
            assert counters(appliance)["replies"] == 4
            return True

    wire.until_long_enough(are_served, "the others have replies")


def test_a_function_that_a_unit_is_silent_about_does_not_stop_its_others(
    run: Run, connect: Connect
) -> None:
    unknown = bytes.fromhex("0400050001")

    def only_writes(asked: Asked) -> None:
        if asked.pdu == WRITE:
            good(asked)

    def is_served(timeout: float) -> bool:
        with Stream("tcp", then=only_writes) as device:
            appliance = run(configuration(device.url, link={"timeout": timeout}))
            front = connect(scada(appliance))
            for _ in range(3):
                assert front.ask(unknown) == exception(unknown, 0x0B)
            # Without a try, so it was not sent.
            assert front.ask(unknown) in (exception(unknown, 0x0A), exception(unknown, 0x0B))
            reply = front.ask(WRITE)
            if reply == exception(WRITE, 0x0B) or not counters(appliance)["refused_down"]:
                return False
            assert reply == WRITE
            assert counters(appliance)["timeouts"] == 3
            return True

    wire.until_long_enough(is_served, "the write has a reply")


def test_a_late_reply_is_not_the_answer_to_the_next_request(run: Run, connect: Connect) -> None:
    six = bytes.fromhex("0300060001")

    def is_answered(timeout: float) -> bool:
        waiting: list[bytes] = []

        def late(asked: Asked) -> None:
            """Answers when the next request is there, before the reply to that one."""
            waiting.append(asked.frame())

        def next_one(asked: Asked) -> None:
            asked.send(*waiting, asked.frame())

        with Stream("tcp", late, next_one) as device:
            front = connect(scada(run(configuration(device.url, link={"timeout": timeout}))))
            assert front.ask(READ) == exception(READ, 0x0B)
            reply = front.ask(six)
        if reply == exception(six, 0x0B):
            return False
        assert reply == bytes.fromhex("03020006")
        return True

    wire.until_long_enough(is_answered, "the next request has a reply")


def test_a_full_queue_is_exception_06(device: Stream, run: Run, connect: Connect) -> None:
    held = Held()
    device.script = [held]
    appliance = run(configuration(device.url, link={"queue": 1}))
    first, second = connect(scada(appliance)), connect(scada(appliance))
    first.send(wire.frame(READ))
    device.await_requests(1)

    assert second.ask(WRITE) == exception(WRITE, 6)
    held.release()
    assert first.receive().pdu == FIVE
    assert counters(appliance)["refused_full"] == 1
    assert [asked.pdu for asked in device.requests] == [READ]


def test_a_client_that_connects_again_and_again_leaves_places_to_others(
    device: Stream, run: Run, connect: Connect
) -> None:
    held = Held()
    device.script = [held]
    appliance = run(configuration(device.url, link={"queue": 4}))
    first = connect(scada(appliance))
    first.send(wire.frame(READ))
    device.await_requests(1)
    second, again = connect(scada(appliance)), connect(scada(appliance))
    second.send(wire.frame(WRITE))
    await_count(appliance, "waiting", 2)

    assert again.ask(WRITE) == exception(WRITE, 6)
    other = connect(scada(appliance), source="127.0.0.2")
    other.send(wire.frame(WRITE))
    await_count(appliance, "waiting", 3)
    held.release()
    assert other.receive().pdu == WRITE


@pytest.mark.parametrize("request_", [READ, WRITE], ids=["a read that others share", "a write"])
def test_a_client_that_has_gone_keeps_no_place_in_the_queue(
    device: Stream, run: Run, connect: Connect, request_: bytes
) -> None:
    held = Held()
    device.script = [held]
    appliance = run(configuration(device.url))
    first, gone, other = (connect(scada(appliance)) for _ in range(3))
    first.send(wire.frame(bytes.fromhex("0300060001")))
    device.await_requests(1)
    gone.send(wire.frame(request_))
    await_count(appliance, "waiting", 2)
    other.send(wire.frame(READ))
    await_count(appliance, "waiting", 3)
    await_count(appliance, "coalesced", int(request_ == READ))
    gone.reset()

    await_count(appliance, "withdrawn", 1)
    assert counters(appliance)["waiting"] == 2
    held.release()
    assert other.receive().pdu == FIVE
    assert [asked.pdu for asked in device.requests][1:] == [READ]


@pytest.mark.parametrize("end", ["reset", "half-closed"])
@pytest.mark.parametrize(
    ("unit", "behind"),
    [
        pytest.param(1, 0, id="alone"),
        pytest.param(2, 1, id="before one of memory"),
        pytest.param(1, 16, id="before 16"),
        pytest.param(2, 1000, id="before more than is read", marks=ends_are_found),
    ],
)
def test_the_write_of_a_client_that_has_gone_is_not_sent(
    device: Stream, run: Run, connect: Connect, unit: int, behind: int, end: str
) -> None:
    held = Held()
    device.script = [held]
    appliance = run(configuration(device.url, units=BESIDE_MEMORY, memories=MEMORY))
    first, gone = connect(scada(appliance)), connect(scada(appliance))
    first.send(wire.frame(READ))
    device.await_requests(1)
    gone.send(wire.frame(WRITE, transaction=behind) + wire.frames([WRITE] * behind, unit))
    waiting = min(16, 1 + (behind if unit == 1 else 0))
    await_count(appliance, "waiting", 1 + waiting)
    gone.reset() if end == "reset" else gone.socket.shutdown(socket.SHUT_WR)
    await_nobody(appliance, others=1)
    held.release()

    assert first.receive().pdu == FIVE
    await_count(appliance, "withdrawn", waiting)
    assert [asked.pdu for asked in device.requests] == [READ]
    assert appliance.memories["plant"].read("holding_registers", 5, 1) == [0]


def test_a_client_that_sends_more_than_is_read_gets_all_replies(device: Stream, run: Run) -> None:
    held = Held()
    device.script = [held]
    appliance = run(configuration(device.url, units=BESIDE_MEMORY, memories=MEMORY))
    with wire.Connection(scada(appliance)) as front:
        front.send(wire.frame(WRITE, transaction=3000) + wire.frames([READ] * 3000, unit=2))
        device.await_requests(1)
        held.release()
        replies = [reply.transaction for reply in front.receive_many(3001)]

    assert replies == [3000, *range(3000)]


def test_a_connection_that_had_no_room_reads_on_after_the_reply(device: Stream, run: Run) -> None:
    """Requests take more room while they wait, so that the last read was a short one."""
    held = Held()
    device.script = [held]
    appliance = run(configuration(device.url, kind="rtu", units=BESIDE_MEMORY, memories=MEMORY))
    frame = TRANSPORTS["rtu"].frame
    with client("rtu", scada(appliance)) as front:
        assert isinstance(front, FramedConnection)
        front.send(frame(READ) + 700 * frame(b"\x0b", unit=2))
        device.await_requests(1)
        front.send(frame(READ, unit=2))
        assert pauses(front)
        held.release()
        replies = front.replies(702)

    assert [unit for unit, _ in replies] == [1, *701 * [2]]
    assert (replies[0][1], replies[-1][1]) == (FIVE, bytes.fromhex("03020000"))


def test_the_write_of_a_client_that_has_gone_does_not_wait_for_late_replies(
    run: Run, connect: Connect, tmp_path: Path
) -> None:
    with Serial(RTU, tmp_path / "device", silent) as device:
        appliance = run(configuration(device.url, link={"timeout": 0.2}))
        first, gone = connect(scada(appliance)), connect(scada(appliance))
        assert first.ask(WRITE) == exception(WRITE, 0x0B)
        # It has its turn at once, but the reply to the first write may still come.
        gone.send(wire.frame(WRITE))
        await_count(appliance, "waiting", 1)
        gone.reset()

        await_count(appliance, "withdrawn", 1)
        assert counters(appliance)["failures"] == 0
        assert first.ask(READ) == bytes.fromhex("03021234")
        assert [asked.pdu for asked in device.requests] == [WRITE, READ]
        appliance.stop()


# Sharing


@pytest.mark.parametrize(("coalesce", "requests"), [(True, 2), (False, 3)])
def test_equal_reads_that_wait_are_answered_together(
    device: Stream, run: Run, connect: Connect, coalesce: bool, requests: int
) -> None:
    held = Held()
    device.script = [held]
    appliance = run(configuration(device.url, link={"coalesce": coalesce}))
    first, one, other = (connect(scada(appliance)) for _ in range(3))
    first.send(wire.frame(bytes.fromhex("0300060001")))
    device.await_requests(1)
    one.send(wire.frame(READ, transaction=1))
    await_count(appliance, "waiting", 2)
    other.send(wire.frame(READ, transaction=2))
    # A read that joins another one has joined when it is counted.
    await_count(appliance, "coalesced" if coalesce else "waiting", 1 if coalesce else 3)
    held.release()

    assert [one.receive(), other.receive()] == [wire.Frame(1, 1, FIVE), wire.Frame(2, 1, FIVE)]
    device.await_requests(requests)


def test_reads_with_different_timeouts_are_not_answered_together(
    device: Stream, run: Run, connect: Connect
) -> None:
    held = Held()
    device.script = [held, silent]
    units: dict[int | str, Any] = {1: {"route": "bus"}, 5: {"route": "drive"}}
    devices = {"drive": {"url": device.url, "unit": 1, "timeout": 0.1}}
    appliance = run(configuration(device.url, units=units, devices=devices))
    first, hurried, patient = (connect(scada(appliance)) for _ in range(3))
    first.send(wire.frame(SIXTH))
    device.await_requests(1)
    hurried.send(wire.frame(READ, unit=5))
    await_count(appliance, "waiting", 2)
    patient.send(wire.frame(READ))
    await_count(appliance, "waiting", 3)
    held.release()

    assert hurried.receive().pdu == exception(READ, 0x0B)
    assert patient.receive().pdu == FIVE
    assert counters(appliance)["coalesced"] == 0


def test_a_reply_answers_equal_reads_as_long_as_it_is_kept(
    device: Stream, run: Run, connect: Connect
) -> None:
    appliance = run(configuration(device.url, link={"cache": 3600}))
    front, other = connect(scada(appliance)), connect(scada(appliance))

    assert [front.ask(READ), other.ask(READ), front.ask(READ)] == [FIVE] * 3
    assert len(device.requests) == 1
    assert front.ask(WRITE) == WRITE
    assert other.ask(READ) == bytes.fromhex("03021234")
    assert [asked.pdu for asked in device.requests] == [READ, WRITE, READ]
    assert counters(appliance)["cached"] == 2


def test_without_a_cache_every_read_reaches_the_device(
    device: Stream, meter: Appliance, connect: Connect
) -> None:
    front = connect(scada(meter))

    assert [front.ask(READ) for _ in range(3)] == [FIVE] * 3
    device.await_requests(3)


def test_reads_of_preferred_clients_and_writes_go_first(
    device: Stream, run: Run, connect: Connect
) -> None:
    held = Held()
    device.script = [held]
    appliance = run(configuration(device.url, link={"priority": {"127.0.0.2": "high"}}))
    to = scada(appliance)
    first, usual, writer = connect(to), connect(to), connect(to)
    preferred = connect(to, source="127.0.0.2")
    first.send(wire.frame(READ))
    device.await_requests(1)
    seven, eight = bytes.fromhex("0300070001"), bytes.fromhex("0300080001")
    for number, (front, pdu) in enumerate([(usual, seven), (preferred, eight), (writer, WRITE)]):
        front.send(wire.frame(pdu))
        await_count(appliance, "waiting", number + 2)
    # The link takes requests in order: once it has this one, it has them all.
    connect(to).send(wire.frame(eight))
    await_count(appliance, "coalesced", 1)
    held.release()

    assert usual.receive().pdu == bytes.fromhex("03020007")
    assert [asked.pdu for asked in device.requests] == [READ, WRITE, eight, seven]


@pytest.mark.parametrize(
    ("source", "order"), [("127.0.0.2", "eab"), ("127.0.0.1", "aeb")], ids=["preferred", "usual"]
)
def test_a_read_that_joins_an_equal_one_waits_no_longer_than_alone(
    device: Stream, run: Run, connect: Connect, source: str, order: str
) -> None:
    held = Held()
    device.script = [held]
    appliance = run(configuration(device.url, link={"priority": {"127.0.0.2": "high"}}))
    first, many = connect(scada(appliance)), connect(scada(appliance))
    other = connect(scada(appliance), source=source)
    reads = {name: bytes.fromhex(f"0300{name * 2}0001") for name in "abe"}
    first.send(wire.frame(READ))
    device.await_requests(1)
    for number, pdu in enumerate(reads.values()):
        many.send(wire.frame(pdu, transaction=number))
    await_count(appliance, "waiting", 4)
    other.send(wire.frame(reads["e"]))
    await_count(appliance, "coalesced", 1)
    held.release()

    assert [many.receive().transaction for _ in reads] == [0, 1, 2]
    assert other.receive().pdu == bytes.fromhex("030200ee")
    assert [asked.pdu for asked in device.requests] == [READ, *(reads[name] for name in order)]


# Audit


@pytest.mark.parametrize("kind", ["tcp", "udp"])
def test_what_is_passed_on_is_in_the_audit_log(
    device: Stream, run: Run, tmp_path: Path, kind: str
) -> None:
    device.is_modelled = False
    device.then = lambda asked: asked.answer(
        exception(asked.pdu, 0x63) if asked.pdu[:1] == b"\x10" else asked.pdu
    )
    many = bytes.fromhex("100005000102 0001")
    refused = [bytes.fromhex(pdu) for pdu in ("420102", "0800010000", "2b0d00")]
    appliance = run(
        configuration(
            device.url,
            kind=kind,
            units={5: {"route": "bus"}},
            rule={"functions": [3, 6, 16, 65]},
            audit={"file": "audit.log"},
        )
    )
    with client(kind, scada(appliance)) as front:
        for pdu in (WRITE, many, VENDOR, READ, bytes.fromhex("0500050000"), *refused):
            front.ask(pdu, 5)

    found = [
        {key: value for key, value in line.items() if key not in ("time", "peer", "listener")}
        for line in await_writes(tmp_path / "audit.log", 7)
    ]
    register = {"area": "holding_registers", "address": 5}
    assert found[0] == {
        "unit": 5, "route": "bus", "function": 6, **register, "values": [0x1234],
        "outcome": "done",
    }  # fmt: skip
    assert found[1] == {
        "unit": 5, "route": "bus", "function": 16, **register, "values": [1],
        "outcome": found[1]["outcome"],
    }  # fmt: skip
    assert found[1]["outcome"] != "done"
    assert found[2] == {
        "unit": 5, "route": "bus", "function": 65, "pdu": "4101020304", "outcome": "done",
    }  # fmt: skip
    assert found[3]["function"] == 5
    assert found[3]["outcome"] == "illegal_function"
    assert "route" not in found[3]
    assert found[4:] == [
        {"unit": 5, "function": pdu[0], "pdu": pdu.hex(), "outcome": "illegal_function"}
        for pdu in refused
    ]


@pytest.mark.parametrize("is_ended", [False, True])
def test_a_write_under_way_is_recorded_although_its_client_has_gone(
    device: Stream, run: Run, connect: Connect, tmp_path: Path, is_ended: bool
) -> None:
    """Also if it is the appliance that ends the connection."""
    held = Held()
    device.script = [held]
    appliance = run(configuration(device.url, audit={"file": "audit.log"}))
    gone = connect(scada(appliance))
    gone.send(wire.frame(WRITE, 1, 1) + wire.frame(WRITE, 2, 2))
    device.await_requests(1)
    await_count(appliance, "waiting", 2)
    if is_ended:
        [session] = appliance.sessions()
        assert appliance.end_session("scada", session["id"], {})
        assert gone.rest() == b""
    else:
        gone.reset()
    await_nobody(appliance)
    held.release()

    await_count(appliance, "withdrawn", 1)
    [line] = await_writes(tmp_path / "audit.log", 1)
    assert (line["unit"], line["function"], line["outcome"]) == (1, 6, "done")
    device.await_requests(1)


@pytest.mark.parametrize("kind", ["tcp", "udp", "serial"])
def test_a_write_under_way_is_recorded_although_its_listener_was_removed(
    device: Stream, run: Run, tmp_path: Path, kind: str
) -> None:
    held = Held()
    device.script = [held]
    audit = {"file": "audit.log"}
    with ExitStack() as clients:
        if kind == "serial":
            line = clients.enter_context(Line(tmp_path / "line", RTU))
            text = routed.serial_configuration(device.url, RTU.listener, line.device, audit=audit)
            appliance = run(text)
            line.send(RTU.frame(WRITE, 1))
        else:
            appliance = run(configuration(device.url, kind=kind, audit=audit))
            front = clients.enter_context(client(kind, scada(appliance)))
            assert isinstance(front, wire.Connection | Datagrams)
            front.send(wire.frame(WRITE))
        device.await_requests(1)
        file = tmp_path / "appliance.yaml"
        file.write_text(configuration(device.url, audit=audit).replace('"scada"', '"other"'))
        appliance.reload(load(file))
        assert list(appliance.diagnostics.stats()["listeners"]) == ["other"]
        held.release()
        [found] = await_writes(tmp_path / "audit.log", 1)
    assert (found["function"], found["outcome"]) == (6, "done")


# The end


def is_listening(to: tuple[str, int]) -> bool:
    try:
        socket.create_connection(to, timeout=wire.DEADLINE).close()
    except ConnectionRefusedError:
        return False
    except ConnectionResetError:
        # It was closed meanwhile.
        return True
    return True


def test_a_request_under_way_is_answered_before_the_end(
    device: Stream, run: Run, connect: Connect, tmp_path: Path
) -> None:
    held = Held()
    device.script = [held]
    appliance = run(configuration(device.url, audit={"file": "audit.log"}))
    to = scada(appliance)
    front = connect(to)
    front.send(wire.frame(WRITE))
    device.await_requests(1)
    stopping = threading.Thread(target=appliance.stop)
    stopping.start()
    wire.until(lambda: not is_listening(to), "the listener is closed")
    held.release()
    stopping.join()

    assert front.receive().pdu == WRITE
    assert front.rest() == b""
    assert [line["outcome"] for line in await_writes(tmp_path / "audit.log", 1)] == ["done"]


def test_the_end_does_not_wait_for_a_silent_device(
    device: Stream, run: Run, connect: Connect
) -> None:
    device.then = silent
    appliance = run(configuration(device.url, link={"timeout": 3600}))
    front = connect(scada(appliance))
    front.send(wire.frame(READ))
    device.await_requests(1)
    appliance.stop()

    assert front.rest() == b""


def test_nothing_is_left_running_if_a_listener_can_t_start(device: Stream, run: Run) -> None:
    before = {thread.name for thread in threading.enumerate()}
    with socket.create_server(("127.0.0.1", 0)) as taken:
        bind = f'"bind": "127.0.0.1:{taken.getsockname()[1]}"'
        text = configuration(device.url).replace('"bind": "127.0.0.1:0"', bind)
        assert bind in text
        with pytest.raises(OSError, match="listener scada"):
            run(text)
    assert {thread.name for thread in threading.enumerate()} == before
    assert device.connections == 0

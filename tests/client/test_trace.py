"""The trace of a client: the bytes that are sent and received."""

from __future__ import annotations

import asyncio
import gc
import sys
import threading
import weakref
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast.client import async_transports
from support import transports, wire
from support.fake_device import FakeDevice, Stream, registers
from support.running import endpoint
from support.secured import Authority, Relay, context

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.client.base import Trace
    from support.running import Run

READ = bytes.fromhex("0000 0006 01 03 0007 0002")
"""A request after its transaction id."""
REPLY = bytes.fromhex("0000 0007 01 03 04 0000 0000")


class Shown:
    """What a trace was called with, joined where a frame came in parts."""

    def __init__(self) -> None:
        self.parts: list[tuple[str, bytes]] = []

    def __call__(self, direction: str, data: bytes) -> None:
        assert data
        if self.parts and self.parts[-1][0] == direction:
            data = self.parts.pop()[1] + data
        self.parts.append((direction, data))


def test_all_bytes_are_shown_in_order() -> None:
    shown = Shown()
    with FakeDevice(registers) as device, holdfast.SyncClient(device.url, trace=shown) as plc:
        assert plc.read_holding_registers(7, 2) == [0, 0]
        assert plc.read_holding_registers(7, 2) == [0, 0]
    words, frames = zip(*shown.parts, strict=True)
    assert words == ("sent", "received") * 2
    ids = [frame[:2] for frame in frames]
    assert ids[0] == ids[1] != ids[2] == ids[3]
    assert [frame[2:] for frame in frames] == [READ, REPLY] * 2


@pytest.mark.parametrize("kind", ["udp", "rtu", "rtu-udp", "ascii"])
def test_frames_are_those_of_the_transport(kind: str, run: Run) -> None:
    appliance = run(transports.configuration(kind))
    host, port = endpoint(appliance, "scada")
    scheme = {"udp": "udp", "rtu": "rtu+tcp", "rtu-udp": "rtu+udp", "ascii": "ascii+tcp"}[kind]
    shown = Shown()
    with holdfast.SyncClient(f"{scheme}://{host}:{port}", trace=shown) as plc:
        plc.read_holding_registers(7, 2)
    [(sent, request), (received, reply)] = shown.parts
    assert (sent, received) == ("sent", "received")
    expected = {
        "udp": (READ, REPLY),
        "rtu": (bytes.fromhex("0103 0007 0002 75CA"), bytes.fromhex("010304 00000000 FA33")),
        "ascii": (b":010300070002F3\r\n", b":01030400000000F8\r\n"),
    }
    if kind == "udp":
        request, reply = request[2:], reply[2:]
    assert (request, reply) == expected[kind.removesuffix("-udp")]


def test_an_error_in_the_trace_is_reported_and_the_call_goes_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    reported: list[Any] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda found: reported.append(found.exc_value))

    def trace(direction: str, _data: bytes) -> None:
        raise ValueError(direction)

    with FakeDevice(registers) as device, holdfast.SyncClient(device.url, trace=trace) as plc:
        assert plc.read_holding_registers(7, 2) == [0, 0]
    assert [str(each) for each in reported] == ["sent", "received"]


@pytest.mark.parametrize("at", ["sent", "received"])
def test_an_interrupt_in_the_trace_ends_the_call(at: str) -> None:
    interrupts = [KeyboardInterrupt]

    def trace(direction: str, _data: bytes) -> None:
        if direction == at and interrupts:
            raise interrupts.pop()

    with FakeDevice(registers) as device, holdfast.SyncClient(device.url, trace=trace) as plc:
        with pytest.raises(KeyboardInterrupt):
            plc.read_holding_registers(7, 2)
        assert plc.read_holding_registers(7, 2) == [0, 0]


def test_the_trace_cannot_use_its_client() -> None:
    refused: list[RuntimeError] = []

    def trace(_direction: str, _data: bytes) -> None:
        with pytest.raises(RuntimeError, match="a trace can't use it") as found:
            plc.read_coils(0, 1)
        refused.append(found.value)

    with FakeDevice(registers) as device, holdfast.SyncClient(device.url, trace=trace) as plc:
        assert plc.read_holding_registers(7, 2) == [0, 0]
    assert len(refused) == 2


def test_a_trace_that_closes_its_client_closes_the_connection_after_the_reply() -> None:
    def trace(direction: str, _data: bytes) -> None:
        if direction == "received":
            plc.close()

    with Stream("tcp") as device, holdfast.SyncClient(device.url, trace=trace) as plc:
        for address in (7, 8):
            assert plc.read_holding_registers(address, 1) == [address]
        assert device.connections == 2


def test_a_trace_within_a_call_of_another_trace_cannot_use_the_client_of_either() -> None:
    refused: list[str] = []

    def inner_trace(direction: str, _data: bytes) -> None:
        for plc in (outer, inner):
            with pytest.raises(RuntimeError, match="a trace can't use it"):
                plc.read_coils(0, 1)
            refused.append(direction)

    def outer_trace(_direction: str, _data: bytes) -> None:
        assert inner.read_holding_registers(7, 2) == [7, 8]

    with Stream("tcp") as device:
        outer = holdfast.SyncClient(device.url, trace=outer_trace)
        inner = holdfast.SyncClient(device.url, trace=inner_trace)
        call = threading.Thread(target=outer.read_holding_registers, args=(7, 2), daemon=True)
        call.start()
        call.join(wire.DEADLINE)
        assert refused == ["sent", "sent", "received", "received"] * 2
        inner.close()
        outer.close()


def read_twice(url: str, trace: Trace) -> None:
    """Reads two registers twice with a client for asyncio."""

    async def reading() -> None:
        async with holdfast.Client(url, trace=trace) as plc:
            assert await plc.read_holding_registers(7, 2) == [7, 8]
            assert await plc.read_holding_registers(7, 2) == [7, 8]

    asyncio.run(reading())


def assert_two_reads(shown: Shown) -> None:
    words, frames = zip(*shown.parts, strict=True)
    assert words == ("sent", "received") * 2
    reply = bytes.fromhex("0000 0007 01 03 04 0007 0008")
    assert [frame[2:] for frame in frames] == [READ, reply] * 2


def test_an_event_loop_shows_all_bytes_in_order() -> None:
    shown = Shown()
    with Stream("tcp") as device:
        read_twice(device.url, shown)
    assert_two_reads(shown)


def test_an_event_loop_shows_what_is_inside_of_tls(tmp_path: Path) -> None:
    authority, shown = Authority(tmp_path), Shown()
    owner = authority.issue("plc", "IP:127.0.0.1")
    with Stream("tcp") as device, Relay(("127.0.0.1", device.port), context(owner)) as relay:
        read_twice(relay.url(ca=authority.ca), shown)
    assert_two_reads(shown)


def test_a_client_for_asyncio_shows_the_bytes_of_other_transports() -> None:
    shown = Shown()
    with Stream("rtu+tcp") as device:
        read_twice(device.url, shown)
    assert [word for word, _ in shown.parts] == ["sent", "received"] * 2


@pytest.mark.parametrize("at", ["sent", "received"])
def test_an_error_in_the_trace_ends_nothing_in_an_event_loop(
    at: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    reported: list[Any] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda found: reported.append(found.exc_value))

    def trace(direction: str, _data: bytes) -> None:
        if direction == at:
            raise ValueError(direction)

    with Stream("tcp") as device:
        read_twice(device.url, trace)
    assert [str(each) for each in reported] == [at, at]


@pytest.mark.parametrize("at", ["sent", "received"])
def test_an_interrupt_in_the_trace_ends_the_event_loop(at: str) -> None:
    interrupts = [KeyboardInterrupt]

    def trace(direction: str, _data: bytes) -> None:
        if direction == at and interrupts:
            raise interrupts.pop()

    with Stream("tcp") as device, pytest.raises(KeyboardInterrupt):
        read_twice(device.url, trace)
    assert not interrupts


class Owner:
    """A device of a program, with a method for the bytes of its client."""

    def __init__(self, kind: type[Any], url: str) -> None:
        self.client = kind(url, trace=self.note, timeout=wire.DEADLINE)

    def note(self, direction: str, data: bytes) -> None:
        pass


def test_a_client_that_shows_its_bytes_to_its_owner_ends_with_it() -> None:
    with Stream("tcp") as device:
        owner = Owner(holdfast.SyncClient, device.url)
        assert owner.client.read_holding_registers(7, 2) == [7, 8]
        left = weakref.ref(owner)
        del owner
        gc.collect()
        assert left() is None
        wire.until(lambda: not device.is_connected, "it is closed")


@pytest.mark.parametrize("scheme", ["tcp", "rtu+tcp"])
def test_a_client_for_asyncio_that_shows_its_bytes_to_its_owner_ends_with_it(scheme: str) -> None:
    def forget(owners: list[Owner], warned: pytest.WarningsRecorder) -> None:
        def is_warned_of() -> bool:
            gc.collect()
            return bool(warned.list)

        owners.clear()
        # A thread may still be at the end of the call.
        wire.until(is_warned_of, "Python warns of it")

    async def main(device: Stream) -> None:
        owners = [Owner(holdfast.Client, device.url)]
        assert await owners[0].client.read_holding_registers(7, 2) == [7, 8]
        left = weakref.ref(owners[0])
        with pytest.warns(ResourceWarning, match="unclosed client") as warned:
            forget(owners, warned)
        del warned  # It has the client as its source.
        gc.collect()
        assert left() is None
        await asyncio.to_thread(wire.until, lambda: not device.is_connected, "it is closed")

    with Stream(scheme) as device:
        asyncio.run(main(device))


def test_a_thread_of_calls_closes_its_connection_whichever_of_them_python_ends_first() -> None:
    closed = threading.Event()
    core: Any = SimpleNamespace(end_call=lambda: None, close=closed.set)
    thread = async_transports._CallThread(core, None)
    del thread
    assert closed.wait(wire.DEADLINE)

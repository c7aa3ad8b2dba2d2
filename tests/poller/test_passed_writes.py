"""Writes into ranges that mirror a device, passed on to the device (`writes: pass`)."""

from __future__ import annotations

import asyncio
import contextlib
import json
import resource
import signal
import threading
from concurrent.futures import ThreadPoolExecutor
from queue import Queue
from typing import TYPE_CHECKING, Any, cast

import pytest

import holdfast
from holdfast.adapters.rest.device_writes import MAX_WAITING, DeviceWrites
from holdfast.config import load
from holdfast.events.audit import Audit
from holdfast.ingest import Grant, MemoryAccess, Refused
from holdfast.net.http.requests import Request
from support import web, wire
from support.audits import await_writes, full, writes
from support.cli import RunCommand
from support.config_folder import written
from support.fake_device import Asked, Stream, exception, good
from support.polled import configuration, counters, device, read, until_polled
from support.routed import Held
from support.running import endpoint, log_events

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from holdfast.appliance import Appliance
    from support.fake_device import Behaviour
    from support.running import Run

SOURCES = ["127.0.0.1"]
RULE = {"sources": SOURCES, "units": {1: "mirror"}, "access": "read-write"}
MORE: dict[str, Any] = {
    "listeners": {
        "scada": {"type": "modbus-tcp", "bind": "127.0.0.1:0", "rules": [RULE]},
        "datagrams": {"type": "modbus-udp", "bind": "127.0.0.1:0", "rules": [RULE]},
    },
    "rest": {"bind": "127.0.0.1:0", "sources": SOURCES, "tokens": "none"},
}
READS = [
    read("holding_registers", 500, 3, ("holding_registers", 10)),
    read("holding_registers", 600, 2, ("holding_registers", 13)),
    read("coils", 0, 8, ("coils", 100)),
    read("input_registers", 0, 2, ("holding_registers", 40)),
]
"""The device's registers 500 to 502 and 600 to 601 are 10 to 14 of the mirror, its coils 0 to 7 are
100 to 107, and its input registers 0 and 1 are holding registers 40 and 41."""

RARELY: dict[str, Any] = {"interval": 3600, "writes": "pass"}


def plc(then: Behaviour = good) -> Stream:
    return Stream("tcp", then=then)


def started(run: Run, source: Stream, **settings: Any) -> Appliance:
    meter = device(source.url, *READS, **{**RARELY, **settings})
    appliance = run(configuration({"meter": meter}, **MORE))
    until_read(appliance)
    return appliance


def until_read(appliance: Appliance) -> None:
    """Waits until the mirror has all that is read at the start."""
    wire.until(lambda: counters(appliance, "meter")["reads"] >= len(READS), "all is read")


def client(appliance: Appliance, listener: str = "scada") -> holdfast.SyncClient:
    host, port = endpoint(appliance, listener)
    scheme = "udp" if listener == "datagrams" else "tcp"
    return holdfast.SyncClient(f"{scheme}://{host}:{port}", timeout=wire.DEADLINE)


@contextlib.contextmanager
def refused_with(code: int) -> Iterator[None]:
    with pytest.raises(holdfast.ModbusException) as raised:
        yield
    assert raised.value.code == code


def requests_of(source: Stream) -> list[bytes]:
    return [asked.pdu for asked in source.requests]


def writes_of(source: Stream) -> list[bytes]:
    return [pdu for pdu in requests_of(source) if pdu[0] > 4]


WRITES: dict[str, tuple[Callable[[holdfast.SyncClient], object], bytes, list[int]]] = {
    "function 6": (lambda plc: plc.write_register(11, 7), b"\x06\x01\xf5\x00\x07", [500, 7, 502]),
    "function 16": (
        lambda plc: plc.write_registers(10, [1, 2]),
        b"\x10\x01\xf4\x00\x02\x04\x00\x01\x00\x02",
        [1, 2, 502],
    ),
    "function 22": (
        lambda plc: plc.mask_write(12, and_mask=0xFF00, or_mask=0x0011),
        b"\x16\x01\xf6\xff\x00\x00\x11",
        [500, 501, 0x0111],
    ),
    "function 23": (
        lambda plc: plc.read_write(10, 3, 11, [9]),
        b"\x17\x01\xf4\x00\x03\x01\xf5\x00\x01\x02\x00\x09",
        [500, 9, 502],
    ),
}


def test_a_device_without_functions_5_and_6_gets_15_and_16(run: Run) -> None:
    with plc() as source:
        appliance = started(run, source, tolerance={"write_multiple": True}, emulate=True)
        with client(appliance) as scada:
            scada.write_register(11, 7)
            scada.write_coil(101, True)
            scada.mask_write(12, and_mask=0xFF00, or_mask=0x0011)
            assert scada.read_holding_registers(10, 3) == [500, 7, 0x0111]
        assert [pdu[0] for pdu in writes_of(source)] == [16, 15, 16]


@pytest.mark.parametrize("listener", ["scada", "datagrams"])
@pytest.mark.parametrize("name", WRITES)
def test_a_write_reaches_the_device_and_then_memory(name: str, listener: str, run: Run) -> None:
    write, sent, after = WRITES[name]
    with plc() as source:
        appliance = started(run, source)
        with client(appliance, listener) as scada:
            result = write(scada)
            assert scada.read_holding_registers(10, 3) == after
        assert writes_of(source) == [sent]
        assert result in (None, after)


def test_a_write_that_is_sent_again_before_its_reply_reaches_the_device_once(run: Run) -> None:
    held = Held()
    with plc() as source:
        appliance = started(run, source)
        source.script = [*[good] * len(source.requests), held]
        with wire.Connection(endpoint(appliance, "scada")) as scada:
            scada.send(3 * wire.frame(b"\x06\x00\x0b\x00\x07"))
            wire.until(lambda: writes_of(source), "the write is passed on")
            held.release()
            assert len(scada.receive_many(3)) == 3
        assert len(writes_of(source)) == 1


def test_a_route_does_not_overtake_a_write_of_its_connection_that_is_passed_on(run: Run) -> None:
    """Both wait for a poll: the one for its device's turn, the other for the link alone."""
    is_asked, goes_on = threading.Event(), threading.Event()

    def slow(asked: Asked) -> None:
        if held:
            is_asked.set()
            assert goes_on.wait(wire.DEADLINE)
        asked.answer()

    held = False
    with plc(slow) as source:
        meter = device(source.url, *READS, interval=0.05, writes="pass", timeout=wire.DEADLINE)
        rule = {**RULE, "units": {1: "mirror", 9: {"route": "meter"}}}
        scada = {**MORE["listeners"]["scada"], "rules": [rule]}
        appliance = run(configuration({"meter": meter}, **{**MORE, "listeners": {"scada": scada}}))
        until_read(appliance)
        held = True
        assert is_asked.wait(wire.DEADLINE)
        with wire.Connection(endpoint(appliance, "scada")) as writer:
            passed, routed = b"\x06\x00\x0a\x00\x01", b"\x06\x01\xf4\x00\x02"
            writer.send(wire.frame(passed) + wire.frame(routed, 9))
            goes_on.set()
            assert [each.pdu for each in writer.receive_many(2)] == [passed, routed]
        assert writes_of(source) == [b"\x06\x01\xf4\x00\x01", routed]


def test_coils_reach_the_device_and_then_memory(run: Run) -> None:
    with plc() as source:
        appliance = started(run, source)
        with client(appliance) as scada:
            scada.write_coil(103, True)
            scada.write_coils(105, [True, True])
            assert scada.read_coils(100, 8) == [0, 0, 0, 1, 0, 1, 1, 0]
        assert writes_of(source) == [b"\x05\x00\x03\xff\x00", b"\x0f\x00\x05\x00\x02\x01\x03"]


def test_function_22_can_be_a_read_and_a_write(run: Run) -> None:
    with plc() as source:
        appliance = started(run, source, emulate=True)
        asked = len(source.requests)
        with client(appliance) as scada:
            scada.mask_write(12, and_mask=0xFF00, or_mask=0x0011)
            assert scada.read_holding_registers(12, 1) == [0x0111]
        assert requests_of(source)[asked:] == [b"\x03\x01\xf6\x00\x01", b"\x06\x01\xf6\x01\x11"]


def test_nothing_comes_between_the_read_and_the_write_of_function_22(run: Run) -> None:
    """A route leads to the same device: its write waits for both, and keeps its bits."""
    is_read, goes_on = threading.Event(), threading.Event()

    def slow(asked: Asked) -> None:
        if asked.pdu == b"\x03\x01\xf6\x00\x01":
            is_read.set()
            assert goes_on.wait(wire.DEADLINE)
        asked.answer()

    with plc(slow) as source, ThreadPoolExecutor(2) as threads:
        meter = device(source.url, *READS, **RARELY, emulate=True, timeout=wire.DEADLINE)
        rule = {**RULE, "units": {1: "mirror", 9: {"route": "meter"}}}
        scada = {**MORE["listeners"]["scada"], "rules": [rule]}
        appliance = run(configuration({"meter": meter}, **{**MORE, "listeners": {"scada": scada}}))
        until_read(appliance)
        with client(appliance) as mirror, client(appliance) as route:
            low = threads.submit(mirror.mask_write, 12, and_mask=0xFF00, or_mask=0x0011)
            assert is_read.wait(wire.DEADLINE)
            high = threads.submit(route.mask_write, 502, and_mask=0x00FF, or_mask=0x2200, unit=9)
            links = appliance.diagnostics.stats
            wire.until(lambda: links()["links"]["meter"]["waiting"], "the other write waits")
            goes_on.set()
            assert (low.result(), high.result()) == (None, None)
        assert source.model.values["holding_registers"][502] == 0x2211


def test_what_function_22_read_is_not_written_once_its_device_has_gone(
    run: Run, tmp_path: Path
) -> None:
    is_read, goes_on, file = threading.Event(), threading.Event(), tmp_path / "other.yaml"

    def slow(asked: Asked) -> None:
        if asked.pdu == b"\x03\x01\xf6\x00\x01":
            is_read.set()
            assert goes_on.wait(wire.DEADLINE)
        asked.answer()

    with plc(slow) as source, plc() as other, ThreadPoolExecutor(1) as threads:
        appliance = started(run, source, emulate=True, timeout=wire.DEADLINE)
        with client(appliance) as scada:
            masked = threads.submit(scada.mask_write, 12, and_mask=0xFF00, or_mask=0x0011)
            assert is_read.wait(wire.DEADLINE)
            file.write_text(configuration({"other": device(other.url, *READS)}, **MORE))
            appliance.reload(load(file))
            wire.until(lambda: other.requests, "the device has gone")
            goes_on.set()
            with refused_with(10):
                masked.result()
        assert writes_of(source) == []


@pytest.mark.parametrize("way", ["hang up", "do not answer", "refuse"])
def test_function_22_is_not_confirmed_if_its_value_is_not_known(way: str, run: Run) -> None:
    """The device has carried it out, and does not tell what it has now."""
    is_written = threading.Event()

    def tell_nothing(asked: Asked) -> None:
        if asked.pdu[0] == 22:
            is_written.set()
        elif is_written.is_set() and way == "hang up":
            return asked.peer.hang_up()
        elif is_written.is_set():
            return asked.answer(exception(asked.pdu, 4)) if way == "refuse" else None
        asked.answer()
        return None

    with plc(tell_nothing) as source:
        appliance = started(run, source, timeout=0.2, tolerance={"retries": 3})
        with client(appliance) as scada:
            with refused_with(11):
                scada.mask_write(12, and_mask=0xFF00, or_mask=0x0011)
            assert scada.read_holding_registers(12, 1) == [502]
        assert is_written.is_set()


def test_what_is_read_from_input_registers_is_never_written(run: Run) -> None:
    with plc() as source:
        appliance = started(run, source)
        with client(appliance) as scada, refused_with(2):
            scada.write_register(40, 1)
        assert writes_of(source) == []


MIXED: dict[str, Callable[[holdfast.SyncClient], object]] = {
    "two ranges": lambda plc: plc.write_registers(12, [1, 1]),
    "a range and what is before it": lambda plc: plc.write_registers(9, [1, 1]),
    "all": lambda plc: plc.write_registers(0, [1] * 50),
    "a write in a range, a read beyond it": lambda plc: plc.read_write(9, 2, 10, [1]),
}


@pytest.mark.parametrize("write", MIXED.values(), ids=MIXED)
def test_a_write_of_more_than_one_range_is_refused(
    write: Callable[[holdfast.SyncClient], object], run: Run
) -> None:
    with plc() as source:
        appliance = started(run, source)
        with client(appliance) as scada:
            with refused_with(2):
                write(scada)
            assert scada.read_holding_registers(9, 6) == [0, 500, 501, 502, 600, 601]
        assert writes_of(source) == []


def refuse_writes(asked: Asked) -> None:
    asked.answer(exception(asked.pdu, 4) if asked.pdu[0] > 4 else None)


def ignore_writes(asked: Asked) -> None:
    if asked.pdu[0] <= 4:
        asked.answer()


def test_the_client_gets_the_exception_of_the_device(run: Run) -> None:
    with plc(refuse_writes) as source:
        appliance = started(run, source)
        with client(appliance) as scada:
            with refused_with(4):
                scada.write_register(11, 7)
            assert scada.read_holding_registers(11, 1) == [501]


def test_a_device_that_does_not_answer_is_exception_11(run: Run) -> None:
    with plc(ignore_writes) as source:
        # Only a write is not answered: reads are repeated, should they take longer.
        appliance = started(run, source, timeout=0.2, tolerance={"retries": 10})
        with client(appliance) as scada:
            with refused_with(11):
                scada.write_register(11, 7)
            assert scada.read_holding_registers(11, 1) == [501]


def test_a_device_gets_no_burst_of_old_writes_after_it_was_silent(run: Run) -> None:
    is_silent = threading.Event()
    is_silent.set()

    def silent(asked: Asked) -> None:
        if asked.pdu[0] <= 4 or not is_silent.is_set():
            asked.answer()

    retry = {"first": 0.5, "most": 0.5}
    with plc(silent) as source:
        tolerance = {"retries": 10}
        appliance = started(run, source, timeout=0.2, retry=retry, tolerance=tolerance)
        with wire.Connection(endpoint(appliance, "scada")) as scada:
            write = b"\x06\x00\x0b\x00"
            codes = [reply[1] for reply in scada.ask_many(write + bytes([n]) for n in range(40))]
            assert codes[:3] == [11] * 3
            assert 10 in codes
            assert codes.count(11) == len(writes_of(source)), "0A: it was not sent"
            is_silent.clear()
            wire.until(lambda: scada.ask(write + b"\xff")[0] == 6, "it is tried again")
        assert writes_of(source)[codes.count(11) :] == [b"\x06\x01\xf5\x00\xff"]


def test_a_device_that_has_gone_is_exception_10(run: Run) -> None:
    with plc() as source:
        appliance = started(run, source)
    with client(appliance) as scada:
        for _ in range(3):
            with pytest.raises(holdfast.ModbusException) as raised:
                scada.write_register(11, 7)
        assert raised.value.code == 10
        assert scada.read_holding_registers(11, 1) == [501]


@pytest.mark.parametrize("emulate", [True, False], ids=["a read and a write", "a write"])
def test_a_device_to_which_no_connection_can_be_made_is_exception_10(
    run: Run, *, emulate: bool
) -> None:
    pause = {"first": 0.001, "most": 0.001}
    with wire.dead_address() as (host, port):
        settings = {**RARELY, "retry": pause, "timeout": 0.1, "emulate": emulate}
        meter = device(f"tcp://{host}:{port}", *READS, **settings)
        appliance = run(configuration({"meter": meter}, **MORE))
        wire.until(lambda: counters(appliance, "meter")["timeouts"], "a poll has failed")
        with client(appliance) as scada:
            for _ in range(3):
                with refused_with(10):
                    scada.mask_write(12, and_mask=0xFF00, or_mask=0x0011)


def test_a_sealed_memory_passes_nothing_on(run: Run, caplog: pytest.LogCaptureFixture) -> None:
    with plc() as source:
        meter = device(source.url, *READS, **RARELY)
        appliance = run(with_seal(configuration({"meter": meter}, **MORE), 0))
        until_read(appliance)
        with client(appliance) as scada, refused_with(6):
            scada.write_register(11, 7)
        assert writes_of(source) == []
        log_events(appliance)
        assert caplog.messages.count("refused_sealed") == 1


def with_seal(text: str, address: int) -> str:
    seal = {"area": "coils", "address": address, "mode": "level"}
    sealed = text.replace('"coils":', f'"seal": {json.dumps(seal)}, "coils":', 1)
    assert sealed != text
    return sealed


def test_modbus_passes_no_write_of_the_gate_bit_on(run: Run) -> None:
    with plc() as source:
        source.model.values["coils"][3] = 1
        meter = device(source.url, *READS, **RARELY)
        appliance = run(with_seal(configuration({"meter": meter}, **MORE), 103))
        until_read(appliance)
        assert not appliance.memories["mirror"].sealed
        with client(appliance) as scada:
            for value in (False, True):
                with refused_with(2):
                    scada.write_coil(103, value)
                with refused_with(2):
                    scada.write_coils(102, [True, value, True])
            scada.write_coil(104, True)
        assert writes_of(source) == [b"\x05\x00\x04\xff\x00"]
        rest = web.Client(endpoint(appliance, "rest"))
        with contextlib.closing(rest):
            assert rest.ingest(web.command("coils", 103, [0], "mirror")).status == 200
        assert appliance.memories["mirror"].sealed


def test_a_write_that_waits_when_its_memory_is_sealed_is_not_sent(run: Run) -> None:
    device_writes = HeldWrites()
    with plc(device_writes) as source:
        meter = device(source.url, *READS, **RARELY, timeout=wire.DEADLINE)
        appliance = run(with_seal(configuration({"meter": meter}, **MORE), 0))
        until_read(appliance)
        mirror = appliance.memories["mirror"]
        mirror.write("coils", 0, [1])
        scada = endpoint(appliance, "scada")
        with wire.Connection(scada) as first, wire.Connection(scada) as second:
            first.send(wire.frame(b"\x06\x00\x0b\x00\x01"))
            held = device_writes.next()
            second.send(wire.frame(b"\x06\x00\x0b\x00\x02"))
            asked = appliance.diagnostics.stats
            wire.until(lambda: asked()["listeners"]["scada"]["requests"][6] == 2, "both are taken")
            mirror.write("coils", 0, [0])
            held.answer()
            assert first.receive().pdu == b"\x06\x00\x0b\x00\x01"
            assert second.receive().pdu == b"\x86\x06"
        with posted(appliance, 3) as sent:
            device_writes.next().answer()
            assert answer(sent).status == 200
        assert [pdu[-1] for pdu in writes_of(source)] == [1, 3]


def test_a_read_that_takes_several_requests_keeps_what_was_written_meanwhile(run: Run) -> None:
    with plc() as source:
        wide = read("holding_registers", 0, 400, ("holding_registers", 0))
        meter = device(source.url, wide, interval=0.01, writes="pass")
        appliance = run(configuration({"meter": meter}, **MORE))
        until_polled(appliance, "meter")
        mirror = appliance.memories["mirror"]
        with client(appliance) as scada:
            for value in range(300):
                scada.write_register(5, value)
                for _ in range(5):
                    assert mirror.read("holding_registers", 5, 1) == [value]
                    assert scada.read_holding_registers(5, 1) == [value]


@pytest.mark.parametrize("address", [5, 395], ids=["in the first request", "in the last"])
def test_a_read_that_takes_several_requests_keeps_what_was_read_meanwhile(
    address: int, run: Run
) -> None:
    """The device changes at once after each write, and tells that in the reply to function 23."""

    def goes_on(asked: Asked) -> None:
        if asked.pdu[0] != 23:
            return asked.answer()
        value = int.from_bytes(asked.pdu[10:12]) + 1
        source.model.values["holding_registers"][address] = value
        return asked.answer(b"\x17\x02" + value.to_bytes(2))

    with plc(goes_on) as source:
        wide = read("holding_registers", 0, 400, ("holding_registers", 0))
        meter = device(source.url, wide, interval=0.01, writes="pass")
        appliance = run(configuration({"meter": meter}, **MORE))
        until_polled(appliance, "meter")
        mirror = appliance.memories["mirror"]
        with client(appliance) as scada:
            for value in range(0, 600, 2):
                assert scada.read_write(address, 1, address, [value]) == [value + 1]
                for _ in range(5):
                    assert mirror.read("holding_registers", address, 1) == [value + 1]
                    assert scada.read_holding_registers(address, 1) == [value + 1]


def test_rest_writes_through_too_and_tells_the_exception(run: Run) -> None:
    with plc() as source:
        appliance = started(run, source)
        rest = web.Client(endpoint(appliance, "rest"))
        with contextlib.closing(rest):
            done = rest.ingest(web.command("holding_registers", 10, [3, 4], "mirror"))
            both = rest.ingest(web.command("holding_registers", 12, [3, 4], "mirror"))
        assert (done.status, done.json["written"]) == (200, 2)
        assert writes_of(source) == [b"\x10\x01\xf4\x00\x02\x04\x00\x03\x00\x04"]
        assert appliance.memories["mirror"].read("holding_registers", 10, 3) == [3, 4, 502]
        assert (both.status, both.json["reason"]) == (409, "mirrored")


@pytest.mark.parametrize("code", [0, 4])
def test_rest_shows_the_exception_of_the_device(
    code: int, run: Run, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(asked: Asked) -> None:
        asked.answer(exception(asked.pdu, code) if asked.pdu[0] > 4 else None)

    with plc(refuse) as source:
        appliance = started(run, source)
        rest = web.Client(endpoint(appliance, "rest"))
        with contextlib.closing(rest):
            refused = rest.ingest(web.command("holding_registers", 10, [3], "mirror"))
        assert (refused.status, refused.json["reason"]) == (502, "device_refused")
        assert f"meter did not take the write: exception {code:02X}" in refused.json["detail"]
        assert appliance.memories["mirror"].read("holding_registers", 10, 1) == [500]
    [fields] = [vars(each)["fields"] for each in caplog.records if each.msg == "ingest_refused"]
    assert (fields["device"], fields["outcome"]) == ("meter", f"exception {code:02X}")


class HeldWrites:
    """A device that answers reads, and writes when the test lets it."""

    def __init__(self) -> None:
        self._writes: Queue[Asked] = Queue()

    def __call__(self, asked: Asked) -> None:
        if asked.pdu[0] > 4:
            self._writes.put(asked)
        else:
            asked.answer()

    def next(self) -> Asked:
        """Waits for the next write."""
        return self._writes.get(timeout=wire.DEADLINE)


def posted(appliance: Appliance, value: int) -> wire.Connection:
    """Sends a write of register 10 over REST, over a connection of its own."""
    connection = wire.Connection(endpoint(appliance, "rest"))
    body = json.dumps(web.command("holding_registers", 10, [value], "mirror")).encode()
    connection.send(web.post(body, "Connection: close"))
    return connection


def answer(connection: wire.Connection) -> web.Answer:
    (received,) = web.answers(connection.rest())
    return received


def of_rest(appliance: Appliance) -> Any:
    return appliance.diagnostics.stats()["adapters"]["rest"]


def connections(appliance: Appliance) -> Any:
    return of_rest(appliance)["connections"]["open"]


@pytest.mark.parametrize("leave", [wire.Connection.close, wire.Connection.finish])
def test_a_write_of_rest_is_not_sent_once_its_client_has_gone(
    run: Run, tmp_path: Path, leave: Callable[[wire.Connection], None]
) -> None:
    log, device_writes = tmp_path / "audit.jsonl", HeldWrites()
    with plc(device_writes) as source:
        meter = device(source.url, *READS, **RARELY)
        appliance = run(configuration({"meter": meter}, **MORE, audit={"file": str(log)}))
        until_read(appliance)
        with posted(appliance, 1) as sent:
            held = device_writes.next()
            with posted(appliance, 2) as gone:
                leave(gone)
                wire.until(
                    lambda: of_rest(appliance)["refused"] == {"withdrawn": 1}, "it is withdrawn"
                )
            held.answer()
            assert answer(sent).status == 200
        with posted(appliance, 3) as next_one:
            device_writes.next().answer()
            assert answer(next_one).status == 200
        appliance.stop()
        assert [pdu[-1] for pdu in writes_of(source)] == [1, 3]
    assert [line["outcome"] for line in writes(log)] == ["withdrawn", "done", "done"]


@pytest.mark.parametrize("leave", [wire.Connection.close, wire.Connection.finish])
def test_a_write_of_rest_is_not_sent_if_its_client_goes_during_a_standstill(
    run: Run, monkeypatch: pytest.MonkeyPatch, leave: Callable[[wire.Connection], None]
) -> None:
    arrived, goes_on = threading.Event(), threading.Event()
    carry_out = DeviceWrites.carry_out

    async def stands_still(self: DeviceWrites, *arguments: Any) -> Any:
        arrived.set()
        assert goes_on.wait(wire.DEADLINE)
        return await carry_out(self, *arguments)

    monkeypatch.setattr(DeviceWrites, "carry_out", stands_still)
    with plc() as source:
        appliance = started(run, source)
        with posted(appliance, 1) as gone:
            assert arrived.wait(wire.DEADLINE)
            leave(gone)
            goes_on.set()
            wire.until(lambda: of_rest(appliance)["refused"] == {"withdrawn": 1}, "it is withdrawn")
        with posted(appliance, 2) as next_one:
            assert answer(next_one).status == 200
        assert [pdu[-1] for pdu in writes_of(source)] == [2]


@pytest.mark.parametrize("over", ["modbus", "rest"])
def test_the_write_of_a_client_that_has_gone_while_the_line_was_busy_is_not_sent(
    run: Run, over: str
) -> None:
    device_writes = HeldWrites()
    with Stream("rtu+tcp", then=device_writes) as source:
        reads = {
            "one": read("holding_registers", 0, 1, ("holding_registers", 20)),
            "other": read("holding_registers", 1, 1, ("holding_registers", 10)),
        }
        devices = {
            name: device(source.url, each, **RARELY, timeout=wire.DEADLINE)
            for name, each in reads.items()
        }
        appliance = run(configuration(devices, **MORE))
        wire.until(
            lambda: all(counters(appliance, name)["reads"] == 1 for name in reads), "all is read"
        )
        with wire.Connection(endpoint(appliance, "scada")) as first:
            first.send(wire.frame(b"\x06\x00\x14\x00\x01"))
            held = device_writes.next()
            if over == "rest":
                posted(appliance, 2).close()
                withdrawn = {"withdrawn": 1}
                wire.until(lambda: of_rest(appliance)["refused"] == withdrawn, "it is withdrawn")
            else:
                with wire.Connection(endpoint(appliance, "scada")) as gone:
                    gone.send(wire.frame(b"\x06\x00\x0a\x00\x02"))
                    until_clients(appliance, 2)
                until_clients(appliance, 1)
            held.answer()
            assert first.receive().pdu == b"\x06\x00\x14\x00\x01"
            first.send(wire.frame(b"\x06\x00\x0a\x00\x03"))
            device_writes.next().answer()
            assert first.receive().pdu == b"\x06\x00\x0a\x00\x03"
        appliance.stop()
        assert [pdu[-1] for pdu in writes_of(source)] == [1, 3]


def until_clients(appliance: Appliance, count: int) -> None:
    """Waits until so many clients of the listener are connected."""
    stats = appliance.diagnostics.stats
    wire.until(
        lambda: stats()["listeners"]["scada"]["connections"]["open"] == count, f"{count} clients"
    )


def test_the_end_of_rest_withdraws_what_was_not_sent(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    called: list[Any] = []
    call_device = MemoryAccess.call_device

    def calling(*arguments: Any) -> int:
        called.append(arguments)
        return call_device(*arguments)

    monkeypatch.setattr(MemoryAccess, "call_device", calling)
    device_writes = HeldWrites()
    with plc(device_writes) as source, ThreadPoolExecutor(1) as threads:
        appliance = started(run, source)
        with posted(appliance, 1) as sent:
            held = device_writes.next()
            with posted(appliance, 2) as waiting:
                wire.until(lambda: len(called) == 2, "both have arrived")
                stopping = threads.submit(appliance.stop)
                refused = answer(waiting)
            held.answer()
            assert answer(sent).status == 200
        stopping.result(wire.DEADLINE)
        assert (refused.status, refused.json["reason"]) == (503, "withdrawn")
        assert [pdu[-1] for pdu in writes_of(source)] == [1]


def test_a_silent_device_holds_up_no_other_write_of_rest(run: Run) -> None:
    device_writes = HeldWrites()
    with plc(device_writes) as source, contextlib.ExitStack() as stack:
        appliance = started(run, source)
        waiting = [stack.enter_context(posted(appliance, value)) for value in range(MAX_WAITING)]
        held = device_writes.next()
        rest = web.Client(endpoint(appliance, "rest"))
        with contextlib.closing(rest):
            for batch in (False, True):
                command = web.command("holding_registers", 0, [7], "mirror")
                assert rest.ingest([command] if batch else command).status == 200
            wire.until(lambda: connections(appliance) == MAX_WAITING + 1, "all have arrived")
            refused = rest.ingest(web.command("holding_registers", 10, [7], "mirror"))
        assert (refused.status, refused.json["reason"]) == (503, "busy")
        assert "16 writes wait for meter" in refused.json["detail"]
        for _ in waiting[1:]:
            held.answer()
            held = device_writes.next()
        held.answer()
        assert {answer(each).status for each in waiting} == {200}


def test_a_write_whose_answer_nobody_waited_for_is_recorded(tmp_path: Path) -> None:
    """The device answers later than REST ends."""

    class Passage:
        is_called = asyncio.Event()

        def device_of(self, *_: object) -> str:
            return "drive"

        def call(self, *_: object) -> int:
            self.is_called.set()
            return 1  # The caller knows no such ticket: its turn has come.

    class Sent(Request):
        def is_client_there(self) -> bool:
            return True

        def when_gone(self, function: object) -> None:
            pass

    async def cancelled() -> None:
        request = Sent("POST", "/", b"", [], "127.0.0.1:50000")
        device_writes = DeviceWrites(memory_access)
        carried_out = asyncio.create_task(device_writes.carry_out(request, begun))
        await passage.is_called.wait()
        device_writes.end()
        carried_out.cancel()
        await asyncio.gather(carried_out, return_exceptions=True)

    plant, passage = holdfast.Memory(holding_registers=8), Passage()
    plant.mirror([("holding_registers", 0, 8)])
    audit = Audit(tmp_path / "audit.jsonl", max_bytes=65536, keep=1)
    passages = cast("Any", {"plant": passage})
    memory_access = MemoryAccess("rest", {"plant": plant}, audit, passages)
    grant = Grant("edge", ["plant"], ["holding_registers"])
    body = json.dumps(web.command("holding_registers", 0, [7], "plant")).encode()
    begun = memory_access.begin(body, grant, "127.0.0.1:50000")
    asyncio.run(cancelled())
    assert memory_access.counts()["refused"] == {"device_refused": 1}
    [line] = writes(tmp_path / "audit.jsonl")
    assert (line["route"], line["values"]) == ("drive", [7])
    assert line["outcome"] == "gateway_target_device_failed_to_respond"


def test_a_write_that_memory_could_not_keep_is_not_confirmed(tmp_path: Path) -> None:
    mirror = {"holding_registers": 100, "keep": {"file": "mirror", "sync": 0}}
    reads = [read("holding_registers", 500, 3, ("holding_registers", 10))]
    with plc() as source, contextlib.ExitStack() as stack:
        settings = {
            "memories": {"mirror": mirror},
            "devices": {"meter": device(source.url, *reads, **RARELY)},
            "listeners": {"scada": MORE["listeners"]["scada"]},
        }
        file = tmp_path / "plant.yaml"
        file.write_text(written(settings))
        command = RunCommand(file)
        stack.callback(command.end, signal.SIGTERM)
        host, port = command.wait_until_it_serves()
        with holdfast.SyncClient(f"tcp://{host}:{port}", timeout=wire.DEADLINE) as scada:
            wire.until(lambda: scada.read_holding_registers(11, 1) == [501], "it is read")
            pid = command.process.pid
            _, most = resource.prlimit(pid, resource.RLIMIT_FSIZE)
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (0, most))
            with refused_with(0x0B):
                scada.write_register(11, 7)
            assert scada.read_holding_registers(11, 1) == [501]
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (most, most))
        assert writes_of(source) == [b"\x06\x01\xf5\x00\x07"]


@pytest.mark.parametrize(("fail", "status"), [("open", 200), ("closed", 503)])
def test_a_full_disk_keeps_closed_audit_logs_from_passing_writes_on(
    run: Run, fail: str, status: int
) -> None:
    with plc() as source:
        meter = device(source.url, *READS, **RARELY)
        audit = {"file": "/dev/full", "fail": fail}
        appliance = run(configuration({"meter": meter}, **MORE, audit=audit))
        until_read(appliance)
        rest = web.Client(endpoint(appliance, "rest"))
        with contextlib.closing(rest):
            answer = rest.ingest(web.command("holding_registers", 10, [3], "mirror"))
        assert answer.status == status
        with client(appliance) as scada:
            if fail == "open":
                scada.write_register(11, 7)
            else:
                with pytest.raises(holdfast.ModbusException, match="Server Device Failure"):
                    scada.write_register(11, 7)
        assert any(asked.pdu[0] in (6, 16) for asked in source.requests) == (fail == "open")


def write_as_mqtt(appliance: Appliance, command: dict[str, object]) -> None:
    """Writes as MQTT does: unlike REST, it waits for the device in its own thread."""
    parts = appliance._require_running()
    access = MemoryAccess("mqtt", appliance.memories, parts.audit.log, parts.devices.passages)
    grant = Grant("edge", ["mirror"], ["holding_registers"])
    access.ingest(json.dumps(command).encode(), grant, "127.0.0.1:9")


@pytest.mark.parametrize("over", ["modbus", "rest", "mqtt"])
def test_the_audit_log_has_what_was_sent_to_the_device_and_its_answer(
    over: str, run: Run, tmp_path: Path
) -> None:
    """It differs between a write that the device has refused and one that it may carry out."""

    def refuse(asked: Asked) -> None:
        code = asked.pdu[-1]
        asked.answer(exception(asked.pdu, code) if asked.pdu[0] > 4 and code else None)

    outcomes = {
        0: "done",
        2: "illegal_data_address",
        11: "gateway_target_device_failed_to_respond",
        0x5A: "exception_5a",
    }
    log = tmp_path / "audit.jsonl"
    with plc(refuse) as source, contextlib.ExitStack() as stack:
        meter = device(source.url, *READS, **RARELY)
        appliance = run(configuration({"meter": meter}, **MORE, audit={"file": str(log)}))
        until_read(appliance)
        scada = stack.enter_context(client(appliance))
        rest = stack.enter_context(contextlib.closing(web.Client(endpoint(appliance, "rest"))))
        for code in outcomes:
            command = web.command("holding_registers", 11, [code], "mirror")
            if over == "rest":
                assert rest.ingest(command).status == (502 if code else 200)
            else:
                with contextlib.suppress(holdfast.ModbusException, Refused):
                    if over == "modbus":
                        scada.write_register(11, code)
                    else:
                        write_as_mqtt(appliance, command)
        appliance.stop()
    told = [
        [line[key] for key in ("route", "address", "values", "outcome")] for line in writes(log)
    ]
    assert told == [["meter", 11, [code], outcome] for code, outcome in outcomes.items()]


@pytest.mark.parametrize("over", ["rest", "mqtt"])
def test_a_write_that_a_device_may_have_carried_out_is_recorded_when_the_disk_has_room(
    over: str, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("holdfast.appliance.parts.audit.RETRY_S", 0.01)
    log = tmp_path / "audit.jsonl"

    def silent(asked: Asked) -> None:
        asked.answer(exception(asked.pdu, 11) if asked.pdu[0] > 4 else None)

    with plc(silent) as source:
        meter = device(source.url, *READS, **RARELY)
        audit = {"file": str(log), "fail": "closed"}
        appliance = run(configuration({"meter": meter}, **MORE, audit=audit))
        until_read(appliance)
        command = web.command("holding_registers", 10, [7], "mirror")
        make_room = full(monkeypatch)
        if over == "rest":
            with contextlib.closing(web.Client(endpoint(appliance, "rest"))) as rest:
                assert rest.ingest(command).json["reason"] == "device_refused"
        else:
            with pytest.raises(Refused, match="may still be carried out"):
                write_as_mqtt(appliance, command)
        assert writes(log) == []
        make_room()
        [line] = await_writes(log, 1)
    assert (line["route"], line["values"]) == ("meter", [7])
    assert line["outcome"] == "gateway_target_device_failed_to_respond"

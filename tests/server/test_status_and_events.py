"""Functions 7 (exception status) and 12 (event log), as a client sees them on every transport."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast import _core
from holdfast.config import load
from holdfast.server import Identity
from holdfast.server.options import STREAM_DEFAULTS
from support import lines, wire
from support.lines import ASCII, RTU, UNIT, Line, Mode
from support.transports import TRANSPORTS, Datagrams, Transport, address, configuration

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from holdfast.appliance import Appliance
    from support.running import Connect, Run

STATUS = b"\x07"
EVENT_LOG = b"\x0c"
READ = bytes.fromhex("0300000001")
OUTSIDE = bytes.fromhex("0303e80001")
WRITE = bytes.fromhex("0600001234")
LISTEN_ONLY = bytes.fromhex("0800040000")
RESTART = bytes.fromhex("0800010000")
CLEARING_RESTART = bytes.fromhex("080001ff00")

WITH_STATUS = {"memory": "plant", "exception_status": {"area": "coils", "address": 100}}
BITS = [1, 0, 1, 1, 0, 0, 0, 1]

RECEIVED, SENT, REFUSED = 0x80, 0x40, 0x41
DAMAGED, BROADCAST = 0x82, 0xC0
LISTENS_ONLY, SILENCED, RESTARTED = 0x20, 0x04, 0x00


def rules(unit: Any, **more: Any) -> list[dict[str, Any]]:
    units = {1: unit, 2: "plant"}
    return [{"sources": ["127.0.0.1"], "units": units, "access": "read-only", **more}]


def events(reply: bytes) -> tuple[int, int, list[int]]:
    """Event count, message count and events of a reply to function 12, without this request."""
    code, count, status, events, messages = struct.unpack(">BBHHH", reply[:8])
    assert (code, count, status) == (12, len(reply) - 2, 0)
    own, *log = reply[8:]
    assert own == RECEIVED
    return events, messages, log


@pytest.fixture(params=list(TRANSPORTS.values()), ids=list(TRANSPORTS))
def transport(request: pytest.FixtureRequest) -> Transport:
    either: Transport = request.param
    return either


@pytest.fixture
def appliance(transport: Transport, run: Run) -> Appliance:
    settings = {"rules": rules(WITH_STATUS), "event_log": True, **transport.patient}
    return run(configuration(transport.kind, **settings))


@pytest.fixture
def client(transport: Transport, appliance: Appliance) -> Iterator[Any]:
    with transport.client(address(appliance)) as made:
        yield made


def test_function_7_reads_the_bits_of_the_unit(client: Any, appliance: Appliance) -> None:
    assert client.ask(STATUS) == b"\x07\x00"
    appliance.memories["plant"].write("coils", 99, [1, *BITS, 1])

    assert client.ask(STATUS) == b"\x07\x8d"
    assert client.ask(STATUS, 2) == b"\x87\x01"
    assert client.ask(STATUS, 3) == b"\x87\x0b"


def test_function_12_tells_what_came_and_what_was_sent(client: Any) -> None:
    assert events(client.ask(EVENT_LOG)) == (0, 1, [])
    assert client.ask(READ)[0] == 3
    assert client.ask(OUTSIDE) == b"\x83\x02"
    log = [REFUSED, RECEIVED, SENT, RECEIVED, SENT, RECEIVED]

    assert events(client.ask(EVENT_LOG, 2)) == (2, 4, log)


def test_function_12_has_the_latest_64_events(client: Any) -> None:
    for _ in range(40):
        client.ask(OUTSIDE)

    _, messages, log = events(client.ask(EVENT_LOG))
    assert messages == 41
    assert log == [REFUSED, RECEIVED] * 31 + [REFUSED]


def test_a_server_has_neither_function_unless_it_is_told(transport: Transport, run: Run) -> None:
    appliance = run(configuration(transport.kind, rules=rules("plant"), **transport.patient))
    with transport.client(address(appliance)) as made:
        asked: Any = made
        for unit in (1, 3):
            assert asked.ask(STATUS, unit) == b"\x87\x01"
            assert asked.ask(EVENT_LOG, unit) == b"\x8c\x01"


def test_a_denied_function_is_refused_before_the_unit_is_looked_up(
    transport: Transport, run: Run
) -> None:
    settings = {"rules": rules(WITH_STATUS, deny=[7, 12]), "event_log": True, **transport.patient}
    with transport.client(address(run(configuration(transport.kind, **settings)))) as made:
        asked: Any = made
        for unit in (1, 3):
            assert asked.ask(STATUS, unit) == b"\x87\x01"
            assert asked.ask(EVENT_LOG, unit) == b"\x8c\x01"


# Errors of frames


def test_a_damaged_frame_is_an_event(client: Any, transport: Transport) -> None:
    broken = bytearray(transport.frame(READ))
    # A protocol id that is not that of Modbus, or a wrong checksum.
    at = 2 if transport.mode is None else -3
    broken[at] = 0x31 if broken[at] != 0x31 else 0x32
    if isinstance(client, Datagrams):
        client.send(bytes(broken))
        log = [DAMAGED]
    else:
        client.send(bytes(broken) + transport.frame(READ))
        client.receive() if transport.mode is None else client.replies(1)
        log = [SENT, RECEIVED, DAMAGED]

    assert events(client.ask(EVENT_LOG))[2] == log


# Serial lines


@pytest.fixture(params=[RTU, ASCII], ids=lambda mode: mode.name)
def line(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Line]:
    mode: Mode = request.param
    with Line(tmp_path / "line", mode) as made:
        yield made


def on_line(run: Run, line: Line, **listener: Any) -> Appliance:
    units: dict[int, str | dict[str, Any]] = {UNIT: WITH_STATUS, 8: "plant"}
    text = lines.configuration(line.mode, line.device, units=units, listener=listener)
    return run(text)


def test_a_line_has_both_functions(line: Line, run: Run) -> None:
    appliance = on_line(run, line, event_log=True)
    appliance.memories["plant"].write("coils", 100, BITS)

    assert line.ask(STATUS) == b"\x07\x8d"
    assert line.ask(STATUS, 8) == b"\x87\x01"
    log = [REFUSED, RECEIVED, SENT, RECEIVED]
    assert events(line.ask(EVENT_LOG, 8)) == (1, 3, log)


def test_a_line_without_an_event_log_does_not_have_function_12(line: Line, run: Run) -> None:
    on_line(run, line)

    assert line.ask(EVENT_LOG) == b"\x8c\x01"


def test_the_events_of_a_line_are_those_of_the_standard(line: Line, run: Run) -> None:
    appliance = on_line(run, line, event_log=True)

    def count(*path: str) -> int:
        found: Any = appliance.diagnostics.stats()["listeners"]["line"]
        for key in path:
            found = found[key]
        return sum(found.values()) if isinstance(found, dict) else int(found)

    damaged = bytearray(line.mode.frame(READ))
    damaged[-3] ^= 1
    line.send(bytes(damaged))
    wire.until(lambda: count("frames", "damaged") == 1, "the frame is damaged")
    for number, (pdu, unit) in enumerate(
        [(WRITE, 0), (LISTEN_ONLY, UNIT), (READ, UNIT), (RESTART, UNIT)], 1
    ):
        line.send(line.mode.frame(pdu, unit))
        wire.until(lambda: count("unanswered") == number, "the request is judged")  # noqa: B023

    silent = LISTENS_ONLY
    assert events(line.ask(EVENT_LOG))[2] == [
        RESTARTED, SENT | silent, RECEIVED | silent,  # restart
        SENT | silent, RECEIVED | silent,  # read
        SENT | silent, SILENCED, RECEIVED,  # listen only mode
        SENT, BROADCAST,
        DAMAGED,
    ]  # fmt: skip
    assert line.ask(CLEARING_RESTART) == CLEARING_RESTART
    assert events(line.ask(EVENT_LOG)) == (0, 1, [RESTARTED])


# Rights, seals and reloads


@pytest.mark.parametrize(
    ("unit", "code"),
    [
        ({"access": "read-only", "functions": [7]}, None),
        ({"functions": [1]}, 0x01),
        ({"read": [{"area": "coils", "start": 100, "end": 107}]}, None),
    ],
)
def test_the_rights_of_a_unit_hold_for_function_7(
    unit: dict[str, Any], code: int | None, run: Run, connect: Connect
) -> None:
    appliance = run(configuration("tcp", rules=rules({**WITH_STATUS, **unit})))
    reply = b"\x07\x00" if code is None else bytes([0x87, code])

    assert connect(address(appliance)).ask(STATUS) == reply


def test_a_sealed_memory_is_busy_for_both_functions(run: Run, connect: Connect) -> None:
    sealed = {"plant": {"coils": 200, "seal": {"area": "coils", "address": 0}}}
    of_unit = rules(WITH_STATUS)
    appliance = run(configuration("tcp", memories=sealed, rules=of_unit, event_log=True))
    client = connect(address(appliance))

    assert client.ask(STATUS) == b"\x87\x06"
    assert client.ask(EVENT_LOG) == b"\x8c\x06"
    appliance.memories["plant"].write("coils", 0, [1])
    assert client.ask(STATUS) == b"\x07\x00"
    busy = [0x44, RECEIVED]
    assert events(client.ask(EVENT_LOG))[2] == [SENT, RECEIVED, *busy, *busy]


def test_a_reload_gives_and_takes_both_functions(
    run: Run, connect: Connect, tmp_path: Path
) -> None:
    plain = configuration("tcp", rules=rules("plant"))
    both = configuration("tcp", rules=rules(WITH_STATUS), event_log=True)
    appliance = run(plain)
    client = connect(address(appliance))

    def reload(text: str) -> None:
        file = tmp_path / "new.yaml"
        file.write_text(text)
        assert appliance.reload(load(file)) == ["listeners.scada"]

    refused = [b"\x87\x01", b"\x8c\x01"]
    assert [client.ask(STATUS), client.ask(EVENT_LOG)] == refused
    reload(both)
    assert client.ask(STATUS) == b"\x07\x00"
    assert events(client.ask(EVENT_LOG))[2] == [SENT, RECEIVED]
    reload(plain)
    assert [client.ask(STATUS), client.ask(EVENT_LOG)] == refused
    reload(both)
    # What was before is forgotten.
    assert events(client.ask(EVENT_LOG))[2] == []


def test_requests_to_a_device_are_events_of_the_listener_and_functions_of_the_device(
    run: Run, connect: Connect
) -> None:
    units = {1: "plant", 7: {"route": "drive"}}
    of_units = [{"sources": ["127.0.0.1"], "units": units, "access": "read-only"}]
    memory = holdfast.Memory(holding_registers=10)
    with holdfast.Server({7: memory}, bind="127.0.0.1:0", access="read-only") as device:
        host, port = device.address
        more = {"devices": {"drive": {"url": f"tcp://{host}:{port}", "unit": 7}}}
        appliance = run(configuration("tcp", rules=of_units, more=more, event_log=True))
        client = connect(address(appliance))
        assert client.ask(READ, 7)[0] == 3
        assert client.ask(OUTSIDE, 7) == b"\x83\x02"
        # The device has neither.
        assert client.ask(STATUS, 7) == b"\x87\x01"
        assert client.ask(EVENT_LOG, 7) == b"\x8c\x01"
        log = [REFUSED, RECEIVED] * 3 + [SENT, RECEIVED]
        assert events(client.ask(EVENT_LOG, 1)) == (1, 5, log)
        # A unit that no rule names shows nothing of the device.
        assert client.ask(STATUS, 9) == b"\x87\x01"
        assert client.ask(EVENT_LOG, 9) == b"\x8c\x0b"


# The library


def test_a_server_of_the_library_has_both_functions(connect: Connect) -> None:
    memory = holdfast.Memory(discrete_inputs=8)
    memory.write("discrete_inputs", 0, BITS)
    rule = holdfast.Rule(
        {1: memory},
        sources=["127.0.0.1"],
        access="read-only",
        exception_status={1: ("discrete_inputs", 0)},
    )
    with holdfast.Server(bind="127.0.0.1:0", rules=[rule], event_log=True) as server:
        client = connect(server)
        assert client.ask(STATUS) == b"\x07\x8d"
        assert events(client.ask(EVENT_LOG))[2] == [SENT, RECEIVED]


def test_a_server_of_datagrams_has_an_event_log() -> None:
    units = {1: holdfast.Memory(coils=8)}
    options: Any = {"access": "read-only", "event_log": True}
    with (
        holdfast.Server(units, bind="udp://127.0.0.1:0", **options) as server,
        Datagrams(server.address) as client,
    ):
        assert events(client.ask(EVENT_LOG)) == (0, 1, [])


def test_a_server_of_a_line_has_an_event_log(line: Line) -> None:
    units = {UNIT: holdfast.Memory(coils=8)}
    bind = f"{line.mode.name}://{line.device}?parity=none"
    with holdfast.Server(units, bind=bind, access="read-only", event_log=True):
        assert events(line.ask(EVENT_LOG)) == (0, 1, [])


def test_bits_outside_what_may_be_read_are_refused(connect: Connect) -> None:
    memory = holdfast.Memory(coils=20)
    rule = _core.Rule(
        {1: memory},
        sources=["127.0.0.1"],
        access="read-only",
        narrowed={1: ("read-only", None, None, ([("coils", 0, 8)], None))},
        exception_status={1: ("coils", 1)},
    )
    listener = _core.Listener("scada", "127.0.0.1:0", [rule], STREAM_DEFAULTS)
    engine = _core.Engine([listener], identity=Identity().objects())
    try:
        to = engine.addresses[0]
        assert to is not None
        assert connect(to).ask(STATUS) == b"\x87\x02"
    finally:
        engine.stop()


@pytest.mark.parametrize(
    ("status", "message"),
    [
        (("holding_registers", 0), "area"),
        (("coils", 65529), "address"),
        (("coils", -1), "address"),
    ],
)
def test_bits_that_can_not_be_are_a_value_error(status: Any, message: str) -> None:
    memory = holdfast.Memory(coils=8)
    with pytest.raises(ValueError, match=message):
        holdfast.Rule(
            {1: memory}, sources=["127.0.0.1"], access="read-only", exception_status={1: status}
        )

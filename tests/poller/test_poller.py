"""Devices that are polled, mirrored and passed on: what arrives, and what is told of failures."""

from __future__ import annotations

import contextlib
import itertools
import socket
import threading
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast.appliance import Appliance
from holdfast.config import load
from holdfast.events import log_lines
from holdfast.polling.faults import fault_word
from holdfast.types import AREAS
from support import polled, web, wire
from support.brokers import free_port
from support.fake_device import HANG_UP, Serial
from support.lines import RTU, Cable
from support.machine import needs_proc
from support.polled import (
    Datagrams,
    Fake,
    Receiver,
    block,
    configuration,
    counters,
    data,
    device,
    exception,
    in_background,
    read,
    reply,
    status,
    uniform,
    until_polled,
)
from support.running import endpoint

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from holdfast.types import Area
    from support.polled import Status
    from support.running import Run, Serve

TIMEOUT, REFUSED, RESET, INVALID, UNREACHABLE = 0x8001, 0x8002, 0x8003, 0x8004, 0x800B
UNKNOWN, OK, ERROR, STALE, DISABLED = range(5)

SOON = {"first": 0.01, "most": 0.02}
"""Pauses after failures."""

# The reads that one request carries, by area.
SHORT: dict[Area, int] = dict(zip(AREAS, (1999, 2000, 125, 99), strict=True))


def everything() -> holdfast.Memory:
    """A memory with 4096 items in each area."""
    return holdfast.Memory(
        coils=4096, discrete_inputs=4096, holding_registers=4096, input_registers=4096
    )


def url(server: holdfast.Server) -> str:
    return "tcp://{}:{}".format(*server.address)


def until_told(
    appliance: Appliance,
    slot: int = 0,
    also: Callable[[polled.Status], object] = lambda _: True,
    **fields: int,
) -> polled.Status:
    """Waits until a status block holds these values; all of the block."""
    found: list[polled.Status] = []

    def is_told() -> bool:
        found.append(status(appliance.memories["status"], slot))
        told = found[-1]._asdict()
        return all(told[key] == value for key, value in fields.items()) and bool(also(found[-1]))

    try:
        wire.until(is_told, f"the status block tells {fields}")
    except AssertionError as error:
        raise AssertionError(f"{error}; found {found[-1]}") from None
    return found[-1]


# What arrives.


def test_all_areas_arrive_as_they_are_while_the_source_changes(run: Run, serve: Serve) -> None:
    source = everything()
    long = [read(area, 0, 4096, (area, 0)) for area in AREAS]
    short = [read(area, 1000, size, (area, 5000)) for area, size in SHORT.items()]
    appliance = run(configuration({"meter": device(url(serve({1: source})), *long, *short)}))
    mirror = appliance.memories["mirror"]
    numbers = itertools.count(1)

    def fill(of: Callable[[int], int]) -> None:
        """Writes every area in one step."""
        values = [of(address) for address in range(4096)]
        bits = [value & 1 for value in values]
        source.write_many([(area, 0, values if "registers" in area else bits) for area in AREAS])

    def change() -> None:
        """All registers of an area hold one number, its bits are alike."""
        number = next(numbers) & 0xFFFF
        fill(lambda _: number)

    seen: dict[Area, set[int]] = {area: set() for area in AREAS}

    def look() -> None:
        """What one request brought is of one moment."""
        for area, size in SHORT.items():
            values = mirror.read(area, 5000, size)
            assert uniform(values), area
            seen[area].add(values[0])

    with in_background(change), in_background(look):
        wire.until(
            lambda: all(
                len(seen[area]) >= least for area, least in zip(AREAS, (2, 2, 20, 20), strict=True)
            ),
            "many states of the source were seen",
        )
    fill(lambda address: address * 7 & 0xFFFF)
    until_polled(appliance, "meter")
    for area, size in SHORT.items():
        assert mirror.read(area, 0, 4096) == source.read(area, 0, 4096)
        assert mirror.read(area, 5000, size) == source.read(area, 1000, size)
        # And not one more.
        assert not any(mirror.read(area, 4096, 5000 - 4096))
        assert not any(mirror.read(area, 5000 + size, 100))
    told = counters(appliance, "meter")
    assert (told["last_error"], told["exceptions"], told["timeouts"]) == (0, 0, 0)


def test_a_read_of_several_requests_is_written_as_one_step(run: Run) -> None:
    """All requests of one poll are answered with its number."""
    asked = itertools.count()
    reads = [read("holding_registers", 0, 300, ("holding_registers", 10))]
    with Fake(lambda request: data(request, next(asked) // 3 + 1)) as fake:
        appliance = run(configuration({"meter": device(fake.url, *reads)}))
        mirror = appliance.memories["mirror"]
        seen: set[int] = set()

        def look() -> None:
            values = mirror.read("holding_registers", 10, 300)
            assert uniform(values)
            seen.add(values[0])

        with in_background(look):
            wire.until(lambda: len(seen) > 20, "many polls were seen")


def test_every_bit_has_its_place(run: Run, serve: Serve) -> None:
    """Whatever the addresses, the lengths, and how reads are joined and parted."""
    source = holdfast.Memory(coils=4096, discrete_inputs=4096)
    bits = [n * n % 7 % 2 for n in range(4096)]
    source.write_many([("coils", 0, bits), ("discrete_inputs", 0, bits)])
    reads = [
        read("coils", 3, 9, ("discrete_inputs", 1001)),
        read("coils", 13, 1, ("discrete_inputs", 1013)),
        read("coils", 17, 50, ("coils", 5)),
        read("discrete_inputs", 1, 4001, ("coils", 7003)),
    ]
    more = {"max_gap": 3, "max_bits": 53}
    appliance = run(configuration({"meter": device(url(serve({1: source})), *reads, **more)}))
    until_polled(appliance, "meter", 1)
    mirror = appliance.memories["mirror"]
    for each in reads:
        into = each["into"]
        found = mirror.read(into["area"], into["address"], each["count"])
        assert found == bits[each["address"] : each["address"] + each["count"]]
    assert sum(mirror.read("discrete_inputs", 0, 65536)) == sum(bits[3:12]) + bits[13]


def test_a_device_of_pymodbus_with_holes_in_it(run: Run) -> None:
    """Only some addresses exist: holes are tried once, and what exists is read."""
    from pymodbus.simulator import DataType, SimData, SimDevice

    def registers(*spans: tuple[int, int]) -> list[SimData]:
        return [
            SimData(start, values=[start + n for n in range(count)], datatype=DataType.REGISTERS)
            for start, count in spans
        ]

    simulated = SimDevice(
        1,
        (
            [SimData(0, values=[True, False] * 8, datatype=DataType.BITS)],
            [SimData(0, values=[False, True] * 8, datatype=DataType.BITS)],
            registers((10, 10), (30, 5), (36, 4)),
            registers((0, 100)),
        ),
    )
    reads = [
        read("holding_registers", 10, 10, ("holding_registers", 10)),
        read("holding_registers", 30, 5, ("holding_registers", 30)),
        read("holding_registers", 36, 4, ("holding_registers", 36)),
        read("input_registers", 1, 99, ("input_registers", 1)),
    ]
    with polled.Pymodbus(simulated) as source:
        meter = device(source.url, *reads, max_gap=20, status=block(0))
        appliance = run(configuration({"meter": meter}))
        until_told(appliance, health=OK)
        mirror = appliance.memories["mirror"]
        for each in reads:
            found = mirror.read(each["area"], each["address"], each["count"])
            assert found == list(range(each["address"], each["address"] + each["count"]))
        until_polled(appliance, "meter")
        told = counters(appliance, "meter")
        assert (told["exceptions"], told["requests_per_poll"]) == (4, 4)


def test_a_seal_opens_when_its_gate_is_read(run: Run, serve: Serve) -> None:
    source = holdfast.Memory(discrete_inputs=8)
    gate = {"memory": "gated", "area": "coils", "address": 0}
    text = configuration(
        {"meter": device(url(serve({1: source})), {**read("discrete_inputs", 4, 4), "into": gate})}
    ).replace(
        '"mirror": ', '"gated": {"coils": 8, "seal": {"area": "coils", "address": 3}}, "mirror": '
    )
    appliance = run(text)
    until_polled(appliance, "meter")
    assert appliance.memories["gated"].sealed
    source.write("discrete_inputs", 7, [1])
    wire.until(lambda: not appliance.memories["gated"].sealed, "the seal is open")


# Those who fail.


def test_a_source_that_is_killed_and_comes_back(run: Run, serve: Serve) -> None:
    source = holdfast.Memory(holding_registers=300)
    source.write("holding_registers", 0, [7] * 300)
    server = serve({1: source})
    host, port = server.address
    name = "the-name-is-longer-than-16"
    reads = [read("holding_registers", 0, 300, ("holding_registers", 0))]
    meter = device(url(server), *reads, status=block(0), retry=SOON)
    appliance = run(configuration({name: meter}))
    mirror = appliance.memories["mirror"]
    before = until_told(appliance, health=OK)
    assert (before.name, before.reserved) == (b"the-name-is-long", (0,) * 9)
    assert (before.last_error, before.seconds_in_error, before.failures) == (0, 0, 0)
    assert before.polls == before.good_polls > 0
    assert (before.timeouts, before.transport_errors, before.most_failures) == (0, 0, 0)

    server.stop()
    dead = until_told(
        appliance, also=lambda told: told.seconds_in_error, health=ERROR, last_error=REFUSED
    )
    assert dead.failures == dead.most_failures > 0
    assert dead.transport_errors > 0
    assert dead.polls == dead.good_polls + dead.transport_errors
    source.write("holding_registers", 0, [8] * 300)
    told = counters(appliance, name)
    assert (told["health"], told["last_error"], told["age"] > 1) == ("error", REFUSED, True)
    assert mirror.read("holding_registers", 0, 300) == [7] * 300

    with holdfast.Server({1: source}, bind=f"{host}:{port}", access="read-only"):
        back = until_told(appliance, health=OK)
        assert (back.last_error, back.seconds_in_error, back.failures) == (0, 0, 0)
        assert back.most_failures >= dead.most_failures
        assert back.good_polls > dead.good_polls
        wire.until(
            lambda: mirror.read("holding_registers", 0, 300) == [8] * 300, "the newest is there"
        )
        told = counters(appliance, name)
        assert (told["health"], told["failures"], told["seconds_in_error"]) == ("ok", 0, 0)


def test_a_line_that_is_not_there_is_unreachable_and_nobody_refuses(
    run: Run, tmp_path: Path
) -> None:
    meter = device(f"rtu://{tmp_path}/line?baud=9600", read("coils", 0, 1), status=block(0))
    appliance = run(configuration({"meter": meter}))
    told = until_told(appliance, health=ERROR, last_error=UNREACHABLE)
    assert told.transport_errors > 0
    assert fault_word(counters(appliance, "meter")["last_error"]) == "unreachable"


@needs_proc
def test_an_adapter_that_is_unplugged_between_two_polls_is_closed(run: Run, tmp_path: Path) -> None:
    source = Serial(RTU, tmp_path / "line")
    with source:
        meter = device(source.url, read("holding_registers", 0, 1), interval=3600)
        appliance = run(configuration({"meter": meter}))
        wire.until(lambda: counters(appliance, "meter")["reads"] == 1, "it is read")
        terminal = str(source.terminal.device.resolve())
        assert terminal in open_files()
    # The next adapter gets its name only when nobody has it open. Others may have it by now.
    wire.until(
        lambda: not any(file.startswith(f"{terminal} (deleted)") for file in open_files()),
        "the line is closed",
    )


def open_files() -> list[str]:
    """The files that this process has open."""
    files = []
    for entry in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # It was closed meanwhile.
            files.append(str(entry.readlink()))
    return files


@pytest.mark.parametrize("kind", ["tcp", "rtu+tcp", "ascii+tcp"])
def test_a_device_whose_machine_drops_packets_is_left_alone_for_a_while(
    run: Run, kind: str
) -> None:
    hour = {"first": 3600, "most": 3600}
    with wire.dead_address() as (host, port), Fake(data) as good:
        meter = device(f"{kind}://{host}:{port}", read("coils", 0, 1), timeout=0.05, retry=hour)
        other = device(good.url, read("coils", 0, 1))
        appliance = run(configuration({"meter": meter, "other": other}))
        wire.until(lambda: counters(appliance, "meter")["last_error"] == TIMEOUT, "it is asked")
        until_polled(appliance, "other", 20)
        assert counters(appliance, "meter")["polls"] == 1


def test_seconds_in_error_count_while_the_first_reply_is_awaited(run: Run) -> None:
    over = threading.Event()

    def late(request: wire.Frame) -> bytes:
        over.wait(wire.DEADLINE)
        return data(request, 1)

    with Fake(late) as fake:
        meter = device(fake.url, read("coils", 0, 1), timeout=60, status=block(0))
        appliance = run(configuration({"meter": meter}))
        waiting = until_told(appliance, also=lambda told: told.seconds_in_error, health=UNKNOWN)
        assert (waiting.failures, waiting.last_error) == (0, 0)
        over.set()
        assert until_told(appliance, health=OK).seconds_in_error == 0


def wrong_length(request: wire.Frame) -> bytes:
    return reply(request, bytes([request.pdu[0], 2, 0, 1]))


def wrong_unit(request: wire.Frame) -> bytes:
    return data(request._replace(unit=99))


def wrong_function(request: wire.Frame) -> bytes:
    return data(request._replace(pdu=b"\x04" + request.pdu[1:]))


def unasked(request: wire.Frame) -> bytes:
    return data(request._replace(transaction=request.transaction ^ 0x55))


def no_header(request: wire.Frame) -> bytes:
    return wire.frame(b"\x03\x02\0\0", request.unit, request.transaction, protocol=7)


@pytest.mark.parametrize(
    ("answer", "code", "counted"),
    [
        (lambda _: None, TIMEOUT, "timeouts"),
        (lambda _: HANG_UP, RESET, "transport_errors"),
        (wrong_length, INVALID, "transport_errors"),
        (wrong_unit, INVALID, "transport_errors"),
        (wrong_function, INVALID, "transport_errors"),
        (unasked, INVALID, "transport_errors"),
        (no_header, INVALID, "transport_errors"),
        (lambda request: exception(request, 0), 0x0100, "exceptions"),
        (lambda request: exception(request, 1), 1, "exceptions"),
        (lambda request: exception(request, 2), 2, "exceptions"),
        (lambda request: exception(request, 4), 4, "exceptions"),
        (lambda request: exception(request, 0x0B), 0x0B, "exceptions"),
        (lambda request: exception(request, 0x77), 0x77, "exceptions"),
    ],
)
def test_every_fault_has_its_code_and_writes_nothing(
    run: Run, answer: Callable[[wire.Frame], bytes | None], code: int, counted: str
) -> None:
    good = threading.Event()
    good.set()
    reads = [read("holding_registers", 5, 3, ("input_registers", 5))]
    with Fake(lambda request: data(request, 9) if good.is_set() else answer(request)) as fake:
        timeout = 0.1 if code == TIMEOUT else wire.DEADLINE
        meter = device(fake.url, *reads, timeout=timeout, status=block(0, keep_last_error=True))
        appliance = run(configuration({"meter": meter}))
        until_told(appliance, health=OK)
        good.clear()
        bad = until_told(appliance, health=ERROR, last_error=code)
        assert bad.failures > 0
        told = counters(appliance, "meter")
        assert told["last_error"] == code
        assert told[counted] > 0
        others = {"exceptions", "timeouts", "transport_errors"} - {counted}
        # A hang-up may meet a request that is not answered yet.
        assert all(told[other] == 0 for other in others)
        assert appliance.memories["mirror"].read("input_registers", 4, 5) == [0, 9, 9, 9, 0]
        good.set()
        assert until_told(appliance, health=OK, failures=0).last_error == code


def test_a_read_of_which_a_part_fails_is_not_written(run: Run) -> None:
    good = threading.Event()
    good.set()

    def answer(request: wire.Frame) -> bytes:
        address, _ = polled.asked(request)
        return exception(request, 6) if address == 125 and not good.is_set() else data(request, n)

    n = 1
    reads = [read("holding_registers", 0, 300, ("holding_registers", 0))]
    with Fake(answer) as fake:
        appliance = run(configuration({"meter": device(fake.url, *reads, status=block(0))}))
        until_told(appliance, health=OK)
        good.clear()
        until_told(appliance, health=ERROR, last_error=6)
        n = 2
        until_polled(appliance, "meter")
        mirror = appliance.memories["mirror"]
        assert mirror.read("holding_registers", 0, 300) == [1] * 300
        good.set()
        wire.until(lambda: mirror.read("holding_registers", 0, 300) == [2] * 300, "all arrives")


def test_nobody_there_from_the_start_is_refused(run: Run) -> None:
    reads = [read("coils", 0, 8, ("coils", 0))]
    meter = device(f"tcp://127.0.0.1:{free_port()}", *reads, status=block(0))
    appliance = run(configuration({"meter": meter}))
    told = until_told(appliance, health=ERROR, last_error=REFUSED)
    assert told.good_polls == 0
    assert told.polls == told.transport_errors
    assert counters(appliance, "meter")["age"] is None


def test_a_bad_address_costs_its_own_read_only(run: Run) -> None:
    """In the middle of a block that joins ten reads, one can't be read."""
    bad = range(53, 54)

    def answer(request: wire.Frame) -> bytes:
        address, count = polled.asked(request)
        met = address < bad.stop and bad.start < address + count
        return exception(request, 2) if met else data(request, 6)

    reads = [
        read("holding_registers", n * 10, 10, ("holding_registers", n * 10)) for n in range(10)
    ]
    with Fake(answer) as fake:
        appliance = run(configuration({"meter": device(fake.url, *reads, status=block(0))}))
        told = until_told(appliance, health=ERROR, last_error=2)
        mirror = appliance.memories["mirror"]
        expected = [6] * 50 + [0] * 10 + [6] * 40
        assert mirror.read("holding_registers", 0, 100) == expected
        until_polled(appliance, "meter")
        assert counters(appliance, "meter")["requests_per_poll"] == 2
        before = len(fake.requests)
        until_polled(appliance, "meter", 10)
        spans = {polled.asked(request) for request in fake.requests[before:]}
        assert spans == {(0, 50), (60, 40)}
        # Every poll goes on, and is told as one that failed.
        after = status(appliance.memories["status"])
        assert after.failures > told.failures
        assert after.timeouts == after.transport_errors == 0
        assert counters(appliance, "meter")["age"] < wire.DEADLINE


def test_a_hole_that_can_not_be_read_is_left_out(run: Run) -> None:
    def answer(request: wire.Frame) -> bytes:
        address, count = polled.asked(request)
        return exception(request, 2) if address <= 12 < address + count else data(request, 6)

    reads = [
        read("input_registers", 0, 10, ("input_registers", 0)),
        read("input_registers", 15, 5, ("input_registers", 15)),
    ]
    with Fake(answer) as fake:
        meter = device(fake.url, *reads, max_gap=10, status=block(0))
        appliance = run(configuration({"meter": meter}))
        told = until_told(appliance, health=OK)
        assert told.last_error == 0
        found = appliance.memories["mirror"].read("input_registers", 0, 20)
        assert found == [6] * 10 + [0] * 5 + [6] * 5
        until_polled(appliance, "meter")
        assert counters(appliance, "meter")["exceptions"] == 1
        assert counters(appliance, "meter")["requests_per_poll"] == 2


def test_a_device_that_bears_fewer_registers_gets_fewer(run: Run) -> None:
    def answer(request: wire.Frame) -> bytes:
        _, count = polled.asked(request)
        return exception(request, 3) if count > 32 else data(request, 6)

    reads = [read("holding_registers", n * 8, 8, ("holding_registers", n * 8)) for n in range(15)]
    with Fake(answer) as fake:
        appliance = run(configuration({"meter": device(fake.url, *reads, status=block(0))}))
        until_told(appliance, health=OK)
        until_polled(appliance, "meter")
        before = len(fake.requests)
        until_polled(appliance, "meter")
        assert all(polled.asked(request)[1] <= 32 for request in fake.requests[before:])
        assert appliance.memories["mirror"].read("holding_registers", 0, 120) == [6] * 120


def test_an_exception_on_one_read_lets_the_others_flow(run: Run) -> None:
    def answer(request: wire.Frame) -> bytes:
        return exception(request, 4) if request.pdu[0] == 2 else data(request, 5)

    reads = [read(area, 0, 8, (area, 0)) for area in AREAS]
    with Fake(answer) as fake:
        appliance = run(configuration({"meter": device(fake.url, *reads, status=block(0))}))
        until_told(appliance, health=ERROR, last_error=4)
        until_polled(appliance, "meter")
        mirror = appliance.memories["mirror"]
        assert [mirror.read(area, 0, 8) for area in AREAS] == [[1] * 8, [0] * 8, [5] * 8, [5] * 8]
        told = counters(appliance, "meter")
        assert told["reads"] >= 3 * (told["polls"] - 1)


def test_a_block_that_is_never_answered_lets_the_others_flow(run: Run) -> None:
    """Also those behind it."""
    reads = [read(area, 0, 8, (area, 0)) for area in AREAS]
    with Fake(lambda request: None if request.pdu[0] == 1 else data(request, 5)) as fake:
        meter = device(fake.url, *reads, timeout=0.2, status=block(0))
        appliance = run(configuration({"meter": meter}))
        mirror = appliance.memories["mirror"]
        wire.until(
            lambda: [mirror.read(area, 0, 1)[0] for area in AREAS] == [0, 1, 5, 5],
            "the others arrive",
        )
        until_told(appliance, health=ERROR, last_error=TIMEOUT)
        before = counters(appliance, "meter")["reads"]
        wire.until(lambda: counters(appliance, "meter")["reads"] >= before + 9, "they go on")


@pytest.mark.parametrize("dead", [lambda _: None, lambda request: exception(request, 0x0B)])
def test_a_dead_unit_behind_a_gateway_does_not_delay_the_others(
    run: Run, dead: Callable[[wire.Frame], bytes | None]
) -> None:
    def answer(request: wire.Frame) -> bytes | None:
        return dead(request) if request.unit in (7, 8, 9) else data(request, request.unit)

    devices = {
        f"unit {unit}".replace(" ", "-"): device(
            "", read("holding_registers", 0, 4, ("holding_registers", unit * 10)), unit=unit,
            status=block(slot), timeout=0.5 if unit > 2 else wire.DEADLINE, in_flight=8,
        )
        for slot, unit in enumerate((1, 2, 7, 8, 9))
    }  # fmt: skip
    with Fake(answer) as fake:
        for each in devices.values():
            each["url"] = fake.url
        appliance = run(configuration(devices))
        wire.until(lambda: min(fake.by_unit[1], fake.by_unit[2]) >= 60, "the others are polled")
        for slot in (0, 1):
            told = until_told(appliance, slot, health=OK)
            assert (told.last_error, told.most_failures) == (0, 0)
        asked = [fake.by_unit[unit] for unit in (7, 8, 9)]
        assert max(asked) <= 20, "a dead unit is asked less and less often"
        for slot in (2, 3, 4):
            until_told(appliance, slot, health=ERROR)
        assert fake.connections == 1


def test_many_dead_units_behind_a_gateway_leave_room_for_the_others(run: Run) -> None:
    """More than there are requests in flight."""
    devices = {
        f"d{unit}": device(
            "", read("coils", unit, 1, ("coils", unit)), unit=unit, timeout=0.2, in_flight=8
        )
        for unit in range(1, 30)
    }
    with Fake(lambda request: data(request) if request.unit > 27 else None) as fake:
        for each in devices.values():
            each["url"] = fake.url
        appliance = run(configuration(devices))
        wire.until(lambda: len(fake.by_unit) == 29, "all were asked once")
        began, before = time.monotonic(), fake.by_unit.copy()
        wire.until(lambda: fake.by_unit[28] >= before[28] + 50, "the others are polled")
        dead = sum(fake.by_unit[unit] - before[unit] for unit in range(1, 28))
        # Four at once, a fifth of a second each.
        assert dead <= 4 * (5 * (time.monotonic() - began) + 1)
        wire.until(lambda: counters(appliance, "d29")["last_error"] == 0, "it answers")


def test_a_unit_that_was_dead_is_read_when_it_answers(run: Run) -> None:
    alive = threading.Event()
    reads = [read("coils", 0, 8, ("coils", 0))]
    with Fake(lambda request: data(request, 1) if alive.is_set() else None) as fake:
        meter = device(fake.url, *reads, timeout=0.1, status=block(0), retry=SOON)
        appliance = run(configuration({"meter": meter}))
        wire.until(lambda: counters(appliance, "meter")["failures"] >= 4, "it is held to be dead")
        alive.set()
        told = until_told(appliance, health=OK)
        assert told.timeouts >= 4
        assert (told.last_error, told.failures) == (0, 0)


def test_a_connection_that_has_gone_silent_is_made_anew(run: Run) -> None:
    """The first connection dies without a word; the device answers on others."""
    reads = [read("holding_registers", 0, 2, ("holding_registers", 0))]

    def is_made_anew(timeout: float) -> bool:
        silent = threading.Event()
        fake = Fake(lambda _: None)
        fake.answer = lambda request: (
            None if fake.connections == 1 and silent.is_set() else data(request, 3)
        )
        with fake:
            meter = device(fake.url, *reads, timeout=timeout, status=block(0), retry=SOON)
            appliance = run(configuration({"meter": meter}))
            until_told(appliance, health=OK)
            if fake.connections > 1:
                return False
            silent.set()
            until_told(appliance, health=ERROR, last_error=TIMEOUT)
            until_told(appliance, health=OK)
            return fake.connections == 2

    wire.until_long_enough(is_made_anew, "the second connection carries all that follows", 0.2)


def test_a_late_reply_is_not_taken_for_the_next(run: Run) -> None:
    """Every other reply comes with the one after it."""
    held: list[bytes] = []
    numbers = itertools.count(1)

    def answer(request: wire.Frame) -> bytes | None:
        if not held:
            held.append(data(request, 0xDEAD))
            return None
        return held.pop() + data(request, next(numbers))

    reads = [read("holding_registers", 0, 4, ("holding_registers", 0))]
    with Fake(answer) as fake:
        appliance = run(configuration({"meter": device(fake.url, *reads, timeout=0.2)}))
        mirror = appliance.memories["mirror"]
        seen: set[int] = set()

        def look() -> None:
            seen.update(mirror.read("holding_registers", 0, 4))

        with in_background(look):
            wire.until(lambda: len(seen) >= 5, "many replies were seen")
        assert 0xDEAD not in seen
        told = counters(appliance, "meter")
        assert told["timeouts"] > 0
        assert fake.connections == 1


def test_a_slow_device_is_not_asked_more_often_afterwards(run: Run) -> None:
    interval, slow = 0.05, threading.Event()
    slow.set()
    patience = threading.Event()

    def answer(request: wire.Frame) -> bytes:
        if slow.is_set():
            patience.wait(4.5 * interval)
        return data(request, 1)

    reads = [read("coils", 0, 1, ("coils", 0))]
    with Fake(answer) as fake:
        meter = {**device(fake.url, *reads, timeout=5), "interval": interval}
        began = time.monotonic()
        appliance = run(configuration({"meter": meter}))
        wire.until(lambda: counters(appliance, "meter")["missed"] >= 12, "polls were missed")
        slow.clear()
        patience.set()
        then, before = time.monotonic(), counters(appliance, "meter")["polls"]
        wire.until(lambda: counters(appliance, "meter")["polls"] >= before + 10, "it is fast now")
        told, now = counters(appliance, "meter"), time.monotonic()
        # One that was due before, and one that begins as this is looked at.
        assert told["polls"] - before <= (now - then) / interval + 2
        assert told["polls"] + told["missed"] <= (now - began) / interval + 2
        assert told["last_error"] == 0


def test_a_unit_that_waits_too_long_for_its_turn_is_out_of_date(run: Run) -> None:
    """Behind a link that carries one request at a time, another unit keeps it waiting."""

    def is_stale(timeout: float) -> bool:
        slow, over = threading.Event(), threading.Event()

        def answer(request: wire.Frame) -> bytes:
            if slow.is_set() and request.unit == 2:
                over.wait(2 * wire.DEADLINE)
            return data(request)

        with Datagrams(answer) as fake:
            one = read("coils", 0, 1, ("coils", 0))
            two = read("coils", 9, 1, ("coils", 9))
            devices = {
                "one": device(fake.url, one, timeout=timeout, status=block(0), retry=SOON),
                "two": device(fake.url, two, unit=2, timeout=60, retry=SOON),
            }
            appliance = run(configuration(devices))
            until_told(appliance, health=OK)
            slow.set()
            told = until_told(appliance, health=STALE)
            health = counters(appliance, "one")["health"]
            over.set()
            if told.timeouts:
                return False
            assert (told.last_error, told.seconds_in_error) == (0, 0)
            assert health == "stale"
            until_told(appliance, health=OK)
            return True

    wire.until_long_enough(is_stale, "each request of the unit is answered", 0.4)


# Transports.


def test_units_of_a_serial_line_are_polled_in_turn_with_a_dead_one(
    run: Run, tmp_path: Path
) -> None:
    from support.lines import configuration as serving

    with Cable(tmp_path) as cable:
        served, polling = cable.devices
        memories = {"a": {"holding_registers": 50}, "b": {"holding_registers": 50}}
        source = run(serving(RTU, served, units={7: "a", 8: "b"}, memories=memories))
        source.memories["a"].write("holding_registers", 0, range(1, 51))
        source.memories["b"].write("holding_registers", 0, range(101, 151))
        line = f"rtu://{polling}?parity=none&baud=115200"
        devices = {
            f"unit-{unit}": device(
                line, read("holding_registers", 0, 50, ("input_registers", unit * 50)), unit=unit,
                timeout=0.2 if unit == 9 else wire.DEADLINE, status=block(slot),
            )
            for slot, unit in enumerate((7, 8, 9))
        }  # fmt: skip
        appliance = run(configuration(devices))
        until_told(appliance, 0, health=OK)
        until_told(appliance, 1, health=OK)
        until_told(appliance, 2, health=ERROR, last_error=TIMEOUT)
        mirror = appliance.memories["mirror"]
        assert mirror.read("input_registers", 350, 50) == list(range(1, 51))
        assert mirror.read("input_registers", 400, 50) == list(range(101, 151))
        dead = counters(appliance, "unit-9")["timeouts"]
        wire.until(
            lambda: (
                counters(appliance, "unit-7")["valid"] > 20 * (dead + 1)
                and counters(appliance, "unit-8")["valid"] > 20 * (dead + 1)
            ),
            "the others have their turns",
        )
        source.memories["a"].write("holding_registers", 0, [4711] * 50)
        wire.until(
            lambda: mirror.read("input_registers", 350, 50) == [4711] * 50, "the newest is there"
        )
        for slot in (0, 1):
            assert status(appliance.memories["status"], slot).timeouts == 0
        # The line is let go before the terminal is.
        appliance.stop()
        source.stop()


@pytest.mark.parametrize(
    ("listener", "scheme"),
    [
        ("modbus-udp", "udp"),
        ("modbus-rtu-over-tcp", "rtu+tcp"),
        ("modbus-rtu-over-udp", "rtu+udp"),
        ("modbus-ascii-over-tcp", "ascii+tcp"),
    ],
)
def test_other_transports_arrive_fail_and_come_back(run: Run, listener: str, scheme: str) -> None:
    port = free_port()
    rules = [{"sources": ["127.0.0.1"], "units": {1: "mirror"}, "access": "read-only"}]
    serving = {"served": {"type": listener, "bind": f"127.0.0.1:{port}", "rules": rules}}
    source = run(configuration({}, listeners=serving))
    kept = source.memories["mirror"]
    values: list[tuple[Area, int, list[int]]] = [
        ("coils", 3, [1, 0, 1, 1] * 600),
        ("input_registers", 7, list(range(300))),
    ]
    kept.write_many(values)
    reads = [read(area, at, len(items), (area, at)) for area, at, items in values]
    meter = device(f"{scheme}://127.0.0.1:{port}", *reads, timeout=0.2, status=block(0), retry=SOON)
    appliance = run(configuration({"meter": meter}))
    mirror = appliance.memories["mirror"]
    until_told(appliance, health=OK)
    for area, at, items in values:
        assert mirror.read(area, at, len(items)) == items
    source.stop()
    dead = until_told(appliance, health=ERROR)
    assert dead.last_error in (TIMEOUT, REFUSED, RESET)
    kept.write("input_registers", 7, [9] * 300)
    source.start()
    until_told(appliance, health=OK)
    wire.until(lambda: mirror.read("input_registers", 7, 300) == [9] * 300, "the newest is there")


# Passing on.


def receiving(port: int, form: str) -> str:
    """The configuration of a receiver, whose memory `mirror` has the unit 4 and the id 9."""
    named = {"memories": ["mirror"]} if form == "crc" else {"units": {4: "mirror"}}
    rule = {"sources": ["127.0.0.1"], **named, "areas": list(AREAS)}
    raw = {"type": "raw-ingest", "format": form, "bind": f"127.0.0.1:{port}", "rules": [rule]}
    text = configuration({}, listeners={"raw": raw})
    return text.replace('"mirror": {', '"mirror": {"id": 9, ')


NAMES: dict[str, dict[str, object]] = {"v1": {"unit": 4}, "crc": {"format": "crc", "memory_id": 9}}


@pytest.mark.parametrize("form", ["v1", "crc"])
def test_a_receiver_that_is_killed_and_comes_back_gets_the_newest(
    run: Run, serve: Serve, form: str
) -> None:
    port = free_port()
    target = run(receiving(port, form))
    source = everything()
    reads = [read(area, 5, 301, (area, 40)) for area in AREAS]
    # Without a place of its own, a read goes to where it was.
    reads.append(read("coils", 1000, 8))
    forward = [{"url": f"raw://127.0.0.1:{port}", **NAMES[form], "timeout": 5}]
    meter = device(url(serve({1: source})), *reads, forward=forward, status=block(0))
    appliance = run(configuration({"meter": meter}))

    def write(value: int) -> None:
        bits = [value & 1] * 301
        source.write_many([
            ("coils", 5, bits), ("discrete_inputs", 5, bits), ("coils", 1000, bits[:8]),
            ("holding_registers", 5, [value] * 301), ("input_registers", 5, [value] * 301),
        ])  # fmt: skip

    def arrived(value: int) -> bool:
        found = [target.memories["mirror"].read(area, 40, 301) for area in AREAS]
        found.append(target.memories["mirror"].read("coils", 1000, 8))
        return [each[0] for each in found] == [value & 1] * 2 + [value] * 2 + [value & 1] and all(
            map(uniform, found)
        )

    write(3)
    wire.until(lambda: arrived(3), "it is passed on")
    assert counters(appliance, "meter")["forward"][0]["refused"] == 0
    target.stop()
    write(4)
    wire.until(lambda: counters(appliance, "meter")["forward"][0]["failed"] > 0, "it is noticed")
    write(5)
    until_polled(appliance, "meter")
    # The device does not care.
    assert until_told(appliance, health=OK).most_failures == 0
    assert counters(appliance, "meter")["forward"][0]["replaced"] > 0
    assert arrived(3)
    target.start()
    wire.until(lambda: arrived(5), "the newest arrives")
    write(7)
    wire.until(lambda: arrived(7), "it goes on")


def test_a_receiver_gets_offsets_of_its_own_and_the_status_block(run: Run, serve: Serve) -> None:
    """Two receivers of one device, with blocks of different content."""
    port = free_port()
    target = run(receiving(port, "v1"))
    source, memory = holdfast.Memory(holding_registers=8), target.memories["mirror"]
    source.write("holding_registers", 0, [7] * 4)
    registers = {"area": "holding_registers", "unit": 4}
    forward = [
        {
            "url": f"raw://127.0.0.1:{port}",
            "unit": 4,
            "offsets": {"holding_registers": offset, "coils": 9},
            "status": {**registers, "slot": slot, **more},
        }
        for offset, slot, more in (
            (1000, 100, {"name": "Pump 1", "keep_last_error": True}),
            (2000, 101, {}),
        )
    ]
    server = serve({1: source})
    meter = device(url(server), read("holding_registers", 0, 4), forward=forward, retry=SOON)
    run(configuration({"meter": meter}))

    def told() -> list[Status]:
        return [polled.status(memory, slot, "holding_registers") for slot in (100, 101)]

    def arrived() -> bool:
        found = (memory.read("holding_registers", address, 4) for address in (1000, 2000))
        return all(registers == [7] * 4 for registers in found)

    wire.until(arrived, "it is passed on")
    wire.until(lambda: all(each.good_polls > 2 for each in told()), "the block arrives")
    assert [(each.health, each.last_error) for each in told()] == [(OK, 0)] * 2
    assert [each.name.rstrip(b"\0") for each in told()] == [b"Pump 1", b"meter"]

    host, port = server.address
    server.stop()
    wire.until(
        lambda: all(each.last_error == REFUSED for each in told()), "the failure is forwarded"
    )
    wire.until(lambda: all(each.seconds_in_error for each in told()), "so are the seconds")
    with holdfast.Server({1: source}, bind=f"{host}:{port}", access="read-only"):
        wire.until(lambda: all(each.health == OK for each in told()), "the recovery arrives")
        assert [each.last_error for each in told()] == [REFUSED, 0]


@pytest.mark.usefixtures("health_is_checked_at_once")
def test_what_happens_at_receivers_is_logged(
    run: Run, serve: Serve, caplog: pytest.LogCaptureFixture
) -> None:
    port = free_port()
    target = run(receiving(port, "v1"))
    source = holdfast.Memory(coils=8)
    receiver = f"raw://127.0.0.1:{port}"
    forward = [{"url": receiver, "unit": unit} for unit in (4, 5)]
    meter = device(url(serve({1: source})), read("coils", 0, 8), forward=forward)
    appliance = run(configuration({"meter": meter}))

    def is_logged(event: str) -> bool:
        appliance.log_events(0.01)
        return event in caplog.messages

    with caplog.at_level("INFO"):
        wire.until(lambda: is_logged("forward_refused"), "nobody has unit 5")
        target.stop()
        wire.until(lambda: is_logged("forward_failed"), "it is gone")
        target.start()
        wire.until(lambda: is_logged("forward_back"), "it is back")
    first = {record.message: vars(record)["fields"] for record in reversed(caplog.records)}
    assert first["forward_refused"].pop("count") > 0
    for event in ("forward_refused", "forward_failed", "forward_back"):
        error = first[event].pop("error", "")
        # Reset: the receiver has stopped amid a packet.
        lost = ("Connection refused", "Connection reset")
        assert error.startswith(lost) == (event == "forward_failed")
        assert first[event] == {"device": "meter", "receiver": receiver}


def test_a_device_is_retried_as_soon_as_it_is_asked_for(run: Run) -> None:
    port, polls = free_port(), 12
    reads = [read("coils", 0, 8, ("coils", 0))]
    meter = device(f"tcp://127.0.0.1:{port}", *reads, interval=0.01, retry=SOON)
    # Pauses of 1, 2, 4 ... s would last for more than an hour.
    appliance = run(configuration({"meter": meter}))
    wire.until(lambda: counters(appliance, "meter")["failures"] >= polls, "it is retried")


def test_every_read_is_passed_on_however_slow_the_receiver(run: Run) -> None:
    """It takes one packet in the time of a poll: no read keeps the others waiting."""
    taken: list[int] = []
    over = threading.Event()

    def take(packet: bytes) -> None:
        taken.append(int.from_bytes(packet[6:8]))
        polls = len(fake.requests)
        wire.until(lambda: len(fake.requests) > polls or over.is_set(), "there are newer bytes")

    reads = [read("holding_registers", n * 10, 1) for n in range(12)]
    with Fake(data) as fake, Receiver(take) as receiver:
        meter = device(fake.url, *reads, max_gap=9, forward=[{"url": receiver.url, "unit": 4}])
        appliance = run(configuration({"meter": meter}))
        wire.until(lambda: len(taken) >= 36, "packets were taken")
        assert counters(appliance, "meter")["requests_per_poll"] == 1
        # They come in turn. Newer bytes of the last and the first may come at once.
        assert taken[:12] == [n * 10 for n in range(12)]
        assert set(Counter(taken[:36]).values()) <= {2, 3, 4}
        over.set()


def test_a_receiver_that_refuses_is_counted_and_costs_nothing(run: Run, serve: Serve) -> None:
    port = free_port()
    target = run(receiving(port, "v1"))
    source = holdfast.Memory(coils=8)
    forward = [
        {"url": f"raw://127.0.0.1:{port}", "unit": 5},
        {"url": f"raw://127.0.0.1:{port}", "unit": 4},
        {"url": f"raw://127.0.0.1:{free_port()}", "unit": 4},
    ]
    meter = device(
        url(serve({1: source})), read("coils", 0, 8, ("coils", 0)), forward=forward, status=block(0)
    )
    appliance = run(configuration({"meter": meter}))
    source.write("coils", 0, [1] * 8)
    wire.until(lambda: target.memories["mirror"].read("coils", 0, 8) == [1] * 8, "one takes it")
    wire.until(
        lambda: all(
            counters(appliance, "meter")["forward"][index][key] > 0
            for index, key in enumerate(("refused", "sent", "failed"))
        ),
        "what became of packets is counted",
    )
    first, second, third = counters(appliance, "meter")["forward"]
    assert (first["sent"], second["refused"], third["sent"]) == (0, 0, 0)
    assert until_told(appliance, health=OK).most_failures == 0


# The appliance.


def test_a_device_that_is_disabled_is_told_so_and_left_alone(run: Run) -> None:
    with Fake(data) as fake:
        reads = [read("coils", 0, 8, ("coils", 0))]
        meter = device(fake.url, *reads, enabled=False, status=block(1))
        other = device(fake.url, read("coils", 9, 8, ("coils", 9)), status=block(0))
        appliance = run(configuration({"meter": meter, "other": other}))
        until_told(appliance, 0, health=OK)
        told = status(appliance.memories["status"], 1)
        assert told == polled.Status(DISABLED, 0, 0, b"meter".ljust(16, b"\0"), (0,) * 9, *[0] * 6)
        assert appliance.diagnostics.stats()["devices"]["meter"] == {"health": "disabled"}
        assert all(polled.asked(request) == (9, 8) for request in fake.requests)


def test_an_appliance_without_enabled_devices_polls_nothing(run: Run) -> None:
    meter = device("tcp://127.0.0.1:1", read("coils", 0, 8, ("coils", 0)), enabled=False)
    appliance = run(configuration({"meter": meter}))
    assert appliance._require_running().devices.poller is None
    assert appliance.diagnostics.stats()["devices"] == {"meter": {"health": "disabled"}}


def test_a_stop_does_not_wait_for_those_who_hang(run: Run, tmp_path: Path) -> None:
    with (
        Fake(lambda _: None) as fake,
        Fake(data) as other,
        socket.create_server(("127.0.0.1", 0), backlog=100) as silent,
        Cable(tmp_path) as cable,
    ):
        port = silent.getsockname()[1]
        # A receiver that takes packets and never replies.
        forward = [{"url": f"raw://127.0.0.1:{port}", "unit": 1, "timeout": 60}]
        places = [
            fake.url,
            f"rtu+tcp://127.0.0.1:{port}",
            f"udp://127.0.0.1:{free_port()}",
            f"rtu://{cable.devices[0]}?parity=none&baud=4000000",
        ]
        devices = {
            f"d{number}": device(
                place, read("coils", number, 1, ("coils", number)), unit=number % 50 + 1,
                timeout=60, in_flight=8,
            )
            for number, place in enumerate(places * 10)
        }  # fmt: skip
        last = read("coils", 99, 1, ("coils", 99))
        devices["answers"] = device(other.url, last, forward=forward)
        appliance = run(configuration(devices))
        wire.until(lambda: len(fake.requests) == 8, "requests hang")
        wire.until(
            lambda: counters(appliance, "answers")["forward"][0]["replaced"], "a packet hangs"
        )
        began = time.monotonic()
        appliance.stop()
        assert time.monotonic() - began < wire.DEADLINE / 2


def test_the_starts_of_many_devices_are_spread(run: Run) -> None:
    first: dict[int, float] = {}

    def answer(request: wire.Frame) -> bytes:
        first.setdefault(request.unit, time.monotonic())
        return data(request)

    with Fake(answer) as fake:
        devices = {
            f"d{unit}": {
                **device(fake.url, read("coils", unit, 1, ("coils", unit)), unit=unit),
                "interval": 1,
            }
            for unit in range(200)
        }
        run(configuration(devices))
        wire.until(lambda: len(first) == 200, "all were asked")
        times = sorted(first.values())
        assert times[-1] - times[0] >= 0.5
        assert times[49] - times[0] >= 0.05
        assert times[199] - times[150] >= 0.05
        assert fake.connections == 1


@pytest.fixture
def records() -> Iterator[web.Records]:
    handler = web.Records()
    log_lines.LOGGER.addHandler(handler)
    level = log_lines.LOGGER.level
    log_lines.LOGGER.setLevel("INFO")
    yield handler
    log_lines.LOGGER.removeHandler(handler)
    log_lines.LOGGER.setLevel(level)


@pytest.mark.usefixtures("health_is_checked_at_once")
def test_a_change_of_health_is_logged_once(run: Run, records: web.Records) -> None:
    good = threading.Event()
    good.set()
    reads = [read("coils", 0, 8, ("coils", 0))]
    with Fake(lambda request: data(request) if good.is_set() else exception(request, 4)) as fake:
        appliance = run(configuration({"meter": device(fake.url, *reads)}))

        def until_logged(count: int) -> None:
            def logged() -> bool:
                appliance.log_events(timeout=0.01)
                return len(records.of("device_health")) == count

            wire.until(logged, f"{count} changes were logged")

        until_logged(1)
        good.clear()
        until_logged(2)
        good.set()
        until_logged(3)
    first, second, third = records.of("device_health")
    assert first == {"event": "device_health", "device": "meter", "health": "ok"}
    assert second.pop("failures") > 0
    assert second == {
        "event": "device_health",
        "device": "meter",
        "health": "error",
        "error": "exception 04",
        "reason": "exception 0x04",
    }
    assert third == first
    levels = [line.split()[0] for line in records.lines if "device_health" in line]
    assert levels == ["INFO", "WARNING", "INFO"]


class Altered:
    """The poller of an appliance, with other counters."""

    def __init__(self, poller: Any) -> None:
        self._poller = poller
        self.counters_instead: dict[str, Any] = {}

    def counters(self, *, receiver: Any = None) -> dict[str, dict[str, Any]]:
        told: dict[str, dict[str, Any]] = self._poller.counters(receiver=receiver)
        return {name: {**counted, **self.counters_instead} for name, counted in told.items()}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._poller, name)


@pytest.mark.usefixtures("health_is_checked_at_once")
def test_a_missing_plan_and_refused_results_are_logged(run: Run, records: web.Records) -> None:
    reads = [read("coils", 0, 8, ("coils", 0))]
    with Fake(data) as fake:
        appliance = run(configuration({"meter": device(fake.url, *reads)}))
        devices: Any = appliance._require_running().devices
        devices.poller = altered = Altered(devices.poller)
        until_polled(appliance, "meter", 1)
        told = counters(appliance, "meter")
        assert (told["plan_error"], told["unplanned"], told["unstored"]) == (None, 0, 0)
        appliance.log_events(timeout=0)
        assert not records.of("device_unplanned") + records.of("device_unstored")
        no_plan = {"plan_error": "read 0: field 0: no items", "health": "error"}
        for changed in (
            {"unstored": 2},
            {"unstored": 5, "health": "error", "last_error": 0x8006},
            {"unstored": 5, **no_plan, "last_error": 0x8005},
            {"unstored": 5, **no_plan, "last_error": 0x8005},
            {"unstored": 5},
            {"unstored": 5, **no_plan, "last_error": 0x8007},
        ):
            altered.counters_instead = changed
            appliance.log_events(timeout=0)
    unstored = records.of("device_unstored")
    assert [(each["device"], each["count"]) for each in unstored] == [("meter", 2), ("meter", 3)]
    unplanned = records.of("device_unplanned")
    assert [(each["device"], each["error"]) for each in unplanned] == [
        ("meter", "read 0: field 0: no items")
    ] * 2
    errors = [each["error"] for each in records.of("device_health") if "error" in each]
    assert errors == ["not stored", "internal error"]
    levels = {line.split()[0] for line in records.lines if "device_un" in line}
    assert levels == {"ERROR"}


@pytest.mark.usefixtures("health_is_checked_at_once")
def test_refused_results_are_not_logged_again_after_a_reload(
    tmp_path: Path, records: web.Records
) -> None:
    file = tmp_path / "appliance.yaml"
    reads = [read("coils", 0, 8, ("coils", 0))]
    with Fake(data) as fake:

        def loaded(**more: Any) -> Any:
            file.write_text(configuration({"meter": device(fake.url, *reads, **more)}))
            return load(file)

        with Appliance(loaded()) as appliance:
            devices: Any = appliance._require_running().devices
            devices.poller = altered = Altered(devices.poller)

            def refused(count: int) -> None:
                altered.counters_instead = {"unstored": count}
                appliance.log_events(timeout=0)

            until_polled(appliance, "meter")
            refused(5)
            polls = counters(appliance, "meter")["polls"]
            assert appliance.reload(loaded(timeout=4)) == ["devices.meter"]
            assert counters(appliance, "meter")["polls"] >= polls, "counters go on"
            refused(5)
            refused(6)
            appliance.reload(loaded(enabled=False))
            appliance.reload(loaded())
            assert counters(appliance, "meter")["polls"] < polls, "counters begin again"
            refused(2)
    assert [each["count"] for each in records.of("device_unstored")] == [5, 1, 2]


def test_rest_and_metrics_tell_of_devices(run: Run) -> None:
    reads = [read("holding_registers", 0, 10, ("holding_registers", 0))]
    http = {"bind": "127.0.0.1:0", "sources": ["127.0.0.1"]}
    with Fake(data) as fake:
        appliance = run(
            configuration(
                {"meter": device(fake.url, *reads), "other": device(fake.url, *[
                    read("coils", 0, 1, ("coils", 0))], enabled=False)},
                rest={**http, "tokens": "none"}, metrics=http,
            )
        )  # fmt: skip
        wire.until(lambda: counters(appliance, "meter")["health"] == "ok", "it answers")
        client = web.Client(endpoint(appliance, "rest"))
        told = client.get("/api/v1/diagnostics/stats").json["devices"]
        client.close()
        assert (told["meter"]["health"], told["other"]) == ("ok", {"health": "disabled"})
        assert told["meter"]["valid"] > 0
        client = web.Client(endpoint(appliance, "metrics"))
        text = client.get("/metrics").body.decode()
        client.close()
        assert 'holdfast_device_health{device="meter",state="ok"} 1.0' in text
        assert 'holdfast_device_health{device="other",state="disabled"} 1.0' in text
        assert 'holdfast_device_age_seconds{device="meter"}' in text
        assert 'holdfast_device_unplanned_polls_total{device="meter"} 0.0' in text
        assert 'holdfast_device_unstored_total{device="meter"} 0.0' in text


def test_an_appliance_can_be_started_again(run: Run) -> None:
    with Fake(data) as fake:
        meter = device(fake.url, read("coils", 0, 8, ("coils", 0)), status=block(0))
        appliance = run(configuration({"meter": meter}))
        until_told(appliance, health=OK)
        appliance.stop()
        asked = len(fake.requests)
        with pytest.raises(RuntimeError):
            appliance.diagnostics.stats()
        appliance.start()
        wire.until(lambda: len(fake.requests) > asked, "it is polled again")


def test_with_measured_costs_the_answers_decide_which_holes_are_read(
    run: Run, serve: Serve, memory: holdfast.Memory
) -> None:
    host, port = serve({1: memory}).address
    appliance = run(
        f"""
        memories: {{mirror: {{holding_registers: 200}}}}
        devices:
          meter:
            url: tcp://{host}:{port}
            unit: 1
            interval: 0.01
            max_gap: auto
            reads:
              - {{area: holding_registers, address: 0, count: 1,
                  into: {{memory: mirror, area: holding_registers, address: 0}}}}
              - {{area: holding_registers, address: 12, count: 100,
                  into: {{memory: mirror, area: holding_registers, address: 12}}}}
        """
    )

    def meter() -> dict[str, Any]:
        found: dict[str, Any] = appliance.diagnostics.stats()["devices"]["meter"]
        return found

    wire.until(lambda: meter()["requests_per_poll"] == 2, "the first plan has two requests")
    wire.until(lambda: meter()["requests_per_poll"] == 1, "requests cost more than registers")
    memory.write("holding_registers", 0, [7])
    memory.write("holding_registers", 111, [9])
    mirror = appliance.memories["mirror"]
    wire.until(
        lambda: (
            mirror.read("holding_registers", 0, 1) + mirror.read("holding_registers", 111, 1)
            == [7, 9]
        ),
        "both reads are mirrored",
    )

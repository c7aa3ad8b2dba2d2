"""The client against our own server: every method by every transport, sync and asyncio; arguments,
threads, tasks, event loops, cancellation and closing.
"""

from __future__ import annotations

import asyncio
import copy
import doctest
import errno
import gc
import itertools
import pickle
import re
import signal
import socket
import struct
import sys
import threading
import time
import warnings
import weakref
from array import array
from collections import UserList, deque
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast import adapters, importing, polling, raw_ingest, values
from holdfast._core import BlockingClient, Request
from holdfast.client import async_transports, tcp_connect
from holdfast.client import endpoint as endpoints
from holdfast.client.requests import TooManyValues
from holdfast.client.serial_settings import SerialTarget
from holdfast.client.tolerance import Tolerance
from holdfast.client.url import NetworkTarget, Tls, parse
from holdfast.config.text.problems import Problem
from holdfast.net import event_loop
from holdfast.server import Identity
from holdfast.simulation.device import Refused
from holdfast.types import AREAS
from support import lines, transports, wire
from support.brokers import free_port
from support.faces import FACES, Awaited, Dial, Face, dialling, run
from support.fake_device import (
    Asked,
    FakeDevice,
    ScriptedDevice,
    Stream,
    Udp,
    exception,
    good,
    registers,
    silent,
)
from support.paths import DOCS
from support.running import endpoint

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator

    from holdfast.types import Area, Integers
    from support.fake_device import Answer, Behaviour
    from support.running import Run, Serve

REGISTERS = [0, 1, 255, 256, 32767, 32768, 65535]
BITS = [True, False, True, True, False, False, True, True, True, False, True]
LONG = "long " * 40
"""Five of these objects take more than one reply."""


@pytest.fixture(params=FACES)
def dial(request: pytest.FixtureRequest) -> Iterator[Dial]:
    yield from dialling(request.param)


@dataclass
class Device:
    """A server of ours, and how a client finds it: unit 1 is `memory`, unit 2 is another one."""

    url: str
    memory: holdfast.Memory
    other: holdfast.Memory


MEMORIES = {"plant": transports.ALL, "other": transports.ALL}
UNITS = {1: "plant", 2: "other"}
IDENTITY = {"vendor_name": "Acme", "product_code": "P1", "revision": "1.2", "model_name": LONG}
PRIVATE = {128: LONG, 129: "short"}
MORE: dict[str, Any] = {"identity": {**IDENTITY, "objects": PRIVATE}}
TRANSPORTS = ("tcp", "udp", "rtu+tcp", "rtu", "ascii")


@pytest.fixture(params=TRANSPORTS)
def device(request: pytest.FixtureRequest, run: Run, tmp_path: Path) -> Iterator[Device]:
    kind: str = request.param
    with ExitStack() as stack:
        if kind in ("rtu", "ascii"):
            cable = stack.enter_context(lines.Cable(tmp_path))
            mode = lines.RTU if kind == "rtu" else lines.ASCII
            appliance = run(
                lines.configuration(mode, cable.devices[0], memories=MEMORIES, units=UNITS, **MORE)
            )
            url = f"{kind}://{cable.devices[1]}?parity=none&baud=4000000"
        else:
            rules = [transports.rule(["127.0.0.1"], units=UNITS)]
            listener = "rtu" if kind == "rtu+tcp" else kind
            text = transports.configuration(listener, rules=rules, memories=MEMORIES, more=MORE)
            appliance = run(text)
            host, port = endpoint(appliance, "scada")
            url = f"{kind}://{host}:{port}"
        yield Device(url, appliance.memories["plant"], appliance.memories["other"])


@pytest.fixture
def client(device: Device, dial: Dial) -> Face:
    return dial(device.url)


def url_of(server: holdfast.Server) -> str:
    host, port = server.address
    return f"tcp://{host}:{port}"


# Every method, by every transport


@pytest.mark.parametrize("area", AREAS)
def test_an_area_is_read(area: Area, device: Device, client: Face) -> None:
    written = BITS if area in AREAS[:2] else REGISTERS
    device.memory.write(area, 100, written)

    read: list[Any] = getattr(client, f"read_{area}")(99, len(written) + 2)

    assert read == [0, *written, 0]
    assert {type(item) for item in read} == {type(written[0])}


def test_the_most_of_one_request_is_read(device: Device, client: Face) -> None:
    device.memory.write("input_registers", 875, range(125))
    device.memory.write("coils", 0, [1, 0, 0] * 333)

    assert client.read_input_registers(875, 125) == list(range(125))
    assert client.read_coils(0, 999) == [True, False, False] * 333


def test_a_coil_and_a_register_are_written(device: Device, client: Face) -> None:
    client.write_coil(7, True)
    client.write_coil(8, True)
    client.write_coil(8, False)
    client.write_register(7, 65535)

    assert device.memory.read("coils", 6, 3) == [0, 1, 0]
    assert device.memory.read("holding_registers", 6, 3) == [0, 65535, 0]


def test_coils_and_registers_are_written(device: Device, client: Face) -> None:
    client.write_coils(7, BITS)
    client.write_registers(7, REGISTERS)
    client.write_registers(100, range(123))

    assert device.memory.read("coils", 6, 13) == [0, *BITS, 0]
    assert device.memory.read("holding_registers", 6, 9) == [0, *REGISTERS, 0]
    assert device.memory.read("holding_registers", 100, 123) == list(range(123))


def test_a_register_is_masked(device: Device, client: Face) -> None:
    device.memory.write("holding_registers", 4, [0x12])

    client.mask_write(4, and_mask=0xF2, or_mask=0x25)

    assert device.memory.read("holding_registers", 4, 1) == [0x17]


def test_registers_are_written_and_read_in_one_step(device: Device, client: Face) -> None:
    device.memory.write("holding_registers", 0, [1, 2, 3, 4])

    assert client.read_write(0, 4, 1, [70, 80]) == [1, 70, 80, 4]
    assert client.read_write(0, 125, 0, range(121)) == [*range(121), 0, 0, 0, 0]


VALUES: list[tuple[str, Any, str]] = [
    ("int16", -2, "ABCD"),
    ("uint32", 305419896, "CDAB"),
    ("float32", 21.5, "BADC"),
    ("float64", -1e300, "DCBA"),
    ("bcd32", 12345678, "ABCD"),
    ("string:7", "Höhe 2", "ABCD"),
    ("bytes:3", b"\0\xff\1", "ABCD"),
    ("bool", True, "ABCD"),
    ("int32[3]", [1, -1, 2**31 - 1], "CDAB"),
]


@pytest.mark.parametrize(("kind", "value", "order"), VALUES, ids=[kind for kind, _, _ in VALUES])
def test_a_typed_value_is_written_and_read(
    kind: str, value: Any, order: str, device: Device, client: Face
) -> None:
    encoding = "utf-8" if kind == "string:7" else None
    raw = holdfast.values.encode(value, kind, order, encoding=encoding)

    client.write("holding_registers", 10, value, kind, order, encoding=encoding)

    assert device.memory.read("holding_registers", 9, len(raw) + 2) == [0, *raw, 0]
    read = client.read("holding_registers", 10, kind, order, encoding=encoding)
    assert (read, type(read)) == (value, type(value))


def test_a_device_says_who_it_is(client: Face) -> None:
    who = client.identify()

    assert (who.vendor_name, who.product_code, who.revision) == ("Acme", "P1", "1.2")
    assert (who.model_name, who.vendor_url) == (LONG, None)
    assert who.conformity_level == 0x83
    assert who.objects[128] == LONG.encode()
    assert sorted(who.objects) == [0, 1, 2, 5, 128, 129]


def test_a_device_has_a_server_id(client: Face) -> None:
    answer = client.report_server_id()

    assert (answer.server_id, answer.running) == (1, True)
    assert answer.additional == b"Acme P1 1.2"
    assert answer.data == b"\x01\xff" + answer.additional


def test_a_device_is_diagnosed(device: Device, client: Face) -> None:
    assert client.diagnostics(0, [0x1234]) == [0x1234]
    if not device.url.startswith("rtu+tcp"):
        # Where nothing but its length ends a request, the server knows only those of one word.
        assert client.diagnostics(0, [0x1234, 0xFFFF]) == [0x1234, 0xFFFF]
    [before] = client.diagnostics(14)
    client.read_coils(0, 1)
    assert client.diagnostics(14) == [before + 2]


def test_events_are_counted(client: Face) -> None:
    before = client.event_counter()
    client.read_coils(0, 1)

    assert before == (False, 0)
    assert client.event_counter() == (False, 1)


def test_an_exception_has_code_and_name(client: Face) -> None:
    with pytest.raises(
        holdfast.ModbusException, match=r"^exception 02 \(Illegal Data Address\)$"
    ) as caught:
        client.read_holding_registers(1000, 1)
    assert (caught.value.code, caught.value.name) == (2, "Illegal Data Address")
    # It does no harm to the connection.
    assert client.read_holding_registers(999, 1) == [0]


def test_a_call_may_be_for_another_unit(device: Device, client: Face) -> None:
    client.write_register(5, 11)
    client.write_register(5, 22, unit=2)

    assert device.memory.read("holding_registers", 5, 1) == [11]
    assert device.other.read("holding_registers", 5, 1) == [22]
    assert client.read("holding_registers", 5, "int16", unit=2) == 22
    assert client.read_holding_registers(5, 1) == [11]


def test_a_client_is_for_the_unit_it_is_made_for(device: Device, dial: Dial) -> None:
    device.other.write("coils", 0, [1])

    assert dial(device.url, unit=2).read_coils(0, 1) == [True]


OTHER_LIBRARIES = {
    **dict.fromkeys(("unit_id", "address", "slave", "slave_id", "device_id"), "set `unit`"),
    **dict.fromkeys(("slaveaddress", "slave_address", "dev_id"), "set `unit`"),
    **dict.fromkeys(("url", "host", "port", "mode"), "make a client with another URL"),
    "handle_local_echo": "set `echo=1` in the URL",
    "retries": "set `retries` in the URL",
    **dict.fromkeys(("auto_close", "close_port_after_each_call"), "set `close_after=1` in the URL"),
    **dict.fromkeys(("byteorder", "wordorder"), "an argument of `read` and `write`"),
    **dict.fromkeys(("trace", "max_in_flight"), "an argument of the constructor"),
}


@pytest.mark.parametrize("kind", [holdfast.SyncClient, holdfast.Client])
def test_an_attribute_of_another_library_chooses_no_device(
    kind: type[holdfast.SyncClient | holdfast.Client],
) -> None:
    class Drive(kind):  # type: ignore[misc, valid-type]
        pass

    for client in (kind("tcp://localhost"), Drive("tcp://localhost")):
        for name, instead in OTHER_LIBRARIES.items():
            with pytest.raises(AttributeError, match=instead):
                setattr(client, name, 2)
            assert not hasattr(client, name)
        with pytest.raises(AttributeError):
            client.target = "tcp://other"  # type: ignore[misc]


def test_an_attribute_that_a_class_does_not_have_is_not_set() -> None:
    client, for_asyncio = holdfast.SyncClient("tcp://localhost"), holdfast.Client("tcp://localhost")
    server = holdfast.Server({}, bind="127.0.0.1:0", access="read-write")
    with holdfast.Poller() as poller:
        for made in (client, for_asyncio, server, poller):
            with pytest.raises(AttributeError, match="interval"):
                made.interval = 5  # type: ignore[union-attr]
            assert weakref.ref(made)() is made


def test_rights_of_a_server_are_not_changed_by_an_attribute() -> None:
    class Device(holdfast.Server):
        pass

    for kind in (holdfast.Server, Device):
        server = kind({1: holdfast.Memory(coils=1)}, bind="127.0.0.1:0", access="read-write")
        for name in ("units", "access", "sources", "functions", "deny", "rules", "tls", "workers"):
            with pytest.raises(AttributeError, match="an argument of the constructor"):
                setattr(server, name, "read-only")
        for name in ("host", "port"):
            with pytest.raises(AttributeError, match="set `bind`"):
                setattr(server, name, "0.0.0.0")


def test_a_subclass_may_define_attributes_of_its_own() -> None:
    class Drive(holdfast.SyncClient):
        address = 0

    drive = Drive("tcp://localhost")
    drive.address, drive.speed = 7, 1500  # type: ignore[attr-defined]
    assert (drive.address, Drive.address) == (7, 0)


def test_a_client_shows_its_device() -> None:
    assert repr(holdfast.SyncClient("tcp://plc?pause=1")) == "SyncClient('tcp://plc:502', unit=1)"
    line = holdfast.Client("rtu:///dev/ttyUSB0", unit=7)
    assert repr(line) == "Client('rtu:///dev/ttyUSB0', unit=7)"


def test_a_closed_client_connects_anew(client: Face) -> None:
    for value in (1, 2, 3):
        client.write_register(0, value)
        assert client.read_holding_registers(0, 1) == [value]
        client.close()
        client.close()


def test_a_client_that_was_never_used_can_be_closed(device: Device, dial: Dial) -> None:
    dial(device.url).close()


@pytest.mark.parametrize("device", ["rtu", "ascii"], indirect=True)
def test_a_write_to_all_units_of_a_line_waits_for_no_reply(device: Device, client: Face) -> None:
    memories = (device.memory, device.other)
    client.write("holding_registers", 5, 21.5, "float32", unit=0)
    # A line that is read late has no silence between two frames.
    wire.until(lambda: all(m.read("holding_registers", 5, 1) != [0] for m in memories), "written")
    client.write_coil(3, True, unit=0)
    wire.until(lambda: all(m.read("coils", 3, 1) == [True] for m in memories), "written")

    for unit in (1, 2):
        assert client.read_holding_registers(5, 2, unit=unit) == [0x41AC, 0]
        assert client.read_coils(3, 1, unit=unit) == [True]


@pytest.mark.parametrize("device", ["rtu", "ascii"], indirect=True)
def test_nothing_is_read_from_all_units_of_a_line(client: Face) -> None:
    for read in (
        lambda: client.read_coils(0, 1, unit=0),
        lambda: client.read_write(0, 1, 0, [1], unit=0),
        lambda: client.identify(unit=0),
        lambda: client.diagnostics(0, unit=0),
        lambda: client.read_fifo_queue(0, unit=0),
        lambda: client.call_function(65, unit=0),
    ):
        with pytest.raises(ValueError, match="unit 0 of a serial line is the broadcast"):
            read()


# What takes several requests


@pytest.fixture
def large(serve: Serve) -> tuple[holdfast.Server, holdfast.Memory]:
    """A server with all addresses that there are."""
    memory = holdfast.Memory(**dict.fromkeys(AREAS, 65536))  # type: ignore[arg-type]
    return serve({1: memory}), memory


Large = tuple[holdfast.Server, holdfast.Memory]


@pytest.mark.parametrize(
    ("area", "count", "requests"),
    [
        ("coils", 2000, 1),
        ("coils", 2001, 2),
        ("discrete_inputs", 65536, 33),
        ("holding_registers", 126, 2),
        ("input_registers", 65536, 525),
    ],
)
def test_a_large_read_takes_several_requests(
    area: Area, count: int, requests: int, large: Large, dial: Dial
) -> None:
    server, memory = large
    bits = area in AREAS[:2]
    start = 65536 - count
    memory.write(area, start, [at * 7 & (1 if bits else 0xFFFF) for at in range(count)])

    read = getattr(dial(url_of(server)), f"read_{area}")(start, count)

    assert read == memory.read(area, start, count)
    [counted] = server.counters()["requests"].values()
    assert counted == requests


@pytest.mark.parametrize(
    ("area", "count", "requests"),
    [
        ("coils", 1968, 1),
        ("coils", 1969, 2),
        ("coils", 65536, 34),
        ("holding_registers", 123, 1),
        ("holding_registers", 124, 2),
        ("holding_registers", 65536, 533),
    ],
)
def test_a_large_write_takes_several_requests_if_that_is_allowed(
    area: Area, count: int, requests: int, large: Large, dial: Dial
) -> None:
    server, memory = large
    client = dial(url_of(server))
    method: Any = client.write_coils if area == "coils" else client.write_registers
    start = 65536 - count
    values: list[Any] = [at % 3 == 0 if area == "coils" else at for at in range(count)]
    if requests > 1:
        with pytest.raises(ValueError, match=f"{count} values, one request writes at most"):
            method(start, values)
        assert server.counters()["requests"] == {}

    method(start, values, split=True)

    assert memory.read(area, start, count) == values
    [counted] = server.counters()["requests"].values()
    assert counted == requests


class Unsliced(Sequence[int]):
    """A sequence that refuses slices with an error of its own."""

    def __init__(self, words: range, error: Exception) -> None:
        self.words, self.error = words, error

    def __len__(self) -> int:
        return len(self.words)

    def __getitem__(self, at: Any) -> Any:
        if isinstance(at, slice):
            raise self.error
        return self.words[at]


@pytest.mark.parametrize(
    "of",
    [
        list,
        tuple,
        deque,
        UserList,
        lambda words: Unsliced(words, TypeError()),
        lambda words: Unsliced(words, ValueError()),
        lambda words: Unsliced(words, IndexError()),
        lambda words: Unsliced(words, AttributeError()),
        lambda words: array("H", words),
        lambda words: dict.fromkeys(words).keys(),
    ],
    ids=[
        *("list", "tuple", "deque", "user_list"),
        *("type_error", "value_error", "index_error", "attribute_error"),
        *("array", "keys"),
    ],
)
def test_a_write_of_any_sequence_may_take_several_requests(
    of: Callable[[range], Integers], large: Large, dial: Dial
) -> None:
    server, memory = large
    dial(url_of(server)).write_registers(7, of(range(200)), split=True)
    assert memory.read("holding_registers", 7, 200) == list(range(200))


@pytest.mark.parametrize(
    ("values", "error", "message"),
    [
        (dict.fromkeys(range(200)), TypeError, "values are dict, not a sequence of integers"),
        (set(range(200)), TypeError, "values are set, not a sequence of integers"),
        (bytes(200), TypeError, "values are bytes, not a sequence of integers"),
        (deque([0] * 199 + [65536]), ValueError, r"values\[199\] is 65536, allowed: integers 0 to"),
        (deque([0] * 199 + [0.5]), TypeError, r"values\[199\] is 0.5, allowed: integers 0 to"),
    ],
)
def test_a_write_in_several_requests_refuses_what_one_refuses(
    values: Any, error: type[Exception], message: str, large: Large, dial: Dial
) -> None:
    with pytest.raises(error, match=message):
        dial(url_of(large[0])).write_registers(0, values, split=True)
    assert large[0].counters()["requests"] == {}


def test_a_typed_value_may_take_several_requests(large: Large, dial: Dial) -> None:
    client = dial(url_of(large[0]))
    values = [float(at) for at in range(100)]
    with pytest.raises(ValueError, match="200 values, one request writes at most 123"):
        client.write("holding_registers", 7, values, "float32[100]")

    client.write("holding_registers", 7, values, "float32[100]", "CDAB", split=True)

    assert client.read("holding_registers", 7, "float32[100]", "CDAB") == values


@pytest.mark.parametrize(
    ("kind", "value", "writes"),
    [
        ("float64[60]", [0.5] * 60, [(7, 120), (127, 120)]),
        ("float32[62]", [0.5] * 62, [(7, 122), (129, 2)]),
        ("uint16[124]", [5] * 124, [(7, 123), (130, 1)]),
        ("string:6[42]", ["abcdef"] * 42, [(7, 123), (130, 3)]),
        ("bytes:20[13]", [b"0123456789" * 2] * 13, [(7, 120), (127, 10)]),
        ("string:246[2]", ["x" * 246] * 2, [(7, 123), (130, 123)]),
        ("string:248[2]", ["x" * 248] * 2, [(7, 123), (130, 123), (253, 2)]),
        ("string:300", "x" * 300, [(7, 123), (130, 27)]),
    ],
)
def test_a_request_writes_whole_elements(
    kind: str, value: Any, writes: list[tuple[int, int]], dial: Dial
) -> None:
    with FakeDevice(lambda pdu: pdu[:5]) as device:
        dial(device.url).write("holding_registers", 7, value, kind, split=True)
        sent = [struct.unpack(">BHH", pdu[:5]) for pdu in device.asked]
    assert sent == [(16, *each) for each in writes]


def test_an_element_is_whole_if_a_later_request_is_refused(dial: Dial) -> None:
    memory = bytearray(2 * 240)

    def device(pdu: bytes) -> bytes:
        at = 2 * int.from_bytes(pdu[1:3])
        if at:
            return exception(pdu, 2)
        memory[: len(pdu) - 6] = pdu[6:]
        return pdu[:5]

    with FakeDevice(device) as fake, pytest.raises(holdfast.ModbusException):
        dial(fake.url).write("holding_registers", 0, [0.1] * 60, "float64[60]", split=True)
    assert struct.unpack(">60d", memory) == (0.1,) * 30 + (0,) * 30


@pytest.mark.parametrize(
    ("reply", "error", "text"),
    [
        (
            lambda pdu: exception(pdu, 2),
            holdfast.ModbusException,
            "exception 02 (Illegal Data Address); the first 123 of 200 registers are written",
        ),
        (
            lambda _: b"",
            holdfast.ConnectionLost,
            "connection lost: closed by the peer; the first 123 of 200 registers are written",
        ),
        (
            lambda pdu: bytes([pdu[0]]) + bytes(4),
            holdfast.InvalidResponse,
            "; the first 123 of 200 registers are written",
        ),
    ],
    ids=["exception", "hang_up", "invalid"],
)
def test_a_write_that_fails_midway_says_how_much_is_written(
    reply: Answer, error: type[holdfast.ModbusError], text: str, dial: Dial
) -> None:
    with (
        FakeDevice(lambda pdu: reply(pdu) if int.from_bytes(pdu[1:3]) else pdu[:5]) as device,
        pytest.raises(error) as raised,
    ):
        dial(device.url).write_registers(0, range(200), split=True)
    assert str(raised.value).endswith(text)
    assert raised.value.written == 123
    assert getattr(raised.value, "maybe_executed", True)
    assert getattr(raised.value, "maybe_sent", True)


def test_a_write_whose_first_request_fails_says_nothing_of_others(dial: Dial) -> None:
    with (
        FakeDevice(lambda pdu: exception(pdu, 2)) as device,
        pytest.raises(
            holdfast.ModbusException, match=r"^exception 02 \(Illegal Data Address\)$"
        ) as raised,
    ):
        dial(device.url).write_coils(0, [False] * 4000, split=True)
    assert (raised.value.written, raised.value.maybe_executed) == (0, False)


@pytest.mark.parametrize(
    ("kind", "reads"),
    [
        ("float64[60]", [(7, 124), (131, 116)]),
        ("float32[63]", [(7, 124), (131, 2)]),
        ("uint16[126]", [(7, 125), (132, 1)]),
        ("bytes:250[2]", [(7, 125), (132, 125)]),
        ("bytes:252[2]", [(7, 125), (132, 125), (257, 2)]),
    ],
)
def test_a_request_reads_whole_elements(
    kind: str, reads: list[tuple[int, int]], dial: Dial
) -> None:
    with FakeDevice(registers) as device:
        dial(device.url).read("holding_registers", 7, kind)
        asked = [struct.unpack(">BHH", pdu) for pdu in device.asked]
    assert asked == [(3, *each) for each in reads]


def test_single_bits_and_registers_are_written_by_functions_5_and_6(
    large: Large, dial: Dial
) -> None:
    server, memory = large
    client = dial(url_of(server))

    client.write("coils", 3, True, "bool")
    client.write("holding_registers", 3, 7, "uint16")
    client.write("coils", 4, [True, False], "bool[2]")
    client.write("holding_registers", 4, 7, "uint32")

    assert memory.read("coils", 3, 3) == [1, 1, 0]
    assert memory.read("holding_registers", 3, 3) == [7, 0, 7]
    assert server.counters()["requests"] == {5: 1, 6: 1, 15: 1, 16: 1}


@pytest.mark.parametrize("order", ["ABCD", "BADC"])
def test_one_bit_of_a_register_leaves_the_others_alone(
    order: str, large: Large, dial: Dial
) -> None:
    server, memory = large
    client = dial(url_of(server))
    memory.write("holding_registers", 0, [0xF00F, 0xF00F])

    client.write("holding_registers", 0, True, "bit:4", order)
    client.write("holding_registers", 1, False, "bit:0", order)

    assert client.read("holding_registers", 0, "bit:4", order) is True
    assert client.read("holding_registers", 1, "bit:0", order) is False
    expected = [0xF01F, 0xF00E] if order == "ABCD" else [0xF00F | 0x1000, 0xF00F & ~0x100]
    assert memory.read("holding_registers", 0, 2) == expected
    assert server.counters()["requests"] == {22: 2, 3: 2}


# Arguments

HUGE = 1 << 200

REFUSED: list[tuple[str, tuple[Any, ...], dict[str, Any], type[Exception], str]] = [
    ("read_coils", (0, 0), {}, ValueError, "count is 0"),
    ("read_coils", (-1, 1), {}, ValueError, "address is -1"),
    ("read_coils", (65536, 1), {}, ValueError, "address is 65536"),
    ("read_coils", (65535, 2), {}, ValueError, "the last address is 65535"),
    ("read_coils", (0, 65537), {}, ValueError, "the last address is 65535"),
    ("read_coils", (-1, 3000), {}, ValueError, "the last address is 65535"),
    ("read_coils", (0, -1), {}, ValueError, "count is -1"),
    ("read_coils", (HUGE, 1), {}, ValueError, "address is"),
    ("read_coils", (0, HUGE), {}, ValueError, "the last address"),
    ("read_coils", (0, -HUGE), {}, ValueError, "count is"),
    ("read_coils", (0.0, 1), {}, TypeError, "float"),
    ("read_coils", (0, "1"), {}, TypeError, "str"),
    ("read_coils", (0, 1), {"unit": 256}, ValueError, "unit is 256, allowed: 0 to 255"),
    ("read_coils", (0, 1), {"unit": -1}, ValueError, "unit is -1"),
    ("read_coils", (0, 1), {"unit": True}, ValueError, "unit is True"),
    ("read_coils", (0, 1), {"unit": "1"}, ValueError, "unit is '1'"),
    ("read_discrete_inputs", (65000, 537), {}, ValueError, "the last address is 65535"),
    ("read_holding_registers", (65535, 126), {}, ValueError, "the last address is 65535"),
    ("read_input_registers", (0, None), {}, TypeError, "NoneType"),
    ("write_coil", (0, 2), {}, ValueError, "is 2, allowed: 0, 1, False, True"),
    ("write_coil", (0, "on"), {}, TypeError, "is 'on'"),
    ("write_coil", (65536, True), {}, ValueError, "address is 65536"),
    ("write_coils", (0, []), {}, ValueError, "count is 0"),
    ("write_coils", (0, [2]), {}, ValueError, r"values\[0\] is 2"),
    ("write_coils", (65535, [1, 0]), {}, ValueError, "the last address is 65535"),
    ("write_coils", (0, [0] * 1969), {}, ValueError, "use split=True"),
    ("write_coils", (0, [0] * 2000 + [2]), {"split": True}, ValueError, r"values\[2000\] is 2"),
    ("write_coils", (0, 1), {}, TypeError, "int"),
    ("write_coils", (65000, [0] * 2000), {"split": True}, ValueError, "the last address"),
    ("write_register", (0, 65536), {}, ValueError, "is 65536, allowed: integers 0 to 65535"),
    ("write_register", (0, -1), {}, ValueError, "is -1"),
    ("write_register", (0, HUGE), {}, ValueError, "value is 16069"),
    ("write_register", (0, 1.0), {}, TypeError, "is 1.0"),
    ("write_register", (0, True), {}, TypeError, "is True"),
    ("write_registers", (0, [1, 65536]), {}, ValueError, r"values\[1\] is 65536"),
    ("write_registers", (0, b"\1\2"), {}, TypeError, "bytes"),
    (
        "write_registers",
        (0, memoryview(b"\1\2")),
        {},
        TypeError,
        "values are memoryview, not a seq",
    ),
    ("write_registers", (0, iter([1])), {}, TypeError, "values are list_iterator, not a sequence"),
    ("write_registers", (0, [1] * 150 + [1.5]), {"split": True}, TypeError, r"values\[150\] is 1"),
    ("write_registers", (0, []), {"split": True}, ValueError, "count is 0"),
    ("write_registers", (0, [1] * 124), {}, ValueError, "use split=True"),
    ("write_registers", (-1, [1] * 200), {"split": True}, ValueError, "the last address"),
    ("mask_write", (0,), {"and_mask": 65536, "or_mask": 0}, ValueError, "and_mask is 65536"),
    ("mask_write", (0,), {"and_mask": 0, "or_mask": -1}, ValueError, "or_mask is -1"),
    ("read_write", (0, 126, 0, [1]), {}, ValueError, "count is 126, allowed: 1 to 125"),
    ("read_write", (0, 1, 0, [1] * 122), {}, ValueError, "count is 122, allowed: 1 to 121"),
    ("read_write", (65535, 2, 0, [1]), {}, ValueError, "the last address is 65535"),
    ("diagnostics", (5,), {}, ValueError, "sub_function is 5, allowed: 0, 1, 2, 3, 4, 10, .* 20$"),
    ("diagnostics", (65536,), {}, ValueError, "sub_function is 65536"),
    ("diagnostics", (0, []), {}, ValueError, "does not allow this data field"),
    ("diagnostics", (0, [65536]), {}, ValueError, r"data\[0\] is 65536, allowed: integers 0 to"),
    ("diagnostics", (0, b"\xa5\x37"), {}, TypeError, "data are bytes, not a sequence of integers"),
    ("diagnostics", (0, {5: 1}), {}, TypeError, "data are dict, not a sequence of integers"),
    ("diagnostics", (0, [0] * 126), {}, ValueError, "Return Query Data does not allow this data"),
    ("diagnostics", (10, [1]), {}, ValueError, "Clear Counters .* does not allow this data field"),
    ("read_file_record", (0, 0), {}, ValueError, "file is 0, allowed: 1 to 65535"),
    ("read_file_record", (1, 10_000), {}, ValueError, "record is 10000, allowed: 0 to 9999"),
    ("read_file_record", (1, -1), {}, ValueError, "record is -1"),
    ("read_file_record", (1, 0, 0), {}, ValueError, "count is 0, allowed: 1 to 121"),
    ("read_file_record", (1, 0, -1), {}, ValueError, "count is -1"),
    ("read_file_record", (1, 9999, 2), {}, ValueError, "the last record is 9999"),
    ("read_file_record", (1, 9900, 200), {}, ValueError, "the last record is 9999"),
    (
        "read_file_record",
        (1, 0, HUGE),
        {},
        ValueError,
        "the last record is 9999",
    ),
    ("read_file_record", (1, 0, 1.0), {}, TypeError, "float"),
    ("read_file_records", ([],), {}, ValueError, "the ranges take 0 bytes"),
    ("read_file_records", ([(1, 0, 122)],), {}, ValueError, "count is 122, allowed: 1 to 121"),
    ("read_file_records", ([(1, 0, 61), (1, 61, 61)],), {}, ValueError, "take 248 bytes"),
    ("read_file_records", ([(1, 0, 1)] * 36,), {}, ValueError, "take 252 bytes"),
    ("read_file_records", ([(1, 0)],), {}, ValueError, "tuple of length 3"),
    ("write_file_record", (1, 0, []), {}, ValueError, "count is 0, allowed: 1 to 122"),
    ("write_file_record", (1, 0, [0] * 123), {}, ValueError, "count is 123, allowed: 1 to 122"),
    ("write_file_record", (1, 0, [65536]), {}, ValueError, r"values\[0\] is 65536"),
    ("write_file_record", (65536, 0, [1]), {}, ValueError, "file is 65536"),
    ("write_file_records", ([(1, 0, [0] * 61)] * 2,), {}, ValueError, "take 258 bytes"),
    ("read_fifo_queue", (65536,), {}, ValueError, "address is 65536"),
    ("call_function", (0,), {}, ValueError, "function is 0, allowed: 1 to 127"),
    ("call_function", (128,), {}, ValueError, "function is 128"),
    ("call_function", (65, bytes(253)), {}, ValueError, r"len\(data\) is 253, allowed: 0 to 252"),
    ("read", ("coil", 0, "bool"), {}, ValueError, "area is 'coil', .* did you mean 'coils'"),
    ("read", ("HR", 0, "int16"), {}, ValueError, "did you mean 'holding_registers'"),
    ("read", ("coils", 0, "uint16"), {}, ValueError, "allowed in coils: bool"),
    ("read", ("holding_registers", 0, "int24"), {}, ValueError, "int24"),
    ("read", ("holding_registers", 0, "int32", "ACBD"), {}, ValueError, "ACBD"),
    ("read", ("holding_registers", 0, "string:4"), {"encoding": "klingon"}, ValueError, "klingon"),
    ("read", ("holding_registers", 65535, "int32"), {}, ValueError, "the last address is 65535"),
    ("write", ("holding_registers", 0, 1 << 15, "int16"), {}, ValueError, "32768"),
    ("write", ("holding_registers", 0, 1.5, "int16"), {}, ValueError, "1.5"),
    ("write", ("input_registers", 0, 1, "int16"), {}, ValueError, "allowed: coils, holding"),
    ("write", ("coils", 0, 5, "uint16"), {}, ValueError, "allowed in coils: bool"),
    ("write", ("holding_registers", 0, [True] * 2, "bit:3[2]"), {}, ValueError, "allowed: one bit"),
]


@pytest.mark.parametrize(
    ("method", "arguments", "named", "error", "text"),
    REFUSED,
    ids=[f"{method}-{number}" for number, (method, *_) in enumerate(REFUSED)],
)
def test_what_cannot_be_asked_is_not_sent(
    method: str,
    arguments: tuple[Any, ...],
    named: dict[str, Any],
    error: type[Exception],
    text: str,
    dial: Dial,
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as nobody:
        client = dial(f"tcp://127.0.0.1:{nobody.getsockname()[1]}")
        with pytest.raises(error, match=text):
            getattr(client, method)(*arguments, **named)
        nobody.setblocking(False)
        with pytest.raises(BlockingIOError):
            nobody.accept()


@pytest.mark.parametrize("face", FACES.values(), ids=FACES)
@pytest.mark.parametrize(
    ("options", "error", "text"),
    [
        ({"unit": 256}, ValueError, "unit is 256, allowed: 0 to 255"),
        ({"unit": None}, ValueError, "unit is None"),
        ({"timeout": 0}, ValueError, "timeout is 0, allowed: more than 0, up to 86400 seconds"),
        ({"timeout": -1}, ValueError, "timeout is -1"),
        ({"timeout": float("nan")}, ValueError, "timeout is nan"),
        ({"timeout": 10**400}, ValueError, "timeout is 1000"),
        ({"timeout": "1"}, TypeError, "timeout is '1', allowed: more than 0, up to 86400 seconds"),
        ({"timeout": None}, TypeError, "timeout is None, allowed: more than 0"),
    ],
)
def test_what_a_client_cannot_be_is_refused(
    face: Any, options: dict[str, Any], error: type[Exception], text: str
) -> None:
    make = holdfast.Client if face is Awaited else face
    with pytest.raises(error, match=text):
        make("tcp://127.0.0.1", **options)


@pytest.mark.parametrize("face", FACES.values(), ids=FACES)
def test_settings_of_a_client_are_checked_when_they_change(face: Any) -> None:
    make = holdfast.Client if face is Awaited else face
    client = make("tcp://127.0.0.1", unit=3, timeout=2)
    with pytest.raises(ValueError, match="unit is 300, allowed: 0 to 255"):
        client.unit = 300
    with pytest.raises(ValueError, match="timeout is -1, allowed: more than 0"):
        client.timeout = -1
    with pytest.raises(TypeError, match="timeout is '3', allowed: more than 0"):
        client.timeout = "3"
    assert (client.unit, client.timeout) == (3, 2)


@pytest.mark.parametrize("number", [0, 1025, 1.0, True, None])
def test_the_number_in_flight_has_its_limits(number: Any) -> None:
    with pytest.raises(ValueError, match="allowed: 1 to 1024"):
        holdfast.Client("tcp://127.0.0.1", max_in_flight=number)


# URLs


@pytest.mark.parametrize(
    ("url", "target"),
    [
        ("tcp://plc", NetworkTarget("tcp", "plc", 502)),
        ("tcp://10.0.0.1:1502/", NetworkTarget("tcp", "10.0.0.1", 1502)),
        ("tcp://Plc_1.hall_2.local.:1502", NetworkTarget("tcp", "plc_1.hall_2.local.", 1502)),
        ("tcp://[fe80::1%12]", NetworkTarget("tcp", "fe80::1%12", 502)),
        ("udp://[fe80::1%25eth0]:502", NetworkTarget("udp", "fe80::1%eth0", 502)),
        ("rtu+tcp://gateway:4001", NetworkTarget("rtu+tcp", "gateway", 4001)),
        ("tls://plc", NetworkTarget("tls", "plc", 802)),
        ("tls://[fd00::1]:1802/?ca=ca.pem", NetworkTarget("tls", "fd00::1", 1802, Tls("ca.pem"))),
        (
            "tls://10.0.0.5?ca=/a%20b/c+d%26.pem&cert=c.pem&key=C:\\k.pem&name=plc7",
            NetworkTarget(
                "tls", "10.0.0.5", 802, Tls("/a b/c+d&.pem", "c.pem", "C:\\k.pem", "plc7")
            ),
        ),
        ("rtu:///dev/ttyUSB0", SerialTarget("rtu", "/dev/ttyUSB0", 19200, "even", 1, 8)),
        ("tcp://plc_7.site-2.example", NetworkTarget("tcp", "plc_7.site-2.example", 502)),
        ("tcp://प्लांट", NetworkTarget("tcp", "प्लांट", 502)),
        ("tcp://[fe80::1%25eth0]", NetworkTarget("tcp", "fe80::1%eth0", 502)),
        ("rtu:///dev/ttyS0?parity=none", SerialTarget("rtu", "/dev/ttyS0", 19200, "none", 2, 8)),
        (
            "rtu:///dev/a%20b?baud=115200&parity=odd&stop_bits=2&silence=0.01&echo=1",
            SerialTarget("rtu", "/dev/a b", 115200, "odd", 2, 8, 0.01, Tolerance(echo=True)),
        ),
        ("ascii:///dev/ttyS0", SerialTarget("ascii", "/dev/ttyS0", 19200, "even", 1, 7)),
        ("ascii:///dev/ttyS0?data_bits=8", SerialTarget("ascii", "/dev/ttyS0", data_bits=8)),
        ("rtu:///COM3", SerialTarget("rtu", "COM3")),
        ("rtu://COM3", SerialTarget("rtu", "COM3")),
        ("rtu://com3", SerialTarget("rtu", "com3")),
        ("rtu://%5C%5C.%5CCOM10", SerialTarget("rtu", r"\\.\COM10")),
    ],
)
def test_a_url_names_a_device(url: str, target: NetworkTarget | SerialTarget) -> None:
    assert parse(url) == target


def test_a_target_is_shown_as_a_url() -> None:
    assert str(parse("udp://[::1]:1502")) == "udp://[::1]:1502"
    assert str(parse("rtu:///dev/ttyUSB0?baud=9600")) == "rtu:///dev/ttyUSB0"


@pytest.mark.parametrize(
    ("url", "text"),
    [
        ("", "is not the URL of a device, allowed: tcp://host:502"),
        ("plc", "is not the URL of a device"),
        ("http://plc", "is not the URL of a device"),
        ("tls://", "is not the address of a device"),
        ("tls://plc/unit", "is not the address of a device"),
        ("tls://plc?baud=9600", "unknown option 'baud', allowed: accept_unit, pad, .*, ca, cert"),
        ("tls://plc?ca=a&ca=b", "option 'ca' is given twice"),
        ("tls://plc?ca=", "ca is '', allowed: paths of files"),
        ("tls://plc?ca=a%00b", r"ca is 'a\\x00b', allowed: paths of files"),
        ("tls://plc?name=", "name is '', allowed: host names and IP addresses"),
        ("tls://plc?cert=a", "cert without key: give both, or neither"),
        ("tls://plc?key=a", "key without cert"),
        ("tcp://plc?ca=a", "unknown option 'ca', allowed: accept_unit, pad, pause"),
        ("rtu:///dev/x?ca=a", "unknown option 'ca', allowed: baud, parity"),
        ("tcp://", "is not the address of a device"),
        ("tcp://10.0.0.5 :502", "the host is '10.0.0.5 ', allowed: a host name"),
        ("tcp://('127.0.0.1', 5020)", r"""the host is "\('127.0.0.1', 5020\)", allowed"""),
        ("udp://10.0.0.5,10.0.0.6", "host is '10.0.0.5,10.0.0.6', allowed"),
        ("tls://plc%20", "host is 'plc%20', allowed"),
        ("tls://plc\u00a0one", "host is 'plc.*', allowed"),
        ("tcp://\uff11\uff12\uff17.1", "the host is"),
        ("tcp://10\u30020\u30020\u30025", "the host is"),
        ("tcp://plc%C2%A0", "host is 'plc%C2%A0', allowed"),
        ("tcp://plc:0", "port 0"),
        ("tcp://plc:65536", "port 65536, allowed: 1 to 65535"),
        ("tcp://plc:x", "port 'x'"),
        ("tcp://plc:", "port '', allowed: 1 to 65535"),
        ("tcp://10.0.0.010:502", "the host is '10.0.0.010', allowed: a host name, an IPv4"),
        ("tcp://192.168.1", "the host is '192.168.1'"),
        ("tcp://10.0.0.300", "the host is '10.0.0.300'"),
        ("tcp://0x0a000005", "the host is '0x0a000005'"),
        ("tcp://plc one", "the host is 'plc one'"),
        ("tcp://${PLC_HOST}:502", "the host is '.*PLC_HOST}'"),
        ("tcp://127.0.0.1&retries=2", r"the host is '127.0.0.1&retries=2'.*begin with '\?'"),
        ("tcp://127.0.0.1;pause=1", r"options begin with '\?'"),
        ("tcp://[::1]&retries=2", "the host is|Invalid IPv6"),
        ("tcp://fd00::1", "an IPv6 address in brackets"),
        ("tcp://127.0.0.1 ", "blanks around it"),
        ("tcp://10.0.0\n.1", "a control character"),
        ("tcp://[::1", "Invalid IPv6 URL"),
        ("tcp://plc/unit", "is not the address of a device"),
        (
            "tcp://plc?unit=1",
            "unknown option 'unit', allowed: accept_unit, pad, pause.*; the unit id of a device is "
            "not part of its URL: set it with unit, or --unit",
        ),
        ("tcp://me@plc", "has a user or a fragment"),
        ("tcp://plc#1", "has a user or a fragment"),
        ("rtu://", "has no device"),
        ("rtu:///", "has no device"),
        ("rtu://10.0.0.5:502", r"RTU frames over TCP are rtu\+tcp://host:502"),
        ("ascii://10.1.1.1", r"ASCII frames over TCP are ascii\+tcp://host:502"),
        ("rtu://dev/ttyUSB0", "three slashes, as in rtu:///dev/ttyUSB0"),
        ("rtu:ttyUSB0", "is not a serial line"),
        ("rtu:///dev/x?baud=10", "baud is '10', allowed: 50 to 4000000"),
        ("rtu:///dev/x?baud=fast", "baud is 'fast'"),
        ("rtu:///dev/x?parity=mark", "parity is 'mark', allowed: none, even, odd"),
        ("rtu:///dev/x?stop_bits=3", "stop_bits is '3', allowed: 1, 2"),
        ("rtu:///dev/x?data_bits=7", "data_bits is 7, allowed with rtu: 8"),
        ("rtu:///dev/x?silence=0", "silence is '0', allowed: seconds, up to 10"),
        ("rtu:///dev/x?echo=yes", "echo is 'yes', allowed: 0, 1"),
        ("rtu:///dev/x?speed=1", "unknown option 'speed', allowed: baud, parity"),
        ("rtu:///dev/x?baud=9600&baud=9600", "option 'baud' is given twice"),
        ("ascii:///dev/x?silence=1", "unknown option 'silence'"),
    ],
)
def test_a_url_that_names_no_device_is_refused(url: str, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        holdfast.SyncClient(url)


@pytest.mark.parametrize(
    "url",
    [
        "tcp://me:secret@plc:502",
        "tcp://me:sec/secret@plc:502",
        "http://me:secret@plc:502",
        "tcp://plc:502?token=secret",
        "tcp://plc:502?retries=x&token=secret",
        "tcp://plc:502#secret",
    ],
)
def test_what_may_be_a_secret_in_a_url_is_not_shown(url: str) -> None:
    with pytest.raises(ValueError, match=r"^'[a-z]+://([*]{3}@)?plc:502'") as caught:
        holdfast.SyncClient(url)
    assert "secret" not in str(caught.value)


def test_a_url_is_a_text() -> None:
    with pytest.raises(TypeError, match="5 is not the URL of a device"):
        holdfast.Client(5)  # type: ignore[arg-type]


# Errors, as a caller catches them


def test_all_errors_are_modbus_errors() -> None:
    assert issubclass(holdfast.ModbusException, holdfast.ModbusError)
    certain = [code for code in range(256) if not holdfast.ModbusException(code).maybe_executed]
    assert certain == [0x01, 0x02, 0x03, 0x06, 0x0A]
    assert issubclass(holdfast.InvalidResponse, holdfast.ModbusError)
    assert issubclass(holdfast.ConnectionLost, holdfast.ModbusError)
    assert issubclass(holdfast.ConnectionLost, ConnectionError)
    assert issubclass(holdfast.RequestTimeout, holdfast.ModbusError)
    assert issubclass(holdfast.RequestTimeout, TimeoutError)


def of_a_later_request(error: holdfast.ModbusError) -> holdfast.ModbusError:
    error.note_written(123, "200 registers")
    return error


LATER_ERRORS = [
    holdfast.ModbusException(2),
    holdfast.ConnectFailed("tcp://plc", "refused"),
    holdfast.TlsFailed("expired", "tls://plc", "the certificate has expired"),
    holdfast.RequestTimeout("no connection", maybe_sent=False),
]


@pytest.mark.parametrize("error", LATER_ERRORS, ids=lambda error: type(error).__name__)
def test_no_error_of_a_later_request_says_that_nothing_was_written(
    error: holdfast.ModbusError,
) -> None:
    before, flag = str(error), "maybe_sent"
    if isinstance(error, holdfast.ModbusException):
        flag = "maybe_executed"
    assert not getattr(error, flag)
    of_a_later_request(error)
    assert getattr(error, flag)
    assert str(error) == f"{before}; the first 123 of 200 registers are written"


PUBLIC_ERRORS = [
    error
    for module in (holdfast, adapters, importing, polling, raw_ingest, values)
    for error in (getattr(module, name) for name in module.__all__)
    if isinstance(error, type) and issubclass(error, Exception)
]
PROBLEMS = [Problem(file, 1, 2, "a", "bad") for file in ("a", "b.yaml")]
ERRORS = [
    holdfast.ModbusException(2, "illegal data address"),
    holdfast.ConnectionLost("closed"),
    of_a_later_request(holdfast.TlsFailed("expired", "tls://plc", "expired")),
    holdfast.ConnectFailed("tcp://plc", "Connection refused", errno.ECONNREFUSED),
    holdfast.RequestTimeout("no reply", maybe_sent=False),
    holdfast.InvalidResponse("an invalid length", "length"),
    polling.WriteFailed("meter", "power", 3),
    polling.WriteFailed("meter", "power", 3, "the poller was closed"),
    TooManyValues(200, 123),
    Refused("power", "power: too large"),
    adapters.Refused("empty", "values are empty", command=1),
    holdfast.TagError("scale", "scale is 0"),
    holdfast.ConfigError("b.yaml", PROBLEMS),
    importing.NotImportable("b.yaml", PROBLEMS, ()),
    raw_ingest.RawTlsFailed("plc: expired", "expired", maybe_written=False),
    *(
        kind("plc: lost", maybe_written=True)
        for kind in (raw_ingest.RawError, raw_ingest.RawRefused, raw_ingest.RawTimeout)
    ),
]
# The others have a text only.
ERRORS += [error("text") for error in PUBLIC_ERRORS if error not in map(type, ERRORS)]


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_an_error_survives_a_process_pool(error: Exception) -> None:
    for copied in (pickle.loads(pickle.dumps(error)), copy.copy(error)):
        assert (type(copied), str(copied), vars(copied)) == (type(error), str(error), vars(error))
        if isinstance(error, OSError):
            assert isinstance(copied, OSError)
            assert (copied.errno, copied.strerror) == (error.errno, error.strerror)


def test_an_error_has_the_number_of_the_system_or_none(dial: Dial) -> None:
    client = dial(f"tcp://127.0.0.1:{free_port()}")
    with pytest.raises(holdfast.ConnectFailed) as caught:
        client.read_coils(0, 1)
    refused = caught.value
    assert (refused.errno, refused.strerror) == (errno.ECONNREFUSED, refused.detail)
    expired = holdfast.TlsFailed("expired", "tls://plc", "it has expired")
    assert (expired.errno, expired.strerror, expired.filename) == (None, "it has expired", None)


# Threads


def test_threads_share_a_client(device: Device, dial: Dial) -> None:
    device.memory.write("holding_registers", 0, range(1000))
    client = dial(device.url)
    wrong: list[Any] = []

    def read(first: int) -> None:
        for address in range(first, 80, 8):
            found = client.read_holding_registers(address, 1)
            if found != [address]:
                wrong.append((address, found))

    threads = [threading.Thread(target=read, args=(first,)) for first in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(wire.DEADLINE)
    assert wrong == []


def test_a_thread_that_waits_for_its_turn_does_not_lose_time() -> None:
    caught: list[holdfast.ModbusError] = []

    with Stream("tcp", then=silent) as device, holdfast.SyncClient(device.url, timeout=0.1) as plc:

        def read() -> None:
            with pytest.raises(holdfast.RequestTimeout) as error:
                plc.read_coils(0, 1)
            caught.append(error.value)

        threads = [threading.Thread(target=read) for _ in range(3)]
        began = time.monotonic()
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(wire.DEADLINE)

        assert len(caught) == 3
        assert time.monotonic() - began >= 0.3
        device.await_requests(3)
        assert device.connections == 1


# Tasks


async def gathered(calls: Sequence[Awaitable[Any]]) -> list[Any]:
    return list(await asyncio.gather(*calls))


@pytest.mark.parametrize("in_flight", [1, 16, 1024])
def test_a_thousand_tasks_share_a_client(
    in_flight: int, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 0, range(1000))

    async def main() -> None:
        async with holdfast.Client(
            url_of(server), timeout=wire.DEADLINE, max_in_flight=in_flight
        ) as plc:
            calls = [plc.read_holding_registers(address, 1) for address in range(1000)]
            assert await gathered(calls) == [[address] for address in range(1000)]

    asyncio.run(main())
    assert server.counters()["connections"]["accepted"] == 1


@pytest.mark.parametrize("device", ["udp", "rtu", "ascii", "rtu+tcp"], indirect=True)
def test_tasks_share_a_client_where_one_request_goes_at_a_time(device: Device) -> None:
    device.memory.write("holding_registers", 0, range(1000))

    async def main() -> None:
        async with holdfast.Client(device.url, timeout=wire.DEADLINE) as plc:
            calls = [plc.read_holding_registers(address, 1) for address in range(50)]
            assert await gathered(calls) == [[address] for address in range(50)]

    run(main)


def test_no_more_requests_are_in_flight_than_allowed() -> None:
    async def main() -> None:
        with Stream("tcp", then=silent) as device:
            async with holdfast.Client(device.url, timeout=wire.DEADLINE, max_in_flight=3) as plc:
                tasks = [asyncio.create_task(plc.read_coils(at, 1)) for at in range(5)]
                await asyncio.to_thread(device.await_requests, 3)
                device.requests[1].answer()
                assert await tasks[1] == [False]
                await asyncio.to_thread(device.await_requests, 4)
                device.then = lambda asked: asked.answer()
                for asked in [device.requests[3], device.requests[0], device.requests[2]]:
                    asked.answer()
                assert await gathered(tasks) == [[False]] * 5
                assert [asked.pdu[2] for asked in device.requests] == [0, 1, 2, 3, 4]

    run(main)


# Cancellation


async def cancelled(task: asyncio.Task[Any]) -> None:
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task


def test_a_call_that_is_cancelled_before_it_ran_sends_nothing() -> None:
    async def main() -> None:
        with Stream("tcp") as device:
            async with holdfast.Client(device.url, timeout=wire.DEADLINE) as plc:
                await cancelled(asyncio.create_task(plc.write_register(0, 1)))
                assert await plc.read_holding_registers(7, 1) == [7]
                assert [asked.pdu[0] for asked in device.requests] == [3]

    run(main)


def test_a_call_that_is_cancelled_while_it_connects_sends_nothing() -> None:
    async def main() -> None:
        with Stream("tcp") as device:
            async with holdfast.Client(device.url, timeout=wire.DEADLINE, max_in_flight=2) as plc:
                both = [asyncio.create_task(plc.write_register(at, 1)) for at in range(2)]
                await asyncio.sleep(0)
                await cancelled(both[0])
                await both[1]
                assert await plc.read_holding_registers(1, 1) == [1]
                assert [asked.pdu[2] for asked in device.requests] == [1, 1]
                assert device.connections == 1

    run(main)


def test_a_dead_connection_is_replaced_although_each_call_has_a_limit_of_its_own() -> None:
    """The limit is shorter than the timeout, as that of `asyncio.timeout` may be."""
    first: list[Any] = []

    def answers_on_another_one(asked: Asked) -> None:
        if asked.peer is not first[0]:
            asked.answer()

    async def main(url: str) -> None:
        async with holdfast.Client(url, timeout=0.2) as plc, asyncio.timeout(wire.DEADLINE):
            while True:
                try:
                    async with asyncio.timeout(0.1):
                        await plc.read_holding_registers(0, 1)
                    break
                except (TimeoutError, holdfast.ConnectionLost):
                    continue

    with Stream(
        "tcp", then=answers_on_another_one, greet=lambda peer, _: first.append(peer)
    ) as device:
        asyncio.run(main(device.url))
        assert device.connections == 2


def test_a_call_has_its_own_time_to_connect_although_another_one_has_begun(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tries = []

    async def connected(*arguments: Any) -> socket.socket:
        tries.append(arguments)
        if len(tries) == 1:
            await asyncio.Event().wait()
        return await tcp_connect.connected(*arguments)

    monkeypatch.setattr(async_transports, "connected", connected)
    request = Request.read("holding_registers", 7, 1)

    async def main(target: NetworkTarget) -> None:
        transport = async_transports.AsyncConnection(target, endpoints.endpoint(target), 2)
        calls = [transport.call(request, 1, timeout) for timeout in (0.05, wire.DEADLINE)]
        short, long = await asyncio.gather(*calls, return_exceptions=True)
        await transport.close()
        assert isinstance(short, holdfast.RequestTimeout)
        assert long == [7]

    with Stream("tcp") as device:
        asyncio.run(main(NetworkTarget("tcp", "127.0.0.1", device.port)))


def test_the_only_call_may_be_cancelled_while_it_connects() -> None:
    async def main() -> None:
        with Stream("tcp") as device:
            async with holdfast.Client(device.url, timeout=wire.DEADLINE) as plc:
                task = asyncio.create_task(plc.write_register(0, 1))
                await asyncio.sleep(0)
                await cancelled(task)
                assert await plc.read_holding_registers(7, 1) == [7]
                assert len(device.requests) == 1

    run(main)


def test_a_call_that_is_cancelled_in_the_queue_sends_nothing_and_keeps_no_place() -> None:
    async def main() -> None:
        with Stream("tcp", silent) as device:
            async with holdfast.Client(device.url, timeout=wire.DEADLINE, max_in_flight=1) as plc:

                async def first() -> None:
                    await plc.read_holding_registers(0, 1)
                    # Its place is given to the third, who does not know it yet.
                    tasks[2].cancel()

                calls = [first(), *[plc.read_holding_registers(at, 1) for at in (1, 2, 3)]]
                tasks = [asyncio.create_task(call) for call in calls]
                await asyncio.to_thread(device.await_requests, 1)
                await cancelled(tasks[1])
                device.requests[0].answer()
                await tasks[0]
                with pytest.raises(asyncio.CancelledError):
                    await tasks[2]
                assert await tasks[3] == [3]
                assert await plc.read_holding_registers(9, 1) == [9]
                assert [asked.pdu[2] for asked in device.requests] == [0, 3, 9]

    run(main)


@pytest.mark.parametrize("loop_factory", [asyncio.new_event_loop, event_loop.fastest])
def test_every_event_loop_carries_replies_that_are_longer_than_its_buffer(
    serve: Serve, loop_factory: Callable[[], asyncio.AbstractEventLoop]
) -> None:
    memory = holdfast.Memory(holding_registers=2000)
    memory.write("holding_registers", 0, range(2000))

    async def main() -> None:
        url = url_of(serve({1: memory}))
        async with holdfast.Client(url, timeout=wire.DEADLINE, max_in_flight=16) as plc:
            reads = [plc.read_holding_registers(at, 125) for at in range(0, 1600, 25)]
            assert await asyncio.gather(*reads) == [
                [*range(at, at + 125)] for at in range(0, 1600, 25)
            ]
            with pytest.raises(holdfast.ModbusException):
                await plc.read_holding_registers(2000, 1)

    with asyncio.Runner(loop_factory=loop_factory) as runner:
        runner.run(main())


@pytest.mark.parametrize("loop_factory", [asyncio.new_event_loop, event_loop.fastest])
def test_every_event_loop_ends_calls_in_time_and_drops_late_replies(
    loop_factory: Callable[[], asyncio.AbstractEventLoop],
) -> None:
    async def main() -> None:
        with Stream("tcp", silent) as device:
            async with holdfast.Client(device.url, timeout=0.05, max_in_flight=2) as plc:
                with pytest.raises(holdfast.RequestTimeout):
                    await plc.read_holding_registers(1, 1)
                plc.timeout = wire.DEADLINE
                device.requests[0].answer()
                assert await plc.read_holding_registers(2, 1) == [2]
                assert plc.late == 1

    with asyncio.Runner(loop_factory=loop_factory) as runner:
        runner.run(main())


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has such a limit")
@pytest.mark.parametrize("loop_factory", [asyncio.new_event_loop, event_loop.fastest])
def test_the_system_repeats_a_request_only_for_its_timeout(
    loop_factory: Callable[[], asyncio.AbstractEventLoop], monkeypatch: pytest.MonkeyPatch
) -> None:
    sockets: list[socket.socket] = []

    async def connected(*arguments: Any) -> socket.socket:
        sockets.append(await tcp_connect.connected(*arguments))
        return sockets[-1]

    monkeypatch.setattr(async_transports, "connected", connected)

    def limit_ms() -> int:
        return sockets[-1].getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT)

    async def main() -> None:
        with Stream("tcp") as device:
            plc = holdfast.Client(device.url)
            # The longest so far, in whole seconds; a new connection begins anew.
            for timeout, limit in [(30, 30_000), (29.5, 30_000), (30.5, 31_000)]:
                plc.timeout = timeout
                await plc.write_register(0, 1)
                assert limit_ms() == limit
            await plc.close()
            plc.timeout = 20
            await plc.write_register(0, 1)
            assert limit_ms() == 20_000
            await plc.close()

    with asyncio.Runner(loop_factory=loop_factory) as runner:
        runner.run(main())


def test_the_reply_to_a_cancelled_call_is_dropped_and_counted() -> None:
    async def main() -> None:
        with Stream("tcp", silent) as device:
            async with holdfast.Client(device.url, timeout=wire.DEADLINE, max_in_flight=1) as plc:
                task = asyncio.create_task(plc.read_holding_registers(1, 1))
                await asyncio.to_thread(device.await_requests, 1)
                await cancelled(task)
                device.requests[0].answer()
                assert await plc.read_holding_registers(2, 1) == [2]
                assert plc.late == 1
                assert device.connections == 1
            assert plc.late == 1

    run(main)


def test_a_call_may_be_cancelled_while_its_reply_is_read() -> None:
    async def main() -> None:
        with Stream("tcp", silent) as device:
            async with holdfast.Client(device.url, timeout=wire.DEADLINE) as plc:
                task = asyncio.create_task(plc.read_holding_registers(1, 1))
                await asyncio.to_thread(device.await_requests, 1)
                # Both happen in one turn of the loop, first this, then that.
                asyncio.get_running_loop().call_soon(task.cancel)
                device.requests[0].answer()
                with pytest.raises(asyncio.CancelledError):
                    await task
                assert await plc.read_holding_registers(2, 1) == [2]
                assert device.connections == 1

    run(main)


@pytest.mark.parametrize("kind", ["udp", "rtu+tcp"])
def test_a_call_in_a_thread_may_be_cancelled(kind: str) -> None:
    async def is_cancelled(timeout: float) -> bool:
        with device_of(kind, good, silent) as device:
            async with holdfast.Client(device.url, timeout=wire.DEADLINE) as plc:
                assert await plc.read_holding_registers(0, 1) == [0]
                plc.timeout, began = timeout, time.monotonic()
                under_way = asyncio.create_task(plc.write_register(1, 1))
                await asyncio.to_thread(device.await_requests, 2)
                waiting = asyncio.create_task(plc.write_register(2, 1))
                await asyncio.sleep(0)
                waiting.cancel()
                under_way.cancel()
                await asyncio.wait([waiting, under_way])
                if time.monotonic() - began >= timeout:
                    return False
                assert waiting.cancelled()
                assert under_way.cancelled()
                plc.timeout = wire.DEADLINE
                assert await plc.read_holding_registers(7, 1) == [7]
                assert [asked.pdu[2] for asked in device.requests] == [0, 1, 7]
                return True

    wire.until_long_enough(lambda timeout: run(partial(is_cancelled, timeout)), "it is cancelled")


def device_of(kind: str, *script: Behaviour, **options: Any) -> ScriptedDevice:
    return Udp(*script, **options) if kind == "udp" else Stream(kind, *script, **options)


def test_timeouts_of_others_leave_a_cancelled_call_alone() -> None:
    async def is_cancelled(timeout: float) -> bool:
        with Stream("tcp", good, then=silent) as device:
            async with holdfast.Client(device.url, timeout=wire.DEADLINE, max_in_flight=3) as plc:
                assert await plc.read_coils(0, 1) == [False]
                plc.timeout, began = timeout, time.monotonic()
                tasks = [asyncio.create_task(plc.read_coils(at, 1)) for at in range(3)]
                await asyncio.to_thread(device.await_requests, 4)
                tasks[0].cancel()
                results = await asyncio.gather(*tasks, return_exceptions=True)
                if not tasks[0].cancelled():
                    assert time.monotonic() - began >= timeout
                    return False
                assert [type(result) for result in results[1:]] == 2 * [holdfast.RequestTimeout]
                return True

    wire.until_long_enough(lambda timeout: run(partial(is_cancelled, timeout)), "it is cancelled")


# Closing while calls wait


def test_calls_that_wait_are_told_that_the_client_was_closed() -> None:
    async def main() -> None:
        with Stream("tcp", *[silent] * 2) as device:
            plc = holdfast.Client(device.url, timeout=wire.DEADLINE, max_in_flight=2)
            tasks = [asyncio.create_task(plc.read_coils(at, 1)) for at in range(4)]
            await asyncio.to_thread(device.await_requests, 2)

            await plc.close()

            for task in tasks:
                with pytest.raises(holdfast.ConnectionLost, match="closed by this side") as error:
                    await task
                assert error.value.maybe_sent == (task in tasks[:2])
            assert device.connections == 1
            assert await plc.read_holding_registers(7, 1) == [7]
            assert device.connections == 2
            assert len(device.requests) == 3
            await plc.close()

    run(main)


def test_calls_that_wait_for_a_connection_are_told_that_the_client_was_closed() -> None:
    async def main() -> None:
        with Stream("tcp") as device:
            plc = holdfast.Client(device.url, timeout=wire.DEADLINE, max_in_flight=2)
            tasks = [asyncio.create_task(plc.read_coils(at, 1)) for at in range(3)]
            await asyncio.sleep(0)

            await plc.close()

            for task in tasks:
                with pytest.raises(holdfast.ConnectionLost, match="closed by this side") as error:
                    await task
                assert not error.value.maybe_sent
            assert device.requests == []

    run(main)


def test_calls_that_wait_for_a_thread_are_told_that_the_client_was_closed() -> None:
    async def main() -> None:
        with Stream("rtu+tcp", silent) as device:
            plc = holdfast.Client(device.url, timeout=10 * wire.DEADLINE)
            tasks = [asyncio.create_task(plc.write_register(at, 1)) for at in range(3)]
            await asyncio.to_thread(device.await_requests, 1)

            await asyncio.wait_for(plc.close(), wire.DEADLINE)

            for task in tasks:
                with pytest.raises(holdfast.ConnectionLost, match="closed by this side") as error:
                    await task
                assert error.value.maybe_sent == (task is tasks[0])
            assert len(device.requests) == 1
            assert await plc.read_holding_registers(7, 1) == [7]
            await plc.close()

    run(main)


@pytest.mark.parametrize("kind", ["tcp", "rtu+tcp"])
def test_a_call_in_a_pause_is_told_that_it_was_not_sent(kind: str) -> None:
    async def main() -> None:
        with Stream(kind) as device:
            url = f"{device.url}?pause_after_connect=60"
            plc = holdfast.Client(url, timeout=10 * wire.DEADLINE)
            task = asyncio.create_task(plc.write_register(0, 1))
            await asyncio.to_thread(wire.until, lambda: device.is_connected, "it has connected")
            await asyncio.sleep(0)
            await plc.close()
            with pytest.raises(holdfast.ConnectionLost, match="closed by this side") as error:
                await task
            assert not error.value.maybe_sent
            assert device.requests == []

    run(main)


def test_a_call_whose_turn_comes_at_a_close_is_not_sent_after_it() -> None:
    async def main() -> None:
        with Stream("tcp", silent) as device:
            plc = holdfast.Client(device.url, timeout=wire.DEADLINE, max_in_flight=1)

            async def reads() -> None:
                await plc.read_holding_registers(0, 1)
                # The place is the writer's now, who does not know it yet.
                await plc.close()

            tasks = [asyncio.create_task(call) for call in (reads(), plc.write_register(1, 1))]
            await asyncio.to_thread(device.await_requests, 1)
            device.requests[0].answer()
            await tasks[0]
            with pytest.raises(holdfast.ConnectionLost, match="closed by this side") as error:
                await tasks[1]
            assert not error.value.maybe_sent
            assert (len(device.requests), device.connections) == (1, 1)

    run(main)


def test_a_call_that_waits_to_be_sent_again_ends_with_the_client() -> None:
    async def main() -> None:
        hangs_up = threading.Event()

        def hang_up(asked: Asked) -> None:
            asked.peer.hang_up()
            hangs_up.set()

        with Stream("tcp", hang_up) as device:
            plc = holdfast.Client(f"{device.url}?retries=3&pause=1", timeout=wire.DEADLINE)
            task = asyncio.create_task(plc.read_coils(0, 1))
            await asyncio.to_thread(hangs_up.wait, wire.DEADLINE)
            transport: Any = plc._transport
            here = transport._last
            while here.open is not None:
                await asyncio.sleep(0)
            await plc.close()
            with pytest.raises(holdfast.ConnectionLost, match="closed by this side"):
                await task
            assert (len(device.requests), device.connections) == (1, 1)

    run(main)


@pytest.mark.parametrize("kind", ["tcp", "rtu+tcp"])
def test_whoever_closes_a_client_may_be_cancelled(kind: str) -> None:
    async def main() -> None:
        problems: list[dict[str, Any]] = []
        asyncio.get_running_loop().set_exception_handler(lambda _, told: problems.append(told))
        with Stream(kind) as device:
            plc = holdfast.Client(device.url, timeout=wire.DEADLINE)
            await plc.read_coils(0, 1)
            task = asyncio.create_task(plc.close())
            await asyncio.sleep(0)
            await cancelled(task)
            await plc.close()
            assert await plc.read_holding_registers(7, 1) == [7]
            await plc.close()
        assert problems == []

    run(main)


def test_an_event_loop_may_end_before_a_close_that_was_cancelled(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async def main(device: Stream) -> None:
        plc = holdfast.Client(device.url, timeout=10 * wire.DEADLINE)
        writing = asyncio.create_task(plc.write_register(0, 1))
        await asyncio.to_thread(device.await_requests, 1)
        closing = asyncio.create_task(plc.close())
        await asyncio.sleep(0)
        await cancelled(closing)
        await cancelled(writing)

    with Stream("rtu+tcp", silent) as device:
        asyncio.run(main(device))
        wire.until(lambda: not device.is_connected, "it is closed")
    assert caplog.records == []


def test_a_client_is_closed_while_the_threads_of_the_application_are_busy() -> None:
    async def main() -> None:
        loop, go_on = asyncio.get_running_loop(), threading.Event()
        loop.set_default_executor(ThreadPoolExecutor(1))
        with Stream("rtu+tcp", silent) as device:
            plc = holdfast.Client(device.url, timeout=10 * wire.DEADLINE)
            writing = asyncio.create_task(plc.write_register(0, 1))
            await asyncio.to_thread(device.await_requests, 1)
            busy = loop.run_in_executor(None, go_on.wait)
            try:
                await asyncio.wait_for(plc.close(), wire.DEADLINE)
            finally:
                go_on.set()
                await busy
            with pytest.raises(holdfast.ConnectionLost, match="closed by this side"):
                await writing

    run(main)


def test_close_does_not_wait_for_a_call_that_begins_after_it() -> None:
    async def main() -> None:
        with Stream("rtu+tcp", silent) as device:
            device.then = silent
            plc = holdfast.Client(device.url, timeout=10 * wire.DEADLINE)
            before = asyncio.create_task(plc.write_register(0, 1))
            await asyncio.to_thread(device.await_requests, 1)
            closing = asyncio.create_task(plc.close())
            await asyncio.sleep(0)
            after = asyncio.create_task(plc.write_register(0, 2))
            await asyncio.wait_for(closing, wire.DEADLINE)
            with pytest.raises(holdfast.ConnectionLost, match="closed by this side"):
                await before
            await asyncio.to_thread(device.await_requests, 2)
            await plc.close()
            with pytest.raises(holdfast.ConnectionLost, match="closed by this side"):
                await after

    run(main)


def test_a_call_that_is_cancelled_before_its_first_byte_is_not_sent() -> None:
    with Stream("rtu+tcp") as device:
        client = BlockingClient(endpoints.endpoint(parse(device.url)))
        answers = iter([False, True])  # Before it connects, and before it sends.
        with pytest.raises(holdfast.ConnectionLost, match="closed by this side") as error:
            client.call(Request.write_register(0, 1), 1, wire.DEADLINE, lambda: next(answers))
        assert not error.value.maybe_sent
        assert client.call(Request.read("holding_registers", 7, 1), 1, wire.DEADLINE) == [7]
        assert [asked.pdu[0] for asked in device.requests] == [3]


def test_a_call_that_is_cancelled_in_a_pause_ends_before_it() -> None:
    with Stream("rtu+tcp") as device:
        target = parse(f"{device.url}?pause_after_connect=10")
        client = BlockingClient(endpoints.endpoint(target))
        # Not before it connects, nor the second time. Without an end in the pause, that is when it
        # is sent.
        answers = itertools.chain([False, False], itertools.repeat(True))
        with pytest.raises(holdfast.ConnectionLost, match="closed by this side") as error:
            client.call(Request.write_register(0, 1), 1, wire.DEADLINE, lambda: next(answers))
        assert not error.value.maybe_sent
        assert device.requests == []


def test_a_call_that_closes_its_client_ends_the_calls_of_all_threads() -> None:
    with Stream("tcp", silent) as device, ThreadPoolExecutor(1) as executor:
        client = BlockingClient(endpoints.endpoint(parse(device.url)))
        write = Request.write_register(0, 1)

        def close() -> bool:  # Asked while its call waits for its turn.
            client.close()
            return False

        first = executor.submit(client.call, write, 1, 4 * wire.DEADLINE)
        device.await_requests(1)
        with pytest.raises(holdfast.ConnectionLost) as waiting:
            client.call(write, 1, wire.DEADLINE, close)
        with pytest.raises(holdfast.ConnectionLost) as sent:
            first.result(wire.DEADLINE)
        assert (waiting.value.maybe_sent, sent.value.maybe_sent) == (False, True)
        assert client.call(Request.read("holding_registers", 7, 1), 1, wire.DEADLINE) == [7]
        assert len(device.requests) == device.connections == 2


def test_a_pause_before_the_next_connection_may_be_longer_than_the_timeout(dial: Dial) -> None:
    def hang_up(asked: Asked) -> None:
        asked.answer()
        asked.peer.hang_up()

    with Stream("tcp", hang_up) as device:
        client = dial(f"{device.url}?reconnect=0.4", timeout=0.1)
        assert client.read_holding_registers(7, 1) == [7]
        failures = 0
        while True:
            try:
                assert client.read_holding_registers(8, 1) == [8]
                break
            except holdfast.ModbusError:
                failures += 1
                assert failures < 100
        # On a loaded machine, a reply may come too late.
        assert 2 <= device.connections <= len(device.requests)


# Event loops


@pytest.mark.parametrize("device", ["tcp", "udp"], indirect=True)
def test_a_client_serves_one_event_loop_after_the_other(device: Device) -> None:
    device.memory.write("holding_registers", 7, [42])
    plc = holdfast.Client(device.url, timeout=wire.DEADLINE)

    async def main() -> None:
        assert await plc.read_holding_registers(7, 1) == [42]
        await plc.close()

    for _ in range(3):
        run(main)


def test_a_client_that_was_not_closed_begins_anew_when_its_event_loop_is_closed(
    server: holdfast.Server,
) -> None:
    plc = holdfast.Client(url_of(server), timeout=wire.DEADLINE)

    async def main() -> None:
        assert await plc.read_holding_registers(0, 1) == [0]

    run(main)
    # What was forgotten is asyncio's to tell.
    with warnings.catch_warnings(record=True, action="always") as told:
        run(main)
        run(plc.close)
        gc.collect()
    assert {warning.category for warning in told} == {ResourceWarning}
    assert any("unclosed transport" in str(warning.message) for warning in told)


@pytest.mark.parametrize("url", ["tcp://127.0.0.1", "udp://127.0.0.1"])
def test_a_copy_that_fails_says_so_once(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    reported: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda found: reported.append(found.exc_value))
    with pytest.raises(TypeError, match="cannot pickle"):
        copy.deepcopy(holdfast.Client(url))
    gc.collect()
    assert reported == []


@pytest.fixture
def no_collector() -> Iterator[None]:
    """Cycles stay, with what they have open."""
    gc.collect()
    gc.disable()
    yield
    gc.enable()
    with warnings.catch_warnings(action="ignore"):  # asyncio warns of its transports.
        gc.collect()


@pytest.mark.usefixtures("no_collector")
def test_a_client_leaves_no_connection_in_an_event_loop_that_is_closed() -> None:
    # A device for one connection at a time.
    with Stream("tcp", in_turn=True) as device:
        plc = holdfast.Client(device.url, timeout=wire.DEADLINE)
        for _ in range(2):
            with asyncio.Runner() as runner:
                assert runner.run(plc.read_holding_registers(7, 1)) == [7]
        assert device.connections == 2
        with pytest.warns(ResourceWarning, match=f"unclosed client of {device.url}"):
            del plc
        wire.until(lambda: not device.is_connected, "it is closed")


@pytest.mark.parametrize("is_connected", [True, False])
def test_a_client_that_nobody_has_any_more_is_closed_in_its_event_loop(is_connected: bool) -> None:
    def forget(clients: list[holdfast.Client]) -> None:
        clients.clear()
        gc.collect()

    async def main() -> None:
        with Stream("tcp") as device:
            clients = [holdfast.Client(device.url, timeout=wire.DEADLINE)]
            reading = asyncio.create_task(clients[0].read_coils(0, 1))
            if is_connected:
                await reading
            else:
                await asyncio.sleep(0)  # It begins to connect.
                await cancelled(reading)
                await asyncio.sleep(0)  # The loop forgets it.
            del reading
            with pytest.warns(ResourceWarning, match=f"unclosed client of {device.url}"):
                forget(clients)
            async with asyncio.timeout(wire.DEADLINE):
                while device.is_connected or len(asyncio.all_tasks()) > 1:
                    await asyncio.sleep(0.01)

    run(main)


def test_a_client_with_a_thread_that_nobody_has_any_more_is_closed() -> None:
    def forget(clients: list[holdfast.Client]) -> None:
        clients.clear()
        gc.collect()

    async def main() -> None:
        with Stream("rtu+tcp", silent) as device:
            clients = [holdfast.Client(device.url, timeout=10 * wire.DEADLINE)]
            writing = asyncio.create_task(clients[0].write_register(0, 1))
            await asyncio.to_thread(device.await_requests, 1)
            await cancelled(writing)
            await asyncio.sleep(0)  # The loop forgets it.
            del writing
            with pytest.warns(ResourceWarning, match=re.escape(f"unclosed client of {device.url}")):
                forget(clients)
            await asyncio.to_thread(wire.until, lambda: not device.is_connected, "it is closed")

    run(main)


def test_a_client_that_was_closed_ends_without_a_warning(server: holdfast.Server) -> None:
    async def main() -> None:
        async with holdfast.Client(url_of(server), timeout=wire.DEADLINE) as plc:
            await plc.read_coils(0, 1)
        del plc
        gc.collect()

    run(main)


@pytest.mark.parametrize("kind", ["tcp", "rtu+tcp", "udp"])
def test_a_client_is_in_use_in_one_event_loop_only(
    kind: str, memory: holdfast.Memory, serve: Serve
) -> None:
    host, port = serve({1: memory}, bind=f"{kind}://127.0.0.1:0").address
    plc = holdfast.Client(f"{kind}://{host}:{port}", timeout=wire.DEADLINE)

    async def read() -> list[int]:
        return await plc.read_holding_registers(0, 1)

    with asyncio.Runner() as one, asyncio.Runner() as other:
        one.run(read())
        with pytest.raises(RuntimeError, match="in use in another event loop"):
            other.run(read())
        with pytest.raises(RuntimeError, match="in use in another event loop"):
            other.run(plc.close())
        assert one.run(read()) == [0]
        one.run(plc.close())
        assert other.run(read()) == [0]
        other.run(plc.close())


def test_a_client_may_be_used_after_its_event_loop_was_closed(
    memory: holdfast.Memory, serve: Serve
) -> None:
    host, port = serve({1: memory}, bind="udp://127.0.0.1:0").address
    plc = holdfast.Client(f"udp://{host}:{port}", timeout=wire.DEADLINE)
    assert asyncio.run(plc.read_coils(0, 1)) == [False]

    async def main() -> None:
        async with plc:
            assert await plc.read_coils(0, 1) == [False]

    run(main)


def test_a_client_runs_in_uvloop(server: holdfast.Server) -> None:
    uvloop = pytest.importorskip("uvloop", reason="there is none for Windows")

    async def main() -> None:
        async with holdfast.Client(url_of(server), timeout=wire.DEADLINE) as plc:
            assert await plc.read_holding_registers(0, 1) == [0]

    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        runner.run(main())


def test_the_event_loop_is_not_held_up_by_other_transports() -> None:
    async def main() -> None:
        with Stream("rtu+tcp", silent) as device:
            async with holdfast.Client(device.url, timeout=0.3) as plc:
                task = asyncio.create_task(plc.read_coils(0, 1))
                turns = 0
                while not task.done():
                    await asyncio.sleep(0)
                    turns += 1
                with pytest.raises(holdfast.RequestTimeout):
                    await task
                assert turns > 10

    run(main)


# Signals


@pytest.mark.parametrize("kind", ["tcp", "rtu+tcp", "udp"])
def test_a_signal_does_not_end_a_call(kind: str) -> None:
    beats = itertools.count()
    before = signal.signal(signal.SIGALRM, lambda *_: next(beats))
    try:
        with device_of(kind, then=silent) as device:
            signal.setitimer(signal.ITIMER_REAL, 0.02, 0.02)
            began = time.monotonic()
            with (
                holdfast.SyncClient(device.url, timeout=0.3) as plc,
                pytest.raises(holdfast.RequestTimeout),
            ):
                plc.write_register(0, 1)
            assert time.monotonic() - began >= 0.3
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert next(beats) > 0


# The page

PAGE = DOCS / "client.md"


@pytest.fixture
def page(serve: Serve) -> str:
    """The page, with a server where it says that there is one."""
    memory = holdfast.Memory(coils=64, holding_registers=200)
    memory.write("holding_registers", 0, [11, 22, 33])
    identity = Identity(vendor_name="Acme", product_code="P1", revision="1.2")
    host, port = serve({1: memory}, identity=identity).address
    return PAGE.read_text().replace("127.0.0.1:5020", f"{host}:{port}")


def test_the_examples_of_the_page_print_what_it_says(page: str) -> None:
    blocks = re.findall(r"^```pycon\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    examples = doctest.DocTestParser().get_doctest("\n".join(blocks), {}, PAGE.name, str(PAGE), 0)
    told: list[str] = []

    results = doctest.DocTestRunner().run(examples, out=told.append)

    assert told == []
    assert results.attempted == 8


def test_the_program_of_the_page_prints_what_it_says(
    page: str, capsys: pytest.CaptureFixture[str]
) -> None:
    [(program, printed)] = re.findall(
        r"^```python\n(.*?)^```\n\nprints\n\n```text\n(.*?)^```$", page, re.MULTILINE | re.DOTALL
    )

    exec(compile(program, PAGE.name, "exec"), {})

    assert capsys.readouterr().out == printed

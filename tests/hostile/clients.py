"""What asks devices: each class puts questions to a device, and reports the results to a judge."""

from __future__ import annotations

import itertools
import struct
import threading
from abc import ABC, abstractmethod
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import holdfast
from holdfast._core import PolledDevice, Poller, Request
from holdfast.appliance import Appliance
from holdfast.client.endpoint import endpoint
from holdfast.client.url import NetworkTarget, parse
from holdfast.config import load
from hostile.devices import ADDRESSES, COUNT, UNITS, VERSIONS, WRITABLE
from hostile.judge import Question
from support import gateways, web, wire
from support.faces import Awaited
from support.polled import configuration as polled_configuration
from support.polled import device as polled_device
from support.polled import read as polled_read
from support.routed import LOOPBACK, configuration
from support.running import endpoint as listening
from support.shared import GATEWAY

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path
    from types import TracebackType
    from typing import ClassVar, Self

    from holdfast.types import Area
    from hostile.devices import Device
    from hostile.judge import Judge

RETRY = {"first": 0.02, "most": 0.05}
"""Seconds between attempts to reach a device that does not answer."""


BASE = 32
"""Where the second device of a poller is in memory."""

BLOCKS: list[tuple[Area, int]] = [
    *[("holding_registers", address) for address in (0, 4, 8, 12)],
    ("input_registers", 2),
]
"""What a poller reads: so far apart that each is a request."""


def readable() -> Iterator[tuple[int, int, int]]:
    """Units, functions and addresses of reads. Most are of the same unit and function."""
    for number in itertools.count():
        unit = UNITS[1] if number % 7 == 5 else UNITS[0]
        function = 4 if number % 5 == 3 else 3
        yield unit, function, ADDRESSES[number % len(ADDRESSES)]


def writable() -> Iterator[tuple[int, int, int]]:
    """Units, addresses and values of writes. No value comes twice."""
    for value in itertools.count(1):
        yield UNITS[0], WRITABLE[value % len(WRITABLE)], value & 0xFFFF


class Asking(ABC):
    """A client of a device. It runs while it is entered."""

    kinds: ClassVar[tuple[str, ...]] = (
        "tcp", "udp", "rtu+tcp", "rtu", "rtu+udp", "ascii+tcp", "ascii",
    )  # fmt: skip
    """The transports that it has."""

    def __init__(self, device: Device, judge: Judge, folder: Path) -> None:
        self.device = device
        self.judge = judge
        self.folder = folder
        self.timeout = device.timeout
        self.stack = ExitStack()
        self.reads = readable()
        self.writes = writable()
        self.steps = 0
        self.lock = threading.Lock()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stack.close()

    def step(self) -> None:
        """Puts some questions."""
        self._put_one()

    def _put_one(self) -> None:
        """Puts a question, in any thread. Every fifth one writes."""
        with self.lock:
            self.steps += 1
            number = self.steps
            asked = next(self.writes if number % 5 == 0 else self.reads)
        if number % 5 == 0:
            self._write(*asked, many=number % 2 == 0)
        else:
            self._read(*asked)

    @abstractmethod
    def start(self) -> None:
        """Connects to the device."""

    def ask(self, unit: int, function: int, address: int) -> list[int]:
        """Reads. Raises `holdfast.ModbusError`."""
        raise NotImplementedError

    def write(self, unit: int, address: int, value: int, *, many: bool) -> None:
        """Writes one register, with function 16 if `many`. Raises `holdfast.ModbusError`."""
        raise NotImplementedError

    def _read(self, unit: int, function: int, address: int) -> None:
        question = Question(unit, function, address, self.device.received)
        try:
            values = self.ask(unit, function, address)
        except holdfast.ModbusError:
            self.judge.error()
        else:
            self.judge.read(question, values)

    def _write(self, unit: int, address: int, value: int, *, many: bool) -> None:
        try:
            self.write(unit, address, value, many=many)
        except holdfast.ModbusError:
            self.judge.write(unit, address, value, is_confirmed=False)
        else:
            self.judge.write(unit, address, value, is_confirmed=True)


def asked_of(client: Any, unit: int, function: int, address: int) -> list[int]:
    read = client.read_holding_registers if function == 3 else client.read_input_registers
    values: list[int] = read(address, COUNT, unit=unit)
    return values


def written_to(client: Any, unit: int, address: int, value: int, many: bool) -> None:
    if many:
        client.write_registers(address, [value], unit=unit)
    else:
        client.write_register(address, value, unit=unit)


class Blocking(Asking):
    """The blocking client."""

    options: ClassVar[str] = ""

    def start(self) -> None:
        url = self.device.url
        if self.options:
            url += ("&" if "?" in url else "?") + self.options
        self.client = self.stack.enter_context(holdfast.SyncClient(url, timeout=self.timeout))

    def ask(self, unit: int, function: int, address: int) -> list[int]:
        return asked_of(self.client, unit, function, address)

    def write(self, unit: int, address: int, value: int, *, many: bool) -> None:
        written_to(self.client, unit, address, value, many)


class Retrying(Blocking):
    """The blocking client, which sends reads again."""

    options = "retries=1"


class Hurried(Blocking):
    """The blocking client, some of whose calls have little time."""

    def step(self) -> None:
        self.client.timeout = self.timeout / (8 if self.steps % 3 == 0 else 1)
        super().step()


class Together(Blocking):
    """The blocking client, in several threads."""

    def start(self) -> None:
        super().start()
        self.threads = self.stack.enter_context(ThreadPoolExecutor(3))

    def step(self) -> None:
        list(self.threads.map(lambda _: self._put_one(), range(3)))


class Pipelined(Asking):
    """The asyncio client, with several requests in flight where the transport allows it."""

    def start(self) -> None:
        self.client = Awaited(self.device.url, timeout=self.timeout, max_in_flight=3)
        self.stack.callback(self.client.end)
        self.threads = self.stack.enter_context(ThreadPoolExecutor(3))

    def step(self) -> None:
        list(self.threads.map(lambda _: self._put_one(), range(3)))

    def ask(self, unit: int, function: int, address: int) -> list[int]:
        return asked_of(self.client, unit, function, address)

    def write(self, unit: int, address: int, value: int, *, many: bool) -> None:
        written_to(self.client, unit, address, value, many)


class Polled(Asking):
    """The native poller: two devices on one link into a memory, which write as well."""

    def start(self) -> None:
        self.memory = holdfast.Memory(holding_registers=64, input_registers=64)
        self.poller = Poller([])
        self.stack.callback(self.poller.stop)
        self.results = self.poller.new_receiver()
        self.pending: dict[int, tuple[int, int, int]] = {}
        self.last = dict.fromkeys(UNITS, 0)
        """The number of the last request of each device that had a valid reply."""
        self.stored: dict[tuple[int, Area, int], list[int]] = {}
        for unit in UNITS:
            self.poller.add(self._device(unit))

    def _device(self, unit: int) -> PolledDevice:
        base = BASE * (unit - 1)
        reads: list[Any] = [
            (area, address, COUNT, (self.memory, area, base + address, None))
            for area, address in BLOCKS
        ]
        return PolledDevice(
            str(unit),
            endpoint(parse(self.device.url)),
            unit=unit,
            interval=0.001,
            timeout=self.timeout,
            reads=reads,
            start_within=0.0,
            receiver=self.results,
            retry=(RETRY["first"], RETRY["most"]),
        )

    def step(self) -> None:
        self.steps += 1
        if self.steps % 5 == 0 and not self.pending:
            unit, address, value = next(self.writes)
            write = Request.write_register(address, value)
            number = self.poller.write(str(unit), write, self.results)
            self.pending[number] = (unit, address, value)
        found = self.results.take(self.timeout)
        assert found is not None, "the poller runs"
        polls, writes = found
        for name, _, blocks in polls:
            for area, address, _, data, *_ in blocks:
                self._judge(int(name), area, address, data)
        for number, fault in writes:
            self.judge.write(*self.pending.pop(number), is_confirmed=fault == 0)
        self._judge_memory()

    def _judge(self, unit: int, area: Area, address: int, data: bytes | None) -> None:
        """Judges a block of a poll. Requests of a device follow each other, so versions grow."""
        if data is None:
            return self.judge.error()
        values = list(struct.unpack(f">{len(data) // 2}H", data))
        function = 4 if area == "input_registers" else 3
        self.judge.read(Question(unit, function, address, self.last[unit]), values)
        received = self.device.received
        self.last[unit] = received - (received - values[0]) % VERSIONS
        return None

    def _judge_memory(self) -> None:
        """Judges what the memory holds: it changes only to values that are right."""
        for unit in UNITS:
            for area, address in BLOCKS:
                values = self.memory.read(area, BASE * (unit - 1) + address, COUNT)
                function = 4 if area == "input_registers" else 3
                place = unit, area, address
                if any(values) and values != self.stored.get(place):
                    self.stored[place] = values
                    self.judge.read(Question(unit, function, address, 0), values)


class Behind(Asking):
    """An appliance before the device, asked by two clients at the same time."""

    def start(self) -> None:
        file = self.folder / f"{type(self).__name__}{id(self)}.yaml"
        file.write_text(self.configuration())
        self.appliance = self.stack.enter_context(Appliance(load(file)))
        host, port = listening(self.appliance, "scada")
        front = f"tcp://{host}:{port}"
        self.clients = [
            self.stack.enter_context(holdfast.SyncClient(front, timeout=wire.DEADLINE))
            for _ in range(2)
        ]
        self.threads = self.stack.enter_context(ThreadPoolExecutor(2))
        self.client = threading.local()

    @abstractmethod
    def configuration(self) -> str:
        """Returns the configuration of the appliance, with the listener `scada`."""

    def step(self) -> None:
        list(self.threads.map(self._step_with, self.clients))

    def _step_with(self, client: holdfast.SyncClient) -> None:
        self.client.front = client
        self._put_one()

    def ask(self, unit: int, function: int, address: int) -> list[int]:
        return asked_of(self.client.front, unit, function, address)

    def write(self, unit: int, address: int, value: int, *, many: bool) -> None:
        written_to(self.client.front, unit, address, value, many)


class Routed(Behind):
    """A listener that passes requests on to the device."""

    def configuration(self) -> str:
        link = {"timeout": self.timeout, "retry": RETRY}
        return configuration(self.device.url, link=link)


class Passed(Behind):
    """Writes into ranges of a memory that are read from the device, which are passed on to it."""

    def configuration(self) -> str:
        rule = {"sources": LOOPBACK, "units": {1: "mirror"}, "access": "read-write"}
        listener = {"type": "modbus-tcp", "bind": "127.0.0.1:0", "rules": [rule]}
        reads = [
            polled_read("holding_registers", 0, COUNT, ("holding_registers", 0)),
            polled_read("holding_registers", 100, 8, ("holding_registers", 100)),
        ]
        meter = polled_device(
            self.device.url, *reads, unit=UNITS[0], timeout=self.timeout, interval=self.timeout / 2,
            writes="pass", retry=RETRY,
        )  # fmt: skip
        return polled_configuration({"meter": meter}, listeners={"scada": listener})

    def _step_with(self, client: holdfast.SyncClient) -> None:
        self.client.front = client
        with self.lock:
            self.steps += 1
            number, written = self.steps, next(self.writes)
        self._write(*written, many=number % 2 == 0)
        values = self.appliance.memories["mirror"].read("holding_registers", 0, COUNT)
        if any(values):
            self.judge.read(Question(UNITS[0], 3, 0, 0), values)


class OverHttp(Asking):
    """The HTTP gateway, over its own connection. Some requests have another timeout."""

    kinds = ("tcp", "udp", "rtu+tcp", "rtu+udp", "ascii+tcp")

    def start(self) -> None:
        running = self.stack.enter_context(gateways.running())
        self.http = running.client()

    def ask(self, unit: int, function: int, address: int) -> list[int]:
        asked = {"functionCode": function, "address": address, "quantity": COUNT}
        values: list[int] = self._done("/read", unit, **asked)["values"]
        return values

    def write(self, unit: int, address: int, value: int, *, many: bool) -> None:
        if many:
            self._done("/write/registers", unit, address=address, values=[value])
        else:
            self._done("/write/register", unit, address=address, value=value)

    def _done(self, path: str, unit: int, **body: Any) -> Any:
        target = parse(self.device.url)
        assert isinstance(target, NetworkTarget)
        # It covers all that is waited for.
        timeout = round(1000 * self.timeout * (1 if self.steps % 3 == 0 else 6))
        where = {"host": target.host, "port": target.port, "transport": target.transport}
        answer = self.http.ask(
            "POST", gateways.API + path, {**where, "unitId": unit, "timeout": timeout, **body}
        )
        assert answer.status != 400, answer.json
        if not answer.json["success"]:
            raise holdfast.ModbusError(answer.json["error"])
        return answer.json


class Shared(OverHttp):
    """The gateway of an appliance over a link that is polled, and that its listener uses."""

    def start(self) -> None:
        file = self.folder / f"shared{id(self)}.yaml"
        file.write_text(self._configuration())
        self.appliance = self.stack.enter_context(Appliance(load(file)))
        self.http = web.Client(listening(self.appliance, "gateway"))
        self.stack.callback(self.http.close)
        host, port = listening(self.appliance, "scada")
        front = holdfast.SyncClient(f"tcp://{host}:{port}", timeout=wire.DEADLINE)
        self.front = self.stack.enter_context(front)
        self.threads = self.stack.enter_context(ThreadPoolExecutor(2))
        self.is_http = threading.local()

    def _configuration(self) -> str:
        into = ("holding_registers", 0)
        meter = polled_device(
            self.device.url, polled_read("holding_registers", 12, COUNT, into), unit=UNITS[0],
            timeout=self.timeout, interval=self.timeout / 3, retry=RETRY,
        )  # fmt: skip
        link = {"timeout": self.timeout, "retry": RETRY}
        more: dict[str, Any] = {
            "devices": {"meter": meter},
            "memories": {"mirror": {"holding_registers": 16}},
        }
        return configuration(self.device.url, link=link, gateway=GATEWAY, **more)

    def step(self) -> None:
        list(self.threads.map(self._step_over, (True, False)))
        values = self.appliance.memories["mirror"].read("holding_registers", 0, COUNT)
        if any(values):
            self.judge.read(Question(UNITS[0], 3, 12, 0), values)

    def _step_over(self, is_http: bool) -> None:
        self.is_http.here = is_http
        self._put_one()

    def ask(self, unit: int, function: int, address: int) -> list[int]:
        if self.is_http.here:
            return super().ask(unit, function, address)
        return asked_of(self.front, unit, function, address)

    def write(self, unit: int, address: int, value: int, *, many: bool) -> None:
        if self.is_http.here:
            super().write(unit, address, value, many=many)
        else:
            written_to(self.front, unit, address, value, many)


CLIENTS: tuple[type[Asking], ...] = (
    Blocking, Pipelined, Polled, Routed, Passed, OverHttp, Shared, Retrying, Hurried, Together,
)  # fmt: skip
"""All of them; the first has every mode in the short form."""

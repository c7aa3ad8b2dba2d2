"""Devices for the poller that answer as a test defines, and parsing of status blocks."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
import threading
from collections import Counter
from typing import TYPE_CHECKING, Any, NamedTuple

from support import wire
from support.brokers import free_port
from support.config_folder import written
from support.fake_device import Stream, Udp

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from types import TracebackType
    from typing import Self

    import holdfast
    from holdfast.appliance import Appliance
    from holdfast.types import Area
    from support.fake_device import Asked

    Answer = Callable[[wire.Frame], bytes | None]

AREAS = {
    "coils": 1,
    "discrete_inputs": 2,
    "holding_registers": 3,
    "input_registers": 4,
}
"""The function code that reads each area."""


def reply(request: wire.Frame, pdu: bytes) -> bytes:
    return wire.frame(pdu, request.unit, request.transaction)


def asked(request: wire.Frame | Asked) -> tuple[int, int]:
    """Parses the address and the count of a read request."""
    address, count = struct.unpack(">HH", request.pdu[1:5])
    return address, count


def data(request: wire.Frame, value: int = 0) -> bytes:
    """Builds the reply to a read: all items have one value."""
    _, count = asked(request)
    if request.pdu[0] <= 2:
        bits = bytes([0xFF * (value & 1)]) * ((count + 7) // 8)
        return reply(request, bytes([request.pdu[0], len(bits)]) + bits)
    return reply(request, bytes([request.pdu[0], 2 * count]) + value.to_bytes(2) * count)


def exception(request: wire.Frame, code: int) -> bytes:
    return reply(request, bytes([request.pdu[0] | 0x80, code]))


class Fake(Stream):
    """Answers requests with a function, on any number of connections. Can stop and restart."""

    is_modelled = False

    def __init__(self, answer: Answer) -> None:
        super().__init__("tcp", then=self._reply, port=free_port())
        self.answer = answer
        self.by_unit: Counter[int] = Counter()

    def _reply(self, asked: Asked) -> None:
        self.by_unit[asked.unit] += 1
        asked.end_with(self.answer(wire.Frame(asked.transaction, asked.unit, asked.pdu)))


class Datagrams(Udp):
    """Answers requests over UDP with a function, one by one."""

    is_modelled = False

    def __init__(self, answer: Answer) -> None:
        super().__init__(then=self._reply)
        self._answer = answer

    def _reply(self, asked: Asked) -> None:
        asked.end_with(self._answer(wire.Frame(asked.transaction, asked.unit, asked.pdu)))


class Receiver:
    """Receives Raw Ingest packets one by one. Calls `taken` with each before it answers."""

    def __init__(self, taken: Callable[[bytes], object]) -> None:
        self._taken = taken
        self._listening = socket.create_server(("127.0.0.1", 0))
        self._thread = threading.Thread(target=self._serve, name="receiver")

    @property
    def url(self) -> str:
        return f"raw://127.0.0.1:{self._listening.getsockname()[1]}"

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._listening.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._listening.close()

    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self._listening.accept()
            except OSError:
                return
            with connection, contextlib.suppress(OSError):
                self._taken(connection.recv(65536))
                connection.sendall(b"\0")


class Pymodbus:
    """A pymodbus server in its own thread."""

    def __init__(self, devices: Any) -> None:
        self._devices = devices
        self.port = free_port()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="pymodbus")

    @property
    def url(self) -> str:
        return f"tcp://127.0.0.1:{self.port}"

    def __enter__(self) -> Self:
        self._thread.start()
        self._server = self._run(self._started())
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._run(self._server.shutdown())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _started(self) -> Any:
        from pymodbus.server import ModbusTcpServer

        server = ModbusTcpServer(self._devices, address=("127.0.0.1", self.port))
        await server.serve_forever(background=True)
        return server

    def _run(self, work: Any) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(wire.DEADLINE)


class Status(NamedTuple):
    """A status block."""

    health: int
    last_error: int
    seconds_in_error: int
    name: bytes
    reserved: tuple[int, ...]
    polls: int
    good_polls: int
    timeouts: int
    transport_errors: int
    failures: int
    most_failures: int


def status(memory: holdfast.Memory, slot: int = 0, area: Area = "input_registers") -> Status:
    """Parses a status block in a memory."""
    told = memory.read(area, slot * 30, 30)
    health, last_error, seconds = told[:3]
    name = struct.pack(">8H", *told[3:11])
    pairs = zip(told[20:28:2], told[21:28:2], strict=True)
    polls, good_polls, timeouts, transport = (low + (high << 16) for low, high in pairs)
    return Status(
        health, last_error, seconds, name, tuple(told[11:20]),
        polls, good_polls, timeouts, transport, told[28], told[29],
    )  # fmt: skip


def read(
    area: str, address: int, count: int, into: tuple[str, int] | None = None
) -> dict[str, Any]:
    """Builds the configuration of a read, optionally into the memory `mirror`."""
    made: dict[str, Any] = {"area": area, "address": address, "count": count}
    if into is not None:
        made["into"] = {"memory": "mirror", "area": into[0], "address": into[1]}
    return made


def device(url: str, *reads: dict[str, Any], unit: int = 1, **more: Any) -> dict[str, Any]:
    """Builds the configuration of a device with a short interval and a long time until stale."""
    often = {"interval": 0.02, "timeout": 5}
    return {"url": url, "unit": unit, **often, "reads": list(reads), **more}


def block(slot: int, **more: Any) -> dict[str, Any]:
    """Builds the settings of a status block."""
    return {"memory": "status", "area": "input_registers", "slot": slot, **more}


def configuration(devices: dict[str, Any], **more: Any) -> str:
    """Builds a configuration with the memories `mirror` and `status`."""
    areas = dict.fromkeys(AREAS, 65536)
    memories = {"mirror": areas, "status": {"input_registers": 30 * max(len(devices), 1)}}
    return written({"memories": memories, "devices": devices, **more})


def counters(appliance: Appliance, name: str) -> dict[str, Any]:
    """Returns the counters of a device."""
    told: dict[str, Any] = appliance.diagnostics.stats()["devices"][name]
    return told


def until_polled(appliance: Appliance, name: str, more: int = 3) -> None:
    """Waits for so many polls that start after the call and finish."""
    enough = counters(appliance, name)["polls"] + more + 1
    wire.until(lambda: counters(appliance, name)["polls"] >= enough, f"{name} is polled")


@contextlib.contextmanager
def in_background(work: Callable[[], object]) -> Iterator[None]:
    """Repeats a call in a thread. Raises the exceptions of the call here."""
    stop = threading.Event()
    failed: list[BaseException] = []

    def run() -> None:
        try:
            while not stop.is_set():
                work()
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
    if failed:
        raise failed[0]


def uniform(values: Iterable[int]) -> bool:
    return len(set(values)) == 1

"""Devices to be polled, that answer as a test wants; and what a status block tells."""

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

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from types import TracebackType
    from typing import Self

    import holdfast
    from holdfast.appliance import Appliance

    Answer = Callable[[wire.Frame], bytes | None]

HANG_UP = b""
"""In place of an answer: the connection is closed."""

AREAS = {
    "coils": 1,
    "discrete_inputs": 2,
    "holding_registers": 3,
    "input_registers": 4,
}
"""The function that reads each area."""


def reply(request: wire.Frame, pdu: bytes) -> bytes:
    return wire.frame(pdu, request.unit, request.transaction)


def asked(request: wire.Frame) -> tuple[int, int]:
    """The address and count of a read."""
    address, count = struct.unpack(">HH", request.pdu[1:5])
    return address, count


def data(request: wire.Frame, value: int = 0) -> bytes:
    """The answer to a read: all items of one value."""
    _, count = asked(request)
    if request.pdu[0] <= 2:
        bits = bytes([0xFF * (value & 1)]) * ((count + 7) // 8)
        return reply(request, bytes([request.pdu[0], len(bits)]) + bits)
    return reply(request, bytes([request.pdu[0], 2 * count]) + value.to_bytes(2) * count)


def exception(request: wire.Frame, code: int) -> bytes:
    return reply(request, bytes([request.pdu[0] | 0x80, code]))


class Fake:
    """Answers the requests of any number of connections by a function; it can go and come back."""

    def __init__(self, answer: Answer) -> None:
        self.answer = answer
        self.port = free_port()
        self.requests: list[wire.Frame] = []
        self.by_unit: Counter[int] = Counter()
        self.connections = 0
        self._open: list[socket.socket] = []
        self._threads: list[threading.Thread] = []
        self._listening: socket.socket | None = None

    @property
    def url(self) -> str:
        return f"tcp://127.0.0.1:{self.port}"

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    def start(self) -> None:
        self._listening = socket.create_server(("127.0.0.1", self.port))
        self._run(self._accept, self._listening)

    def stop(self) -> None:
        """Ends all connections and listens no more."""
        if self._listening is not None:
            with contextlib.suppress(OSError):
                self._listening.shutdown(socket.SHUT_RDWR)
            # The first thread accepts connections: after its end there are no more.
            self._threads.pop(0).join()
            self._listening.close()
            self._listening = None
        for each in self._open:
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
        while self._threads:
            self._threads.pop().join()
        self._open.clear()

    def _run(self, work: Callable[[socket.socket], None], of: socket.socket) -> None:
        thread = threading.Thread(target=work, args=(of,), name="fake")
        self._threads.append(thread)
        thread.start()

    def _accept(self, listening: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while True:
                connection, _ = listening.accept()
                self.connections += 1
                self._open.append(connection)
                self._run(self._talk, connection)

    def _talk(self, connection: socket.socket) -> None:
        received = b""
        with connection, contextlib.suppress(OSError):
            while piece := connection.recv(65536):
                whole, received = wire.split(received + piece)
                for request in whole:
                    self.requests.append(request)
                    self.by_unit[request.unit] += 1
                    answer = self.answer(request)
                    if answer == HANG_UP:
                        return
                    if answer is not None:
                        connection.sendall(answer)


class Datagrams:
    """Answers requests over UDP by a function, one after the other."""

    def __init__(self, answer: Callable[[wire.Frame], bytes]) -> None:
        self._answer = answer
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._thread = threading.Thread(target=self._serve, name="fake")

    @property
    def url(self) -> str:
        return f"udp://127.0.0.1:{self._socket.getsockname()[1]}"

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as last:
            last.sendto(b"", self._socket.getsockname())
        self._thread.join()
        self._socket.close()

    def _serve(self) -> None:
        while True:
            received, peer = self._socket.recvfrom(65536)
            if not received:
                return
            [request], _ = wire.split(received)
            self._socket.sendto(self._answer(request), peer)


class Receiver:
    """Takes Raw Ingest packets, one after the other; `taken` is called with each before it is
    answered.
    """

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
    """A server of pymodbus in a thread of its own."""

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
    requests: int
    valid: int
    timeouts: int
    transport_errors: int
    failures: int
    most_failures: int


def status(memory: holdfast.Memory, slot: int = 0) -> Status:
    """What a block in the input registers of a memory tells."""
    told = memory.read("input_registers", slot * 30, 30)
    health, last_error, seconds = told[:3]
    name = struct.pack(">8H", *told[3:11])
    pairs = zip(told[20:28:2], told[21:28:2], strict=True)
    requests, valid, timeouts, transport = (low + (high << 16) for low, high in pairs)
    return Status(
        health, last_error, seconds, name, tuple(told[11:20]),
        requests, valid, timeouts, transport, told[28], told[29],
    )  # fmt: skip


def read(
    area: str, address: int, count: int, into: tuple[str, int] | None = None
) -> dict[str, Any]:
    """A read, perhaps into the memory `mirror`."""
    made: dict[str, Any] = {"area": area, "address": address, "count": count}
    if into is not None:
        made["into"] = {"memory": "mirror", "area": into[0], "address": into[1]}
    return made


def device(url: str, *reads: dict[str, Any], unit: int = 1, **more: Any) -> dict[str, Any]:
    """A device that is polled often, and not soon out of date."""
    often = {"interval": 0.02, "timeout": 5}
    return {"url": url, "unit": unit, **often, "reads": list(reads), **more}


def block(slot: int) -> dict[str, Any]:
    """The place of a status block."""
    return {"memory": "status", "area": "input_registers", "slot": slot}


def configuration(devices: dict[str, Any], **more: Any) -> str:
    """The text of a configuration with the memories `mirror` and `status`."""
    areas = dict.fromkeys(AREAS, 65536)
    memories = {"mirror": areas, "status": {"input_registers": 30 * max(len(devices), 1)}}
    return written({"memories": memories, "devices": devices, **more})


def counters(appliance: Appliance, name: str) -> dict[str, Any]:
    """What is counted of a device."""
    told: dict[str, Any] = appliance.diagnostics.stats()["devices"][name]
    return told


def until_polled(appliance: Appliance, name: str, more: int = 3) -> None:
    """Waits for so many polls that begin after now, and end."""
    enough = counters(appliance, name)["polls"] + more + 1
    wire.until(lambda: counters(appliance, name)["polls"] >= enough, f"{name} is polled")


@contextlib.contextmanager
def in_background(work: Callable[[], object]) -> Iterator[None]:
    """Does something again and again in a thread; what it raises is raised here."""
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

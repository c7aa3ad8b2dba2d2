"""Raw Ingest, the sender's side: one packet, one connection, one atomic write, one byte of reply.

`unit` makes a packet of format v1, `memory_id` one of format crc; which of both a receiver speaks,
its configuration says. Nothing is tried twice: what to do after a failure is the caller's to say.

>>> await holdfast.raw_ingest.send("10.0.2.9", 9000, "input_registers", 0, [100, 200], unit=1)
"""

from __future__ import annotations

import asyncio
import math
import os
import reprlib
import selectors
import socket
import time
from typing import TYPE_CHECKING, Literal, TypeAlias, TypedDict

from holdfast._core import encode_raw_ingest, pack_raw_ingest
from holdfast.net.addresses import joined
from holdfast.net.resolver import Resolver
from holdfast.protocol import ADDRESSES, LAST_ADDRESS, MAX_WORD
from holdfast.types import AREAS, BIT_AREAS

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from typing import Unpack

    from holdfast.net.resolver import SocketAddress
    from holdfast.types import Area

__all__ = [
    "RawError",
    "RawRefused",
    "RawTimeout",
    "encode",
    "send",
    "send_packet",
    "send_packet_sync",
    "send_sync",
]

Format: TypeAlias = Literal["v1", "crc"]
Crc: TypeAlias = Literal["required", "none"]
Data: TypeAlias = bytes | bytearray | memoryview

TIMEOUT = 5.0
MAX_FIELD = MAX_WORD
DONE, REFUSED = b"\x00", b"\x01"
_RESOLVER = Resolver()


class RawError(Exception):
    """A packet that is not known to be written.

    `maybe_written` tells whether it may have been: all of it was sent, and no valid reply came.
    """

    def __init__(self, what: str, *, maybe_written: bool) -> None:
        outcome = "the packet may have been written" if maybe_written else "nothing was written"
        super().__init__(f"{what}; {outcome}")
        self.maybe_written = maybe_written


class RawRefused(RawError):
    """The receiver refused the packet (reply 01) and wrote nothing; it never says why."""


class RawTimeout(RawError, TimeoutError):
    """Connection, packet and reply took longer than the timeout."""


class Options(TypedDict, total=False):
    """What `encode` takes beside area, address and values."""

    data: Data | None
    count: int | None
    unit: int | None
    memory_id: int | None
    format: Format | None
    crc: Crc | None


def encode(
    area: Area,
    address: int,
    values: Iterable[int] | None = None,
    *,
    data: Data | None = None,
    count: int | None = None,
    unit: int | None = None,
    memory_id: int | None = None,
    format: Format | None = None,
    crc: Crc | None = None,
) -> bytes:
    """One packet, of format v1 for a `unit`, of format crc for a `memory_id`.

    `values` are 1 to 65535 bits (0, 1, False, True) or registers (integers 0 to 65535). In place of
    them, `data` is the payload as the wire has it: registers high byte first, bits packed least
    significant bit first with their `count`. `crc` is "none" for receivers of format crc that
    expect no CRC behind the payload. `format` may be given too, and must agree.

    Raises `ValueError` for what no receiver may accept, `TypeError` for a value of another type:
    nothing is converted, cut or wrapped.
    """
    if area not in AREAS:
        raise ValueError(f"area is {reprlib.repr(area)}, allowed are {', '.join(AREAS)}")
    if (unit is None) == (memory_id is None):
        raise TypeError("a packet has either a unit (format v1) or a memory_id (format crc)")
    layout: Format = "crc" if unit is None else "v1"
    if format not in (None, layout):
        raise ValueError(f"format is {format!r}, but the packet is of format {layout}")
    if crc not in (None, "required", "none"):
        raise ValueError(f"crc is {crc!r}, allowed are 'required' and 'none'")
    if crc is not None and layout == "v1":
        raise ValueError("crc is for format crc, a packet of format v1 never has one")
    _checked_field("address", address)
    payload, items = _payload(area, values, data, count)
    if address + items > ADDRESSES:
        last = f"the last address is {LAST_ADDRESS}"
        raise ValueError(f"{area}: {items} from address {address}, {last}")
    target = (
        _checked_field("memory_id", memory_id) if unit is None else _checked_field("unit", unit)
    )
    return encode_raw_ingest(
        payload,
        area=area,
        address=address,
        count=items,
        target=target,
        format=layout,
        crc=crc or "required",
    )


async def send(
    host: str,
    port: int,
    area: Area,
    address: int,
    values: Iterable[int] | None = None,
    *,
    timeout: float = TIMEOUT,
    **options: Unpack[Options],
) -> None:
    """Sends one packet, as `encode` makes it; returns when the receiver has written it.

    Raises as `encode` before it connects, and as `send_packet`.
    """
    await send_packet(host, port, encode(area, address, values, **options), timeout=timeout)


def send_sync(
    host: str,
    port: int,
    area: Area,
    address: int,
    values: Iterable[int] | None = None,
    *,
    timeout: float = TIMEOUT,
    **options: Unpack[Options],
) -> None:
    """As `send`, without an event loop."""
    send_packet_sync(host, port, encode(area, address, values, **options), timeout=timeout)


async def send_packet(host: str, port: int, packet: bytes, *, timeout: float = TIMEOUT) -> None:
    """Sends a packet that is made already; returns when the receiver has written it.

    `timeout`, in seconds, is one deadline for finding and reaching the host, sending, and the
    reply. Raises `RawRefused`, `RawTimeout`, or `RawError` for everything else that goes wrong; all
    are a `RawError`, which knows whether the packet may have been written. The connection is
    closed in any case, also when the task is cancelled.
    """
    attempt = _Attempt(host, port, timeout)
    try:
        async with asyncio.timeout(timeout):
            connection = await _connected(host, port, asyncio.get_running_loop().time() + timeout)
            with connection:
                reply = await _exchange(attempt, connection, packet)
    except OSError as error:
        raise attempt.failed(error) from error
    attempt.conclude(reply)


def send_packet_sync(host: str, port: int, packet: bytes, *, timeout: float = TIMEOUT) -> None:
    """As `send_packet`, without an event loop."""
    attempt = _Attempt(host, port, timeout)
    deadline = time.monotonic() + timeout
    try:
        with _connected_sync(host, port, deadline) as connection:
            reply = _exchange_sync(attempt, connection, packet, deadline)
    except OSError as error:
        raise attempt.failed(error) from error
    attempt.conclude(reply)


class _Attempt:
    """How far one packet has come, and what becomes of that."""

    def __init__(self, host: str, port: int, timeout: float) -> None:
        _checked_field("port", port, least=1)
        if not 0 < timeout < math.inf:
            raise ValueError(f"timeout is {timeout}, allowed are seconds above 0")
        try:
            if not host.encode("idna"):
                raise UnicodeError
        except UnicodeError:
            raise ValueError(f"{reprlib.repr(host)} is no name of a host") from None
        self.peer = joined(host, port)
        self.timeout = timeout
        self.connected = False
        self.sent = False

    def failed(self, error: OSError) -> RawError:
        if isinstance(error, TimeoutError):
            what = "reply" if self.connected else "connection"
            text = f"{self.peer}: no {what} within {self.timeout:g} s"
            return RawTimeout(text, maybe_written=self.sent)
        what = error.strerror or str(error)
        if error.errno is not None and not isinstance(error, socket.gaierror):
            what = os.strerror(error.errno)
        return RawError(f"{self.peer}: {what}", maybe_written=self.sent)

    def conclude(self, reply: bytes) -> None:
        """Returns if the reply says that the packet was written."""
        if reply == DONE and self.sent:
            return
        if reply == REFUSED:
            raise RawRefused(f"{self.peer} refused the packet", maybe_written=False)
        if reply == DONE:
            what = "answered 00 before it had the packet"
        elif reply:
            what = f"answered {reply.hex()}, allowed are 00 and 01"
        else:
            what = "closed the connection without a reply"
        raise RawError(f"{self.peer} {what}", maybe_written=self.sent)


async def _connected(host: str, port: int, deadline: float) -> socket.socket:
    """A connection to the first address of the host that takes one.

    Each address has its share of the time that is left, so that a dead one does not use up all.
    """
    loop = asyncio.get_running_loop()
    found = await asyncio.wrap_future(_RESOLVER.look_up(host, port))
    for others, (family, address) in _countdown(found):
        try:
            connection = socket.socket(family)
            try:
                _prepare(connection)
                async with asyncio.timeout((deadline - loop.time()) / (others + 1)):
                    await loop.sock_connect(connection, address)
            except BaseException:
                connection.close()
                raise
            return connection
        except OSError:
            if not others:
                raise
    raise OSError("the host has no address")


def _connected_sync(host: str, port: int, deadline: float) -> socket.socket:
    """As `_connected`."""
    found = _RESOLVER.wait_for(host, port, _left(deadline))
    for others, (family, address) in _countdown(found):
        try:
            connection = socket.socket(family)
            try:
                _prepare(connection)
                connection.settimeout(_left(deadline) / (others + 1))
                connection.connect(address)
                connection.setblocking(False)
            except BaseException:
                connection.close()
                raise
            return connection
        except OSError:
            if not others:
                raise
    raise OSError("the host has no address")


def _countdown(found: Sequence[SocketAddress]) -> Iterator[tuple[int, SocketAddress]]:
    """The addresses, each with how many come after it."""
    return zip(reversed(range(len(found))), found, strict=True)


def _prepare(connection: socket.socket) -> None:
    connection.setblocking(False)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


async def _exchange(attempt: _Attempt, connection: socket.socket, packet: bytes) -> bytes:
    """The reply, or nothing when there is none.

    It is awaited from the start: a receiver may refuse a packet by its header. What becomes of the
    rest of the packet then is of no interest.
    """
    loop = asyncio.get_running_loop()
    attempt.connected = True
    sending = asyncio.create_task(loop.sock_sendall(connection, packet))
    try:
        return await loop.sock_recv(connection, 1)
    finally:
        sending.cancel()
        await asyncio.wait([sending])
        attempt.sent = not sending.cancelled() and sending.exception() is None


def _exchange_sync(
    attempt: _Attempt, connection: socket.socket, packet: bytes, deadline: float
) -> bytes:
    """As `_exchange`."""
    attempt.connected = True
    unsent = memoryview(packet)
    with selectors.DefaultSelector() as selector:
        selector.register(connection, selectors.EVENT_READ | selectors.EVENT_WRITE)
        while True:
            for _, ready in selector.select(_left(deadline)):
                try:
                    if ready & selectors.EVENT_READ:
                        return connection.recv(1)
                    unsent = unsent[connection.send(unsent) :]
                    attempt.sent = not unsent
                except BlockingIOError:
                    continue
                except OSError:
                    if ready & selectors.EVENT_READ:
                        raise
                    selector.modify(connection, selectors.EVENT_READ)
                if attempt.sent:
                    selector.modify(connection, selectors.EVENT_READ)


def _left(deadline: float) -> float:
    left = deadline - time.monotonic()
    if left <= 0:
        raise TimeoutError
    return left


def _payload(
    area: Area, values: Iterable[int] | None, data: Data | None, count: int | None
) -> tuple[bytes, int]:
    """The payload, and how many values it has."""
    if (values is None) == (data is None):
        raise TypeError("a packet has either values or data")
    if count is not None:
        _checked_field("count", count, least=1)
    if data is not None:
        return _checked(area, data, count)
    if isinstance(values, Data):
        raise TypeError("values are bytes, which are given as data")
    items = list(values or ())
    if not 1 <= len(items) <= MAX_FIELD:
        raise ValueError(f"values are {len(items)}, allowed are 1 to {MAX_FIELD}")
    if count not in (None, len(items)):
        raise ValueError(f"count is {count}, but values are {len(items)}")
    return pack_raw_ingest(area, items), len(items)


def _checked(area: Area, data: Data, count: int | None) -> tuple[bytes, int]:
    """Data as it is, and how many values it has."""
    if not isinstance(data, Data):
        raise TypeError(f"data is {reprlib.repr(data)}, not bytes")
    payload = bytes(data)
    if area in BIT_AREAS:
        if count is None:
            raise TypeError("data of bits needs a count")
        if len(payload) != (count + 7) // 8:
            raise ValueError(
                f"{count} {area} are {(count + 7) // 8} bytes, data has {len(payload)}"
            )
        return payload, count
    if len(payload) % 2 or not 1 <= len(payload) // 2 <= MAX_FIELD:
        raise ValueError(
            f"data has {len(payload)} bytes, allowed are 2 for each of 1 to {MAX_FIELD}"
        )
    if count not in (None, len(payload) // 2):
        raise ValueError(f"count is {count}, but data is {len(payload) // 2} registers")
    return payload, len(payload) // 2


def _checked_field(name: str, value: object, least: int = 0) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError(
            f"{name} is {reprlib.repr(value)}, allowed are integers {least} to {MAX_FIELD}"
        )
    if not least <= value <= MAX_FIELD:
        raise ValueError(f"{name} is {value}, allowed are {least} to {MAX_FIELD}")
    return value

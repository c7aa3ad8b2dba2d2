"""A sender of Raw Ingest packets: one connection per packet, one atomic write, one reply byte.

`unit` selects packets of format v1, `memory_id` packets of format crc; use the format of the
receiver's configuration. Nothing is retried: the caller decides what to do after a failure.

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
    """The packet was not confirmed.

    `maybe_written`: the whole packet was sent, but no valid reply arrived.
    """

    def __init__(self, what: str, *, maybe_written: bool) -> None:
        outcome = "the packet may have been written" if maybe_written else "nothing was written"
        super().__init__(f"{what}; {outcome}")
        self.maybe_written = maybe_written


class RawRefused(RawError):
    """The receiver refused the packet (reply 01) and wrote nothing. It gives no reason."""


class RawTimeout(RawError, TimeoutError):
    """Connection, packet and reply took longer than the timeout."""


class Options(TypedDict, total=False):
    """The options of `encode`."""

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
    """Encodes one packet: format v1 with `unit`, format crc with `memory_id`.

    `values` are 1 to 65535 bits (0, 1, False, True) or registers (integers 0 to 65535). `data` is
    the alternative: the payload as on the wire, registers high byte first, or bits packed least
    significant bit first with their `count`. Set `crc` to "none" for receivers of format crc that
    expect no CRC after the payload. `format` is optional and must match.

    Raises `ValueError` for a packet that no receiver accepts, `TypeError` for a value of another
    type: values are never converted, truncated or wrapped.
    """
    if area not in AREAS:
        raise ValueError(f"area is {reprlib.repr(area)}, allowed: {', '.join(AREAS)}")
    if (unit is None) == (memory_id is None):
        raise TypeError("a packet requires either a unit (format v1) or a memory_id (format crc)")
    layout: Format = "crc" if unit is None else "v1"
    if format not in (None, layout):
        raise ValueError(f"format is {format!r}, but the packet is of format {layout}")
    if crc not in (None, "required", "none"):
        raise ValueError(f"crc is {crc!r}, allowed: 'required' or 'none'")
    if crc is not None and layout == "v1":
        raise ValueError("crc requires format crc: a packet of format v1 has no CRC")
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
    """Encodes and sends one packet. Returns when the receiver has written it.

    Raises the errors of `encode` before it connects, and the errors of `send_packet`.
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
    """Like `send`, without an event loop."""
    send_packet_sync(host, port, encode(area, address, values, **options), timeout=timeout)


async def send_packet(host: str, port: int, packet: bytes, *, timeout: float = TIMEOUT) -> None:
    """Sends an encoded packet. Returns when the receiver has written it.

    `timeout`, in seconds, covers name resolution, connection, packet and reply together. Raises
    `RawRefused`, `RawTimeout`, or `RawError` for all other failures; all are `RawError`, and
    `maybe_written` says whether the packet may have been written. Always closes the connection,
    also when the task is cancelled.
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
    """Like `send_packet`, without an event loop."""
    attempt = _Attempt(host, port, timeout)
    deadline = time.monotonic() + timeout
    try:
        with _connected_sync(host, port, deadline) as connection:
            reply = _exchange_sync(attempt, connection, packet, deadline)
    except OSError as error:
        raise attempt.failed(error) from error
    attempt.conclude(reply)


class _Attempt:
    """The progress of one packet, and its outcome."""

    def __init__(self, host: str, port: int, timeout: float) -> None:
        _checked_field("port", port, least=1)
        if not 0 < timeout < math.inf:
            raise ValueError(f"timeout is {timeout}, allowed: more than 0 seconds")
        try:
            if not host.encode("idna"):
                raise UnicodeError
        except UnicodeError:
            raise ValueError(f"{reprlib.repr(host)} is not a host name") from None
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
        """Returns if the reply confirms the packet; otherwise raises `RawError`."""
        if reply == DONE and self.sent:
            return
        if reply == REFUSED:
            raise RawRefused(f"{self.peer} refused the packet", maybe_written=False)
        if reply == DONE:
            what = "answered 00 before it had the whole packet"
        elif reply:
            what = f"answered {reply.hex()}, allowed: 00 or 01"
        else:
            what = "closed the connection without a reply"
        raise RawError(f"{self.peer} {what}", maybe_written=self.sent)


async def _connected(host: str, port: int, deadline: float) -> socket.socket:
    """Connects to the first address of the host that accepts.

    Each address gets a share of the remaining time, so that one dead address does not use it up.
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
    """Like `_connected`, without an event loop."""
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
    """The addresses, each with the number of addresses after it."""
    return zip(reversed(range(len(found))), found, strict=True)


def _prepare(connection: socket.socket) -> None:
    connection.setblocking(False)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


async def _exchange(attempt: _Attempt, connection: socket.socket, packet: bytes) -> bytes:
    """Sends the packet and returns the reply, empty without one.

    Waits for the reply from the start: a receiver can refuse a packet by its header. The rest of
    the packet does not matter then.
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
    """Like `_exchange`, without an event loop."""
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
    """The payload, and its number of values."""
    if (values is None) == (data is None):
        raise TypeError("a packet requires either values or data")
    if count is not None:
        _checked_field("count", count, least=1)
    if data is not None:
        return _checked(area, data, count)
    if isinstance(values, Data):
        raise TypeError("values are bytes; pass them as data")
    items = list(values or ())
    if not 1 <= len(items) <= MAX_FIELD:
        raise ValueError(f"found {len(items)} values, allowed: 1 to {MAX_FIELD}")
    if count not in (None, len(items)):
        raise ValueError(f"count is {count}, but found {len(items)} values")
    return pack_raw_ingest(area, items), len(items)


def _checked(area: Area, data: Data, count: int | None) -> tuple[bytes, int]:
    """Checks a payload. Returns it as bytes, with its number of values."""
    if not isinstance(data, Data):
        raise TypeError(f"data is {reprlib.repr(data)}, not bytes")
    payload = bytes(data)
    if area in BIT_AREAS:
        if count is None:
            raise TypeError("data of bits requires a count")
        if len(payload) != (count + 7) // 8:
            raise ValueError(
                f"{count} {area} require {(count + 7) // 8} bytes, data has {len(payload)}"
            )
        return payload, count
    if len(payload) % 2 or not 1 <= len(payload) // 2 <= MAX_FIELD:
        raise ValueError(
            f"data has {len(payload)} bytes, allowed: 2 for each of 1 to {MAX_FIELD} registers"
        )
    if count not in (None, len(payload) // 2):
        raise ValueError(f"count is {count}, but data has {len(payload) // 2} registers")
    return payload, len(payload) // 2


def _checked_field(name: str, value: object, least: int = 0) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError(
            f"{name} is {reprlib.repr(value)}, allowed: integers {least} to {MAX_FIELD}"
        )
    if not least <= value <= MAX_FIELD:
        raise ValueError(f"{name} is {value}, allowed: {least} to {MAX_FIELD}")
    return value

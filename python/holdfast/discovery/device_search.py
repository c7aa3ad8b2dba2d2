"""Finds Modbus devices: hosts of networks, and unit ids of a device.

Everything is read; nothing is written. A device is found if it answers a request, with values or
with an exception.
"""

from __future__ import annotations

import asyncio
import contextlib
from asyncio import sleep
from dataclasses import dataclass, field
from time import monotonic
from time import sleep as pause
from typing import TYPE_CHECKING, Literal, TypeAlias

from holdfast.client import Client
from holdfast.client.url import NetworkTarget
from holdfast.errors import (
    ConnectFailed,
    ConnectionLost,
    InvalidResponse,
    ModbusError,
    ModbusException,
    RequestTimeout,
)
from holdfast.net.addresses import joined
from holdfast.protocol import GATEWAY_FAILURES, MAX_SERIAL_UNIT

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterable, Iterator, Sequence

    from holdfast.client import SyncClient
    from holdfast.client.identification import Identification
    from holdfast.client.requests import ServerId
    from holdfast.net.addresses import Address, Network

UNUSUAL_UNIT = 231
"""A unit id that is rare: what answers as it does is probably no device of its own."""

ANSWERS = "answers"
"""The detail of a unit id that returns values."""

HOST_UNITS = (1, 255, 0)
"""Unit ids to try at a host. Devices without a serial line often use 255 or 0."""

GATEWAY_UNITS = tuple(range(1, MAX_SERIAL_UNIT + 1))
"""Unit ids to try behind a gateway, or on a line whose settings are known."""

State: TypeAlias = Literal["modbus", "open", "refused", "silent", "error"]
"""What an address is: answers Modbus; only has the port open; refuses; does not respond."""


@dataclass(frozen=True)
class Identity:
    """What a device says about itself; empty if it does not support it."""

    objects: tuple[tuple[str, str], ...] = ()
    """Names and texts of function 43/14, or the server id of function 17."""

    def __str__(self) -> str:
        return " ".join(text for _, text in self.objects)


@dataclass
class Host:
    """An address of a network, and what was found there."""

    address: str
    port: int
    state: State
    unit: int | None = None
    """The unit id that answered."""
    detail: str = ""
    identity: Identity = field(default_factory=Identity)
    longest_late: float = 0.0
    """How many seconds its slowest late reply took; 0 if there was none."""
    is_mute: bool = False
    """Whether connections were made, and no unit id got a reply or was disconnected."""

    @property
    def url(self) -> str:
        """The URL of the device."""
        return f"tcp://{joined(self.address, self.port)}"


@dataclass(frozen=True)
class Unit:
    """A unit id that was asked."""

    unit: int
    answers: bool
    detail: str
    """The answer, or why there is none."""
    identity: Identity = Identity()
    is_garbled: bool = False
    """Whether bytes came that are not a valid reply: the settings of a line may be wrong."""
    is_silent: bool = False
    """Whether no reply came: it may have been asked too soon."""
    is_mute: bool = False
    """Whether it is silent on a connection that stays open."""


@dataclass
class Rate:
    """Lets at most so many begin in a second. The first begins at once."""

    per_second: float
    _next: float = 0.0

    async def turn(self) -> None:
        """Waits for the next turn."""
        now = monotonic()
        begins = max(self._next, now)
        self._next = begins + 1 / self.per_second
        await sleep(begins - now)


def addresses(networks: Iterable[Network]) -> Iterator[Address]:
    """All hosts of networks, each once."""
    seen: set[Address] = set()
    for network in networks:
        for address in network.hosts():
            if address not in seen:
                seen.add(address)
                yield address


def size(networks: Iterable[Network]) -> int:
    """How many hosts networks have at most."""
    return sum(each.num_addresses for each in networks)


async def hosts(
    networks: Iterable[Network],
    *,
    port: int,
    timeout: float,
    rate: float,
    concurrency: int,
    units: Sequence[int] = HOST_UNITS,
) -> AsyncIterator[Host]:
    """Looks at every host of networks, and yields each as soon as its result is known.

    Begins at most `rate` connections a second, and looks at `concurrency` hosts at a time.
    """
    pace = Rate(rate)
    results: asyncio.Queue[Host | None] = asyncio.Queue()
    left = addresses(networks)

    async def work() -> None:
        for address in left:
            await pace.turn()
            results.put_nowait(await _host(str(address), port, timeout, units))

    async def all_work() -> None:
        try:
            async with asyncio.TaskGroup() as group:
                for _ in range(concurrency):
                    group.create_task(work())
        finally:
            results.put_nowait(None)

    running = asyncio.create_task(all_work())
    try:
        while (host := await results.get()) is not None:
            yield host
        await running
    finally:
        running.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await running


async def _host(address: str, port: int, timeout: float, units: Sequence[int]) -> Host:
    host = Host(address, port, "silent")
    async with Client(host.url, timeout=timeout) as client:
        await _ask(host, client, units)
        host.longest_late = client.longest_late
    return host


async def _ask(host: Host, client: Client, units: Sequence[int]) -> None:
    """Asks unit ids until one answers, and notes in `host` what was found.

    The first is asked once more after the second, see `units`.
    """
    for unit in (*units[:2], *units[:1], *units[2:]):
        try:
            await client.read("holding_registers", 0, "uint16", unit=unit)
            host.detail = ANSWERS
        except ModbusException as error:
            host.detail = str(error)
            if error.code in GATEWAY_FAILURES:
                host.state = "modbus"
                continue
        except ConnectFailed as error:
            host.detail = error.detail
            host.state = _unreachable(error) if host.state == "silent" else host.state
            return
        except (RequestTimeout, ConnectionLost, InvalidResponse) as error:
            if isinstance(error, RequestTimeout) and not error.maybe_sent:
                return  # No connection was made: the other unit ids would wait as long.
            is_first = host.state == "silent"
            host.is_mute = isinstance(error, RequestTimeout) and (is_first or host.is_mute)
            if host.state != "modbus":
                host.state = "open"
                host.detail = str(error)
            continue
        host.state, host.unit = "modbus", unit
        try:
            host.identity = identity(await client.identify(unit=unit))
        except ModbusError:
            with contextlib.suppress(ModbusError):
                host.identity = server_identity(await client.report_server_id(unit=unit))
        return


def _unreachable(error: ConnectFailed) -> State:
    return "refused" if isinstance(error.__cause__, ConnectionRefusedError) else "silent"


def units(client: SyncClient, unit_ids: Sequence[int], *, delay: float = 0.0) -> Iterator[Unit]:
    """Asks unit ids one by one, and yields each at once. Raises `ConnectFailed`.

    If the first two do not reply, the first is asked and yielded once more: some devices ignore
    what comes soon after connecting, and after three timeouts the connection is another one.
    """
    is_silent = True
    for count, unit in enumerate(unit_ids, 1):
        if count > 1:
            pause(delay)
        found = probe(client, unit, delay=delay)
        is_silent = is_silent and found.is_silent
        yield found
        if is_silent and count == min(2, len(unit_ids)):
            pause(delay)
            yield probe(client, unit_ids[0], delay=delay)


def probe(client: SyncClient, unit: int, *, delay: float = 0.0) -> Unit:
    """Asks one unit id. Raises `ConnectFailed`."""
    try:
        client.read("holding_registers", 0, "uint16", unit=unit)
        detail = ANSWERS
    except ModbusException as error:
        if error.code in GATEWAY_FAILURES:
            return Unit(unit, answers=False, detail=str(error))
        detail = str(error)
    except ConnectFailed:
        raise
    except ModbusError as error:
        is_garbled = isinstance(error, InvalidResponse)
        return Unit(
            unit,
            answers=False,
            detail=str(error),
            is_garbled=is_garbled,
            is_silent=not is_garbled,
            is_mute=_connects(client) and isinstance(error, RequestTimeout) and error.maybe_sent,
        )
    return Unit(unit, answers=True, detail=detail, identity=_identify(client, unit, delay))


def _connects(client: SyncClient) -> bool:
    """Whether a client makes connections, which a serial line and UDP have none of."""
    return isinstance(client.target, NetworkTarget) and "udp" not in client.target.transport


def _identify(client: SyncClient, unit: int, delay: float) -> Identity:
    """What a device says about itself, by function 43/14, else 17."""
    pause(delay)
    try:
        return identity(client.identify(unit=unit))
    except ModbusError:
        pause(delay)
    try:
        return server_identity(client.report_server_id(unit=unit))
    except ModbusError:
        return Identity()


def identity(answer: Identification) -> Identity:
    """An answer to function 43/14 as text."""
    names = ("vendor_name", "product_code", "revision", "product_name", "model_name")
    texts = ((name, getattr(answer, name)) for name in names)
    return Identity(tuple((name, text) for name, text in texts if text))


def server_identity(answer: ServerId) -> Identity:
    """An answer to function 17 as text."""
    data = answer.additional if answer.running is not None else answer.data
    text = bytes(each for each in data if 0x20 <= each < 0x7F).decode().strip()
    return Identity((("server_id", text),)) if len(text) >= 3 else Identity()


def like_unusual(
    client: SyncClient, asked: Sequence[Unit], *, is_line: bool, delay: float = 0.0
) -> list[Unit]:
    """The unit ids that answer as a rare one does, which are probably no devices of their own: with
    values or the same exception, and the same identification. All of them, if a device ignores unit
    ids.

    None if a unit id does not answer, or on a line, where each unit id is a device of its own.
    """
    if is_line or len(asked) < 2 or not all(unit.answers for unit in asked):
        return []
    rare = next((unit for unit in asked if unit.unit == UNUSUAL_UNIT), None)
    if rare is None:
        pause(delay)
        rare = probe(client, UNUSUAL_UNIT, delay=delay)
    elif len(asked) < MAX_SERIAL_UNIT:
        return []  # A device is expected there.
    answer = (rare.answers, rare.detail, rare.identity)
    return [unit for unit in asked if (unit.answers, unit.detail, unit.identity) == answer]


def devices(asked: Sequence[Unit], alike: Sequence[Unit]) -> list[Unit]:
    """The unit ids to describe: all that answer in a way of their own, and the first of those that
    answer `alike`, as `like_unusual` returned them. That one is left out if it has only an
    exception and others have values.
    """
    own = [unit for unit in asked if unit.answers and unit not in alike]
    is_device = not own or any(unit.detail == ANSWERS or unit.identity.objects for unit in alike)
    return [unit for unit in asked if unit in own or (is_device and unit in alike[:1])]

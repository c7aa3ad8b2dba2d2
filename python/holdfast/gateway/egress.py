"""Whom the gateway may connect to: networks and ports, and names made addresses.

A name is resolved once. Only addresses that are in the list are kept, and the connection is made to
one of those, never to the name: what it means to a name server a moment later does not matter.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
from dataclasses import dataclass
from ipaddress import ip_address
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable

    from holdfast.client.target import Transport
    from holdfast.config.addresses import Address
    from holdfast.config.egress import Allowed

    Resolve: TypeAlias = Callable[[str], Awaitable[list[str]]]

MAX_LOOKUPS = 32
"""Names that are looked up at once; more wait."""


class Refused(Exception):
    """The target is not in the egress list."""


class NoSuchName(Exception):
    """A name that means no address."""


@dataclass(frozen=True)
class Route:
    """A way to a device that may be gone: its addresses, each of them in the list."""

    transport: Transport
    addresses: tuple[str, ...]
    port: int
    name: str | None = None
    """The name that the device's certificate must have, with TLS."""


class Egress:
    """The list, and how names become addresses."""

    def __init__(self, entries: Iterable[Allowed], resolve: Resolve | None = None) -> None:
        self.entries = tuple(entries)
        self._resolve = Lookups() if resolve is None else resolve

    def allows(self, address: str, port: int, transport: Transport) -> bool:
        """Whether a connection may be made; an IPv4 address in IPv6 is that IPv4 address."""
        found = plain(address)
        if found.is_multicast or found.is_unspecified:
            return False
        return any(entry.holds(found, port, transport) for entry in self.entries)

    async def route(
        self, transport: Transport, host: str, port: int, name: str | None = None
    ) -> Route:
        """The way to a target; `name` is that of its certificate, if it is not the host.

        Raises `Refused` and `NoSuchName`.
        """
        bare = host.removeprefix("[").removesuffix("]")
        try:
            found = [str(ip_address(bare))]
        except ValueError:
            found = await self._resolve(host)
        allowed = [str(plain(each)) for each in found if self.allows(each, port, transport)]
        if not allowed:
            is_name = bare not in found
            where = f" ({', '.join(found[:4])})" if is_name else ""
            raise Refused(f"{host}{where}, port {port}, is not in the egress list of this gateway")
        # IPv4 first: a device that has both seldom answers Modbus on IPv6 only.
        allowed.sort(key=lambda each: ":" in each)
        addresses = tuple(dict.fromkeys(allowed))
        secure = transport == "tls"
        return Route(transport, addresses, port, certified(name or host) if secure else None)


def certified(host: str) -> str:
    """What a certificate has for a host: an address without brackets, a name in lower case."""
    bare = host.removeprefix("[").removesuffix("]")
    try:
        return str(plain(bare))
    except ValueError:
        return bare.lower().removesuffix(".")


def plain(address: str) -> Address:
    """An address; an IPv4 address in IPv6 is that IPv4 address."""
    found = ip_address(address)
    return getattr(found, "ipv4_mapped", None) or found


class Lookups:
    """The system's resolver, in threads that nobody has to wait for."""

    def __init__(self) -> None:
        self._turns = asyncio.Semaphore(MAX_LOOKUPS)

    async def __call__(self, host: str) -> list[str]:
        """The addresses of a name. Raises `NoSuchName`."""
        await self._turns.acquire()
        loop = asyncio.get_running_loop()
        answer: asyncio.Future[list[str]] = loop.create_future()

        def settle(found: list[str] | NoSuchName) -> None:
            self._turns.release()
            if answer.done():  # Nobody waits any more.
                return
            if isinstance(found, NoSuchName):
                answer.set_exception(found)
            else:
                answer.set_result(found)

        def work() -> None:
            found = _looked_up(host)
            with contextlib.suppress(RuntimeError):  # The loop has ended.
                loop.call_soon_threadsafe(settle, found)

        threading.Thread(target=work, name="lookup", daemon=True).start()
        return await answer


def _looked_up(host: str) -> list[str] | NoSuchName:
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError) as error:
        why = getattr(error, "strerror", None) or str(error)
        return NoSuchName(f"can't resolve {host}: {why}")
    # An address of one link only, with a scope, is none that others could mean.
    return [str(address[0]) for *_, address in found if "%" not in str(address[0])]

"""Which devices callers may have the scanner talk to, and where those are.

A name is looked up once, when it is first asked for, and what is allowed or not is the address that
was found: the one that is connected to. So a name can't point to one place when it is judged and to
another when it is used.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
from dataclasses import replace
from ipaddress import IPv6Address, ip_address, ip_network
from typing import TYPE_CHECKING, Any

from holdfast.client.target import NetworkTarget, SerialTarget, Tls
from holdfast.config.scanning import parse_pollable
from holdfast.scanner.errors import Refused

if TYPE_CHECKING:
    from collections.abc import Iterable
    from ipaddress import IPv4Address

    from holdfast.client.target import Target

LOOKUP_TIMEOUT = 5.0
"""Seconds that a name has to be looked up."""

MAX_LOOKING = 64
"""Names that are looked up at once."""

PRIVATE = tuple(
    ip_network(text)
    for text in (
        "127.0.0.0/8",
        "10.0.0.0/8",
        "172.16.0.0/12",
        "192.168.0.0/16",
        "::1/128",
        "fc00::/7",
    )
)
"""What is allowed where nothing is said."""

WHERE = "name it with --allow, or in nats.devices of the configuration"


class Allowed:
    """Networks, and serial devices by their paths; without any, `PRIVATE`.

    Raises `ValueError` for an entry that is neither.
    """

    def __init__(self, entries: Iterable[str] = ()) -> None:
        allowed = [parse_pollable(entry) for entry in entries] or PRIVATE
        self._devices = {entry for entry in allowed if isinstance(entry, str)}
        self.networks = tuple(entry for entry in allowed if not isinstance(entry, str))
        self._looking = 0

    async def address(self, target: Target, *, after: Target | None = None) -> Target:
        """The target with the address that its host has, allowed. Raises `Refused`.

        With TLS it keeps the name that the certificate must have. Of several addresses it is the
        first, or the one that follows on `after`.
        """
        if isinstance(target, SerialTarget):
            if target.device not in self._devices:
                raise Refused(f"{target.device} is not allowed; {WHERE}")
            return target
        found = await self._found(target)
        allowed = [address for address in found if self._contains(address)]
        if not allowed:
            known = ", ".join(found)
            told = "" if known == target.host else f" ({known})"
            networks = ", ".join(map(str, self.networks)) or "serial devices only"
            raise Refused(f"{target.host}{told} is not allowed, allowed are {networks}")
        last = after.host if isinstance(after, NetworkTarget) else ""
        at = (allowed.index(last) + 1) % len(allowed) if last in allowed else 0
        tls = replace(target.tls, name=target.tls.name or target.host)
        return replace(target, host=allowed[at], tls=tls if target.transport == "tls" else Tls())

    async def _found(self, target: NetworkTarget) -> list[str]:
        """The addresses of a host, IPv4 first: few devices have another."""
        with contextlib.suppress(ValueError):
            return [str(ip_address(target.host))]
        if self._looking >= MAX_LOOKING:
            raise Refused(f"{MAX_LOOKING} names are being looked up, no more at once")
        self._looking += 1
        future = _looked_up(target)
        future.add_done_callback(self._looked)
        try:
            async with asyncio.timeout(LOOKUP_TIMEOUT):
                found = await asyncio.shield(future)
        except TimeoutError:
            raise Refused(f"host {target.host} was not found within {LOOKUP_TIMEOUT:g} s") from None
        except (OSError, UnicodeError) as error:
            raise Refused(f"host {target.host}: {error}") from None
        ordered = sorted(found, key=lambda entry: entry[0] != socket.AF_INET)
        return list(dict.fromkeys(str(entry[4][0]) for entry in ordered))

    def _looked(self, future: asyncio.Future[list[Any]]) -> None:
        self._looking -= 1
        if not future.cancelled():
            future.exception()

    def _contains(self, text: str) -> bool:
        address = _plain(ip_address(text))
        return any(address in network for network in self.networks)


def _plain(address: IPv4Address | IPv6Address) -> IPv4Address | IPv6Address:
    """An IPv4 address that is mapped into IPv6 is that IPv4 address."""
    if isinstance(address, IPv6Address) and address.ipv4_mapped is not None:
        return address.ipv4_mapped
    return address


def _looked_up(target: NetworkTarget) -> asyncio.Future[list[Any]]:
    """What the system says of a host; asked in a thread of its own, which a stop need not wait for,
    because nothing can interrupt the system's resolver.
    """
    loop = asyncio.get_running_loop()
    future: asyncio.Future[list[Any]] = loop.create_future()

    def tell(found: list[Any] | Exception) -> None:
        if future.done():
            return
        if isinstance(found, Exception):
            future.set_exception(found)
        else:
            future.set_result(found)

    def ask() -> None:
        found: list[Any] | Exception
        try:
            found = list(socket.getaddrinfo(target.host, target.port, type=socket.SOCK_STREAM))
        except (OSError, UnicodeError) as error:
            found = error
        with contextlib.suppress(RuntimeError):  # The loop is closed.
            loop.call_soon_threadsafe(tell, found)

    threading.Thread(target=ask, name="holdfast-scan-resolver", daemon=True).start()
    return future

"""Names to addresses, by the system's resolver.

Nothing can interrupt the system's resolver, so it is called in threads that nobody has to wait for:
not a stop, not the end of the process, not a caller whose time is over. There are only so many of
them; names beyond that wait for their turn, for as long as their callers do.
"""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Awaitable, Callable
from concurrent.futures import Future
from typing import Any, TypeAlias

from holdfast.net.addresses import address_in, unbracketed

Resolve: TypeAlias = Callable[[str], Awaitable[list[str]]]
"""The addresses of a name. Raises `NoSuchName`."""

SocketAddress: TypeAlias = tuple[int, Any]
"""A family, and where to connect to in it."""

Lookup: TypeAlias = "Future[list[SocketAddress]]"

MAX_LOOKUPS = 32
"""Names that are looked up at once; more wait."""

LOOKUP_TIMEOUT = 5.0
"""Seconds that a name has to be looked up."""


class NoSuchName(Exception):
    """A name that means no address, or did not in time."""

    def __init__(self, host: str, why: str) -> None:
        self.host = host
        self.why = why
        super().__init__(f"can't resolve {host}: {why}")


class Resolver:
    """The system's resolver, for any thread.

    Awaited, it gives the addresses of a name, within `timeout` seconds.
    """

    def __init__(self, timeout: float = LOOKUP_TIMEOUT, *, most: int = MAX_LOOKUPS) -> None:
        self._timeout = timeout
        self._most = most
        self._lock = threading.Lock()
        self._threads = 0
        self._waiting: dict[Lookup, tuple[str, int | None]] = {}
        """Those that nobody looks up yet, the first one first."""

    async def __call__(self, host: str) -> list[str]:
        """The addresses of a name, each once. Raises `NoSuchName`."""
        try:
            async with asyncio.timeout(self._timeout):
                found = await asyncio.wrap_future(self.look_up(host))
        except TimeoutError:
            raise NoSuchName(host, f"no answer within {self._timeout:g} s") from None
        except OSError as error:
            raise NoSuchName(host, error.strerror or str(error)) from error
        # One with a scope is of one link only: it is none that a name could mean to others.
        return list(dict.fromkeys(at[0] for _, at in found if "%" not in at[0]))

    def wait_for(self, host: str, port: int, timeout: float) -> list[SocketAddress]:
        """What `look_up` comes to, within so many seconds. Raises `OSError`."""
        asked = self.look_up(host, port)
        try:
            return asked.result(timeout)
        finally:
            asked.cancel()

    def look_up(self, host: str, port: int | None = None) -> Lookup:
        """Where a host is, in the order of the system. The future has `OSError` for a name that
        means nothing; when it is cancelled before its turn, nothing is looked up.
        """
        asked: Lookup = Future()
        if address_in(host) is not None:  # Which asks nobody.
            _settle(asked, unbracketed(host), port)
            return asked
        asked.add_done_callback(self._forget)
        with self._lock:
            self._waiting[asked] = host, port
            begins = self._threads < self._most
            self._threads += begins
        if begins:
            self._begin()
        return asked

    def _forget(self, asked: Lookup) -> None:
        with self._lock:
            self._waiting.pop(asked, None)

    def _begin(self) -> None:
        try:
            threading.Thread(target=self._work, name="holdfast-resolver", daemon=True).start()
        except RuntimeError:  # The system has no more threads; those that run go on.
            with self._lock:
                self._threads -= 1
                left = [] if self._threads else list(self._waiting)
                for asked in left:
                    del self._waiting[asked]
            for asked in left:
                if asked.set_running_or_notify_cancel():
                    asked.set_exception(OSError("no thread to look up a name"))

    def _work(self) -> None:
        """Looks up what waits, until nothing does."""
        while True:
            with self._lock:
                asked = next(iter(self._waiting), None)
                if asked is None:
                    self._threads -= 1
                    return
                host, port = self._waiting.pop(asked)
            _settle(asked, host, port)


def _settle(asked: Lookup, host: str, port: int | None) -> None:
    if not asked.set_running_or_notify_cancel():
        return
    try:
        if "\0" in host:  # The system would look up what stands before it.
            raise ValueError
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except OSError as error:
        asked.set_exception(error)
    except ValueError:  # What IDNA or the system can't take, such as a label of 64 characters.
        asked.set_exception(OSError(f"{host} can't be a host name"))
    else:
        asked.set_result([(family, address) for family, *_, address in found])

"""Resolves names with the system's resolver.

A call to the system's resolver cannot be interrupted. So it runs in daemon threads, which neither a
stop, nor the exit of the process, nor a caller with a timeout has to wait for. Whoever asks for a
name that is being looked up waits for the same thread. Addresses that came when nobody waited any
more are for the next attempt: a lookup may take longer than each attempt. The number of threads is
limited; further lookups are queued until their callers give up.
"""

from __future__ import annotations

import asyncio
import copy
import os
import socket
import threading
import time
from collections.abc import Awaitable, Callable, Iterable
from concurrent.futures import Future
from functools import partial
from typing import Any, TypeAlias

from holdfast.net.addresses import address_in, unbracketed

Resolve: TypeAlias = Callable[[str], Awaitable[list[str]]]
"""Resolves a name to its addresses. Raises `NoSuchName`."""

SocketAddress: TypeAlias = tuple[int, Any]
"""An address family, and an address for `socket.connect`."""

Lookup: TypeAlias = "Future[list[SocketAddress]]"
Place: TypeAlias = tuple[str, int | None]
"""A host and a port."""

MAX_LOOKUPS = 32
"""Limit of concurrent lookups; further ones are queued."""

LOOKUP_TIMEOUT_S = 5.0
"""Seconds after which a lookup fails."""

KEPT_S = 60.0
"""Seconds that addresses are kept that came too late: as in the core."""


class NoSuchName(Exception):
    """A name has no address, or the lookup timed out."""

    def __init__(self, host: str, why: str) -> None:
        self.host = host
        self.why = why
        super().__init__(f"can't resolve {host}: {why}")

    @classmethod
    def unanswered(cls, host: str, timeout: float) -> NoSuchName:
        """Returns the error of a lookup that had no result within `timeout` seconds."""
        return cls(host, f"no answer within {timeout:g} s")


class Resolver:
    """The system's resolver. Thread-safe.

    Calling it is asynchronous and returns the addresses of a name within `timeout` seconds.
    """

    def __init__(self, timeout: float = LOOKUP_TIMEOUT_S, *, most: int = MAX_LOOKUPS) -> None:
        self._timeout = timeout
        self._most = most
        self._lock = threading.Lock()
        self._process = os.getpid()
        self._threads = 0
        self._waiting: dict[Place, list[Lookup]] = {}
        """Who waits for a place, oldest first."""
        self._queue: dict[Place, None] = {}
        """The places that no thread looks up yet."""
        self._late: dict[Place, tuple[float, list[SocketAddress]]] = {}
        """What came when nobody waited any more, and when."""

    async def __call__(self, host: str) -> list[str]:
        """Returns the addresses of a name without duplicates. Raises `NoSuchName`."""
        try:
            async with asyncio.timeout(self._timeout):
                found = await asyncio.wrap_future(self.look_up(host))
        except TimeoutError:
            raise NoSuchName.unanswered(host, self._timeout) from None
        except OSError as error:
            raise NoSuchName(host, error.strerror or str(error)) from error
        # Addresses with a scope are link-local. They are valid on one link only.
        return list(dict.fromkeys(at[0] for _, at in found if "%" not in at[0]))

    def wait_for(self, host: str, port: int, timeout: float) -> list[SocketAddress]:
        """Returns the result of `look_up`, waiting at most `timeout` seconds. Raises `OSError`."""
        lookup = self.look_up(host, port)
        try:
            return lookup.result(timeout)
        finally:
            lookup.cancel()

    def look_up(self, host: str, port: int | None = None) -> Lookup:
        """Starts a lookup. The future holds the addresses in the system's order, or `OSError`.

        Cancelling the future removes a queued lookup.
        """
        lookup: Lookup = Future()
        if address_in(host) is not None:  # Needs no name server, so it returns at once.
            _end([lookup], _outcome(unbracketed(host), port))
            return lookup
        place = host, port
        lookup.add_done_callback(partial(self._forget, place))
        with self._lock:
            if self._process != os.getpid():  # A forked process does not have the threads.
                self._process, self._threads = os.getpid(), 0
                self._waiting.clear()
                self._queue.clear()
                self._late.clear()
            late = self._take_late(place)
            if late is None:
                if place not in self._waiting:
                    self._queue[place] = None
                self._waiting.setdefault(place, []).append(lookup)
            begins = place in self._queue and self._threads < self._most
            self._threads += begins
        if late is not None:
            _end([lookup], late)
        if begins:
            self._begin()
        return lookup

    def _forget(self, place: Place, lookup: Lookup) -> None:
        with self._lock:
            waiting = self._waiting.get(place, [])
            if lookup in waiting:
                waiting.remove(lookup)
            if not waiting and place in self._queue:
                del self._queue[place], self._waiting[place]

    def _take_late(self, place: Place) -> list[SocketAddress] | None:
        """The addresses that came too late, once. Called with the lock."""
        oldest = time.monotonic() - KEPT_S
        self._late = {of: late for of, late in self._late.items() if late[0] > oldest}
        _, found = self._late.pop(place, (0.0, None))
        return found

    def _begin(self) -> None:
        try:
            threading.Thread(target=self._work, name="holdfast-resolver", daemon=True).start()
        except RuntimeError:  # No new thread can start. Running ones go on with the queue.
            with self._lock:
                self._threads -= 1
                places = [] if self._threads else list(self._queue)
                left = [lookup for place in places for lookup in self._waiting.pop(place)]
                for place in places:
                    del self._queue[place]
            _end(left, OSError("can't start a thread to look up the name"))

    def _work(self) -> None:
        """Handles queued lookups until the queue is empty."""
        while True:
            with self._lock:
                place = next(iter(self._queue), None)
                if place is None:
                    self._threads -= 1
                    return
                del self._queue[place]
            outcome = _outcome(*place)
            with self._lock:
                lookups = self._waiting.pop(place)
                if not (lookups or isinstance(outcome, OSError)):
                    self._late[place] = time.monotonic(), outcome
            _end(lookups, outcome)


CONFIGURED = Resolver()
"""For names that configurations and callers of the library give: brokers, devices, servers. Names
that requests bring have a pool of their own, whose threads they can't take from these."""


def _outcome(host: str, port: int | None) -> list[SocketAddress] | OSError:
    """What the system says of a name."""
    try:
        if "\0" in host:  # The system would look up only the part before the NUL.
            raise ValueError
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except OSError as error:
        return error
    except ValueError:  # IDNA or the system refuses the name, such as a label of 64 characters.
        return OSError(f"{host} is not a valid host name")
    return [(family, address) for family, *_, address in found]


def _end(waiting: Iterable[Lookup], outcome: list[SocketAddress] | OSError) -> None:
    """Hands an outcome to all who still wait for it."""
    for lookup in waiting:
        if lookup.set_running_or_notify_cancel():
            if isinstance(outcome, OSError):
                lookup.set_exception(copy.copy(outcome))
            else:
                lookup.set_result(list(outcome))

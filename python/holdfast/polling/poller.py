"""`Poller`: the native poller as a library."""

from __future__ import annotations

import heapq
import itertools
import math
import os
import threading
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Self

from holdfast import _core
from holdfast.client.base import (
    BROADCAST,
    DEFAULT_TIMEOUT_S,
    MAX_INTERVAL_S,
    MAX_TIMEOUT_S,
    MIN_INTERVAL_S,
    checked_seconds,
    is_broadcast,
)
from holdfast.client.endpoint import endpoint
from holdfast.client.requests import write_typed
from holdfast.client.url import other_name, parse, shared_connection, shared_options
from holdfast.polling.faults import LOST, fault_text
from holdfast.polling.readings import Batch, Reader
from holdfast.protocol import READ_BITS, READ_REGISTERS
from holdfast.runtime.text import listing
from holdfast.tags import Tag, TagList
from holdfast.tags.read_gap import DEFAULT_MAX_GAP

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
    from concurrent.futures import Future

    from holdfast.polling.readings import DevicePoll
    from holdfast.runtime.own_thread import OwnThread

SIGNAL_CHECK_S = 0.1
"""Seconds of one wait, between which signal handlers run."""

MAX_CONVERTING_S = 0.05
"""Seconds in which polls become values for one batch. The next batch has those that are left."""

ABANDON_CHECK_S = 1.0
"""Seconds that a thread waits for a batch, for a task that may not want it any more."""


class WriteFailed(Exception):
    """A write that a device did not confirm. It may have carried it out all the same."""

    def __init__(self, device: str, tag: str, fault: int, reason: str | None = None) -> None:
        """`reason`: the fault as text, where that of its code would mislead."""
        super().__init__(device, tag, fault, reason)
        self.device, self.tag = device, tag
        self.fault = fault
        """The code, see `holdfast.polling.faults`."""

    def __str__(self) -> str:
        reason = self.args[3] or fault_text(self.fault)
        return f"{self.device}.{self.tag}: {reason}"


class Poller:
    """Polls devices on a native thread, and hands out their values in batches.

    >>> with Poller() as poller:
    ...     poller.add("tcp://10.0.0.5", tags={"flow": ("input_registers", 0, "float32")})
    ...     for batch in poller:
    ...         print(batch.rows())

    Iterate over it from one thread or one task. `gather` is how many seconds a batch waits for the
    polls of other devices, after its first. If nobody takes batches, the oldest polls are dropped
    and counted.

    A forked child does not have the thread: `close` does nothing there, and the other methods raise
    `RuntimeError`.

    Raises `ValueError` or `TypeError` for a `gather` that is no time.
    """

    __slots__ = (
        "__weakref__",
        "_changing",
        "_connections",
        "_core_names",
        "_gather",
        "_generations",
        "_given_up",
        "_has_ended",
        "_names",
        "_numbers",
        "_places",
        "_poller",
        "_process",
        "_queued",
        "_readers",
        "_results",
        "_thread",
    )

    def __init__(self, *, gather: float = 0.01) -> None:
        self._gather = checked_seconds("gather", gather, MAX_TIMEOUT_S, 0)
        self._poller = _core.Poller([])
        self._results = self._poller.new_receiver()
        self._readers: dict[str, Reader] = {}
        """By the name in the core, see `_core_names`."""
        self._core_names: dict[str, str] = {}
        """A device that is added again has a new one: polls of the earlier device may be queued."""
        self._places: dict[str, tuple[str, str]] = {}
        """The connection of each device, by its name in the core."""
        self._connections: dict[tuple[str, str], tuple[dict[str, object], set[str]]] = {}
        """The options of each connection, and its devices."""
        self._changing = threading.RLock()
        """Of all that `add` and `remove` change. A signal handler that calls one of them does
        not wait for the call that it interrupts, but may find it half done.
        """
        self._names = itertools.count(1)
        self._generations = itertools.count(1)
        self._process = os.getpid()
        self._thread: OwnThread | None = None
        self._numbers = itertools.count()
        self._given_up: list[tuple[int, Future[Batch | None]]] = []
        """Batches that a task waited for until it was cancelled: a heap, by the order in which they
        were asked for. The first goes to whoever asks next, also in another event loop.
        """
        self._has_ended = False
        self._queued: deque[tuple[str, float, list[Any]]] = deque()

    def add(
        self,
        url: str,
        tags: TagList | Mapping[str, Tag | tuple[Any, ...]],
        *,
        name: str | None = None,
        unit: int = 1,
        interval: float = 1.0,
        timeout: float = DEFAULT_TIMEOUT_S,
        max_gap: int = DEFAULT_MAX_GAP,
        max_registers: int = READ_REGISTERS,
        max_bits: int = READ_BITS,
        in_flight: int | None = 1,
    ) -> str:
        """Polls the tags of a device every `interval` seconds. Returns its name.

        `tags` are a tag list, or by name: a `Tag`, or area, address, type and order. The name is by
        default that of the address, with a number if it is in use. `max_gap` is the largest gap, in
        bits or registers, that is read to save a request.

        Devices at one address or serial line share a connection, and so `in_flight` and the options
        of the URL.

        Raises `ValueError` for invalid arguments, a name in use, a serial line that other devices
        have under another name, and options that differ from those of another device at the
        address; `TypeError` if a time is not a number, or `tags` neither a tag list nor a mapping;
        `TagError` for an invalid tag, and `RuntimeError` after `close`.
        """
        self._check_process()
        interval = checked_seconds("interval", interval, MAX_INTERVAL_S, MIN_INTERVAL_S)
        timeout = checked_seconds("timeout", timeout, MAX_TIMEOUT_S)
        target = parse(url)
        if is_broadcast(target, unit):
            raise ValueError(f"{BROADCAST}, which can't be polled")
        listed = tags if isinstance(tags, TagList) else TagList(_tags(tags))
        if not len(listed):
            raise ValueError("tags is empty, allowed: at least one tag")
        with self._changing:
            if name is None:
                name = url.partition("://")[2] or url
                if name in self._core_names:
                    name = f"{name}#{next(self._names)}"
            if name in self._core_names:
                raise ValueError(f"device {name}: the name is already in use")
            place = shared_connection(target)
            if (other := other_name(target, self._connections)) is not None:
                named = f"{url!r} is the serial line of other devices under another name"
                raise ValueError(f"{named}, allowed: {other!r}")
            options = shared_options(target) | {"in_flight": in_flight}
            known, users = self._connections.get(place, (options, set()))
            for option, value in options.items():
                if value != known[option]:
                    others = f"but other devices at this address have {known[option]!r}"
                    raise ValueError(f"{url!r}: {option} is {value!r}, {others}, allowed: the same")
            core_name = f"{name}#{next(self._generations)}"
            reader = Reader(name, listed, max_registers, max_bits)
            self._poller.add(
                _core.PolledDevice(
                    core_name,
                    endpoint(target),
                    unit=unit,
                    interval=interval,
                    timeout=timeout,
                    reads=[],
                    fields=list(reader.fields),
                    receiver=self._results,
                    max_gap=max_gap,
                    max_registers=max_registers,
                    max_bits=max_bits,
                    in_flight=in_flight,
                    start_within=min(interval, SIGNAL_CHECK_S * len(self._readers)),
                )
            )
            users.add(core_name)
            self._connections[place] = known, users
            self._places[core_name] = place
            self._readers[core_name] = reader
            self._core_names[name] = core_name
            return name

    def remove(self, name: str) -> None:
        """Stops polling a device. Writes to it that wait are not sent, and fail.

        Raises `KeyError` for an unknown name.
        """
        self._check_process()
        with self._changing:
            core_name = self._core_name(name)
            del self._core_names[name]
            del self._readers[core_name]
            place = self._places.pop(core_name)
            _, users = self._connections[place]
            users.remove(core_name)
            if not users:
                del self._connections[place]
            self._poller.remove(core_name)

    def write(self, name: str, tag: str, value: Any) -> None:
        """Writes a value, or the name of a state, between two reads of the device.

        Returns when the device has confirmed it. Raises `KeyError` for an unknown device or tag,
        `ValueError` for a tag that is not `writable` or a value that does not fit, `WriteFailed`,
        also for a `remove` or `close` meanwhile, and `RuntimeError` after `close`. An exception of
        a signal handler, as that of Ctrl-C, ends the wait: what was not sent yet is not sent.
        """
        self._check_process()
        core_name = self._core_name(name)
        of = self._readers[core_name].named.get(tag)
        if of is None:
            raise KeyError(f"device {name} has no tag {tag!r}")
        if not of.writable:
            raise ValueError(of.unwritable or f"{tag}: writable is not true in the tag list")
        raw = of.raw(value)
        [request] = write_typed(
            of.area, of.address, raw, of.type, of.order, of.encoding, split=False
        )
        writing = self._poller.new_receiver()
        try:
            number = self._poller.write(core_name, request, writing)
            while True:
                results = writing.take(SIGNAL_CHECK_S)
                if results is None:
                    raise WriteFailed(name, tag, LOST, "the poller was closed during the write")
                for done, fault in results[1]:
                    if done == number and fault:
                        raise WriteFailed(name, tag, fault)
                    if done == number:
                        return
        finally:  # A signal handler may end it here.
            writing.withdraw()

    def counters(self) -> dict[str, dict[str, Any]]:
        """Health and counters of each device, by name."""
        self._check_process()
        counters = self._poller.counters()
        return {
            name: counters[core_name]
            for name, core_name in list(self._core_names.items())
            if core_name in counters
        }

    @property
    def dropped(self) -> int:
        """Polls that nobody has taken in time."""
        return self._results.dropped

    def take(self, timeout: float | None = None) -> Batch | None:
        """The next batch; `None` if none comes within `timeout` seconds, or after `close`.

        Raises `ValueError` or `TypeError` for a `timeout` that is no time.
        """
        self._check_process()
        if timeout is not None:
            timeout = checked_seconds("timeout", timeout, math.inf, -math.inf)
        began = time.monotonic()
        if self._given_up:
            number, asked = heapq.heappop(self._given_up)
            try:
                batch = asked.result(timeout and min(timeout, MAX_TIMEOUT_S))
            except BaseException as error:
                if asked.done() and error is asked.exception():
                    raise
                heapq.heappush(self._given_up, (number, asked))
                if isinstance(error, TimeoutError):
                    return None
                raise
            if batch is not None:
                return batch
        return self._within(timeout and timeout - (time.monotonic() - began))

    def _within(self, timeout: float | None) -> Batch | None:
        """The next batch that nobody has asked for."""
        end = None if timeout is None else time.monotonic() + timeout
        while True:
            left = SIGNAL_CHECK_S if end is None else min(SIGNAL_CHECK_S, end - time.monotonic())
            if not self._queued:
                results = self._results.take(max(0.0, left))
                if results is None:
                    self._has_ended = True
                    return None
                self._queue(results[0])
            polls = self._converted()
            if polls:
                return Batch(polls)
            if end is not None and time.monotonic() >= end:
                return None

    def _queue(self, found: list[tuple[str, float, list[Any]]]) -> None:
        self._queued += found
        if found and self._gather:
            time.sleep(self._gather)
            more = self._results.take(0.0)
            self._queued += more[0] if more is not None else []

    def _converted(self) -> list[DevicePoll]:
        """The values of queued polls, as many as fit into the time of a batch."""
        polls: list[DevicePoll] = []
        until = time.monotonic() + MAX_CONVERTING_S
        while self._queued:
            name, _, blocks = self._queued.popleft()
            reader = self._readers.get(name)
            if reader is not None:
                polls.append(reader.poll(blocks))
            if time.monotonic() >= until:
                break
        return polls

    def __iter__(self) -> Iterator[Batch]:
        while (batch := self.take()) is not None:
            yield batch

    def __aiter__(self) -> AsyncIterator[Batch]:
        return _Batches(self._next)

    async def _next(self) -> Batch | None:
        """The next batch; `None` after `close`."""
        import asyncio  # Who iterates over it without a loop does not need it.

        from holdfast.runtime.own_thread import OwnThread

        if self._thread is None:
            self._thread = OwnThread("holdfast-poller")
        while True:
            self._check_process()
            if self._given_up:
                number, asked = heapq.heappop(self._given_up)
            else:
                number = next(self._numbers)
                asked = self._thread.submit(partial(self._within, ABANDON_CHECK_S))
            try:
                batch = await asyncio.wrap_future(asked)
            except (asyncio.CancelledError, GeneratorExit):
                if not asked.cancel():  # It has begun.
                    heapq.heappush(self._given_up, (number, asked))
                raise
            if batch is not None or self._has_ended:
                return batch

    def close(self) -> None:
        """Stops polling. Batches that wait can still be taken."""
        if os.getpid() == self._process:
            self._poller.stop()

    def _core_name(self, name: str) -> str:
        """The name of a device in the core. Raises `KeyError`."""
        core_name = self._core_names.get(name)
        if core_name is None:
            raise KeyError(f"device {name!r} is unknown, allowed: {listing(self._core_names)}")
        return core_name

    def _check_process(self) -> None:
        """Raises `RuntimeError` in a forked child, which would wait for ever: also for a lock that
        the thread held when the process was forked."""
        if os.getpid() != self._process:
            raise RuntimeError("this poller works in the process that has made it, not in a child")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Batches:
    """An iteration of a task. A wait that is cancelled, as by a timeout, does not end it."""

    def __init__(self, following: Callable[[], Awaitable[Batch | None]]) -> None:
        self._following = following

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Batch:
        batch = await self._following()
        if batch is None:
            raise StopAsyncIteration
        return batch

    async def aclose(self) -> None:
        """Does nothing: another iteration goes on. For `contextlib.aclosing`."""


def _tags(tags: Mapping[str, Tag | tuple[Any, ...]]) -> Iterator[Tag]:
    if not isinstance(tags, Mapping):
        example = "{'flow': ('input_registers', 0, 'float32')}"
        allowed = f"a holdfast.TagList, or a tag for each name, as in {example}"
        raise TypeError(f"tags is a {type(tags).__name__}, allowed: {allowed}")
    for name, tag in tags.items():
        if isinstance(tag, Tag):
            yield tag if tag.name == name else replace(tag, name=name)
        elif isinstance(tag, tuple) and 2 <= len(tag) <= 4:
            # Only a tag list says what may not be written.
            tuple_tag = Tag(name, *tag)
            yield tuple_tag if tuple_tag.unwritable else replace(tuple_tag, writable=True)
        else:
            found = f"the tag {name} is {tag!r}"
            raise ValueError(f"{found}, allowed: a Tag, or (area, address, type, order)")

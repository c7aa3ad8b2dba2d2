"""The native poller, and the thread that takes what it read and wrote.

The thread hands over all polls that wait at once, and takes no more before they are dealt with:
what the event loop can't keep up with stays in the poller, which drops the oldest.
"""

from __future__ import annotations

import asyncio
import itertools
import threading
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

from holdfast import _core
from holdfast.types import PolledBlock

if TYPE_CHECKING:
    from holdfast.scanner.devices import ScannedDevice

Poll: TypeAlias = tuple[str, float, list[PolledBlock]]
"""What the device is polled as, when the schedule wanted the poll, in seconds, and its blocks."""

RESULTS_TIMEOUT = 60.0
"""Seconds that the thread waits for polls at once; it ends with the poller."""

GATHERED = 0.005
"""Seconds from one hand-over to the next, at least: so that a batch is worth its price."""

FIRST_WITHIN = 1.0
"""Seconds in which the first polls of new devices are spread."""

RENEWED = 0.1
"""Seconds from one change of what a device is polled for to the next, at least: a poll begins with
each, and a caller may ask for a thousand tags one by one."""


class Polling:
    """Devices that are polled. `take` gets each poll, in the event loop: the device, when the
    schedule wanted it, in seconds, and the blocks.
    """

    def __init__(self, take: Callable[[ScannedDevice, float, list[PolledBlock]], None]) -> None:
        self._take = take
        self._devices: dict[str, ScannedDevice] = {}
        """By what they are polled as."""
        self._renewed: dict[ScannedDevice, float] = {}
        self._waiting: dict[ScannedDevice, asyncio.TimerHandle] = {}
        self._urgent: set[ScannedDevice] = set()
        """Those of which somebody waits for values that nobody has yet."""
        self._writes: dict[int, asyncio.Future[int]] = {}
        """By the number that the poller gave them: what will have the fault."""
        self._loop = asyncio.get_running_loop()
        self._poller = _core.Poller([])
        self._names = map(str, itertools.count())
        self._stopping = threading.Event()
        self._taken = threading.Semaphore(1)
        self._thread = threading.Thread(target=self._run, name="holdfast-scan", daemon=True)
        self._thread.start()

    def renew(self, device: ScannedDevice, *, at_once: bool = True) -> None:
        """Polls a device as it is now wanted: at once, or soon if that has just changed; without
        `at_once` when it is its turn.
        """
        if at_once:
            self._urgent.add(device)
        if device in self._waiting:
            return
        left = self._renewed.get(device, 0.0) + RENEWED - self._loop.time()
        if device in self._renewed and left > 0:
            self._waiting[device] = self._loop.call_later(left, self._renew, device)
        else:
            self._renew(device)

    def _renew(self, device: ScannedDevice) -> None:
        """The name is another one with every change: what was still read for the old one is not
        taken for the new one's.
        """
        self._waiting.pop(device, None)
        at_once = device in self._urgent
        self._urgent.discard(device)
        old, name = device.polled_as, next(self._names)
        if old:
            self._poller.replace(old, _made(device, name), at_once=at_once)
            del self._devices[old]
        else:
            self._poller.add(_made(device, name))
        device.polled_as = name
        self._devices[name] = device
        self._renewed[device] = self._loop.time()

    def drop(self, device: ScannedDevice) -> None:
        """Polls a device no more; its connection is closed."""
        waiting = self._waiting.pop(device, None)
        if waiting is not None:
            waiting.cancel()
        self._urgent.discard(device)
        self._poller.remove(device.polled_as)
        del self._devices[device.polled_as]
        del self._renewed[device]

    async def write(self, device: ScannedDevice, request: _core.Request) -> int:
        """Sends a write to a device between two reads; the fault, 0 when it was confirmed."""
        number = self._poller.write(device.polled_as, request)
        done: asyncio.Future[int] = self._loop.create_future()
        self._writes[number] = done
        try:
            return await done
        finally:
            del self._writes[number]

    def counters(self) -> dict[str, dict[str, Any]]:
        """How the poller sees its devices, by what they are polled as."""
        return self._poller.counters()

    @property
    def dropped(self) -> int:
        """Polls that were lost because the event loop did not keep up."""
        return self._poller.dropped

    async def stop(self) -> None:
        """Polls nothing any more."""
        self._stopping.set()
        self._taken.release()
        for waiting in self._waiting.values():
            waiting.cancel()
        await asyncio.to_thread(self._end)

    def _end(self) -> None:
        self._poller.stop()
        self._thread.join()

    def _run(self) -> None:
        while (taken := self._poller.results(RESULTS_TIMEOUT)) is not None:
            self._taken.acquire()
            if self._stopping.is_set():
                return
            self._loop.call_soon_threadsafe(self._hand_over, *taken)
            self._stopping.wait(GATHERED)

    def _hand_over(self, polls: Sequence[Poll], writes: Sequence[tuple[int, int]]) -> None:
        try:
            for number, fault in writes:
                done = self._writes.get(number)
                if done is not None and not done.done():
                    done.set_result(fault)
            for name, due, blocks in polls:
                device = self._devices.get(name)
                if device is not None:
                    self._take(device, due, blocks)
        finally:
            self._taken.release()


def _made(device: ScannedDevice, name: str) -> _core.PolledDevice:
    source, plan = device.source, device.source.plan
    assert device.endpoint is not None
    interval = device.rate / 1000
    reads = dict.fromkeys((tag.area, tag.address, tag.count, None) for tag in device.tags.values())
    return _core.PolledDevice(
        name,
        device.endpoint,
        unit=source.unit,
        interval=interval,
        timeout=source.timeout / 1000,
        reads=list(reads),
        max_gap=plan.max_gap,
        max_registers=plan.max_registers,
        max_bits=plan.max_bits,
        readable=plan.readable,
        forbidden=plan.forbidden,
        start_within=min(interval, FIRST_WITHIN),
        report=True,
        release=source.release,
    )

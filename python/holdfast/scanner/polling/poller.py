"""The native poller, and the thread that passes its results to the event loop.

In an appliance, the poller is that of the appliance, so that devices at one address share one
connection.

The thread passes all waiting results at once, and fetches no more until they are handled. The event
loop handles them in short turns, so that requests are answered in between. If it can't keep up,
older polls of a device are skipped, and results stay in the poller, which drops the oldest.
"""

from __future__ import annotations

import asyncio
import itertools
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

from holdfast import _core
from holdfast.scanner.errors import STOPPING, NotConfirmed, Refused
from holdfast.types import PolledBlock

if TYPE_CHECKING:
    from holdfast.scanner.subscriptions.device import ScannedDevice

Poll: TypeAlias = tuple[str, float, list[PolledBlock]]
"""The device's name in the poller, the scheduled time in seconds, and the blocks."""

RESULTS_TIMEOUT_S = 60.0
"""Time of one wait for results. Stopping the poller ends the wait."""

WAKE_INTERVAL_S = 0.1
"""Time between wake-ups of a thread that has to end."""

MIN_BATCH_INTERVAL_S = 0.005
"""The shortest time between two batches, so that batches have a useful size."""

TURN_S = 0.01
"""Time of polls that the event loop handles before it does anything else."""

MAX_LAG_S = 1.0
"""Time after which the result of a poll is skipped if a newer one of its device waits."""

FIRST_POLL_SPREAD_S = 1.0
"""Time over which the first polls of new devices are spread; for devices of the configuration, the
`MAX_FIRST_POLL_SPREAD` of crates/engine/src/poller/schedule.rs."""

PREFIX = "nats/"
"""The beginning of the names of devices in the poller. Names in a configuration have no slash."""

NUMBERS = itertools.count()
"""A restarted scanner continues with the next number."""

MIN_CHANGE_INTERVAL_S = 0.1
"""The shortest time between two changes of a device in the poller. Each change starts a
poll, and a caller may subscribe to a thousand tags one by one."""


class Polling:
    """Polls devices, from `start` on."""

    def __init__(
        self,
        poller: _core.Poller | None = None,
        fence: Callable[[ScannedDevice], _core.Fence | None] = lambda _: None,
        exact_pauses_s: tuple[float, float] | None = None,
    ) -> None:
        """`fence` returns what says when another node may poll a device.

        `exact_pauses_s` are the first and the longest pause after failures, without jitter.
        """
        self._fence = fence
        self._exact_pauses_s = exact_pauses_s
        self._devices: dict[str, ScannedDevice] = {}
        """The devices by their name in the poller."""
        self._changed: dict[ScannedDevice, tuple[float, _core.Endpoint | None]] = {}
        """When each device was changed last, and its address since then."""
        self._pending_changes: dict[ScannedDevice, asyncio.TimerHandle] = {}
        self._paused: set[ScannedDevice] | None = None
        """The devices to poll when polling is resumed; `None` while it is not paused."""
        self._urgent: set[ScannedDevice] = set()
        """Devices that must be polled immediately, because a new subscriber waits for values."""
        self._skipped = 0
        self._writes: dict[int, asyncio.Future[int]] = {}
        """Futures of the faults of pending writes, by the number from the poller."""
        self._shared_poller = poller
        self._stopping = threading.Event()
        self._may_take = threading.Semaphore(1)
        self._thread = threading.Thread(target=self._run, name="holdfast-scan", daemon=True)

    def start(self, on_poll: Callable[[ScannedDevice, float, list[PolledBlock]], None]) -> None:
        """Calls `on_poll` in the running event loop for each poll.

        Its arguments are the device, the scheduled time in seconds, and the blocks.
        """
        self._on_poll = on_poll
        self._loop = asyncio.get_running_loop()
        self._poller = _core.Poller([]) if self._shared_poller is None else self._shared_poller
        self._results = self._poller.new_receiver()
        self._thread.start()

    def renew(self, device: ScannedDevice, *, at_once: bool = True) -> None:
        """Updates a device in the poller, at most every `MIN_CHANGE_INTERVAL_S` seconds.

        With `at_once`, it is then polled immediately, otherwise at its next scheduled time. While
        polling is paused, it is polled when that ends. Raises `Refused` after `stop`.
        """
        if self._stopping.is_set():
            raise Refused(STOPPING)
        if self._paused is not None:
            self._paused.add(device)
            return
        if at_once:
            self._urgent.add(device)
        if device in self._pending_changes:
            return
        changed_at, _ = self._changed.get(device, (-math.inf, None))
        left = changed_at + MIN_CHANGE_INTERVAL_S - self._loop.time()
        if left > 0:
            self._pending_changes[device] = self._loop.call_later(left, self._renew, device)
        else:
            self._renew(device)

    def _renew(self, device: ScannedDevice) -> None:
        """Replaces a device in the poller.

        The current poll completes, and counts: its blocks have addresses, so they are right for any
        tags. If it did not, a device that is changed often would have no values and no health. A
        device that has moved gets a new name, so that results from its old address are discarded.
        """
        self._pending_changes.pop(device, None)
        at_once = device in self._urgent
        self._urgent.discard(device)
        old, (_, address) = device.polled_as, self._changed.get(device, (None, None))
        name = old if old and address is device.endpoint else f"{PREFIX}{next(NUMBERS)}"
        if old:
            self._poller.replace(old, self._native(device, name), at_once=at_once)
            del self._devices[old]
        else:
            self._poller.add(self._native(device, name))
        device.polled_as = name
        self._devices[name] = device
        self._changed[device] = (self._loop.time(), device.endpoint)

    def drop(self, device: ScannedDevice) -> None:
        """Stops polling a device and closes its connection, if it is polled."""
        if self._paused is not None:
            self._paused.discard(device)
        if not device.polled_as:
            return
        waiting = self._pending_changes.pop(device, None)
        if waiting is not None:
            waiting.cancel()
        self._urgent.discard(device)
        self._poller.remove(device.polled_as)
        del self._devices[device.polled_as]
        del self._changed[device]

    def pause(self) -> None:
        """Stops polling all devices and closes their connections, until `resume`."""
        devices = set(self._devices.values())
        for device in devices:
            self.drop(device)
            device.polled_as = ""
        self._paused = devices if self._paused is None else self._paused | devices

    def resume(self) -> None:
        """Polls all devices again."""
        devices, self._paused = self._paused, None
        if devices and not self._stopping.is_set():
            for device in devices:
                self.renew(device)

    async def write(self, device: ScannedDevice, request: _core.Request, *, within: float) -> int:
        """Sends a write between two reads. Returns the fault, or 0 when the device confirmed it.

        What can't be sent `within` seconds, and one timeout of the device, is not sent.

        Raises `Refused` while polling is paused, and after `stop`.
        """
        if self._stopping.is_set():
            raise Refused(f"not written: {STOPPING}")
        if self._paused is not None:
            raise Refused("not written: the scanner is disabled")
        number = self._poller.write(device.polled_as, request, self._results, within=within)
        done: asyncio.Future[int] = self._loop.create_future()
        self._writes[number] = done
        try:
            return await done
        except asyncio.CancelledError:  # By the end of the responder. It may have been sent.
            raise NotConfirmed(f"not confirmed: {STOPPING}") from None
        finally:
            del self._writes[number]

    def _native(self, device: ScannedDevice, name: str) -> _core.PolledDevice:
        source, plan = device.source, device.source.plan
        assert device.endpoint is not None
        interval = device.rate / 1000
        fence = self._fence(device)
        reads = dict.fromkeys(
            (tag.area, tag.span.start, len(tag.span), None) for tag in device.tags.values()
        )
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
            # A device that was taken over has waited already.
            start_within=min(interval if fence is None else interval / 2, FIRST_POLL_SPREAD_S),
            receiver=self._results,
            release=source.release,
            retry=self._exact_pauses_s,
            jitter=self._exact_pauses_s is None,
            fence=fence,
        )

    def counters(self) -> dict[str, dict[str, Any]]:
        """Returns the poller's counters of each device, by its name in the poller."""
        return self._poller.counters(receiver=self._results)

    @property
    def dropped(self) -> int:
        """Polls lost because the event loop did not keep up."""
        return self._results.dropped + self._skipped

    async def stop(self) -> None:
        """Stops polling its devices, and closes the connections that nobody else uses."""
        self._stopping.set()
        self._may_take.release()
        for waiting in self._pending_changes.values():
            waiting.cancel()
        for name in self._devices:
            self._poller.remove(name)
        await asyncio.to_thread(self._end)

    def _end(self) -> None:
        if self._shared_poller is None:
            self._poller.stop()
        while self._thread.is_alive():
            # A wake-up that comes before the wait may have ended another one.
            self._results.wake()
            self._thread.join(WAKE_INTERVAL_S)

    def _run(self) -> None:
        while (taken := self._results.take(RESULTS_TIMEOUT_S)) is not None:
            if not any(taken):
                if self._stopping.is_set():
                    return
                continue
            # The event loop has handled the last batch: otherwise results would pile up in it.
            self._may_take.acquire()
            if self._stopping.is_set():
                return
            self._loop.call_soon_threadsafe(self._hand_over, *taken)
            # Not a wait for the stop: on some Pythons, that follows a clock which may be set back.
            time.sleep(MIN_BATCH_INTERVAL_S)

    def _hand_over(self, polls: Sequence[Poll], writes: Sequence[tuple[int, int]]) -> None:
        for number, fault in writes:
            done = self._writes.get(number)
            if done is not None and not done.done():
                done.set_result(fault)
        self._handle(deque(self._timely(polls)))

    def _timely(self, polls: Sequence[Poll]) -> list[Poll]:
        """All polls, or without those that are too late to matter."""
        newest = {name: index for index, (name, _, _) in enumerate(polls)}
        if len(newest) == len(polls):  # As long as the event loop keeps up.
            return list(polls)
        past = time.time() - MAX_LAG_S
        timely = [
            poll
            for index, poll in enumerate(polls)
            if newest[poll[0]] == index or not poll[2] or poll[2][-1][5] > past
        ]
        self._skipped += len(polls) - len(timely)
        return timely

    def _handle(self, polls: deque[Poll]) -> None:
        until = self._loop.time() + TURN_S
        if self._stopping.is_set():
            polls.clear()
        try:
            while polls:
                name, due, blocks = polls.popleft()
                device = self._devices.get(name)
                if device is not None:  # Else it was removed meanwhile, or has moved.
                    self._on_poll(device, due, blocks)
                if self._loop.time() >= until:
                    break
        finally:
            if polls:
                self._loop.call_soon(self._handle, polls)
            else:
                self._may_take.release()

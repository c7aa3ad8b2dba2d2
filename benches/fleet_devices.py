"""Runs Modbus devices that judge a fleet, one on each address of 127.0.0.0/8.

A device notes polls that are late, polls that overlap, and a second connection beside the first.
The argument is the interval in seconds at which devices are polled. For each line on standard
input, the figures since the previous line are printed as JSON.
"""

from __future__ import annotations

import asyncio
import json
import math
import resource
import sys
import time
from typing import Any

DELAY = 0.005
"""Seconds that a device takes to answer."""

LATE = 1.5
"""Intervals without a poll after which one counts as missed."""


class Device:
    """One device, from its first connection on."""

    __slots__ = ("asking", "connections", "last")

    def __init__(self) -> None:
        self.connections = 0
        self.asking: Connection | None = None
        self.last = math.nan


class Judge:
    """All devices, and what they have noted."""

    def __init__(self, interval: float) -> None:
        self.interval = interval
        self.devices: dict[str, Device] = {}
        self.reset()

    def reset(self) -> None:
        """Begins to count anew."""
        self.polls = self.missed = self.doubles = self.overlaps = 0
        self.longest = 0.0

    def polled(self, device: Device, now: float) -> None:
        """Counts a poll."""
        self.polls += 1
        gap = now - device.last
        if gap > self.longest:  # False for the first poll.
            self.longest = gap
        if gap > LATE * self.interval:
            self.missed += round(gap / self.interval) - 1
        device.last = now

    def report(self) -> dict[str, Any]:
        """Returns the figures, with those of devices that wait for a poll."""
        now = time.monotonic()
        gaps = [now - device.last for device in self.devices.values()]
        waiting = [gap for gap in gaps if gap > LATE * self.interval]
        found = {
            "devices": len(self.devices),
            "polls": self.polls,
            "missed": self.missed + len(waiting),
            "longest": max([self.longest, *waiting]),
            "doubles": self.doubles,
            "overlaps": self.overlaps,
        }
        self.reset()
        return found


class Connection(asyncio.Protocol):
    """A connection to one device. All registers are 0."""

    def __init__(self, judge: Judge) -> None:
        self._judge = judge

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Finds the device by the address of this side."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        address = transport.get_extra_info("sockname")[0]
        self._device = self._judge.devices.setdefault(address, Device())
        self._judge.doubles += self._device.connections > 0
        self._device.connections += 1

    def connection_lost(self, _: Exception | None) -> None:
        """Notes that the device has one connection less."""
        self._device.connections -= 1
        if self._device.asking is self:
            self._device.asking = None

    def data_received(self, data: bytes) -> None:
        """Answers a request, of which the scanner sends one at a time."""
        device, judge = self._device, self._judge
        judge.overlaps += device.asking not in (None, self)
        device.asking = self
        judge.polled(device, time.monotonic())
        size = 2 * int.from_bytes(data[10:12])
        reply = data[:4] + (3 + size).to_bytes(2) + data[6:8] + bytes([size]) + bytes(size)
        asyncio.get_running_loop().call_later(DELAY, self._answer, reply)

    def _answer(self, reply: bytes) -> None:
        self._device.asking = None
        self._transport.write(reply)


async def main() -> None:
    """Serves until standard input is closed."""
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    loop = asyncio.get_running_loop()
    judge = Judge(float(sys.argv[1]))
    server = await loop.create_server(lambda: Connection(judge), "0.0.0.0", 0, backlog=4096)
    print(f"listening 127.0.0.1:{server.sockets[0].getsockname()[1]}", flush=True)
    reader = asyncio.StreamReader()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    while await reader.readline():
        print(json.dumps(judge.report()), flush=True)


asyncio.run(main())

"""Devices and results of the native poller."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

from holdfast._core import Endpoint, PolledDevice, Poller
from support import wire

if TYPE_CHECKING:
    from collections.abc import Callable

    from holdfast._core import Link, Memory, Passage, Request
    from holdfast.types import Area
    from support.fake_device import Stream

Made: TypeAlias = "partial[PolledDevice]"
"""A device, but for the receiver of its polls."""

TIMEOUT, REFUSED, RESET, INVALID = 0x8001, 0x8002, 0x8003, 0x8004
EXPIRED, WITHDRAWN = 0x800A, 0x800C


class ReportingPoller:
    """A poller with one receiver, which takes the polls of all devices."""

    def __init__(self) -> None:
        self._poller = Poller([])
        self.results = self._poller.new_receiver()

    def add(self, device: Made) -> None:
        self._poller.add(device(receiver=self.results))

    def replace(self, name: str, device: Made, *, at_once: bool = True) -> None:
        self._poller.replace(name, device(receiver=self.results), at_once=at_once)

    def write(self, name: str, request: Request, *, within: float | None = None) -> int:
        return self._poller.write(name, request, self.results, within=within)

    def passage(self, memory: Memory, *ranges: tuple[Area, int, int, str, int, bool]) -> Passage:
        return self._poller.passage(memory, ranges)

    def link(self, endpoint: Endpoint) -> Link:
        return self._poller.link(endpoint)

    def forget_links(self) -> None:
        """Forgets all links that no device has."""
        self._poller.forget_links([])

    def remove(self, name: str) -> bool:
        return self._poller.remove(name)

    def counters(self) -> dict[str, dict[str, Any]]:
        return self._poller.counters()

    def stop(self) -> None:
        self._poller.stop()


def device(fake: Stream, name: str = "a", *, transport: Any = "tcp", **more: Any) -> Made:
    return device_at(Endpoint.network(transport, "127.0.0.1", fake.port), name, **more)


def device_at(endpoint: Endpoint, name: str, **more: Any) -> Made:
    settings: dict[str, Any] = {
        "unit": 1,
        "interval": 3600.0,
        "timeout": 10.0,
        "reads": [("holding_registers", 0, 1, None)],
        "start_within": 0.0,
    }
    return partial(PolledDevice, name, endpoint, **(settings | more))


def taken(
    poller: ReportingPoller, wanted: Callable[[list[Any], list[Any]], object]
) -> tuple[Any, Any]:
    """Collects polls and writes until `wanted` accepts them. Returns all of them."""
    polls: list[Any] = []
    writes: list[Any] = []

    def come() -> bool:
        found = poller.results.take(0.05)
        assert found is not None
        polls.extend(found[0])
        writes.extend(found[1])
        return bool(wanted(polls, writes))

    wire.until(come, "everything has come")
    return polls, writes


def written(poller: ReportingPoller, number: int) -> int:
    """Returns the fault of a write."""
    _, writes = taken(poller, lambda _, writes: number in dict(writes))
    fault: int = dict(writes)[number]
    return fault

"""Devices and results of the native poller."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast._core import Endpoint, PolledDevice, Poller
from support import wire

if TYPE_CHECKING:
    from collections.abc import Callable

    from support.polled import Fake

TIMEOUT, REFUSED, RESET, INVALID = 0x8001, 0x8002, 0x8003, 0x8004


def device(fake: Fake, name: str = "a", **more: Any) -> PolledDevice:
    settings: dict[str, Any] = {
        "unit": 1,
        "interval": 3600.0,
        "timeout": 10.0,
        "reads": [("holding_registers", 0, 1, None)],
        "start_within": 0.0,
        "report": True,
    }
    return PolledDevice(name, Endpoint.network("tcp", "127.0.0.1", fake.port), **(settings | more))


def taken(poller: Poller, wanted: Callable[[list[Any], list[Any]], object]) -> tuple[Any, Any]:
    """Collects polls and writes until `wanted` accepts them. Returns all of them."""
    polls: list[Any] = []
    writes: list[Any] = []

    def come() -> bool:
        found = poller.results(0.05)
        assert found is not None
        polls.extend(found[0])
        writes.extend(found[1])
        return bool(wanted(polls, writes))

    wire.until(come, "everything has come")
    return polls, writes


def written(poller: Poller, number: int) -> int:
    """Returns the fault of a write."""
    _, writes = taken(poller, lambda _, writes: number in dict(writes))
    fault: int = dict(writes)[number]
    return fault

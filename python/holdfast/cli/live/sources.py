"""The sources of `holdfast watch`; those of an appliance are in `appliance_sources`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import click

from holdfast.cli import answers, terminal_text
from holdfast.cli.device_errors import hint, problem
from holdfast.cli.options.device import read_raw
from holdfast.cli.terminal_text import print_json
from holdfast.types import BIT_AREAS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.client import SyncClient
    from holdfast.types import Area

MAX_ADDRESSES = 8192
"""Maximum number of watched addresses: more fit on no screen, and reading them is slow."""


@dataclass(frozen=True)
class WatchedRange:
    """A watched range of addresses."""

    memory: str | None
    """The memory; `None` for a device."""
    unit: int
    """The unit id of the device, or of the memory at the listener."""
    area: Area
    address: int
    count: int


class Unreadable(Exception):
    """The source answered with an error."""


class Unwatchable(Exception):
    """The appliance of a configuration can't be watched."""


class Source(Protocol):
    """A source of values. `read` raises `ModbusError`, `Unreadable` or `OSError`."""

    where: str
    url: str
    blocks: list[WatchedRange]

    def read(self) -> list[list[int]]:
        """Reads the values of each block."""

    def close(self) -> None:
        """Closes the connection."""


class DeviceSource:
    """Blocks of a device, read over Modbus."""

    def __init__(
        self, where: str, url: str, client: SyncClient, blocks: Sequence[WatchedRange]
    ) -> None:
        self.where = where
        self.url = url
        self.blocks = list(blocks)
        self._client = client

    def read(self) -> list[list[int]]:
        """Reads the values of each block."""
        return [self._values(block) for block in self.blocks]

    def _values(self, block: WatchedRange) -> list[int]:
        # Some devices refuse to read a part of a value: a request ends at an even distance.
        element = 1 if block.area in BIT_AREAS or block.count % 2 else 2
        place = (block.area, block.address, block.count)
        return read_raw(self._client, *place, element=element, unit=block.unit)

    def close(self) -> None:
        """Closes the connection."""
        self._client.close()


def within(
    blocks: Sequence[WatchedRange], area: Area, address: int, count: int
) -> list[WatchedRange]:
    """The parts of blocks inside a range of an area."""
    found = []
    for block in blocks:
        first = max(block.address, address)
        end = min(block.address + block.count, address + count)
        if block.area == area and first < end:
            found.append(WatchedRange(block.memory, block.unit, area, first, end - first))
    return found


def cut(
    blocks: Sequence[WatchedRange], most: int = MAX_ADDRESSES
) -> tuple[list[WatchedRange], int]:
    """The first `most` addresses of the blocks, and how many addresses were cut off."""
    left, kept = most, []
    for block in blocks:
        count = min(block.count, left)
        if count:
            kept.append(WatchedRange(block.memory, block.unit, block.area, block.address, count))
        left -= count
    total = sum(block.count for block in blocks)
    return kept, total - sum(block.count for block in kept)


def print_error(error: object, url: str) -> None:
    """Prints why a later reading failed: watching goes on."""
    if answers.wanted():
        now = {"time": terminal_text.timestamp()}
        print_json({"ok": False, "target": url, **now, **problem(error)})
    else:
        click.echo(f"{terminal_text.clock()}  {error}")
        hint(error, url)

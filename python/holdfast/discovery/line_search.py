"""Finds the devices of a serial line whose settings are unknown.

Everything is read; nothing is written.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from holdfast.client import SyncClient
from holdfast.discovery.device_search import Unit, probe
from holdfast.errors import ConnectFailed

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from holdfast.client.serial_settings import Parity

LINE_UNITS = tuple(range(1, 11))
"""Unit ids to try on a serial line: each takes a timeout, with each of its settings."""

BAUDS = (9600, 19200, 38400, 57600, 115200, 4800, 2400, 1200)
PARITIES: tuple[Parity, ...] = ("none", "even", "odd")
"""The settings to try, the most common first."""


@dataclass(frozen=True)
class LineSettings:
    """Settings of a serial line."""

    baud: int
    parity: Parity

    def url(self, mode: str, device: str) -> str:
        """The URL of the line with these settings."""
        stop = "&stop_bits=1" if self.parity == "none" else ""
        return f"{mode}://{device}?baud={self.baud}&parity={self.parity}{stop}"


@dataclass(frozen=True)
class Attempt:
    """An attempt to find a device on a line."""

    settings: LineSettings
    found: Unit
    is_usable: bool = True
    """Whether the line can be opened with these settings."""
    longest_late: float = 0.0
    """How many seconds the slowest late reply with these settings took so far."""


def attempts(
    mode: str,
    device: str,
    settings: Sequence[LineSettings],
    unit_ids: Sequence[int],
    timeout: float,
) -> Iterator[Attempt]:
    """Asks unit ids with each setting, and yields every attempt: the first unit id with all
    settings, then the others. Ends after the unit ids of the first setting that has an answer.

    Raises `ConnectFailed` if the line can't be opened with any setting.
    """
    failures: dict[LineSettings, ConnectFailed] = {}
    for part in (unit_ids[:1], unit_ids[1:]):
        for each in settings:
            if each in failures:
                continue
            answered = False
            with SyncClient(each.url(mode, device), timeout=timeout) as client:
                for unit in part:
                    try:
                        found = probe(client, unit)
                    except ConnectFailed as error:
                        failures[each] = error
                        refused = Unit(unit, answers=False, detail=error.detail)
                        yield Attempt(each, refused, is_usable=False)
                        break
                    answered = answered or found.answers
                    yield Attempt(each, found, longest_late=client.longest_late)
                if answered:
                    for unit in unit_ids[1:] if part == unit_ids[:1] else ():
                        found = probe(client, unit)
                        yield Attempt(each, found, longest_late=client.longest_late)
                    return
        if len(failures) == len(settings):
            raise failures[settings[0]]

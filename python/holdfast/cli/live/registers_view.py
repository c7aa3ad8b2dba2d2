"""The live view of `holdfast watch`: all values, with changes highlighted, and their rates."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from rich.text import Text

from holdfast.cli import terminal_text
from holdfast.cli.live.changes import Tracker
from holdfast.cli.live.screen import FADE_READINGS, FRESH, RECENT, Screen
from holdfast.cli.live.sources import Unreadable
from holdfast.errors import ModbusError
from holdfast.types import BIT_AREAS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.cli.live.sources import Source, WatchedRange

MAX_RATES = 8
"""Maximum number of lines for rates of change."""


class View(Screen):
    """Shows all values of blocks, starting with the reading `first`."""

    def __init__(
        self, source: Source, first: Sequence[Sequence[int]], every: float, note: str | None
    ) -> None:
        super().__init__(source.where, every, note)
        self._source = source
        self._tracker = Tracker(source.blocks)
        self._tracker.update(time.monotonic(), first)
        self._errors = 0
        self.error: Exception | None = None
        """The error of the last reading."""

    def read(self) -> None:
        """Reads all blocks."""
        try:
            values = self._source.read()
        except (ModbusError, Unreadable, OSError) as error:
            self._errors += 1
            self.error = error
        else:
            self.error = None
            self._tracker.update(time.monotonic(), values)

    def state(self) -> tuple[int, int, str]:
        """The numbers of readings and of errors, and the error of the last reading, or ""."""
        return self._tracker.readings, self._errors, str(self.error or "")

    def body(self, width: int) -> list[Text]:
        """All blocks, each under its name."""
        lines: list[Text] = []
        for index, block in enumerate(self._tracker.blocks):
            if lines:
                lines.append(Text())
            lines.append(Text(_name(block), "bold"))
            lines += self._block(index, block, width)
        return lines

    def _block(self, index: int, block: WatchedRange, width: int) -> list[Text]:
        cell = 2 if block.area in BIT_AREAS else 6
        most = 32 if cell == 2 else 16
        columns = max(1, min(most, 1 << max(0, (max(1, (width - 6) // cell)).bit_length() - 1)))
        values = self._tracker.values[index]
        lines = []
        for start in range(0, block.count, columns):
            line = Text.assemble((f"{block.address + start:>5} ", "dim"))
            for offset in range(start, min(start + columns, block.count)):
                text = str(int(values[offset]))
                line.append(" " * (cell - len(text)))
                line.append(text, self._style(index, block.address + offset))
            lines.append(line)
        return lines

    def _style(self, index: int, address: int) -> str:
        age = self._tracker.age(index, address)
        if self.error is not None:
            return "dim"
        if age is None or age >= FADE_READINGS:
            return ""
        return FRESH if age == 0 else RECENT

    def foot(self) -> list[Text]:
        """The latest changes: value, rate and number of changes."""
        rows = []
        for block, address, value, history in self._tracker.latest(MAX_RATES):
            rate = history.rate(self._tracker.at)
            unit = "changes/s" if block.area in BIT_AREAS else "/s"
            rows.append(
                f"{_name(block)} {address}: {value:>5}   {rate:+.3g} {unit}   "
                f"{terminal_text.counted(history.changes, 'change')}"
            )
        return [Text("changing", "bold"), *map(Text, rows)] if rows else []


def _name(block: WatchedRange) -> str:
    return block.area if block.memory is None else f"{block.memory} {block.area}"

"""The live view of `holdfast watch`: all values, with changes highlighted, and their rates."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from rich.text import Text

from holdfast.cli import terminal_text
from holdfast.cli.live import highlight
from holdfast.cli.live.changes import Tracker
from holdfast.cli.live.screen import (
    CUT,
    Screen,
    whole,
    with_whole_parts,
)
from holdfast.cli.live.sources import Unreadable
from holdfast.errors import ModbusError
from holdfast.types import BIT_AREAS, SHORT_OF

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
            lines.append(Text(_named(block, "", width), "bold"))
            lines += self._block(index, block, width)
        return lines

    def _block(self, index: int, block: WatchedRange, width: int) -> list[Text]:
        cell = 2 if block.area in BIT_AREAS else 6
        most = 32 if cell == 2 else 16
        cell = max(1, min(cell, width - 6))
        columns = max(1, min(most, 1 << max(0, (max(1, (width - 6) // cell)).bit_length() - 1)))
        values = self._tracker.values[index]
        lines = []
        for start in range(0, block.count, columns):
            line = Text.assemble((f"{block.address + start:>5} ", "dim"))
            for offset in range(start, min(start + columns, block.count)):
                text = whole(str(int(values[offset])), cell)
                line.append(" " * (cell - len(text)))
                line.append(text, self._style(index, block.address + offset))
            lines.append(line)
        return lines

    def _style(self, index: int, address: int) -> str:
        if self.error is not None:
            return "dim"
        return highlight.style(self._tracker.age(index, address))

    def foot(self, width: int) -> list[Text]:
        """The latest changes: value, rate and number of changes."""
        rows = []
        for block, address, value, history in self._tracker.latest(MAX_RATES):
            rate = history.rate(self._tracker.at)
            unit = "changes/s" if block.area in BIT_AREAS else "/s"
            line = _named(block, f" {address}: {value:>5}", width)
            if len(line) > width:
                line = _named(block, f" {address}: {CUT}", width)
            parts = (f"{rate:+.3g} {unit}", terminal_text.counted(history.changes, "change"))
            rows.append(with_whole_parts(Text(line), [(part, "") for part in parts], width))
        return [Text("changing", "bold"), *rows] if rows else []


def _named(block: WatchedRange, end: str, width: int) -> str:
    """The name of a block, and what ends its line.

    On a narrow terminal, the area is short and the name of the memory is cut, which leaves the
    addresses of two areas distinct.
    """
    memory = "" if block.memory is None else f"{block.memory} "
    line = f"{memory}{block.area}{end}"
    if len(line) <= width:
        return line
    line = f"{SHORT_OF[block.area]}{end}"
    room = width - len(line)
    if len(memory) > room:
        memory = f"{memory[: room - 2]}{CUT} " if room >= 2 else ""
    return memory + line

"""The live view of `holdfast watch`: all values, with changes highlighted, and their rates."""

from __future__ import annotations

import contextlib
import math
import signal
import time
from typing import TYPE_CHECKING

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from holdfast.cli import keys, pace, showing
from holdfast.cli.sources import Unreadable
from holdfast.cli.watching import Tracker
from holdfast.errors import ModbusError
from holdfast.types import BIT_AREAS

if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import FrameType

    from holdfast.cli.keys import Wait
    from holdfast.cli.sources import Source, WatchedRange

SIZE_CHECK_INTERVAL = 0.2
"""Seconds between checks of the size of the terminal."""

FADE = 3
"""Readings for which a change stays highlighted."""

RATES = 8
"""Maximum number of lines for rates of change."""

TURNS = {
    **dict.fromkeys(("n", " ", "\x1b[6~", "\x1b[B"), 1),
    **dict.fromkeys(("p", "b", "\x1b[5~", "\x1b[A"), -1),
}
"""Keys that turn pages: letters, page down and up, arrows."""

FRESH = "bold reverse yellow"
RECENT = "bold yellow"


class Quit(Exception):
    """The user ends the view."""


class View:
    """The screen, redrawn after every reading and when its size changes."""

    def __init__(self, source: Source, every: float, note: str | None) -> None:
        self._source = source
        self._every = every
        self._note = note
        self._tracker = Tracker(source.blocks)
        self._errors = 0
        self._error: str | None = None
        self._page = 0
        self._pages = 1
        self._console = Console()
        self._live = Live(console=self._console, screen=True, auto_refresh=False)
        self._size = self._console.size

    def run(self, first: Sequence[Sequence[int]], times: int | None) -> None:
        """Shows readings until q or Ctrl-C, starting with the reading `first`."""
        self._tracker.update(time.monotonic(), first)
        before = signal.signal(signal.SIGTERM, _quit)
        try:
            with contextlib.suppress(Quit, KeyboardInterrupt), keys.keys() as wait, self._live:
                ticks = pace.ticks(self._every, times, lambda left: self._wait(wait, left))
                for tick in ticks:
                    if tick:
                        self._read()
                    self._draw()
        finally:
            signal.signal(signal.SIGTERM, before)

    def _read(self) -> None:
        try:
            values = self._source.read()
        except (ModbusError, Unreadable, OSError) as error:
            self._errors += 1
            self._error = str(error)
        else:
            self._error = None
            self._tracker.update(time.monotonic(), values)

    def _wait(self, wait: Wait, left: float) -> None:
        """Waits for a key or a short time, and handles keys."""
        pressed = wait(min(left, SIZE_CHECK_INTERVAL))
        for key in [pressed] if pressed.startswith("\x1b") else pressed:
            if key in ("q", "Q", keys.END):
                raise Quit
            self._page = max(0, min(self._page + TURNS.get(key, 0), self._pages - 1))
        if pressed or self._console.size != self._size:
            self._draw()

    def _draw(self) -> None:
        self._size = width, height = self._console.size
        rates = self._rates()
        body = self._body(width)
        room = max(1, height - 3 - (len(rates) + 1 if rates else 0))
        self._pages = pages = max(1, math.ceil(len(body) / room))
        self._page = min(self._page, pages - 1)
        shown = body[self._page * room : (self._page + 1) * room]
        keys_ = "q quits" + (f"   n, p turn pages ({self._page + 1}/{pages})" if pages > 1 else "")
        lines = [*self._head(), *shown]
        if rates:
            lines += [Text(), *rates]
        lines += [Text()] * (height - 1 - len(lines))
        lines.append(Text(keys_ + (f"   {self._note}" if self._note else ""), "dim"))
        for line in lines:
            line.truncate(width)
        self._live.update(Group(*lines), refresh=True)

    def _head(self) -> list[Text]:
        tracker = self._tracker
        counts = showing.counted(tracker.readings, "reading")
        head = Text.assemble(
            (self._source.where, "bold"),
            f"   every {self._every:g} s   {counts}   {showing.clock()[:8]}",
        )
        if self._errors:
            head.append(f"   {showing.counted(self._errors, 'error')}", "red")
        second = Text(showing.plain(self._error), "bold red") if self._error else Text()
        return [head, second]

    def _body(self, width: int) -> list[Text]:
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
        if self._error is not None:
            return "dim"
        if age is None or age >= FADE:
            return ""
        return FRESH if age == 0 else RECENT

    def _rates(self) -> list[Text]:
        """The latest changes: value, rate and number of changes."""
        rows = []
        for block, address, value, history in self._tracker.latest(RATES):
            rate = history.rate(self._tracker.at)
            unit = "changes/s" if block.area in BIT_AREAS else "/s"
            rows.append(
                f"{_name(block)} {address}: {value:>5}   {rate:+.3g} {unit}   "
                f"{showing.counted(history.changes, 'change')}"
            )
        return [Text("changing", "bold"), *map(Text, rows)] if rows else []


def _quit(_number: int, _frame: FrameType | None) -> None:
    """Ends the view by an exception, so that the terminal is restored."""
    raise Quit


def _name(block: WatchedRange) -> str:
    return block.area if block.memory is None else f"{block.memory} {block.area}"

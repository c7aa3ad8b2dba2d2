"""The screen of `holdfast watch`: lines in pages, redrawn after every reading, and its keys."""

from __future__ import annotations

import contextlib
import math
import os
import re
import time
from abc import ABC, abstractmethod
from textwrap import shorten
from typing import TYPE_CHECKING

from rich.cells import cell_len
from rich.console import Console, ConsoleDimensions, Group
from rich.control import Control
from rich.live import Live
from rich.text import Text

from holdfast.cli import standard_output, terminal_text
from holdfast.cli.live import keys, schedule
from holdfast.cli.signals import on_ctrl_z

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from holdfast.cli.live.keys import Wait

SIZE_CHECK_INTERVAL_S = 0.2
"""Between two checks of the size of the terminal."""

MIN_BODY_LINES = 3
"""The lines of a page that the foot leaves on a terminal with few lines: a heading and two more."""

MIN_FOOT_LINES = 2
"""Fewer lines of the foot, which would be its heading alone, are not shown."""

GAP = "   "
"""Between the parts of a line."""

CUT = "…"
"""Stands for what has no room on a line."""

TURNS = {
    **dict.fromkeys(("n", " ", "\x1b[6~", "\x1b[B"), 1),
    **dict.fromkeys(("p", "b", "\x1b[5~", "\x1b[A"), -1),
}
"""Keys that turn pages: letters, page down and up, arrows."""

_KEYS = re.compile(r"\x1b\[[0-9;]*[~A-Za-z]|\x1b.?|.", re.DOTALL)
"""A key: several may have been pressed since the last look."""


class Quit(Exception):
    """The user ends the view."""


class Screen(ABC):
    """The screen. Its content is redrawn after every reading and when its size changes."""

    def __init__(self, where: str, every: float, note: str | None) -> None:
        self._where = where
        self._every = every
        self._note = note
        self._page = 0
        self._pages = 1
        self._wait: Wait = lambda _: ""
        self._drawn = 0.0
        self._console = Console()
        self._live = Live(console=self._console, screen=True, auto_refresh=False)
        self._size = self._console.size

    @abstractmethod
    def read(self) -> None:
        """Reads."""

    @abstractmethod
    def body(self, width: int) -> Sequence[Text]:
        """The lines that are shown in pages."""

    @abstractmethod
    def foot(self, width: int) -> Sequence[Text]:
        """The lines below them, on every page."""

    @abstractmethod
    def state(self) -> tuple[int, int, str]:
        """The numbers of readings and of errors, and the error of the last reading, or ""."""

    def run(self, times: int | None) -> None:
        """Shows readings until q or Ctrl-C. The first one has been read before.

        Raises `KeyboardInterrupt` if the terminal was closed: nothing more can be printed.
        """
        try:
            self._show(times)
            if standard_output.is_screen():
                return
        except (OSError, KeyboardInterrupt):
            if standard_output.is_screen():
                raise
        # Its end is found by a key, by what can't be written, or by SIGHUP, in any order.
        standard_output.leave()
        raise KeyboardInterrupt

    def _show(self, times: int | None) -> None:
        with (
            contextlib.suppress(Quit, KeyboardInterrupt),
            keys.keys() as wait,
            self._live,
            on_ctrl_z(lambda: self._switch(False), lambda: self._switch(True)),
        ):
            self._wait = wait
            for tick in schedule.ticks(self._every, times, self._pause):
                if tick:
                    self.read()
                self._draw()

    def between(self) -> None:
        """Handles keys during a reading, and redraws after a while."""
        self._pause(0)
        if time.monotonic() - self._drawn > SIZE_CHECK_INTERVAL_S:
            self._draw()

    def _pause(self, left: float) -> None:
        """Waits for a key or a short time, and handles keys."""
        pressed = self._wait(min(left, SIZE_CHECK_INTERVAL_S))
        for key in _KEYS.findall(pressed):
            if key in ("q", "Q", keys.END):
                raise Quit
            self._page = max(0, min(self._page + TURNS.get(key, 0), self._pages - 1))
        if pressed or self._console.size != self._size:
            self._draw()

    def _switch(self, is_shown: bool) -> None:
        """Switches to the screen, or back to that of the shell. May interrupt the output of Rich,
        so it does without."""
        codes = f"{Control.alt_screen(is_shown)}{Control.show_cursor(not is_shown)}"
        os.write(self._console.file.fileno(), codes.encode())
        self._size = ConsoleDimensions(0, 0)  # Redraws soon, as for a new size.

    def _draw(self) -> None:
        self._drawn = time.monotonic()
        self._size = width, height = self._console.size
        body = self.body(width)
        most = height - 4 - min(len(body), MIN_BODY_LINES)
        foot = self.foot(width)[:most] if most >= MIN_FOOT_LINES else []
        room = max(1, height - 3 - (len(foot) + 1 if foot else 0))
        self._pages = pages = max(1, math.ceil(len(body) / room))
        self._page = min(self._page, pages - 1)
        shown = body[self._page * room : (self._page + 1) * room]
        lines = [*self._head(width), *shown]
        if foot:
            lines += [Text(), *foot]
        lines += [Text()] * (height - 1 - len(lines))
        del lines[height - 1 :]
        lines.append(self._keys(width))
        for line in lines:
            line.truncate(width, overflow="ellipsis")
        self._live.update(Group(*lines), refresh=True)

    def _keys(self, width: int) -> Text:
        """The keys, the page, and the note."""
        line = Text("q quits", "dim")
        if self._pages > 1:
            page = f"({self._page + 1}/{self._pages})"
            is_wide = len(f"{line}{GAP}n, p turn pages {page}") <= width
            line.append(f"{GAP}n, p {'turn pages ' if is_wide else ''}{page}")
        if self._note:
            room = max(1, width - line.cell_len - len(GAP))
            line.append(GAP + shorten(self._note, room, placeholder=f" {CUT}"))
        return line

    def _head(self, width: int) -> list[Text]:
        readings, errors, error = self.state()
        counts = terminal_text.counted(readings, "reading")
        parts = [
            (part, "") for part in (f"every {self._every:g} s", counts, terminal_text.clock()[:8])
        ]
        if errors:
            parts.append((terminal_text.counted(errors, "error"), "red"))
        head = with_whole_parts(Text(self._where, "bold"), parts, width)
        second = Text(terminal_text.plain(error), "bold red") if error else Text()
        return [head, second]


def with_whole_parts(line: Text, parts: Iterable[tuple[str, str]], width: int) -> Text:
    """A line with further parts and their styles, up to the first that does not fit.

    No part is cut: the first digits of a number are another number.
    """
    line = Text.assemble(line)
    for part, style in parts:
        if line.cell_len + len(GAP) + cell_len(part) > width:
            break
        line.append(GAP)
        line.append(part, style)
    return line


def whole(number: str, width: int) -> str:
    """A number, or an ellipsis alone if it does not fit."""
    return number if cell_len(number) <= width else CUT

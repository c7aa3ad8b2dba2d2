"""The screen of `holdfast watch`: lines in pages, redrawn after every reading, and its keys."""

from __future__ import annotations

import contextlib
import math
import os
import re
import time
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

from rich.console import Console, ConsoleDimensions, Group
from rich.control import Control
from rich.live import Live
from rich.text import Text

from holdfast.cli import terminal_text
from holdfast.cli.live import keys, schedule
from holdfast.cli.signals import on_ctrl_z

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.cli.live.keys import Wait

SIZE_CHECK_INTERVAL_S = 0.2
"""Between two checks of the size of the terminal."""

FADE_READINGS = 3
"""A change stays highlighted for so many readings."""

FRESH = "bold reverse yellow"
RECENT = "bold yellow"

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
    def foot(self) -> Sequence[Text]:
        """The lines below them, on every page."""

    @abstractmethod
    def state(self) -> tuple[int, int, str]:
        """The numbers of readings and of errors, and the error of the last reading, or ""."""

    def run(self, times: int | None) -> None:
        """Shows readings until q or Ctrl-C. The first one has been read before."""
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
        foot = self.foot()
        body = self.body(width)
        room = max(1, height - 3 - (len(foot) + 1 if foot else 0))
        self._pages = pages = max(1, math.ceil(len(body) / room))
        self._page = min(self._page, pages - 1)
        shown = body[self._page * room : (self._page + 1) * room]
        keys_ = "q quits" + (f"   n, p turn pages ({self._page + 1}/{pages})" if pages > 1 else "")
        lines = [*self._head(), *shown]
        if foot:
            lines += [Text(), *foot]
        lines += [Text()] * (height - 1 - len(lines))
        lines.append(Text(keys_ + (f"   {self._note}" if self._note else ""), "dim"))
        for line in lines:
            line.truncate(width)
        self._live.update(Group(*lines), refresh=True)

    def _head(self) -> list[Text]:
        readings, errors, error = self.state()
        counts = terminal_text.counted(readings, "reading")
        head = Text.assemble(
            (self._where, "bold"),
            f"   every {self._every:g} s   {counts}   {terminal_text.clock()[:8]}",
        )
        if errors:
            head.append(f"   {terminal_text.counted(errors, 'error')}", "red")
        second = Text(terminal_text.plain(error), "bold red") if error else Text()
        return [head, second]

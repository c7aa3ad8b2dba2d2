"""Runs a command in its own terminal: output, keys, sizes and signals."""

from __future__ import annotations

import contextlib
import fcntl
import os
import pty
import re
import select
import signal
import struct
import termios
import time
import tty
from typing import TYPE_CHECKING

from support import wire
from support.commands import Command

if TYPE_CHECKING:
    from types import TracebackType
    from typing import Self

ESCAPES = re.compile(r"\x1b(\[[0-9;?]*[ -/]*[@-~]|[()][A-Z0-9]|[=>78])")


def plain(text: str) -> str:
    """Removes colors and cursor movements from the output."""
    return ESCAPES.sub("", text).replace("\r", "")


class Terminal:
    """Runs `holdfast` with these arguments on a pseudo-terminal, and kills it at the end."""

    def __init__(
        self, *arguments: str, lines: int = 40, columns: int = 100, **environment: str
    ) -> None:
        self._own, theirs = pty.openpty()
        try:
            self._resize(lines, columns)
            unwanted = ("NO_COLOR", "COLUMNS", "LINES")
            settings = {k: v for k, v in os.environ.items() if k not in unwanted}
            settings |= {"TERM": "xterm-256color", "LANG": "C.UTF-8"} | environment
            self.process = Command(*arguments, terminal=theirs, environment=settings)
        except BaseException:
            os.close(self._own)
            raise
        finally:
            os.close(theirs)
        self.shown = ""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.process.kill()
        self.process.wait()
        if self._own >= 0:
            os.close(self._own)

    def until(self, *texts: str) -> str:
        """Waits until the output since the last call contains all texts. Returns it."""
        deadline = time.monotonic() + wire.DEADLINE
        since = len(self.shown)
        while not all(text in plain(self.shown[since:]) for text in texts):
            if time.monotonic() > deadline or not self._look(deadline):
                raise AssertionError(f"{texts} not in:\n{plain(self.shown[since:])}")
        return plain(self.shown[since:])

    def keys(self, keys: str) -> None:
        os.write(self._own, keys.encode())

    def wait_for_enter(self) -> None:
        """Lets the terminal pass on whole lines only, as it does for a shell."""
        modes = termios.tcgetattr(self._own)
        modes[tty.LFLAG] |= termios.ICANON
        termios.tcsetattr(self._own, termios.TCSANOW, modes)

    def resize(self, lines: int, columns: int) -> None:
        self._resize(lines, columns)
        self.process.send_signal(signal.SIGWINCH)

    def end(self, number: signal.Signals | None = None) -> int:
        """Returns the exit code, after an optional signal."""
        if number is not None:
            self.process.send_signal(number)
        deadline = time.monotonic() + wire.DEADLINE
        while self._look(deadline):
            assert time.monotonic() < deadline, plain(self.shown)
        return self.process.wait(wire.DEADLINE)

    def hang_up(self) -> int:
        """Closes the terminal, which sends SIGHUP. Returns the exit code."""
        os.close(self._own)
        self._own = -1
        return self.process.wait(wire.DEADLINE)

    def _look(self, deadline: float) -> bool:
        """Reads available output. Returns whether more may follow."""
        patience = max(0.0, deadline - time.monotonic())
        if not select.select([self._own], [], [], patience)[0]:
            return True
        piece = b""
        with contextlib.suppress(OSError):  # Linux raises OSError when the other end is closed.
            piece = os.read(self._own, 65536)
        self.shown += piece.decode(errors="replace")
        return bool(piece)

    def _resize(self, lines: int, columns: int) -> None:
        fcntl.ioctl(self._own, termios.TIOCSWINSZ, struct.pack("HHHH", lines, columns, 0, 0))

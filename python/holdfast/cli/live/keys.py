"""Reads single keys from the terminal, without waiting for Enter."""

from __future__ import annotations

import contextlib
import os
import select
import sys
import time
from typing import TYPE_CHECKING, TypeAlias

from holdfast.cli.signals import on_ctrl_z

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    Wait: TypeAlias = Callable[[float], str]

END = "\x04"
"""The key that stands for a closed terminal."""


@contextlib.contextmanager
def keys() -> Iterator[Wait]:
    """Yields a function that waits up to some seconds for a key; it returns "" at the timeout."""
    if not sys.stdin.isatty():
        yield _nothing
    elif sys.platform == "win32":
        yield _windows
    else:
        import termios
        import tty

        terminal = sys.stdin.fileno()
        before = termios.tcgetattr(terminal)

        def take() -> None:
            tty.setcbreak(terminal)

        def leave() -> None:
            with contextlib.suppress(termios.error):  # A closed terminal has no modes.
                termios.tcsetattr(terminal, termios.TCSADRAIN, before)

        with on_ctrl_z(leave, take):
            try:
                take()
                yield lambda seconds: _posix(terminal, seconds)
            finally:
                leave()


def _nothing(seconds: float) -> str:
    time.sleep(seconds)
    return ""


def _posix(terminal: int, seconds: float) -> str:
    if not select.select([terminal], [], [], seconds)[0]:
        return ""
    return os.read(terminal, 64).decode(errors="replace") or END


def _windows(seconds: float) -> str:
    if sys.platform != "win32":
        raise AssertionError("only for Windows")
    import msvcrt

    end = time.monotonic() + seconds
    while not msvcrt.kbhit():
        left = end - time.monotonic()
        if left <= 0:
            return ""
        time.sleep(min(left, 0.02))
    return msvcrt.getwch()

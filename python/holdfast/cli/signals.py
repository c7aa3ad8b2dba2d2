"""The signals that end a service, make it reread its configuration, or stop a view for a while."""

from __future__ import annotations

import os
import signal
import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from types import FrameType


OTHERS = (
    "SIGHUP",
    "SIGQUIT",
    "SIGBREAK",
    "SIGUSR1",
    "SIGUSR2",
    "SIGALRM",
    "SIGVTALRM",
    "SIGPROF",
    "SIGIO",
    "SIGPWR",
    "SIGXCPU",
)
"""Signals that would end the process at once, where the system has them: no write may go
unrecorded."""


def ending_signals() -> Iterator[signal.Signals]:
    """The signals that end a service: Ctrl-C, a stop, a closed terminal unless `nohup` is used.

    And every other one that ends a process and can be caught, except those of a crash.
    """
    yield from (signal.SIGINT, signal.SIGTERM)
    for name in OTHERS:
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) != signal.SIG_IGN:
            yield number


_early_hangups: list[int] = []
"""SIGHUP before there are `Signals`."""


def keep_hangups() -> None:
    """Keeps each SIGHUP for the first `Signals`, in place of the end of the process."""
    hangup = getattr(signal, "SIGHUP", None)
    if hangup is not None:
        signal.signal(hangup, lambda number, _frame: _early_hangups.append(number))


def _at_once() -> Callable[[int, FrameType | None], object] | signal.Handlers:
    """The handler with which a signal ends the process at once.

    For process 1, such as that of a container, the kernel ignores a signal with the usual one.
    """
    if os.getpid() == 1:
        return lambda number, _frame: os._exit(128 + number)
    return signal.SIG_DFL


@contextmanager
def ended_by_ctrl_c() -> Iterator[None]:
    """Lets Ctrl-C end the process at once, as a stop does, while modules are imported.

    SIGTERM also ends process 1, from now on. Nothing has begun yet. `KeyboardInterrupt` in the
    middle of an import shows a traceback, may become a `RuntimeError`, and is lost in a destructor.
    """
    number, usual = signal.SIGINT, signal.default_int_handler
    try:
        is_usual = signal.getsignal(number) == usual
        if is_usual:
            signal.signal(number, _at_once())
        if os.getpid() == 1 and signal.getsignal(signal.SIGTERM) == signal.SIG_DFL:
            signal.signal(signal.SIGTERM, _at_once())
    except ValueError:  # Only the main thread may set it.
        is_usual = False
    try:
        yield
    finally:
        if is_usual:
            signal.signal(number, usual)


SIGNAL_INTERVAL_S = 0.2
"""A command that waits for something else looks for signals this often."""


class Interrupted(BaseException):
    """A signal came before the service was ready."""


class Signals:
    """Records the signals that end a service. The second signal ends the process at once.

    SIGHUP can request a reload instead: `always`, also that of a terminal that is closed, or only
    `with a terminal` that is still there, or without any.
    """

    def __init__(self, *, reload: Literal["always", "with a terminal", "never"] = "never") -> None:
        self.received = False
        self._interrupts = False
        self._reload = False
        self._needs_terminal = reload == "with a terminal" and _has_terminal()
        hangup = None if reload == "never" else getattr(signal, "SIGHUP", None)
        for number in ending_signals():
            if number != hangup:
                signal.signal(number, self._note)
        if hangup is not None:
            signal.signal(hangup, self._request_reload)
            # One that has come since is not lost.
            if _early_hangups:
                self._reload = True

    @contextmanager
    def interrupting(self) -> Iterator[None]:
        """Lets a signal end what is inside: a start may wait long. Raises `Interrupted`."""
        self._interrupts = True
        try:
            if self.received:
                raise Interrupted
            yield
        finally:
            self._interrupts = False

    @contextmanager
    def held(self) -> Iterator[None]:
        """Lets what is inside end, such as the output of a line, before a signal ends the rest."""
        interrupts, self._interrupts = self._interrupts, False
        try:
            yield
        finally:
            self._interrupts = interrupts
        if interrupts and self.received:
            self._interrupts = False
            raise Interrupted

    def take_reload(self) -> bool:
        """Whether a reload was requested since the last call."""
        requested, self._reload = self._reload, False
        return requested

    def _request_reload(self, number: int, frame: FrameType | None) -> None:
        if self._needs_terminal and not _has_terminal():
            self._note(number, frame)
        else:
            self._reload = True

    def _note(self, number: int, _frame: FrameType | None) -> None:
        self.received = True
        signal.signal(number, _at_once())
        if self._interrupts:
            self._interrupts = False
            raise Interrupted


@contextmanager
def interruptions() -> Iterator[Signals]:
    """The signals that end a search, which then prints its findings so far.

    The first ends what is inside `interrupting`; the second ends the process at once.
    """
    before = {number: signal.getsignal(number) for number in ending_signals()}
    try:
        signals = Signals()
        for number, handler in before.items():
            if handler == signal.SIG_IGN:  # A script has started the command in the background.
                signal.signal(number, handler)
        yield signals
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


@contextmanager
def stops_as_ctrl_c() -> Iterator[None]:
    """Lets SIGTERM and SIGHUP, unless `nohup` is used, raise `KeyboardInterrupt` as Ctrl-C does."""
    numbers = {signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)}
    numbers = numbers.intersection(ending_signals())
    before = {number: signal.signal(number, signal.default_int_handler) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def on_ctrl_z(before: Callable[[], None], after: Callable[[], None]) -> Iterator[None]:
    """Lets Ctrl-Z call `before` and then stop the process, and calls `after` when it continues.

    For modes of the terminal, which the shell needs as they were. Those inside come first.
    """
    if sys.platform == "win32":
        yield
        return

    def stop(number: int, frame: FrameType | None) -> None:
        before()
        if callable(outer):
            outer(number, frame)
        else:
            signal.signal(number, outer)
            # Not `os.kill`, whose signal another thread may take, later.
            signal.raise_signal(number)
        signal.signal(number, stop)
        after()

    outer = signal.signal(signal.SIGTSTP, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTSTP, outer)


def _has_terminal() -> bool:
    """Whether standard input is a terminal that was not closed."""
    try:
        return os.isatty(0)
    except OSError:
        return False

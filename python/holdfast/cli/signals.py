"""The signals that end a service, or make it reread its configuration."""

from __future__ import annotations

import signal
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator
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


class Signals:
    """Records the signals that end a service. The second signal ends the process at once.

    With `reloads`, SIGHUP requests a reload instead, also that of a terminal that is closed.
    """

    def __init__(self, *, reloads: bool = False) -> None:
        self.received = False
        self._reload = False
        for number in ending_signals():
            signal.signal(number, self._note)
        hangup = getattr(signal, "SIGHUP", None)
        if reloads and hangup is not None:
            signal.signal(hangup, self._request_reload)

    def take_reload(self) -> bool:
        """Whether a reload was requested since the last call."""
        requested, self._reload = self._reload, False
        return requested

    def _request_reload(self, _number: int, _frame: FrameType | None) -> None:
        self._reload = True

    def _note(self, number: int, _frame: FrameType | None) -> None:
        self.received = True
        signal.signal(number, signal.SIG_DFL)

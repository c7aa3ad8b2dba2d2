"""The signals that end a service."""

from __future__ import annotations

import signal
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator
    from types import FrameType


def ending_signals() -> Iterator[signal.Signals]:
    """The signals that end a service: Ctrl-C, a stop, a closed terminal unless `nohup` is used."""
    yield from (signal.SIGINT, signal.SIGTERM)
    for name in ("SIGHUP", "SIGQUIT", "SIGBREAK"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) != signal.SIG_IGN:
            yield number


class Signals:
    """Records the signals that end a service. The second signal ends the process at once."""

    def __init__(self) -> None:
        self.received = False
        for number in ending_signals():
            signal.signal(number, self._note)

    def _note(self, number: int, _frame: FrameType | None) -> None:
        self.received = True
        signal.signal(number, signal.SIG_DFL)

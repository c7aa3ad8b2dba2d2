"""Which of the commands to a device goes next to the node that polls it."""

from __future__ import annotations

import asyncio
from bisect import bisect_left, insort


class CommandOrder:
    """The commands to one device, by number, in the order in which they were received.

    One at a time has the turn, until it is on its way to the device; the others wait in order. One
    that comes back, because the device has moved, waits again. It also waits for later ones that
    are on their way: they come back, too, or it is overtaken and must not be written any more.
    """

    def __init__(self) -> None:
        self._waiting: list[tuple[int, asyncio.Event]] = []
        """In order, with the event that it may have the turn."""
        self._turn: int | None = None
        self._going: dict[int, None] = {}
        """Those that have or had the turn, until they come back or end. In order: what is added is
        later than all of them."""
        self._last_written = -1
        """The latest that has ended and may have been carried out."""

    def wait(self, number: int) -> asyncio.Event:
        """Adds a command, also one that comes back. Returns the event that it may have the turn."""
        changed = asyncio.Event()
        insort(self._waiting, (number, changed))
        self._going.pop(number, None)
        self.release(number)
        return changed

    def take(self, number: int) -> bool:
        """Takes the turn. Returns whether this command has it now."""
        last = next(reversed(self._going), -1)
        if self._turn is not None or number != self._waiting[0][0] or number < last:
            return False
        del self._waiting[0]
        self._going[number] = None
        self._turn = number
        return True

    def release(self, number: int) -> None:
        """Lets the next one take the turn, if this command has it: it is on its way."""
        if self._turn == number:
            self._turn = None
        if self._waiting:
            self._waiting[0][1].set()

    def is_overtaken(self, number: int) -> bool:
        """Whether a later command has ended, and may have been carried out."""
        return number < self._last_written

    def end(self, number: int, *, may_be_written: bool) -> None:
        """Removes a command, wherever it is."""
        if number in self._going:
            del self._going[number]
            if may_be_written:
                self._last_written = max(self._last_written, number)
        else:
            del self._waiting[bisect_left(self._waiting, (number,))]
        self.release(number)

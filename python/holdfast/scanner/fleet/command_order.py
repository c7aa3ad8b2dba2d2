"""Which of the commands that wait for the node of a device goes first."""

from __future__ import annotations

import asyncio
import contextlib


class WaitingCommands:
    """The commands to one device that no node has yet, by number. The lowest number goes first.

    A command that comes back because the device has moved joins again with its number, so it goes
    before those that were received after it.
    """

    def __init__(self) -> None:
        self._changed: dict[int, asyncio.Event] = {}
        """For each command, the event that it may be the first one now."""

    def join(self, number: int) -> None:
        """Adds a command, unless it waits already."""
        self._changed.setdefault(number, asyncio.Event())

    def leave(self, number: int) -> None:
        """Removes a command, if it waits: a node has it, or it is refused."""
        if self._changed.pop(number, None) is not None and self._changed:
            self._changed[min(self._changed)].set()

    async def turn(self, number: int, seconds: float) -> bool:
        """Waits until a command is the first one. Returns whether it is, within this time."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                while min(self._changed) < number:
                    changed = self._changed[number] = asyncio.Event()
                    await changed.wait()
                return True
        return False

"""The readings that an output has not sent yet: in memory, and with a file beyond outages."""

from __future__ import annotations

import threading
from collections import deque
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.outputs.stored import Stored
    from holdfast.polling import Reading


class Buffer:
    """Readings in their order. `offer` is for the thread that polls; it never waits for a file.

    All other methods are for the thread of the output. The newest `most` readings are in memory;
    with a file, those that can't be sent go there.
    """

    def __init__(self, most: int = 1_000_000) -> None:
        self.most = most
        self._waiting: deque[Reading] = deque()
        self._taken: list[Reading] = []
        self._of_file = False
        self._come = threading.Condition()
        self._is_woken = False
        self.stored: Stored | None = None
        self.dropped = 0
        """Readings that were lost because there was no room."""

    def offer(self, readings: Iterable[Reading]) -> None:
        """Adds readings. If there is no room, the oldest go, and are counted."""
        with self._come:
            self._waiting.extend(readings)
            while len(self._waiting) > self.most:
                self._waiting.popleft()
                self.dropped += 1
            self._come.notify_all()

    def __len__(self) -> int:
        stored = 0 if self.stored is None else self.stored.count
        with self._come:
            return len(self._waiting) + (0 if self._of_file else len(self._taken)) + stored

    def take(self, most: int, timeout: float) -> list[Reading]:
        """The oldest readings; waits for the first, up to `timeout` seconds.

        They stay until `done`. Until then, it returns the same. Raises `OSError` for the file.
        """
        if self._taken:
            return self._taken
        if self.stored is not None and self.stored.count:
            self._taken, self._of_file = self.stored.first(), True
            return self._taken
        with self._come:
            self._come.wait_for(lambda: self._waiting or self._is_woken, timeout)
            self._is_woken = False
            count = min(most, len(self._waiting))
            self._taken = [self._waiting.popleft() for _ in range(count)]
        return self._taken

    def done(self) -> None:
        """Removes what was taken. Raises `OSError` for the file."""
        if self._of_file and self.stored is not None:
            self.stored.remove_first()
        self._taken, self._of_file = [], False

    def wake(self) -> None:
        """Ends the current or the next wait of `take`. Thread-safe."""
        with self._come:
            self._is_woken = True
            self._come.notify_all()

    def keep(self, step: int = 1000) -> None:
        """Moves what is in memory to the file, if there is one. Raises `OSError`; nothing is lost
        then.
        """
        if self.stored is None:
            return
        while True:
            if self._taken and not self._of_file:
                moved = self._taken
            else:
                with self._come:
                    moved = [self._waiting.popleft() for _ in range(min(step, len(self._waiting)))]
            if not moved:
                return
            try:
                self.dropped += self.stored.add(moved)
            except OSError:
                self._put_back(moved)
                raise
            if moved is self._taken:
                self._taken = []

    def _put_back(self, readings: list[Reading]) -> None:
        if readings is self._taken:
            return
        with self._come:
            self._waiting.extendleft(reversed(readings))

    def detach(self) -> None:
        """Closes the file, and forgets what was taken from it."""
        if not self._of_file:
            with self._come:
                self._waiting.extendleft(reversed(self._taken))
        self._taken, self._of_file = [], False
        if self.stored is not None:
            self.stored.close()
            self.stored = None

"""The readings that an output has not sent yet: in memory, and in a file if it has one."""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import TYPE_CHECKING

from holdfast.config.models.outputs import MAX_VALUES

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.outputs.buffer_file import Stored
    from holdfast.polling import Reading


MAX_STEP = 20_000
"""Readings that are stored at once. Each step waits for the disk once."""


class Buffer:
    """Readings in their order. `offer` is for the thread that polls; it never waits for a file.

    All other methods are for the thread of the output. The newest `most` readings are in memory;
    with a file, those that can't be sent go there.
    """

    def __init__(self, most: int = MAX_VALUES) -> None:
        self.most = most
        self._waiting: deque[Reading] = deque()
        self._batch: list[Reading] = []
        self._is_batch_stored = False
        self._changed = threading.Condition()
        self._is_woken = False
        self.stored: Stored | None = None
        self.dropped = 0
        """Readings that were lost because there was no room."""

    def offer(self, readings: Iterable[Reading]) -> None:
        """Adds readings. If there is no room, the oldest are dropped and counted."""
        with self._changed:
            self._waiting.extend(readings)
            while len(self._waiting) > self.most:
                self._waiting.popleft()
                self.dropped += 1
            self._changed.notify_all()

    def __len__(self) -> int:
        stored = 0 if self.stored is None else self.stored.count
        with self._changed:
            return len(self._waiting) + (0 if self._is_batch_stored else len(self._batch)) + stored

    def take(self, max_readings: int, timeout: float) -> list[Reading]:
        """Returns the oldest readings. Waits for the first up to `timeout` seconds.

        Returns the same readings again until `done` is called. Raises `OSError` if the file fails.
        """
        if self._batch:
            return self._batch
        # The readings in the file are older than those in memory.
        if self.stored is not None and self.stored.count:
            self._batch, self._is_batch_stored = self.stored.first(), True
            self.dropped += self.stored.damaged
            self.stored.damaged = 0
            return self._batch
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_woken, timeout)
            self._is_woken = False
            count = min(max_readings, len(self._waiting))
            self._batch = [self._waiting.popleft() for _ in range(count)]
        return self._batch

    def done(self) -> None:
        """Removes the readings that `take` returned. Raises `OSError` if the file fails."""
        if self._is_batch_stored and self.stored is not None:
            self.stored.remove_first()
        self._batch, self._is_batch_stored = [], False

    def wake(self) -> None:
        """Ends the current or the next wait of `take`. Thread-safe."""
        with self._changed:
            self._is_woken = True
            self._changed.notify_all()

    def keep(self, seconds: float, step: int = MAX_STEP) -> None:
        """Moves what waits in memory now to the file, if there is one, `step` at a time.

        Ends after some seconds, and does not wait for readings that come meanwhile: they may come
        faster than a disk stores them. Raises `OSError` if the file fails. No reading is lost then.
        """
        if self.stored is None:
            return
        until = time.monotonic() + seconds
        with self._changed:
            left = len(self._waiting)
        while time.monotonic() < until:
            # The batch goes first: it is older than the readings that wait.
            if self._batch and not self._is_batch_stored:
                moved = self._batch
            else:
                with self._changed:
                    count = min(step, left, len(self._waiting))
                    moved = [self._waiting.popleft() for _ in range(count)]
                left -= count
            if not moved:
                return
            try:
                self.dropped += self.stored.add(moved)
            except OSError:
                if moved is not self._batch:
                    self._put_back(moved)
                raise
            if moved is self._batch:
                self._batch = []

    def _put_back(self, readings: list[Reading]) -> None:
        with self._changed:
            self._waiting.extendleft(reversed(readings))

    def detach(self) -> None:
        """Closes the file. A batch from memory waits again; one from the file stays there."""
        if not self._is_batch_stored:
            self._put_back(self._batch)
        self._batch, self._is_batch_stored = [], False
        if self.stored is not None:
            self.stored.close()
            self.stored = None

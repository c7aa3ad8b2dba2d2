"""The readings that an output has not sent yet: in memory, and in a file if it has one."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from typing import TYPE_CHECKING

from holdfast.config.models.outputs import MAX_VALUES
from holdfast.outputs.buffer_file_error import FileGone

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from holdfast.outputs.buffer_file import BufferFile
    from holdfast.polling import Reading


MAX_STEP = 20_000
"""Readings that are stored at once. Each step waits for the disk once."""

MAX_ROW = 1000
"""Readings in one row of the file, but for the rest of a poll."""


class Buffer:
    """Readings in their order. `offer` is for the thread that polls; it never waits for a file.

    All other methods are for the thread of the output. The newest `most` readings are in memory;
    with a file, those that can't be sent go there.

    What is taken or stored ends with a whole poll, so that nobody sees half of one.
    """

    def __init__(self, most: int = MAX_VALUES, before: Buffer | None = None) -> None:
        """`before` is that of the same output with other settings, until a reload."""
        self.most = most
        self.in_use: threading.Lock = threading.Lock() if before is None else before.in_use
        """Held by the output that sends: after a reload, the one before may still be ending."""
        self._before = before
        self._waiting: deque[Sequence[Reading]] = deque()
        """Polls."""
        self._count = 0
        """The readings of these polls."""
        self._offered = self._seen = 0
        """All readings that were ever offered: now, and at the last `has_late`."""
        self._batch: list[Reading] = []
        self._is_batch_stored = False
        self._changed = threading.Condition()
        self._is_woken = False
        self.stored: BufferFile | None = None
        self.dropped: int = 0 if before is None else before.dropped
        """Readings that were lost because there was no room."""
        self._dropped_before = self.dropped

    def offer(self, polls: Iterable[Sequence[Reading]]) -> None:
        """Adds the readings of polls. If there is no room, the oldest are dropped and counted."""
        with self._changed:
            before = self._count
            for poll in polls:
                if poll:
                    self._waiting.append(poll)
                    self._count += len(poll)
            self._offered += self._count - before
            while (excess := self._count - self.most) > 0:
                oldest = self._waiting.popleft()
                if excess < len(oldest):
                    self._waiting.appendleft(oldest[excess:])
                gone = min(excess, len(oldest))
                self._count -= gone
                self._drop(gone)
            self._changed.notify_all()

    def take_over(self) -> None:
        """Takes what the output before the reload has left. Called with `in_use`: that has ended.

        Until then, it sends nothing that is meant for this one: a broker or topic of before would
        get it in place of the new one.
        """
        before, self._before = self._before, None
        if before is not None:
            before.take_over()
            self._put_back(*before._pop_all())
            self._drop(before.dropped - self._dropped_before)

    def clear(self) -> None:
        """Drops what is in memory. It is not counted as dropped: the end of the output logs it."""
        self._pop_all()
        if not self._is_batch_stored:
            self._batch = []

    def _pop_all(self) -> list[Sequence[Reading]]:
        with self._changed:
            polls = [*self._waiting]
            self._waiting.clear()
            self._count = 0
            return polls

    def _drop(self, count: int) -> None:
        # Both threads count.
        with self._changed:
            self.dropped += count

    def __len__(self) -> int:
        # Diagnostics ask too, while the thread of the output may lose the file.
        stored, before = self.stored, self._before
        with self._changed:
            waiting = self._count + (0 if self._is_batch_stored else len(self._batch))
        waiting += 0 if stored is None else stored.count
        return waiting + (0 if before is None else len(before))

    @property
    def first_number(self) -> int:
        """The number of the oldest reading, in the order of all that were offered, from 0 on.

        Those from before, of a file or of the output before a reload, have negative numbers.
        """
        with self._changed:
            return self._offered - len(self)

    @property
    def next_number(self) -> int:
        """The number of the next reading that is offered."""
        return self._offered

    def take(self, max_readings: int, timeout: float) -> list[Reading]:
        """Returns the oldest readings. Waits for the first up to `timeout` seconds.

        They may be more than `max_readings`, by the rest of a poll. Returns the same readings again
        until `done` is called. Raises `OSError` if the file fails.
        """
        if self._batch:
            return self._batch
        # The readings in the file are older than those in memory.
        if self.stored is not None and self.stored.count:
            with self._losing_file():
                self._batch = self.stored.first(max_readings)
            self._is_batch_stored = bool(self._batch)
            self._drop(self.stored.damaged)
            self.stored.damaged = 0
            return self._batch
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_woken, timeout)
            self._is_woken = False
            self._batch = self._pop(max_readings)
        return self._batch

    def _pop(self, least: int) -> list[Reading]:
        """Removes whole polls with so many readings, or all. Called with the lock."""
        found: list[Reading] = []
        while self._waiting and len(found) < least:
            found += self._waiting.popleft()
        self._count -= len(found)
        return found

    @property
    def is_filling(self) -> bool:
        """Whether readings fill more than half of the memory."""
        return 2 * self._count > self.most

    def has_late(self) -> bool:
        """Whether readings wait in memory since the last call."""
        with self._changed:
            is_late = self._offered - self._count < self._seen
            self._seen = self._offered
        return is_late

    def done(self) -> bool:
        """Removes the readings that `take` returned. Returns whether they were in the file.

        Raises `OSError` if the file fails. Even then, `take` does not return them again.
        """
        was_stored, self._batch, self._is_batch_stored = self._is_batch_stored, [], False
        if was_stored:
            assert self.stored is not None, "the batch is in it"
            with self._losing_file():
                self.stored.remove_first()
        return was_stored

    def wake(self) -> None:
        """Ends the current or the next wait of `take`. Thread-safe."""
        with self._changed:
            self._is_woken = True
            self._changed.notify_all()

    def restore_file(self) -> bool:
        """Writes a file that was removed anew, with all that waits in it. Returns whether it was.

        Raises `OSError` if that fails.
        """
        with self._losing_file():
            return self.stored is not None and self.stored.restore()

    def move_to_file(self, seconds: float, step: int = MAX_STEP) -> bool:
        """Moves what waits in memory now to the file, if there is one, `step` at a time. Returns
        whether anything was moved.

        Ends after some seconds, and does not wait for readings that come meanwhile: they may come
        faster than a disk stores them. Raises `OSError` if the file fails. No reading of those in
        memory is lost then.
        """
        has_moved = False
        if self.stored is None:
            return has_moved
        until = time.monotonic() + seconds
        with self._changed:
            left = self._count
        while time.monotonic() < until:
            # The batch goes first: it is older than the readings that wait.
            if self._batch and not self._is_batch_stored:
                rows = [self._batch]
            else:
                rows, end = [], max(0, left - step)
                with self._changed:
                    while left > end and (row := self._pop(min(MAX_ROW, left - end))):
                        rows.append(row)
                        left -= len(row)
            if not rows:
                return has_moved
            try:
                with self._losing_file():
                    self._drop(self.stored.add(rows))
            except BaseException:
                if rows[0] is not self._batch:
                    self._put_back(*rows)
                raise
            has_moved = True
            if rows[0] is self._batch:
                self._batch = []
        return has_moved

    @contextlib.contextmanager
    def _losing_file(self) -> Iterator[None]:
        """Goes on without a file that is gone. A batch that came from it is in memory only."""
        try:
            yield
        except FileGone as gone:
            self._drop(gone.lost)
            self.stored, self._is_batch_stored = None, False
            raise

    def _put_back(self, *rows: Sequence[Reading]) -> None:
        with self._changed:
            self._waiting.extendleft(row for row in reversed(rows) if row)
            self._count += sum(map(len, rows))

    def detach(self) -> None:
        """Closes the file. A batch from memory waits again; one from the file stays there."""
        if not self._is_batch_stored:
            self._put_back(self._batch)
        self._batch, self._is_batch_stored = [], False
        if self.stored is not None:
            self.stored.close()
            self.stored = None

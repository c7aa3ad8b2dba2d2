"""Copies of the lines of an audit log, sent elsewhere by a thread of their own.

Nobody waits for a copy: a receiver that is slow or down delays no write. Its lines wait in a queue;
those that don't fit are dropped and counted.
"""

from __future__ import annotations

import errno
import logging
import threading
import time
from collections import deque
from math import inf
from typing import TYPE_CHECKING, Protocol

from holdfast.events import log_lines

if TYPE_CHECKING:
    from collections.abc import Sequence

MAX_WAITING_BYTES = 32 * 2**20
"""The most bytes that wait for a receiver."""

RETRY_DELAY_S = 1.0
"""Seconds before a line is sent again."""

BACK_AFTER_S = 5.0
"""Seconds without a failure, from the first line that is sent again, before an outage of a receiver
that `reports_late` is over."""

LOST_INTERVAL_S = 60.0
"""Interval of logging that lines were dropped."""

CLOSE_TIMEOUT_S = 2.0
"""Seconds to send what waits when the log is closed."""


class Receiver(Protocol):
    """Where copies go."""

    reports_late: bool
    """Whether a line that does not arrive can be sent, and the next one fails: lines to a UDP port
    where nobody listens succeed and fail by turns, as over TCP if each connection is reset."""

    def send(self, line: bytes) -> None:
        """Sends a line without its line feed. Raises `OSError`; the next call tries anew."""

    def close(self) -> None:
        """Closes the connection."""


class Copies:
    """Sends lines to a receiver, in order, each until that succeeds. Thread-safe."""

    def __init__(self, name: str, receiver: Receiver) -> None:
        self.name = name
        self._receiver = receiver
        self._waiting: deque[bytes] = deque()
        self._size = 0
        self._sent = self._failed = self._dropped = 0
        self._logged, self._logged_at = 0, -inf
        """The dropped lines that were logged, and when."""
        self._closing = False
        self._reasons: set[str] = set()
        """Why the receiver is down: all that were logged in this outage."""
        self._back_at = inf
        """When the outage is over, unless a line fails before; infinite until one was sent."""
        self._change = threading.Condition()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"holdfast-{name}", daemon=True)

    def start(self) -> None:
        """Begins to send."""
        self._thread.start()

    def put(self, lines: Sequence[bytes]) -> None:
        """Queues lines; drops those that don't fit. Never waits."""
        with self._change:
            for line in lines:
                if self._size + len(line) > MAX_WAITING_BYTES:
                    self._dropped += 1
                    continue
                self._size += len(line)
                self._waiting.append(line)
            self._change.notify()

    def counts(self) -> dict[str, int]:
        """Returns the numbers of lines sent, failed attempts, lines dropped and lines waiting."""
        with self._change:
            return {
                "sent": self._sent,
                "failed": self._failed,
                "dropped": self._dropped,
                "waiting": len(self._waiting),
            }

    def close(self) -> None:
        """Sends what waits, for a limited time; drops the rest."""
        with self._change:
            self._closing = True
            self._change.notify()
        self._thread.join(CLOSE_TIMEOUT_S)
        self._closed.set()
        with self._change:
            self._dropped += len(self._waiting)
            self._waiting.clear()
        self._log_lost(0.0)

    def _run(self) -> None:
        while (line := self._next()) is not None:
            try:
                self._receiver.send(line.rstrip(b"\n"))
            except OSError as error:
                self._note(error)
            else:
                self._note(None)
        self._receiver.close()

    def _next(self) -> bytes | None:
        """The first line that waits; `None` after the last, and when it is too late."""
        while True:
            left = self._back_at - time.monotonic()
            with self._change:
                if not self._waiting and not self._closing and left > 0:
                    self._change.wait(None if left == inf else left)
                line = self._waiting[0] if self._waiting else None
                is_end = self._closing
            if line is None and left <= 0:
                self._reasons.clear()
                self._back_at = inf
                log_lines.write(logging.INFO, "audit_copies_back", receiver=self.name)
            if line is not None or is_end:
                return None if self._closed.is_set() else line

    def _note(self, error: OSError | None) -> None:
        """Counts an attempt.

        A line that is too long will never be sent: it is dropped. The receiver may be up.
        """
        too_long = error is not None and error.errno == errno.EMSGSIZE
        with self._change:
            self._failed += error is not None and not too_long
            self._sent += error is None
            self._dropped += too_long
            self._logged += too_long
            if (error is None or too_long) and self._waiting:
                self._size -= len(self._waiting.popleft())
        if error is not None:
            # Each line that is lost, and each new reason of an outage.
            if too_long or str(error) not in self._reasons:
                log_lines.problem("audit_copy_failed", receiver=self.name)
            if not too_long:
                self._reasons.add(str(error))
                self._back_at = inf
                self._closed.wait(RETRY_DELAY_S)
        elif self._reasons and self._back_at == inf:
            late = BACK_AFTER_S if self._receiver.reports_late else 0.0
            self._back_at = time.monotonic() + late
        self._log_lost(LOST_INTERVAL_S)

    def _log_lost(self, every: float) -> None:
        """Logs how many lines were dropped, once in some seconds."""
        with self._change:
            lost, now = self._dropped - self._logged, time.monotonic()
            if not lost or now < self._logged_at + every:
                return
            self._logged, self._logged_at = self._dropped, now
        log_lines.write(logging.ERROR, "audit_copies_lost", receiver=self.name, count=lost)

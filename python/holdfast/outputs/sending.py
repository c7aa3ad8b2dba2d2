"""Sends what is in a buffer, in order, and again after an outage."""

from __future__ import annotations

import logging
import threading
import time
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from holdfast import logs
from holdfast.runtime.backoff import Backoff

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from holdfast.outputs.buffer import Buffer
    from holdfast.outputs.stored import Stored
    from holdfast.polling import Reading
    from holdfast.runtime.stop import Stop

FIRST_PAUSE = 1.0
MAX_PAUSE = 10.0
"""Seconds between attempts to send. Each failure doubles the pause, up to the maximum."""

MAX_READINGS = 1000
"""The most readings that are sent in one step."""

TICK = 1.0
"""Seconds between two looks at the buffer during an outage."""

LAST = 2.0
"""Seconds that an output has for what is left when it is stopped."""


class Refused(Exception):
    """A receiver does not want these readings, and never will. They are dropped and counted."""


class Receiver(Protocol):
    """Where the readings of an output go. For the thread of the output."""

    def send(self, readings: list[Reading]) -> None:
        """Sends readings, and returns when the receiver has confirmed them.

        Raises `OSError` if it should be tried again, `Refused` if not. Must end in bounded time.
        """

    def idle(self) -> None:
        """Called once a second while nothing is sent."""

    def close(self) -> None:
        """Ends the connection, if there is one."""

    def status(self) -> Mapping[str, object]:
        """Plain data for diagnostics, without secrets. Called from any thread."""


@runtime_checkable
class Interruptible(Protocol):
    """A receiver whose waiting ends with the output."""

    def until(self, stop: Stop) -> None:
        """Takes the stop of the output. Called before all else."""


def soon_after(stop: Stop, end: Callable[[], None]) -> None:
    """Calls `end` in a thread of its own, `LAST` seconds after the stop: what waits must end."""

    def begin() -> None:
        timer = threading.Timer(LAST, end)
        timer.daemon = True
        timer.start()

    stop.then(begin)


class Sending:
    """An adapter that sends what is in a buffer to a receiver."""

    def __init__(
        self,
        name: str,
        receiver: Receiver,
        buffer: Buffer,
        open_file: Callable[[], Stored] | None = None,
    ) -> None:
        self._name, self._receiver, self._buffer = name, receiver, buffer
        self._open_file = open_file
        self._sent = self._refused = 0
        self._backoff = Backoff(FIRST_PAUSE, MAX_PAUSE, jitter=True)
        self._pause = 0.0
        self._last_error: str | None = None
        self._is_failing = False
        self._file_error: str | None = None

    def run(self, stop: Stop) -> None:
        """Sends until `stop` is set. What is left is sent too if that is quick, or kept."""
        stop.then(self._buffer.wake)
        if isinstance(self._receiver, Interruptible):
            self._receiver.until(stop)
        try:
            while not stop.is_set():
                self._use_file()
                if not self._step(stop):
                    self._wait(stop)
            self._finish()
        finally:
            self._receiver.close()
            self._buffer.detach()

    def status(self) -> dict[str, object]:
        """What was sent, what waits, and why."""
        return {
            **self._receiver.status(),
            "connected": not self._is_failing,
            "readings": {
                "sent": self._sent,
                "refused": self._refused,
                "dropped": self._buffer.dropped,
            },
            "waiting": len(self._buffer),
            "failures": self._backoff.failures,
            "last_error": self._last_error,
            "file_error": self._file_error,
        }

    def _step(self, stop: Stop) -> bool:
        """Sends once. Returns whether to go on at once."""
        try:
            readings = self._buffer.take(MAX_READINGS, 0.0 if stop.is_set() else TICK)
            if not readings:
                self._receiver.idle()
                return True
        except OSError as error:
            return self._failed(error)
        try:
            self._receiver.send(readings)
        except Refused as error:
            self._refused += len(readings)
            logs.refused(
                "output_refused",
                kind=self._name,
                output=self._name,
                count=len(readings),
                error=error,
            )
        except OSError as error:
            return self._failed(error)
        else:
            self._sent += len(readings)
            if self._is_failing:
                waiting = len(self._buffer) - len(readings)
                logs.write(logging.INFO, "output_back", output=self._name, waiting=waiting)
        self._is_failing = False
        self._backoff.succeeded()
        try:
            self._buffer.done()
        except OSError as error:
            return self._failed(error)
        return True

    def _failed(self, error: OSError) -> bool:
        self._last_error = str(error) or type(error).__name__
        self._pause = self._backoff.failed()
        if not self._is_failing:
            self._is_failing = True
            logs.write(logging.WARNING, "output_failed", output=self._name, error=self._last_error)
        return False

    def _wait(self, stop: Stop) -> None:
        """Waits for the next attempt, and keeps what comes meanwhile."""
        end = time.monotonic() + self._pause
        while not stop.is_set() and (left := end - time.monotonic()) > 0:
            self._keep()
            stop.wait(min(TICK, left))

    def _finish(self) -> None:
        """Sends what is left for a while, and keeps the rest."""
        end = time.monotonic() + LAST
        if not self._is_failing:
            while len(self._buffer) and time.monotonic() < end:
                try:
                    self._receiver.send(self._buffer.take(MAX_READINGS, 0.0))
                    self._buffer.done()
                except (OSError, Refused):
                    break
        self._keep()
        lost = len(self._buffer) - (self._buffer.stored.count if self._buffer.stored else 0)
        if lost > 0:
            logs.write(logging.WARNING, "output_unsent", output=self._name, count=lost)

    def _use_file(self) -> None:
        """Opens the file, or tries again after an error."""
        if self._open_file is None or self._buffer.stored is not None:
            return
        try:
            self._buffer.stored = self._open_file()
        except OSError as error:
            self._tell_file(error)
        else:
            self._file_error = None

    def _keep(self) -> None:
        try:
            self._buffer.keep()
        except OSError as error:
            self._tell_file(error)
        else:
            self._file_error = None

    def _tell_file(self, error: OSError) -> None:
        told = str(error)
        if told != self._file_error:
            logs.write(logging.ERROR, "output_file_failed", output=self._name, error=told)
        self._file_error = told

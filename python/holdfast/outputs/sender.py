"""Sends the readings of a buffer in order, and retries them after an outage."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from math import inf
from typing import TYPE_CHECKING, Protocol

from holdfast.events import log_lines
from holdfast.outputs.buffer_file_error import FileGone
from holdfast.runtime.backoff import Backoff

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping, Sequence

    from holdfast.outputs.buffer import Buffer
    from holdfast.outputs.buffer_file import BufferFile
    from holdfast.polling import Reading
    from holdfast.runtime.stop import Stop

FIRST_PAUSE_S = 1.0
MAX_PAUSE_S = 10.0
"""Seconds between attempts to send. Each failure doubles the pause, up to the maximum."""

MAX_READINGS = 1000
"""Limit of readings in one call of `Receiver.send`, but for the rest of a poll."""

CHECK_INTERVAL_S = 1.0
"""Interval of moving readings to the file, in an outage or while the receiver does not keep up."""

DROPPED_INTERVAL_S = 60.0
"""Interval of logging that readings were dropped."""

RENEWAL_INTERVAL_S = 60.0
"""Least interval of publishing again what was lost: what was refused may be refused again."""

STOP_TIMEOUT_S = 2.0
"""Time in which a stopped output sends the remaining readings."""

STORE_TIMEOUT_S = 2.5
"""Time in which it then stores those that are left. Both end before the output is given up."""


class Refused(Exception):
    """The receiver refused these readings for good, and took all others. They are dropped."""

    def __init__(self, message: str, readings: Sequence[Reading]) -> None:
        super().__init__(message)
        self.readings = readings


class Receiver(Protocol):
    """Where the readings of an output go. For the thread of the output."""

    def use_stop(self, _stop: Stop, /) -> None:
        """Takes the stop of the output, which ends waits early. Called before all else."""
        return

    def use_buffer(self, _buffer: Buffer, /) -> None:
        """Takes the buffer, whose order tells what waited. Called before all else."""
        return

    def send(self, readings: list[Reading]) -> None:
        """Sends readings, and returns when the receiver has confirmed them.

        Raises `OSError` if it should be tried again, `Refused` if not. Must end in bounded time.
        """

    def idle(self) -> bool:
        """Called once a second while nothing is sent. Returns whether that shows that it works."""
        return False

    def close(self) -> None:
        """Ends the connection, if there is one."""

    def status(self) -> Mapping[str, object]:
        """Plain data for diagnostics, without secrets. Called from any thread."""


def time_left(stop: Stop) -> float:
    """Seconds in which the receiver of an output may still take something; 0 at the end."""
    return max(0.0, stop.at + STOP_TIMEOUT_S - time.monotonic())


def soon_after(stop: Stop, end: Callable[[], None]) -> None:
    """Calls `end` in a thread of its own, `STOP_TIMEOUT_S` after the stop, to end a wait."""

    def begin() -> None:
        timer = threading.Timer(STOP_TIMEOUT_S, end)
        timer.daemon = True
        timer.start()

    stop.then(begin)


def log_unsent(name: str, buffer: Buffer) -> None:
    """Logs what is lost at the end of an output, if no `OutputSender` runs that does so itself.

    Its receiver may have failed, or never have been made.
    """
    if buffer.in_use.acquire(blocking=False):
        try:
            buffer.take_over()
            _log_count(name, len(buffer))
            buffer.clear()
        finally:
            buffer.in_use.release()


def _log_count(name: str, unsent: int) -> None:
    if unsent > 0:
        log_lines.write(logging.WARNING, "output_unsent", output=name, count=unsent)


class OutputSender:
    """An adapter that sends what is in a buffer to a receiver.

    At its end, `leaves_file` tells whether no output uses the file any more, and `is_followed`
    whether the output goes on with other settings: it takes over what waits in memory. `renew`
    offers the last value of each tag again, or has the next ones of some tags of devices published.
    """

    def __init__(
        self,
        name: str,
        receiver: Receiver,
        buffer: Buffer,
        open_file: Callable[[], BufferFile] | None = None,
        leaves_file: Callable[[], bool] = lambda: False,
        is_followed: Callable[[], bool] = lambda: False,
        renew: Callable[[Collection[tuple[str, str]] | None], object] = lambda _: None,
    ) -> None:
        self._name, self._receiver, self._buffer = name, receiver, buffer
        self._open_file, self._renew = open_file, renew
        self._leaves_file, self._is_followed = leaves_file, is_followed
        self._sent = self._refused = 0
        self._logged_dropped, self._logged_at = buffer.dropped, -inf
        self._looked_at = -inf
        self._renewed_dropped, self._renewed_at = buffer.dropped, -inf
        self._refused_tags: set[tuple[str, str]] = set()
        """Those of which values were refused since they were published again."""
        self._backoff = Backoff(FIRST_PAUSE_S, MAX_PAUSE_S, jitter=True)
        self._pause = 0.0
        self._last_error: str | None = None
        self._is_failing = False
        self._file_error: str | None = None

    def run(self, stop: Stop) -> None:
        """Sends until `stop` is set. Then sends or stores the rest.

        First waits for the output before, which may still end: two would send the same readings.
        """
        while not self._buffer.in_use.acquire(timeout=CHECK_INTERVAL_S):
            self._is_failing = True
            self._last_error = "the output before the reload has not ended"
            if stop.is_set():
                self._log_unsent()
                return
        self._is_failing, self._last_error = False, None
        try:
            self._buffer.take_over()
            self._run(stop)
        finally:
            self._buffer.in_use.release()

    def _run(self, stop: Stop) -> None:
        stop.then(self._buffer.wake)
        self._receiver.use_stop(stop)
        self._receiver.use_buffer(self._buffer)
        try:
            while not stop.is_set():
                self._use_file()
                if not self._step(stop):
                    self._wait(stop)
                self._move_late_to_file()
                self._log_dropped()
                self._replace_lost()
            self._finish(stop.at + STOP_TIMEOUT_S)
        except Exception:
            self._move_to_file(STORE_TIMEOUT_S)
            raise
        finally:
            self._receiver.close()
            self._log_left()
            self._buffer.detach()

    def status(self) -> dict[str, object]:
        """The counters of readings, and the last errors."""
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
            readings = self._take(0.0 if stop.is_set() else CHECK_INTERVAL_S)
            if not readings:
                if self._receiver.idle():
                    self._worked(0)
                return True
            self._send(readings)
        except OSError as error:
            self._failed(error)
            return False
        self._worked(len(self._buffer) - len(readings))
        self._confirm_sent()
        return True

    def _take(self, seconds: float) -> list[Reading]:
        """The oldest readings; those in memory, if the file is gone. Raises `OSError`."""
        with self._using_file(FileGone):
            return self._buffer.take(MAX_READINGS, seconds)
        return self._buffer.take(MAX_READINGS, seconds)

    def _confirm_sent(self) -> None:
        """Removes what was sent. If the file fails, the next readings are sent all the same."""
        with self._using_file():
            if self._buffer.done():
                self._file_error = None

    def _worked(self, waiting: int) -> None:
        """Notes that the receiver works; so many readings wait for it."""
        if self._is_failing:
            log_lines.write(logging.INFO, "output_back", output=self._name, waiting=waiting)
        self._is_failing = False
        self._backoff.succeeded()

    def _send(self, readings: list[Reading]) -> None:
        """Sends readings, and counts them. Raises `OSError` if it should be tried again."""
        refused = 0
        try:
            self._receiver.send(readings)
        except Refused as error:
            refused = len(error.readings)
            self._refused_tags |= {(each.device, each.name) for each in error.readings}
            log_lines.refused(
                "output_refused",
                kind=self._name,
                output=self._name,
                count=refused,
                error=error,
            )
        self._refused += refused
        self._sent += len(readings) - refused

    def _failed(self, error: OSError) -> None:
        self._last_error = str(error) or type(error).__name__
        self._pause = self._backoff.failed()
        if not self._is_failing:
            self._is_failing = True
            log_lines.write(
                logging.WARNING, "output_failed", output=self._name, error=self._last_error
            )

    def _wait(self, stop: Stop) -> None:
        """Waits for the next attempt, and moves new readings to the file meanwhile."""
        end = time.monotonic() + self._pause
        while not stop.is_set() and (left := end - time.monotonic()) > 0:
            self._move_to_file(CHECK_INTERVAL_S)
            self._log_dropped()
            stop.wait(min(CHECK_INTERVAL_S, left))

    def _move_late_to_file(self) -> None:
        """Moves readings to the file if they come faster than they are sent, or wait for those in
        the file: a crash would lose them, or memory not have room for them.
        """
        is_late = self._buffer.is_filling
        if (now := time.monotonic()) >= self._looked_at + CHECK_INTERVAL_S:
            self._looked_at = now
            is_late |= self._buffer.has_late()
        if is_late:
            self._move_to_file(CHECK_INTERVAL_S)

    def _finish(self, end: float) -> None:
        """Sends remaining readings until `end`, then moves the rest to the file.

        After an outage, the receiver may work again: what would be lost is tried once more.
        """
        if self._is_failing:
            self._move_to_file(CHECK_INTERVAL_S)  # Only this shows whether the file takes it.
        has_file = self._buffer.stored is not None and self._file_error is None
        if not (self._is_failing and (has_file or self._is_followed())):
            while len(self._buffer) and time.monotonic() < end:
                try:
                    self._send(self._take(0.0))
                except OSError:
                    break
                self._confirm_sent()
        self._move_to_file(STORE_TIMEOUT_S)
        self._log_dropped(0.0)
        self._log_unsent()
        if not self._is_followed():
            self._buffer.clear()

    def _log_unsent(self) -> None:
        """Logs what is lost."""
        stored = self._buffer.stored
        in_file = 0 if stored is None else stored.count
        kept = in_file if stored is not None and stored.is_in_place else 0
        _log_count(self._name, (in_file if self._is_followed() else len(self._buffer)) - kept)

    def _use_file(self) -> None:
        """Opens the file, or tries again after an error."""
        if self._open_file is None or self._buffer.stored is not None:
            return
        is_late = self._file_error is not None
        with self._using_file():
            stored = self._buffer.stored = self._open_file()
            self._file_error = None
            if is_late and stored.count:
                # Newer values than these may have been sent: the last of a tag must be the newest.
                self._renew(None)

    def _move_to_file(self, seconds: float) -> None:
        with self._using_file():
            if self._buffer.restore_file():
                log_lines.write(logging.WARNING, "output_file_recreated", output=self._name)
                self._file_error = None
            if self._buffer.move_to_file(seconds):
                self._file_error = None

    def _log_dropped(self, every: float = DROPPED_INTERVAL_S) -> None:
        """Logs how many readings were lost because there was no room, once in some seconds."""
        lost, now = self._buffer.dropped - self._logged_dropped, time.monotonic()
        if lost > 0 and now >= self._logged_at + every:
            self._logged_dropped, self._logged_at = self._logged_dropped + lost, now
            log_lines.write(logging.WARNING, "output_dropped", output=self._name, count=lost)

    def _replace_lost(self) -> None:
        """Has values follow that replace what was dropped or refused, if the receiver works.

        An output that publishes changes would leave it with older ones until the next change.
        """
        has_lost = self._buffer.dropped > self._renewed_dropped
        if self._is_failing or not (has_lost or self._refused_tags):
            return
        # What waits comes first: a renewal must not take its room.
        if has_lost and len(self._buffer) >= MAX_READINGS:
            return
        if (now := time.monotonic()) >= self._renewed_at + RENEWAL_INTERVAL_S:
            self._renewed_at = now
            tags, self._refused_tags = self._refused_tags, set()
            self._renew(None if has_lost else tags)
            # Those of the renewal that did not fit would not fit the next time either.
            self._renewed_dropped = self._buffer.dropped

    def _log_left(self) -> None:
        stored = self._buffer.stored
        if stored is not None and stored.count and stored.is_in_place and self._leaves_file():
            log_lines.write(
                logging.WARNING,
                "output_file_left",
                output=self._name,
                file=str(stored.file),
                count=stored.count,
            )

    @contextlib.contextmanager
    def _using_file(self, errors: type[OSError] = OSError) -> Iterator[None]:
        # No error of the file stops the output. Each new one is logged once.
        try:
            yield
        except errors as error:
            message = str(error)
            if message != self._file_error:
                log_lines.write(
                    logging.ERROR, "output_file_failed", output=self._name, error=message
                )
            self._file_error = message
            if isinstance(error, FileGone) and error.stays:
                # Opened again, it would fail at the same place.
                self._open_file = None

"""Writes log lines, and what services print at their start, from a thread of its own, so that a
reader who stops reading holds up nobody.
"""

from __future__ import annotations

import logging
import os
import select
import sys
import threading
import time
from collections import deque
from typing import TextIO

MAX_WAITING_LINES = 10_000
"""Lines that wait at most. More are dropped and counted."""

MAX_LINES_PER_WRITE = 500
"""Lines of one write."""

CLOSE_TIMEOUT_S = 1.0
"""Seconds that the end of the program waits for the lines, by default."""

PRIORITIES = {"DEBUG": 7, "INFO": 6, "WARNING": 4, "ERROR": 3, "CRITICAL": 2}
"""The levels of lines, as numbers of syslog(3)."""


class QueuedHandler(logging.Handler):
    """Queues lines for a stream.

    `dropped` counts lines that found the queue full, or were not written completely.
    """

    def __init__(self, stream: TextIO, timeout: float = CLOSE_TIMEOUT_S) -> None:
        """`timeout` is that of `flush`, in seconds."""
        super().__init__()
        self._stream, self._timeout = stream, timeout
        self._lines: deque[str] = deque()
        self._changed = threading.Condition()
        self._writing = False
        self._ends_in_line = False
        """Whether the last byte in the stream is no line feed: a full disk has cut off a line."""
        self._noted = 0
        self._is_journal = _is_journal(stream)
        self.dropped = 0
        threading.Thread(target=self._write_for_ever, name="holdfast-log", daemon=True).start()

    def emit(self, record: logging.LogRecord) -> None:
        """Queues a line. Never waits for the stream."""
        try:
            line = self.format(record) + "\n"
        except Exception:  # As all handlers do.
            self.handleError(record)
            return
        with self._changed:
            if len(self._lines) >= MAX_WAITING_LINES:
                self.dropped += 1
            else:
                self._lines.append(line)
            self._changed.notify_all()

    def format(self, record: logging.LogRecord) -> str:
        """The line, for the journal of systemd with its priority; see sd-daemon(3)."""
        line = super().format(record)
        if self._is_journal and (priority := PRIORITIES.get(record.levelname)) is not None:
            return f"<{priority}>{line}"
        return line

    def flush(self) -> None:
        """Waits until all lines are written, up to the timeout."""
        with self._changed:
            self._changed.wait_for(lambda: not self._lines and not self._writing, self._timeout)

    def _write_for_ever(self) -> None:
        while True:
            with self._changed:
                self._writing = False
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._lines)
                count = min(len(self._lines), MAX_LINES_PER_WRITE)
                lines = [self._lines.popleft() for _ in range(count)]
                missing = self.dropped - self._noted
                self._writing = True
            if missing:
                lines.append(self._note(missing))
            lost = self._write("".join(lines))
            with self._changed:
                if not lost:
                    self._noted += missing
                elif missing:
                    lost -= 1  # The note was the last line. It is written again with the next ones.
                self.dropped += lost

    def _note(self, count: int) -> str:
        record = logging.makeLogRecord(
            {
                "name": "holdfast",
                "levelname": "WARNING",
                "msg": "log_dropped",
                "created": time.time(),
                "fields": {"count": count},
            }
        )
        return self.format(record) + "\n"

    def _write(self, text: str) -> int:
        """Writes without the lock of the stream, which the end of the program needs.

        Returns the number of lines that were not written completely.
        """
        try:
            descriptor = self._stream.fileno()
        except (OSError, ValueError):  # It is no file.
            self._stream.write(text)
            return 0
        if self._ends_in_line:
            text = "\n" + text
        encoding = self._stream.encoding or "utf-8"
        if sys.platform == "win32":  # A console takes bytes in an encoding of its own.
            encoding = os.device_encoding(descriptor) or encoding
        data = text.encode(encoding, "backslashreplace")
        while data:
            try:
                count = os.write(descriptor, data)
            except BlockingIOError:
                select.select([], [descriptor], [])
            except OSError:  # The disk is full, or nobody reads it any more.
                # A line that lacks only its line feed has it with the next write.
                return data.removeprefix(b"\n").count(b"\n")
            else:
                self._ends_in_line = data[:count][-1:] != b"\n"
                data = data[count:]
        return 0


def _is_journal(stream: TextIO) -> bool:
    """Whether systemd has connected the stream with its journal, which takes the prefix away.

    The variable alone does not say so: processes inherit it whose stream is another one.
    """
    named = os.environ.get("JOURNAL_STREAM")
    if not named:
        return False
    try:
        found = os.fstat(stream.fileno())
    except (OSError, ValueError):  # It is no file.
        return False
    return named == f"{found.st_dev}:{found.st_ino}"


def announce(text: str) -> None:
    """Prints what a service says at its start. A service runs, whoever reads that, and when."""
    printing = QueuedHandler(sys.stdout)
    printing.emit(logging.makeLogRecord({"msg": text}))
    printing.flush()  # Whoever reads has it before the service goes on.

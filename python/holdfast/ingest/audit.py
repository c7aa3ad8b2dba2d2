"""The audit log: one JSON object a line for every write, done or refused.

A line is in the hands of the system before the writer gets its answer; for Modbus writes, which
native threads serve, it follows at once, and a gap is told in a line of its own. A file that grew
too large is renamed to `.1`, `.2` and so on.
"""

from __future__ import annotations

import logging
import threading
import time
from logging.handlers import RotatingFileHandler
from typing import TYPE_CHECKING

import msgspec

from holdfast import logs

if TYPE_CHECKING:
    from pathlib import Path


class Audit:
    """Appends to one file, from any thread; raises `OSError` when it can't be opened."""

    def __init__(self, file: Path, *, max_bytes: int, keep: int) -> None:
        self._file = _File(file, maxBytes=max_bytes, backupCount=keep, encoding="utf-8")
        self._lines = 0
        self._lock = threading.Lock()

    def write(self, **fields: object) -> None:
        """One line: the time, then the fields."""
        line = {"time": logs.timestamp(time.time()), **fields}
        text = msgspec.json.encode(line).decode()
        self._file.handle(logging.makeLogRecord({"msg": text}))
        with self._lock:
            self._lines += 1

    def counts(self) -> dict[str, int]:
        """Lines written, and lines that the file did not take."""
        failed = self._file.failed
        return {"lines": self._lines - failed, "failed": failed}

    def close(self) -> None:
        """Closes the file."""
        self._file.close()


class _File(RotatingFileHandler):
    """A rotating file that counts what it could not write, and says so in the log."""

    failed = 0

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: ARG002
        self.failed += 1
        logs.problem("audit_failed", file=self.baseFilename)

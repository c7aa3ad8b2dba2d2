"""The audit log: one line with a JSON object for every write, done or refused.

A line is written to the file before the writer gets its answer. The lines of Modbus writes follow
shortly after the answer, because native threads serve them; lost lines are reported in a line of
their own. A file that is too large is renamed to `.1`, `.2` and so on.
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
    """Appends lines to a file. Thread-safe. Raises `OSError` if the file can't be opened."""

    def __init__(self, file: Path, *, max_bytes: int, keep: int) -> None:
        self._file = _File(file, maxBytes=max_bytes, backupCount=keep, encoding="utf-8")
        self._lines = 0
        self._lock = threading.Lock()

    def write(self, **fields: object) -> None:
        """Writes one line: the time, then the fields."""
        line = {"time": logs.timestamp(time.time()), **fields}
        text = msgspec.json.encode(line).decode()
        self._file.handle(logging.makeLogRecord({"msg": text}))
        with self._lock:
            self._lines += 1

    def counts(self) -> dict[str, int]:
        """Returns the numbers of lines written, and of lines that could not be written."""
        failed = self._file.failed
        return {"lines": self._lines - failed, "failed": failed}

    def close(self) -> None:
        """Closes the file."""
        self._file.close()


class _File(RotatingFileHandler):
    """A rotating file that counts and logs failed writes."""

    failed = 0

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: ARG002
        self.failed += 1
        logs.problem("audit_failed", file=self.baseFilename)

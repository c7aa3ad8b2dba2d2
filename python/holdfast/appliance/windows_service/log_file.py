"""The log of a service, which has no standard error: a file that is rotated."""

from __future__ import annotations

import io
import logging
from logging.handlers import RotatingFileHandler
from typing import TYPE_CHECKING

from holdfast.events import log_lines
from holdfast.events.rotation import Rotation

if TYPE_CHECKING:
    from pathlib import Path

MAX_BYTES = 10_000_000
"""Bytes of a file."""

BACKUPS = 5
"""Older files, `NAME.log.1` and so on."""


class LogFile(io.TextIOBase):
    """A stream to a rotated file. What can't be written is dropped: the service goes on."""

    def __init__(self, file: Path) -> None:
        file.parent.mkdir(parents=True, exist_ok=True)
        self._handler = _Handler(file)

    def writable(self) -> bool:
        """It is."""
        return True

    def write(self, text: str, /) -> int:
        """Appends text. Refuses bytes, as click tries whether a stream takes them."""
        if not isinstance(text, str):
            raise TypeError(f"a log takes text, found {type(text).__name__}")
        self._handler.handle(logging.makeLogRecord({"msg": text}))
        return len(text)

    def close(self) -> None:
        """Closes the file."""
        self._handler.close()
        super().close()


class _Handler(RotatingFileHandler):
    terminator = ""

    def __init__(self, file: Path) -> None:
        self._rotation = Rotation(file, BACKUPS, self._not_rotated)
        self._rotation.take_up()
        super().__init__(file, maxBytes=MAX_BYTES, backupCount=BACKUPS, encoding="utf-8")

    def shouldRollover(self, record: logging.LogRecord) -> bool:
        """Whether the file is full, and can probably be renamed."""
        return self._rotation.may_rotate and bool(super().shouldRollover(record))

    def doRollover(self) -> None:
        """Begins a new file, unless a reader has this one open: the default deletes older ones."""
        if self.stream is not None:
            self.stream.close()
            self.stream = None
        self._rotation.rotate()
        self.stream = self._open()

    def _not_rotated(self) -> None:
        log_lines.problem("log_file_not_rotated", file=self.baseFilename)

    def handleError(self, record: logging.LogRecord) -> None:
        """Drops the text: the default writes to standard error, which leads back here."""

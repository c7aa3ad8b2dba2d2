"""Writes values to an SQLite database, for small sites."""

from __future__ import annotations

import sqlite3
from typing import TYPE_CHECKING, Any

import msgspec

from holdfast.outputs.buffer_file import file_errors, is_in_place
from holdfast.outputs.sender import STOP_TIMEOUT_S, Receiver, time_left
from holdfast.outputs.text_file import row
from holdfast.runtime.stop import Stop

if TYPE_CHECKING:
    import os

    from holdfast.config.models.outputs import FileConfig
    from holdfast.polling import Reading

_CREATE = """
CREATE TABLE IF NOT EXISTS readings (
    time TEXT NOT NULL, device TEXT NOT NULL, tag TEXT NOT NULL, value, unit TEXT, error TEXT
);
CREATE INDEX IF NOT EXISTS readings_of_tag ON readings (device, tag, time);
CREATE INDEX IF NOT EXISTS readings_by_time ON readings (time);
"""

MAX_ROWS_PER_REMOVAL = 1000
"""Limit of rows that are removed at once if the database is too large; of few, it is a tenth."""


class SqliteFile(Receiver):
    """The table `readings`. Others may read it meanwhile."""

    def __init__(self, settings: FileConfig) -> None:
        self._file, self._max_bytes = settings.file, settings.max_bytes
        self._db: sqlite3.Connection | None = None
        self._status: os.stat_result | None = None
        """Of the file that is open."""
        self._stop = Stop()

    def use_stop(self, stop: Stop) -> None:
        """Limits the waits for other programs after the stop. Called before all else."""
        self._stop = stop

    def send(self, readings: list[Reading]) -> None:
        """Inserts rows. They survive a power cut when this returns."""
        with file_errors(self._file, self.close):
            db = self._opened()
            # First: after the rows are stored, an error would have them sent and stored again.
            self._shrink(db)
            with db:
                db.executemany(
                    "INSERT INTO readings VALUES (?, ?, ?, ?, ?, ?)",
                    [_row(reading) for reading in readings],
                )

    def close(self) -> None:
        """Closes the database."""
        if self._db is not None:
            self._db.close()
            self._db = None

    def status(self) -> dict[str, object]:
        """Where values go."""
        return {"file": str(self._file)}

    def _opened(self) -> sqlite3.Connection:
        """The database; a new one if somebody has removed the file."""
        if self._status is None or not is_in_place(self._file, self._status):
            self.close()
        if self._db is None:
            self._db = sqlite3.connect(self._file, check_same_thread=False)
            self._limit_waits(self._db)
            self._db.execute("PRAGMA auto_vacuum=INCREMENTAL")
            # A write-ahead log would have a file in shared memory, for which SQLite takes no room
            # on the disk: if that is full, the process ends at a page of it, by SIGBUS.
            # Another program that has an older database open keeps the log there: the next opening
            # tries again.
            try:
                self._db.execute("PRAGMA journal_mode=TRUNCATE")
            except sqlite3.OperationalError as error:
                if error.sqlite_errorcode != sqlite3.SQLITE_BUSY:
                    raise
            self._db.executescript(_CREATE)
            self._status = self._file.stat()
        self._limit_waits(self._db)
        return self._db

    def _limit_waits(self, db: sqlite3.Connection) -> None:
        seconds = min(STOP_TIMEOUT_S, time_left(self._stop))
        db.execute(f"PRAGMA busy_timeout={int(seconds * 1000)}")

    def _shrink(self, db: sqlite3.Connection) -> None:
        """Removes the oldest rows if there are too many."""
        while self._size(db) > self._max_bytes:
            first, last = db.execute(
                "SELECT (SELECT min(rowid) FROM readings), (SELECT max(rowid) FROM readings)"
            ).fetchone()
            if first is None:
                return
            gone = min(MAX_ROWS_PER_REMOVAL, 1 + (last - first) // 10)
            with db:
                db.execute("DELETE FROM readings WHERE rowid < ?", (first + gone,))
            db.executescript("PRAGMA incremental_vacuum")  # `execute` would free one page.

    @staticmethod
    def _size(db: sqlite3.Connection) -> int:
        pages, free, size = (
            db.execute(f"PRAGMA {name}").fetchone()[0]
            for name in ("page_count", "freelist_count", "page_size")
        )
        return int((pages - free) * size)


def _row(reading: Reading) -> tuple[Any, ...]:
    time, device, tag, value, unit, error = row(reading)
    if isinstance(value, list):
        value = msgspec.json.encode(value).decode()
    elif isinstance(value, int) and not -(2**63) <= value < 2**63:
        value = float(value)  # As text it would have all digits, but sort after all numbers.
    return time, device, tag, value, unit, error

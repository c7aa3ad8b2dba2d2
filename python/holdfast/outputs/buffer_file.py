"""A file with readings that could not be sent yet.

SQLite keeps it valid after a power cut. One row has the readings of many polls, so that many values
cost few writes.
"""

from __future__ import annotations

import contextlib
import os
import sqlite3
from typing import TYPE_CHECKING, Any
from zlib import crc32

import msgspec

from holdfast.outputs.buffer_file_error import FileGone
from holdfast.outputs.tag_meaning import definition_text, tag_from
from holdfast.polling import Reading
from holdfast.tags import Tag

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from pathlib import Path

    FindTag = Callable[[str, str], Tag | None]

FORMAT = 1
"""The version of the format, in each file. Files of another one are not touched."""

LOCK_TIMEOUT_S = 1.0
"""Seconds to wait for a file that is in use, by default."""

_CREATE = f"""
BEGIN;
CREATE TABLE readings (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    count INTEGER NOT NULL, data BLOB NOT NULL, checksum INTEGER NOT NULL
);
CREATE TABLE tags (meaning INTEGER PRIMARY KEY, description TEXT NOT NULL);
PRAGMA user_version={FORMAT};
COMMIT
"""
"""`checksum` is the CRC of `data`, begun with `count`. `tags` is for readings whose tag is changed
or removed before they are sent: `meaning` is the CRC of the description.
"""

_DIGITS = 1
"""The type of msgpack's extension for integers as text."""


class _Damage(sqlite3.DatabaseError):
    """Damage that SQLite does not notice: it checks what it stores, not what it reads."""

    sqlite_errorcode = sqlite3.SQLITE_CORRUPT


class BufferFile:
    """Readings in a file, oldest first. For one thread. Methods raise `OSError`.

    `max_bytes` bounds the readings, not the file, which is a little larger.
    """

    def __init__(
        self, file: Path, max_bytes: int, find: FindTag, lock_timeout: float = LOCK_TIMEOUT_S
    ) -> None:
        self.file = file
        self.count = 0
        """How many readings wait."""
        self.damaged = 0
        """How many readings were removed because they could not be read."""
        self._max_bytes, self._find = max_bytes, find
        self._bytes = 0
        self._described: set[int] = set()
        """The meanings that are in the file for sure."""
        self._earlier: dict[tuple[str, int], Tag] = {}
        """Tags as they were when their readings were stored."""
        self._first: dict[int, int] = {}
        """The rows that `first` returned last, and how many readings each has."""
        self._sent = 0
        """The last row that is sent. On a full disk, rows up to it are still in the file."""
        self._lock_timeout = lock_timeout
        self._open()

    def _open(self) -> None:
        with file_errors(self.file):
            self._db = sqlite3.connect(
                self.file,
                timeout=self._lock_timeout,
                isolation_level=None,
                check_same_thread=False,
            )
        with self._errors(self.close):
            # A text that is not UTF-8 spoils only the row that needs it, in `first`.
            self._db.text_factory = bytes
            # Two processes with one file would each send the readings of the other.
            self._db.execute("PRAGMA locking_mode=EXCLUSIVE")
            [found] = self._db.execute("PRAGMA user_version").fetchone()
            [tables] = self._db.execute("SELECT count(*) FROM sqlite_master").fetchone()
            if tables and found != FORMAT:
                raise sqlite3.NotSupportedError(
                    f"format {found}, of another version of Holdfast or program, allowed: {FORMAT}"
                )
            self._db.execute("PRAGMA auto_vacuum=INCREMENTAL")
            if not tables:
                self._db.executescript(_CREATE)
            self._recount()
            self._status = self.file.stat()

    @property
    def is_in_place(self) -> bool:
        """Whether the file has not been removed or renamed since it was opened."""
        return is_in_place(self.file, self._status)

    def restore(self) -> bool:
        """Writes the file anew, with all that waits, if it was removed. Returns whether it was."""
        if self.is_in_place:
            return False
        if self.file.exists():
            raise OSError(
                f"{self.file}: another file is in its place. Move that one away, and all that waits"
                " is written to a new file"
            )
        # After a crash, there is a whole file or none.
        copy = self.file.with_name(f"{self.file.name}.new")
        with file_errors(self.file):
            copy.unlink(missing_ok=True)
            with contextlib.closing(sqlite3.connect(copy)) as db:
                self._db.backup(db)
        copy.rename(self.file)
        # First: it removes the journal, whose name is that of the journal of the new file.
        self.close()
        try:
            self._open()
        except OSError as error:
            raise FileGone(str(error), 0) from error
        return True

    def add(self, rows: Sequence[Sequence[Reading]]) -> int:
        """Stores rows of readings durably, all or none. Returns how many were dropped for want of
        room.
        """
        dropped = 0
        # Once for each tag: most readings share theirs.
        tags = {id(reading.tag): reading.tag for row in rows for reading in row}
        texts = {of: definition_text(tag) for of, tag in tags.items()}
        meanings = {of: crc32(text.encode()) for of, text in texts.items()}
        new = {
            meanings[of]: text for of, text in texts.items() if meanings[of] not in self._described
        }
        encoded = [
            _encoded(
                [
                    (device, tag.name, value, time, fault, undecoded, meanings[id(tag)])
                    for device, tag, value, time, fault, undecoded in row
                ]
            )
            for row in rows
        ]
        with self._transaction():
            self._remove("id <= ?", self._sent)
            self._db.executemany("INSERT OR IGNORE INTO tags VALUES (?, ?)", new.items())
            for count, data in zip(map(len, rows), encoded, strict=True):
                while self._bytes + len(data) > self._max_bytes and self.count:
                    removed = self._remove("id = (SELECT min(id) FROM readings)")
                    if not removed:
                        raise _missing(self.count)
                    dropped += removed
                if len(data) > self._max_bytes:
                    dropped += count
                    continue
                self._db.execute(
                    "INSERT INTO readings (count, data, checksum) VALUES (?, ?, ?)",
                    (count, data, crc32(data, count)),
                )
                self.count += count
                self._bytes += len(data)
        self._described |= new.keys()
        return dropped

    def first(self, most: int) -> list[Reading]:
        """The oldest readings, in whole rows: one, and more up to `most` readings. Empty if there
        are none.

        Removes those that are not as they were stored, and counts them in `damaged`. If the file
        itself can't be read, it is `FileGone`: trying again would hold up all that comes behind.
        """
        query = (
            "SELECT id, count, length(data), data, checksum FROM readings "
            "WHERE id > ? ORDER BY id LIMIT 1"
        )
        found: list[Reading] = []
        last = self._sent
        self._first = {}
        while True:
            try:
                row = next(_sound(self._db.execute(query, (last,)).fetchall()), None)
                if row is None and not found and self.count:
                    raise _missing(self.count)
                if row is None or (found and len(found) + row[1] > most):
                    return found
                id, count, _, data, checksum = row
                if id <= last:
                    raise _Damage(f"row {id} is behind row {last}")
                if crc32(data, count) != checksum:
                    raise ValueError("the row is not the one that was stored")
                readings = [self._reading(plain) for plain in _decoded(data)]
            except sqlite3.Error as error:
                if found:
                    return found
                raise self._gone(f"{self.file}: {error}", self.count + self.damaged) from error
            except (msgspec.MsgspecError, TypeError, ValueError):
                if found:
                    return found
                last, self._first = id, {id: count}
                self.damaged += count
                self.remove_first()
            else:
                found += readings
                last, self._first[id] = id, count

    def remove_first(self) -> None:
        """Removes what `first` returned last, unless `add` has dropped it since.

        If that fails, this or `add` removes it later; `first` goes on behind it all the same.
        """
        self.count -= sum(self._first.values())
        self._sent = max(self._first, default=self._sent)
        self._first = {}
        try:
            with self._transaction():
                self._remove("id <= ?", self._sent)
        except FileGone:
            raise
        except OSError as error:
            if self.count or not self.is_in_place:
                raise
            # A removal needs room for its journal, which a full disk does not have. A file in which
            # nothing waits can go as a whole, unless the disk can only be read.
            try:
                self.file.unlink()
            except OSError:
                raise error from None
            self.close()
            raise FileGone(str(error), self.damaged) from error
        if not self.count:
            # The readings are removed already. If this fails, pages stay free for the next ones.
            with contextlib.suppress(sqlite3.Error):
                # `execute` would free one page, `executescript` frees all.
                self._db.executescript("PRAGMA incremental_vacuum")

    def close(self) -> None:
        """Closes the file."""
        self._db.close()

    def _remove(self, which: str, *parameters: int) -> int:
        rows = self._db.execute(
            f"DELETE FROM readings WHERE {which} RETURNING id, count, length(data)", parameters
        ).fetchall()
        removed = 0
        for id, count, size in _sound(rows):
            self._bytes -= size
            if id > self._sent:
                removed += count
                self._first.pop(id, None)
        self.count -= removed
        return removed

    def _recount(self) -> None:
        self.count = self._bytes = last = 0
        damage = None
        # What is before damage can be sent; what is behind it counts as lost later.
        for order in ("ASC", "DESC"):
            query = f"SELECT id, count, length(data) FROM readings WHERE id > ? ORDER BY id {order}"
            try:
                with contextlib.closing(self._db.execute(query, (last,))) as rows:
                    for last, count, size in _sound(rows):
                        self.count += count if last > self._sent else 0
                        self._bytes += size
            except sqlite3.Error as error:
                damage = error
        if damage is not None and not self.count:
            raise damage

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[None]:
        """All that is done, or none of it, also of what is counted."""
        before = self.count, self._bytes, self._first.copy()
        try:
            with self._errors(), self._db:
                self._db.execute("BEGIN")
                yield
        except BaseException:
            self.count, self._bytes, self._first = before
            raise

    @contextlib.contextmanager
    def _errors(self, undo: Callable[[], object] = lambda: None) -> Iterator[None]:
        """As `file_errors`, but a damaged file is `FileGone`, and left under another name."""
        waiting = self.count - sum(self._first.values()) + self.damaged
        try:
            with file_errors(self.file, undo):
                yield
        except OSError as error:
            # Errors of the module itself have no code.
            code = getattr(error.__cause__, "sqlite_errorcode", sqlite3.SQLITE_ERROR)
            if code & 0xFF != sqlite3.SQLITE_CORRUPT:
                raise
            raise self._gone(str(error), waiting) from error

    def _gone(self, error: str, lost: int) -> FileGone:
        """Leaves the file under another name, if that can be."""
        self.close()
        aside = self.file.with_name(f"{self.file.name}.damaged")
        try:
            self.file.replace(aside)
        except OSError as failed:
            return FileGone(f"{error}; it can't become {aside}: {failed}", lost, stays=True)
        return FileGone(f"{error}; it is {aside} now", lost)

    def _reading(self, plain: Sequence[Any]) -> Reading:
        """A reading that `add` has stored. Raises `TypeError` or `ValueError` for anything else."""
        device, name, value, time, fault, undecoded, meaning = plain
        tag = self._find(device, name)
        if tag is None or meaning != crc32(definition_text(tag).encode()):
            tag = self._as_stored(name, meaning)
        return Reading(device, tag, value, time, fault, undecoded)

    def _as_stored(self, name: str, meaning: int) -> Tag:
        """A tag as it was. Raises `ValueError` if that is damaged."""
        if (known := self._earlier.get((name, meaning))) is not None:
            return known
        query = "SELECT description FROM tags WHERE meaning = ?"
        row = self._db.execute(query, (meaning,)).fetchone()
        if row is None or crc32(row[0]) != meaning:
            raise ValueError("the description is not the one that was stored")
        return self._earlier.setdefault((name, meaning), tag_from(name, row[0]))


def _missing(count: int) -> _Damage:
    return _Damage(f"{count} readings are missing")


def _sound(rows: Iterable[Any]) -> Iterator[Any]:
    """Rows that begin with an id, how many readings there are, and their size."""
    for row in rows:
        id, count, size, *_ = row
        # Each reading takes several bytes.
        if not (type(count) is type(size) is int and 0 < count <= size):
            raise _Damage(f"row {id} has {count} readings in {size} bytes")
        yield row


def _encoded(plain: Sequence[tuple[Any, ...]]) -> bytes:
    try:
        return msgspec.msgpack.encode(plain)
    except OverflowError:
        # Integers of msgpack have 64 bits, and a scale makes longer ones: all are stored as text.
        return msgspec.msgpack.encode(
            [(device, name, _as_text(value), *rest) for device, name, value, *rest in plain]
        )


def _as_text(value: Any) -> Any:
    """An integer, or each one of an array, as digits that `_decoded` knows from a text."""
    if isinstance(value, list):
        return [_as_text(item) for item in value]
    return msgspec.msgpack.Ext(_DIGITS, b"%d" % value) if type(value) is int else value


def _decoded(data: bytes) -> Any:
    return msgspec.msgpack.decode(data, ext_hook=lambda _, digits: int(bytes(digits)))


@contextlib.contextmanager
def file_errors(file: Path, undo: Callable[[], object] = lambda: None) -> Iterator[None]:
    """Raises `OSError` for errors of SQLite. After any, `undo`, whose own errors do not count."""
    try:
        yield
    except BaseException as error:
        with contextlib.suppress(sqlite3.Error):
            undo()
        if isinstance(error, UnicodeDecodeError):
            # Python failed to decode SQLite's message, which quotes damaged text of the schema.
            error = _Damage(error.object.decode(errors="replace"))
        if isinstance(error, sqlite3.Error):
            raise OSError(f"{file}: {error}") from error
        raise


def is_in_place(file: Path, status: os.stat_result) -> bool:
    """Whether a file is still the one that had this status."""
    try:
        return os.path.samestat(file.stat(), status)
    except OSError:
        return False

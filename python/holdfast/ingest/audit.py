"""The audit log: one line with a JSON object for every write, done or refused.

A line is written to the file before the writer gets its answer. The lines of Modbus writes follow
shortly after the answer, because native threads serve them. Lost lines are reported in a line of
their own. A file that is too large is renamed to `.1`, `.2` and so on; a file that somebody else
has renamed is created anew.
"""

from __future__ import annotations

import itertools
import os
import threading
import time
from typing import TYPE_CHECKING

import msgspec

from holdfast import logs

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from pathlib import Path

MODE = 0o640
"""The access to a new file: the owner writes, the group reads."""


class Audit:
    """Appends lines to a file. Thread-safe. Raises `OSError` if the file can't be opened."""

    def __init__(self, file: Path, *, max_bytes: int, keep: int) -> None:
        self._file = file
        self._max_bytes = max_bytes
        self._keep = keep
        self._lock = threading.Lock()
        self._lines = self._failed = self._missing = 0
        self._open()

    def write(self, **fields: object) -> None:
        """Writes one line: the time, then the fields."""
        self.write_all([fields])

    def write_all(self, lines: Iterable[Mapping[str, object]]) -> None:
        """Writes lines, all with the present time.

        After lines that could not be written, a line with their number comes first.
        """
        texts = [_line(fields) for fields in lines]
        if not texts:
            return
        with self._lock:
            gap = [_line({"lost": self._missing})] if self._missing else []
            done = 0
            try:
                for part in self._parts(gap + texts):
                    self._append(b"".join(part))
                    done += len(part)
            except OSError:
                logs.problem("audit_failed", file=str(self._file))
            if done and gap:
                self._missing, done = 0, done - 1
            self._lines += done
            self._failed += len(texts) - done
            self._missing += len(texts) - done

    def counts(self) -> dict[str, int]:
        """Returns the numbers of lines written, and of lines that could not be written."""
        with self._lock:
            return {"lines": self._lines, "failed": self._failed}

    def close(self) -> None:
        """Closes the file."""
        with self._lock:
            os.close(self._descriptor)

    def _open(self) -> None:
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | getattr(os, "O_BINARY", 0)
        self._descriptor = os.open(self._file, flags, MODE)
        status = os.fstat(self._descriptor)
        self._identity, self._size = (status.st_dev, status.st_ino), status.st_size

    def _parts(self, lines: list[bytes]) -> Iterator[list[bytes]]:
        """Splits lines into those that fit into the open file. Opens a new one between parts."""
        if not self._is_current():
            before = self._descriptor
            self._open()
            os.close(before)
        while lines:
            count, size = 0, self._size
            for line in lines:
                size += len(line)
                if size > self._max_bytes:
                    break
                count += 1
            if count == 0:
                if self._size:
                    self._rotate()
                count = 1
            yield lines[:count]
            lines = lines[count:]

    def _append(self, data: bytes) -> None:
        """Appends whole lines, or nothing."""
        written = 0
        try:
            while written < len(data):
                written += os.write(self._descriptor, data[written:])
        except OSError:
            if written:
                os.ftruncate(self._descriptor, self._size)
            raise
        self._size += len(data)

    def _is_current(self) -> bool:
        """Whether the open file still has its name."""
        try:
            status = self._file.stat()
        except OSError:
            return False
        return (status.st_dev, status.st_ino) == self._identity

    def _rotate(self) -> None:
        """Renames the files and begins a new one. If that fails, goes on with the present one."""
        names = [self._file, *(self._numbered(number) for number in range(1, self._keep + 1))]
        os.close(self._descriptor)  # Windows renames no open file.
        try:
            for newer, older in reversed(list(itertools.pairwise(names))):
                if newer.exists():
                    newer.replace(older)
        except OSError:
            logs.problem("audit_not_rotated", file=str(self._file))
        self._open()

    def _numbered(self, number: int) -> Path:
        return self._file.with_name(f"{self._file.name}.{number}")


def _line(fields: Mapping[str, object]) -> bytes:
    return msgspec.json.encode({"time": logs.timestamp(time.time()), **fields}) + b"\n"

"""The file of an audit log: whole lines are appended, and a file that is too large is put aside.

A full file is renamed to `.1`, `.2` and so on. A file that something else has renamed is created
anew, so `logrotate` works too. Only one process at a time can write a file.
"""

from __future__ import annotations

import errno
import os
import stat
from typing import TYPE_CHECKING

from holdfast.events import log_lines
from holdfast.events.audit.chain import End, digest_of, place_of
from holdfast.events.file_lock import lock
from holdfast.events.rotation import Rotation

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

FILE_MODE = 0o640
"""The access to a new file: the owner writes, the group reads."""

CLOSED = -1
CHUNK_BYTES = 64 * 1024
MAX_LINE_BYTES = 4 * 2**20
"""A line that is longer is not a line of an audit log. Raw Ingest packets have up to 0.4 MB."""


class AuditFile:
    """Appends lines. Raises `OSError` if the file can't be opened, or another process writes it."""

    def __init__(self, file: Path, *, max_bytes: int, keep: int) -> None:
        self.file = file
        self.broken: dict[str, str] | None
        """Why the chain breaks before the next line, as fields of it, if it does."""
        self._max_bytes = max_bytes
        self._rotation = Rotation(file, keep, self._not_rotated)
        self._prefix = b""
        self._descriptor = CLOSED
        self._identity: tuple[int, int] | None = None
        """That of the file that was written last."""
        self._is_regular = False
        self._size = 0
        self._open()
        self._rotation.take_up()
        try:
            self.end, self.broken = self._found()
        except OSError:
            self.close()
            raise

    def close(self) -> None:
        """Closes the file."""
        descriptor, self._descriptor = self._descriptor, CLOSED
        if descriptor != CLOSED:
            os.close(descriptor)

    def check(self) -> None:
        """Looks what others have done to the file, and opens a new one if it has lost its name."""
        try:
            status = self.file.stat()
        except OSError:
            status = None
        is_open = self._descriptor != CLOSED
        if is_open and status is not None and _identity(status) == self._identity:
            if self._is_regular and status.st_size != self._size:
                self.broken, self._size = {"reason": "changed"}, status.st_size
                self._end_last_line()
            return
        if self._is_regular and is_open and not _links(self._descriptor):
            self.broken = {"reason": "deleted"}
        before = self._identity, self._size
        self.close()
        self._open()
        # An earlier file may be back, without the lines of the one that was here meanwhile.
        if self.broken is None and self._size and (self._identity, self._size) != before:
            self.broken = {"reason": "changed"}
        self._end_last_line()

    def append(self, lines: list[bytes], *, together: bool = False) -> Iterator[int]:
        """Appends lines, and yields the numbers of lines that were stored at once.

        With `together`, stores all of them or none. Raises `OSError`.
        """
        while lines:
            count = self._fitting(lines)
            is_full = count == 0 or (together and count < len(lines))
            if self._size and is_full and self._rotation.may_rotate:
                self.rotate()
                count = self._fitting(lines)
            count = len(lines) if together else max(count, 1)
            self._write(b"".join(lines[:count]))
            yield count
            lines = lines[count:]

    def rotate(self) -> None:
        """Renames the files and begins a new one. If that fails, goes on with the present one."""
        if self._prefix:
            self._write(b"")
        self.close()
        self._rotation.rotate()
        self._open()

    @property
    def is_empty(self) -> bool:
        """Whether the file has no line yet."""
        return self._size == 0

    def _not_rotated(self) -> None:
        log_lines.problem("audit_not_rotated", file=str(self.file))

    def _open(self) -> None:
        if _is_pipe(self.file):
            # Without a reader, opening it would never end.
            raise OSError(errno.EINVAL, "it is a named pipe, allowed: a regular file", self.file)
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | getattr(os, "O_BINARY", 0)
        self._descriptor = os.open(self.file, flags, FILE_MODE)
        status = os.fstat(self._descriptor)
        self._is_regular = stat.S_ISREG(status.st_mode)
        if self._is_regular and not lock(self._descriptor):
            self.close()
            raise OSError(f"{self.file}: another process writes this audit log")
        self._identity = _identity(status)
        self._size = status.st_size

    def _fitting(self, lines: list[bytes]) -> int:
        """The number of lines that fit into the open file."""
        size = self._size
        for count, line in enumerate(lines):
            size += len(line)
            if size > self._max_bytes:
                return count
        return len(lines)

    def _write(self, data: bytes) -> None:
        """Appends whole lines, or nothing."""
        data, written = self._prefix + data, 0
        try:
            while written < len(data):
                written += os.write(self._descriptor, data[written:])
        except OSError:
            if written:
                os.ftruncate(self._descriptor, self._size)
            raise
        self._prefix = b""
        self._size += len(data)

    def _found(self) -> tuple[End, dict[str, str] | None]:
        """The end of the chain in the files, and why it does not simply go on."""
        last = last_lines(self.file) if self._is_regular else []
        if last:
            return self._end_of(last)
        before = self._last_aside()
        if not before:
            return End(), {"reason": "new"}
        place, digest = place_of(before[-1]), digest_of(before[-1])
        return End(0 if place is None else place.seq, digest), {"reason": "missing"}

    def _end_of(self, last: list[bytes]) -> tuple[End, dict[str, str] | None]:
        *others, line = last
        if not line.endswith(b"\n"):
            self._end_last_line()
            before = others or self._last_aside()
            place = place_of(before[-1]) if before else None
            seq = 0 if place is None else place.seq + 1
            # The torn line may lack its `prev`, which tied it to the lines before.
            after = {"after": digest_of(before[-1])} if before else {}
            return End(seq, digest_of(line + b"\n")), {"reason": "torn", **after}
        place = place_of(line)
        if place is None:
            return End(0, digest_of(line)), {"reason": "unchained"}
        return End(place.seq, digest_of(line)), None

    def _last_aside(self) -> list[bytes]:
        """The last lines of the file that was put aside last."""
        aside = [self._rotation.numbered(number) for number in (0, 1)]
        return next((last_lines(file) for file in aside if file.is_file()), [])

    def _end_last_line(self) -> None:
        """Ends an incomplete last line with the next line that is written."""
        last = last_lines(self.file) if self._is_regular and self._size else []
        self._prefix = b"\n" if last and not last[-1].endswith(b"\n") else b""


def _is_pipe(file: Path) -> bool:
    """Whether a file is a pipe, other than one of the process itself, such as `/dev/stdout`.

    The check of configurations has the same rule (`runtime/bounded_files.py`, a floor above).
    """
    try:
        mode = file.stat().st_mode
        return stat.S_ISFIFO(mode) and not os.path.realpath(file).startswith(("/dev/", "/proc/"))
    except FileNotFoundError:
        return False


def _identity(status: os.stat_result) -> tuple[int, int]:
    return status.st_dev, status.st_ino


def _links(descriptor: int) -> int:
    """The number of names that a file has."""
    return os.fstat(descriptor).st_nlink


def last_lines(file: Path) -> list[bytes]:
    """The last two lines of a file with their line ends, or fewer. Reads only its end."""
    data, line_ends = b"", 3
    with file.open("rb") as opened:
        at = opened.seek(0, os.SEEK_END)
        while at > 0 and data.count(b"\n") < line_ends and len(data) < 2 * MAX_LINE_BYTES:
            before, at = at, max(0, at - CHUNK_BYTES)
            opened.seek(at)
            data = opened.read(before - at) + data
    *lines, rest = data.split(b"\n")
    return [*(line + b"\n" for line in lines), *([rest] if rest else [])][-2:]

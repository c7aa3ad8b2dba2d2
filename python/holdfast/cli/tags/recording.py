"""Values of tags as CSV: lines with a time and a cell for each tag, and files of such lines."""

from __future__ import annotations

import codecs
import contextlib
import os
import stat
from typing import TYPE_CHECKING

from holdfast.cli import terminal_text
from holdfast.events import log_lines
from holdfast.runtime.text import MAX_CHARACTERS
from holdfast.tags.csv_text import csv_lines
from holdfast.tags.text import text_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from holdfast.client.tag_reading import Reading
    from holdfast.tags import Tag

FILE_MODE = 0o644

BLOCK = 1 << 20
"""How much of a file is read at a time."""

MAX_LINE_BYTES = 1 << 20
"""More bytes without an end of a line are none that a power failure has cut off."""


class NotARecording(ValueError):
    """A file that has something else."""


def head(tags: Iterable[Tag]) -> str:
    """The line with the names of the columns."""
    return csv_lines([["time", *(tag.name for tag in tags)]])


def row(moment: float, readings: Sequence[Reading], *, is_shown: bool = False) -> str:
    """The line of one reading; the cell of a tag that was not read is empty.

    States are numbers, so that the line can be plotted and played back. Control characters in texts
    are escaped if the line `is_shown` on a terminal.
    """
    cells = [text_of(each.tag, each.value, states=False) for each in readings]
    if is_shown:
        cells = [terminal_text.plain(cell) for cell in cells]
    return csv_lines([[log_lines.timestamp(moment), *cells]])


class Recording:
    """A file that lines are appended to. Each line is written at once, so none is torn.

    Raises `OSError`, and `NotARecording` for a file with other columns. If the last line of the
    file is incomplete, as after a power failure, it is removed.
    """

    def __init__(self, path: Path, tags: Iterable[Tag]) -> None:
        self.removed = 0
        """Bytes of an incomplete line that were removed."""
        flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | getattr(os, "O_BINARY", 0)
        self._file = os.open(path, flags, FILE_MODE)
        try:
            self._begin(head(tags).encode())
        except BaseException:
            self.close()
            raise

    def _begin(self, head: bytes) -> None:
        about = os.fstat(self._file)
        if not stat.S_ISREG(about.st_mode) or about.st_size == 0:
            self._append(head)
            return
        most = len(head) + MAX_CHARACTERS
        found = self._at(0, most)
        if not head.startswith(found[: len(head)]):
            first, end, _ = found.partition(b"\n")
            more = "" if end or len(found) < most else "…"
            allowed = head.removesuffix(b"\n")
            line = first.removeprefix(codecs.BOM_UTF8).rstrip(b"\r")
            is_resaved = allowed in (line, line.replace(b";", b","), line.replace(b"\t", b","))
            reason = ", as a spreadsheet has saved it" if end and is_resaved else ""
            raise NotARecording(
                f"found {first.decode(errors='replace')!r}{more} in the first line{reason}, "
                f"allowed: {allowed.decode()!r}, an empty file or a new one"
            )
        whole = self._whole()
        if about.st_size - whole > MAX_LINE_BYTES:
            raise NotARecording(
                f"found {about.st_size - whole} bytes without the end of a line, as behind a quote "
                "that stands alone, allowed: whole lines"
            )
        if whole < about.st_size:
            self.removed = about.st_size - whole
            os.ftruncate(self._file, whole)
        if not whole:
            self._append(head)

    def _whole(self) -> int:
        """The bytes up to the end of the last whole line: a newline in quotes is part of a text."""
        whole = at = 0
        is_quoted = False
        while block := self._at(at, BLOCK):
            for part in block.split(b'"'):
                end = part.rfind(b"\n") + 1
                if end and not is_quoted:
                    whole = at + end
                is_quoted = not is_quoted
                at += len(part) + 1
            is_quoted = not is_quoted  # No quote is behind the last part.
            at -= 1
        return whole

    def _at(self, start: int, count: int) -> bytes:
        os.lseek(self._file, start, os.SEEK_SET)
        return os.read(self._file, count)

    def add(self, moment: float, readings: Sequence[Reading]) -> None:
        """Appends a line, or nothing. Raises `OSError`."""
        self._append(row(moment, readings).encode())

    def _append(self, line: bytes) -> None:
        written = 0
        try:
            while written < len(line):
                written += os.write(self._file, line[written:])
        except BaseException:
            if written:
                with contextlib.suppress(OSError):
                    os.ftruncate(self._file, os.fstat(self._file).st_size - written)
            raise

    def close(self) -> None:
        """Closes the file."""
        os.close(self._file)

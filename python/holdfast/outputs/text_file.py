"""Writes values to files of text: CSV, JSON Lines or line protocol."""

from __future__ import annotations

import logging
import os
import re
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from holdfast.config.models.outputs import MEASUREMENT
from holdfast.events import log_lines
from holdfast.events.rotation import Rotation
from holdfast.outputs.line_protocol import lines
from holdfast.outputs.sender import Receiver
from holdfast.tags.csv_text import csv_lines
from holdfast.tags.text import plain, text_of

if TYPE_CHECKING:
    import io
    from collections.abc import Callable
    from pathlib import Path

    from holdfast.config.models.outputs import FileConfig
    from holdfast.polling import Reading

COLUMNS = ("time", "device", "tag", "value", "unit", "error")

HEAD = f"{','.join(COLUMNS)}\n".encode()
"""The first line of CSV."""

MAX_LINE_BYTES = 1 << 20
"""No line is longer: the last so many bytes of a file have the end of one."""


class TextFile(Receiver):
    """A file of whole lines. What a full disk cuts off is removed, and written again later."""

    def __init__(self, settings: FileConfig) -> None:
        self._file = settings.file
        self._max_bytes = settings.max_bytes
        self._rotation = Rotation(settings.file, settings.keep, self._not_rotated)
        self._head = HEAD if settings.format == "csv" else b""
        self._form = FORMS[settings.format]
        self._open: io.FileIO | None = None

    def send(self, readings: list[Reading]) -> None:
        """Appends lines. They are in the file when this returns."""
        data = self._form.encode(readings)
        if not data:
            return
        file = self._opened(len(data))
        size = file.seek(0, os.SEEK_END)
        whole = memoryview(data if size else self._head + data)
        try:
            while whole:
                whole = whole[file.write(whole) :]
        except OSError:
            file.truncate(size)
            raise

    def close(self) -> None:
        """Closes the file."""
        if self._open is not None:
            self._open.close()
            self._open = None

    def status(self) -> dict[str, object]:
        """Where values go."""
        return {"file": str(self._file)}

    def _opened(self, more: int) -> io.FileIO:
        """The file; another one if it is full, or if somebody has moved it."""
        if self._open is not None and not _is_same(self._open, self._file):
            self.close()
        if self._open is None:
            self._rotation.take_up()
            self._open = self._file.open("ab", buffering=0)
            try:
                _end_line(self._open, self._file, self._form)
            except OSError:
                self.close()  # The next row would go on with what was not looked at.
                raise
        size = self._open.seek(0, os.SEEK_END)
        if size and size + more > self._max_bytes and self._rotation.may_rotate:
            self.close()
            self._rotation.rotate()
            self._open = self._file.open("ab", buffering=0)
        return self._open

    def _not_rotated(self) -> None:
        log_lines.problem("output_not_rotated", file=str(self._file))


def _is_same(file: io.FileIO, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except OSError:
        return False


class Form(NamedTuple):
    """The format of a text file: how rows are encoded, and how a row that was cut off is found."""

    encode: Callable[[list[Reading]], bytes]
    """The rows of readings."""
    begin: bytes
    """How the file begins."""
    row: re.Pattern[bytes]
    """How a row begins."""
    whole: re.Pattern[bytes]
    """Whole rows. A text in CSV can have newlines."""


def _end_line(file: io.FileIO, path: Path, form: Form) -> None:
    """Removes a row that a crash has cut off: half of a value can be a wrong one, and a quote that
    nothing closes would take in the next row.

    In a file that does not begin as an output does, the line is another's: it is only ended.
    """
    size = file.seek(0, os.SEEK_END)
    if not size:
        return
    with path.open("rb") as reading:
        is_own = form.begin.startswith(reading.read(len(form.begin)))  # It can be cut off, too.
        reading.seek(max(0, size - MAX_LINE_BYTES))
        tail = reading.read()
    cut = _cut_off(tail, form) if is_own else len(tail) - (tail.rfind(b"\n") + 1)
    if not cut:
        return
    if is_own and cut < MAX_LINE_BYTES:
        file.truncate(size - cut)
        log_lines.write(logging.WARNING, "output_line_cut", file=str(path), bytes=cut)
    else:
        file.write(b"\n")


def _cut_off(tail: bytes, form: Form) -> int:
    """The bytes behind the last whole row."""
    # From the last two: what looks like the last one may be within a text.
    begins = [found.start() for found in form.row.finditer(tail)][-2:]
    end = max((next(form.whole.finditer(tail, begin)).end() for begin in begins), default=0)
    # Both may be within one text, and rows of another can have a quote that stands alone: whole
    # lines are removed only if they begin as a row.
    if not form.row.match(tail, end):
        end = tail.rfind(b"\n") + 1
    return len(tail) - end


def row(reading: Reading) -> tuple[Any, ...]:
    """The columns of a reading."""
    return (
        f"{datetime.fromtimestamp(reading.time, UTC):%Y-%m-%dT%H:%M:%S.%fZ}",
        reading.device,
        reading.tag.name,
        plain(reading.tag, reading.value),
        reading.tag.unit,
        reading.error,
    )


def _csv(readings: list[Reading]) -> bytes:
    found = []
    for reading in readings:
        time, device, tag, _, unit, error = row(reading)
        value = text_of(reading.tag, reading.value, states=False)
        found.append((time, device, tag, value, unit, error))
    return csv_lines(found).encode()


def _json_lines(readings: list[Reading]) -> bytes:
    encoder = msgspec.json.Encoder()
    return encoder.encode_lines(
        [dict(zip(COLUMNS, row(reading), strict=True)) for reading in readings]
    )


def _influx(readings: list[Reading]) -> bytes:
    return lines(readings, MEASUREMENT, {})


_INFLUX = f"{MEASUREMENT},device=".encode()
_LINES = re.compile(rb"(?:[^\n]*+\n)*+")

FORMS = {
    "csv": Form(
        _csv,
        HEAD,
        re.compile(rb"^[0-9]{4}-[0-9]{2}-[0-9]{2}T[0-9:.]{15}Z,", re.MULTILINE),
        re.compile(rb'(?:(?:[^"\n]++|"[^"]*+")*+\n)*+'),
    ),
    "jsonl": Form(
        _json_lines,
        b'{"time":',
        re.compile(rb'^\{"time":', re.MULTILINE),
        _LINES,
    ),
    "influx": Form(
        _influx,
        _INFLUX,
        re.compile(b"^" + _INFLUX, re.MULTILINE),
        _LINES,
    ),
}

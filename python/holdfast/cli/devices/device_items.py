"""Items of a device that are in no area: records of files, `file:4:0`, and queues, `fifo:1246`."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import click

from holdfast._core import Request
from holdfast.cli import terminal_text
from holdfast.cli.options import device
from holdfast.cli.options.option import whole_number
from holdfast.client import requests

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.client import SyncClient

FORM = "file:FILE:RECORD or fifo:ADDRESS, as in file:4:0 and fifo:1246"


def registers_table(head: str, first: int, raw: Sequence[int]) -> list[str]:
    """Registers as a table, numbered from `first` on."""
    rows = [
        (str(number), str(each), f"0x{each:04X}", _binary(each))
        for number, each in enumerate(raw, first)
    ]
    return terminal_text.table((head, "decimal", "hex", "binary"), rows, ">>>>")


def _binary(register: int) -> str:
    text = f"{register:016b}"
    return " ".join(text[at : at + 4] for at in range(0, 16, 4))


def is_named(words: Sequence[str]) -> bool:
    """Whether arguments begin with such an item."""
    return bool(words) and re.match("(file|fifo):", words[0], re.I) is not None


@dataclass(frozen=True)
class Records:
    """Records of a file, or the registers of a queue, to read."""

    file: int | None
    """`None` for a queue."""
    first: int
    """The first record, or the address of the queue."""
    count: int | None
    """`None` for a queue."""

    def read(self, client: SyncClient) -> list[int]:
        """Reads them."""
        if self.file is None:
            return client.read_fifo_queue(self.first)
        return client.read_file_record(self.file, self.first, self.count or 1)

    def to_json(self) -> dict[str, object]:
        """What to read, for JSON."""
        if self.file is None:
            return {"fifo": self.first}
        return {"file": self.file, "record": self.first, "count": self.count}

    def found(self, raw: Sequence[int]) -> dict[str, object]:
        """The values for JSON."""
        return {"registers": list(raw)}

    def undecodable(self, raw: Sequence[int]) -> bool:  # noqa: ARG002
        """Whether some registers are not a valid value of a type: there is none."""
        return False

    def lines(self, raw: Sequence[int]) -> list[str]:
        """The values as a table. The registers of a queue have places, counted from 0."""
        if self.file is None:
            return registers_table("place", 0, raw)
        return registers_table("record", self.first, raw)


def to_read(words: Sequence[str]) -> Records:
    """Parses an item to read, and its COUNT. Raises `click.UsageError`."""
    file, first, left = _parts(words)
    if len(left) > 1:
        raise click.UsageError(f"Got unexpected extra argument ({' '.join(left[1:])}).")
    named = whole_number(left[0]) if left else None
    if left and named is None:
        raise click.UsageError(f"COUNT is {left[0]!r}, allowed: the number of records.")
    if file is None:
        if named is not None:
            raise click.UsageError("fifo:ADDRESS takes no COUNT: a queue is read as a whole.")
        with device.usable():
            Request.read_queue(first)
        return Records(None, first, None)
    size = 1 if named is None else named
    with device.usable():
        # What the client would refuse, which splits what is too much for one request.
        requests.read_file_requests(file, first, size)
    return Records(file, first, size)


def to_write(words: Sequence[str]) -> tuple[int, int, list[str]]:
    """Parses an item to write. Returns the file, the first record, and the values as text."""
    file, first, left = _parts(words)
    if file is None:
        raise click.UsageError("A queue can't be written, only read.")
    if not left:
        raise click.UsageError("Missing argument 'VALUE...'.")
    return file, first, left


def _parts(words: Sequence[str]) -> tuple[int | None, int, list[str]]:
    kind, *parts = words[0].split(":")
    numbers = [whole_number(part) for part in parts]
    if len(numbers) != (2 if kind.lower() == "file" else 1) or None in numbers:
        raise click.UsageError(f"{words[0]!r} is not {FORM}.")
    *file, first = (number or 0 for number in numbers)
    return file[0] if file else None, first, list(words[1:])

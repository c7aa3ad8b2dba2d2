"""Text output: aligned tables, colour, and text from outside without control characters."""

from __future__ import annotations

import datetime
import json
import math
import os
import sys
import time
from typing import TYPE_CHECKING, Any

import click

from holdfast import logs
from holdfast.config.initial import extent
from holdfast.values.digits import shortest

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from holdfast.config import RangeConfig


def styled(text: str, **style: Any) -> str:
    """Text with colour, unless NO_COLOR is set. Without a terminal, `click.echo` removes it."""
    return text if os.environ.get("NO_COLOR") else click.style(text, **style)


def table(head: Sequence[str], rows: Iterable[Sequence[str]], align: str = "") -> list[str]:
    """Lines with aligned columns, headings first. `align` has a `<` or `>` per column."""
    cells = [list(head), *map(list, rows)]
    widths = [max(len(click.unstyle(row[at])) for row in cells) for at in range(len(head))]
    sides = align.ljust(len(head), "<")
    lines = [
        "  ".join(_filled(*each) for each in zip(row, widths, sides, strict=True)).rstrip()
        for row in cells
    ]
    return [styled(lines[0], bold=True), *lines[1:]]


def _filled(text: str, width: int, side: str) -> str:
    space = " " * (width - len(click.unstyle(text)))
    return space + text if side == ">" else text + space


def counted(count: int, noun: str) -> str:
    """`1 register`, `2 registers`, `2 addresses`."""
    return f"{count} {noun}{'' if count == 1 else 'es' if noun.endswith('s') else 's'}"


def words(area: str) -> str:
    """The name of an area or key, with spaces."""
    return area.replace("_", " ")


def ranges_shown(ranges: Iterable[RangeConfig]) -> str:
    """Ranges of addresses: `coils 0-7, holding registers 5`."""
    return ", ".join(f"{words(each.area)} {extent(each.addresses)}" for each in ranges)


def plain(text: str) -> str:
    """Text from outside, with control characters escaped."""
    return "".join(letter if letter.isprintable() else _escaped(letter) for letter in text)


def _escaped(letter: str) -> str:
    code = ord(letter)
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}"


def shown(value: Any, kind: str) -> str:
    """A typed value as text."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return shortest(value, kind)
    if isinstance(value, bytes):
        return value.hex(" ")
    if isinstance(value, str):
        return plain(json.dumps(value, ensure_ascii=False))
    return str(value)


def jsonable(value: Any) -> Any:
    """A typed value for JSON: bytes in hex, `None` for NaN and infinity."""
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def fits(text: str) -> bool:
    """Whether standard output can encode the text."""
    try:
        text.encode(sys.stdout.encoding or "ascii")
    except (UnicodeEncodeError, LookupError):
        return False
    return True


def clock() -> str:
    """The local time of day."""
    return datetime.datetime.now().strftime("%H:%M:%S.%f")[:-3]


def timestamp() -> str:
    """The time in UTC, for JSON."""
    return logs.timestamp(time.time())

"""Text output: aligned tables, colour, and text from outside without control characters."""

from __future__ import annotations

import datetime
import json
import os
import sys
import time
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import click

from holdfast.cli import answers
from holdfast.runtime.text import counted as counted
from holdfast.runtime.text import extent
from holdfast.values.digits import decimal_of
from holdfast.values.orders import SWAPPED_BYTES

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from holdfast.config import ConfigError, Problem
    from holdfast.config.models.devices import RangeConfig
    from holdfast.config.models.listeners import ExceptionStatusConfig
    from holdfast.importing import Note
    from holdfast.tags import Tag


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


def number_ranges(numbers: Iterable[int]) -> str:
    """Numbers as text: `1-10, 255`, or `none`."""
    ranges: list[list[int]] = []
    for number in sorted(numbers):
        if ranges and number == ranges[-1][1] + 1:
            ranges[-1][1] = number
        else:
            ranges.append([number, number])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in ranges) or "none"


def words(area: str) -> str:
    """The name of an area or key, with spaces."""
    return area.replace("_", " ")


def ranges_shown(ranges: Iterable[RangeConfig | ExceptionStatusConfig]) -> str:
    """Ranges of addresses: `coils 0-7, holding registers 5`."""
    return ", ".join(f"{words(each.area)} {extent(each.addresses)}" for each in ranges)


def plain(text: str) -> str:
    """Text from outside, with control characters escaped."""
    return "".join(letter if letter.isprintable() else _escaped(letter) for letter in text)


def _escaped(letter: str) -> str:
    code = ord(letter)
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}"


def order_shown(tag: Tag) -> str:
    """The byte order of a tag; empty if the order has no effect on its single register."""
    return tag.order if tag.count > 1 or tag.order in SWAPPED_BYTES else ""


def shown(value: Any, kind: str) -> str:
    """A typed value as text."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return decimal_of(value, kind)
    if isinstance(value, bytes):
        return value.hex(" ")
    if isinstance(value, str):
        return plain(json.dumps(value, ensure_ascii=False))
    return str(value)


def print_json(answer: object, indent: int | None = None) -> None:
    """Prints an answer for programs."""
    click.echo(json.dumps(answer, indent=indent))


def problems_to_json(problems: Iterable[Problem | Note]) -> list[dict[str, Any]]:
    """Problems, warnings or notes, for JSON."""
    return [asdict(problem) for problem in problems]


def print_problems(error: ConfigError, **more: object) -> None:
    """Prints the problems of a configuration, or of a tag list, as JSON."""
    problems = problems_to_json(error.problems)
    text = counted(len(problems), "problem")
    answers.print_wrong("configuration", text, more={"problems": problems, **more})


def show_problems(error: ConfigError) -> None:
    """Prints each problem as a line on standard error, and their number; or all as JSON."""
    if answers.wanted():
        print_problems(error)
        return
    for problem in error.problems:
        click.echo(problem, err=True)
    click.echo(counted(len(error.problems), "problem"), err=True)


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
    # Few commands need the log, which takes long to import.
    from holdfast.events import log_lines

    return log_lines.timestamp(time.time())

"""Values from a CSV file: a column for each tag, as `holdfast read --record` writes it."""

from __future__ import annotations

import csv
from itertools import chain, islice, repeat
from typing import TYPE_CHECKING, Any, NamedTuple

from holdfast.config.text import yaml_document
from holdfast.config.text.problems import ConfigError
from holdfast.simulation.capacity import Capacity
from holdfast.tags.csv_text import csv_separator
from holdfast.tags.strict_text import from_text
from holdfast.tags.text import value_from
from holdfast.values import DoesNotFit

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from pathlib import Path

    from holdfast.tags import Tag, TagList

MAX_ROWS = 1_000_000
TIME = "time"
"""The column that is ignored: each row is one step."""

_INFINITIES = ("inf", "-inf")
"""How infinite values of registers are recorded. No write takes them."""


class Unplayable(ValueError):
    """The file can't be played back."""


class Played(NamedTuple):
    """What a file has: an item for each row."""

    values: dict[str, list[Any]]
    """By the names of tags."""
    lines: list[int]
    """Their numbers in the file."""


def load(path: Path, tags: TagList) -> Played:
    """Reads the values of each tag. An empty cell repeats the value before, as does a null
    in an array for its item.

    Raises `Unplayable`, which names file and line, and `OSError`.
    """
    try:
        with path.open(encoding="utf-8-sig", errors="surrogateescape", newline="") as file:
            lines = _checked(file, str(path))
            first = [*islice(lines, 1)]
            separator = csv_separator("".join(first))
            rows = csv.reader(chain(first, lines), delimiter=separator)
            return _columns(rows, str(path), tags)
    except ConfigError as error:
        raise Unplayable(str(error)) from error
    except csv.Error as error:
        raise Unplayable(f"{path}: not CSV: {error}") from error


def _checked(lines: Iterable[str], file: str) -> Iterator[str]:
    """The lines of a file, one at a time. Raises `ConfigError` for one that is not UTF-8."""
    for number, line in enumerate(lines, 1):
        if not line.isascii():
            try:
                line.encode()
            except UnicodeEncodeError:
                data = line.encode(errors="surrogateescape")
                # A text that a device has, and its recording, may contain NUL.
                yaml_document.decoded(data, file, "CSV", may_have_nul=True, line=number)
        yield line


def _columns(rows: Any, file: str, tags: TagList) -> Played:
    names = next(rows, None)
    if names is None:
        raise Unplayable(f"{file}: the file is empty")
    for name in names:
        if name != TIME and name not in tags:
            raise Unplayable(f"{file}:1: found the column {name!r}, allowed: names of tags")
    found: dict[str, list[Any]] = {name: [] for name in names if name != TIME}
    if len(found) < len(names) - names.count(TIME):
        raise Unplayable(f"{file}:1: two columns have the same name")
    lines: list[int] = []
    capacities = {name: Capacity(tags[name]) for name in found if tags[name].source is None}
    for row in rows:
        if not row:
            continue
        where = f"{file}:{rows.line_num}"
        if len(row) != len(names):
            raise Unplayable(f"{where}: found {len(row)} cells, allowed: {len(names)}")
        if len(lines) == MAX_ROWS:
            raise Unplayable(f"{where}: more than {MAX_ROWS} rows")
        lines.append(rows.line_num)
        _take(found, zip(names, row, strict=True), where, tags, capacities)
    if not any(found.values()):
        raise Unplayable(f"{file}: no values")
    return Played(found, lines)


def _take(
    found: dict[str, list[Any]],
    cells: Iterable[tuple[str, str]],
    where: str,
    tags: TagList,
    capacities: Mapping[str, Capacity],
) -> None:
    for name, cell in cells:
        if name == TIME:
            continue
        before = found[name]
        if not cell:
            before.append(before[-1] if before else None)
            continue
        try:
            value = _value(tags[name], cell)
        except ValueError as error:
            raise Unplayable(f"{where}: {name}: {error}") from error
        if isinstance(value, list):
            items = chain((before[-1] if before else None) or (), repeat(None))
            value = [was if item is None else item for item, was in zip(value, items, strict=False)]
        before.append(value)
        if name in capacities:
            try:
                capacities[name].check(value)
            except DoesNotFit as error:
                raise Unplayable(f"{where}: {error}") from error


def _value(tag: Tag, cell: str) -> Any:
    """The value of a cell: a number before a state of that name, as states are recorded."""
    try:
        if tag.is_float and tag.of_type.count is None and cell in _INFINITIES:
            return float(cell)
        if tag.is_number:
            return value_from(tag, cell, states=False, is_measurement=True)
        return from_text(cell, tag.of_type, tag.type)
    except ValueError:
        return value_from(tag, cell)

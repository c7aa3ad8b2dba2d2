"""Reads a tag list from a file: YAML with `order` and `tags`, or CSV with one tag a line."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from holdfast.config import build
from holdfast.config.checks.common import Scope
from holdfast.config.checks.tags import check_profiles
from holdfast.config.text import yaml_document
from holdfast.config.text.messages import show
from holdfast.config.text.problems import ConfigError, Problem
from holdfast.config.text.report import Report
from holdfast.config.values.scalars import is_name
from holdfast.config.values.tag_scale import FORMS, PLACE_KEYS
from holdfast.runtime.suggestion import suggestion
from holdfast.runtime.text import listing
from holdfast.tags import TagList
from holdfast.tags.csv_text import csv_separator
from holdfast.tags.text import decimal_comma
from holdfast.types import KNOWN_AREAS

if TYPE_CHECKING:
    from holdfast.config.models.tags import ProfileConfig
    from holdfast.config.text.yaml_document import KeyPath

KINDS = (".yaml", ".yml", ".csv")

MAX_BYTES = 3 << 20
"""The size limit of a tag list. It has room for 25,000 tags, which take about 5 s; more would have
too many keys and values."""

COLUMNS = (
    *("name", "area", "address", "type", "order"),
    *("scale", "offset", "unit", "writable", "description"),
)
"""The columns of CSV, in this order if the file does not name them."""
MORE_COLUMNS = (
    *("min", "max", "deadband", "round", "encoding", "null"),
    *("device_class", "state_class"),
)
"""Columns that a file can have if it names its columns."""

_NUMBERS = ("scale", "offset", "min", "max", "deadband", "null")

_TEXT = (
    *("name", "type", "order", "unit", "description", "encoding", "round"),
    *("device_class", "state_class"),
)


def load_tags(path: Path | str) -> TagList:
    """Reads a tag list. Raises `ConfigError` with every problem."""
    return load_profile(Path(path), str(path)).tag_list


def parse_tags(
    text: str, file: str, *, is_csv: bool, max_values: int = yaml_document.MAX_VALUES
) -> TagList:
    """Parses a tag list; messages call it `file`. Raises `ConfigError` with every problem.

    YAML may have `max_values` values, with aliases expanded.
    """
    return _profile(text, file, "tags", Path(), is_csv=is_csv, max_values=max_values).tag_list


def load_profile(path: Path, file: str) -> ProfileConfig:
    """Reads a profile; messages call it `file`. Raises `ConfigError` with every problem."""
    name = path.stem if is_name(path.stem) else "tags"
    text = yaml_document.read_text(path, file, "YAML or CSV", MAX_BYTES)
    return _profile(text, file, name, path.parent, is_csv=path.suffix.lower() == ".csv")


def _profile(
    text: str,
    file: str,
    name: str,
    folder: Path,
    *,
    is_csv: bool,
    max_values: int = yaml_document.MAX_VALUES,
) -> ProfileConfig:
    if is_csv:
        document, problems = _csv(text, file)
    else:
        document, problems = yaml_document.parse(text, file, max_values=max_values)
    if not isinstance(document.data, dict):
        message = f"found {show(document.data)}, allowed: a mapping with the keys order, tags"
        raise ConfigError(file, problems or [Problem(file, 1, 1, "", message)])
    whole = document.inside("profiles", name)
    report = Report(whole)
    config = build.build(whole.data, folder, report)
    check_profiles(Scope(config, folder, report))
    problems += [_without(f"profiles.{name}", problem) for problem in report.problems]
    if problems:
        raise ConfigError(file, problems)
    return config.profiles[name]


def _without(prefix: str, problem: Problem) -> Problem:
    return replace(problem, key=problem.key.removeprefix(prefix).removeprefix("."))


@dataclass
class _Table:
    """The tags of a CSV file, as data with places."""

    file: str
    problems: list[Problem] = field(default_factory=list)
    tags: dict[Any, Any] = field(default_factory=dict)
    lines: dict[KeyPath, int] = field(default_factory=dict)

    def refuse(self, line: int, message: str, key: str = "") -> None:
        self.problems.append(Problem(self.file, line, None, key, message))

    def take(self, line: int, columns: list[str], cells: list[str]) -> None:
        """Adds the tag of a line."""
        if len(cells) > len(columns):
            self.refuse(line, f"found {len(cells)} cells, allowed: up to {len(columns)}")
            return
        given = {key: cell for key, cell in zip(columns, cells, strict=False) if cell}
        name = given.pop("name", None)
        if name is None:
            self.refuse(line, "the tag has no name, allowed: a name in the column name")
        elif name in self.tags:
            first = self.lines["tags", name]
            self.refuse(line, f"the tag {show(name)} is given twice, first in line {first}")
        else:
            self.tags[name] = tag = {}
            self.lines["tags", name] = line
            for key, cell in given.items():
                flaw = decimal_comma(cell) if key in _NUMBERS else None
                if flaw is None:
                    tag[key] = _cell(key, cell)
                else:
                    self.refuse(line, f"{show(cell)} {flaw}", f"tags.{name}.{key}")


def _csv(text: str, file: str) -> tuple[yaml_document.Document, list[Problem]]:
    yaml_document.require_allowed(text, file, "CSV")
    table, columns = _Table(file), list[str]()
    sample = next((line for line in text.splitlines() if line.strip() and line[0] != "#"), "")
    rows = csv.reader(io.StringIO(text, newline=None), delimiter=csv_separator(sample), strict=True)
    first = 1
    try:
        for row in rows:
            first = rows.line_num + 1
            cells = [cell.strip() for cell in row]
            if not any(cells) or cells[0].startswith("#"):
                continue
            if not columns and cells == ["sep=", ""]:  # The separator in a line of its own.
                continue
            if columns:
                table.take(rows.line_num, columns, cells)
            elif "name" in map(str.lower, cells):
                columns = _columns(table, rows.line_num, cells)
                if table.problems:  # The same ones would follow for each row.
                    raise ConfigError(file, table.problems)
            else:
                columns = list(COLUMNS)
                table.take(rows.line_num, columns, cells)
    except csv.Error as error:
        rule = "a cell that begins with a quote ends with one, and has others twice"
        table.refuse(first, f"not CSV: {error}, allowed: {rule}")
        raise ConfigError(file, table.problems) from None
    if not table.tags:
        if not table.problems:
            table.refuse(1, "found no tags, allowed: one in each line, as in level,hr,0")
        raise ConfigError(file, table.problems)
    document = yaml_document.table(file, {"tags": table.tags}, table.lines)
    return document, table.problems


def _columns(table: _Table, line: int, cells: list[str]) -> list[str]:
    known = (*COLUMNS, *MORE_COLUMNS)
    columns = [cell.lower() for cell in cells]
    for column in dict.fromkeys(columns):
        if column not in known:
            words = f"found the column {show(column)}, allowed: {listing(known)}"
            table.refuse(line, f"{words}{suggestion(column, known)}")
        elif columns.count(column) > 1:
            table.refuse(line, f"two columns have the name {show(column)}")
    return columns


def _cell(key: str, cell: str) -> Any:
    """The value of a cell, as YAML would have it."""
    if key == "area":
        return KNOWN_AREAS.get(cell.lower(), cell.lower())
    if key in _TEXT:
        return cell
    if key == "scale":
        return _scale(cell)
    if key == "writable":
        words = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}
        return words.get(cell.lower(), cell)
    if key == "null":
        return [yaml_document.scalar(part.strip()) for part in cell.split("|")]
    return yaml_document.scalar(cell)


def _scale(cell: str) -> Any:
    """A scale: a number, or `exponent W_SF`, `factor hr 12 uint16` for one in a register."""
    form, *words = cell.split()
    if form.lower() not in FORMS or not words:
        return yaml_document.scalar(cell)
    if len(words) == 1:
        return {"from": words[0], "as": form.lower()}
    if len(words) > len(PLACE_KEYS):
        return cell
    place = {key: _cell(key, word) for key, word in zip(PLACE_KEYS, words, strict=False)}
    return {"from": place, "as": form.lower()}

"""CSV: rows as lines, and the separator that a file uses."""

from __future__ import annotations

import csv
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable


def csv_lines(rows: Iterable[Iterable[object]]) -> str:
    """Rows of cells as lines of CSV, each of which ends with a newline."""
    lines = _Lines()
    csv.writer(lines).writerows(rows)  # Its own end of line, so that it quotes "\r" and "\n".
    return "".join(lines)


def csv_separator(line: str) -> str:
    """The separator of a CSV file by its first line: spreadsheets may use another than a comma."""
    return max(",;\t", key=line.count)


class _Lines(list[str]):
    """Takes the lines of a CSV writer, one at a time."""

    def write(self, line: str) -> None:
        self.append(line.removesuffix("\r\n") + "\n")

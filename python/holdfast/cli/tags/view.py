"""The live view of tags: a line for each, with value, unit, and the age of a value that is old."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from rich.cells import cell_len, set_cell_size
from rich.text import Text

from holdfast.cli import terminal_text
from holdfast.cli.live import highlight
from holdfast.cli.live.screen import CUT, Screen
from holdfast.cli.tags.changes import TagTracker
from holdfast.cli.tags.read import value_shown

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.cli.tags.changes import Tracked
    from holdfast.cli.tags.source import TagSource
    from holdfast.client.tag_reading import Error, Reading

MIN_NAME_COLUMNS = 8
"""The width that names keep on a narrow terminal."""

MAX_VALUE_COLUMNS = 20
"""The maximum width of the column of values; longer ones extend beyond it."""

GAP_COLUMNS = 2


class TagView(Screen):
    """Shows all tags, starting with the reading `first`."""

    def __init__(self, source: TagSource, first: Sequence[Reading], every: float) -> None:
        super().__init__(source.where, every, None)
        self._source = source
        self._tracker = TagTracker(source.tags)
        self._tracker.update(time.monotonic(), first)

    def read(self) -> None:
        """Reads all tags, and redraws meanwhile."""
        _, readings = self._source.read(self.between)
        self._tracker.update(time.monotonic(), readings)

    @property
    def tag_errors(self) -> list[Error | None]:
        """The error of each tag in the last reading."""
        return [each.error for each in self._tracker.tracked]

    def state(self) -> tuple[int, int, str]:
        """The numbers of readings and of errors, and the error of the last reading, or ""."""
        tracker = self._tracker
        return tracker.readings, tracker.errors, str(tracker.error or "")

    def foot(self, width: int) -> list[Text]:  # noqa: ARG002
        """Nothing."""
        return []

    def body(self, width: int) -> list[Text]:
        """A line for each tag, or more if it does not fit."""
        rows = [_Row(each, self._tracker) for each in self._tracker.tracked]
        values = max(min(MAX_VALUE_COLUMNS, cell_len(row.value)) for row in rows)
        units = max(cell_len(row.unit) for row in rows)
        most = width - GAP_COLUMNS - values - (units + 1 if units else 0)
        names = min(max(cell_len(row.name) for row in rows), max(MIN_NAME_COLUMNS, most))
        return [line for row in rows for line in row.lines(names, values, units, width)]


class _Row:
    """A tag on the screen. Without room beside the name, its value is below, if need be alone.

    A text is cut there. Of a number, no digits are left out: what remained would be another one.
    """

    def __init__(self, tracked: Tracked, tracker: TagTracker) -> None:
        tag = tracked.tag
        self.name = terminal_text.plain(tag.name)
        has_value = tracked.was_read and tracked.value is not None
        self.value = value_shown(tag, tracked.value) if tracked.was_read else "-"
        self.unit = terminal_text.plain(tag.unit) if has_value else ""
        self._is_text = has_value and (
            isinstance(tracked.value, str | bytes) or tag.state(tracked.value) is not None
        )
        self.note = ""
        self._style = "" if has_value else "dim"
        if tracked.error is not None:
            self._style = "dim"
            old = f"{_age(time.monotonic() - tracked.at)} old" if tracked.was_read else ""
            error = "" if tracker.error is not None else str(tracked.error)
            self.note = ": ".join(part for part in (old, terminal_text.plain(error)) if part)
        else:
            self._style = highlight.style(tracker.age(tracked)) or self._style

    def lines(self, names: int, values: int, units: int, width: int) -> list[Text]:
        """The row for columns of these widths."""
        value = Text.assemble(
            " " * (values - cell_len(self.value)),
            (self.value, self._style),
            f" {self.unit}" if self.unit else "",
        )
        lines = []
        if names + GAP_COLUMNS + value.cell_len <= width:
            row = Text.assemble(_fitted(self.name, names), " " * GAP_COLUMNS, value)
        else:
            lines.append(Text(self.name))
            lines[0].truncate(width, overflow="ellipsis")
            shown = self._fitted(width)
            indent = " " * GAP_COLUMNS if GAP_COLUMNS + cell_len(shown) <= width else ""
            row = Text.assemble(indent, (shown, self._style))
            if self.unit and row.cell_len + 1 + cell_len(self.unit) <= width:
                row.append(f" {self.unit}")
        if not self.note:
            return [*lines, row]
        start = names + GAP_COLUMNS + values + (units + 1 if units else 0) + GAP_COLUMNS
        if max(start, row.cell_len + GAP_COLUMNS) + cell_len(self.note) <= width:
            row.append(" " * max(GAP_COLUMNS, start - row.cell_len))
            row.append(self.note, "red")
            return [*lines, row]
        note = Text.assemble(" " * GAP_COLUMNS, (self.note, "red"))
        note.truncate(width, overflow="ellipsis")
        return [*lines, row, note]

    def _fitted(self, width: int) -> str:
        """The value in this width; else the start of a text, or the first numbers of an array."""
        if cell_len(self.value) <= width:
            return self.value
        start = set_cell_size(self.value, width - 1)
        return (start if self._is_text else start[: start.rfind(",") + 1]) + CUT


def _fitted(name: str, width: int) -> str:
    """A name with exactly this width; an ellipsis shows that it is cut."""
    if cell_len(name) <= width:
        return set_cell_size(name, width)
    return set_cell_size(name, width - 1) + "…"


def _age(seconds: float) -> str:
    """`12 s`, `3 min` or `2 h`."""
    if seconds < 60:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 3600 else f"{seconds / 3600:.0f} h"

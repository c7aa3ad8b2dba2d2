"""The live view of tags: a line for each, with value, unit, and the age of a value that is old."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from rich.cells import cell_len, set_cell_size
from rich.text import Text

from holdfast.cli import showing
from holdfast.cli.screen import FADE, FRESH, RECENT, Screen
from holdfast.cli.tag_tracking import TagTracker
from holdfast.cli.tagged_read import value_shown

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.cli.tag_source import TagSource
    from holdfast.cli.tag_tracking import Tracked
    from holdfast.tools.tag_reading import Reading

MIN_NAME = 8
"""The width that names keep on a narrow terminal."""

MAX_VALUE = 20
"""The maximum width of the column of values; longer ones extend beyond it."""

GAP = 2


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

    def state(self) -> tuple[int, int, str | None]:
        """The numbers of readings and of errors, and the error of the last reading."""
        tracker = self._tracker
        error = None if tracker.error is None else str(tracker.error)
        return tracker.readings, tracker.errors, error

    def foot(self) -> list[Text]:
        """Nothing."""
        return []

    def body(self, width: int) -> list[Text]:
        """A line for each tag, or more if it does not fit."""
        rows = [_Row(each, self._tracker) for each in self._tracker.tracked]
        values = max(min(MAX_VALUE, cell_len(row.value)) for row in rows)
        units = max(cell_len(row.unit) for row in rows)
        most = width - GAP - values - (units + 1 if units else 0)
        names = min(max(cell_len(row.name) for row in rows), max(MIN_NAME, most))
        return [line for row in rows for line in row.lines(names, values, units, width)]


class _Row:
    """A tag on the screen. Its number is never cut off: without room, it has a line of its own."""

    def __init__(self, tracked: Tracked, tracker: TagTracker) -> None:
        tag = tracked.tag
        self.name = showing.plain(tag.name)
        has_value = tracked.was_read and tracked.value is not None
        self.value = value_shown(tag, tracked.value) if tracked.was_read else "-"
        self.unit = showing.plain(tag.unit) if has_value else ""
        self.note = ""
        self._style = "" if has_value else "dim"
        if tracked.error is not None:
            self._style = "dim"
            old = f"{_age(time.monotonic() - tracked.at)} old" if tracked.was_read else ""
            error = "" if tracker.error is not None else str(tracked.error)
            self.note = ": ".join(part for part in (old, showing.plain(error)) if part)
        else:
            age = tracker.age(tracked)
            if age is not None and age < FADE:
                self._style = FRESH if age == 0 else RECENT

    def lines(self, names: int, values: int, units: int, width: int) -> list[Text]:
        """The row for columns of these widths."""
        value = Text.assemble(
            " " * (values - cell_len(self.value)),
            (self.value, self._style),
            f" {self.unit}" if self.unit else "",
        )
        lines = []
        if names + GAP + value.cell_len <= width:
            row = Text.assemble(_fitted(self.name, names), " " * GAP, value)
        else:
            lines.append(Text(self.name))
            lines[0].truncate(width, overflow="ellipsis")
            row = Text.assemble(" " * GAP, (self.value, self._style), f" {self.unit}".rstrip())
            row.truncate(width, overflow="ellipsis")
        if not self.note:
            return [*lines, row]
        start = names + GAP + values + (units + 1 if units else 0) + GAP
        if max(start, row.cell_len + GAP) + cell_len(self.note) <= width:
            row.append(" " * max(GAP, start - row.cell_len))
            row.append(self.note, "red")
            return [*lines, row]
        note = Text.assemble(" " * GAP, (self.note, "red"))
        note.truncate(width, overflow="ellipsis")
        return [*lines, row, note]


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

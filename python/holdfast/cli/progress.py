"""A progress bar on standard error, if that is a terminal."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from typing import TYPE_CHECKING, Any, final

import click

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

ESTIMATE_COLUMNS = 80
LABEL_COLUMNS = 36
"""The bar has an estimate, or a label and a note, if the terminal has so many columns."""

BAR_COLUMNS = 30
OTHER_COLUMNS = 27
"""The columns of the bar; those of spaces, percentage and note."""

REDRAW_INTERVAL_S = 0.1
"""Between two updates of the bar."""


@final
class Bar:
    """A progress bar."""

    def __init__(self, shown: Any, length: int, columns: int) -> None:
        self._shown = shown
        self._length = length
        self._columns = columns
        self._drawn = 0.0

    def __call__(self, at: int) -> None:
        """Sets the progress, from 0 to the length."""
        now = time.monotonic()
        if now - self._drawn >= REDRAW_INTERVAL_S:
            self._drawn = now
            self._shown.update(min(at, self._length) - self._shown.pos)
            self._shown.render_progress()

    def clear(self) -> None:
        """Clears the line of the bar, for a line of output there. The bar comes back below it."""
        if sys.stdout.isatty():
            click.echo(f"\r{' ' * (self._columns - 1)}\r", file=sys.stderr, nl=False)
            self._drawn = 0.0


@contextlib.contextmanager
def bar(label: str, length: int, note: Callable[[], str]) -> Iterator[Bar | None]:
    """Yields a bar with this length; `None` without a terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    columns = os.get_terminal_size(sys.stderr.fileno()).columns or 80
    has_room = columns >= ESTIMATE_COLUMNS
    shown = click.progressbar(
        range(length),
        label=label if columns >= LABEL_COLUMNS else None,
        file=sys.stderr,
        item_show_func=(lambda _: note()) if columns >= LABEL_COLUMNS else None,
        show_eta=has_room,
        width=BAR_COLUMNS if has_room else max(3, columns - len(label) - OTHER_COLUMNS),
    )
    with shown:
        yield Bar(shown, length, columns)
        shown.update(length - shown.pos)

"""A progress bar on standard error, if that is a terminal."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from typing import TYPE_CHECKING, TypeAlias

import click

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    Advance: TypeAlias = Callable[[int], None]

ROOMY = 80
TIGHT = 36
"""Columns of a terminal from which the bar has an estimate; and a label and a note."""

WIDTH = 30
OTHERS = 27
"""The columns of the bar; those of spaces, percentage and note."""

BETWEEN = 0.1
"""Seconds between updates of the bar."""


@contextlib.contextmanager
def bar(label: str, length: int, note: Callable[[], str]) -> Iterator[Advance | None]:
    """Yields a function that sets the progress, from 0 to `length`; `None` without a terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    columns = os.get_terminal_size(sys.stderr.fileno()).columns or 80
    has_room = columns >= ROOMY
    shown = click.progressbar(
        range(length),
        label=label if columns >= TIGHT else None,
        file=sys.stderr,
        item_show_func=(lambda _: note()) if columns >= TIGHT else None,
        show_eta=has_room,
        width=WIDTH if has_room else max(3, columns - len(label) - OTHERS),
    )
    seen = 0.0
    with shown:

        def advance(at: int) -> None:
            nonlocal seen
            now = time.monotonic()
            if now - seen >= BETWEEN:
                seen = now
                shown.update(min(at, length) - shown.pos)

        yield advance
        shown.update(length - shown.pos)

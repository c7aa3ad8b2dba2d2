"""A progress bar on standard error, if that is a terminal."""

from __future__ import annotations

import contextlib
import sys
import time
from typing import TYPE_CHECKING, TypeAlias

import click

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    Advance: TypeAlias = Callable[[int], None]

BETWEEN = 0.1
"""Seconds between updates of the bar."""


@contextlib.contextmanager
def bar(label: str, length: int, note: Callable[[], str]) -> Iterator[Advance | None]:
    """Yields a function that sets the progress, from 0 to `length`; `None` without a terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    shown = click.progressbar(
        range(length), label=label, file=sys.stderr, item_show_func=lambda _: note()
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

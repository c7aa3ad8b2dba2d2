"""Options for times: `--every`, `--timeout`, `--delay`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from holdfast.cli.options.option import Command, option
from holdfast.client.base import MAX_TIMEOUT_S
from holdfast.runtime.time_units import TIME, seconds_in

if TYPE_CHECKING:
    from collections.abc import Callable

WHOLE_REQUEST = "Time limit for connection, request and reply together."


class Duration(click.ParamType):  # type: ignore[type-arg]
    """A time with its unit, as in `500ms` or `2s`; without a unit, seconds."""

    name = "time"

    def __init__(
        self, least_s: float = 0.0, most_s: float = MAX_TIMEOUT_S, *, zero: bool = False
    ) -> None:
        self._least_s = least_s
        self._most_s = most_s
        self._zero = zero

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Parses a time, in seconds."""
        text = str(value).strip()
        match = TIME.fullmatch(text)
        if match is not None and match[3].lower() == "m":
            self.fail(f"{text!r} is not clear: write {match[1]}min or {match[1]}ms.", param, ctx)
        found = seconds_in(text)
        seconds = -1.0 if found is None else found
        if seconds == 0 and self._zero:
            return 0.0
        if not max(self._least_s, 1e-9) <= seconds <= self._most_s:
            span = f"from {self._least_s:g}" if self._least_s else "more than 0"
            allowed = f"{'0, or ' if self._zero else ''}{span}, up to {self._most_s:.12g} s"
            self.fail(
                f"{text!r} is not a time, as in 500ms, 2s or 2 (seconds): {allowed}.", param, ctx
            )
        return seconds


def time_option(
    names: str, help: str, default: str | None = None, type: Duration | None = None
) -> Callable[[Command], Command]:
    """Adds an option for a time."""
    return option(names, "TIME", help, type or Duration(), default)


def every_option(default: str | None, help: str) -> Callable[[Command], Command]:
    """Adds `--every`, the interval between readings."""
    return time_option("--every", help, default)


def timeout_option(
    default: str | None = "1", help: str = WHOLE_REQUEST, type: Duration | None = None
) -> Callable[[Command], Command]:
    """Adds `--timeout`."""
    return time_option("--timeout", help, default, type)


delay_option = time_option("--delay", "Wait between two requests.", "0", Duration(zero=True))

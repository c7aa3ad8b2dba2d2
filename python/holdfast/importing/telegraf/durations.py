"""Durations as Telegraf has them: 1m30s, or seconds."""

from __future__ import annotations

import re
from fractions import Fraction
from typing import TYPE_CHECKING

from holdfast.client.base import MIN_INTERVAL_S
from holdfast.config.text.messages import show
from holdfast.config.values.scalars import MAX_TIME

if TYPE_CHECKING:
    from holdfast.importing.key_reader import Section

_UNITS = {
    "ns": Fraction(1, 10**9),
    "us": Fraction(1, 10**6),
    "µs": Fraction(1, 10**6),
    "μs": Fraction(1, 10**6),
    "ms": Fraction(1, 1000),
    "s": Fraction(1),
    "m": Fraction(60),
    "h": Fraction(3600),
    "d": Fraction(86_400),
}
_PART = re.compile(r"([0-9]+\.?[0-9]*|\.[0-9]+)(ns|us|µs|μs|ms|s|m|h|d)")


def seconds(section: Section, key: str) -> float | None:
    """The duration at a key in seconds; `None` if it is absent or 0."""
    value = section.get(key)
    text = str(value) if type(value) in (int, float) else value
    if text in (None, ""):
        return None
    total = None
    if isinstance(text, str):
        if re.fullmatch(r"[0-9]+(\.[0-9]+)?", text):
            total = Fraction(text)
        elif re.fullmatch(rf"({_PART.pattern})+", text):
            total = sum((Fraction(n) * _UNITS[unit] for n, unit in _PART.findall(text)), Fraction())
    if total is None or total > MAX_TIME:
        message = f"found {show(value)}, allowed: a duration of up to 366 days, as in '1m30s'"
        section.problem(key, message)
        return None
    return (int(total) if total.denominator == 1 else float(total)) or None


def interval(section: Section) -> float | None:
    """The interval of a table in seconds, as long as the shortest here."""
    found = seconds(section, "interval")
    if found is not None and found < MIN_INTERVAL_S:
        message = f"raised to {MIN_INTERVAL_S * 1000:g} ms, the shortest interval"
        section.changed("interval", message)
        return MIN_INTERVAL_S
    return found

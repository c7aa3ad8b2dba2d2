"""Times as people write them, with a unit: `500ms`, `2s`."""

from __future__ import annotations

import re

TIME = re.compile(r"([0-9]+\.?[0-9]*|\.[0-9]+)(?:e([+-]?[0-9]{1,3}))? ?([a-z]*)", re.I)
"""A time as people write it: a number, its exponent, and its unit."""

_UNITS_S = {"ms": 0.001, "s": 1.0, "min": 60.0, "h": 3600.0, "": 1.0}


def seconds_in(text: str) -> float | None:
    """The seconds of a time as in `500ms`, `2s` or `2`; `None` for other text, also for `m`."""
    match = TIME.fullmatch(text)
    unit = None if match is None else _UNITS_S.get(match[3].lower())
    if match is None or unit is None:
        return None
    return float(f"{match[1]}e{match[2] or 0}") * unit

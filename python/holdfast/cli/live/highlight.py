"""How `holdfast watch` highlights a value that has changed, and for how many readings."""

from __future__ import annotations

FADE_READINGS = 3
"""A change stays highlighted for so many readings."""

_FRESH = "bold reverse yellow"
_RECENT = "bold yellow"


def style(age: int | None) -> str:
    """The style of a value that changed `age` readings ago; `None`: never."""
    if age is None or age >= FADE_READINGS:
        return ""
    return _FRESH if age == 0 else _RECENT

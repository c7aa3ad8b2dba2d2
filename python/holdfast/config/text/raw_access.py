"""Reads data that is not validated: a value of the wrong type counts as absent."""

from __future__ import annotations

from typing import Any


def mapping(value: object) -> dict[Any, Any]:
    """The value if it is a mapping, else an empty mapping."""
    return value if isinstance(value, dict) else {}


def entries(value: object) -> list[Any]:
    """The value if it is a list, else an empty list."""
    return value if isinstance(value, list) else []

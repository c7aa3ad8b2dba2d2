"""The test vectors, and the memories they define."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from support.paths import VECTORS

if TYPE_CHECKING:
    from holdfast.types import Area


def cases(name: str) -> list[dict[str, Any]]:
    loaded: list[dict[str, Any]] = json.loads((VECTORS / name).read_text())["cases"]
    assert loaded
    return loaded


def overlay(areas: dict[Area, list[int]], changes: dict[Area, dict[str, list[int]]]) -> None:
    for area, runs in changes.items():
        for address, values in runs.items():
            start = int(address)
            areas[area][start : start + len(values)] = values

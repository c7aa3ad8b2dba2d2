"""Reads audit logs."""

from __future__ import annotations

import errno
import json
import os
from typing import TYPE_CHECKING, Any

from support import wire

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    import pytest


def full(monkeypatch: pytest.MonkeyPatch, room: int = 10) -> Callable[[], None]:
    """Lets the disk be full after some more bytes. Returns how to make room."""
    left, real = room, os.write

    def written(descriptor: int, data: bytes) -> int:
        nonlocal left
        if left == 0:
            raise OSError(errno.ENOSPC, "no space left on device")
        data, left = data[:left], 0
        return real(descriptor, data)

    monkeypatch.setattr(os, "write", written)
    return lambda: monkeypatch.setattr(os, "write", real)


def lines(file: Path) -> list[dict[str, Any]]:
    """Returns the whole lines of an audit log."""
    whole, _, _ = file.read_text().rpartition("\n")
    return [json.loads(line) for line in whole.splitlines()]


def writes(file: Path) -> list[dict[str, Any]]:
    """Returns the lines about writes, without their time and their place in the chain."""
    chained = ("time", "seq", "prev")
    return [
        {key: value for key, value in line.items() if key not in chained}
        for line in lines(file)
        if "event" not in line
    ]


def await_writes(file: Path, count: int) -> list[dict[str, Any]]:
    """Returns the lines about writes when there are so many."""
    wire.until(lambda: len(writes(file)) >= count, f"{count} writes")
    return writes(file)

"""Reads the password for a broker."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.bounded_files import MAX_SECRETS, read
from holdfast.config.broker import MAX_TEXT

if TYPE_CHECKING:
    from pathlib import Path

MAX_PASSWORD = MAX_TEXT


def read_password(file: Path | None) -> bytes | None:
    """Reads the password at each attempt, so that a new password needs no restart."""
    if file is None:
        return None
    content = read(file, MAX_SECRETS)
    newline = b"\r\n" if content.endswith(b"\r\n") else b"\n"
    password = content.removesuffix(newline)
    if len(password) > MAX_PASSWORD:
        raise ValueError(f"{file} holds more than {MAX_PASSWORD} bytes")
    return password

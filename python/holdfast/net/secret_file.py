"""Reads a file that contains a password or a token."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.bounded_files import MAX_SECRETS, read

if TYPE_CHECKING:
    from pathlib import Path


def read_secret(file: Path) -> str:
    """Returns the text without the end of its line. Raises `OSError` for an unusable file."""
    try:
        return read(file, MAX_SECRETS).decode().removesuffix("\n").removesuffix("\r")
    except UnicodeDecodeError:
        raise OSError(f"{file} is not UTF-8 text") from None

"""Reads files that contain a password or a token."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.runtime.bounded_files import MAX_SECRETS_BYTES, read

if TYPE_CHECKING:
    from pathlib import Path


def read_secret(file: Path) -> str:
    """Returns the text without the end of its line. Raises `OSError` for an unusable file."""
    try:
        return read(file, MAX_SECRETS_BYTES).decode().removesuffix("\n").removesuffix("\r")
    except UnicodeDecodeError:
        raise OSError(f"{file} is not UTF-8 text") from None

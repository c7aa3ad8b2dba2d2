"""Reads files that contain a password or a token."""

from __future__ import annotations

import codecs
from typing import TYPE_CHECKING

from holdfast.runtime.bounded_files import MAX_SECRETS_BYTES, read

if TYPE_CHECKING:
    from pathlib import Path


def read_secret(file: Path) -> str:
    """Returns the text without the end of its line. Raises `OSError` for an unusable file."""
    try:
        return read_bytes(file).decode().removesuffix("\n").removesuffix("\r")
    except UnicodeDecodeError:
        raise OSError(f"{file} is not UTF-8 text") from None


def read_bytes(file: Path) -> bytes:
    """Returns the content without the byte order mark that editors on Windows put before it."""
    return read(file, MAX_SECRETS_BYTES).removeprefix(codecs.BOM_UTF8)

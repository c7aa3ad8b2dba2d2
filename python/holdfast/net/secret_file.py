"""Reads files that contain a password or a token."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.net.mqtt import MAX_TEXT
from holdfast.runtime.bounded_files import MAX_SECRETS_BYTES, read

if TYPE_CHECKING:
    from pathlib import Path


def read_secret(file: Path) -> str:
    """Returns the text without the end of its line. Raises `OSError` for an unusable file."""
    try:
        return read(file, MAX_SECRETS_BYTES).decode().removesuffix("\n").removesuffix("\r")
    except UnicodeDecodeError:
        raise OSError(f"{file} is not UTF-8 text") from None


def read_password(file: Path | None) -> bytes | None:
    """Returns the password for an MQTT broker, which may be any bytes.

    Called at each attempt to connect, so that a new password needs no restart. Raises `OSError` for
    an unusable file.
    """
    if file is None:
        return None
    content = read(file, MAX_SECRETS_BYTES)
    newline = b"\r\n" if content.endswith(b"\r\n") else b"\n"
    password = content.removesuffix(newline)
    if len(password) > MAX_TEXT:
        raise OSError(f"{file} holds more than {MAX_TEXT} bytes")
    return password

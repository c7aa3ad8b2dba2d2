"""The texts of SunSpec points: their encoding, and registers without a text."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

NO_TEXT = 0x8000
"""Some devices fill the registers of a text that is not implemented with this, instead of 0."""


def encoding_of(registers: Sequence[int]) -> str:
    """UTF-8, as SunSpec has it, or Latin-1 of a device that does not follow it."""
    try:
        _bytes(registers).decode("utf-8")
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8"


def text_in(registers: Sequence[int], encoding: str) -> str | None:
    """The text without its padding; `None` if there is none."""
    if set(registers) == {NO_TEXT}:
        return None
    return _bytes(registers).rstrip(b"\0 ").decode(encoding) or None


def _bytes(registers: Sequence[int]) -> bytes:
    return b"".join(each.to_bytes(2, "big") for each in registers)

"""Which errors mean that received bytes are no JSON of the expected form."""

from __future__ import annotations

import msgspec

MALFORMED_JSON = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)
"""What msgspec raises: for other forms, for a text that is not UTF-8, and for deep nesting."""


def malformed_text(error: Exception) -> str:
    """Returns what is wrong, for people."""
    # The position in the error counts from the start of the string, not of the document.
    text = "a string is not UTF-8" if isinstance(error, UnicodeDecodeError) else str(error)
    if text.endswith("invalid character (byte 0)"):
        text += ": it may be a byte order mark, which is not shown"
    return text

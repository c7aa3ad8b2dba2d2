"""Which errors mean that received bytes are no JSON of the expected form."""

from __future__ import annotations

import codecs

import msgspec

MALFORMED_JSON = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)
"""What msgspec raises: for other forms, for a text that is not UTF-8, and for deep nesting."""


def malformed_text(error: Exception, data: bytes | bytearray | memoryview) -> str:
    """Returns what is wrong with the data, for people."""
    # The position in the error counts from the start of the string, not of the document.
    text = "a string is not UTF-8" if isinstance(error, UnicodeDecodeError) else str(error)
    if text.endswith("invalid character (byte 0)") and data[:3] == codecs.BOM_UTF8:
        text += ": it is a byte order mark, which is not shown"
    return text

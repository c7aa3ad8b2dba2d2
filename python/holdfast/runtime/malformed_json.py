"""Which errors mean that received bytes are no JSON of the expected form."""

from __future__ import annotations

import msgspec

MALFORMED_JSON = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)
"""What msgspec raises: for other forms, for a text that is not UTF-8, and for deep nesting."""

"""Escapes invisible characters in lines of an audit log."""

from __future__ import annotations

import json


def escaped(body: bytes) -> bytes:
    """JSON with invisible characters escaped, as they could forge what a terminal shows of a line.

    JSON has them only in texts, and the encoders escape none above U+001F.
    """
    if body.isascii() and b"\x7f" not in body:
        return body
    letters = body.decode(errors="replace")
    if letters.isprintable():
        return body
    return "".join(
        letter if letter.isprintable() else json.dumps(letter)[1:-1] for letter in letters
    ).encode()

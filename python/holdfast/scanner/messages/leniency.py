"""Reads requests of callers that do not keep to the message types exactly.

tentacle-modbus did not check requests, so its callers send unknown keys and numbers as text. Such a
request is adjusted where its meaning is certain, and refused otherwise: a value is never guessed.
`Adjustments` collects what was changed, for the log.
"""

from __future__ import annotations

import re
from decimal import Decimal
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec

from holdfast.scanner.errors import Refused
from holdfast.scanner.messages.types import (
    SubscribeRequest,
    TagRequest,
    UnsubscribeRequest,
    check_size,
    converted,
    decode,
    with_integers,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

Asked = TypeVar("Asked", SubscribeRequest, UnsubscribeRequest)

NUMBERS = ("port", "unitId", "scanRate", "timeout", "deadband", "address", "ttl")
"""The keys of numbers, in requests and in their tags."""

MAX_SHOWN = 5
"""The most keys and tags in one line of the log."""

_NUMBER = re.compile(r"[+-]?[0-9]{1,15}(\.[0-9]{0,15})?([eE][+-]?[0-9]{1,2})?")


class Adjustments:
    """What was changed in a request, by kind; and what its caller must know of its tags."""

    def __init__(self) -> None:
        self._found: dict[str, list[str]] = {}
        self.warnings: list[tuple[str, str]] = []
        """Tag ids, and what is to be known of the byte order of each."""

    def add(self, kind: str, what: str) -> None:
        """Adds a change. Equal ones are listed once."""
        listed = self._found.setdefault(kind, [])
        if what not in listed:
            listed.append(what)

    def warn(self, tag: str, note: str) -> None:
        """Adds what is to be known of the byte order of a tag."""
        self.warnings.append((tag, note))

    def __iter__(self) -> Iterator[tuple[str, str]]:
        """Yields each kind with its changes as text."""
        for kind, listed in self._found.items():
            more = f" and {len(listed) - MAX_SHOWN} more" if len(listed) > MAX_SHOWN else ""
            yield kind, ", ".join(listed[:MAX_SHOWN]) + more


def adjusted(data: bytes, kind: type[Asked], most: int, changes: Adjustments) -> Asked:
    """Parses a request of at most `most` bytes. Adds what was changed. Raises `Refused`."""
    check_size(data, most)
    try:
        return decode(data, kind, most)
    except Refused:
        try:
            found = with_integers(msgspec.json.decode(data))
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            found = None
        if type(found) is not dict:
            raise
    return converted(_request(found, kind, changes), kind)


def _request(found: dict[str, Any], kind: type[Asked], changes: Adjustments) -> dict[str, Any]:
    request = _tidy(found, kind, changes)
    if kind is SubscribeRequest and type(request.get("tags")) is list:
        request["tags"] = [
            _tidy(tag, TagRequest, changes) if type(tag) is dict else tag for tag in request["tags"]
        ]
    return request


def _tidy(
    found: dict[str, Any], kind: type[Asked | TagRequest], changes: Adjustments
) -> dict[str, Any]:
    """Returns an object without unknown keys, with numbers in place of exact texts."""
    known = {field.encode_name for field in msgspec.structs.fields(kind)}
    for key in found:
        if key not in known:
            changes.add("keys_ignored", key if len(key) <= 64 else f"{key[:64]}…")
    return {
        key: _number(value) if key in NUMBERS and type(value) is str else value
        for key, value in found.items()
        if key in known
    }


def _number(text: str) -> int | float | str:
    """Returns the number that a text states; the text itself if it is not exactly a number."""
    text = text.strip()
    if _NUMBER.fullmatch(text) is None:
        return text
    exact = Decimal(text)
    if exact == exact.to_integral_value():
        return int(exact)
    return float(exact)

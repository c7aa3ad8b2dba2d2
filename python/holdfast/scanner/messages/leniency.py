"""Adjusts requests of callers that do not keep to the message types exactly. Does no I/O.

tentacle-modbus did not check requests, so its callers send unknown keys and numbers as text. Such a
request is adjusted where its meaning is certain, and refused otherwise: a value is never guessed.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from decimal import Decimal
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec

from holdfast.scanner.messages.types import SubscribeRequest, TagRequest, UnsubscribeRequest

if TYPE_CHECKING:
    from collections.abc import Iterator

Lenient = TypeVar("Lenient", SubscribeRequest, UnsubscribeRequest)
"""The requests that may be adjusted."""

NUMBERS = ("port", "unitId", "scanRate", "timeout", "deadband", "address", "ttl")
"""The keys of numbers, in requests and in their tags."""

MAX_LISTED = 5
"""The most keys and tags in one line of the log."""

MAX_KEY_LENGTH = 64
"""The most characters of an unknown key in the log."""

_NUMBER = re.compile(r"[+-]?[0-9]{1,15}(\.[0-9]{0,15})?([eE][+-]?[0-9]{1,2})?")


@dataclass
class Adjustments:
    """What was changed in a request, for the log; and what its caller must know of its tags."""

    are_allowed: bool = True
    """Whether a request may be changed; otherwise it is refused."""
    changes: list[tuple[str, str]] = field(default_factory=list)
    """The kind of each change, which is an event of the log, and what was found."""
    byte_orders: list[tuple[str, str]] = field(default_factory=list)
    """Tag ids, and what is to be known of the byte order of each."""

    def summary(self) -> Iterator[tuple[str, str]]:
        """Yields each kind with its changes as text. Equal ones are listed once."""
        of_kind: dict[str, dict[str, None]] = {}
        for kind, found in self.changes:
            of_kind.setdefault(kind, {})[found] = None
        for kind, listed in of_kind.items():
            first = list(listed)[:MAX_LISTED]
            more = f" and {len(listed) - MAX_LISTED} more" if len(listed) > MAX_LISTED else ""
            yield kind, ", ".join(first) + more


def tidied(found: dict[str, Any], kind: type[Lenient], adjustments: Adjustments) -> dict[str, Any]:
    """Returns a request without unknown keys, with numbers in place of exact texts."""
    request = _tidy(found, kind, adjustments)
    if kind is SubscribeRequest and type(request.get("tags")) is list:
        request["tags"] = [
            _tidy(tag, TagRequest, adjustments) if type(tag) is dict else tag
            for tag in request["tags"]
        ]
    return request


def _tidy(
    found: dict[str, Any], kind: type[Lenient | TagRequest], adjustments: Adjustments
) -> dict[str, Any]:
    known = {field.encode_name for field in msgspec.structs.fields(kind)}
    for key in found:
        if key not in known:
            shown = key if len(key) <= MAX_KEY_LENGTH else f"{key[:MAX_KEY_LENGTH]}…"
            adjustments.changes.append(("keys_ignored", shown))
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

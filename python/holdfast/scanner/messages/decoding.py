"""Parses the requests of callers, and adjusts those that are not exact. Does no I/O.

`decode` checks requests strictly: an unknown key, a wrong type or a value out of range refuses the
whole request. `null` for an optional value is the same as omitting it. `decode_lenient` adjusts a
request where its meaning is certain, and refuses it otherwise: a value is never guessed.
tentacle-modbus did not check requests, so its callers send unknown keys and numbers as text.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from decimal import Decimal
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar, get_args

import msgspec

from holdfast.config.values.scanner_settings import Publish
from holdfast.runtime.malformed_json import MALFORMED_JSON, malformed_text
from holdfast.runtime.text import clip, quote
from holdfast.scanner.errors import Refused
from holdfast.scanner.messages.types import (
    FunctionCode,
    Request,
    SubscribeRequest,
    TagRequest,
    UnsubscribeRequest,
)
from holdfast.types import TRANSPORTS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

Lenient = TypeVar("Lenient", SubscribeRequest, UnsubscribeRequest)
"""The requests that may be adjusted."""

Normalize: TypeAlias = "Callable[[dict[str, Any]], dict[str, Any]]"
"""Returns the JSON object of a request with other keys. It may change the one that it gets."""

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
            adjustments.changes.append(("keys_ignored", clip(key, MAX_KEY_LENGTH)))
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


Decoded = TypeVar("Decoded", bound=Request)

MAX_DEPTH = 10
"""No request is nested deeper."""

MAX_EXACT_FLOAT = 2.0**53
"""Floats below this represent every integer exactly."""

CHOICES: dict[str, Sequence[str]] = {
    "functionCode": get_args(FunctionCode),
    "transport": TRANSPORTS,
    "publish": get_args(Publish),
    "tagIds": ("all",),
}
"""The words that a key accepts. `tagIds` accepts a list as well."""


def decode(data: bytes, kind: type[Decoded], max_bytes: int) -> Decoded:
    """Parses a request strictly. Raises `Refused`, also for more than `max_bytes`."""
    _check_size(data, max_bytes)
    return _exact(data, kind)


def decode_lenient(
    data: bytes,
    kind: type[Lenient],
    max_bytes: int,
    adjustments: Adjustments,
    normalize: Normalize | None = None,
) -> Lenient:
    """Parses a request, and adds what was adjusted to `adjustments`, if they are allowed.

    `normalize` makes the keys of `kind` from those that the programs of a dialect send. Raises
    `Refused`, also for more than `max_bytes`.
    """
    _check_size(data, max_bytes)
    found = None if normalize is None else _object(data)
    try:
        if normalize is None or found is None:
            return _exact(data, kind)
        found = normalize(found)
        return _converted(found, kind)
    except Refused:
        if not adjustments.are_allowed:
            raise
        found = _object(data) if found is None else found
        if found is None:  # Nothing in it can be adjusted, so the error above says it best.
            raise
    return _converted(tidied(_with_integers(found), kind, adjustments), kind)


def _check_size(data: bytes, max_bytes: int) -> None:
    if len(data) > max_bytes:
        raise Refused(f"the request has {len(data)} bytes, allowed: {max_bytes}")


def _exact(data: bytes, kind: type[Decoded]) -> Decoded:
    try:
        try:
            return msgspec.json.decode(data, type=kind)
        except msgspec.ValidationError:
            return _converted(msgspec.json.decode(data), kind)
    except MALFORMED_JSON as error:
        raise Refused(f"not JSON: {malformed_text(error, data)}") from None


def _converted(value: Any, kind: type[Decoded]) -> Decoded:
    try:
        return msgspec.convert(value, type=kind)
    except msgspec.ValidationError:
        whole = _with_integers(value)  # JavaScript callers write 502.0 for 502.
    try:
        return msgspec.convert(whole, type=kind)
    except msgspec.ValidationError as error:
        raise Refused(_wrong_word(whole, kind) or str(error)) from None


def _object(data: bytes) -> dict[str, Any] | None:
    """Returns a JSON object; `None` for everything else."""
    try:
        found = msgspec.json.decode(data)
    except MALFORMED_JSON:
        return None
    return found if type(found) is dict else None


def _with_integers(value: Any, depth: int = 0) -> Any:
    """Converts whole floats to integers. JavaScript callers do not distinguish them."""
    if depth > MAX_DEPTH:
        return value
    if type(value) is dict:
        return {key: _with_integers(item, depth + 1) for key, item in value.items()}
    if type(value) is list:
        return [_with_integers(item, depth + 1) for item in value]
    if type(value) is float and value.is_integer() and abs(value) < MAX_EXACT_FLOAT:
        return int(value)
    return value


def _wrong_word(value: Any, kind: type[Request], where: str = "$") -> str | None:
    """The error of a request with a word that its key does not accept, with the accepted ones."""
    if type(value) is not dict:
        return None
    for each in msgspec.structs.fields(kind):
        key = each.encode_name
        word, words = value.get(key), CHOICES.get(key, ())
        if words and type(word) is str and word not in words:
            allowed = ", ".join(words) if key != "tagIds" else 'a list of tag ids, "all"'
            return f"Invalid enum value {quote(word)} - at `{where}.{key}`, allowed: {allowed}"
        if key == "tags" and type(word) is list:
            found = (
                _wrong_word(tag, TagRequest, f"{where}.tags[{at}]") for at, tag in enumerate(word)
            )
            if (wrong := next(filter(None, found), None)) is not None:
                return wrong
    return None

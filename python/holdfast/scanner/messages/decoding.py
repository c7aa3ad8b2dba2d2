"""Parses the requests of callers. Does no I/O.

`decode` checks requests strictly: an unknown key, a wrong type or a value out of range refuses the
whole request. `null` for an optional value is the same as omitting it. `decode_lenient` adjusts a
request where its meaning is certain, as `leniency` says.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar, get_args

import msgspec

from holdfast.config.scanning import Publish
from holdfast.scanner.errors import Refused
from holdfast.scanner.messages.leniency import Lenient, tidied
from holdfast.scanner.messages.types import FunctionCode, Request
from holdfast.types import TRANSPORTS

if TYPE_CHECKING:
    from holdfast.scanner.messages.dialect import Normalize
    from holdfast.scanner.messages.leniency import Adjustments

Decoded = TypeVar("Decoded", bound=Request)

MAX_EXACT_FLOAT = 2.0**53
"""Floats below this represent every integer exactly."""

CHOICES = {
    "functionCode": get_args(FunctionCode),
    "transport": TRANSPORTS,
    "publish": get_args(Publish),
    "tagIds": ("a list of tag ids", '"all"'),
}

_MALFORMED = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)


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
        return msgspec.json.decode(data, type=kind)
    except msgspec.ValidationError as error:
        if "got `float`" in str(error):  # JavaScript callers write 502.0 for 502.
            return _converted(msgspec.json.decode(data), kind)
        raise Refused(_with_choices(str(error))) from None
    except _MALFORMED as error:
        raise Refused(f"not JSON: {error}") from None


def _converted(value: Any, kind: type[Decoded]) -> Decoded:
    try:
        try:
            return msgspec.convert(value, type=kind)
        except msgspec.ValidationError as error:
            if "got `float`" not in str(error):
                raise
            return msgspec.convert(_with_integers(value), type=kind)
    except msgspec.ValidationError as error:
        raise Refused(_with_choices(str(error))) from None


def _object(data: bytes) -> dict[str, Any] | None:
    """Returns a JSON object; `None` for everything else."""
    try:
        found = msgspec.json.decode(data)
    except _MALFORMED:
        return None
    return found if type(found) is dict else None


def _with_integers(value: Any) -> Any:
    """Converts whole floats to integers. JavaScript callers do not distinguish them."""
    if type(value) is dict:
        return {key: _with_integers(item) for key, item in value.items()}
    if type(value) is list:
        return [_with_integers(item) for item in value]
    if type(value) is float and value.is_integer() and abs(value) < MAX_EXACT_FLOAT:
        return int(value)
    return value


def _with_choices(text: str) -> str:
    """Returns an error message of msgspec; for an enumeration, with the allowed words."""
    if "enum" in text:
        for key, words in CHOICES.items():
            if f".{key}`" in text:
                return f"{text}, allowed: {', '.join(words)}"
    return text

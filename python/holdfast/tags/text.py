"""Values of tags as text and for JSON, and text as values to write.

What `text_of` returns, `value_from` accepts, except for infinity, and scaled 64-bit integers with
more digits than a float has.
"""

from __future__ import annotations

import base64
import math
import re
from fractions import Fraction
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from holdfast.runtime.text import either, quote
from holdfast.tags.scale import RegisterScale, linear_of
from holdfast.tags.strict_text import BOOLEANS, decimal_from, from_text
from holdfast.values import DoesNotFit
from holdfast.values.digits import shortest

if TYPE_CHECKING:
    from collections.abc import Collection

    from holdfast.tags.tag import Tag

SWITCHED = {"on": True, "off": False}
MAX_PLACES = 6
"""The most decimal places of scaled integers; with more, only those that are needed."""

_INTEGER = re.compile(r"[+-]?[0-9]{1,40}")
_HEX = re.compile(r"0[xX][0-9a-fA-F]{1,16}")
_DECIMAL = re.compile(r"[+-]?([0-9]{1,40}\.?[0-9]{0,40}|\.[0-9]{1,40})([eE][+-]?[0-9]{1,3})?")
_THOUSANDS = r"[+-]?[1-9][0-9]{0,2},[0-9]{3}"
_COMMA = re.compile(rf"(?!{_THOUSANDS}$)[+-]?[0-9]{{0,40}},[0-9]{{1,40}}([eE][+-]?[0-9]{{1,3}})?")


def plain(tag: Tag, value: Any) -> Any:
    """A value for JSON.

    Floats have the digits of their type, bytes are base64; `None` for NaN, infinity and no value.
    """
    if isinstance(value, list | tuple):
        return [plain(tag, item) for item in value]
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    if isinstance(value, float):
        return _trimmed(tag, value) if math.isfinite(value) else None
    return value


def text_of(tag: Tag, value: Any, *, states: bool = True) -> str:
    """A value as text, without its unit; empty for no value.

    Values that have a name are that name, unless `states` is false. Scaled integers have the
    decimal places of their scale. Bytes are base64, arrays are JSON.
    """
    if value is None or value != value:
        return ""
    if isinstance(value, list | tuple):
        import msgspec

        return msgspec.json.encode(plain(tag, value)).decode()
    name = tag.state(value) if states else None
    if name is not None:
        return name
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    if isinstance(value, float) and math.isfinite(value):
        places = None if tag.is_float else _places(tag.scale, tag.offset)
        return shortest(_trimmed(tag, value), "") if places is None else f"{value:.{places}f}"
    return str(value)


def value_from(tag: Tag, text: str, *, states: bool = True, is_measurement: bool = False) -> Any:
    """Parses a value of a tag, or with `states` the name of one; `Tag.raw` then checks if it fits.

    A text that is a name is that name, also if it looks like a number. A measurement may become 0
    if it is too small.

    Raises `ValueError`.
    """
    word = text.strip()
    names = tag.states.values() if states else ()
    if word in names:
        return word
    if tag.of_type.count is not None or not tag.is_number:
        if tag.of_type.count is None and tag.of_type.base in ("bool", "bit"):
            return _switched(word, names)
        return from_text(text, tag.of_type, tag.type, is_measurement=is_measurement)
    if _INTEGER.fullmatch(word):
        # An integer has no sign of zero.
        is_minus_zero = tag.is_float and word[0] == "-" and int(word) == 0
        return -0.0 if is_minus_zero else int(word)
    if _HEX.fullmatch(word) and not tag.is_float and (tag.scale, tag.offset) == (1, 0):
        return int(word, 16)
    if _DECIMAL.fullmatch(word):
        return decimal_from(word, tag.of_type, is_measurement)
    if flaw := decimal_comma(word):
        raise DoesNotFit(f"{text!r} {flaw}")
    if names:
        return word
    raise DoesNotFit(f"{quote(text)} is not a number")


def decimal_comma(word: str) -> str | None:
    """What to say of a number with a decimal comma; `None` for other words, and for 1,000."""
    if _COMMA.fullmatch(word) is None:
        return None
    return f"has a decimal comma, allowed: a decimal point, as in {word.replace(',', '.')}"


def _switched(word: str, names: Collection[str]) -> bool:
    lowered = [name.lower() for name in names]
    # A name in other letters: with `states: {0: on, 1: off}`, the word OFF would switch it on.
    found = None if word.lower() in lowered else (BOOLEANS | SWITCHED).get(word.lower())
    if found is None:
        allowed = either([*names, "true", "false", "on", "off", 1, 0])
        raise DoesNotFit(f"{quote(word)} is not {allowed}")
    return found


def _trimmed(tag: Tag, value: float) -> float:
    """A finite value, as if its registers held the shortest decimal that they stand for."""
    base = tag.of_type.base
    if base != "float32":
        return value
    if tag.scale == 1 and tag.offset == 0:
        return float(shortest(value, base))
    if isinstance(tag.scale, RegisterScale):
        return value  # `Tag.scaled` has calculated it from these decimals.
    linear = linear_of(tag.scale, tag.offset)
    try:
        number = float(linear.number(value))
    except OverflowError:
        return value
    return linear.value(Fraction(shortest(number, base)))


@lru_cache(1024)
def _places(scale: float | RegisterScale, offset: float) -> int | None:
    """The decimal places of all scaled integers; `None` for too many, and if they may change."""
    if isinstance(scale, RegisterScale):
        return None
    texts = [repr(float(number)).removesuffix(".0") for number in (scale, offset)]
    if any("e" in text for text in texts):
        return None
    found = max(len(text.partition(".")[2]) for text in texts)
    return found if found <= MAX_PLACES else None

"""How plausible registers are as a text of a fixed length, in bits (`plausibility`).

A text is described by its characters, each after the one before it: case and digits seldom change
within a word. Its field has a usual length and is padded, mostly with NUL. So text that goes on
without padding may be one field or several: a change of its nature at a usual length tells where
the next one begins, and if none does, the lengths share the probability.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

MIN_TEXT_BYTES = 3
MAX_TEXT_BYTES = 64
"""The least and the most bytes of text."""

# Bits are costs, minus log2 of a probability: more is rarer.

LENGTH_BITS = {4: 4.5, 6: 4.5, 8: 2.7, 10: 4.0, 12: 3.7, 14: 5.0, 16: 2.7, 18: 5.0, 20: 3.3,
               24: 4.0, 32: 2.3, 40: 4.5, 48: 5.5, 64: 4.5}  # fmt: skip
OTHER_LENGTH_BITS = 6.0
"""The bits of a field's length in bytes."""

FULL_FIELD_BITS = 2.0
"""A text that fills its field, without padding."""

USUAL_TEXT_BYTES = 12
BITS_PER_EXTRA_BYTE = 0.3
"""The bytes of usual texts, and the bits for each byte more."""

SPACE_PADDING_BITS = 3.0
"""A field that is padded with spaces."""

OPEN_END_BITS = 3.0
"""A field that goes on behind what was read, if text ends nowhere."""

STARTS = {"U": 0.8, "L": 2.5, "D": 2.0, "P": 5.0, "S": 5.0}
FOLLOWS = {
    "UU": 0.7, "UL": 2.0, "UD": 2.5, "UP": 3.0, "US": 3.0,
    "LU": 5.5, "LL": 0.4, "LD": 4.0, "LP": 4.0, "LS": 2.5,
    "DU": 5.0, "DL": 4.5, "DD": 0.5, "DP": 2.5, "DS": 3.5,
    "PU": 1.5, "PL": 2.5, "PD": 1.0, "PP": 5.0, "PS": 4.0,
    "SU": 1.2, "SL": 2.5, "SD": 1.5, "SP": 3.0, "SS": 6.0,
}  # fmt: skip
"""Bits for the class of a character, of the first and after another: upper and lower case, digit,
punctuation, space.
"""

WITHIN = {"U": 4.3, "L": 4.1, "D": 3.3, "S": 0.0}
CODE_BITS = 3.0
CODE_LETTER_BITS = 5.2
"""Bits of a code, such as a serial number or a MAC address: of its kind, and of each of the 36
capital letters and digits in any order.
"""

USUAL_MARKS = b"-._/:"
USUAL_MARK_BITS = 2.5
MARK_BITS = 5.5
"""Bits for a character of its class."""


@dataclass(frozen=True)
class Field:
    """A possible field of text."""

    length: int
    """Its bytes."""
    bits: float
    goes_on: bool = False
    """Whether this is only the beginning of a longer field."""


def fields(contents: Sequence[bytes], *, is_open: bool) -> Iterator[Field]:
    """The possible fields that begin with the first byte; `contents` has the bytes of each read.

    `is_open` means that registers behind these bytes exist, which were not read.
    """
    data = contents[0]
    printable = _printable_length(data)
    if printable < MIN_TEXT_BYTES:  # Most registers are no text: this must be quick.
        return
    if any(_printable_length(each) < MIN_TEXT_BYTES for each in contents):
        return
    whole = min(_padded(each) for each in contents)
    if any(not each[:MIN_TEXT_BYTES].strip() for each in contents):
        return
    text = data[:printable]
    costs = _costs(text)
    lengths = {*LENGTH_BITS, printable + printable % 2, whole - whole % 2}
    for length in sorted(lengths):
        if MIN_TEXT_BYTES <= length <= whole:
            yield Field(length, _bits(costs, text[:length], length))
    if is_open and all(map(_is_text, contents)) and len(data) < MAX_TEXT_BYTES:
        yield Field(printable, costs[printable] + OPEN_END_BITS, goes_on=True)


def _bits(costs: Sequence[float], text: bytes, length: int) -> float:
    """The bits of a text in a field of some length."""
    used = len(text.rstrip(b" "))
    bits = costs[used] + LENGTH_BITS.get(length, OTHER_LENGTH_BITS)
    bits += BITS_PER_EXTRA_BYTE * max(0, used - USUAL_TEXT_BYTES)
    if used == length:
        return bits + FULL_FIELD_BITS
    return bits + (SPACE_PADDING_BITS if used < len(text) else 0.0) + math.log2(length)


def _printable_length(data: bytes) -> int:
    """The printable bytes at the beginning."""
    return next((at for at, byte in enumerate(data) if not 0x20 <= byte < 0x7F), len(data))


def _is_text(data: bytes) -> bool:
    return _printable_length(data) == len(data)


def _padded(data: bytes) -> int:
    """The printable bytes at the beginning, with the NULs behind them."""
    at = _printable_length(data)
    return at + next((n for n, byte in enumerate(data[at:]) if byte), len(data) - at)


def _costs(text: bytes) -> list[float]:
    """The bits of the first n characters, for each n: as words, or as a code."""
    costs = [0.0]
    words = 0.0
    code = CODE_BITS
    before = ""
    for byte in text:
        own = _class(byte)
        mark = USUAL_MARK_BITS if byte in USUAL_MARKS else MARK_BITS
        words += (FOLLOWS[before + own] if before else STARTS[own]) + WITHIN.get(own, mark)
        code += CODE_LETTER_BITS if own in "UD" else math.inf
        costs.append(min(words, code))
        before = own
    return costs


def _class(byte: int) -> str:
    letter = chr(byte)
    if letter.isdigit():
        return "D"
    if letter.isalpha():
        return "U" if letter.isupper() else "L"
    return "S" if letter == " " else "P"

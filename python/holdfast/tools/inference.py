"""Guesses the type and byte order of registers from their values in several reads.

Every type in every order gets a score in bits: how common it is, how much shorter its values can be
written than the bits they take (small numbers, few digits, plausible magnitudes, text), and how
little they change between reads, relative to their size. A wrong order gives numbers of unusual
magnitudes with many digits that jump. A known value takes precedence over all of these.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from holdfast import values
from holdfast.values import ConversionError
from holdfast.values.digits import shortest

if TYPE_CHECKING:
    from collections.abc import Callable

MANTISSAS = {"float16": 10, "float32": 23, "float64": 52}

BITS_A_DIGIT = math.log2(10)

ORDERS = {"ABCD": 0.0, "CDAB": -1.0, "DCBA": -3.0, "BADC": -4.0}
"""How common an order is, for two or more registers."""

SWAPPED = {"string": -3.0}
RARELY_SWAPPED = -7.0
"""How common swapped bytes are in text, and in other single registers."""

USUAL = {
    "uint16": 6.0,
    "int16": 6.0,
    "float32": 6.0,
    "uint32": 4.0,
    "int32": 4.0,
    "float64": 5.0,
    "uint64": -6.0,
    "int64": -6.0,
    "bcd16": 0.0,
    "bcd32": 3.0,
    "float16": -7.0,
    "string": -6.0,
}
"""How common a type is."""

SIGNED = {"uint16": "int16", "uint32": "int32", "uint64": "int64"}

ODD = {"uint16": 1, "int16": 1, "uint32": 3, "int32": 3, "uint64": 8, "int64": 8}
"""The penalty for large numbers, in bits; they are unusual in large types."""

SCALES = {1.0: 0.0, 0.1: 1.0, 0.01: 1.5, 0.001: 3.0, 10.0: 3.0}
"""Scales of integers to try for a known value, and how unusual each is."""

MAX_SAVED = {16: 16.0, 32: 16.0, 64: 6.0}
"""The maximum bonus for small numbers by size: leading zeros may belong to another value."""

USUAL_MAGNITUDE = 6
"""Powers of ten, up and down, of usual floats."""

PLAUSIBLE = 12.0
"""The maximum weight of all other criteria with a known value."""

MIN_TEXT = 3
SMOOTHEST = 9.0
WORST = -4.0
CLOSEST = 1e-6
UNLIKE = 0.1


@dataclass(frozen=True)
class Guess:
    """A possible type of registers."""

    type: str
    order: str
    offset: int
    """Registers before the value."""
    values: tuple[Any, ...]
    """The decoded value of each read."""
    score: float
    """0 to 1; only meaningful for ranking."""
    reasons: tuple[str, ...]
    """Reasons for and against the guess."""
    also: str | None = None
    """Another type that decodes to the same values in all reads."""
    scale: float = 1.0
    """The factor that scales the value to the known value."""


def guess(
    reads: Sequence[Sequence[int]], *, like: float | None = None, anywhere: bool = False
) -> list[Guess]:
    """Guesses the type of registers from several reads. Returns the best guess first.

    Values start at the first register, or with `anywhere` at any register. `like` is the known
    value of one of the reads: guesses are then ranked by their distance to it, and distant guesses
    are omitted.
    """
    if not reads or not reads[0] or any(len(read) != len(reads[0]) for read in reads):
        raise ValueError("all reads require the same number of registers, at least one")
    guesses: list[Guess] = []
    for offset in range(len(reads[0]) if anywhere else 1):
        rest = [read[offset:] for read in reads]
        for kind, order in _candidates(rest):
            guesses += _weighed(rest, kind, order, offset, like)
    return sorted(guesses, key=lambda each: -each.score)


def _candidates(reads: Sequence[Sequence[int]]) -> Iterator[tuple[str, str]]:
    """The types that fit, each in its distinct orders."""
    size = len(reads[0])
    for kind in USUAL:
        if kind == "string":
            for order in ("ABCD", "BADC"):
                length = _text_length(reads, order)
                if length:
                    yield f"string:{length}", order
            continue
        registers = values.register_count(kind)
        if registers <= size:
            for order in ORDERS if registers > 1 else ("ABCD", "BADC"):
                yield kind, order


def _weighed(
    reads: Sequence[Sequence[int]], kind: str, order: str, offset: int, like: float | None
) -> Iterator[Guess]:
    """The guesses of a candidate; none if its values are invalid or equal to another type's."""
    registers = values.register_count(kind)
    try:
        found = tuple(values.decode(read[:registers], kind, order) for read in reads)
    except ConversionError:
        return
    if any(isinstance(value, float) and not math.isfinite(value) for value in found):
        return
    if kind.startswith("int") and min(found) >= 0:
        return
    also = SIGNED.get(kind)
    if also is not None and max(found) >= 1 << (16 * registers - 1):
        also = None
    base = kind.partition(":")[0]
    reasons: list[str] = []
    bits = USUAL[base] + (ORDERS[order] if registers > 1 and base != "string" else 0)
    if order == "BADC" and (registers == 1 or base == "string"):
        bits += SWAPPED.get(base, RARELY_SWAPPED)
    bits += min(_saved(value, kind, 16 * registers, reasons) for value in found)
    bits += _smoothness(found, reasons)
    if like is None:
        yield Guess(kind, order, offset, found, _score(bits), tuple(reasons), also)
        return
    if isinstance(found[0], str):
        return
    for scale, unusual in SCALES.items():
        if scale != 1 and isinstance(found[0], float):
            continue
        off = min(_distance(value * scale, like) for value in found)
        if off <= UNLIKE:
            close = -math.log2(max(off, CLOSEST)) - unusual
            near = "equal" if off < CLOSEST else f"{100 * off:.2g} % off"
            score = _score(5 * close + max(-PLAUSIBLE, min(PLAUSIBLE, bits)) - 40)
            yield Guess(kind, order, offset, found, score, (near, *reasons), also, scale)


def _score(bits: float) -> float:
    return 1 / (1 + 2 ** (-bits / 5))


def _saved(value: Any, kind: str, bits: int, reasons: list[str]) -> float:
    """How many bits shorter a value can be written than stored; negative if it is unusual."""
    if isinstance(value, str):
        cost = sum(_letter_cost(letter) for letter in value)
        _note(reasons, "printable text")
        return 8 * len(value) - cost + (bits - 8 * len(value)) / 2
    if value == 0:
        return 0.0
    if isinstance(value, float):
        return bits - _float_cost(value, kind, reasons)
    if kind.startswith("bcd"):
        _note(reasons, "decimal digits only")
        return bits - BITS_A_DIGIT * len(str(value)) - 2
    cost = 3 + 1.5 * math.log2(abs(value) + 1)
    if cost > bits + ODD[kind]:
        if bits > 16:
            _note(reasons, "large")
        return -ODD[kind]
    if bits > 16:
        _note(reasons, "small for its size")
    return min(MAX_SAVED[bits], bits - cost)


def _float_cost(value: float, kind: str, reasons: list[str]) -> float:
    """The bits to write a float: its magnitude and significant digits."""
    magnitude = abs(math.log10(abs(value)))
    text = shortest(value, kind)
    digits = len(text.partition("e")[0].replace(".", "").strip("-0"))
    if magnitude > USUAL_MAGNITUDE + 2:
        _note(reasons, "odd magnitude")
    elif digits <= 4:
        _note(reasons, "few digits")
    else:
        _note(reasons, "plausible magnitude")
    odd = 4 * max(0.0, magnitude - USUAL_MAGNITUDE)
    return 3 + 1.2 * magnitude + odd + min(MANTISSAS[kind], 2 + BITS_A_DIGIT * digits)


def _smoothness(found: Sequence[Any], reasons: list[str]) -> float:
    """How little the values change, relative to their size, in bits; 0 without changes."""
    changes = [pair for pair in itertools.pairwise(found) if pair[0] != pair[1]]
    if not changes:
        return 0.0
    if isinstance(found[0], str):
        _note(reasons, "changes")
        return WORST
    each = [
        min(SMOOTHEST, max(WORST, -math.log2(abs(b - a) / max(abs(a), abs(b))))) for a, b in changes
    ]
    mean = sum(each) / len(each)
    _note(reasons, "changes smoothly" if mean > 3 else "jumps")
    return mean


def _distance(value: float, like: float) -> float:
    """The distance of a value to a known value, relative to the known value."""
    return abs(value - like) / (abs(like) or 1.0)


def _letter_cost(letter: str) -> float:
    return 5 if letter.isalpha() or letter == " " else 6 if letter.isdigit() else 7.5


def _text_length(reads: Sequence[Sequence[int]], order: str) -> int:
    """The bytes of text, with padding, at the start of all reads; 0 without text."""
    lengths = []
    for read in reads:
        data = bytes(values.decode(read, f"bytes:{2 * len(read)}", order))
        letters = _prefix(data, lambda byte: 0x20 <= byte < 0x7F)
        if letters < MIN_TEXT or not data[:letters].strip():
            return 0
        padding = _prefix(data[letters:], lambda byte: byte == 0)
        end = letters + padding
        lengths.append(end - end % 2)
    return min(lengths) if min(lengths) >= MIN_TEXT else 0


def _prefix(data: bytes, belongs: Callable[[int], bool]) -> int:
    return next((at for at, byte in enumerate(data) if not belongs(byte)), len(data))


def _note(reasons: list[str], text: str) -> None:
    if text not in reasons:
        reasons.append(text)

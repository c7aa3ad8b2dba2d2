"""Judges what Holdfast claims about the blocks of a corpus, and counts how often it is right.

A claim is true if its type and order are those of the truth, or if it covers the same registers and
decodes to the same values in every read. These are true too:

* the other sign, for registers whose bits are independent (`Truth.is_bits`), and each of several
  such registers for itself
* an unsigned integer for as many bytes of `bytes:N`
* a text of another length, if it is the whole text and swallows nothing but empty registers

A plain 16-bit integer over a register without a value is not judged: `None`. Registers behind the
end of a text that contain NUL only are such registers.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

from calibration.cases import EMPTY, NOW, Case, Truth
from holdfast.discovery.address_search import Survey
from holdfast.discovery.description import Description, conclude
from holdfast.discovery.type_guess import guess
from holdfast.values import ConversionError, decode
from holdfast.values.types import parsed

SURE = 0.9
"""A claim of at least this confidence may be wrong once in ten times, at most."""

EDGES = (0.0, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 0.99)
"""The lower edges of the buckets of confidence."""

WINDOW = 4
"""So many registers are given to `guess`: those of the largest number."""

PLAIN = ("uint16", "int16")
UNSIGNED = {1: "uint16", 2: "uint32", 4: "uint64"}
NATURAL = "ABCD"

Face: TypeAlias = Literal["guess", "describe"]
"""Which function made a claim."""

Held: TypeAlias = tuple[str, int, Face]
"""A claim, comparable between versions: case, offset and face."""


@dataclass(frozen=True, slots=True)
class Claim:
    """What was claimed about registers, and whether it is true."""

    case: Case
    face: Face
    offset: int
    type: str
    order: str
    confidence: float
    truth: Truth
    """The truth to which the first register belongs."""
    is_true: bool | None
    """`None` if it is not judged."""

    @property
    def key(self) -> Held:
        """What identifies it in another version of the rules."""
        return self.case.name, self.offset, self.face

    def __str__(self) -> str:
        extent = range(self.offset, self.offset + parsed(self.type).registers)
        words = " ".join(f"{self.case.reads[0][at]:04x}" for at in extent)
        return (
            f"{self.case.name} {self.offset}, {self.face}: {self.type} {self.order} with "
            f"{self.confidence:.3f}, but {self.truth.what} is {self.truth.type} {self.truth.order} "
            f"at {self.truth.offset}: {words}"
        )


@dataclass(frozen=True, slots=True)
class Row:
    """The claims of one line of a table."""

    name: str
    count: int
    true: int

    @property
    def wrong(self) -> int:
        """How many are not true."""
        return self.count - self.true

    @property
    def share(self) -> float:
        """The share of true claims; not a number if there are none."""
        return self.true / self.count if self.count else math.nan


def judged(cases: Iterable[Case], now: float = NOW) -> list[Claim]:
    """The claims of both faces about all cases, also those that are not judged."""
    claims: list[Claim] = []
    for case in cases:
        claims += of_guess(case, now)
        claims += of_describe(case, now)
    return claims


def of_guess(case: Case, now: float = NOW) -> Iterator[Claim]:
    """The first guess at each value.

    Registers without a value are left out: there, true claims would not be judged, but wrong ones.
    """
    for truth in case.values:
        if truth.type == EMPTY:
            continue
        window = [read[truth.offset : truth.offset + WINDOW] for read in case.reads]
        guesses = guess(window, now=now)
        if guesses:
            first = guesses[0]
            end = truth.offset + len(window[0])
            yield _claim(
                case, "guess", truth.offset + first.offset, end, first.order, first.score,
                [first.type, *([first.also] if first.also else [])],
            )  # fmt: skip


def of_describe(case: Case, now: float = NOW) -> Iterator[Claim]:
    """What the description of a device with this block alone concludes."""
    size = len(case.reads[0])
    survey = Survey(["holding_registers"])
    survey.areas[0].ranges.append(range(size))
    found = Description(1, survey)
    found.reads["holding_registers", range(size)] = [list(read) for read in case.reads]
    conclude(found, now)
    for each in found.tags:
        tag = each.tag
        yield _claim(case, "describe", tag.address, size, tag.order, each.confidence, [tag.type])


def _claim(
    case: Case, face: Face, offset: int, end: int, order: str, confidence: float, types: list[str]
) -> Claim:
    verdicts = [verdict(case, offset, each, order, end) for each in types]
    is_true = True if True in verdicts else verdicts[0]
    truth = next(each for each in case.values if offset in each.extent)
    return Claim(case, face, offset, types[0], order, confidence, truth, is_true)


def verdict(case: Case, offset: int, type: str, order: str, end: int) -> bool | None:
    """Whether a claim is true, `None` if it is not judged. Nothing behind `end` was known."""
    claimed = parsed(type)
    if claimed.count is None:
        return _of_one(case, offset, type, order, end)
    size = claimed.width // 2
    starts = range(offset, offset + claimed.registers, size)
    each = [_of_one(case, start, claimed.element, order, end) for start in starts]
    seen = [answer for answer in each if answer is not None]
    return all(seen) if seen else None


def _of_one(case: Case, offset: int, type: str, order: str, end: int) -> bool | None:
    if type in PLAIN and offset in _without_value(case):
        return None
    truth = next(each for each in case.values if offset in each.extent)
    if truth.is_bits and type in PLAIN and order == NATURAL:
        return True
    if truth.offset != offset or truth.type == EMPTY:
        return False
    if type.startswith("string:") and truth.type.startswith("string:"):
        return _same_text(case, truth, type, order, end)
    registers = parsed(type).registers
    if registers != truth.registers:
        return False
    if (type, order) == (truth.type, truth.order):
        return True
    readings = _readings(case, offset, registers, type, order)
    return any(
        _same(readings, _readings(case, offset, truth.registers, other, truth.order))
        for other in (truth.type, *_of_bytes(truth))
    ) or (truth.is_bits and _same_bits(case, truth, type, order))


def _of_bytes(truth: Truth) -> list[str]:
    if not truth.type.startswith("bytes:") or truth.registers not in UNSIGNED:
        return []
    return [UNSIGNED[truth.registers]]


def _same_bits(case: Case, truth: Truth, type: str, order: str) -> bool:
    """Whether the claim is an integer that shows the bits in the right places."""
    unsigned = UNSIGNED.get(truth.registers)
    if unsigned is None or type not in (unsigned, unsigned.removeprefix("u")):
        return False
    return _same(
        _readings(case, truth.offset, truth.registers, unsigned, order),
        _readings(case, truth.offset, truth.registers, unsigned, truth.order),
    )


def _same_text(case: Case, truth: Truth, type: str, order: str, end: int) -> bool:
    claimed = range(truth.offset, truth.offset + parsed(type).registers)
    known = range(truth.offset, min(truth.extent.stop, end))
    empty = {each.offset for each in case.values if each.type == EMPTY}
    if any(at not in truth.extent and at not in empty for at in claimed):
        return False
    texts = _readings(case, truth.offset, len(claimed), type, order)
    true = _readings(case, truth.offset, len(known), f"string:{2 * len(known)}", truth.order)
    return _same([_stripped(each) for each in texts], [_stripped(each) for each in true])


def _stripped(text: Any) -> Any:
    return text.rstrip("\0 ") if isinstance(text, str) else text


def _without_value(case: Case) -> frozenset[int]:
    """The registers without a value: the empty ones, and the padding of texts."""
    found = set()
    for truth in case.values:
        if truth.type == EMPTY:
            found.add(truth.offset)
        elif truth.type.startswith("string:"):
            extent = list(truth.extent)
            while extent and all(read[extent[-1]] == 0 for read in case.reads):
                found.add(extent.pop())
    return frozenset(found)


def _readings(case: Case, offset: int, registers: int, type: str, order: str) -> list[Any]:
    """The value of each read, `None` where it can't be decoded."""
    values: list[Any] = []
    for read in case.reads:
        try:
            values.append(decode(read[offset : offset + registers], type, order))
        except ConversionError:
            values.append(None)
    return values


def _same(one: Sequence[Any], other: Sequence[Any]) -> bool:
    """Whether all values are equal and none is missing. Not-a-number is equal to itself."""
    return all(
        a is not None and b is not None and (a == b or (a != a and b != b))
        for a, b in zip(one, other, strict=True)
    )


def buckets(claims: Iterable[Claim]) -> list[Row]:
    """A row for each bucket of confidence."""
    counted: dict[float, Counter[bool | None]] = {edge: Counter() for edge in EDGES}
    for each in claims:
        edge = max(edge for edge in EDGES if edge <= each.confidence or not edge)
        counted[edge][each.is_true] += 1
    rows = []
    for edge, after in zip(EDGES, (*EDGES[1:], 1.0), strict=True):
        true, wrong = counted[edge][True], counted[edge][False]
        rows.append(Row(f"{edge:.2f} to {after:.2f}", true + wrong, true))
    return rows


def by(claims: Iterable[Claim], name: Callable[[Claim], str], at_least: float = SURE) -> list[Row]:
    """A row for each name of the sure claims, such as the kind of device."""
    counted: defaultdict[str, Counter[bool | None]] = defaultdict(Counter)
    for each in claims:
        if each.confidence >= at_least and each.is_true is not None:
            counted[name(each)][each.is_true] += 1
    return [Row(key, sum(seen.values()), seen[True]) for key, seen in sorted(counted.items())]


def wrong(claims: Iterable[Claim], at_least: float = SURE) -> list[Claim]:
    """The sure claims that are wrong, for reading."""
    return [each for each in claims if each.is_true is False and each.confidence >= at_least]


def held(claims: Iterable[Claim], at_least: float = SURE) -> set[Held]:
    """What was claimed truly with this confidence, to compare two versions of the rules."""
    return {each.key for each in claims if each.is_true and each.confidence >= at_least}

"""How the values of simulated tags change: endless series, with one value for each step.

Each has a text form, such as `sine:220:240:60`.
"""

from __future__ import annotations

import itertools
import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

from holdfast.simulation.capacity import Capacity
from holdfast.tags.text import value_from
from holdfast.values import DoesNotFit

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from random import Random

    from holdfast.tags import Tag

Series: TypeAlias = "Iterator[Any]"

FORMS = {
    "constant": "constant:VALUE",
    "ramp": "ramp:LOW:HIGH:SECONDS",
    "sine": "sine:LOW:HIGH:SECONDS",
    "walk": "walk:LOW:HIGH:STEP",
    "counter": "counter:PER_SECOND",
    "cycle": "cycle:SECONDS",
}
ALLOWED = ", ".join(FORMS.values())

_NUMBER = re.compile(r"[+-]?([0-9]{1,15}\.?[0-9]{0,15}|\.[0-9]{1,15})([eE][+-]?[0-9]{1,2})?")


@dataclass(frozen=True)
class Generator:
    """What the values of a tag do."""

    kind: str
    numbers: tuple[float, ...] = ()
    items: tuple[Any, ...] = ()
    """The value of `constant`, and the values of `cycle`; otherwise nothing."""

    def series(self, step: float, random: Random) -> Series:
        """The values at intervals of `step` seconds."""
        return _SERIES[self.kind](self, step, random)

    @property
    def ends(self) -> tuple[Any, ...]:
        """Values between which, or among which, all of the series are. A counter: see `turning`."""
        if self.items:
            return self.items
        if self.kind == "counter":
            rate, most, _ = self.numbers
            return 0, math.copysign(most, rate)
        return self.numbers[:2]

    def first_count(self, step: float, least_step: float) -> float:
        """What a counter has to be able to count to, so that it counts at all."""
        [rate] = self.numbers
        return math.copysign(max(abs(rate * step), least_step), rate) if rate else 0

    def turning(self, low: float, high: float, least_step: float) -> Generator:
        """A counter that begins again at 0 after `low` or `high`, as that of a meter does."""
        [rate] = self.numbers
        return Generator("counter", (rate, max(0, high if rate >= 0 else -low), least_step))


def constant(value: Any) -> Generator:
    """Always the same value."""
    return Generator("constant", items=(value,))


def parsed(tag: Tag, text: str) -> Generator:
    """Parses a generator for a tag. Raises `ValueError`."""
    kind, _, rest = text.partition(":")
    if kind not in FORMS:
        raise ValueError(f"{kind!r} is not a generator, allowed: {ALLOWED}")
    if kind == "constant":
        value = value_from(tag, rest)
        if tag.source is None:
            tag.raw(value)
        return constant(value)
    if kind == "cycle":
        return Generator(kind, _numbers(kind, rest), _items(tag))
    if not tag.is_number or tag.of_type.count is not None:
        raise ValueError(f"{tag.type} is not a number, allowed: constant:VALUE, cycle:SECONDS")
    return Generator(kind, _numbers(kind, rest))


def _numbers(kind: str, text: str) -> tuple[float, ...]:
    words = text.split(":")
    if len(words) != FORMS[kind].count(":") or not all(map(_NUMBER.fullmatch, words)):
        raise ValueError(f"{f'{kind}:{text}'!r} is not {FORMS[kind]}, with numbers")
    found = tuple(map(float, words))
    if kind in ("ramp", "sine", "walk") and found[0] >= found[1]:
        raise ValueError(f"{kind}: {words[0]} is not less than {words[1]}")
    if kind != "counter" and found[-1] <= 0:
        raise ValueError(f"{kind}: {words[-1]} is not more than 0")
    return found


def _items(tag: Tag) -> tuple[Any, ...]:
    if tag.of_type.count is None and tag.of_type.base in ("bool", "bit"):
        return False, True
    if tag.of_type.count is None and (found := states(tag)):
        return found
    raise ValueError("cycle requires states, or a tag with one bit")


def states(tag: Tag) -> tuple[int, ...]:
    """The states that the registers can hold."""
    if tag.source is not None:
        return tuple(tag.states)
    capacity = Capacity(tag)
    return tuple(value for value in tag.states if _fits(capacity, value))


def _fits(capacity: Capacity, value: Any) -> bool:
    try:
        capacity.check(value)
    except DoesNotFit:
        return False
    return True


def _constant(of: Generator, _step: float, _random: Random) -> Series:
    return itertools.repeat(of.items[0])


def _ramp(of: Generator, step: float, _random: Random) -> Series:
    low, high, period = of.numbers
    return (low + (high - low) * (at * step / period % 1) for at in itertools.count())


def _sine(of: Generator, step: float, random: Random) -> Series:
    low, high, period = of.numbers
    phase = random.random()
    for at in itertools.count():
        turned = math.sin(math.tau * (at * step / period + phase))
        yield (low + high) / 2 + (high - low) / 2 * turned


def _walk(of: Generator, step: float, random: Random) -> Series:
    low, high, most = of.numbers
    most *= step
    value = (low + high) / 2
    while True:
        yield value
        value = min(high, max(low, value + random.uniform(-most, most)))


def _counter(of: Generator, step: float, _random: Random) -> Series:
    rate, *ends = of.numbers
    most, least_step = ends or (math.inf, 0)
    for at in itertools.count():
        turned = abs(at * step * rate) % (most + least_step)
        yield math.copysign(min(turned, most), rate)


def _cycle(of: Generator, step: float, random: Random) -> Series:
    [seconds] = of.numbers
    first = random.randrange(len(of.items))
    for at in itertools.count():
        yield of.items[(first + int(at * step / seconds)) % len(of.items)]


_SERIES: dict[str, Callable[[Generator, float, Random], Series]] = {
    "constant": _constant,
    "ramp": _ramp,
    "sine": _sine,
    "walk": _walk,
    "counter": _counter,
    "cycle": _cycle,
}

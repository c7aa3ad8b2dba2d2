"""How the values of simulated tags change: endless series, with one value for each step.

Each has a text form, such as `sine:220:240:60`.
"""

from __future__ import annotations

import itertools
import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

from holdfast.simulation.capacity import Capacity, extremes
from holdfast.tags.text import value_from
from holdfast.values import DoesNotFit

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from random import Random

    from holdfast.tags import Tag
    from holdfast.tags.scale import Form

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
    if tag.of_type.count is None and (states := _states(tag)):
        return states
    raise ValueError("cycle requires states, or a tag with one bit")


def _states(tag: Tag) -> tuple[int, ...]:
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


USUAL: tuple[tuple[Sequence[str], Generator], ...] = (
    (("V",), Generator("walk", (225, 235, 0.5))),
    (("kV",), Generator("walk", (9.8, 10.2, 0.02))),
    (("Hz",), Generator("walk", (49.95, 50.05, 0.005))),
    (("A",), Generator("sine", (1, 15, 120))),
    (("W", "VA", "var"), Generator("sine", (200, 3000, 120))),
    (("kW", "kVA", "kvar", "MW"), Generator("sine", (2, 30, 120))),
    (("Wh", "kWh", "MWh", "varh", "kvarh"), Generator("counter", (0.5,))),
    (("m³", "m3", "l", "h", "s", "min"), Generator("counter", (1,))),
    (("°C", "C", "degC"), Generator("sine", (18, 24, 300))),
    (("°F", "degF"), Generator("sine", (64, 75, 300))),
    (("K",), Generator("sine", (290, 300, 300))),
    (("%",), Generator("sine", (10, 90, 120))),
    (("bar",), Generator("walk", (2, 6, 0.1))),
    (("rpm", "1/min"), Generator("walk", (1400, 1500, 5))),
    (("m³/h", "m3/h", "l/min", "l/h"), Generator("sine", (0, 20, 120))),
)
"""What values with these units do."""

OTHER = Generator("sine", (0, 100, 60))
STATE_TIME_S = 10.0
"""Seconds for which a tag stays in a state."""


def usual(tag: Tag, low: float, high: float) -> Generator:
    """What the values of a tag do unless something else is chosen: numbers from `low` to `high`."""
    base = tag.of_type.base
    if base == "string":
        return _name(tag)
    if base == "bytes":
        return constant(None)
    if base in ("bool", "bit"):
        return Generator("cycle", (STATE_TIME_S,), (False, True))
    if states := _states(tag):
        return Generator("cycle", (STATE_TIME_S,), states)
    if tag.min is not None and tag.max is not None:
        least, most = max(low, tag.min), min(high, tag.max)
        if least < most:
            return Generator("walk", (least, most, (most - least) / 10))
    found = next((made for units, made in USUAL if tag.unit in units), OTHER)
    first, last = (0, 0) if found.kind == "counter" else found.numbers[:2]
    if low <= first <= last <= high:
        return found
    return Generator("sine", (low + (high - low) * 0.1, low + (high - low) * 0.9, 60))


def _name(tag: Tag) -> Generator:
    return constant(tag.name.encode("ascii", "replace").decode()[: tag.of_type.parameter])


def scale(tag: Tag, form: Form) -> Generator:
    """The value of a register that contains the scale of other tags: a tenth, if it can."""
    if form == "exponent":
        return constant(-1 if extremes(tag)[0] < 0 else 0)
    try:
        tag.raw(0.1)
    except ValueError:
        return constant(tag.value(1))
    return constant(0.1)


def still(tag: Tag) -> Generator:
    """The first value of a tag that keeps what is written to it."""
    if not tag.is_number:
        return _name(tag) if tag.of_type.base == "string" else constant(None)
    if tag.states:
        return constant(next(iter(tag.states)))
    low, high = tag.min, tag.max
    if low is not None and high is not None:
        return constant((low + high) / 2)
    return constant(low if low is not None and low > 0 else min(0, 0 if high is None else high))

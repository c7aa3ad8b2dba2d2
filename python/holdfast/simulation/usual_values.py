"""What simulated tags do unless something else is chosen: by unit, by type and by limits."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.simulation.capacity import extremes
from holdfast.simulation.generators import Generator, constant, states

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.tags import Tag
    from holdfast.tags.scale import Form

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
    if of_tag := states(tag):
        return Generator("cycle", (STATE_TIME_S,), of_tag)
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

"""Simulated devices with known values: the half of the corpus that the rules were tuned on.

`cases()` makes blocks of registers as meters, inverters, drives, controllers and their name plates
have them, read five times, with the truth about every register. The same seed makes the same
devices. Its models are what manuals of such devices list: what is measured, in which unit, how
finely, and what lies next to each other. No figure of them comes from the rules.

A device has one order, static or live values, and one of two habits with single registers: if it
swaps bytes, then in all registers or only in long values.
"""

from __future__ import annotations

import random
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from calibration.cases import BITS, EMPTY, EVERY_S, NOW, READS, Case, Truth
from calibration.sources import (
    address,
    bits,
    constant,
    counted,
    drawn,
    epoch,
    measured,
    serial,
    setpoint,
    state,
    string,
    version,
)
from calibration.tuning_plants import PLANTS
from holdfast import values

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from calibration.sources import Series, Source

ORDERS = {"ABCD": 45, "CDAB": 30, "BADC": 10, "DCBA": 15}
"""How many of a hundred devices have an order."""


# Parts of devices: what lies next to each other.


def meter_16(chance: random.Random) -> list[Source]:
    """A meter of integers with a fixed scale."""
    volts, amps = chance.choice((1, 0.1, 0.1)), chance.choice((0.1, 0.01, 0.001))
    return [
        *[measured("voltage", "uint16", 222, 242, volts)] * 3,
        *[measured("current", "uint16", 0, chance.choice((5, 32)), amps, 0.02)] * 3,
        *[measured("power", "int16", -3000, 9000, 1, 0.02)] * chance.choice((1, 3)),
        measured("power factor", "int16", -1, 1, 0.001, 0.01),
        measured("frequency", "uint16", 49.9, 50.1, chance.choice((0.01, 0.1)), 0.0004),
    ]


def meter_32(chance: random.Random) -> list[Source]:
    """A meter of long integers."""
    signed, plain = chance.choice((("int32", "int32"), ("int32", "uint32"), ("uint32", "uint32")))
    least = -8000 if signed == "int32" else 0
    return [
        *[measured("voltage", plain, 222, 242, chance.choice((0.1, 0.001)))] * 3,
        *[measured("current", plain, 0.1, 32, 0.001, 0.02)] * 3,
        *[measured("power", signed, least, 20000, chance.choice((1, 0.1)), 0.02)] * 2,
        *[counted("energy", plain, 3, 8.5)] * chance.choice((1, 2, 4)),
    ]


def meter_float(chance: random.Random) -> list[Source]:
    """A meter of floats."""
    kind = chance.choice(("float32", "float32", "float32", "float64"))
    step = chance.choice((0, 0, 0, 0.1, 0.01))
    return [
        *[measured("voltage", kind, 222, 242, step)] * 3,
        *[measured("current", kind, 0.05, 60, step, 0.02)] * chance.choice((1, 3)),
        *[measured("power", kind, -5000, 20000, step, 0.02)] * chance.choice((1, 3)),
        measured("power factor", kind, 0.5, 1, step, 0.01),
        measured("frequency", kind, 49.9, 50.1, step, 0.0004),
        *[counted("energy", kind, 1, 7, 0.3)] * chance.choice((0, 1)),
    ]


def energies(chance: random.Random) -> list[Source]:
    """Energy counters of 64 bits."""
    kind = chance.choice(("uint64", "uint64", "int64"))
    return [counted("energy", kind, 3, 12, 300)] * chance.randint(1, 5)


def inverter(chance: random.Random) -> list[Source]:
    """An inverter: a mixture of sizes."""
    return [
        state,
        bits(f"alarm {BITS}", "uint16", 16, 2),
        *[measured("dc voltage", "uint16", 200, 800, 0.1)] * 2,
        *[measured("dc current", "int16", 0, 12, 0.01, 0.02)] * 2,
        measured("power", "int32", -500, 12000, 1, 0.02),
        measured("temperature", "int16", -20, 70, 0.1),
        counted("energy", "uint32", 4, 7.5),
        counted("energy today", chance.choice(("uint16", "uint32")), 1, 4),
        bits(f"grid code {BITS}", "uint32", 32, 4),
    ]


def drive(chance: random.Random) -> list[Source]:
    """A drive: status and control words, speeds, limits."""
    return [
        bits(f"status {BITS}", "uint16", 16, 9),
        bits(f"control {BITS}", "uint16", 16, 6),
        measured("speed", "int16", -1500, 1500, 1, 0.01),
        measured("torque", "int16", -100, 100, 0.1, 0.05),
        measured("frequency", "uint16", 0, 50, chance.choice((0.1, 0.01)), 0.01),
        constant("limit", "int16", 32767, -32768, 16384, -16384, 1000, -1000),
        *[setpoint("parameter", "uint16", 0, 5000, chance.choice((1, 5, 100)))] * 4,
        counted("hours", chance.choice(("uint16", "uint32")), 2, 4.7, 0.2),
        state,
    ]


def controller(chance: random.Random) -> list[Source]:
    """A controller: temperatures, set points, times, a few floats."""
    long = chance.choice(("float32", "float32", "int32"))
    step = 0.5 if long == "float32" else 1
    return [
        *[measured("temperature", "int16", -15, 95, 0.1, 0.005)] * chance.randint(1, 5),
        *[setpoint("set point", "int16", -50, 900, chance.choice((5, 10, 50)))] * 2,
        measured("humidity", "uint16", 10, 100, chance.choice((1, 0.1)), 0.01),
        *[setpoint("set point", long, 10, 90, step)] * chance.randint(1, 3),
        measured("pressure", "uint16", 0.8, 12, chance.choice((0.01, 0.001)), 0.01),
        state,
    ]


def process(chance: random.Random) -> list[Source]:
    """A flow computer: floats of any magnitude, totals, constants of a calibration."""
    kind = chance.choice(("float32", "float32", "float64"))
    return [
        measured("flow", kind, 0, 10 ** chance.uniform(-1, 4), 0, 0.02),
        measured("temperature", kind, -30, 150, 0, 0.002),
        measured("pressure", kind, 0.9, 16, 0, 0.01),
        measured("density", kind, 600, 1100, 0, 0.0005),
        counted("total", kind, 2, 6, 0.5),
        drawn("calibration", kind, lambda c: round(c.uniform(-2, 2), c.choice((3, 4, 5, 6)))),
        constant("constant", kind, 0.1, 1.0, 100.0, 0.01, 273.15, 4.0, 20.0, 1e-3, 0.0),
        setpoint("alarm limit", kind, 0, 120, 0.5),
    ]


def identity(chance: random.Random) -> list[Source]:
    """What a device says about itself in numbers."""
    found: list[Source] = [
        drawn("serial number", "uint32", serial),
        drawn("firmware", "uint16", version),
        drawn("device code", "uint16", lambda c: c.randint(256, 0xFFFE)),
        *[drawn("ip address", "uint32", address)] * chance.choice((0, 1, 3)),
        *[drawn(f"status {BITS}", "uint32", lambda c: c.getrandbits(32) & c.getrandbits(32))]
        * chance.randint(0, 2),
        setpoint("unit id", "uint16", 1, 247, 1),
        constant("baud rate", "uint16", 9600, 19200, 38400, 4800),
        *[epoch] * chance.randint(0, 2),
    ]
    chance.shuffle(found)
    return found


def name_plate(chance: random.Random) -> list[Source]:
    """Texts next to each other."""
    return [string] * chance.randint(2, 5)


def clock(chance: random.Random) -> list[Source]:
    """Date and time in registers of their own."""
    second = chance.randrange(50)

    def seconds(_: random.Random, live: bool) -> Series:
        return "uint16", "second", [second + (live and at // 2) for at in range(READS)]

    return [
        drawn("year", "uint16", lambda c: c.randint(2015, 2027)),
        drawn("month", "uint16", lambda c: c.randint(1, 12)),
        drawn("day", "uint16", lambda c: c.randint(1, 28)),
        drawn("hour", "uint16", lambda c: c.randrange(24)),
        drawn("minute", "uint16", lambda c: c.randrange(60)),
        seconds,
    ]


FORMS = ("%y%m %d%H %M%S", "%Y %m%d %H%M", "%Y %m%d %H%M %S00", "%S%M %H%d %m%y")
"""The fields of clocks in decimal digits, as `strftime` names them; a space ends a register."""


def clock_bcd(chance: random.Random) -> list[Source]:
    """Date and time in decimal digits, two fields in a register. Most clocks are set."""
    first = NOW + chance.choice((0, 0, 0, 3600, -1.7e8, 3e7)) + chance.uniform(-40, 40)
    form = chance.choice(FORMS)

    def field(place: int) -> Source:
        def draw(_: random.Random, live: bool) -> Series:
            pace = EVERY_S if live else 0.0
            times = [datetime.fromtimestamp(first + pace * at, UTC) for at in range(READS)]
            return "bcd16", "clock", [int(time.strftime(form).split()[place]) for time in times]

        return draw

    return [field(place) for place in range(len(form.split()))]


def digits(chance: random.Random) -> list[Source]:
    """A meter with a counter in decimal digits."""
    kind, most = chance.choice((("bcd16", 4), ("bcd32", 8)))
    return [counted("reading", kind, most - 2, most - 0.05, 3)] * chance.randint(1, 3)


def settings(chance: random.Random) -> list[Source]:
    """Parameters: small numbers, thresholds, times, scale factors."""
    step = chance.choice((1, 1, 5, 10))
    return [
        *[setpoint("parameter", "uint16", 0, chance.choice((20, 300, 5000)), step)]
        * chance.randint(3, 8),
        constant("scale factor", "int16", -1, -2, -3, 0, 1),
        *[setpoint("threshold", chance.choice(("uint32", "int32")), 0, 10**5, 100)]
        * chance.choice((0, 0, 1)),
        constant("maximum", "uint16", 65000, 0x7FFF, 10000, 60000),
    ]


DEVICES = {
    "meter_16": (meter_16, 14),
    "meter_32": (meter_32, 10),
    "meter_float": (meter_float, 14),
    "energies": (energies, 6),
    "inverter": (inverter, 10),
    "drive": (drive, 9),
    "controller": (controller, 9),
    "process": (process, 8),
    "identity": (identity, 10),
    "name_plate": (name_plate, 8),
    "clock": (clock, 3),
    "clock_bcd": (clock_bcd, 2),
    "digits": (digits, 3),
    "settings": (settings, 8),
    **PLANTS,
}
"""Parts of devices, and how common each is."""


class _Block:
    """The registers of a case while they are put together."""

    def __init__(self, order: str, swapped: bool, text_order: str) -> None:
        self._orders = {True: "BADC" if swapped else "ABCD", False: order}
        self._text_order = text_order
        self.reads: list[list[int]] = [[] for _ in range(READS)]
        self.truths: list[Truth] = []

    def add(self, series: Series) -> None:
        kind, what, found = series
        order = self._orders[not kind.startswith("string") and values.register_count(kind) == 1]
        if kind.startswith("string"):
            order = self._text_order
        self.truths.append(Truth(len(self.reads[0]), kind, order, what))
        for read, value in zip(self.reads, found, strict=True):
            read += values.encode(value, kind, order)

    def fill(self, content: Sequence[int], what: str) -> None:
        self.truths += [
            Truth(len(self.reads[0]) + at, EMPTY, "ABCD", what) for at in range(len(content))
        ]
        for read in self.reads:
            read += content


def _filler(chance: random.Random) -> tuple[list[int], str]:
    """Registers that contain nothing between values."""
    return (
        ([0] * chance.choice((1, 1, 2, 3, 10)), "zeros"),
        ([0xFFFF] * chance.choice((1, 2, 4)), "all bits set"),
        ([0x8000] * chance.choice((1, 1, 2)), "marker"),
    )[chance.choices(range(3), (6, 2, 2))[0]]


def case(number: int, seed: int = 0) -> Case:
    """One simulated block."""
    chance = random.Random(f"{seed} {number}")
    order = chance.choices(list(ORDERS), list(ORDERS.values()))[0]
    live = chance.random() < 0.55
    swaps = order in ("BADC", "DCBA")
    block = _Block(
        order,
        swaps and chance.random() < 0.5,
        "BADC" if (swaps and chance.random() < 0.4) or chance.random() < 0.03 else "ABCD",
    )
    weights = [weight for _, weight in DEVICES.values()]
    parts = chance.choices(list(DEVICES), weights, k=chance.choice((1, 1, 1, 2, 3)))
    gaps = chance.choice((0, 0, 0.05, 0.15))
    for part in parts:
        sources = DEVICES[part][0](chance)
        for source in sources[: chance.choice((2, 4, 20, 20, 20))]:
            block.add(source(chance, live))
            if chance.random() < gaps:
                block.fill(*_filler(chance))
    return Case(f"{parts[0]} {number}", parts[0], live, block.reads, block.truths)


def cases(count: int = 700, seed: int = 0) -> Iterator[Case]:
    """So many blocks; 700 have about 10,000 values."""
    return (case(number, seed) for number in range(count))

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
from typing import TYPE_CHECKING, Any

from calibration.cases import BITS, EMPTY, EVERY_S, NOW, READS, Case, Truth
from holdfast import values

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    Series = tuple[str, str, list[Any]]
    Source = Callable[[random.Random, bool], Series]

ORDERS = {"ABCD": 45, "CDAB": 30, "BADC": 10, "DCBA": 15}
"""How many of a hundred devices have an order."""


# Series of five values: each source draws a value and lets it change as such values do.


def measured(
    what: str, kind: str, least: float, most: float, step: float, noise: float = 0.002
) -> Source:
    """A measurement: `step` is what it is rounded to (0: to nothing), `noise` its scatter relative
    to its size. An integer counts steps.
    """

    def draw(chance: random.Random, live: bool) -> Series:
        mean = chance.uniform(least, most)
        scatter = abs(mean) * noise * chance.choice((0.1, 0.5, 1, 1, 3)) if live else 0.0
        series = [chance.gauss(mean, scatter) for _ in range(READS)]
        if kind.startswith("float"):
            return kind, what, [round(v / step) * step if step else v for v in series]
        whole = [round(value / step) for value in series]
        return kind, what, [max(0, v) for v in whole] if kind[0] == "u" else whole

    return draw


def counted(what: str, kind: str, least: float, most: float, pace: float = 20) -> Source:
    """A counter between 10^least and 10^most. Half of those of live devices count fast."""

    def draw(chance: random.Random, live: bool) -> Series:
        value = float(int(10 ** chance.uniform(least, most)))
        rate = chance.choice((0, 0, 0.2, 1, pace)) if live else 0
        series = []
        for _ in range(READS):
            series.append(value if kind.startswith("float") else int(value))
            value += chance.uniform(0, 2 * rate)
        return kind, what, series

    return draw


def constant(what: str, kind: str, *found: Any) -> Source:
    """One of some constants."""
    return lambda chance, _: (kind, what, [chance.choice(found)] * READS)


def drawn(what: str, kind: str, draw: Callable[[random.Random], Any]) -> Source:
    """A constant that is drawn once."""
    return lambda chance, _: (kind, what, [draw(chance)] * READS)


def setpoint(what: str, kind: str, least: float, most: float, step: float) -> Source:
    """What a person sets: a multiple of a step. It seldom changes between reads."""

    def draw(chance: random.Random, live: bool) -> Series:
        first, second = (step * chance.randint(int(least / step), int(most / step)) for _ in "ab")
        if not kind.startswith("float"):
            first, second = int(first), int(second)
        if not live or chance.random() < 0.9:
            return kind, what, [first] * READS
        return kind, what, [first] * 2 + [second] * 3

    return draw


def bits(what: str, kind: str, width: int, most: int) -> Source:
    """A bit field; one bit of a live one may change."""

    def draw(chance: random.Random, live: bool) -> Series:
        word = sum(1 << bit for bit in chance.sample(range(width), chance.randint(0, most)))
        series = [word] * READS
        if live and chance.random() < 0.3:
            series = [word] * 2 + [word ^ 1 << chance.randrange(width)] * 3
        return kind, what, series

    return draw


def state(chance: random.Random, live: bool) -> Series:
    """A mode or an enumeration."""
    first, second = (chance.choice((0, 1, 1, 2, 3, 4, 5, 7, 10, 12, 100, 307)) for _ in "ab")
    changed = live and chance.random() < 0.15
    return "uint16", "state", [first] * 3 + [second if changed else first] * 2


def epoch(chance: random.Random, live: bool) -> Series:
    """The clock of a device, which may be wrong by hours or never set, or the time of an event."""
    if not live or chance.random() < 0.4:
        return "uint32", "event", [int(NOW) - chance.randint(0, 3 * 365 * 86400)] * READS
    first = NOW + chance.choice((0, 0, 3600, -7200, -1.2e8)) + chance.uniform(-60, 60)
    return "uint32", "clock", [int(first + EVERY_S * at) for at in range(READS)]


def address(chance: random.Random) -> int:
    """An IPv4 address, netmask or gateway of a plant."""
    first, second = chance.choice(((192, 168), (192, 168), (10, None), (172, 16), (169, 254)))
    parts = (
        first,
        chance.choice((0, 0, 1, 10, 20)) if second is None else second,
        chance.choice((0, 1, 2, 10, 178)),
        chance.choice((1, 10, 50, 100, 254, chance.randrange(256))),
    )
    if chance.random() < 0.25:
        parts = chance.choice(((255, 255, 255, 0), (255, 255, 0, 0), (8, 8, 8, 8)))
    return int.from_bytes(bytes(parts), "big")


def serial(chance: random.Random) -> int:
    """A serial number of 32 bits: with a year in front, counted, or any bits."""
    form = chance.randrange(4)
    if form == 0:
        return chance.randint(15, 40) * 10_000_000 + chance.randrange(1_000_000)
    if form == 1:
        return int(10 ** chance.uniform(5, 9.6))
    if form == 2:
        return chance.randint(10**8, 4 * 10**9)
    return chance.getrandbits(32)


def version(chance: random.Random) -> int:
    """A firmware version: bytes, or decimal digits."""
    if chance.random() < 0.5:
        return chance.randint(1, 5) << 8 | chance.randrange(20)
    return chance.randint(100, 620)


LETTERS = "ABCDEFGHJKLMNPRSTUVWXYZ"
DIGITS = "0123456789"
MAKERS = ("ACME", "Voltwerk", "Nordic Drives", "Siegel & Co", "Delta Meter", "HYDRA", "Kern GmbH")
MODELS = ("PM{}", "iEM-{}", "SUN-{}K", "HX {}", "VFD{}A", "Boiler {}", "M{}/24", "EM{}-DIN AV5")


def text(chance: random.Random) -> tuple[str, str]:
    """A text of a name plate and what it is."""
    form = chance.randrange(7)
    number = chance.choice((10, 24, 340, 750, 3155, 5000))
    some = "".join(chance.choice(LETTERS) for _ in range(3))
    digits = "".join(chance.choice(DIGITS) for _ in range(chance.randint(4, 12)))
    return (
        (chance.choice(MAKERS), "maker"),
        (chance.choice(MODELS).format(number), "model"),
        (some[: chance.randint(0, 3)] + digits, "serial text"),
        (f"{chance.choice(('V', '', 'v', 'Rev '))}{chance.randint(0, 9)}.{digits[:2]}", "version"),
        (f"20{chance.randint(18, 26)}-0{chance.randint(1, 9)}-1{digits[0]}", "date text"),
        ("".join(chance.choice("0123456789ABCDEF") for _ in range(12)), "mac text"),
        (chance.choice(("Kessel 1", "Hall 3 East", "PUMP-01", "spare", "Line A", "L1")), "name"),
    )[form]


def string(chance: random.Random, _: bool) -> Series:
    """A text in a field that is often larger; padded with NUL, seldom with spaces."""
    found, what = text(chance)
    size = chance.choice((8, 16, 16, 20, 32, 32, len(found) + len(found) % 2))
    size = max(size, len(found) + len(found) % 2)
    if chance.random() < 0.15:
        found = found.ljust(size)
    return f"string:{size}", what, [found] * READS


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


def cases(count: int = 300, seed: int = 0) -> Iterator[Case]:
    """So many blocks; 300 have about 3,000 values."""
    return (case(number, seed) for number in range(count))

"""Values of simulated devices: sources that draw a value and let it change as such values do.

`tuning.py` and `tuning_plants.py` make their blocks of them. No figure comes from the rules.
"""

from __future__ import annotations

import random
from typing import TYPE_CHECKING, Any

from calibration.cases import EVERY_S, NOW, READS

if TYPE_CHECKING:
    from collections.abc import Callable

    Series = tuple[str, str, list[Any]]
    Source = Callable[[random.Random, bool], Series]


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

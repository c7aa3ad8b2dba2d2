"""Blocks of registers as the manuals of common plants list them, for the tuning half.

They mix what single parts of `tuning.py` do not: 16- and 32-bit integers with enumerations and
small flags between them, counters whose high word is 0, values at rest, scale registers, limits,
masks, markers for values that are not available, raw values of converters, and histograms.
"""

from __future__ import annotations

import random
from typing import TYPE_CHECKING

from calibration.cases import BITS, READS
from calibration.sources import bits as flags
from calibration.sources import (
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

if TYPE_CHECKING:
    from calibration.sources import Series, Source


def few(what: str, most: int = 9, kind: str = "uint16") -> Source:
    """A small enumeration, number or switch. It seldom changes."""

    def draw(chance: random.Random, live: bool) -> Series:
        first, second = chance.randint(0, most), chance.randint(0, most)
        changed = live and chance.random() < 0.1
        return kind, what, [first] * 2 + [second if changed else first] * 3

    return draw


def maybe(source: Source, kind: str, missing: int, share: float = 0.2) -> Source:
    """A value that is sometimes not available: then its register contains a marker."""

    def draw(chance: random.Random, live: bool) -> Series:
        found = source(chance, live)
        return (kind, found[1], [missing] * READS) if chance.random() < share else found

    return draw


def at_rest(source: Source, share: float = 0.3) -> Source:
    """A value that is 0 while the plant rests."""

    def draw(chance: random.Random, live: bool) -> Series:
        kind, what, found = source(chance, live)
        return kind, what, [type(found[0])(0)] * READS if chance.random() < share else found

    return draw


def solar(chance: random.Random) -> list[Source]:
    """An inverter: long powers and energies between words."""
    half = chance.choice(("uint32", "int32"))
    strings = chance.choice((1, 2, 2, 4))
    return [
        drawn("type code", "uint16", lambda c: c.randint(1, 9000)),
        setpoint("nominal power", "uint16", 30, 1100, 10),
        few("output type", 2),
        counted("energy today", "uint16", 0, 2.5, 0.1),
        counted("energy", "uint32", 2, 6, 0.1),
        counted("hours", "uint32", 2, 4.7, 0.1),
        measured("temperature", "int16", 5, 65, 0.1),
        *[
            measured("dc voltage", "uint16", 200, 800, 0.1),
            at_rest(measured("dc current", "uint16", 0.1, 12, 0.1, 0.02)),
        ] * strings,
        at_rest(measured("dc power", "uint32", 20, 12000, 1, 0.02)),
        *[measured("voltage", "uint16", 222, 242, 0.1)] * 3,
        *[at_rest(measured("current", "uint16", 0.1, 20, 0.1, 0.02))] * 3,
        at_rest(measured("power", half, 20, 12000, 1, 0.02)),
        at_rest(measured("reactive power", "int32", -900, 900, 1, 0.05)),
        measured("power factor", "int16", -1, 1, 0.001, 0.01),
        measured("frequency", "uint16", 49.9, 50.1, chance.choice((0.1, 0.01)), 0.0004),
        constant("state", "uint16", 0, 1, 2, 3, 0x8000, 0x1300, 0x0200, 512, 0x5500),
        few("fault", 0),
        flags(f"alarm {BITS}", "uint32", 32, 1),
    ]  # fmt: skip


def growatt(chance: random.Random) -> list[Source]:
    """An inverter whose powers are long integers in tenths beside voltages of one register."""
    string_ = [
        at_rest(measured("dc voltage", "uint16", 150, 600, 0.1)),
        at_rest(measured("dc current", "uint16", 0.1, 12, 0.1, 0.02)),
        at_rest(measured("dc power", "uint32", 10, 5000, 0.1, 0.02)),
    ]
    return [
        few("state", 3),
        at_rest(measured("dc power", "uint32", 20, 9000, 0.1, 0.02)),
        *string_ * 2,
        at_rest(measured("power", "uint32", 20, 9000, 0.1, 0.02)),
        measured("frequency", "uint16", 49.9, 50.1, 0.01, 0.0004),
        *[
            measured("voltage", "uint16", 222, 242, 0.1),
            at_rest(measured("current", "uint16", 0.1, 12, 0.1, 0.02)),
            at_rest(measured("power", "uint32", 10, 3000, 0.1, 0.02)),
        ] * chance.choice((1, 3)),
        counted("energy today", "uint32", 0, 2.5, 0.1),
        counted("energy", "uint32", 2, 5.5, 0.1),
        counted("work time", "uint32", 4, 8, 1),
        measured("temperature", "uint16", 15, 65, 0.1),
        few("fault", 0),
        measured("bus voltage", "uint16", 300, 420, 0.1),
    ]  # fmt: skip


def sunspec(chance: random.Random) -> list[Source]:
    """Values with scale registers behind them."""

    def scale(*found: int) -> Source:
        return constant("scale factor", "int16", *found)

    energy = counted("energy", "uint32", 3, 8.2, 3)
    return [
        *[at_rest(measured("current", "uint16", 0.1, 30, 0.01, 0.02))] * 4, scale(-2, -1),
        *[maybe(measured("voltage", "uint16", 222, 242, 0.1), "uint16", 0xFFFF, 0.1)] * 3,
        scale(-1, -2),
        at_rest(measured("power", "int16", -3000, 9000, 1, 0.02)), scale(0, 1, -1),
        measured("frequency", "uint16", 49.9, 50.1, 0.01, 0.0004), scale(-2, -3),
        measured("power factor", "int16", -100, 100, 0.1), scale(-1, -3),
        *[energy] * chance.choice((1, 1, 4)), scale(0, 1, 2),
        *[maybe(measured("temperature", "int16", 10, 70, 0.1), "int16", -32768)] * 3,
        scale(-1, -2),
        constant("state", "uint16", 1, 2, 4, 5, 8),
        few("vendor state", 9),
        *[flags(f"event {BITS}", "uint32", 32, 1)] * chance.choice((0, 2, 4)),
    ]  # fmt: skip


def long_only(chance: random.Random) -> list[Source]:
    """A device of long integers only, also for enumerations and markers."""
    signed, plain = "int32", "uint32"
    return [
        drawn("serial number", plain, serial),
        constant("state", plain, 35, 303, 307, 381, 455, 1392, 51, 311),
        maybe(measured("power", signed, 10, 9000, 1, 0.02), signed, -0x80000000),
        *[maybe(measured("power", signed, 10, 3000, 1, 0.02), signed, -0x80000000)] * 3,
        *[measured("voltage", plain, 222, 242, 0.01)] * 3,
        maybe(measured("frequency", plain, 49.9, 50.1, 0.01, 0.0004), plain, 0xFFFFFFFF),
        *[counted("energy", plain, 2, 7, 1)] * 2,
        maybe(measured("temperature", signed, -5, 70, 0.1), signed, -0x80000000),
        *[few("parameter", 40, plain)] * chance.choice((1, 4)),
        counted("hours", plain, 2, 8, 1),
        *[constant("state", plain, 0xFFFFFD, 0xFFFFFE, 303, 1129, 1130)] * 2,
    ]


def battery(chance: random.Random) -> list[Source]:
    """A battery: its cells, limits and protection bits."""
    cells, mean = chance.choice((4, 8, 15, 16)), chance.uniform(3.0, 3.5)
    cell = measured("cell voltage", "uint16", mean - 0.01, mean + 0.01, 0.001, 0.0003)
    return [
        measured("voltage", "uint16", 46, 56, chance.choice((0.1, 0.01))),
        at_rest(measured("current", "int16", -90, 90, chance.choice((0.1, 0.01)), 0.03)),
        setpoint("charge", "uint16", 5, 100, 1),
        setpoint("health", "uint16", 90, 100, 1),
        measured("capacity left", chance.choice(("uint16", "uint32")), 20, 280, 0.01, 0.0001),
        *[setpoint("capacity", chance.choice(("uint16", "uint32")), 5000, 28000, 1000)] * 2,
        counted("cycles", "uint16", 0, 3),
        *[cell] * cells,
        *[measured("temperature", "int16", 10, 40, chance.choice((1, 0.1)))]
        * chance.choice((2, 4)),
        *[few("cell number", cells)] * 2,
        *[flags(f"protection {BITS}", "uint16", 16, 1)] * 3,
        few("mosfet", 3),
        counted("charged", "uint32", 2, 7, 1),
        constant("chemistry", "uint16", 0, 1, 2, 3),
        setpoint("limit", "uint16", 2500, 3700, 50),
    ]


def heat_pump(chance: random.Random) -> list[Source]:
    """A heat pump: sensors that may be missing, modes, set points, counters."""
    step, missing = chance.choice((0.1, 0.1, 0.01, 1)), chance.choice((-32768, -30000, 32767))
    sensor = maybe(measured("temperature", "int16", -15, 65, step, 0.005), "int16", missing)
    hours = chance.choice(("uint16", "uint32", "int32"))
    return [
        *[sensor] * chance.randint(4, 9),
        *[few("mode", 5)] * 2,
        *[setpoint("set point", "int16", 180, 600, 5)] * chance.choice((2, 4)),
        setpoint("curve", "int16", 0, 15, 1),
        *[few("switch", 1)] * chance.choice((2, 5)),
        at_rest(measured("speed", "uint16", 20, 90, chance.choice((1, 0.1)), 0.005)),
        *[counted("hours", hours, 1, 4.5, 0.05)] * 2,
        counted("starts", hours, 1, 4, 0.05),
        at_rest(measured("power", chance.choice(("uint16", "uint32")), 300, 6000, 1, 0.02)),
        *[counted("heat", "uint32", 1, 5, 0.1)] * chance.choice((0, 2)),
        few("alarm", 0),
        constant("degree minutes", "int16", -60, -400, 0, -123, -5),
    ]


def ventilation(chance: random.Random) -> list[Source]:
    """An air handling unit: many switches, speeds, set points."""
    return [
        *[few("switch", 1)] * chance.randint(2, 8),
        few("mode", 6),
        *[setpoint("speed", "uint16", 15, 100, 5)] * 4,
        *[at_rest(measured("speed", "uint16", 700, 2900, 1, 0.005))] * 2,
        *[setpoint("flow", "uint16", 100, 900, 10)] * chance.choice((2, 6)),
        *[measured("temperature", "int16", -10, 30, 0.1, 0.004)] * 4,
        measured("carbon dioxide", "uint16", 400, 1500, 1, 0.01),
        measured("humidity", "uint16", 20, 80, chance.choice((1, 0.1))),
        counted("filter time", "uint32", 4, 7.3, 1),
        *[few("alarm", 1)] * 4,
        *[setpoint("time", "uint16", 0, 2300, 30)] * chance.choice((0, 7)),
    ]


def plc(chance: random.Random) -> list[Source]:
    """Data of a program: words, long integers and floats in any order."""
    full = chance.choice((27648, 32767, 4095, 10000, 65535))
    raw = measured("raw value", "uint16", 0, full, 1, 0.003)
    pool: list[Source] = [
        flags(f"status {BITS}", "uint16", 16, 8),
        few("step", 120), few("recipe", 20), few("switch", 1), raw, raw,
        measured("value", "int16", -2000, 5000, 1),
        setpoint("set point", "int16", -100, 1000, 10),
        measured("level", "float32", 0, 100, 0, 0.005),
        at_rest(measured("flow", "float32", 0.5, 400, 0, 0.02)),
        setpoint("set point", "float32", 0, 200, 0.5),
        counted("pieces", "uint32", 1, 6, 1),
        counted("time", "uint32", 3, 7, 500),
        measured("position", "int32", -9 * 10**5, 9 * 10**5, 1, 0.001),
        setpoint("target", "int32", -10**6, 10**6, 500),
        counted("heartbeat", "uint16", 0, 4, 1),
        few("alarm", 400),
    ]  # fmt: skip
    found = []
    for _ in range(chance.randint(5, 12)):
        found += [chance.choice(pool)] * chance.choice((1, 1, 1, 2, 4))
    return found


def in_out(chance: random.Random) -> list[Source]:
    """An I/O module: raw values, switches, counters, configuration."""
    full = chance.choice((4095, 32767, 65535, 20000, 10000))
    kind = "uint16" if full > 32767 else chance.choice(("uint16", "int16"))
    return [
        flags(f"inputs {BITS}", "uint16", 16, 8),
        flags(f"outputs {BITS}", "uint16", 16, 4),
        *[at_rest(measured("raw value", kind, 0, full, 1, 0.002), 0.2)] * chance.choice((4, 8)),
        *[counted("pulses", "uint32", 0, chance.choice((4, 6)), 5)] * chance.choice((2, 4, 8)),
        *[few("range", 16)] * chance.choice((2, 8)),
        constant("mask", "uint16", 0xFFFF, 0x00FF, 0x0F0F, 0xFF00, 0x000F),
        constant("watchdog", "uint16", 0, 100, 1000, 5000, 60),
        drawn("module code", "uint16", lambda c: c.randint(256, 0x9FFF)),
        drawn("firmware", "uint16", version),
    ]


def genset(_: random.Random) -> list[Source]:
    """A controller of an engine: words of the engine, long integers of the generator, markers."""

    def kind(source: Source, missing: int, name: str) -> Source:
        return maybe(source, name, missing)

    return [
        kind(at_rest(measured("oil pressure", "uint16", 150, 600, 1)), 0xFFFF, "uint16"),
        kind(measured("coolant", "int16", 5, 95, 1), 32767, "int16"),
        kind(measured("oil", "int16", 5, 110, 1), 32767, "int16"),
        kind(measured("fuel", "uint16", 5, 100, 1), 0xFFFF, "uint16"),
        measured("battery", "uint16", 11.5, 28.5, 0.1),
        at_rest(measured("speed", "uint16", 1480, 1520, 1)),
        at_rest(measured("frequency", "uint16", 49.5, 50.5, 0.1, 0.001)),
        *[at_rest(measured("voltage", "uint32", 225, 235, 0.1))] * 3,
        *[at_rest(measured("voltage", "uint32", 390, 410, 0.1))] * 3,
        *[at_rest(measured("current", "uint32", 5, 400, 0.1, 0.02))] * 3,
        *[kind(measured("power", "int32", -500, 90000, 1, 0.02), 0x7FFFFFFF, "int32")] * 3,
        counted("run time", "uint32", 3, 7.5, 1),
        counted("starts", "uint32", 0, 3.5, 0.01),
        counted("energy", "uint32", 2, 6, 0.1),
        epoch,
        few("mode", 5),
        flags(f"alarm {BITS}", "uint16", 16, 3),
    ]


def inverter_drive(chance: random.Random) -> list[Source]:
    """A frequency converter: words in profile form, references, parameters, fault log."""
    return [
        constant(f"control {BITS}", "uint16", 0x047F, 0x0406, 0x047E, 0x0006, 0x000F),
        constant("reference", "int16", 20000, 10000, -20000, 5000, 0, 16384),
        constant(f"status {BITS}", "uint16", 0x0637, 0x1237, 0x0231, 0x4337, 0x1627, 0x0250),
        at_rest(measured("speed", "int16", -1500, 3000, 1, 0.003)),
        at_rest(measured("current", "uint16", 0.5, 60, chance.choice((0.1, 0.01)), 0.02)),
        at_rest(measured("torque", "int16", -100, 100, 0.1, 0.05)),
        at_rest(measured("power", chance.choice(("int16", "uint16", "int32")), 0, 3000, 0.1, 0.02)),
        measured("bus voltage", "uint16", 540, 620, chance.choice((1, 0.1))),
        measured("temperature", "uint16", 25, 80, chance.choice((1, 0.1))),
        counted("energy", "uint32", 1, 6, 0.01),
        counted("hours", "uint32", 1, 5, 0.01),
        *[few("fault", 80)] * chance.choice((1, 5)),
        *[setpoint("ramp", "uint16", 10, 600, 10)] * 2,
        setpoint("least", "uint16", 0, 200, 50),
        setpoint("most", "uint16", 500, 6000, 500),
        flags(f"inputs {BITS}", "uint16", 8, 4),
    ]


def charger(chance: random.Random) -> list[Source]:
    """A charging station: long integers, or a mixture with words."""
    long = chance.choice(("uint32", "uint32", "uint16"))
    return [
        few("state", 6, long),
        few("cable", 7, long),
        few("error", 0, long),
        *[at_rest(measured("current", long, 6, 32, 0.001, 0.01))] * 3,
        at_rest(measured("power", "uint32", 1400, 22000, chance.choice((1, 0.001)), 0.01)),
        counted("energy", "uint32", 3, 8, 2),
        *[measured("voltage", long, 222, 242, 1)] * 3,
        measured("power factor", long, 0.9, 1, 0.001),
        setpoint("most", long, 6000, 32000, 1000),
        at_rest(counted("session", "uint32", 0, 4.5, 1)),
        at_rest(counted("duration", "uint32", 1, 5, 0.5)),
        drawn("serial number", "uint32", serial),
        drawn("firmware", long, version),
        few("phases", 3, long),
        setpoint("timeout", "uint16", 0, 300, 10),
        few("relay", 1),
    ]


def sensor(chance: random.Random) -> list[Source]:
    """A sensor or weather station, with its settings."""
    light = chance.choice((900, 60000))
    return [
        measured("temperature", "int16", -15, 40, chance.choice((0.1, 0.01))),
        measured("humidity", "uint16", 20, 99, chance.choice((0.1, 0.01))),
        measured("pressure", "uint16", 950, 1040, chance.choice((1, 0.1)), 0.0002),
        measured("light", chance.choice(("uint32", "uint16")), 0, light, 1, 0.02),
        at_rest(measured("wind", "uint16", 0, 15, chance.choice((0.1, 0.01)), 0.1)),
        measured("direction", "uint16", 0, 359, 1, 0.02),
        at_rest(counted("rain", "uint32", 0, 3, 0)),
        measured("radiation", "uint16", 0, 1100, 1, 0.02),
        few("offset", 0),
        constant("offset", "int16", -5, -10, 0, 0, 3),
        setpoint("unit id", "uint16", 1, 247, 1),
        constant("baud rate", "uint16", 3, 5, 96, 9600, 19200),
        few("parity", 2),
        drawn("device code", "uint16", lambda c: c.randint(256, 0xFFFE)),
    ]  # fmt: skip


def histogram(chance: random.Random) -> list[Source]:
    """Harmonics or classes of a histogram: many values that get small."""
    kind = chance.choice(("uint16", "uint16", "uint32"))
    mean = chance.uniform(1, 4)
    if chance.random() < 0.5:
        return [counted("class", kind, 0, mean, 0.2) for _ in range(chance.choice((8, 12, 24)))]
    return [
        measured("harmonic", kind, 0, 10**mean / (at + 1), 1, 0.05)
        for at in range(chance.choice((8, 15, 31)))
    ]


def limits(chance: random.Random) -> list[Source]:
    """Alarm limits with delays, and their bits."""
    kind = chance.choice(("int16", "int16", "uint16", "float32", "int32"))
    step = chance.choice((1, 5, 10))
    return [
        *[setpoint("high limit", kind, 500, 3000, step), setpoint("low limit", kind, 0, 400, step)]
        * chance.randint(1, 4),
        *[setpoint("delay", "uint16", 0, 120, 5)] * chance.choice((1, 4)),
        constant("maximum", "uint16", 0xFFFF, 0x7FFF, 65000, 9999, 30000),
        constant("maximum", "uint32", 999999, 99999999, 0x7FFFFFFF, 100000, 3600),
        few("enabled", 1),
        flags(f"alarm {BITS}", "uint16", 16, 2),
    ]


def heat_meter(chance: random.Random) -> list[Source]:
    """A heat or water meter: long counters beside words."""
    kind = chance.choice(("uint32", "uint32", "int32", "float32"))
    return [
        drawn("serial number", "uint32", serial),
        *[counted("energy", kind, 2, 7, 0.1)] * 2,
        *[counted("volume", kind, 2, 7, 0.3)] * 2,
        at_rest(measured("flow", kind, 20, 2500, 1, 0.02)),
        at_rest(measured("power", kind, 1, 90, 0.1, 0.02)),
        *[measured("temperature", chance.choice(("uint16", "int16", kind)), 20, 80, 0.1)] * 2,
        counted("hours", chance.choice(("uint16", "uint32")), 2, 4.7, 0.01),
        flags(f"error {BITS}", "uint16", 16, 1),
        epoch,
    ]


def log(chance: random.Random) -> list[Source]:
    """Entries of a log: a time, a code, a value."""
    code = few("code", 400)
    kind = chance.choice(("uint16", "uint32", "float32"))
    value = setpoint("value", kind, 0, chance.choice((300, 20000)), 1)
    return [epoch, code, value] * chance.randint(2, 6)


def three_phase(chance: random.Random) -> list[Source]:
    """A meter of long integers, small or signed, with a few words behind them."""
    kind = chance.choice(("int32", "uint32"))
    least = -4000 if kind == "int32" else 0
    return [
        *[measured("voltage", kind, 222, 242, 0.1)] * 3,
        *[at_rest(measured("current", kind, 0.1, 30, 0.001, 0.02), 0.1)] * 3,
        *[at_rest(measured("power", kind, least, 7000, 0.1, 0.02), 0.1)] * 6,
        measured("power factor", chance.choice(("int16", kind)), 0, 1, 0.001),
        few("sequence", 1) if kind == "uint32" else constant("sequence", "int16", 0, -1),
        measured("frequency", "uint16", 49.9, 50.1, 0.1, 0.0004),
        *[counted("energy", kind, 1, 6, 0.2)] * chance.choice((2, 4, 8)),
        few("tariff", 4),
        constant("ratio", "uint16", 1, 10, 20, 100, 400),
        constant("ratio", "uint32", 1, 10, 20, 100, 400),
        string,
    ]


def word_order_mix(chance: random.Random) -> list[Source]:
    """Status words and small counters of both sizes, at random."""
    pool: list[Source] = [
        state, few("switch", 1), few("number", 60), few("code", 999),
        counted("counter", "uint16", 0, 4.5, 0.5), counted("counter", "uint32", 0, 4.5, 0.5),
        counted("counter", "uint32", 2, 6, 0.5), measured("value", "uint16", 0, 5000, 1),
        measured("value", "uint32", 0, 90000, 1), measured("value", "int16", -900, 900, 1),
        measured("value", "int32", -9000, 9000, 1), flags(f"status {BITS}", "uint16", 16, 5),
        flags(f"status {BITS}", "uint32", 32, 3), constant("marker", "uint16", 0xFFFF, 0x8000),
    ]  # fmt: skip
    found = []
    for _ in range(chance.randint(4, 10)):
        found += [chance.choice(pool)] * chance.choice((1, 1, 2, 3))
    return found


PLANTS = {
    "solar": (solar, 10),
    "growatt": (growatt, 6),
    "sunspec": (sunspec, 8),
    "long_only": (long_only, 6),
    "battery": (battery, 8),
    "heat_pump": (heat_pump, 10),
    "ventilation": (ventilation, 8),
    "plc": (plc, 10),
    "in_out": (in_out, 8),
    "genset": (genset, 8),
    "inverter_drive": (inverter_drive, 8),
    "charger": (charger, 8),
    "sensor": (sensor, 7),
    "histogram": (histogram, 4),
    "limits": (limits, 7),
    "heat_meter": (heat_meter, 8),
    "log": (log, 4),
    "three_phase": (three_phase, 8),
    "word_order_mix": (word_order_mix, 8),
}
"""Parts of plants, and how common each is."""

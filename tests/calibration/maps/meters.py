"""Register maps of electricity meters, heat meters and pulse counters."""

from __future__ import annotations

from datetime import datetime

from calibration.blocks import (
    Row,
    between,
    bits,
    clock,
    constant,
    counter,
    empty,
    epoch,
    magnitude,
    near,
    octets,
    past,
    several,
    text,
)

VOLTS = near(230, 4, 0.3, idle=None)
AMPERES = near(6, 4, 0.15, idle=0, low=0)
WATTS = near(1200, 900, 25, idle=0)
FACTOR = near(0.94, 0.05, 0.004, idle=1)
HERTZ = near(50, 0.02, 0.008)
NAN = constant(float("nan"))


def sdm630() -> list[Row]:
    """Eastron SDM630, input registers from 0: float32 at every second address, with gaps."""
    gap = empty(2)
    return [
        *several(3, "voltage", "float32", VOLTS),
        *several(3, "current", "float32", AMPERES),
        *several(3, "active power", "float32", WATTS),
        *several(3, "apparent power", "float32", near(1300, 900, 25, idle=0, low=0)),
        *several(3, "reactive power", "float32", near(150, 120, 6, idle=0)),
        *several(3, "power factor", "float32", FACTOR),
        *several(3, "phase angle", "float32", near(12, 20, 1, idle=0)),
        Row("mean voltage", "float32", VOLTS), *gap,
        Row("mean current", "float32", AMPERES),
        Row("sum of currents", "float32", near(18, 9, 0.4, idle=0, low=0)), *gap,
        Row("total power", "float32", near(3600, 2500, 60, idle=0)), *gap,
        Row("total apparent power", "float32", near(3900, 2500, 60, idle=0, low=0)), *gap,
        Row("total reactive power", "float32", near(450, 300, 20, idle=0)),
        Row("total power factor", "float32", FACTOR), *gap,
        Row("total phase angle", "float32", near(12, 15, 1, idle=0)), *gap,
        Row("frequency", "float32", HERTZ),
        Row("import energy", "float32", counter(50, 60_000, 0.001)),
        Row("export energy", "float32", counter(1, 9000, 0.0005, never=0.5)),
        Row("import reactive energy", "float32", counter(5, 9000, 0.0005)),
        Row("export reactive energy", "float32", counter(1, 3000, 0.0002, never=0.3)),
        Row("apparent energy", "float32", counter(50, 60_000, 0.001)),
        Row("charge", "float32", counter(50, 300_000, 0.005)),
        Row("power demand", "float32", near(3500, 2000, 2, idle=0, low=0)),
        Row("largest power demand", "float32", magnitude(500, 20_000)),
    ]  # fmt: skip


def sdm230() -> list[Row]:
    """Eastron SDM230, input registers from 0: single phase, more gaps than values."""
    return [
        Row("voltage", "float32", VOLTS), *empty(4),
        Row("current", "float32", AMPERES), *empty(4),
        Row("active power", "float32", WATTS), *empty(4),
        Row("apparent power", "float32", near(1300, 900, 25, idle=0, low=0)), *empty(4),
        Row("reactive power", "float32", near(150, 120, 6, idle=0)), *empty(4),
        Row("power factor", "float32", FACTOR), *empty(4),
        Row("phase angle", "float32", near(12, 20, 1, idle=0)), *empty(32),
        Row("frequency", "float32", HERTZ),
        Row("import energy", "float32", counter(50, 60_000, 0.0004)),
        Row("export energy", "float32", counter(1, 9000, 0.0002, never=0.5)),
        Row("import reactive energy", "float32", counter(5, 9000, 0.0002)),
        Row("export reactive energy", "float32", counter(1, 3000, 0.0001, never=0.3)),
        *empty(4),
        Row("power demand", "float32", near(1100, 700, 1, idle=0, low=0)),
        Row("largest power demand", "float32", magnitude(500, 9000)),
    ]  # fmt: skip


def sdm_settings() -> list[Row]:
    """Eastron SDM, holding registers from 0: settings as round float32."""
    return [
        Row("demand time", "float32", constant(0.0)),
        Row("demand period", "float32", constant(60.0, 30.0, 15.0)), *empty(4),
        Row("system voltage", "float32", constant(230.0, 400.0)),
        Row("system current", "float32", constant(5.0, 100.0)),
        Row("system type", "float32", constant(3.0, 1.0)),
        Row("pulse width", "float32", constant(100.0, 60.0, 200.0)),
        Row("password lock", "float32", constant(0.0, 1.0)), *empty(2),
        Row("parity", "float32", constant(0.0, 1.0, 2.0)),
        Row("address", "float32", constant(1.0, 2.0, 17.0)),
        Row("pulse constant", "float32", constant(1000.0, 0.0)),
        Row("password", "float32", constant(1000.0, 1234.0)), *empty(2),
        Row("baud rate code", "float32", constant(2.0, 3.0, 5.0)),
    ]  # fmt: skip


def janitza() -> list[Row]:
    """Janitza UMG 96 and 604, from 19000: float32 without gaps, energy in Wh."""
    return [
        *several(3, "voltage", "float32", VOLTS),
        *several(3, "voltage between phases", "float32", near(400, 5, 0.5)),
        *several(3, "current", "float32", near(60, 40, 1.5, idle=0, low=0)),
        Row("sum of currents", "float32", near(8, 4, 0.5, idle=0, low=0)),
        *several(4, "active power", "float32", near(13_000, 9000, 300, idle=0)),
        *several(4, "apparent power", "float32", near(14_000, 9000, 300, idle=0, low=0)),
        *several(4, "reactive power", "float32", near(2500, 2000, 120, idle=0)),
        *several(3, "power factor", "float32", FACTOR),
        Row("frequency", "float32", HERTZ),
        Row("phase rotation", "float32", constant(1.0, -1.0)),
        *several(4, "energy", "float32", counter(1e4, 4e8, 4)),
        *several(4, "import energy", "float32", counter(1e4, 4e8, 4)),
        *several(4, "export energy", "float32", counter(1e2, 4e6, 1, never=0.6)),
        *several(3, "distortion of voltage", "float32", near(2.2, 0.6, 0.05, low=0)),
        *several(3, "distortion of current", "float32", near(18, 8, 0.7, idle=0, low=0)),
    ]


def pac() -> list[Row]:
    """Siemens SENTRON PAC, from 1: float32, and a status word at the end."""
    return [
        *several(3, "voltage", "float32", VOLTS),
        *several(3, "voltage between phases", "float32", near(400, 5, 0.5)),
        *several(3, "current", "float32", AMPERES),
        *several(3, "apparent power", "float32", near(1300, 900, 25, idle=0, low=0)),
        *several(3, "active power", "float32", WATTS),
        *several(3, "reactive power", "float32", near(150, 120, 6, idle=0)),
        *several(3, "power factor", "float32", FACTOR),
        *several(3, "distortion of voltage", "float32", near(2, 0.5, 0.05, low=0)),
        *several(3, "distortion of current", "float32", near(14, 8, 0.5, idle=0, low=0)),
        Row("frequency", "float32", HERTZ),
        Row("mean voltage", "float32", VOLTS),
        Row("mean current", "float32", AMPERES),
        *several(3, "total power", "float32", near(3600, 2500, 60, idle=0)),
        Row("limit bits", "uint32", bits(16, 0.05)),
        Row("diagnosis bits", "uint32", bits(32, 0.06)),
        Row("digital output bits", "uint32", bits(2, 0.4)),
        Row("operating hours", "uint32", counter(3600, 2e8, 1)),
    ]


def pac_energy() -> list[Row]:
    """Siemens SENTRON PAC, from 801: float64 counters in Wh."""
    return [
        *several(2, "import energy", "float64", counter(1e5, 3e9, 8)),
        *several(2, "export energy", "float64", counter(1e3, 3e7, 2, never=0.6)),
        *several(2, "reactive energy", "float64", counter(1e4, 3e8, 3)),
        *several(2, "reactive energy returned", "float64", counter(1e3, 3e7, 1, never=0.5)),
        *several(2, "apparent energy", "float64", counter(1e5, 3e9, 8, never=0.2)),
    ]


def pm5000_identity() -> list[Row]:
    """Schneider PM5000 and iEM3000, from 30: texts of 20 registers, then numbers."""
    return [
        Row("meter name", "string:40", text("Energy Meter", "MDB-01", "PM 5320")),
        Row("meter model", "string:40", text("PM5320", "iEM3255", "PM5560")),
        Row("manufacturer", "string:40", text("Schneider Electric")),
        Row("model code", "uint16", between(15_000, 18_000)),
        Row("serial number", "uint32", between(10**7, 4 * 10**9)),
        Row("year made", "uint16", between(2014, 2025)),
        Row("month made", "uint16", between(1, 12)),
        Row("hardware revision", "string:10", text("1.0.0", "003", "A02")),
        Row("firmware version", "uint16", between(10_000, 32_000)),
        *empty(4),
    ]


def pm5000() -> list[Row]:
    """Schneider PM5000, from 3000: float32 with not-a-number, int64 counters, a clock."""
    return [
        *several(3, "current", "float32", near(42, 25, 0.8, idle=0, low=0)),
        *several(2, "current of neutral", "float32", NAN),
        Row("mean current", "float32", near(42, 20, 0.6, idle=0, low=0)),
        *several(4, "unbalance", "float32", near(8, 5, 0.4, idle=0, low=0)),
        *several(4, "voltage between phases", "float32", near(400, 5, 0.4)),
        *several(4, "voltage", "float32", VOLTS),
        *several(4, "active power", "float32", near(9, 6, 0.2, idle=0)),
        *several(4, "reactive power", "float32", near(2, 1.5, 0.05, idle=0)),
        *several(4, "power factor", "float32", FACTOR),
        Row("frequency", "float32", HERTZ),
        Row("temperature", "float32", NAN),
        Row("import energy", "int64", counter(1e4, 5e9, 10)),
        Row("export energy", "int64", counter(1e2, 5e7, 2, never=0.5)),
        Row("reactive energy", "int64", counter(1e3, 5e8, 3)),
        Row("reactive energy returned", "int64", counter(1e2, 5e7, 1, never=0.4)),
        Row("year", "uint16", clock(lambda at: at.year)),
        Row("month", "uint16", clock(lambda at: at.month)),
        Row("day", "uint16", clock(lambda at: at.day)),
        Row("hour", "uint16", clock(lambda at: at.hour)),
        Row("minute", "uint16", clock(lambda at: at.minute)),
        Row("second", "uint16", clock(lambda at: at.second)),
    ]


def dtsu666() -> list[Row]:
    """Chint DTSU666, from 0x2000: float32 that are integers, scaled by 10 or 1000."""
    return [
        *several(3, "voltage between phases", "float32", near(4000, 40, 4)),
        *several(3, "voltage", "float32", near(2310, 30, 3)),
        *several(3, "current", "float32", near(5200, 3000, 90, idle=0, low=0)),
        *several(4, "active power", "float32", near(11_000, 9000, 250, idle=0)),
        *several(4, "reactive power", "float32", near(1500, 1200, 60, idle=0)),
        *empty(8),
        *several(4, "power factor", "float32", near(940, 40, 4, idle=1000)),
        *empty(6),
        Row("frequency", "float32", near(5000, 2, 0.8)),
    ]


def analyser() -> list[Row]:
    """A power analyser whose float32 have any order, with demands, minima and maxima."""
    return [
        *several(3, "voltage", "float32", VOLTS),
        *several(3, "current", "float32", near(120, 80, 2, idle=0, low=0)),
        *several(3, "active power", "float32", near(26, 20, 0.6, idle=0)),
        Row("frequency", "float32", HERTZ),
        *several(3, "lowest voltage", "float32", magnitude(200, 225)),
        *several(3, "highest voltage", "float32", magnitude(235, 250)),
        *several(3, "highest current", "float32", magnitude(50, 900)),
        Row("import energy", "float32", counter(100, 4e6, 0.01)),
        Row("export energy", "float32", counter(10, 4e4, 0.001, never=0.6)),
        Row("transformer, primary", "float32", constant(100.0, 250.0, 400.0, 1000.0)),
        Row("transformer, secondary", "float32", constant(5.0, 1.0)),
        *several(2, "distortion", "float32", near(5, 2, 0.2, low=0)),
    ]


def b23() -> list[Row]:
    """ABB B23 and B24, from 0x5B00: scaled uint32 and int32, then int16."""
    return [
        *several(3, "voltage", "uint32", near(2300, 40, 3)),
        *several(3, "voltage between phases", "uint32", near(3990, 50, 5)),
        *several(3, "current", "uint32", near(600, 400, 12, idle=0, low=0)),
        *empty(2, 0xFFFF),
        *several(4, "active power", "int32", near(140_000, 90_000, 2000, idle=0)),
        *several(4, "reactive power", "int32", near(-20_000, 30_000, 700, idle=0)),
        *several(4, "apparent power", "int32", near(150_000, 90_000, 2000, idle=0, low=0)),
        Row("frequency", "uint16", near(5000, 2, 0.8)),
        *several(4, "phase angle of power", "int16", near(80, 200, 8, idle=0)),
        *several(3, "phase angle of voltage", "int16", constant(0, 1200, -1200, 1199, -1201)),
        *several(3, "phase angle of current", "int16", near(100, 800, 8, idle=0)),
        *several(4, "power factor", "int16", near(930, 50, 4, idle=1000)),
        *several(4, "quadrant", "uint16", constant(1, 1, 4, 2)),
    ]


def b23_energy() -> list[Row]:
    """ABB B23 and B24, from 0x5000: uint64 counters, all ones where there is none."""
    return [
        Row("import energy", "uint64", counter(1e3, 9e7, 0.5)),
        Row("export energy", "uint64", counter(1e2, 9e5, 0.1, never=0.5)),
        Row("net energy", "int64", counter(1e3, 9e7, 0.5)),
        Row("import reactive energy", "uint64", counter(1e3, 9e6, 0.2)),
        Row("export reactive energy", "uint64", counter(1e2, 9e5, 0.1, never=0.4)),
        Row("net reactive energy", "int64", counter(1e2, 9e6, 0.1)),
        Row("apparent energy", "uint64", counter(1e3, 9e7, 0.5)),
        *empty(8, 0xFFFF),
        *several(3, "import energy of a phase", "uint64", counter(1e3, 9e7, 0.2)),
    ]


def em24() -> list[Row]:
    """Carlo Gavazzi EM24, from 0: int32 with the low register first, then int16."""
    return [
        *several(3, "voltage", "int32", near(2300, 40, 3)),
        *several(3, "voltage between phases", "int32", near(3990, 50, 5)),
        *several(3, "current", "int32", near(6000, 4000, 120, idle=0, low=0)),
        *several(3, "active power", "int32", near(14_000, 12_000, 200, idle=0)),
        *several(3, "apparent power", "int32", near(15_000, 9000, 200, idle=0, low=0)),
        *several(3, "reactive power", "int32", near(-1500, 2500, 80, idle=0)),
        *several(2, "mean voltage", "int32", near(2310, 30, 3)),
        Row("total power", "int32", near(42_000, 25_000, 500, idle=0)),
        Row("total apparent power", "int32", near(45_000, 25_000, 500, idle=0, low=0)),
        Row("total reactive power", "int32", near(-4000, 5000, 200, idle=0)),
        *several(4, "power factor", "int16", near(930, 50, 4, idle=1000)),
        Row("phase sequence", "int16", constant(0, -1)),
        Row("frequency", "uint16", near(500, 0.3, 0.2)),
        Row("import energy", "int32", counter(500, 9e6, 0.01)),
        Row("import reactive energy", "int32", counter(100, 9e5, 0.005)),
        Row("power demand", "int32", near(38_000, 20_000, 10, idle=0, low=0)),
        Row("largest power demand", "int32", magnitude(20_000, 180_000)),
        *several(3, "import energy of a phase", "int32", counter(200, 3e6, 0.003)),
        *several(4, "energy of a tariff", "int32", counter(200, 3e6, 0.003, never=0.5)),
        Row("export energy", "int32", counter(10, 9e5, 0.002, never=0.6)),
    ]


def orno() -> list[Row]:
    """ORNO WE-515 and Acrel: int16 and uint16 first, then int32 and energy as uint32."""
    return [
        Row("serial number", "uint32", between(2 * 10**7, 2 * 10**8)),
        Row("address", "uint16", between(1, 30)),
        Row("baud rate", "uint16", constant(9600, 19_200)),
        Row("software version", "uint16", between(100, 260)),
        Row("hardware version", "uint16", between(100, 120)),
        *several(3, "voltage", "uint16", near(2310, 30, 3)),
        *several(3, "current", "uint16", near(520, 300, 9, idle=0, low=0)),
        Row("frequency", "uint16", near(5000, 2, 0.8)),
        *several(4, "active power", "int32", near(1100, 900, 25, idle=0)),
        *several(4, "reactive power", "int32", near(150, 200, 9, idle=0)),
        *several(4, "power factor", "int16", near(940, 40, 4, idle=1000)),
        *several(4, "import energy", "uint32", counter(100, 9e6, 0.01)),
        *several(4, "export energy", "uint32", counter(10, 9e4, 0.002, never=0.6)),
        *several(2, "transformer ratio", "uint16", constant(1, 20, 40, 100)),
    ]


def pzem() -> list[Row]:
    """PZEM-016 modules: ten registers, uint32 with the low register first."""
    return [
        Row("voltage", "uint16", near(2310, 40, 4)),
        Row("current", "uint32", near(4000, 3000, 90, idle=0, low=0)),
        Row("power", "uint32", near(9000, 6000, 190, idle=0, low=0)),
        Row("energy", "uint32", counter(50, 900_000, 0.3)),
        Row("frequency", "uint16", near(500, 0.4, 0.3)),
        Row("power factor", "uint16", near(94, 4, 0.6, idle=0, low=0)),
        Row("alarm bits", "uint16", constant(0, 0, 0xFFFF)),
    ]


def heat_meter() -> list[Row]:
    """Heat meters and gateways of M-Bus: the identification is BCD."""
    return [
        Row("identification", "bcd32", between(10**7, 8 * 10**7)),
        Row("manufacturer code bits", "uint16", constant(0x2C2D, 0x4D65, 0x2824, 0x11A5)),
        Row("generation", "uint16", between(1, 60)),
        Row("medium", "uint16", constant(4, 4, 12, 13)),
        Row("access number", "uint16", between(1, 255)),
        Row("status bits", "uint16", bits(5, 0.1)),
        Row("energy", "uint32", counter(100, 3e6, 0.01)),
        Row("volume", "uint32", counter(100, 9e6, 0.05)),
        Row("operating hours", "uint32", counter(500, 90_000, 0.0003)),
        Row("flow", "uint32", near(850, 500, 15, idle=0, low=0)),
        Row("power", "int32", near(14_000, 9000, 200, idle=0)),
        Row("flow temperature", "uint16", near(6150, 900, 6, low=0)),
        Row("return temperature", "uint16", near(4120, 700, 5, low=0)),
        Row("difference of temperatures", "int16", near(2030, 500, 6)),
        Row("clock", "bytes:4", clock(_type_f)),
        Row("due date", "uint16", constant(0x1F0C, 0x1F0C, 0x1E06)),
        Row("energy at due date", "uint32", magnitude(100, 2e6)),
        *several(4, "volume of a month", "uint32", magnitude(10, 9e4)),
    ]


def _type_f(at: datetime) -> bytes:
    """The date and time of M-Bus, type F."""
    year = at.year % 100
    return bytes([at.minute, at.hour, at.day | (year & 7) << 5, at.month | (year >> 3) << 4])


def pulses() -> list[Row]:
    """Pulse counters of 16 channels, most unused, with the states of the inputs."""
    return [
        Row("input bits", "uint16", bits(16, 0.3, toggles=True)),
        *several(16, "pulses", "uint32", counter(3, 5e6, 2, never=0.45)),
        *several(4, "pulses an hour", "uint16", magnitude(5, 9000)),
        Row("seconds since start", "uint32", counter(600, 9e7, 1)),
    ]


def dl645() -> list[Row]:
    """Meters with a converter of DL/T 645: everything is BCD."""
    return [
        Row("number", "bcd32", between(10**6, 9 * 10**7)),
        Row("import energy", "bcd32", counter(1000, 9e6, 0.01)),
        Row("export energy", "bcd32", counter(10, 9e4, 0.01, never=0.4)),
        *several(3, "voltage", "bcd16", near(2305, 25, 3)),
        *several(3, "current", "bcd16", near(520, 300, 8, idle=0, low=0)),
        *several(3, "power", "bcd32", near(11_500, 6000, 120, idle=0, low=0)),
        Row("frequency", "bcd16", near(5000, 2, 0.8)),
        Row("year and month", "bcd16", clock(lambda at: (at.year % 100) * 100 + at.month)),
        Row("day and hour", "bcd16", clock(lambda at: at.day * 100 + at.hour)),
        Row("minute and second", "bcd16", clock(lambda at: at.minute * 100 + at.second)),
        Row("address", "bcd16", between(1, 99)),
    ]


def _packed_date(at: datetime) -> int:
    return (at.year % 100) << 9 | at.month << 5 | at.day


def wireless_gateway() -> list[Row]:
    """A gateway of radio sensors: its address, then a short record for each sensor."""
    record = [
        Row("sensor address", "bytes:6", octets(0x00, 0x0D, 0x6F, (0, 255), (0, 255), (0, 255))),
        Row("battery", "uint16", near(2950, 200, 3, low=1800)),
        Row("signal", "int16", near(-72, 14, 1.5)),
        Row("temperature", "int16", near(2130, 180, 4)),
        Row("humidity", "uint16", near(4600, 900, 12, low=500)),
        Row("last message", "uint32", epoch(hours=(0.001, 2))),
        Row("battery changed", "uint16", past(_packed_date)),
    ]  # fmt: skip
    return [
        Row("gateway address", "bytes:6", octets(0x00, 0x0D, 0x6F, (0, 255), (0, 255), (0, 255))),
        Row("firmware version bits", "uint16", constant(0x0102, 0x0114, 0x0203)),
        Row("sensors", "uint16", constant(4)),
        *record, *record, *record, *record,
    ]  # fmt: skip

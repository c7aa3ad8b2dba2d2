"""Register maps of ventilation, heat pumps, weather stations, power supplies and networks."""

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


def nilan() -> list[Row]:
    """Nilan CTS602: temperatures in hundredths, flags, packed dates, two letters a register."""
    return [
        *several(10, "temperature", "int16", near(2050, 500, 4)),
        *several(4, "temperature", "int16", near(900, 900, 4)),
        *several(4, "no sensor", "int16", constant(-27_300, 9900)),
        Row("humidity", "uint16", near(4300, 700, 8, low=1000)),
        Row("carbon dioxide", "uint16", near(720, 200, 4, low=400)),
        Row("alarms bits", "uint16", bits(4, 0.1)),
        Row("alarm", "uint16", constant(0, 19, 21)),
        Row("alarm date bits", "uint16", past(_dos_date)),
        Row("alarm time bits", "uint16", past(lambda at: at.hour << 11 | at.minute << 5)),
        *empty(6),
        Row("running", "uint16", constant(1, 1, 0)),
        Row("mode", "uint16", constant(1, 2, 3)),
        Row("state", "uint16", constant(3, 5, 9)),
        Row("seconds in state", "uint16", counter(5, 30_000, 1)),
        *several(3, "ventilation step", "uint16", constant(1, 2, 3)),
        Row("days since filter", "uint16", between(1, 90)),
        Row("days to filter", "uint16", between(1, 90)),
        *several(2, "lamp", "uint16", constant(0, 1)),
        Row("display", "string:8", text("AUTO 2>2", "VARME >3", "  22 C  ")),
        Row("display attribute bits", "uint16", bits(8, 0.2)),
        Row("display", "string:8", text("  21 1#:", "FILTER  ")),
        Row("second", "uint16", clock(lambda at: at.second)),
        Row("minute", "uint16", clock(lambda at: at.minute)),
        Row("hour", "uint16", clock(lambda at: at.hour)),
        Row("day", "uint16", clock(lambda at: at.day)),
        Row("month", "uint16", clock(lambda at: at.month)),
        Row("year", "uint16", clock(lambda at: at.year % 100)),
        *several(6, "temperature set", "int16", constant(2100, 2000, 1600, 5500, 2400)),
    ]  # fmt: skip


def _dos_date(at: datetime) -> int:
    return (at.year - 1980) % 128 << 9 | at.month << 5 | at.day


def systemair() -> list[Row]:
    """Systemair, from 100: fan speeds, logs, heater signals, temperatures, filter times."""
    return [
        Row("fan level", "uint16", constant(2, 1, 3)),
        *several(6, "fan flow", "uint16", constant(30, 45, 60, 80, 100)),
        Row("unit of flow", "uint16", constant(0, 1)),
        *several(2, "fan output", "uint16", near(46, 12, 0.4, idle=0, low=0)),
        *several(2, "fan speed", "uint16", near(1480, 300, 8, idle=0, low=0)),
        *empty(1),
        Row("manual stop", "uint16", constant(0, 1)), *empty(1),
        *several(10, "fan log", "uint16", magnitude(1, 30_000)),
        *several(2, "curve", "uint16", between(1, 10)),
        *several(2, "control type", "uint16", constant(0, 1)),
        *several(2, "heater type", "uint16", constant(0, 1, 2)), *empty(1),
        *several(2, "heater signal", "uint16", near(22, 20, 0.5, idle=0, low=0)),
        Row("frost protection", "uint16", constant(70, 100, 120)),
        Row("temperature level", "uint16", constant(2, 3, 4)),
        Row("set point", "uint16", constant(18, 20, 21)),
        *several(5, "temperature level", "uint16", constant(120, 145, 170, 195, 220)),
        *several(4, "temperature", "int16", near(195, 25, 0.5)),
        Row("outdoor temperature", "int16", near(45, 80, 0.4)),
        Row("sensor bits", "uint16", bits(5, 0.05)),
        *several(6, "interval", "uint16", constant(0, 20, 25, 70, 75, 100)),
        Row("band", "uint16", constant(250, 300)),
        Row("integral time", "uint16", constant(20, 120)),
        Row("preheater set point", "int16", constant(-100, -50, 0)),
        Row("filter period", "uint16", constant(6, 9, 12)),
        Row("days of filter", "uint16", between(1, 360)),
        Row("seconds to filter", "uint32", counter(1e4, 3e7, 0)),
    ]  # fmt: skip


def stiebel() -> list[Row]:
    """Stiebel Eltron ISG, from 500: tenths of degrees, 0x8000 where a sensor is absent."""
    return [
        *several(2, "room temperature", "int16", near(213, 15, 0.4)), *empty(2, 0x8000),
        Row("humidity", "int16", near(440, 70, 1)),
        Row("dew point", "int16", near(92, 20, 0.6)),
        Row("outdoor temperature", "int16", near(45, 80, 0.4)),
        *several(3, "heating circuit temperature", "int16", near(312, 50, 0.6)),
        *empty(2, 0x8000),
        *several(4, "flow temperature", "int16", near(328, 50, 0.8)), *empty(1, 0x8000),
        *several(2, "buffer temperature", "int16", near(322, 40, 0.4)),
        Row("heating pressure", "int16", near(168, 20, 0.5)),
        Row("flow rate", "int16", near(1240, 300, 7, idle=0)),
        Row("hot water", "int16", near(478, 40, 0.5)),
        Row("hot water set", "int16", constant(480, 500, 520)),
        *empty(7, 0x8000),
        Row("runtime", "uint16", magnitude(20, 30_000)), *empty(2, 0x8000),
        *several(2, "limit", "int16", constant(-200, -100, 50)),
        Row("runtime", "uint16", magnitude(2, 3000)),
        *several(2, "source temperature", "int16", near(62, 40, 0.4)), *empty(1, 0x8000),
        Row("hot gas temperature", "int16", near(683, 90, 2, idle=221)),
        *several(2, "pressure", "int16", near(166, 60, 1)),
    ]  # fmt: skip


def stiebel_energy() -> list[Row]:
    """Stiebel Eltron ISG, from 3500: energies in two registers of three decimal digits each."""
    energy = [
        Row("energy of the day", "uint16", counter(1, 90, 0.001)),
        Row("energy below a megawatt hour", "uint16", between(0, 999)),
        Row("energy, megawatt hours", "uint16", between(0, 90)),
    ]
    return [
        *energy, *energy,
        Row("heater, kilowatt hours", "uint16", between(0, 999)),
        Row("heater, megawatt hours", "uint16", between(0, 9)),
        *energy, *energy,
        *several(6, "running hours", "uint16", magnitude(2, 30_000)),
        *several(26, "output", "uint16", constant(0, 0, 1)),
        *several(3, "version", "uint16", between(0, 30)),
    ]  # fmt: skip


def nibe() -> list[Row]:
    """Nibe S series, input registers: tenths of degrees, flags, uint32 with the low word first."""
    return [
        Row("outdoor temperature", "int16", near(45, 80, 0.4)),
        *several(6, "temperature", "int16", near(380, 100, 0.6)),
        *empty(3, 0x8000),
        Row("room temperature", "int16", near(213, 15, 0.3)),
        *several(8, "flag", "uint16", constant(0, 0, 1, 2)),
        *several(3, "current", "uint32", near(42, 20, 1.2, idle=0, low=0)),
        Row("degree minutes", "int32", near(-900, 1800, 6)),
        Row("compressor frequency", "uint16", near(52, 15, 0.4, idle=0, low=0)),
        Row("compressor starts", "uint32", magnitude(20, 30_000)),
        Row("compressor hours", "uint32", magnitude(50, 60_000)),
        Row("compressor hours, hot water", "uint32", magnitude(20, 9000)),
        *several(4, "energy", "uint32", counter(100, 900_000, 0.001, never=0.25)),
        *several(3, "alarm", "uint16", constant(0, 0, 183)),
        *several(6, "curve", "int16", constant(0, 9, -2, 15, 30, 45)),
        *several(6, "set point", "int16", constant(210, 200, 450, 500, 550)),
        Row("software version", "uint16", between(2000, 9999)),
    ]


def idm() -> list[Row]:
    """iDM heat pumps, from 1000: float32 with the low register first, between enumerations."""
    return [
        Row("outdoor temperature", "float32", near(4.5, 8, 0.04)),
        Row("mean outdoor temperature", "float32", near(4.8, 7, 0.0)),
        Row("message", "uint16", constant(0, 0, 21)),
        Row("mode", "uint16", constant(1, 1, 2)),
        *empty(2),
        *several(4, "storage temperature", "float32", near(38, 9, 0.05)),
        Row("price", "float32", constant(0.0, 12.5)),
        *several(2, "energy", "float32", counter(100, 90_000, 0.001)),
        Row("hot water set", "uint16", constant(46, 48, 52)),
        *several(2, "hot water limit", "uint16", constant(44, 46, 50)),
        *several(6, "flow temperature", "float32", near(33, 6, 0.06)),
        *several(4, "room temperature", "float32", constant(-1.0, -1.0, 21.4)),
        *several(6, "state of a circuit", "uint16", constant(0, 1, 2, 255)),
        *several(3, "energy", "float32", counter(100, 90_000, 0.001)),
        Row("power", "float32", near(6.2, 2, 0.08, idle=0, low=0)),
    ]


def komfovent() -> list[Row]:
    """Komfovent C6: settings, clock as uint32, temperatures, energies of day, month and ever."""
    return [
        *several(2, "on", "uint16", constant(0, 1)),
        *several(3, "season", "uint16", constant(0, 1, 2)),
        Row("clock", "uint32", epoch()),
        Row("time zone", "int16", constant(120, 60, 180)),
        *several(4, "flow of a mode", "uint32", constant(120, 200, 280, 350, 150)),
        *several(4, "temperature of a mode", "int16", constant(180, 200, 210)),
        *several(3, "temperature", "int16", near(205, 20, 0.5)),
        Row("outdoor temperature", "int16", near(45, 80, 0.4)),
        *several(2, "flow", "uint32", near(212, 50, 2, idle=0, low=0)),
        *several(2, "fan", "uint16", near(462, 120, 3, idle=0, low=0)),
        Row("efficiency", "uint16", near(86, 4, 0.3, idle=0, low=0)),
        Row("power", "uint32", near(62, 20, 1.2, idle=0, low=0)),
        *several(6, "energy", "uint32", counter(20, 9e6, 0.05)),
        *several(3, "active alarm", "uint16", constant(0, 0, 127)),
        Row("firmware version bits", "uint32", constant(0x01031E07, 0x01041010)),
    ]


def thermostat() -> list[Row]:
    """Room controllers: set points, states, one or two measured values."""
    return [
        Row("room temperature", "int16", near(213, 12, 0.4)),
        Row("set point", "int16", constant(210, 215, 200)),
        *several(4, "set point", "int16", constant(210, 190, 160, 240, 80)),
        Row("mode", "uint16", constant(0, 1, 2, 3)),
        Row("fan", "uint16", constant(0, 1, 2, 3)),
        Row("valve", "uint16", near(42, 30, 0.5, idle=0, low=0)),
        *several(4, "input", "uint16", constant(0, 1)),
        Row("humidity", "uint16", near(44, 8, 0.3, low=10)),
        *several(6, "setting", "uint16", constant(0, 1, 5, 10, 30, 50)),
        Row("address", "uint16", between(1, 60)),
        Row("firmware version", "uint16", between(100, 320)),
    ]


def weather() -> list[Row]:
    """Weather stations: tenths as int16, then float32, with codes for what is not measured."""
    return [
        Row("temperature", "int16", near(112, 70, 0.8)),
        Row("dew point", "int16", near(52, 60, 0.8)),
        Row("humidity", "uint16", near(720, 150, 1.5, low=100)),
        Row("pressure", "uint16", near(10_132, 90, 0.8)),
        Row("wind speed", "uint16", near(42, 25, 4, low=0)),
        Row("wind gust", "uint16", near(82, 35, 2, low=0)),
        Row("wind direction", "uint16", near(2200, 700, 60, low=0)),
        Row("radiation", "uint16", near(420, 250, 5, idle=0, low=0)),
        Row("rain", "uint16", counter(1, 9000, 0.001, never=0.3)),
        *several(2, "not measured", "int16", constant(0x7FFF)),
        *empty(1, 0x8000),
        *several(4, "temperature", "float32", near(11.2, 7, 0.08)),
        Row("wind speed", "float32", near(4.2, 2.5, 0.4, low=0)),
        Row("pressure", "float32", near(1013.2, 9, 0.03)),
        Row("rain", "float32", counter(1, 900, 0.0002, never=0.3)),
        Row("clock", "uint32", epoch()),
        Row("status bits", "uint16", bits(8, 0.1)),
        Row("serial number", "uint32", between(10**5, 9 * 10**8)),
    ]


def thies() -> list[Row]:
    """Thies Clima: int32 and uint32 at every second register, 0x7FFFFFFF if absent."""
    return [
        Row("wind speed", "uint32", near(42, 25, 4, low=0)),
        Row("wind speed, mean", "uint32", near(42, 25, 1, low=0)),
        Row("wind direction", "uint32", near(2200, 700, 60, low=0)),
        Row("temperature", "int32", near(112, 70, 0.8)),
        Row("temperature inside", "int32", near(193, 60, 0.6)),
        Row("humidity", "uint32", near(720, 150, 1.5, low=100)),
        Row("pressure", "uint32", near(101_320, 900, 6)),
        Row("light", "uint32", near(42_000, 25_000, 300, idle=0, low=0)),
        Row("twilight", "uint32", near(480, 50, 0, idle=0, low=0)),
        Row("radiation", "int32", near(420, 250, 5, idle=0)),
        Row("precipitation", "uint32", constant(0, 0, 1)),
        Row("intensity", "uint32", near(0, 900, 9, low=0)),
        Row("amount", "uint32", counter(1, 9000, 0.001, never=0.3)),
        *several(2, "not measured", "int32", constant(0x7FFFFFFF)),
        Row("position, longitude", "int32", near(9_930_000, 300_000, 0)),
        Row("position, latitude", "int32", near(51_530_000, 300_000, 0)),
        Row("date", "uint32", clock(lambda at: at.year * 10_000 + at.month * 100 + at.day)),
        Row("time", "uint32", clock(lambda at: at.hour * 10_000 + at.minute * 100 + at.second)),
        Row("software version", "uint32", between(100, 320)),
    ]


def air_sensor() -> list[Row]:
    """Small sensors: a handful of uint16, then address and baud rate."""
    return [
        Row("carbon dioxide", "uint16", near(640, 200, 4, low=400)),
        Row("temperature", "int16", near(223, 25, 0.6)),
        Row("humidity", "uint16", near(446, 90, 1.2, low=100)),
        *several(2, "particles", "uint16", near(12, 7, 0.7, low=0)),
        Row("address", "uint16", between(1, 20)),
        Row("baud rate code", "uint16", constant(3, 2, 9600)),
    ]


def apc() -> list[Row]:
    """APC Smart-UPS: bits of 32, fixed-point uint16, texts of 8 registers, dates in days."""
    return [
        Row("status bits", "uint32", constant(0x00002002, 0x00002000, 0x00000004)),
        Row("transfer cause", "uint16", constant(8, 0, 2)),
        Row("outlet bits", "uint32", bits(12, 0.2)),
        *empty(10),
        *several(3, "error bits", "uint16", bits(16, 0.02)),
        Row("seconds left", "uint32", near(2400, 900, 9, low=60)),
        Row("battery charge", "uint16", near(51_000, 300, 0)),
        Row("battery voltage", "uint16", near(1746, 20, 1)),
        Row("battery date", "uint16", between(6500, 9400)),
        Row("battery temperature", "uint16", near(3200, 200, 3)),
        Row("load", "uint16", near(7200, 3000, 40, idle=0, low=0)),
        Row("apparent load", "uint16", near(8200, 3000, 40, idle=0, low=0)),
        Row("output current", "uint16", near(62, 25, 1.2, idle=0, low=0)),
        Row("output voltage", "uint16", near(14_800, 60, 9)),
        Row("output frequency", "uint16", near(6400, 3, 1)),
        Row("energy", "uint32", counter(50, 9e6, 0.1)),
        Row("input voltage", "uint16", near(14_750, 120, 12)),
        Row("firmware version", "string:16", text("UPS 09.3 (ID18)", "UPS 15.1")),
        Row("model", "string:32", text("Smart-UPS 1500", "Smart-UPS X 3000")),
        Row("article", "string:32", text("SMT1500RMI2UC", "SMX3000RMHV2U")),
        Row("serial number", "string:16", text("AS1########", "3S2105X#####")),
        Row("name", "string:16", text("UPS-RACK-0#", "")),
        Row("made", "uint16", between(6000, 9400)),
        Row("rated power", "uint16", constant(1500, 2880, 3000)),
    ]


def ups() -> list[Row]:
    """UPS cards of Eaton, Socomec and others: uint16, states, no texts."""
    return [
        *several(3, "input voltage", "uint16", near(231, 3, 0.4)),
        *several(3, "output voltage", "uint16", near(230, 1, 0.3)),
        *several(3, "output current", "uint16", near(82, 30, 1, idle=0, low=0)),
        *several(3, "load", "uint16", near(42, 15, 0.5, idle=0, low=0)),
        Row("input frequency", "uint16", near(500, 0.3, 0.2)),
        Row("output frequency", "uint16", constant(500)),
        Row("battery voltage", "uint16", near(2712, 30, 0.6)),
        Row("battery current", "int16", near(0, 3, 0.5)),
        Row("battery charge", "uint16", constant(100, 100, 97)),
        Row("minutes left", "uint16", near(42, 20, 0, low=3)),
        Row("temperature", "uint16", near(263, 25, 0.5)),
        *several(4, "status bits", "uint16", bits(16, 0.15)),
        *several(4, "alarm bits", "uint16", bits(16, 0.02)),
        Row("apparent power", "uint32", near(8200, 3000, 40, idle=0, low=0)),
        Row("active power", "uint32", near(7200, 3000, 40, idle=0, low=0)),
        *empty(6, 0xFFFF),
    ]


def alfen_identity() -> list[Row]:
    """Alfen chargers, from 100: texts, a clock in int16, uptime as uint64."""
    return [
        Row("name", "string:34", text("ALF_########", "ace00#####")),
        Row("manufacturer", "string:10", text("Alfen NV")),
        Row("map version", "int16", constant(1)),
        Row("firmware version", "string:34", text("4.14.0-3398", "6.4.0-4210")),
        Row("platform", "string:34", text("NG910", "NG920-60583")),
        Row("serial number", "string:22", text("ACE0######", "ACE1######")),
        Row("year", "int16", clock(lambda at: at.year)),
        Row("month", "int16", clock(lambda at: at.month)),
        Row("day", "int16", clock(lambda at: at.day)),
        Row("hour", "int16", clock(lambda at: at.hour)),
        Row("minute", "int16", clock(lambda at: at.minute)),
        Row("second", "int16", clock(lambda at: at.second)),
        Row("uptime", "uint64", counter(1e5, 3e9, 1000)),
        Row("time zone", "int16", constant(60, 120, 0)),
    ]


def alfen() -> list[Row]:
    """Alfen chargers, from 300: float32, then float64 energies; not-a-number if not measured."""
    return [
        Row("meter state bits", "uint16", constant(3, 1)),
        Row("age of the values", "uint64", counter(20, 5000, 1000)),
        Row("meter type", "uint16", constant(0, 2)),
        *several(3, "voltage", "float32", near(231, 3, 0.3)),
        *several(3, "voltage between phases", "float32", near(400, 4, 0.5)),
        Row("current of neutral", "float32", constant(float("nan"))),
        *several(3, "current", "float32", near(15.6, 1, 0.05, idle=0, low=0)),
        Row("sum of currents", "float32", near(47, 2, 0.1, idle=0, low=0)),
        *several(4, "power factor", "float32", near(0.99, 0.01, 0.002, idle=0)),
        Row("frequency", "float32", near(50, 0.02, 0.008)),
        *several(4, "active power", "float32", near(3600, 150, 15, idle=0)),
        *several(4, "apparent power", "float32", near(3640, 150, 15, idle=0, low=0)),
        *several(4, "reactive power", "float32", near(40, 60, 5, idle=0)),
        *several(4, "import energy", "float64", counter(1e4, 2e7, 1)),
        *several(4, "export energy", "float64", constant(0.0, 0.0, float("nan"))),
        Row("available", "uint16", constant(1)),
        Row("mode", "string:10", text("A", "C2", "B2", "C2")),
        Row("largest current", "float32", constant(16.0, 32.0, 20.0)),
        Row("valid for", "uint32", constant(0, 60)),
        Row("safe current", "float32", constant(6.0, 16.0)),
        Row("accepted", "uint16", constant(0, 1)),
        Row("phases", "uint16", constant(1, 3)),
    ]


def keba() -> list[Row]:
    """KEBA and go-e chargers: uint32 throughout, states and milliamperes."""
    return [
        Row("state", "uint32", constant(1, 2, 3)),
        Row("cable", "uint32", constant(7, 3, 5)),
        Row("error code", "uint32", constant(0)),
        *several(3, "current", "uint32", near(15_800, 300, 30, idle=0, low=0)),
        Row("serial number", "uint32", between(15_000_000, 29_000_000)),
        Row("product", "uint32", between(3_120_001, 3_130_404)),
        Row("firmware version", "uint32", between(30_900, 31_300)),
        Row("active power", "uint32", near(10_900_000, 200_000, 20_000, idle=0, low=0)),
        Row("total energy", "uint32", counter(1e5, 4e8, 30)),
        *several(3, "voltage", "uint32", near(231, 3, 0.4)),
        Row("power factor", "uint32", near(990, 5, 1.2, idle=0, low=0)),
        Row("largest current", "uint32", constant(16_000, 32_000)),
        Row("largest current of the cable", "uint32", constant(32_000, 20_000)),
        Row("card bits", "uint32", constant(0, 0x04A3B2C1)),
        Row("energy of the session", "uint32", counter(50, 300_000, 30)),
        *several(2, "failsafe", "uint32", constant(0, 6000, 30)),
    ]


def charger() -> list[Row]:
    """Mennekes, ABL and other chargers: texts, states as uint16, address of the network."""
    return [
        Row("firmware version", "string:4", text("5.33", "5.12")),
        Row("state", "uint16", constant(0, 2, 3)),
        *several(2, "error bits", "uint32", bits(32, 0.02)),
        Row("model", "string:20", text("AMTRON Charge #00"[:15], "eMH3 Twin")),
        Row("hardware address", "bytes:6", octets(0x00, 0x0E, 0x8C, (0, 255), (0, 255), (0, 255))),
        Row("network address", "bytes:4", octets(192, 168, (0, 3), (2, 250))),
        *several(3, "energy of a phase", "uint32", counter(1e3, 9e7, 1)),
        *several(3, "power of a phase", "uint32", near(3600, 100, 12, idle=0, low=0)),
        *several(3, "current of a phase", "uint32", near(15_800, 300, 30, idle=0, low=0)),
        Row("session", "uint32", counter(20, 60_000, 0)),
        Row("start of the session", "uint32", epoch(hours=(0.1, 9))),
        Row("duration", "uint32", counter(30, 30_000, 1)),
        *several(2, "limit", "uint16", constant(16, 32, 6, 0)),
        Row("card", "string:20", text("04A3??????", "")),
    ]


def network_device() -> list[Row]:
    """Industrial switches: texts, versions, addresses, counters of packets, states of ports."""
    return [
        Row("manufacturer", "string:32", text("Moxa", "Phoenix Contact", "Hirschmann")),
        Row("unit", "uint16", constant(1, 2)),
        Row("product", "string:32", text("EDS-408A", "FL SWITCH 2208", "RS20-0800T1T1")),
        Row("serial number", "string:20", text("0####", "TBAFE#######")),
        Row("firmware version", "string:12", text("V3.8", "3.10", "09.0.12")),
        Row("firmware version bits", "uint16", constant(0x0308, 0x030A)),
        Row("hardware address", "bytes:6", octets(0x00, 0x90, 0xE8, (0, 255), (0, 255), (0, 255))),
        Row("network address", "bytes:4", octets(192, 168, (0, 3), (2, 250))),
        Row("network mask", "bytes:4", octets(255, 255, 255, 0)),
        Row("router", "bytes:4", octets(192, 168, (0, 3), 1)),
        Row("uptime", "uint32", counter(1e3, 9e7, 1)),
        *several(2, "power supply", "uint16", constant(0, 1)),
        *several(8, "port state", "uint16", constant(0, 1, 1, 2)),
        *several(8, "port speed", "uint16", constant(3, 1, 0xFFFF)),
        *several(8, "packets sent", "uint32", counter(50, 4e9, 120, never=0.25)),
        *several(8, "packets received", "uint32", counter(50, 4e9, 90, never=0.25)),
        *several(4, "packets lost", "uint32", constant(0, 0, 0, 12)),
    ]

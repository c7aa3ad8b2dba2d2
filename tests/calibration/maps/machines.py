"""Register maps of drives, remote inputs and outputs, controllers (PLC) and gensets."""

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
    past,
    several,
    text,
)


def danfoss() -> list[Row]:
    """Danfoss FC: parameters 16-xx as int32 or uint32 of two registers each."""
    return [
        Row("control bits", "uint32", constant(0x047C, 0x043C)),
        Row("reference", "int32", near(38_000, 9000, 0, idle=0)),
        Row("reference in percent", "int32", near(760, 150, 0, idle=0)),
        Row("status bits", "uint32", constant(0x0F07, 0x0607, 0x0603)),
        Row("main value", "int32", near(7600, 1200, 20, idle=0)),
        Row("power", "uint32", near(520, 200, 9, idle=0, low=0)),
        Row("motor voltage", "uint32", near(3100, 500, 9, idle=0, low=0)),
        Row("frequency", "uint32", near(382, 70, 1, idle=0, low=0)),
        Row("motor current", "uint32", near(1060, 300, 12, idle=0, low=0)),
        Row("torque", "int32", near(320, 120, 9, idle=0)),
        Row("speed", "int32", near(1140, 250, 3, idle=0)),
        Row("thermal load", "uint32", near(46, 15, 0, idle=0, low=0)),
        Row("link voltage", "uint32", near(562, 8, 1.2)),
        Row("brake energy", "uint32", constant(0)),
        Row("heatsink temperature", "uint32", near(41, 6, 0.3, low=0)),
        Row("inverter thermal load", "uint32", near(31, 9, 0, idle=0, low=0)),
        Row("rated current", "uint32", constant(1600, 3200, 720)),
        Row("alarm bits", "uint32", bits(32, 0.02)),
        Row("warning bits", "uint32", bits(32, 0.03)),
        Row("extended status bits", "uint32", bits(24, 0.1)),
        Row("operating hours", "uint32", counter(100, 70_000, 0.0003)),
        Row("running hours", "uint32", counter(50, 50_000, 0.0003)),
        Row("energy", "uint32", counter(50, 900_000, 0.002)),
    ]


def abb_drive() -> list[Row]:
    """ABB ACS550 and ACS580: control and status words, then group 1 as int16."""
    return [
        Row("control bits", "uint16", constant(0x047F, 0x047E)),
        *several(2, "reference", "int16", near(14_000, 3000, 0, idle=0)),
        Row("status bits", "uint16", constant(0x1237, 0x0231, 0x1637)),
        *several(2, "actual value", "int16", near(13_900, 3000, 30, idle=0)),
        *empty(4),
        Row("speed", "int16", near(1120, 250, 3, idle=0)),
        Row("frequency", "int16", near(381, 70, 1, idle=0)),
        Row("current", "uint16", near(106, 30, 1.5, idle=0, low=0)),
        Row("torque", "int16", near(320, 120, 9, idle=0)),
        Row("power", "int16", near(52, 20, 1, idle=0)),
        Row("link voltage", "uint16", near(562, 8, 1.2)),
        Row("output voltage", "uint16", near(310, 50, 1.5, idle=0, low=0)),
        Row("drive temperature", "uint16", near(412, 60, 1)),
        *several(2, "external reference", "int16", near(380, 90, 0, idle=0)),
        Row("control location", "uint16", constant(0, 1, 2)),
        Row("running hours", "uint16", magnitude(20, 50_000)),
        Row("energy", "uint16", magnitude(5, 60_000)),
        Row("regulator output", "int16", near(610, 150, 5, idle=0)),
        Row("input bits", "uint16", bits(6, 0.4)),
        *several(2, "analog input", "uint16", near(420, 200, 1.5, low=0)),
        Row("relay bits", "uint16", bits(3, 0.4)),
        Row("last fault", "uint16", constant(0, 3, 9, 16)),
        *several(2, "earlier fault", "uint16", constant(0, 4, 7, 2021)),
        Row("motor current, rated", "uint16", constant(115, 230, 32)),
        Row("motor voltage, rated", "uint16", constant(400, 415)),
        Row("motor speed, rated", "uint16", constant(1440, 1470, 2930)),
        Row("ramp up", "uint16", constant(50, 100, 300)),
        Row("ramp down", "uint16", constant(50, 100, 300)),
        Row("lowest frequency", "int16", constant(0, 200, -500)),
        Row("highest frequency", "int16", constant(500, 520)),
    ]


def altivar() -> list[Row]:
    """Schneider Altivar, from 3200: int16 with and without scale, with reserved registers."""
    return [
        Row("status bits", "uint16", constant(0x0637, 0x0233, 0x0250)),
        Row("frequency", "int16", near(381, 70, 1, idle=0)),
        Row("reference", "int16", near(382, 70, 0, idle=0)),
        Row("motor current", "uint16", near(106, 30, 1.5, idle=0, low=0)),
        Row("torque", "int16", near(320, 120, 9, idle=0)),
        Row("extended status bits", "uint16", bits(16, 0.2)), *empty(1, 0x8000),
        Row("mains voltage", "uint16", near(4010, 60, 8)),
        Row("motor voltage", "uint16", near(310, 50, 1.5, idle=0, low=0)),
        Row("thermal state of motor", "uint16", near(62, 20, 0.3, low=0)),
        Row("thermal state of drive", "uint16", near(48, 15, 0.3, low=0)),
        Row("power", "int16", near(52, 20, 1, idle=0)), *empty(4, 0x8000),
        Row("consumption", "uint16", magnitude(5, 60_000)),
        *several(2, "operating hours", "uint32", counter(100, 2e8, 1)),
        *empty(2, 0x8000),
        *several(8, "fault of the past", "uint16", constant(0, 0, 5, 18, 22, 30)),
        Row("model", "string:16", text("ATV320U15N4C", "ATV630D15N4")),
        Row("software version bits", "uint16", constant(0x2601, 0x1802)),
    ]  # fmt: skip


def sew() -> list[Row]:
    """SEW Movitrac and Siemens SINAMICS: process data words, then parameters of 32 bits."""
    return [
        *several(3, "output word bits", "uint16", constant(0x0006, 0x047F, 0x1388, 0x0BB8)),
        Row("status bits", "uint16", constant(0x0407, 0x0005, 0xEB37)),
        Row("speed", "int16", near(7100, 2000, 20, idle=0)),
        Row("output current", "int16", near(430, 150, 8, idle=0)),
        *empty(2),
        *several(2, "speed", "float32", near(1420, 60, 1.5, idle=0)),
        Row("link voltage", "float32", near(562, 8, 1.2)),
        Row("current", "float32", near(10.6, 3, 0.1, idle=0, low=0)),
        Row("torque", "float32", near(32, 12, 0.6, idle=0)),
        Row("temperature", "float32", near(41, 6, 0.1)),
        Row("ramp up", "float32", constant(10.0, 5.0, 2.5)),
        Row("ramp down", "float32", constant(10.0, 5.0, 2.5)),
        Row("highest speed", "float32", constant(1500.0, 3000.0)),
        Row("fault", "uint16", constant(0, 7801, 30_005)),
        *several(3, "fault of the past", "uint16", constant(0, 7800, 30_002)),
    ]


def wago() -> list[Row]:
    """WAGO 750: the process image, analog values first, then words of digital values."""
    return [
        *several(4, "current loop", "int16", near(14_500, 6000, 20)),
        *several(4, "temperature", "int16", near(223, 40, 1)),
        *several(2, "open input", "int16", constant(8500, -2000, 32_767)),
        *empty(1, 0x8000),
        *several(4, "voltage", "int16", near(1200, 9000, 20)),
        *several(2, "counter", "uint32", counter(50, 4e9, 8)),
        *several(3, "input bits", "uint16", bits(16, 0.35, toggles=True)),
        *several(2, "output bits", "uint16", bits(16, 0.25)),
    ]


def wago_identity() -> list[Row]:
    """WAGO and Beckhoff couplers, from 0x2010: versions, constants, texts with swapped bytes."""
    return [
        Row("firmware revision", "uint16", between(1, 30)),
        Row("series", "uint16", constant(750)),
        Row("item", "uint16", constant(352, 842, 881)),
        *several(2, "firmware version", "uint16", between(1, 40)),
        *empty(3),
        Row("constant", "uint16", constant(0)),
        Row("constant", "uint16", constant(0xFFFF)),
        Row("constant", "uint16", constant(0x1234)),
        Row("constant", "uint16", constant(0xAAAA)),
        Row("constant", "uint16", constant(0x7FFF)),
        Row("constant", "uint16", constant(0x8000)),
        Row("constant", "uint16", constant(0x3FFF)),
        Row("constant", "uint16", constant(0x4000)),
        Row("firmware text", "string:32", text("Modbus TCP FW 01.04.##", "BK9050"), "BADC"),
        Row("firmware date", "string:16", text("04.##.2019", "12 MAR 2018"), "BADC"),
        *several(12, "terminal bits", "uint16", constant(0x8201, 0x8402, 466, 455, 0x8801, 0)),
    ]


def analog_module() -> list[Row]:
    """ADAM-6000 and similar: uint16 of full scale, extremes, ranges, alarms."""
    return [
        *several(8, "analog input", "uint16", near(33_000, 12_000, 25, low=0)),
        *several(8, "largest value", "uint16", magnitude(34_000, 65_000)),
        *several(8, "smallest value", "uint16", magnitude(50, 30_000)),
        *several(8, "range", "uint16", constant(0x0107, 0x0148, 0x0182)),
        Row("alarm bits", "uint16", bits(8, 0.1)),
        Row("module bits", "uint16", constant(0x6017, 0x6015)),
        Row("firmware version bits", "uint16", constant(0x0501, 0x0614)),
        Row("watchdog", "uint16", constant(0, 10, 100)),
    ]


def thermometers() -> list[Row]:
    """Modules of resistance thermometers: int16 with a value for an open input, then settings."""
    return [
        *several(5, "temperature", "int16", near(223, 180, 1)),
        *several(2, "open input", "int16", constant(32_767, 8500)),
        *empty(1, 0x8000),
        *several(8, "sensor type", "uint16", constant(2, 2, 3)),
        *several(8, "offset", "int16", constant(0, 0, -5, 3)),
        Row("address", "uint16", between(1, 32)),
        Row("baud rate code", "uint16", constant(3, 2)),
        Row("filter", "uint16", constant(5, 10)),
        Row("errors bits", "uint16", bits(8, 0.3)),
    ]


def s7_block() -> list[Row]:
    """A data block of a Siemens S7: REAL, INT, DINT, WORD, a text with its header, a BCD date."""
    return [
        *several(4, "measured value", "float32", near(48, 22, 0.2)),
        *several(4, "set point", "float32", constant(50.0, 20.0, 7.5, 100.0, 0.0)),
        *several(4, "integer", "int16", near(120, 300, 2)),
        Row("parts", "int32", counter(20, 9e6, 0.5)),
        Row("parts refused", "int32", counter(2, 9e3, 0.01, never=0.2)),
        *several(3, "word of bits", "uint16", bits(16, 0.2, toggles=True)),
        Row("alarm bits", "uint32", bits(32, 0.05)),
        Row("text header bits", "uint16", constant(0x140C)),
        Row("recipe", "string:20", text("RECIPE_04_##", "Charge 2025#")),
        Row("year and month", "bcd16", clock(lambda at: (at.year % 100) * 100 + at.month)),
        Row("day and hour", "bcd16", clock(lambda at: at.day * 100 + at.hour)),
        Row("minute and second", "bcd16", clock(lambda at: at.minute * 100 + at.second)),
        Row("milliseconds and weekday", "bcd16", clock(_milliseconds)),
        *several(3, "measured value", "float32", near(3.1, 1.2, 0.02)),
        Row("total", "float32", counter(50, 9e5, 0.05)),
        Row("time", "int32", constant(5000, 60_000, 1_500_000)),
        Row("step", "int16", constant(10, 20, 35, 110)),
        Row("mode", "int16", constant(0, 1, 2)),
    ]


def _milliseconds(at: datetime) -> int:
    """The last digits of DATE_AND_TIME: milliseconds and the day of the week."""
    return at.microsecond // 1000 * 10 + at.isoweekday() % 7 + 1


def iec_variables() -> list[Row]:
    """Variables of a CODESYS controller, one after another as they were declared."""
    return [
        *several(5, "measured value", "float32", near(22, 9, 0.1)),
        *several(5, "set point", "float32", constant(21.0, 20.5, 60.0, 0.0, 5.0)),
        *several(5, "output", "float32", near(48, 25, 0.5, idle=0, low=0)),
        *several(2, "total", "float64", counter(100, 9e6, 0.02)),
        *several(3, "running time", "uint32", counter(1e3, 9e7, 1, never=0.1)),
        *several(3, "counter", "int32", counter(5, 9e6, 0.2)),
        *several(6, "state", "int16", constant(0, 1, 2, 3, 10, 20)),
        *several(4, "word of bits", "uint16", bits(16, 0.15)),
        *several(2, "analog raw", "int16", near(16_000, 6000, 15)),
        Row("clock", "uint32", epoch()),
    ]


def m340() -> list[Row]:
    """Memory words of a Schneider M340: INT, and REAL and DINT with the low register first."""
    return [
        *several(6, "integer", "int16", near(420, 300, 3)),
        *several(6, "measured value", "float32", near(12, 6, 0.1)),
        *several(3, "counter", "int32", counter(20, 9e6, 0.5)),
        *several(4, "set point", "float32", constant(10.0, 2.5, 150.0, 0.0)),
        Row("seconds and weekday", "bcd16", clock(lambda at: at.second * 100 + at.isoweekday())),
        Row("hour and minute", "bcd16", clock(lambda at: at.hour * 100 + at.minute)),
        Row("month and day", "bcd16", clock(lambda at: at.month * 100 + at.day)),
        Row("year", "bcd16", clock(lambda at: at.year)),
        *several(6, "word of bits", "uint16", bits(16, 0.2, toggles=True)),
        *several(8, "preset", "int16", constant(0, 10, 50, 100, 300, 1000)),
        *empty(6),
    ]


def set_points() -> list[Row]:
    """A page of settings: round float32, and limits as int16."""
    return [
        *several(4, "set point", "float32", constant(20.0, 21.5, 65.0, 55.0, 6.5)),
        *several(4, "upper limit", "float32", constant(100.0, 80.0, 95.0, 10.0)),
        *several(4, "lower limit", "float32", constant(0.0, 5.0, -10.0, 1.0)),
        *several(3, "gain", "float32", constant(1.0, 2.5, 0.8, 12.0)),
        *several(3, "integral time", "float32", constant(120.0, 30.0, 0.0)),
        *several(3, "hysteresis", "float32", constant(0.5, 1.0, 2.0)),
        *several(6, "delay", "int16", constant(0, 5, 10, 30, 60, 300)),
        *several(6, "enabled", "int16", constant(0, 1)),
        Row("password", "uint16", constant(1234, 0, 9999, 4711)),
        Row("checksum", "uint16", between(0x0100, 0xFFFF)),
    ]


def omron() -> list[Row]:
    """Data memory of an Omron or Mitsubishi controller: BCD counters, int16, int32, presets."""
    return [
        *several(4, "counter", "bcd16", counter(3, 9000, 0.2)),
        *several(4, "timer preset", "bcd16", constant(50, 100, 300, 1200)),
        *several(3, "total", "bcd32", counter(100, 9e7, 0.5)),
        *several(6, "measured value", "int16", near(320, 200, 3)),
        *several(4, "set value", "int16", constant(0, 50, 300, 1500, 400)),
        *several(2, "position", "int32", near(-20_000, 90_000, 30, idle=1000)),
        *several(3, "word of bits", "uint16", bits(16, 0.2)),
        Row("minute and second", "bcd16", clock(lambda at: at.minute * 100 + at.second)),
        Row("day and hour", "bcd16", clock(lambda at: at.day * 100 + at.hour)),
        Row("year and month", "bcd16", clock(lambda at: (at.year % 100) * 100 + at.month)),
    ]


def histogram() -> list[Row]:
    """A trend of 24 hours and a histogram of 12 classes, uint16, with totals as uint32."""
    return [
        *several(24, "value of an hour", "uint16", near(310, 90, 0, low=0)),
        *several(12, "count of a class", "uint16", magnitude(1, 9000)),
        *several(7, "energy of a day", "uint32", magnitude(200, 90_000)),
        Row("index", "uint16", between(0, 23)),
        *several(5, "not yet used", "uint16", constant(0)),
    ]


def controllers() -> list[Row]:
    """Process controllers: value, set point, output and parameters of three loops, int16."""
    loop = [
        Row("value", "int16", near(640, 300, 2)),
        Row("set point", "int16", constant(650, 800, 1200, 400)),
        Row("output", "int16", near(480, 250, 5, idle=0, low=0)),
        Row("proportional band", "int16", constant(50, 120, 30)),
        Row("integral time", "int16", constant(120, 240, 60)),
        Row("derivative time", "int16", constant(30, 0, 15)),
        Row("state bits", "uint16", bits(10, 0.2)),
        Row("alarm limit", "int16", constant(1000, 900, -100)),
        Row("alarm limit", "int16", constant(100, 0, -50)),
        Row("highest value", "int16", magnitude(700, 1500)),
    ]
    return [
        Row("model", "uint16", constant(2404, 3216, 700)),
        Row("firmware version", "uint16", between(100, 420)),
        *loop, *loop, *loop,
        Row("program step", "uint16", constant(0, 1, 4)),
        Row("remaining time", "uint16", counter(20, 3600, 0)),
    ]  # fmt: skip


def deep_sea() -> list[Row]:
    """Deep Sea gensets, page 4: uint16, then voltages and powers of 32 bits, and no-value codes."""
    return [
        Row("oil pressure", "uint16", near(420, 60, 4, idle=0, low=0)),
        Row("coolant temperature", "int16", near(82, 6, 0.3, idle=24)), *empty(1, 0x8000),
        Row("fuel", "uint16", near(71, 20, 0, low=3)),
        Row("alternator voltage", "uint16", near(278, 6, 1, idle=0, low=0)),
        Row("battery voltage", "uint16", near(272, 6, 0.6)),
        Row("engine speed", "uint16", near(1502, 6, 2, idle=0, low=0)),
        Row("generator frequency", "uint16", near(501, 2, 0.6, idle=0, low=0)),
        *several(3, "generator voltage", "uint32", near(2310, 20, 4, idle=0, low=0)),
        *several(3, "voltage between phases", "uint32", near(4001, 30, 6, idle=0, low=0)),
        *several(3, "generator current", "uint32", near(820, 300, 12, idle=0, low=0)),
        *empty(2, 0xFFFF),
        *several(3, "generator power", "int32", near(18_000, 7000, 250, idle=0)),
        *empty(1), Row("mains frequency", "uint16", near(500, 0.5, 0.2)),
        *several(3, "mains voltage", "uint32", near(2320, 25, 3)),
        *several(3, "mains voltage between phases", "uint32", near(4015, 40, 5)),
        Row("mains phase rotation", "uint16", constant(1)), *empty(4, 0xFFFF),
        Row("clock", "uint32", epoch()),
        Row("time to maintenance", "int32", magnitude(1e5, 9e5)),
        Row("time of maintenance", "uint32", epoch(hours=(-4000, -100))),
        Row("running time", "uint32", counter(1e4, 9e7, 1)),
        Row("energy", "uint32", counter(100, 9e6, 0.02)),
        Row("reactive energy", "uint32", counter(50, 9e5, 0.01)),
        Row("starts", "uint32", magnitude(5, 4000)),
    ]  # fmt: skip


def comap() -> list[Row]:
    """ComAp gensets: a text, bits, int16, counters, a BCD clock."""
    return [
        Row("name", "string:32", text("IL4-AMF25", "InteliLite MRS", "GEN-SET 0#")),
        *several(3, "binary bits", "uint16", bits(16, 0.3)),
        *several(3, "generator voltage", "uint16", near(231, 2, 0.5, idle=0, low=0)),
        *several(3, "generator current", "uint16", near(82, 30, 1.5, idle=0, low=0)),
        Row("generator frequency", "uint16", near(500, 1, 0.6, idle=0, low=0)),
        *several(3, "generator power", "int16", near(18, 7, 0.5, idle=0)),
        Row("power factor", "int16", near(92, 4, 0.6, idle=0)),
        Row("speed", "uint16", near(1500, 3, 2, idle=0, low=0)),
        Row("oil pressure", "int16", near(42, 6, 0.6, idle=0)),
        Row("water temperature", "int16", near(82, 6, 0.3)),
        Row("fuel", "int16", near(71, 20, 0)),
        Row("battery voltage", "int16", near(272, 6, 0.6)),
        *empty(2, 0x8000),
        Row("energy", "int32", counter(50, 9e5, 0.02)),
        Row("running hours", "uint32", counter(100, 9e5, 0.0003)),
        Row("starts", "uint16", magnitude(5, 4000)),
        Row("maintenance", "uint16", magnitude(5, 9000)),
        Row("hour and minute", "bcd16", clock(lambda at: at.hour * 100 + at.minute)),
        Row("day and month", "bcd16", clock(lambda at: at.day * 100 + at.month)),
        *several(4, "alarm bits", "uint16", bits(16, 0.05)),
        *several(8, "limit", "int16", constant(110, 90, 510, 485, 15, 95, 0, 20)),
    ]


def deif() -> list[Row]:
    """DEIF AGC: int16 measurements, counters with the high register first, many words of alarms."""
    return [
        Row("application", "uint16", constant(0, 3, 5)),
        *several(6, "generator voltage", "int16", near(400, 3, 0.6, idle=0)),
        *several(3, "generator frequency", "int16", near(5001, 8, 3, idle=0)),
        *several(3, "phase angle", "int16", near(0, 1200, 6, idle=0)),
        *several(3, "generator current", "int16", near(82, 30, 1.5, idle=0)),
        *several(4, "generator power", "int16", near(18, 7, 0.5, idle=0)),
        *several(4, "reactive power", "int16", near(6, 3, 0.4, idle=0)),
        Row("power factor", "int16", near(92, 4, 0.6, idle=100)),
        Row("energy", "uint32", counter(50, 9e5, 0.02)),
        *several(3, "energy of a period", "uint32", magnitude(3, 9000)),
        Row("running hours", "uint32", counter(100, 9e5, 0.0003)),
        Row("operations of the breaker", "uint16", magnitude(3, 4000)),
        Row("starts", "uint16", magnitude(5, 4000)),
        *several(14, "alarm bits", "uint16", bits(16, 0.02)),
        *several(3, "input bits", "uint16", bits(16, 0.3)),
        Row("last fault year", "uint16", past(lambda at: at.year)),
        Row("last fault month", "uint16", past(lambda at: at.month)),
        Row("last fault day", "uint16", past(lambda at: at.day)),
    ]

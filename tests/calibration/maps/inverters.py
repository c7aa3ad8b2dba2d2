"""Register maps of photovoltaic inverters and batteries."""

from __future__ import annotations

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
    several,
    text,
)

GRID = near(2310, 30, 3)
HERTZ = near(5000, 2, 0.8)


def huawei_identity() -> list[Row]:
    """Huawei SUN2000, from 30000: texts of several lengths, then nominal values."""
    return [
        Row("model", "string:30", text("SUN2000-10KTL-M1", "SUN2000-5KTL-L1", "SUN2000-30KTL-M3")),
        Row("serial number", "string:20", text("HV21######@##", "TA22########", "21010738######")),
        Row("part number", "string:20", text("01074###-00#", "02312###")),
        Row("firmware version", "string:30", text("V100R001C00SPC1##", "V200R001C00SPC1##")),
        Row("software version", "string:30", text("V100R001C20SPC###", "")),
        *empty(3),
        Row("protocol version", "uint32", constant(0x00030000, 0x00020005)),
        Row("model code", "uint16", between(348, 470)),
        Row("strings", "uint16", constant(2, 4, 8)),
        Row("trackers", "uint16", constant(2, 4)),
        Row("rated power", "uint32", constant(5000, 10_000, 30_000)),
        Row("largest active power", "uint32", constant(5500, 11_000, 33_000)),
        Row("largest apparent power", "uint32", constant(5500, 11_000, 33_000)),
        Row("largest reactive power", "int32", constant(3300, 6600, 19_800)),
        Row("smallest reactive power", "int32", constant(-3300, -6600, -19_800)),
        *empty(2),
    ]  # fmt: skip


def huawei() -> list[Row]:
    """Huawei SUN2000, from 32000: bits, strings of modules, int32, times, energy."""
    module = [
        Row("voltage of a string", "int16", near(5600, 900, 15, idle=0)),
        Row("current of a string", "int16", near(520, 200, 8, idle=0)),
    ]
    return [
        Row("state bits", "uint16", constant(0x0006, 0x0006, 0x0001)), *empty(1),
        Row("state bits", "uint16", constant(0x0007, 0x0005)),
        Row("state bits", "uint32", constant(0, 1, 2)), *empty(3),
        *several(3, "alarm bits", "uint16", bits(16, 0.02)), *empty(5),
        *module, *module, *empty(44),
        Row("input power", "int32", near(5200, 2500, 60, idle=0, low=0)),
        *several(3, "voltage between phases", "uint16", near(4010, 40, 5)),
        *several(3, "voltage", "uint16", GRID),
        *several(3, "current", "int32", near(7600, 3500, 90, idle=0)),
        Row("peak power today", "int32", magnitude(2000, 9900)),
        Row("active power", "int32", near(5000, 2500, 60, idle=0)),
        Row("reactive power", "int32", near(-60, 150, 8, idle=0)),
        Row("power factor", "int16", near(996, 6, 1.5, idle=0)),
        Row("frequency", "uint16", HERTZ),
        Row("efficiency", "uint16", near(9790, 40, 4, idle=0)),
        Row("temperature", "int16", near(425, 90, 1.2)),
        Row("insulation resistance", "uint16", near(2400, 900, 0)),
        Row("status", "uint16", constant(0x0200, 0x0200, 0xA000, 0x0002)),
        Row("fault code", "uint16", constant(0, 0, 0, 2065)),
        Row("start", "uint32", epoch(hours=(1, 5))),
        Row("shutdown", "uint32", epoch(hours=(12, 20))),
        Row("active power", "int32", near(5000, 2500, 60, idle=0)),
        *empty(9),
        Row("total energy", "uint32", counter(1000, 9e6, 0.1)),
        Row("total energy of the modules", "uint32", counter(1000, 9e6, 0.1)),
        Row("time of statistics", "uint32", epoch(hours=(0.0, 1.0))),
        Row("energy of the hour", "uint32", counter(2, 900, 0.1)),
        Row("energy of the day", "uint32", counter(20, 6000, 0.1)),
        Row("energy of the month", "uint32", counter(200, 160_000, 0.1)),
        Row("energy of the year", "uint32", counter(2000, 1_600_000, 0.1)),
    ]  # fmt: skip


def sma() -> list[Row]:
    """SMA, from 30051: uint32 and int32 throughout; 0x80000000 and all ones mean no value."""
    none_signed = [*empty(1, 0x8000), *empty(1)]
    none = empty(2, 0xFFFF)
    return [
        Row("device class", "uint32", constant(8001, 8007)),
        Row("model", "uint32", between(9074, 9400)),
        Row("serial number", "uint32", between(1_900_000_000, 3_010_000_000)),
        Row("software version bits", "uint32", constant(0x03100F04, 0x02520304, 0x04001104)),
        *none,
        Row("condition", "uint32", constant(307, 307, 35, 303)),
        Row("rated power", "uint32", constant(8000, 10_000, 25_000)),
        Row("recommended action", "uint32", constant(887, 336)),
        Row("relay", "uint32", constant(51, 311)),
        Row("total energy", "uint32", counter(1e5, 3e8, 2)),
        Row("total energy", "uint32", counter(100, 3e5, 0.002)),
        Row("energy of the day", "uint32", counter(100, 60_000, 2)),
        Row("operating time", "uint32", counter(1e5, 3e8, 1)),
        Row("feed-in time", "uint32", counter(1e5, 2e8, 1)), *none,
        Row("current of modules", "int32", near(6200, 2500, 60, idle=0)),
        Row("voltage of modules", "int32", near(54_000, 7000, 90, idle=0)),
        Row("power of modules", "int32", near(3300, 1500, 30, idle=0)),
        Row("active power", "int32", near(6400, 3000, 60, idle=0)),
        *several(3, "active power of a phase", "int32", near(2130, 1000, 20, idle=0)),
        *several(3, "voltage", "uint32", near(23_100, 300, 30)), *none, *none, *none,
        *several(3, "current", "uint32", near(9200, 4000, 80, idle=0, low=0)),
        Row("frequency", "uint32", HERTZ),
        Row("reactive power", "int32", near(-40, 120, 6, idle=0)), *none_signed, *none_signed,
        Row("temperature", "int32", near(412, 80, 2)),
        Row("energy", "uint64", counter(1e5, 3e8, 2)),
        Row("energy of the day", "uint64", counter(100, 60_000, 2)),
        Row("feed-in time", "uint64", counter(1e5, 2e8, 1)),
    ]  # fmt: skip


def sungrow() -> list[Row]:
    """Sungrow, input registers from 4989: uint32 and int32 with the low register first."""
    return [
        Row("serial number", "string:20", text("A21########", "B2###@#####", "A22########")),
        Row("model code", "uint16", constant(0x0E03, 0x0E13, 0x2434)),
        Row("rated power", "uint16", constant(80, 100, 250)),
        Row("output type", "uint16", constant(0, 1, 2)),
        Row("energy of the day", "uint16", counter(3, 600, 0.01)),
        Row("total energy", "uint32", counter(100, 9e5, 0.01)),
        Row("operating hours", "uint32", counter(100, 60_000, 0.0003)),
        Row("temperature", "int16", near(402, 80, 1.2)),
        Row("apparent power", "uint32", near(6600, 3000, 60, idle=0, low=0)),
        Row("voltage of modules", "uint16", near(5600, 900, 15, idle=0, low=0)),
        Row("current of modules", "uint16", near(82, 30, 1.5, idle=0, low=0)),
        Row("voltage of modules", "uint16", near(4700, 900, 15, idle=0, low=0)),
        Row("current of modules", "uint16", near(78, 30, 1.5, idle=0, low=0)),
        *empty(2),
        Row("power of modules", "uint32", near(6800, 3000, 60, idle=0, low=0)),
        *several(3, "voltage", "uint16", GRID),
        *several(3, "current", "uint16", near(92, 40, 1.5, idle=0, low=0)),
        *empty(3),
        Row("active power", "uint32", near(6500, 3000, 60, idle=0, low=0)),
        Row("reactive power", "int32", near(-50, 120, 7, idle=0)),
        Row("power factor", "int16", near(998, 4, 1, idle=1000)),
        Row("frequency", "uint16", near(500, 0.3, 0.2)),
        *empty(1, 0xFFFF),
        Row("work state", "uint16", constant(0, 0, 0x8000, 0x1200)),
        *several(5, "fault time", "uint16", constant(0)),
        Row("fault code", "uint16", constant(0, 0, 39)),
        *empty(4),
        Row("reactive power, nominal", "uint16", constant(48, 60, 150)),
    ]


def sungrow_hybrid() -> list[Row]:
    """Sungrow SH, input registers from 12999: the battery, energies of the day and in total."""
    day = counter(3, 500, 0.01)
    total = counter(100, 9e5, 0.01, never=0.1)
    return [
        Row("system state", "uint16", constant(64, 64, 8, 16_384)),
        Row("running bits", "uint16", bits(8, 0.4)),
        Row("energy of the day", "uint16", day), Row("total energy", "uint32", total),
        Row("exported today", "uint16", day), Row("exported in total", "uint32", total),
        Row("load power", "int32", near(900, 600, 30, low=0)),
        Row("export power", "int32", near(300, 2500, 40, idle=0)),
        Row("charged today", "uint16", day), Row("charged in total", "uint32", total),
        Row("used today", "uint16", day), Row("used in total", "uint32", total),
        Row("self-use", "uint16", near(430, 200, 0, low=0)),
        Row("grid state", "uint16", constant(0xAA, 0x55)),
        *several(3, "current", "int16", near(42, 30, 1.5, idle=0)),
        Row("active power", "int32", near(2500, 2500, 50, idle=0)),
        Row("imported today", "uint16", day), Row("imported in total", "uint32", total),
        Row("battery voltage", "uint16", near(2150, 120, 2)),
        Row("battery current", "uint16", near(60, 40, 2, idle=0, low=0)),
        Row("battery power", "uint16", near(1300, 900, 30, idle=0, low=0)),
        Row("charge", "uint16", near(640, 250, 0, low=50)),
        Row("health", "uint16", near(980, 20, 0)),
        Row("battery temperature", "int16", near(241, 50, 0.3)),
        Row("discharged today", "uint16", day), Row("discharged in total", "uint32", total),
    ]  # fmt: skip


def goodwe() -> list[Row]:
    """GoodWe ET, from 35100: a clock of packed bytes, uint16 and uint32 mixed."""
    return [
        Row("year and month bits", "uint16", clock(lambda at: (at.year % 100) << 8 | at.month)),
        Row("day and hour bits", "uint16", clock(lambda at: at.day << 8 | at.hour)),
        Row("minute and second bits", "uint16", clock(lambda at: at.minute << 8 | at.second)),
        Row("voltage of modules", "uint16", near(3800, 700, 12, idle=0, low=0)),
        Row("current of modules", "uint16", near(62, 30, 1.5, idle=0, low=0)),
        Row("power of modules", "uint32", near(2400, 1200, 30, idle=0, low=0)),
        Row("voltage of modules", "uint16", near(3500, 700, 12, idle=0, low=0)),
        Row("current of modules", "uint16", near(58, 30, 1.5, idle=0, low=0)),
        Row("power of modules", "uint32", near(2100, 1200, 30, idle=0, low=0)),
        *empty(8, 0xFFFF),
        Row("modes bits", "uint32", constant(0x0202, 0x02020000, 0x00000202)),
        *[row for _ in range(3) for row in _goodwe_phase()],
        Row("grid mode", "uint16", constant(1, 1, 0)),
        Row("inverter power", "int32", near(4300, 2200, 50, idle=0)),
        Row("grid power", "int32", near(-300, 2200, 40, idle=0)),
        *empty(1), Row("reactive power", "int16", near(-30, 90, 6, idle=0)),
        *empty(1), Row("apparent power", "int16", near(4300, 2200, 50, idle=0)),
        *empty(1), Row("load", "int16", near(900, 500, 30, low=0)),
        *several(3, "temperature", "int16", near(402, 70, 1)),
        *several(2, "bus voltage", "uint16", near(6400, 300, 6)),
        Row("battery voltage", "uint16", near(2560, 120, 2)),
        Row("battery current", "int16", near(-20, 60, 1.5, idle=0)),
        Row("warning bits", "uint16", bits(16, 0.03)),
        Row("error bits", "uint32", bits(32, 0.02)),
        Row("total energy", "uint32", counter(100, 9e5, 0.01)),
        Row("energy of the day", "uint32", counter(3, 600, 0.01)),
        Row("operating hours", "uint32", counter(100, 60_000, 0.0003)),
    ]  # fmt: skip


def _goodwe_phase() -> list[Row]:
    return [
        Row("voltage", "uint16", GRID),
        Row("current", "uint16", near(62, 30, 1.5, idle=0, low=0)),
        Row("frequency", "uint16", HERTZ),
        *empty(1),
        Row("active power", "int16", near(1400, 700, 20, idle=0)),
    ]


def goodwe_identity() -> list[Row]:
    """GoodWe, from 35000: versions, and texts without padding next to each other."""
    return [
        Row("protocol version", "uint16", constant(1, 2, 3)),
        Row("rated power", "uint16", constant(5000, 8000, 10_000)),
        Row("output type", "uint16", constant(0, 1, 2)),
        Row("serial number", "string:16", text("9010KETU########"[:16], "95048EHU########")),
        Row("model", "string:10", text("GW10K-ET", "GW5048-EHA", "GW8K-ET")),
        *several(3, "processor version", "uint16", between(1, 60)),
        Row("software revision", "uint16", between(100, 400)),
        Row("arm version", "string:12", text("04029-09-S11", "02041-17-S10")),
        Row("dsp version", "string:12", text("04029-09-S11", "02041-17-S00")),
    ]


def solax() -> list[Row]:
    """SolaX X3, input registers from 0: int16, then energies with the low register first."""
    return [
        Row("voltage", "uint16", GRID),
        Row("current", "int16", near(62, 30, 1.5, idle=0)),
        Row("power", "int16", near(1400, 900, 20, idle=0)),
        *several(2, "voltage of modules", "uint16", near(4300, 900, 12, idle=0, low=0)),
        *several(2, "current of modules", "uint16", near(62, 30, 1.5, idle=0, low=0)),
        Row("frequency", "uint16", HERTZ),
        Row("temperature", "int16", near(38, 8, 0.2)),
        Row("run mode", "uint16", constant(2, 2, 0, 9)),
        *several(2, "power of modules", "uint16", near(2300, 900, 20, idle=0, low=0)),
        *empty(8),
        Row("battery voltage", "int16", near(3150, 120, 2)),
        Row("battery current", "int16", near(-20, 60, 1.5, idle=0)),
        Row("battery power", "int16", near(-300, 1200, 25, idle=0)),
        Row("battery connected", "uint16", constant(0, 1)),
        Row("battery temperature", "int16", near(22, 5, 0)),
        *empty(3), Row("charge", "uint16", near(64, 25, 0, low=5)),
        Row("discharged in total", "uint32", counter(50, 90_000, 0.001)),
        *empty(1), Row("discharged today", "uint16", counter(2, 150, 0.001)),
        Row("charged in total", "uint32", counter(50, 90_000, 0.001)),
        Row("charged today", "uint16", counter(2, 150, 0.001)),
        *several(3, "limit of the battery", "uint16", constant(250, 300, 5500, 0)),
        *empty(16),
        Row("fault bits", "uint32", bits(32, 0.02)), *empty(2),
        Row("feed-in power", "int32", near(-300, 2500, 40, idle=0)),
        Row("fed in in total", "uint32", counter(100, 900_000, 0.01)),
        Row("consumed in total", "uint32", counter(100, 900_000, 0.01)),
        Row("power without grid", "uint16", constant(0)), *empty(3),
        Row("energy of the day", "uint16", counter(3, 600, 0.01)), *empty(1),
        Row("total energy", "uint32", counter(100, 900_000, 0.01)),
    ]  # fmt: skip


def solax_settings() -> list[Row]:
    """SolaX, holding registers from 0: three full texts, versions, password, limits, a clock."""
    return [
        Row("serial number", "string:14", text("H34A##I#######", "XB322########@")),
        Row("manufacturer", "string:14", text("SolaX", "solax power")),
        Row("module", "string:14", text("X3-Hybrid-G4", "SolaX Inverter")),
        *empty(4),
        Row("password", "uint16", constant(2014, 6868, 0)),
        *several(2, "firmware version", "uint16", between(100, 160)),
        Row("safety code", "uint16", between(0, 30)),
        *several(2, "lowest voltage", "uint16", constant(1840, 1955)),
        *several(2, "highest voltage", "uint16", constant(2530, 2645, 2760)),
        *several(2, "lowest frequency", "uint16", constant(4750, 4700, 4500)),
        *several(2, "highest frequency", "uint16", constant(5150, 5200)),
        Row("start delay", "uint16", constant(60, 300)),
        *several(2, "volt-var point", "uint16", constant(0, 2200, 2400, 1000)),
        Row("second", "uint16", clock(lambda at: at.second)),
        Row("minute", "uint16", clock(lambda at: at.minute)),
        Row("hour", "uint16", clock(lambda at: at.hour)),
        Row("day", "uint16", clock(lambda at: at.day)),
        Row("month", "uint16", clock(lambda at: at.month)),
        Row("year", "uint16", clock(lambda at: at.year % 100)),
        Row("work mode", "uint16", constant(0, 1, 2)),
        *several(2, "charge limit", "uint16", constant(10, 20, 100, 300)),
        *several(2, "charge time bits", "uint16", constant(0, 0x1700, 0x3B17, 0x0006)),
    ]


def growatt() -> list[Row]:
    """Growatt, input registers from 0: status, then uint16 and uint32 mixed."""
    return [
        Row("status", "uint16", constant(1, 1, 0)),
        Row("input power", "uint32", near(48_000, 20_000, 500, idle=0, low=0)),
        *[row for _ in range(2) for row in _growatt_string()],
        *empty(24),
        Row("active power", "uint32", near(46_000, 20_000, 500, idle=0, low=0)),
        Row("frequency", "uint16", HERTZ),
        *[row for _ in range(3) for row in _growatt_phase()],
        *several(3, "voltage between phases", "uint16", near(4010, 40, 5)),
        Row("energy of the day", "uint32", counter(3, 600, 0.01)),
        Row("total energy", "uint32", counter(100, 900_000, 0.01)),
        Row("operating time", "uint32", counter(1e5, 2e8, 2)),
        *[row for _ in range(2) for row in _growatt_energy()],
        *empty(20),
        *several(3, "temperature", "uint16", near(402, 70, 1)),
        *several(2, "bus voltage", "uint16", near(3900, 200, 6)),
        Row("power factor", "uint16", constant(10_000, 20_000)),
        Row("power percentage", "uint16", constant(100)),
        Row("fault code", "uint32", constant(0, 0, 0, 408)),
    ]


def _growatt_string() -> list[Row]:
    return [
        Row("voltage of modules", "uint16", near(5600, 900, 15, idle=0, low=0)),
        Row("current of modules", "uint16", near(42, 20, 1.2, idle=0, low=0)),
        Row("power of modules", "uint32", near(24_000, 9000, 250, idle=0, low=0)),
    ]


def _growatt_phase() -> list[Row]:
    return [
        Row("voltage", "uint16", GRID),
        Row("current", "uint16", near(66, 30, 1.5, idle=0, low=0)),
        Row("apparent power", "uint32", near(15_400, 7000, 150, idle=0, low=0)),
    ]


def _growatt_energy() -> list[Row]:
    return [
        Row("energy of modules, day", "uint32", counter(3, 300, 0.005)),
        Row("energy of modules, total", "uint32", counter(100, 400_000, 0.005)),
    ]


def growatt_settings() -> list[Row]:
    """Growatt, holding registers from 0: settings, texts, a clock, limits."""
    return [
        Row("on", "uint16", constant(1, 1, 0)),
        Row("safety function bits", "uint16", bits(10, 0.4)),
        Row("memory of power factor", "uint16", constant(0, 1)),
        Row("active power", "uint16", constant(100, 255)),
        Row("reactive power", "uint16", constant(0, 100)),
        Row("power factor", "uint16", constant(10_000, 20_000)),
        Row("rated power", "uint32", constant(50_000, 100_000, 36_000)),
        Row("rated voltage", "uint16", constant(3600, 5800)),
        Row("firmware version", "string:6", text("AH1.0", "GH1.0Z", "DN1.0")),
        Row("control version", "string:6", text("ZABA01", "ZCBC07")),
        Row("language", "uint16", constant(0, 1)), *empty(1),
        Row("start voltage", "uint16", constant(1500, 2500)),
        Row("start time", "uint16", constant(60, 300)),
        *several(2, "restart", "uint16", constant(60, 300, 9)),
        Row("unused power", "uint16", constant(0)), *empty(1),
        Row("serial number", "string:10", text("BQE#E##0##", "NTCE8#####")),
        Row("model code bits", "uint32", bits(32, 0.3)),
        Row("address", "uint16", between(1, 8)),
        *several(2, "flash", "uint16", constant(0, 1)), *empty(10),
        Row("year", "uint16", clock(lambda at: at.year)),
        Row("month", "uint16", clock(lambda at: at.month)),
        Row("day", "uint16", clock(lambda at: at.day)),
        Row("hour", "uint16", clock(lambda at: at.hour)),
        Row("minute", "uint16", clock(lambda at: at.minute)),
        Row("second", "uint16", clock(lambda at: at.second)),
        Row("weekday", "uint16", clock(lambda at: at.isoweekday() % 7)),
        Row("lowest voltage", "uint16", constant(1840, 3180)),
        Row("highest voltage", "uint16", constant(2645, 4570)),
        Row("lowest frequency", "uint16", constant(4750)),
        Row("highest frequency", "uint16", constant(5150)),
    ]  # fmt: skip


def sunspec_integer() -> list[Row]:
    """The points of SunSpec model 103, as Fronius and SolarEdge have them, without its header."""
    return [
        Row("current", "uint16", near(2310, 900, 30, idle=0, low=0)),
        *several(3, "current of a phase", "uint16", near(770, 300, 9, idle=0, low=0)),
        Row("scale of current", "int16", constant(-2)),
        *several(3, "voltage between phases", "uint16", near(4010, 40, 5)),
        *several(3, "voltage", "uint16", GRID),
        Row("scale of voltage", "int16", constant(-1)),
        Row("active power", "int16", near(5200, 2500, 60, idle=0)),
        Row("scale of power", "int16", constant(0, -1, 1)),
        Row("frequency", "uint16", HERTZ),
        Row("scale of frequency", "int16", constant(-2)),
        Row("apparent power", "int16", near(5300, 2500, 60, idle=0)),
        Row("scale of apparent power", "int16", constant(0, -1, 1)),
        Row("reactive power", "int16", near(-90, 200, 9, idle=0)),
        Row("scale of reactive power", "int16", constant(0, -1, 1)),
        Row("power factor", "int16", near(-9980, 30, 5, idle=0)),
        Row("scale of power factor", "int16", constant(-2, -4)),
        Row("energy", "uint32", counter(1e5, 9e7, 2)),
        Row("scale of energy", "int16", constant(0)),
        *empty(1, 0xFFFF), *empty(1, 0x8000),
        Row("voltage of modules", "uint16", near(6100, 800, 15, idle=0, low=0)),
        Row("scale of voltage", "int16", constant(-1)),
        Row("power of modules", "int16", near(5400, 2500, 60, idle=0)),
        Row("scale of power", "int16", constant(0, -1)),
        Row("cabinet temperature", "int16", near(402, 80, 2)), *empty(3, 0x8000),
        Row("scale of temperature", "int16", constant(-1)),
        Row("state", "uint16", constant(4, 4, 2)),
        Row("state of manufacturer", "uint16", constant(4, 5)),
        *several(2, "event bits", "uint32", bits(32, 0.02)),
        *empty(8, 0xFFFF),
    ]  # fmt: skip


def sunspec_float() -> list[Row]:
    """The points of SunSpec model 113, without its header."""
    return [
        Row("current", "float32", near(23, 9, 0.3, idle=0, low=0)),
        *several(3, "current of a phase", "float32", near(7.7, 3, 0.1, idle=0, low=0)),
        *several(3, "voltage between phases", "float32", near(401, 4, 0.5)),
        *several(3, "voltage", "float32", near(231, 3, 0.3)),
        Row("active power", "float32", near(5200, 2500, 60, idle=0)),
        Row("frequency", "float32", near(50, 0.02, 0.008)),
        Row("apparent power", "float32", near(5300, 2500, 60, idle=0)),
        Row("reactive power", "float32", near(-90, 200, 9, idle=0)),
        Row("power factor", "float32", near(-99.8, 0.3, 0.05, idle=0)),
        Row("energy", "float32", counter(1e5, 9e7, 2)),
        *several(2, "no value", "float32", constant(float("nan"))),
        Row("power of modules", "float32", near(5400, 2500, 60, idle=0)),
        Row("cabinet temperature", "float32", constant(float("nan"))),
        *several(3, "temperature", "float32", constant(float("nan"))),
        Row("state", "uint16", constant(4, 4, 2)),
        Row("state of manufacturer", "uint16", constant(4, 5)),
        *several(6, "event bits", "uint32", bits(32, 0.02)),
    ]


def kostal() -> list[Row]:
    """Kostal Plenticore, from 0: texts, then float32 with the low register first, with uint32."""
    return [
        Row("article number", "string:16", text("10335###", "10523###")),
        Row("serial number", "string:16", text("90######@#####", "95#####@########")),
        Row("strings", "uint16", constant(2, 3)),
        Row("phases", "uint16", constant(3)),
        Row("controller version", "string:16", text("01.45", "01.71")),
        Row("processor version", "string:16", text("01.71.05411", "01.46")),
        Row("state", "uint32", constant(6, 6, 10)),
        Row("power of modules", "float32", near(4200, 2200, 45, idle=0, low=0)),
        Row("controller state", "uint32", constant(0, 3)),
        *several(3, "use by the house", "float32", near(420, 300, 12, low=0)),
        *several(3, "energy used", "float32", counter(1e4, 3e7, 0.2)),
        Row("work hours", "float32", counter(1e5, 2e8, 1)),
        Row("power factor", "float32", near(0.99, 0.01, 0.002, idle=0)),
        Row("frequency", "float32", near(50, 0.02, 0.008)),
        *[row for _ in range(3) for row in _kostal_phase()],
        *several(2, "current of modules", "float32", near(6, 3, 0.1, idle=0, low=0)),
        *several(2, "voltage of modules", "float32", near(480, 90, 2, idle=0, low=0)),
        Row("energy of the day", "float32", counter(300, 50_000, 1)),
        Row("energy of the year", "float32", counter(1e5, 9e6, 1)),
        Row("total energy", "float32", counter(1e6, 9e7, 1)),
    ]


def _kostal_phase() -> list[Row]:
    return [
        Row("current", "float32", near(6, 3, 0.1, idle=0, low=0)),
        Row("active power", "float32", near(1400, 700, 20, idle=0)),
        Row("voltage", "float32", near(231, 3, 0.3)),
    ]


def deye() -> list[Row]:
    """Deye and Sunsynk, holding registers from 0: a full text, settings, counters word by word."""
    return [
        Row("device type bits", "uint16", constant(0x0500, 0x0003, 0x0006)),
        Row("address", "uint16", constant(1)),
        Row("protocol version", "uint16", constant(0x0104, 0x0102)),
        Row("serial number", "string:10", text("22########", "23########")),
        *empty(3),
        *several(4, "firmware version", "uint16", between(0x1000, 0x6000)),
        *empty(1),
        Row("rated power", "uint32", constant(80_000, 120_000)),
        Row("trackers bits", "uint16", constant(0x0203, 0x0201)),
        *empty(2),
        Row("year and month bits", "uint16", clock(lambda at: (at.year % 100) << 8 | at.month)),
        Row("day and hour bits", "uint16", clock(lambda at: at.day << 8 | at.hour)),
        Row("minute and second bits", "uint16", clock(lambda at: at.minute << 8 | at.second)),
        *several(3, "time of use", "uint16", constant(0, 500, 900, 1300, 1730, 2100)),
        *several(3, "power of a time", "uint16", constant(8000, 5000, 12_000)),
        *several(3, "charge of a time", "uint16", constant(20, 35, 100)),
        Row("active energy of the day", "int16", counter(3, 600, 0.01)),
        Row("reactive energy of the day", "int16", counter(1, 60, 0.001, never=0.5)),
        Row("total energy", "uint32", counter(100, 900_000, 0.01)),
        Row("total of battery", "uint32", counter(100, 90_000, 0.01)),
        Row("discharged in total", "uint32", counter(100, 90_000, 0.01)),
        Row("imported in total", "uint32", counter(100, 90_000, 0.01, never=0.2)),
        *several(2, "temperature", "uint16", near(1402, 50, 1)),
        *several(3, "voltage", "uint16", GRID),
        *several(3, "power", "int16", near(1200, 900, 25, idle=0)),
        Row("frequency", "uint16", HERTZ),
    ]


def solis() -> list[Row]:
    """Solis, input registers from 33000: versions, text, clock in six registers, energy."""
    return [
        Row("model code bits", "uint16", constant(0x2030, 0x2060)),
        Row("processor version bits", "uint16", constant(0x003D, 0x0017)),
        Row("display version bits", "uint16", constant(0x0032, 0x001A)),
        Row("protocol version", "uint16", constant(4, 5)),
        Row("serial number", "string:32", text("6031050########", "110CA21########")),
        *empty(2),
        Row("year", "uint16", clock(lambda at: at.year % 100)),
        Row("month", "uint16", clock(lambda at: at.month)),
        Row("day", "uint16", clock(lambda at: at.day)),
        Row("hour", "uint16", clock(lambda at: at.hour)),
        Row("minute", "uint16", clock(lambda at: at.minute)),
        Row("second", "uint16", clock(lambda at: at.second)),
        *empty(1),
        Row("total energy", "uint32", counter(10, 90_000, 0.001)),
        Row("energy of the month", "uint32", counter(5, 3000, 0.001)),
        Row("energy of the last month", "uint32", magnitude(50, 3000)),
        Row("energy of the day", "uint16", counter(3, 600, 0.01)),
        Row("energy of yesterday", "uint16", magnitude(30, 600)),
        Row("energy of the year", "uint32", counter(5, 9000, 0.001)),
        Row("energy of the last year", "uint32", magnitude(500, 9000)),
        *empty(2),
        *several(2, "voltage of modules", "uint16", near(3600, 700, 12, idle=0, low=0)),
        *several(2, "current of modules", "uint16", near(62, 30, 1.5, idle=0, low=0)),
        Row("power of modules", "uint32", near(4200, 2200, 45, idle=0, low=0)),
        Row("bus voltage", "uint16", near(3900, 200, 5)),
        *several(3, "voltage", "uint16", GRID),
        *several(3, "current", "uint16", near(66, 30, 1.5, idle=0, low=0)),
        Row("active power", "int32", near(4100, 2200, 45, idle=0)),
        Row("reactive power", "int32", near(-60, 150, 8, idle=0)),
        Row("temperature", "uint16", near(402, 70, 1)),
        Row("frequency", "uint16", HERTZ),
        Row("state", "uint16", constant(3, 3, 0, 15)),
        *several(3, "fault bits", "uint16", bits(16, 0.03)),
    ]


def victron() -> list[Row]:
    """Victron GX, service vebus from 3: int16, alarms, then uint32 energies."""
    return [
        Row("input voltage", "uint16", GRID), *empty(2),
        Row("input current", "int16", near(20, 60, 2)), *empty(2),
        Row("input frequency", "int16", HERTZ), *empty(2),
        Row("input power", "int16", near(50, 140, 3)), *empty(2),
        Row("output voltage", "uint16", GRID), *empty(2),
        Row("output current", "int16", near(38, 20, 1.5)), *empty(2),
        Row("output frequency", "int16", HERTZ),
        Row("current limit", "int16", constant(160, 250, 320)),
        Row("output power", "int16", near(80, 50, 2)), *empty(2),
        Row("battery voltage", "uint16", near(5280, 100, 2)),
        Row("battery current", "int16", near(-40, 300, 5, idle=0)),
        Row("phases", "uint16", constant(1, 3)),
        Row("active input", "uint16", constant(0, 1, 240)),
        Row("charge", "uint16", near(720, 200, 0, low=100)),
        Row("state", "uint16", constant(3, 5, 9, 252)),
        Row("error", "uint16", constant(0)),
        Row("mode", "uint16", constant(3)),
        *several(3, "alarm", "uint16", constant(0, 0, 0, 1)),
        Row("set point", "int16", near(-200, 900, 30, idle=0)),
        *several(2, "switch", "uint16", constant(0, 1)),
        *several(14, "alarm of a phase", "uint16", constant(0)),
        *several(5, "permission", "uint16", constant(0, 1)),
        Row("battery temperature", "int16", near(215, 40, 0)),
        *several(12, "state of a function", "uint16", constant(0, 1, 0)),
        *several(10, "energy", "uint32", counter(20, 900_000, 0.01, never=0.35)),
    ]  # fmt: skip


def battery() -> list[Row]:
    """A battery manager: cell voltages, temperatures, charge, limits, counters, protections."""
    return [
        *several(16, "cell voltage", "uint16", near(3312, 12, 1)),
        *several(4, "cell temperature", "int16", near(238, 30, 0.4)),
        Row("voltage", "uint16", near(5300, 60, 2)),
        Row("current", "int32", near(-2000, 9000, 60, idle=0)),
        Row("charge", "uint16", near(640, 250, 0, low=10)),
        Row("health", "uint16", near(990, 10, 0)),
        Row("remaining capacity", "uint16", near(18_000, 6000, 1, low=100)),
        Row("full capacity", "uint16", constant(28_000, 20_000, 30_400)),
        Row("cycles", "uint16", magnitude(2, 3000)),
        *several(2, "protection bits", "uint16", bits(16, 0.03)),
        Row("balancing bits", "uint16", bits(16, 0.15, toggles=True)),
        *several(2, "limit of current", "uint16", constant(1000, 2000, 500)),
        *several(2, "limit of voltage", "uint16", constant(5680, 4480, 5760)),
        Row("charged in total", "uint32", counter(50, 900_000, 0.02)),
        Row("serial number", "string:20", text("P16S200A#####-####", "LFP############")),
        Row("firmware version bits", "uint16", constant(0x0114, 0x0203, 0x1016)),
    ]

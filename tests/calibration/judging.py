"""The corpus that judges the confidence of guesses: devices as a scan of a plant finds them.

The maps follow the public register maps of real devices, shortened: which types, scales and orders
are next to each other (`maps`). The values have the magnitudes and the noise that such devices
have. Whoever changes the rules of inference must not look at the values of this corpus,
only at the tables of `benches/calibration.py`: a corpus to which rules are adjusted judges nothing.

`MAPS` has the weights: how many devices of each map are made. Of all values, a quarter is of meters
and a quarter of inverters and batteries, because these are what most people read; an eighth is of
buildings, a ninth of controllers; the rest is of gensets, drives, settings, chargers, inputs and
outputs, sensors, identities, power supplies and networks. Of the devices, 55 % measure and change,
15 % are idle but their clocks and mains voltages change, 15 % show the same values in all reads
although they work, and 15 % are idle and still. A quarter of the devices pads texts with blanks,
one in twelve swaps the bytes of its texts, and one in ten has lost its clock.

Some contents can't be told from others, even by somebody who knows the field: a uint32 counter
below 65,536 beside zeros, a device without a single value that changes. They are part of the
corpus, because a program that knows its limits says so with its confidence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from random import Random

from calibration.blocks import NATURAL, Device, Row, build
from calibration.cases import NOW, Case
from calibration.maps import buildings, inverters, machines, meters

SEED = 20251125

LOW_FIRST = ("CDAB",)
BOTH = ("ABCD", "CDAB")
ALL = ("CDAB", "DCBA", "BADC")
"""Orders of devices that are seldom met in the natural order."""

LOST_CLOCKS = (0.0, 946_684_800.0)
"""Where clocks begin that have lost the time: 1970 and 2000."""


@dataclass(frozen=True)
class Map:
    """A register map, and how many devices have it."""

    name: str
    kind: str
    rows: Callable[[], Sequence[Row]]
    devices: int
    orders: tuple[str, ...] = (NATURAL,)
    """The orders of its devices, in turn."""


MAPS = (
    Map("sdm630", "float meter", meters.sdm630, 6),
    Map("sdm230", "float meter", meters.sdm230, 5),
    Map("sdm settings", "settings", meters.sdm_settings, 3),
    Map("janitza", "float meter", meters.janitza, 5),
    Map("pac", "float meter", meters.pac, 4),
    Map("pac energy", "float meter", meters.pac_energy, 3),
    Map("pm5000 identity", "identity", meters.pm5000_identity, 3),
    Map("pm5000", "float meter", meters.pm5000, 4),
    Map("dtsu666", "float meter", meters.dtsu666, 3),
    Map("analyser", "float meter", meters.analyser, 6, ALL),
    Map("b23", "integer meter", meters.b23, 4),
    Map("b23 energy", "integer meter", meters.b23_energy, 3),
    Map("em24", "integer meter", meters.em24, 6, LOW_FIRST),
    Map("orno", "integer meter", meters.orno, 5, BOTH),
    Map("pzem", "integer meter", meters.pzem, 4, LOW_FIRST),
    Map("heat meter", "integer meter", meters.heat_meter, 4, BOTH),
    Map("pulses", "integer meter", meters.pulses, 4, BOTH),
    Map("dl645", "integer meter", meters.dl645, 2),
    Map("wireless gateway", "sensor", meters.wireless_gateway, 2),
    Map("huawei identity", "identity", inverters.huawei_identity, 4),
    Map("huawei", "inverter", inverters.huawei, 5),
    Map("sma", "inverter", inverters.sma, 4),
    Map("sungrow", "inverter", inverters.sungrow, 4, LOW_FIRST),
    Map("sungrow hybrid", "inverter", inverters.sungrow_hybrid, 4, LOW_FIRST),
    Map("goodwe", "inverter", inverters.goodwe, 4),
    Map("goodwe identity", "identity", inverters.goodwe_identity, 3),
    Map("solax", "inverter", inverters.solax, 3, LOW_FIRST),
    Map("solax settings", "settings", inverters.solax_settings, 3),
    Map("growatt", "inverter", inverters.growatt, 4),
    Map("growatt settings", "settings", inverters.growatt_settings, 4),
    Map("sunspec integer", "inverter", inverters.sunspec_integer, 4),
    Map("sunspec float", "inverter", inverters.sunspec_float, 3),
    Map("kostal", "inverter", inverters.kostal, 3, LOW_FIRST),
    Map("deye", "inverter", inverters.deye, 3, LOW_FIRST),
    Map("solis", "inverter", inverters.solis, 3),
    Map("victron", "inverter", inverters.victron, 4),
    Map("battery", "inverter", inverters.battery, 3, BOTH),
    Map("danfoss", "drive", machines.danfoss, 3),
    Map("abb drive", "drive", machines.abb_drive, 4),
    Map("altivar", "drive", machines.altivar, 3),
    Map("sew", "drive", machines.sew, 3, BOTH),
    Map("wago", "inputs and outputs", machines.wago, 4, LOW_FIRST),
    Map("wago identity", "identity", machines.wago_identity, 2),
    Map("analog module", "inputs and outputs", machines.analog_module, 3),
    Map("thermometers", "inputs and outputs", machines.thermometers, 3),
    Map("s7 block", "controller", machines.s7_block, 6),
    Map("iec variables", "controller", machines.iec_variables, 6, (*BOTH, *ALL)),
    Map("m340", "controller", machines.m340, 4, LOW_FIRST),
    Map("set points", "settings", machines.set_points, 4, BOTH),
    Map("omron", "controller", machines.omron, 3, LOW_FIRST),
    Map("histogram", "controller", machines.histogram, 3, BOTH),
    Map("loops", "controller", machines.controllers, 3),
    Map("deep sea", "genset", machines.deep_sea, 4),
    Map("comap", "genset", machines.comap, 3),
    Map("deif", "genset", machines.deif, 3),
    Map("nilan", "building", buildings.nilan, 3),
    Map("systemair", "building", buildings.systemair, 3),
    Map("stiebel", "building", buildings.stiebel, 4),
    Map("stiebel energy", "building", buildings.stiebel_energy, 3),
    Map("nibe", "building", buildings.nibe, 4, LOW_FIRST),
    Map("idm", "building", buildings.idm, 3, LOW_FIRST),
    Map("komfovent", "building", buildings.komfovent, 3),
    Map("thermostat", "building", buildings.thermostat, 4),
    Map("weather", "sensor", buildings.weather, 3, BOTH),
    Map("thies", "sensor", buildings.thies, 3),
    Map("air sensor", "sensor", buildings.air_sensor, 4),
    Map("apc", "power supply", buildings.apc, 3),
    Map("ups", "power supply", buildings.ups, 3),
    Map("alfen identity", "identity", buildings.alfen_identity, 3),
    Map("alfen", "charger", buildings.alfen, 4),
    Map("keba", "charger", buildings.keba, 3),
    Map("charger", "charger", buildings.charger, 3, BOTH),
    Map("network device", "network", buildings.network_device, 3, BOTH),
)


def cases(seed: int = SEED) -> list[Case]:
    """All blocks, the same for the same seed."""
    made = []
    for each in MAPS:
        for number in range(each.devices):
            chance = Random(f"{seed} {each.name} {number}")
            device = _device(chance, each.orders[number % len(each.orders)])
            made.append(build(f"{each.name} {number + 1}", each.kind, each.rows(), device))
    return made


def _device(chance: Random, order: str) -> Device:
    moves, idle = chance.choices(
        [(True, False), (True, True), (False, False), (False, True)], [55, 15, 15, 15]
    )[0]
    return Device(
        chance,
        order,
        moves,
        idle,
        refresh=chance.choice((1, 1, 2)),
        digits=chance.choice((None, None, None, 1, 2, 3)),
        padding=chance.choices("\0 ", [3, 1])[0],
        text_order=chance.choices((NATURAL, "BADC"), [11, 1])[0],
        clock_s=_clock(chance),
    )


def _clock(chance: Random) -> float:
    """The time of a device: mostly right, or that of a time zone, or wrong by days, or lost."""
    kind = chance.choices(("right", "zone", "wrong", "lost"), [55, 25, 10, 10])[0]
    if kind == "lost":
        return chance.choice(LOST_CLOCKS) + chance.uniform(1e4, 4e7)
    error = {"right": 90.0, "zone": 90.0, "wrong": 9e5}[kind]
    zone = chance.choice((3600, 7200)) if kind == "zone" else 0
    return NOW + zone + chance.uniform(-error, error)

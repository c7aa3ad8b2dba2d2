"""The classes of entities that Home Assistant knows, and which of them a tag can have.

They are those of Home Assistant 2026.2. An unknown word is passed on: a later version may have it.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from holdfast.runtime.suggestion import suggestion
from holdfast.runtime.text import either

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from holdfast.tags import Tag

_ENERGY = (
    *("mWh", "Wh", "kWh", "MWh", "GWh", "TWh", "J", "kJ", "MJ", "GJ"),
    *("cal", "kcal", "Mcal", "Gcal"),
)
_PRESSURE = (
    *("mPa", "Pa", "hPa", "kPa", "mbar", "cbar", "bar", "psi"),
    *("mmHg", "inHg", "inH₂O"),
)
_RAIN = ("mm/h", "mm/d", "in/h", "in/d")
_TEMPERATURE = ("°C", "°F", "K")
_VOLUME = ("L", "m³", "ft³", "CCF", "MCF")
_VOLUMES = (*_VOLUME, "mL", "gal", "fl. oz.")
_WIND = ("m/s", "km/h", "mm/s", "m/min", "in/s", "ft/s", "mph", "kn", "Beaufort")

_DATA = ("B", "kB", "MB", "GB", "TB", "PB", "EB", "ZB", "YB")
_UNITS: dict[str, tuple[str, ...]] = {
    "absolute_humidity": ("mg/m³", "g/m³"),
    "apparent_power": ("mVA", "VA", "kVA"),
    "aqi": (),
    "area": ("mm²", "cm²", "m²", "km²", "ha", "in²", "ft²", "yd²", "ac", "mi²"),
    "atmospheric_pressure": _PRESSURE,
    "battery": ("%",),
    "blood_glucose_concentration": ("mg/dL", "mmol/L"),
    "carbon_dioxide": ("ppm",),
    "carbon_monoxide": ("ppb", "ppm", "µg/m³", "mg/m³"),
    "conductivity": ("µS/cm", "mS/cm", "S/cm"),
    "current": ("mA", "A"),
    "data_rate": (
        *("bit/s", "kbit/s", "Mbit/s", "Gbit/s", "B/s", "kB/s", "MB/s", "GB/s"),
        *("KiB/s", "MiB/s", "GiB/s"),
    ),
    "data_size": (
        *("bit", "kbit", "Mbit", "Gbit", *_DATA),
        *("KiB", "MiB", "GiB", "TiB", "PiB", "EiB", "ZiB", "YiB"),
    ),
    "distance": ("mm", "cm", "m", "km", "in", "ft", "yd", "mi", "nmi"),
    "duration": ("µs", "ms", "s", "min", "h", "d"),
    "energy": _ENERGY,
    "energy_distance": ("Wh/km", "kWh/100km", "km/kWh", "mi/kWh"),
    "energy_storage": _ENERGY,
    "frequency": ("Hz", "kHz", "MHz", "GHz"),
    "gas": _VOLUME,
    "humidity": ("%",),
    "illuminance": ("lx",),
    "irradiance": ("W/m²", "BTU/(h⋅ft²)"),
    "moisture": ("%",),
    "nitrogen_dioxide": ("ppb", "µg/m³"),
    "nitrogen_monoxide": ("ppb", "µg/m³"),
    "nitrous_oxide": ("µg/m³",),
    "ozone": ("ppb", "µg/m³"),
    "ph": (),
    "pm1": ("µg/m³",),
    "pm10": ("µg/m³",),
    "pm25": ("µg/m³",),
    "pm4": ("µg/m³",),
    "power": ("mW", "W", "kW", "MW", "GW", "TW"),
    "power_factor": ("%",),
    "precipitation": ("mm", "cm", "in"),
    "precipitation_intensity": _RAIN,
    "pressure": _PRESSURE,
    "reactive_energy": ("varh", "kvarh"),
    "reactive_power": ("mvar", "var", "kvar"),
    "signal_strength": ("dB", "dBm"),
    "sound_pressure": ("dB", "dBA"),
    "speed": (*_WIND, *_RAIN),
    "sulphur_dioxide": ("ppb", "µg/m³"),
    "temperature": _TEMPERATURE,
    "temperature_delta": _TEMPERATURE,
    "volatile_organic_compounds": ("µg/m³", "mg/m³"),
    "volatile_organic_compounds_parts": ("ppb", "ppm"),
    "voltage": ("µV", "mV", "V", "kV", "MV"),
    "volume": _VOLUMES,
    "volume_flow_rate": (
        *("mL/s", "L/s", "L/min", "L/h", "m³/s", "m³/min", "m³/h"),
        *("ft³/min", "gal/min", "gal/h", "gal/d"),
    ),
    "volume_storage": _VOLUMES,
    "water": (*_VOLUME, "gal"),
    "weight": ("µg", "mg", "g", "kg", "oz", "lb", "st"),
    "wind_direction": ("°",),
    "wind_speed": _WIND,
}
"""Device classes of numbers, with the units that they can have."""

_SUGGESTED = {
    unit: device_class
    for device_class, units in {
        "apparent_power": ("VA",),
        "current": ("A", "mA"),
        "data_rate": ("bit/s", "kbit/s", "Mbit/s"),
        "energy": ("Wh", "kWh", "MWh", "GWh", "J", "kJ", "MJ", "GJ"),
        "frequency": ("Hz", "kHz", "MHz", "GHz"),
        "illuminance": ("lx",),
        "irradiance": ("W/m²",),
        "power": ("W", "kW", "MW", "GW"),
        "pressure": ("Pa", "hPa", "kPa", "bar", "mbar", "psi"),
        "reactive_power": ("var",),
        "speed": ("m/s", "km/h", "mm/s"),
        "temperature": ("°C", "°F", "K"),
        "voltage": ("V", "mV", "kV"),
        "volume_flow_rate": ("m³/h", "L/min"),
        "weight": ("kg", "g"),
    }.items()
    for unit in units
}
"""The device class of a unit that has only one, in all versions: they refuse an entity whose class
or unit they don't know."""

NUMBERS = frozenset(_UNITS) | {"monetary"}
TEXTS = frozenset(("date", "timestamp"))
SWITCHES = frozenset(("outlet", "switch"))
BINARY_SENSORS = frozenset(
    (
        *("battery", "battery_charging", "carbon_monoxide", "cold", "connectivity", "door"),
        *("garage_door", "gas", "heat", "light", "lock", "moisture", "motion", "moving"),
        *("occupancy", "opening", "plug", "power", "presence", "problem", "running", "safety"),
        *("smoke", "sound", "tamper", "update", "vibration", "window"),
    )
)
_DEVICE_CLASSES = NUMBERS | TEXTS | SWITCHES | BINARY_SENSORS | {"enum"}

MEASUREMENT, ANGLE, TOTAL = "measurement", "measurement_angle", "total"
TOTAL_INCREASING = "total_increasing"
_STATE_CLASSES = (MEASUREMENT, ANGLE, TOTAL, TOTAL_INCREASING)

KNOWN: dict[str, Collection[str]] = {
    "device_class": _DEVICE_CLASSES,
    "state_class": _STATE_CLASSES,
}
"""The words of each key of a tag. A later version of Home Assistant may have more."""

_METERS = ("energy", "gas", "reactive_energy", "volume", "water")
"""What only totals have: a meter counts it, which only falls when it begins again."""

_COUNTED = ("area", "distance", "duration", "precipitation", "weight")
"""What can be a total, too."""

_SPELLINGS = {
    **dict.fromkeys(("VAR", "VAr", "Var"), "var"),
    **dict.fromkeys(("VARh", "VArh", "Varh"), "varh"),
    **dict.fromkeys(("kVAR", "kVAr", "kVar", "KVAR"), "kvar"),
    **dict.fromkeys(("kVARh", "kVArh", "kVarh", "KVARh"), "kvarh"),
    **{unit.replace("L", "l"): unit for unit in ("L", "mL", "mL/s", "L/s", "L/min", "L/h")},
    **{unit.replace("³", "3"): unit for unit in ("m³", "m³/s", "m³/min", "m³/h")},
    "W/m2": "W/m²",
    # All versions take the sign for micro, only newer ones the Greek letter.
    **{
        unit.replace("\N{MICRO SIGN}", "\N{GREEK SMALL LETTER MU}"): unit
        for units in _UNITS.values()
        for unit in units
        if "\N{MICRO SIGN}" in unit
    },
}
"""How Home Assistant spells a unit. M is never m: `Mvar` is not `mvar`."""


def is_class_word(text: str) -> bool:
    """Whether a text can be a class of any version."""
    return re.fullmatch(r"[a-z][a-z0-9_]*", text) is not None


def unit_of(tag: Tag) -> str:
    """The unit of an entity. If the tag names a class, it is spelled as Home Assistant does."""
    return _spelled(tag.unit) if tag.device_class else tag.unit


def _spelled(unit: str) -> str:
    return _SPELLINGS.get(unit, unit)


def of_number(tag: Tag) -> tuple[str, str]:
    """The device class (or an empty text) and the state class of a number.

    Those that it does not name follow from its unit, and from the one that it names.
    """
    device_class = tag.device_class if takes(NUMBERS, tag.device_class) else ""
    if not device_class:
        device_class = _SUGGESTED.get(tag.unit, "")
        # A class with a state class that it can't have would be the wrong one.
        if tag.state_class and not _may_be(tag.state_class, device_class):
            device_class = ""
    return device_class, tag.state_class or _usual_state_class(device_class)


def _usual_state_class(device_class: str) -> str:
    if device_class in _METERS:
        return TOTAL_INCREASING
    return {"monetary": TOTAL, "wind_direction": ANGLE}.get(device_class, MEASUREMENT)


def _may_be(state_class: str, device_class: str) -> bool:
    is_total = state_class in (TOTAL, TOTAL_INCREASING)
    return device_class in _COUNTED or is_total == (device_class in _METERS)


def takes(known: Collection[str], device_class: str) -> bool:
    """Whether an entity whose classes are `known` can have a class: one of them, or a new one."""
    return device_class in known or device_class not in _DEVICE_CLASSES


def is_on_or_off(tag: Tag) -> bool:
    """Whether a tag is a switch or a binary sensor."""
    return set(tag.states.values()) == {"on", "off"} or tag.of_type.base in ("bool", "bit")


def flaws(tag: Tag) -> Iterator[tuple[str, str]]:
    """Classes that have no effect, or with which Home Assistant refuses the entity: key and why."""
    if tag.device_class and (flaw := _flaw_of_device_class(tag, tag.device_class)):
        yield "device_class", flaw
    if tag.state_class and (flaw := _flaw_of_state_class(tag, tag.state_class)):
        yield "state_class", flaw


def _flaw_of_device_class(tag: Tag, word: str) -> str | None:
    if word not in _DEVICE_CLASSES:
        return _unknown("device_class", word)
    kind, known = _kind(tag)
    if word not in known:
        return f"{word} has no effect: it is no class of {kind}"
    unit, units = _spelled(tag.unit), _UNITS.get(word)
    if kind != "numbers" or not unit or units is None or unit in units:
        return None
    allowed = either(units) if units else "none"
    return f"{_refused(word, tag.unit)}, allowed: {allowed}"


def _flaw_of_state_class(tag: Tag, word: str) -> str | None:
    if word not in _STATE_CLASSES:
        return _unknown("state_class", word)
    kind, _ = _kind(tag)
    if kind != "numbers":
        return f"{word} has no effect: only numbers have a state class"
    if word == ANGLE and tag.unit != "°":
        return f"{_refused(word, tag.unit)}, allowed: °"
    return None


def _refused(word: str, unit: str) -> str:
    return f"Home Assistant refuses {word} with the unit {unit!r} over MQTT"


def _unknown(key: str, word: str) -> str:
    unknown = f"{word!r} is unknown here: Home Assistant refuses an entity if it is unknown there"
    return f"{unknown}{suggestion(word, sorted(KNOWN[key]))}"


def _kind(tag: Tag) -> tuple[str, Collection[str]]:
    """What a tag is to Home Assistant, and the device classes for that."""
    if tag.of_type.count is not None or tag.of_type.base == "bytes":
        return "arrays and bytes", ()
    if is_on_or_off(tag):
        return "bits", BINARY_SENSORS | SWITCHES
    if tag.states:
        return "states", ("enum",)
    return ("numbers", NUMBERS) if tag.is_number else ("texts", TEXTS)

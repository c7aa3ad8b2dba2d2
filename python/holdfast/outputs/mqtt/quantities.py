"""What a unit says about a value, in the words of Home Assistant.

Units that stand for several quantities, such as % and m³, have no device class.
"""

from __future__ import annotations

MEASUREMENT, TOTAL = "measurement", "total_increasing"

_DEVICE_CLASSES = {
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
}
_OF_UNIT = {unit: name for name, units in _DEVICE_CLASSES.items() for unit in units}


def classes(unit: str) -> tuple[str | None, str]:
    """The device class and the state class of a unit.

    Energy is what a meter counts: it only falls when the meter begins again.
    """
    device_class = _OF_UNIT.get(unit)
    return device_class, TOTAL if device_class == "energy" else MEASUREMENT

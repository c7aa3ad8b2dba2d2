"""Discovery messages, read as strictly as Home Assistant documents them.

Unknown keys, wrong types, and combinations that Home Assistant warns of are errors.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from typing import Any

TOPIC = re.compile(r"homeassistant/(\w+)/([a-zA-Z0-9_-]+)/([a-zA-Z0-9_-]+)/config")

COMMON: dict[str, type | tuple[type, ...]] = {
    "name": str,
    "unique_id": str,
    "entity_category": str,
    "state_topic": str,
    "value_template": str,
    "availability": list,
    "availability_mode": str,
    "device": dict,
    "origin": dict,
}
OWN: dict[str, dict[str, type | tuple[type, ...]]] = {
    "sensor": {
        "device_class": str,
        "options": list,
        "state_class": str,
        "unit_of_measurement": str,
    },
    "binary_sensor": {"device_class": str, "payload_on": str, "payload_off": str},
    "switch": {
        "command_topic": str,
        "device_class": str,
        "payload_on": str,
        "payload_off": str,
        "state_on": str,
        "state_off": str,
    },
    "select": {"command_topic": str, "options": list},
    "number": {
        "command_topic": str,
        "device_class": str,
        "unit_of_measurement": str,
        "min": (int, float),
        "max": (int, float),
        "step": (int, float),
        "mode": str,
    },
}
REQUIRED = {
    "sensor": {"state_topic"},
    "binary_sensor": {"state_topic"},
    "switch": {"command_topic"},
    "select": {"command_topic", "options"},
    "number": {"command_topic"},
}
UNITS = {
    "apparent_power": {"mVA", "VA", "kVA"},
    "battery": {"%"},
    "conductivity": {"µS/cm", "mS/cm", "S/cm"},
    "current": {"A", "mA"},
    "data_rate": {"bit/s", "kbit/s", "Mbit/s", "Gbit/s", "B/s", "kB/s", "MB/s", "GB/s"},
    "distance": {"km", "m"},
    "duration": {"d", "h", "min", "s", "ms"},
    "energy_storage": {"kWh"},
    "energy": {"Wh", "kWh", "MWh", "GWh", "TWh", "mWh", "J", "kJ", "MJ", "GJ"},
    "frequency": {"Hz", "kHz", "MHz", "GHz"},
    "illuminance": {"lx"},
    "irradiance": {"W/m²"},
    "power": {"mW", "W", "kW", "MW", "GW", "TW"},
    "pressure": {"Pa", "hPa", "kPa", "bar", "cbar", "mbar", "mmHg", "inHg", "psi"},
    "reactive_energy": {"varh", "kvarh"},
    "reactive_power": {"mvar", "var", "kvar"},
    "speed": {"m/s", "km/h", "mm/s", "mm/h", "mm/d"},
    "temperature": {"°C", "°F", "K"},
    "voltage": {"µV", "mV", "V", "kV", "MV"},
    "volume_flow_rate": {"m³/h", "m³/s", "L/h", "L/min", "L/s", "mL/s"},
    "water": {"m³", "L"},
    "weight": {"µg", "mg", "g", "kg"},
    "wind_direction": {"°"},
}
"""The units of each device class that outputs use."""


DEVICE = {
    "identifiers",
    "name",
    "manufacturer",
    "model",
    "sw_version",
    "configuration_url",
    "via_device",
}
"""The keys of a device that outputs use."""


@dataclass(frozen=True)
class Entity:
    """An entity, as Home Assistant would add it."""

    component: str
    node: str
    config: dict[str, Any]

    def shown(self, payload: bytes) -> str:
        """The state that a message brings.

        The templates of outputs are Jinja, and but for three words also Python.
        """
        template = self.config["value_template"]
        found = re.fullmatch(r"\{\{ (.*) \}\}", template)
        assert found is not None, template
        code = re.sub(r"\bnone\b", "None", found[1])
        code = re.sub(r"\btrue:", "True:", re.sub(r"\bfalse:", "False:", code))
        text = payload.decode()
        try:
            value_json = json.loads(text)
        except ValueError:
            value_json = None
        names = {"value": text, "value_json": value_json, "float": float}
        return str(eval(code, {"__builtins__": {}}, names))


def entity(topic: str, payload: bytes) -> Entity:
    """Parses a discovery message. Fails if Home Assistant would not take it, or warn of it."""
    found = TOPIC.fullmatch(topic)
    assert found is not None, f"not a discovery topic: {topic}"
    component = found[1]
    config = json.loads(payload)
    known = COMMON | OWN[component]
    for key, value in config.items():
        assert key in known, f"{component} has no {key}"
        assert isinstance(value, known[key]), f"{key} is {value!r}"
        assert not isinstance(value, bool)
    assert REQUIRED[component] <= config.keys(), topic
    for key in config:
        if key.endswith("_topic"):
            assert not set(config[key]) & set("+#"), key
    assert config.get("availability_mode", "latest") in ("all", "any", "latest")
    for each in config.get("availability", ()):
        assert each.keys() <= {"topic", "payload_available", "payload_not_available"}
        assert isinstance(each["topic"], str)
    device = config["device"]
    assert device.keys() <= DEVICE
    assert device["identifiers"], "a device needs identifiers or connections"
    assert re.fullmatch(
        r"(?:https?|homeassistant)://\S+", device.get("configuration_url", "http://a")
    )
    assert config.get("entity_category", "config") in ("config", "diagnostic")
    assert config["origin"].keys() <= {"name", "sw_version", "support_url"}
    assert config["origin"]["name"]
    _check_class(config, component)
    if component == "number":
        assert config["min"] < config["max"]
        assert config["step"] >= 0.001
        assert config["mode"] in ("auto", "box", "slider")
    if "options" in config:
        assert config["options"]
        assert len(set(config["options"])) == len(config["options"])
    return Entity(component, found[2], config)


def _check_class(config: dict[str, Any], component: str) -> None:
    device_class, unit = config.get("device_class"), config.get("unit_of_measurement")
    if device_class == "enum":
        assert component == "sensor"
        assert unit is None
        assert "state_class" not in config
        assert config["options"]
        return
    assert component == "select" or "options" not in config
    if component in ("binary_sensor", "switch"):
        classes = {"binary_sensor": ("connectivity", "door"), "switch": ("outlet",)}
        assert device_class is None or device_class in classes[component]
        return
    if device_class == "timestamp":
        assert (component, unit, config.get("state_class")) == ("sensor", None, None)
        return
    if device_class is not None:
        assert unit in UNITS[device_class], f"{device_class} in {unit}"
    state_class = config.get("state_class")
    known = (None, "measurement", "measurement_angle", "total", "total_increasing")
    assert state_class in known
    assert state_class != "measurement_angle" or unit == "°"
    if device_class in ("energy", "reactive_energy", "water"):
        assert state_class in (None, "total", "total_increasing")
    if device_class == "energy_storage":
        assert state_class in (None, "measurement")

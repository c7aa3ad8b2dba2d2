"""`holdfast import home-assistant`: what hubs and entities of Home Assistant become."""

from __future__ import annotations

import os
import struct
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from holdfast.cli import main
from holdfast.config import ConfigError, load
from holdfast.config.text.problems import ConfigNotAnswered
from holdfast.importing import NotImportable, read_home_assistant
from holdfast.runtime import bounded_files
from holdfast.values import decode, register_count

if TYPE_CHECKING:
    from collections.abc import Callable

    from holdfast.importing import Imported

HUB = """\
default_config:
automation: !include automations.yaml
modbus:
  - name: inverter
    type: tcp
    host: 192.168.1.50
    port: 502
    {entities}
"""


@pytest.fixture
def imported(tmp_path: Path) -> Callable[..., Imported]:
    def read(entities: str, hub: str = HUB) -> Imported:
        file = tmp_path / "configuration.yaml"
        file.write_text(hub.replace("{entities}", entities), encoding="utf-8")
        found = read_home_assistant(file)
        result = tmp_path / "plant.yaml"
        result.write_text(found.to_yaml(), encoding="utf-8")
        load(result)
        return found

    return read


def tags(found: Imported, device: str = "inverter") -> dict[str, Any]:
    entries: dict[str, Any] = found.data["devices"][device]["tags"]
    return entries


def notes(found: Imported) -> list[str]:
    return [f"{note.line}: {note.key}: {note.kind}: {note.message}" for note in found.notes]


def test_a_sensor_becomes_a_tag(imported: Callable[..., Imported]) -> None:
    found = imported(
        "sensors: [{name: Grid Power, slave: 3, address: 5016, input_type: input, swap: word, "
        "data_type: uint32, scale: 0.1, offset: '-5', unit_of_measurement: W, "
        "scan_interval: 5, nan_value: '0xFFFFFFFF', device_class: power}]"
    )
    assert found.data["devices"] == {
        "inverter": {
            "url": "tcp://192.168.1.50:502",
            "unit": 3,
            "interval": 5,
            "timeout": 3,
            "max_gap": 0,
            "tags": {
                "grid_power": {
                    "area": "input_registers",
                    "address": 5016,
                    "type": "uint32",
                    "order": "CDAB",
                    "scale": 0.1,
                    "offset": -5,
                    "unit": "W",
                    "null": [4294967295],
                    "device_class": "power",
                    "description": "Grid Power",
                }
            },
        }
    }
    assert found.data["outputs"]["home"] == {
        "type": "mqtt",
        "url": "mqtt://homeassistant.local",
        "discovery": "homeassistant",
    }


def classes(found: Imported) -> dict[str, tuple[str | None, str | None]]:
    of = tags(found).items()
    return {name: (tag.get("device_class"), tag.get("state_class")) for name, tag in of}


def test_classes_are_those_of_the_source(imported: Callable[..., Imported]) -> None:
    found = imported(
        "sensors: [{name: stored, address: 1, unit_of_measurement: kWh, "
        "device_class: ENERGY_STORAGE, state_class: measurement}, "
        "{name: water, address: 2, unit_of_measurement: m³, device_class: water, "
        "state_class: total_increasing, virtual_count: 1}, "
        "{name: q, address: 4, unit_of_measurement: kVArh, device_class: reactive_energy}, "
        "{name: newer, address: 5, device_class: of_later_version}]\n"
        "    binary_sensors: [{name: door, address: 1, device_class: door}]\n"
        "    switches: [{name: plug, address: 9, device_class: outlet}]"
    )
    assert classes(found) == {
        "stored": ("energy_storage", "measurement"),
        "water": ("water", "total_increasing"),
        "water_1": ("water", "total_increasing"),
        "q": ("reactive_energy", None),
        "newer": ("of_later_version", None),
        "door": ("door", None),
        "plug": ("outlet", None),
    }
    assert not [note for note in notes(found) if "_class" in note]


def test_classes_with_which_no_entity_would_appear_are_left_out(
    imported: Callable[..., Imported],
) -> None:
    found = imported(
        "sensors: [{name: c, address: 1, unit_of_measurement: C, device_class: temperature}, "
        "{name: text, address: 2, data_type: string, count: 2, state_class: measurement}, "
        "{name: angle, address: 4, state_class: measurement_angle}, "
        "{name: number, address: 5, device_class: 5}, "
        "{name: words, address: 6, device_class: power factor}]"
    )
    assert set(classes(found).values()) == {(None, None)}
    left_out = [note for note in notes(found) if "_class: left out: " in note]
    assert [note.partition("left out: ")[2] for note in left_out] == [
        "Home Assistant refuses temperature with the unit 'C' over MQTT, allowed: °C, °F or K",
        "measurement has no effect: only numbers have a state class",
        "Home Assistant refuses measurement_angle with the unit '' over MQTT, allowed: °",
        "found 5, which is no class of Home Assistant",
        "found 'power factor', which is no class of Home Assistant",
    ]


TYPES = {"int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q"}
SWAPS = (None, "byte", "word", "word_byte")


@given(
    kind=st.sampled_from([*TYPES, "float16", "float32", "float64"]),
    swap=st.sampled_from(SWAPS),
    data=st.binary(min_size=8, max_size=8),
)
def test_each_type_and_order_has_the_value_that_the_source_had(
    tmp_path_factory: pytest.TempPathFactory, kind: str, swap: str | None, data: bytes
) -> None:
    code = {**TYPES, "float16": "e", "float32": "f", "float64": "d"}[kind]
    size = struct.calcsize(f">{code}")
    if size == 2 and swap in ("word", "word_byte"):
        swap = "byte"
    registers = [int.from_bytes(data[at : at + 2], "big") for at in range(0, size, 2)]
    swapped = [int.from_bytes(each.to_bytes(2, "big"), "little") for each in registers]
    given_order = swapped if swap in ("byte", "word_byte") else registers
    if swap in ("word", "word_byte"):
        given_order = given_order[::-1]
    [expected] = struct.unpack(f">{code}", b"".join(r.to_bytes(2, "big") for r in given_order))
    more = f", swap: {swap}" if swap else ""
    file = tmp_path_factory.mktemp("import") / "modbus.yaml"
    entity = f"{{name: x, address: 1, data_type: {kind}{more}}}"
    file.write_text(HUB.replace("{entities}", f"sensors: [{entity}]"))
    tag = tags(read_home_assistant(file))["x"]
    found = decode(registers, tag["type"], tag.get("order", "ABCD"))
    assert found == expected or (found != found and expected != expected)


@pytest.mark.parametrize(
    ("structure", "count", "kind", "order"),
    [
        (">f", 2, "float32", None),
        ("!d", 4, "float64", None),
        ("<i", 2, "int32", "DCBA"),
        ("h", 1, "int16", "DCBA"),
        (">l", 2, "int32", None),
        ("@L", 4, "uint64", "DCBA"),
        (">8s", 4, "string:8", None),
    ],
)
def test_a_structure_of_one_kind_is_a_type(
    imported: Callable[..., Imported], structure: str, count: int, kind: str, order: str | None
) -> None:
    entity = f"name: x, address: 1, data_type: custom, structure: '{structure}', count: {count}"
    tag = tags(imported(f"sensors: [{{{entity}}}]"))["x"]
    assert (tag["type"], tag.get("order")) == (kind, order)


@pytest.mark.parametrize(
    ("structure", "swap"), [(">3H", "none"), ("<2i", "none"), (">2f", "none"), (">2h", "byte")]
)
def test_each_value_of_a_structure_is_a_sensor(
    imported: Callable[..., Imported], structure: str, swap: str
) -> None:
    data = bytes(range(0x41, 0x41 + struct.calcsize(structure)))
    registers = [int.from_bytes(data[at : at + 2], "big") for at in range(0, len(data), 2)]
    received = [int.from_bytes(each.to_bytes(2, "big"), "little") for each in registers]
    swapped = b"".join(each.to_bytes(2, "big") for each in received)
    expected = struct.unpack(structure, swapped if swap == "byte" else data)
    found = imported(
        f"sensors: [{{name: x, address: 20, data_type: custom, structure: '{structure}', "
        f"count: {len(registers)}, swap: {swap}, unit_of_measurement: V, nan_value: 7}}]"
    )
    values = []
    for tag in tags(found).values():
        assert (tag["unit"], 7 in tag["null"]) == ("V", True)
        of_tag = registers[tag["address"] - 20 :][: register_count(tag["type"])]
        values.append(decode(of_tag, tag["type"], tag.get("order", "ABCD")))
    assert tuple(values) == expected
    assert list(tags(found)) == ["x", "x_1", "x_2"][: len(expected)]
    message = "changed: a sensor for each value; the source had one text"
    assert f"8: modbus[0].sensors[0]: {message}" in notes(found)


def test_a_number_is_written_within_its_limits(imported: Callable[..., Imported]) -> None:
    found = imported(
        "numbers: [{name: Setpoint, address: 10, slave: 1, scale: 0.1, offset: 2, min_value: 5, "
        "max_value: 30, step: 0.5, unit_of_measurement: °C, write_type: holdings}, "
        "{name: Level, address: 11, slave: 1, data_type: float32, swap: word}]"
    )
    place = {"area": "holding_registers", "writable": True}
    assert tags(found) == {
        "setpoint": place
        | {"address": 10, "type": "int16", "scale": 0.1, "offset": 2, "unit": "°C"}
        | {"min": 5, "max": 30, "round": "nearest", "description": "Setpoint"},
        "level": place
        | {"address": 11, "type": "float32", "order": "CDAB", "min": 0, "max": 100}
        | {"description": "Level"},
    }
    device = found.data["devices"]["inverter"]
    assert device["url"] == "tcp://192.168.1.50:502?write_multiple=1"
    assert [note for note in notes(found) if "left out" in note] == [
        "8: modbus[0].numbers[0].step: left out: the step is the scale"
    ]


def test_a_structure_of_several_kinds_is_left_out(imported: Callable[..., Imported]) -> None:
    found = imported(
        "sensors: [{name: x, address: 1, data_type: custom, structure: '>hf', count: 3, scale: 2}, "
        "{name: y, address: 9}]"
    )
    assert list(tags(found)) == ["y"]
    message = "left out: x has the structure '>hf', which is no type here: add a tag for each value"
    assert [note for note in notes(found) if "left out" in note] == [
        f"8: modbus[0].sensors[0]: {message}"
    ]


def test_an_entity_with_a_scale_of_0_is_left_out(imported: Callable[..., Imported]) -> None:
    found = imported(
        "sensors: [{name: x, address: 1, scale: 0, unit_of_measurement: W, virtual_count: 2}, "
        "{name: text, address: 2, data_type: string, count: 2, scale: 0}]\n"
        "    climates:\n"
        "      - {name: y, address: 3, target_temp_register: 4, current_temp_scale: 0, scale: 2}\n"
        "      - {name: z, address: 5, target_temp_register: 6, target_temp_scale: 0, "
        "hvac_onoff_coil: 7}"
    )
    assert list(tags(found)) == ["text", "z_power"]
    message = "has a scale of 0, with which all numbers are one value: add a tag"
    assert [note for note in notes(found) if "left out" in note] == [
        f"8: modbus[0].sensors[0]: left out: x {message}",
        "8: modbus[0].sensors[1].scale: left out: a text has none",
        f"10: modbus[0].climates[0]: left out: y {message}",
        f"11: modbus[0].climates[1]: left out: z {message}",
    ]


def test_types_of_former_versions(imported: Callable[..., Imported]) -> None:
    found = imported(
        "sensors: [{name: a, address: 1, data_type: uint, count: 2, reverse_order: true}, "
        "{name: b, address: 3, data_type: float, count: 4}, {name: c, address: 7, data_type: int}]"
    )
    assert [tag["type"] for tag in tags(found).values()] == ["uint32", "float64", "int16"]
    assert tags(found)["a"]["order"] == "CDAB"


def test_sensors_that_follow_the_first_have_the_next_registers(
    imported: Callable[..., Imported],
) -> None:
    found = imported(
        "sensors: [{name: Phase, address: 100, data_type: float32, virtual_count: 2}]\n"
        "    binary_sensors: [{name: Bit, address: 5, slave_count: 1}, "
        "{name: Register, address: 9, input_type: holding}]"
    )
    places = {name: (tag["area"], tag["address"]) for name, tag in tags(found).items()}
    assert places == {
        "phase": ("holding_registers", 100),
        "phase_1": ("holding_registers", 102),
        "phase_2": ("holding_registers", 104),
        "bit": ("coils", 5),
        "bit_1": ("coils", 6),
        "register": ("holding_registers", 9),
    }
    assert tags(found)["register"]["type"] == "bit:0"


def test_switches_write_the_numbers_that_the_source_wrote(
    imported: Callable[..., Imported],
) -> None:
    found = imported(
        "switches:\n"
        "      - {name: Coil, address: 1, write_type: coil, verify: }\n"
        "      - {name: Register, address: 2, verify: }\n"
        "      - {name: Numbers, address: 3, command_on: 170, command_off: 85, verify: }\n"
        "      - {name: Elsewhere, address: 4, verify: "
        "{input_type: input, address: 44, state_on: 2, state_off: [0, 1]}}\n"
        "      - {name: Blind, address: 5}"
    )
    found_tags = tags(found)
    assert found_tags["coil"] == {
        "area": "coils",
        "address": 1,
        "writable": True,
        "description": "Coil",
    }
    assert (found_tags["register"].get("type"), found_tags["register"]["states"]) == (
        None,
        {0: "off", 1: "on"},
    )
    assert found_tags["numbers"]["states"] == {85: "off", 170: "on"}
    assert found_tags["elsewhere_state"]["states"] == {0: "off", 1: "off (1)", 2: "on"}
    assert (found_tags["elsewhere_state"]["area"], found_tags["elsewhere_state"]["address"]) == (
        "input_registers",
        44,
    )
    assert "writable" not in found_tags["elsewhere_state"]
    assert found.data["outputs"]["home"]["writes"] is True
    blind = "its state is read from its address; the source did not read it"
    assert [note for note in notes(found) if blind in note] == [
        f"13: modbus[0].switches[4]: check: {blind}"
    ]


@pytest.mark.parametrize(
    ("switch", "area", "address", "states"),
    [
        ("verify: {address: 44}", "holding_registers", 44, {0: "off", 1: "on"}),
        ("verify: {input_type: input}", "input_registers", 7, {0: "off", 1: "on"}),
        ("verify: {state_on: ['2', 3]}", "holding_registers", 7, {0: "off", 2: "on", 3: "on (3)"}),
        ("verify: {address: 44, input_type: coil}", "coils", 44, None),
        ("verify: {state_on: [1, 3]}", "holding_registers", 7, {0: "off", 1: "on", 3: "on (3)"}),
        (
            "write_type: coil, command_on: 255, verify: {input_type: holding}",
            "holding_registers",
            7,
            {0: "off", 255: "on"},
        ),
    ],
)
def test_a_register_is_on_and_off_at_the_numbers_of_its_switch_only(
    imported: Callable[..., Imported], switch: str, area: str, address: int, states: Any
) -> None:
    tag = tags(imported(f"lights: [{{name: lamp, address: 7, {switch}}}]"))["lamp_state"]
    assert (tag["area"], tag["address"], tag.get("states")) == (area, address, states)
    assert "type" not in tag


def test_a_thermostat_is_off_at_0_only(imported: Callable[..., Imported]) -> None:
    climate = "{name: hall, address: 30, target_temp_register: 31, hvac_onoff_register: 32}"
    assert tags(imported(f"climates: [{climate}]"))["hall_power"]["type"] == "bool"


def test_an_inverted_coil_is_on_at_0(imported: Callable[..., Imported]) -> None:
    inverted = "write_type: coil, command_on: 0, command_off: 255"
    found = imported(
        f"switches: [{{name: plain, address: 1, {inverted}}}, "
        f"{{name: verified, address: 2, {inverted}, verify: {{input_type: discrete_input, "
        "address: 9, state_on: 0, state_off: 1}}]"
    )
    found_tags = tags(found)
    states = {0: "on", 1: "off"}
    assert found_tags["plain"] == {
        "area": "coils",
        "address": 1,
        "states": states,
        "writable": True,
    }
    assert found_tags["verified"]["states"] == states
    assert found_tags["verified_state"] == {
        "area": "discrete_inputs",
        "address": 9,
        "description": "verified state",
    }
    assert not [note for note in notes(found) if "instead of a switch" in note]


@pytest.mark.parametrize("verify", ["", "{delay: 1}", "{input_type: coil}"])
def test_the_source_read_1_as_on_also_of_an_inverted_coil(
    imported: Callable[..., Imported], verify: str
) -> None:
    inverted = "write_type: coil, command_on: 0, command_off: 1"
    found = imported(f"switches: [{{name: x, address: 1, {inverted}, verify: {verify}}}]")
    assert tags(found)["x"]["states"] == {0: "on", 1: "off"}
    assert tags(found)["x_state"] == {"area": "coils", "address": 1, "description": "x state"}


@pytest.mark.parametrize("commands", ["command_on: 0", "command_on: 2, command_off: 3"])
def test_a_coil_that_is_always_written_alike_is_left_out(
    imported: Callable[..., Imported], commands: str
) -> None:
    found = imported(
        f"switches: [{{name: same, address: 1, write_type: coil, {commands}}}, "
        "{name: other, address: 2}]"
    )
    assert list(tags(found)) == ["other"]
    value = 0 if commands == "command_on: 0" else 1
    message = f"same writes {value} for on and for off: add a tag"
    assert f"8: modbus[0].switches[0]: left out: {message}" in notes(found)


@pytest.mark.parametrize(
    "entities",
    [
        "switches: [{name: a, address: 1, write_type: holdings}, {name: b, address: 2}]",
        "lights: [{name: a, address: 1, write_type: coils}, {name: b, address: 2}]",
        "climates: [{name: a, address: 1, target_temp_register: 3, data_type: int16, "
        "target_temp_write_registers: true}]\n    fans: [{name: b, address: 2}]",
        "climates: [{name: a, address: 1, target_temp_register: 3, data_type: float32, "
        "write_registers: true, hvac_onoff_register: 4}]\n    switches: [{name: b, address: 2}]",
        "climates: [{name: a, address: 1, target_temp_register: 3, data_type: float32, "
        "fan_mode_register: {address: 4, write_registers: true, values: {state_fan_on: 1}}}]"
        "\n    covers: [{name: b, address: 2}]",
        "climates: [{name: a, address: 1, target_temp_register: 3, data_type: float32, "
        "fan_mode_register: {address: [4], values: {state_fan_on: 1}}}]"
        "\n    covers: [{name: b, address: 2}]",
        "climates: [{name: a, address: 1, target_temp_register: 3, data_type: float32, "
        "swing_mode_register: {address: [4], values: {swing_mode_state_on: 1}}}]"
        "\n    covers: [{name: b, address: 2}]",
    ],
)
def test_a_device_that_was_written_with_the_functions_for_several_still_is(
    entities: str, imported: Callable[..., Imported]
) -> None:
    found = imported(entities)
    assert found.data["devices"]["inverter"]["url"] == "tcp://192.168.1.50:502?write_multiple=1"
    [note] = [each for each in notes(found) if "function" in each]
    assert note.endswith("changed: written with function 15 or 16, as others of this hub")
    single = imported("switches: [{name: a, address: 1, write_type: holding}]")
    assert single.data["devices"]["inverter"]["url"] == "tcp://192.168.1.50:502"


def test_hubs_at_one_address_have_the_same_options(imported: Callable[..., Imported]) -> None:
    sensors = "sensors: {name: a, address: 1}"
    hub = f"- {{name: NAME, type: tcp, host: 10.0.0.5, port: 502, MORE {sensors}}}\n"
    first = hub.replace("NAME", "one").replace("MORE", "delay: 2,")
    other = hub.replace("NAME", "two").replace("MORE", "message_wait_milliseconds: 50,")
    found = imported("", first + other)
    urls = {device["url"] for device in found.data["devices"].values()}
    assert urls == {"tcp://10.0.0.5:502?pause_after_connect=2&pause=0.05"}
    message = "hubs at one address share a connection: pauses and functions of another (and 1 more)"
    assert f"1: [0]: changed: {message}" in notes(found)


def test_covers_and_climates_become_their_registers(imported: Callable[..., Imported]) -> None:
    found = imported(
        "covers: [{name: Gate, address: 20, state_open: 5, status_register: 21, "
        "status_register_type: input}]\n"
        "    climates: [{name: Hall, address: 30, input_type: input, scale: 0.1, "
        "target_temp_register: [31, 31, 31, 31, 31, 31, 31], max_temp: 28, "
        "hvac_onoff_coil: 7, "
        "hvac_mode_register: {address: 32, values: {state_off: 0}}, "
        "fan_mode_register: {address: 33, values: {state_fan_low: 1, state_fan_high: 2}}}]"
    )
    found_tags = tags(found)
    assert found_tags["gate"]["states"] == {0: "closed", 5: "open"}
    assert found_tags["gate_status"] == {
        "area": "input_registers",
        "address": 21,
        "states": {0: "closed", 2: "opening", 3: "closing", 5: "open"},
        "description": "Gate status",
    }
    assert found_tags["hall"] == {
        "area": "input_registers",
        "address": 30,
        "type": "int16",
        "scale": 0.1,
        "unit": "°C",
        "description": "Hall",
    }
    setpoint = found_tags["hall_setpoint"]
    assert (setpoint["area"], setpoint["address"]) == ("holding_registers", 31)
    assert (setpoint["min"], setpoint["max"], setpoint["scale"]) == (5, 28, 0.1)
    assert found_tags["hall_fan_mode"]["states"] == {1: "low", 2: "high"}
    assert "hall_fan_mode_state" not in found_tags
    assert found_tags["hall_power"]["area"] == "coils"


@pytest.mark.parametrize(
    ("cover", "states"),
    [
        ("state_open: 0, state_closed: 1, status_register: 9", {0: "on", 1: "off"}),
        ("state_open: 5, status_register: 9", None),
        ("state_open: 0, state_closed: 1", None),
    ],
)
def test_a_coil_of_a_cover_opens_when_it_is_switched_on(
    imported: Callable[..., Imported], cover: str, states: Any
) -> None:
    """Without a status register, the source wrote 1 to open."""
    found = imported(f"covers: [{{name: door, address: 3, input_type: coil, {cover}}}]")
    assert tags(found)["door"].get("states") == states
    assert tags(found)["door"]["writable"]


def test_a_coil_of_a_cover_that_is_always_written_alike_is_left_out(
    imported: Callable[..., Imported],
) -> None:
    cover = "{name: door, address: 3, input_type: coil, state_closed: 2, status_register: 9}"
    found = imported(f"covers: [{cover}]")
    assert list(tags(found)) == ["door_status"]
    message = "left out: door writes 1 for on and for off: add a tag"
    assert f"8: modbus[0].covers[0]: {message}" in notes(found)


def test_only_numbers_that_the_source_wrote_can_be_written(
    imported: Callable[..., Imported],
) -> None:
    found = imported(
        "covers: [{name: gate, address: 20}, {name: flap, address: 3, input_type: coil}]\n"
        "    climates: [{name: hall, address: 30, target_temp_register: 31, hvac_mode_register: "
        "{address: 32, values: {state_off: 0, state_heat: 1, state_cool: [3, 2], "
        "state_fan_only: [1, 4]}}}]"
    )
    states = {
        name: (tag["address"], tag.get("writable", False), tag["states"])
        for name, tag in tags(found).items()
        if "states" in tag
    }
    assert states == {
        "gate": (20, True, {0: "closed", 1: "open"}),
        "gate_status": (20, False, {0: "closed", 1: "open", 2: "opening", 3: "closing"}),
        "hall_mode": (32, True, {0: "off", 1: "heat", 3: "cool"}),
        "hall_mode_state": (
            32,
            False,
            {0: "off", 1: "heat", 2: "cool (2)", 3: "cool", 4: "fan_only"},
        ),
    }
    assert tags(found)["flap"] == {"area": "coils", "address": 3, "writable": True}
    covers, mode = "modbus[0].covers", "modbus[0].climates[0].hvac_mode_register"
    firsts = "the select has the first number of each mode, which the source wrote"
    assert {
        f"8: {covers}[0]: changed: a select and a sensor instead of a cover",
        f"8: {covers}[1]: changed: a switch instead of a cover",
        f"9: {mode}: changed: {firsts}; a sensor has all",
        f"9: {mode}.values.state_fan_only: left out: fan_only is 1, as heat",
    } <= set(notes(found))


def test_each_register_of_a_setpoint_is_a_number_with_its_modes(
    imported: Callable[..., Imported],
) -> None:
    climate = "name: pool, address: 21, target_temp_register: [2, 4, 4, 4, 3, 3, 2], max_temp: 40"
    found = imported(f"climates: [{{{climate}}}]")
    numbers = {name: tag for name, tag in tags(found).items() if "setpoint" in name}
    assert {name: tag["address"] for name, tag in numbers.items()} == {
        "pool_setpoint_auto_off": 2,
        "pool_setpoint_cool_dry_fan_only": 4,
        "pool_setpoint_heat_heat_cool": 3,
    }
    assert all(tag["writable"] and tag["max"] == 40 for tag in numbers.values())
    message = "a number for each register, with its modes; the source used that of the mode"
    key = "modbus[0].climates[0].target_temp_register"
    assert f"8: {key}: changed: {message}" in notes(found)


def test_a_number_with_several_names_has_the_first_of_the_source(
    imported: Callable[..., Imported],
) -> None:
    found = imported(
        "covers: [{name: Gate, address: 20, state_open: 1, state_opening: 1}]\n"
        "    climates: [{name: Hall, address: 30, target_temp_register: 31, "
        "hvac_mode_register: {address: 32, values: {state_auto: 1, state_heat: 1, state_off: 0}}, "
        "hvac_action_register: {address: 33, values: {action_off: 0, action_idle: 0}}}]"
    )
    found_tags = tags(found)
    assert found_tags["gate_status"]["states"] == {0: "closed", 1: "open", 3: "closing"}
    assert found_tags["hall_mode"]["states"] == {0: "off", 1: "heat"}
    assert found_tags["hall_action"]["states"] == {0: "idle"}
    assert [note.partition(": left out: ")[2] for note in notes(found) if "left out" in note] == [
        "opening is 1, as open",
        "auto is 1, as heat",
        "off is 0, as idle",
    ]


def test_each_unit_id_of_a_hub_is_a_device_with_its_own_interval(
    imported: Callable[..., Imported],
) -> None:
    found = imported(
        "sensors: [{name: a, address: 1, slave: 1, scan_interval: 30}, "
        "{name: b, address: 2, device_address: 2, scan_interval: 5}, "
        "{name: c, address: 3, slave: 1, scan_interval: 10}, {name: d, address: 4}, "
        "{name: left out, address: 5, slave: 1, scan_interval: 1, scale: 0}, "
        "{name: e, address: 6, slave: 1, scan_interval: 0}]"
    )
    devices = found.data["devices"]
    assert {name: (d["unit"], d["interval"], list(d["tags"])) for name, d in devices.items()} == {
        "inverter-1": (1, 10, ["e", "c"]),
        "inverter-1-15s": (1, 15, ["d"]),
        "inverter-1-30s": (1, 30, ["a"]),
        "inverter-2": (2, 5, ["b"]),
    }
    message = "changed: entities polled every 15 s are tags of inverter-1-15s"
    assert f"8: modbus[0].sensors[3]: {message}" in notes(found)


def test_an_interval_longer_than_a_day_is_taken(imported: Callable[..., Imported]) -> None:
    found = imported(
        "sensors: [{name: a, address: 1, scan_interval: 604800}, "
        "{name: b, address: 2, scan_interval: 99999999}]"
    )
    week, year = found.data["devices"].values()
    assert (week["interval"], year["interval"]) == (604_800, 31_622_400)
    message = "scan_interval: changed: polled every 31622400 s, the longest interval"
    assert f"8: modbus[0].sensors[1].{message}" in notes(found)


def test_a_serial_line_and_pauses_are_in_the_url(imported: Callable[..., Imported]) -> None:
    hub = (
        "- {name: line, type: serial, method: rtu, port: /dev/ttyUSB0, baudrate: 9600, "
        "bytesize: 8, parity: N, stopbits: 1, delay: 2, message_wait_milliseconds: 30, "
        "timeout: 5, sensors: {name: a, address: 1, slave: 248}}\n"
    )
    device = imported("", hub).data["devices"]["line"]
    assert device["unit"] == 248
    line = "rtu:///dev/ttyUSB0?baud=9600&parity=none&stop_bits=1"
    assert device["url"] == f"{line}&pause=0.03&pause_after_connect=2"
    assert device["timeout"] == 5


def test_every_mistake_is_told_with_its_line(imported: Callable[..., Imported]) -> None:
    with pytest.raises(NotImportable) as raised:
        imported(
            "sensors: [{name: a, address: -1}, {address: 2}, {name: b, address: 1, count: 0}, "
            "{name: c, address: 1, data_type: string}, {name: d, address: 1, slave: 300}]\n"
            "    switches: !include switches.yaml"
        )
    assert [(each.line, each.key) for each in raised.value.problems] == [
        (8, "modbus[0].sensors[0].address"),
        (8, "modbus[0].sensors[1].name"),
        (8, "modbus[0].sensors[2].count"),
        (8, "modbus[0].sensors[3].count"),
        (8, "modbus[0].sensors[4].slave"),
        (9, "modbus[0].switches"),
    ]


def test_a_mode_whose_name_no_state_has_is_a_mistake(imported: Callable[..., Imported]) -> None:
    with pytest.raises(NotImportable) as raised:
        imported(
            "climates: [{name: hall, address: 30, target_temp_register: 31, hvac_mode_register: "
            "{address: 32, values: {state_: 0, 'state_heat ': 1, state_cool: 2}}}]"
        )
    mode = "8: modbus[0].climates[0].hvac_mode_register.values"
    assert [text.partition(", allowed")[0] for text in refusals(raised.value)] == [
        f"{mode}.state_: found ''",
        f"{mode}.'state_heat ': found 'heat '",
    ]


def refusals(error: NotImportable) -> list[str]:
    return [f"{each.line}: {each.key}: {each.message}" for each in error.problems]


def test_secrets_are_read_from_the_file_beside_it(
    imported: Callable[..., Imported], tmp_path: Path
) -> None:
    hub = HUB.replace("192.168.1.50", "!secret host").replace("502", "!secret port")
    sensors = "sensors: [{name: a, address: 1}]"
    with pytest.raises(NotImportable) as raised:
        imported(sensors, hub)
    missing = "which is not in secrets.yaml beside the imported file, allowed: its value"
    assert refusals(raised.value) == [
        f"6: modbus[0].host: found the secret host, {missing}",
        f"7: modbus[0].port: found the secret port, {missing}",
    ]
    (tmp_path / "secrets.yaml").write_text("host: 10.0.0.9\nport: 1502\n")
    device = imported(sensors, hub).data["devices"]["inverter"]
    assert device["url"] == "tcp://10.0.0.9:1502"


def test_files_that_are_included_are_read_where_they_are(
    imported: Callable[..., Imported], tmp_path: Path
) -> None:
    for folder in ("packages", "entities"):
        (tmp_path / folder).mkdir()
    (tmp_path / "secrets.yaml").write_text("host: 10.0.0.1\nport: 1502\n")
    (tmp_path / "packages" / "secrets.yaml").write_text("host: 10.0.0.2\n")
    (tmp_path / "hubs.yaml").write_text(
        "- &hub {name: one, type: tcp, host: !secret host, port: !secret port, "
        "sensors: !include entities/a.yaml}\n"
        "- {<<: *hub, name: two, host: 10.0.0.3, sensors: [!include entities/b.yaml]}\n"
    )
    (tmp_path / "packages" / "pv.yaml").write_text(
        "modbus:\n  name: pv\n  type: tcp\n  host: !secret host\n  port: !secret port\n"
        "  sensors: !include ../entities/a.yaml\n  switches: !include ../entities/none.yaml\n"
    )
    (tmp_path / "entities" / "a.yaml").write_text(
        "- {name: a, address: 1, slave: 7}\n- &b {name: b, address: 2, slave: 7, precision: 1}\n"
    )
    (tmp_path / "entities" / "b.yaml").write_text("name: c\nslave: 7\naddress: 3\naddress: 4\n")
    (tmp_path / "entities" / "none.yaml").write_text("# none yet\n")
    (tmp_path / "automations.yaml").write_text(
        "- action: modbus.write_register\n  data: {hub: pv, slave: 7, address: 2, value: 1}\n"
    )
    found = imported(
        "",
        "homeassistant: {packages: {pv: !include packages/pv.yaml}}\n"
        "automation: !include automations.yaml\nmodbus: !include hubs.yaml\n",
    )
    assert {
        name: (each["url"], list(each["tags"])) for name, each in found.data["devices"].items()
    } == {
        "one": ("tcp://10.0.0.1:1502", ["a", "b"]),
        "two": ("tcp://10.0.0.3:1502", ["c"]),
        "pv": ("tcp://10.0.0.2:1502", ["a", "b"]),
    }
    places = {
        (Path(note.file).relative_to(tmp_path).as_posix(), note.line, note.key)
        for note in found.notes
    }
    assert places >= {
        ("automations.yaml", 1, "automation[0].action"),
        ("entities/a.yaml", 2, "modbus[0].sensors[1].precision"),
        ("entities/b.yaml", 4, "modbus[1].sensors[0].address"),
    }


def test_a_problem_of_an_included_file_has_its_name_and_line(
    imported: Callable[..., Imported], tmp_path: Path
) -> None:
    for name, text in {
        "a.yaml": "- {name: a, address: 0100}\n- name: b\n- !secret missing\n",
        "b.yaml": "x:\n  password: a: b\n",
        "c.yaml": "!include c.yaml\n",
        "d.yaml": "!include_dir_list d\n",
        "e.yaml": "- {<<: !include ../outside.yaml, name: x, address: 1}\n",
    }.items():
        (tmp_path / name).write_text(text)
    (tmp_path.parent / "outside.yaml").write_text("name: x\n")
    lists = ("sensors", "switches", "covers", "climates", "lights", "fans")
    with pytest.raises(NotImportable) as raised:
        imported(
            "\n    ".join(
                f"{each}: !include {name}.yaml" for each, name in zip(lists, "abcdef", strict=True)
            )
        )
    found = [
        f"{Path(each.file).name}:{each.line}: {each.key.removeprefix('modbus[0].')}: {each.message}"
        for each in raised.value.problems
    ]
    assert [each.replace(f"{tmp_path}{os.sep}", "") for each in found] == [
        "configuration.yaml:13: fans: found !include f.yaml, but f.yaml: can't be read: "
        "No such file or directory",
        "a.yaml:1: sensors[0].address: found 0100, which the source read as octal, allowed: 64, "
        "or 100 if that is meant",
        "a.yaml:2: sensors[1].address: missing, allowed: an address from 0 to 65535",
        "a.yaml:3: sensors[2]: found the secret missing, which is not in secrets.yaml beside the "
        "imported file, allowed: its value",
        "b.yaml:2: switches: not YAML (line hidden, as it may contain a secret), allowed: text in "
        "quotes",
        "c.yaml:1: covers: found c.yaml, allowed: up to 10 files inside each other, none inside "
        "itself",
        "d.yaml:1: climates: found !include_dir_list d, allowed: !include of each file; a file "
        "with hubs can be imported by itself",
        "e.yaml:1: lights[0].'<<': found !include ../outside.yaml, allowed: a file in the folder "
        "of the imported one, or below it",
    ]


def test_a_link_does_not_lead_out_of_the_folder(
    imported: Callable[..., Imported], tmp_path: Path
) -> None:
    (tmp_path.parent / "linked.yaml").write_text("- {name: a, address: 1}\n")
    (tmp_path / "a.yaml").symlink_to(tmp_path.parent / "linked.yaml")
    with pytest.raises(NotImportable, match="allowed: a file in the folder of the imported one"):
        imported("sensors: !include a.yaml")


@pytest.mark.skipif(sys.platform == "win32", reason="no named pipes in folders")
def test_a_named_pipe_is_not_included(imported: Callable[..., Imported], tmp_path: Path) -> None:
    if sys.platform != "win32":
        os.mkfifo(tmp_path / "pipe")
    with pytest.raises(NotImportable, match="it is a named pipe, allowed: a regular file"):
        imported("sensors: !include pipe")


@pytest.mark.parametrize("lost", ["a.yaml", "b.yaml", "secrets.yaml"])
def test_the_first_file_that_does_not_answer_ends_the_import(
    imported: Callable[..., Imported], tmp_path: Path, lost: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.yaml").write_text("[!include b.yaml, !include b.yaml]\n")
    (tmp_path / "b.yaml").write_text("{name: a, address: !secret low}\n")
    (tmp_path / "secrets.yaml").write_text("low: 1\n")
    read, asked = bounded_files.read, list[str]()

    def answer(path: Path, *args: Any, **options: Any) -> bytes:
        asked.append(path.name)
        if path.name == lost:
            raise bounded_files.not_answered(str(path), bounded_files.TIMEOUT_MS)
        return read(path, *args, **options)

    monkeypatch.setattr(bounded_files, "read", answer)
    with pytest.raises(ConfigNotAnswered):
        imported("sensors: !include a.yaml")
    assert asked[-1] == lost
    assert asked.count(lost) == 1


def test_secrets_are_not_read_from_other_folders(tmp_path: Path) -> None:
    outside, inside = tmp_path / "outside", tmp_path / "inside"
    for folder in (outside, inside):
        folder.mkdir()
    (outside / "secrets.yaml").write_text("unit: 9\n")
    (inside / "a.yaml").write_text("- {name: a, address: 1, slave: !secret unit}\n")
    (inside / "linked").symlink_to(outside, target_is_directory=True)
    (outside / "a.yaml").symlink_to(inside / "a.yaml")
    hub = HUB.replace("{entities}", "sensors: !include linked/a.yaml")
    (inside / "configuration.yaml").write_text(hub)
    with pytest.raises(NotImportable, match="found the secret unit, which is not in"):
        read_home_assistant(inside / "configuration.yaml")
    (inside / "secrets.yaml").symlink_to(outside / "secrets.yaml")
    (inside / "configuration.yaml").write_text(hub.replace("linked/", ""))
    with pytest.raises(NotImportable, match=r"secrets\.yaml is a link, allowed: a file in the"):
        read_home_assistant(inside / "configuration.yaml")


def test_files_that_include_others_again_and_again_are_refused(
    imported: Callable[..., Imported], tmp_path: Path
) -> None:
    for number in range(8):
        inside = ", ".join([f"!include {number + 1}.yaml"] * 9)
        (tmp_path / f"{number}.yaml").write_text(f"[{inside}]\n")
    (tmp_path / "8.yaml").write_text("name: x\n")
    with pytest.raises(ConfigError, match="allowed: 300 of them in all files"):
        imported("sensors: !include 0.yaml")
    (tmp_path / "8.yaml").write_text(f"[{'1, ' * 2000}]\n")
    with pytest.raises(ConfigError, match="more than 300000 keys and values, the limit"):
        imported("sensors: !include 0.yaml")
    (tmp_path / "8.yaml").write_text("\n" * (1 << 20))
    with pytest.raises(NotImportable) as raised:
        imported(f"sensors: [{'!include 8.yaml, ' * 5}]")
    message = (
        "8: modbus[0].sensors[4]: found !include 8.yaml, allowed: 4194304 bytes in all files "
        "that are included"
    )
    assert message in refusals(raised.value)


def test_packages_that_are_not_read_are_noted(imported: Callable[..., Imported]) -> None:
    core = "homeassistant: {name: !secret home, packages: !include_dir_named packages}"
    found = imported("sensors: [{name: a, address: 1}]", HUB.replace("default_config:", core))
    message = "found !include_dir_named packages, allowed: !include of each file; a file with hubs"
    assert [note for note in notes(found) if "left out" in note] == [
        f"1: homeassistant.packages: left out: {message} can be imported by itself"
    ]


@pytest.mark.parametrize(
    ("above", "key"),
    [
        ("<<: !include nope.yaml", "'<<'"),
        ("<<: [!include nope.yaml]", "'<<'.0"),
        ("homeassistant: !include nope.yaml", "homeassistant"),
        ("homeassistant: {packages: [!include nope.yaml]}", "homeassistant.packages[0]"),
        ("homeassistant: {packages: {a.b: !include nope.yaml}}", "homeassistant.packages.'a.b'"),
        ("homeassistant: {packages: {a: !include merge.yaml}}", "homeassistant.packages.a.'<<'"),
        ("homeassistant: {packages: {a: {sensor: !include nope.yaml}}}", None),
        ("frontend: !include nope.yaml", None),
        ("pv: {modbus: []}\nother: !include nope.yaml\n", "other"),
    ],
)
def test_what_may_have_hubs_and_is_not_read_is_noted(
    imported: Callable[..., Imported], tmp_path: Path, above: str, key: str | None
) -> None:
    (tmp_path / "automations.yaml").write_text("[]\n")
    (tmp_path / "merge.yaml").write_text("<<: !include nope.yaml\n")
    found = imported("sensors: [{name: a, address: 1}]", HUB.replace("default_config:", above))
    left_out = [note for note in found.notes if note.kind == "left out"]
    assert [note.key for note in left_out] == ([] if key is None else [key])
    assert all(
        "but nope.yaml: can't be read" in each.message.replace(f"{tmp_path}{os.sep}", "")
        for each in left_out
    )


@pytest.mark.parametrize("value", ["!include hubs.yaml", "[!include hubs.yaml]"])
def test_a_problem_of_a_section_that_is_merged_is_one_of_the_section(
    imported: Callable[..., Imported], tmp_path: Path, value: str
) -> None:
    hub = HUB.partition("modbus:")[2].replace(
        "{entities}", "sensors: [{name: a, address: 1, slave: !secret unit}]"
    )
    (tmp_path / "hubs.yaml").write_text(f"modbus:{hub}")
    with pytest.raises(NotImportable, match="found the secret unit, which is not in"):
        imported("", f"<<: {value}\n")


def test_entities_of_the_former_form_are_named(imported: Callable[..., Imported]) -> None:
    former = "binary_sensor:\n  - platform: modbus\n    registers: [{hub: h, register: 1}]\n"
    message = (
        "found platform: modbus, the form before Home Assistant 2021.7, allowed: entities in lists "
        "of their hub in modbus, such as sensors and switches, with address in place of register"
    )
    for hub, line in (("", 2), (HUB.replace("{entities}", ""), 10)):
        with pytest.raises(NotImportable) as raised:
            imported("", hub + former)
        assert refusals(raised.value) == [f"{line}: binary_sensor[0]: {message}"]
    found = imported("sensors: [{name: a, address: 1}]", HUB + former)
    assert f"10: binary_sensor[0]: left out: {message}" in notes(found)


def test_all_sections_are_read(imported: Callable[..., Imported]) -> None:
    rest = "type: tcp, host: 10.0.0.1, port: 502, sensors: [{name: a, address: 1}]"
    packages = [f"{name}:\n  modbus: [{{name: {name}, {rest}}}]\n" for name in "xy"]
    found = imported("", "".join(packages))
    assert list(found.data["devices"]) == ["x", "y"]


def test_a_problem_of_an_anchor_elsewhere_is_one_of_its_alias(
    imported: Callable[..., Imported],
) -> None:
    hub = HUB.replace("default_config:", "base: &base {data_type: !secret kind, scale: 0.1}")
    with pytest.raises(NotImportable) as raised:
        imported("sensors: [{<<: *base, name: a, address: 1}]", hub)
    missing = "which is not in secrets.yaml beside the imported file, allowed: its value"
    assert refusals(raised.value) == [
        f"8: modbus[0].sensors[0].'<<': found the secret kind, {missing}"
    ]


def test_a_problem_of_an_included_file_has_its_place_also_for_an_alias(
    imported: Callable[..., Imported], tmp_path: Path
) -> None:
    (tmp_path / "b.yaml").write_text("x: 1\npassword: *hunter2\n")
    hub = HUB.replace("default_config:", "x: &x !include b.yaml")
    with pytest.raises(NotImportable) as raised:
        imported("sensors: *x", hub)
    hidden = "not YAML (line hidden, as it may contain a secret), allowed: text in quotes"
    assert refusals(raised.value) == [f"2: modbus[0].sensors: {hidden}"]
    assert raised.value.problems[0].file == str(tmp_path / "b.yaml")


def test_an_alias_of_aliases_has_the_first_problems_of_its_anchor(
    imported: Callable[..., Imported],
) -> None:
    levels = [f"a{level}: &a{level} [{f'*a{level - 1}, ' * 10}]" for level in range(1, 4)]
    anchors = "\n".join(["a0: &a0 [!no 1, !no 2, !no 3, !no 4]", *levels])
    with pytest.raises(NotImportable) as raised:
        imported("sensors: *a3", HUB.replace("default_config:", anchors))
    allowed = "allowed: what it stands for"
    assert refusals(raised.value) == [
        f"11: modbus[0].sensors: found !no {number}, {allowed}" for number in (1, 2, 3)
    ]


def test_secrets_are_not_shown_and_are_single_values(
    imported: Callable[..., Imported], tmp_path: Path
) -> None:
    (tmp_path / "secrets.yaml").write_text("word: hunter2\nmany: {a: 1}\n")
    entities = (
        "sensors: [{name: a, address: !secret word}, {<<: !secret many, name: b, address: 2}]"
    )
    with pytest.raises(NotImportable) as raised:
        imported(entities, HUB.replace("192.168.1.50", "!secret word"))
    found = refusals(raised.value)
    assert len(found) == 2
    assert not [message for message in found if "hunter2" in message]
    octal = "found the secret low, which the source read as octal or binary"
    for low in ("0100", "0_100"):
        (tmp_path / "secrets.yaml").write_text(f"low: {low}\nother: 0200\n")
        with pytest.raises(NotImportable) as raised:
            imported("sensors: [{name: a, address: !secret low}]")
        assert refusals(raised.value) == [
            f"8: modbus[0].sensors[0].address: {octal}, allowed: a number without a 0 in front"
        ]
    (tmp_path / "inside").mkdir()
    (tmp_path / "inside" / "secrets.yaml").write_text("low:\n")
    (tmp_path / "inside" / "a.yaml").write_text("{name: a, address: !secret low}\n")
    with pytest.raises(NotImportable, match="found the secret low without a value, allowed: text"):
        imported("sensors: !include inside/a.yaml")
    (tmp_path / "secrets.yaml").write_text("word: [\n")
    with pytest.raises(NotImportable, match="is not YAML that can be read"):
        imported("sensors: [{name: a, address: !secret word}]")


def test_merged_keys_are_those_of_the_entity_unless_it_has_its_own(
    imported: Callable[..., Imported],
) -> None:
    found = imported(
        "sensors:\n"
        "      - &base {name: a, address: 1, data_type: uint32, swap: word, slave: 4}\n"
        "      - {<<: *base, name: b, address: 3}\n"
        "      - {<<: [{scale: 0.1}, *base], name: c, address: 5, data_type: int32}"
    )
    found_tags = tags(found)
    assert {name: tag["type"] for name, tag in found_tags.items()} == {
        "a": "uint32",
        "b": "uint32",
        "c": "int32",
    }
    assert found_tags["c"]["scale"] == 0.1
    assert [tag["order"] for tag in found_tags.values()] == ["CDAB"] * 3


def test_the_last_of_equal_keys_counts_as_in_the_source(
    imported: Callable[..., Imported], tmp_path: Path
) -> None:
    (tmp_path / "secrets.yaml").write_text("host: 10.0.0.8\nhost: 10.0.0.9\n")
    first = HUB.replace("{entities}", "sensors: [{name: a, address: 1}]")
    second = HUB.partition("\n")[2].replace("192.168.1.50", "!secret host")
    found = imported("sensors: [{name: b, slave: 3, address: 2, address: 4}]", first + second)
    device = found.data["devices"]["inverter"]
    assert (device["url"], device["unit"]) == ("tcp://10.0.0.9:502", 3)
    assert {name: tag["address"] for name, tag in device["tags"].items()} == {"b": 4}
    last = "the last counts, as in the source"
    assert [note for note in notes(found) if last in note] == [
        f"10: modbus: check: line 3 has it, too: {last}",
        f"15: modbus[0].sensors[0].address: check: line 15 has it, too: {last}",
    ]


def test_equal_keys_inside_a_value_that_does_not_count_have_no_note(
    imported: Callable[..., Imported],
) -> None:
    twice = "sensors: [{name: a, slave: 1, slave: 2, address: 3}]"
    once = "sensors: [{name: a, slave: 2, address: 3}]"
    hub = HUB.replace("{entities}", twice) + HUB.partition("\n")[2]
    last = "the last counts, as in the source"
    for entities, lines in ((once, [10]), (twice, [10, 15])):
        found = imported(entities, hub)
        assert [note.line for note in found.notes if last in note.message] == lines


def test_the_last_of_several_merge_keys_counts_as_in_the_source(
    imported: Callable[..., Imported],
) -> None:
    hub = HUB.replace("default_config:", "x: &x {scale: 2, offset: 3}\ny: &y {scale: 4}")
    tag = tags(imported("sensors: [{<<: *x, <<: *y, name: a, address: 1}]", hub))["a"]
    assert (tag["scale"], tag["offset"]) == (4, 3)


def test_the_section_is_found_in_a_package(imported: Callable[..., Imported]) -> None:
    inside = "".join(f"      {line}\n" for line in HUB.splitlines()[2:])
    hub = f"homeassistant:\n  packages:\n    pv:\n{inside}"
    assert list(tags(imported("sensors: [{name: a, address: 1}]", hub))) == ["a"]


@pytest.mark.parametrize(
    ("port", "url"),
    [
        ("/dev/ttyUSB0", "rtu:///dev/ttyUSB0?baud=9600&parity=even&stop_bits=1&pause=0.03"),
        ("COM3", "rtu:///COM3?baud=9600&parity=even&stop_bits=1&pause=0.03"),
        ("socket://10.0.0.7:8899", "rtu+tcp://10.0.0.7:8899?pause=0.03"),
        ("rfc2217://10.0.0.7:8899", None),
    ],
)
def test_ports_of_serial_lines(
    imported: Callable[..., Imported], port: str, url: str | None
) -> None:
    hub = (
        f"- {{name: line, type: serial, method: rtu, port: '{port}', baudrate: 9600, "
        "bytesize: 8, parity: E, stopbits: 1, sensors: {name: a, address: 1}}\n"
    )
    if url is None:
        with pytest.raises(NotImportable, match="allowed: a serial port, or socket://host:port"):
            imported("", hub)
    else:
        assert imported("", hub).data["devices"]["line"]["url"] == url


def test_color_temperatures_of_lights_are_left_out_with_the_reason(
    imported: Callable[..., Imported],
) -> None:
    found = imported(
        "lights: [{name: x, address: 1, color_temp_address: 2, min_temp: 2000, max_temp: 7000}]"
    )
    left_out = [note.partition(": left out: ")[2] for note in notes(found) if "left out" in note]
    assert left_out == [
        "color temperatures are not converted: add a tag",
        *["the limits of color temperatures are not converted"] * 2,
    ]


def test_notes_that_are_alike_are_one(imported: Callable[..., Imported]) -> None:
    sensors = ", ".join(f"{{name: s{at}, address: {at}, precision: 1}}" for at in range(9))
    found = [note for note in notes(imported(f"sensors: [{sensors}]")) if "precision" in note]
    message = "values are not rounded; Home Assistant can show fewer digits (and 8 more)"
    assert found == [f"8: modbus[0].sensors[0].precision: left out: {message}"]


@pytest.mark.parametrize(
    ("entity", "message"),
    [
        ("data_type: uint16, count: 2", "count: found 2 with data_type uint16, allowed: 1"),
        ("data_type: uint, count: 3", "count: found 3 with data_type uint, allowed: 1, 2 or 4"),
        (
            "data_type: custom, structure: '>2h', count: 2, swap: word",
            "swap: found word with several values, whose order it changes, allowed: none or byte",
        ),
        ("nan_value: xyz", "nan_value: found 'xyz', allowed: an integer"),
    ],
)
def test_what_would_be_another_value_is_refused(
    imported: Callable[..., Imported], entity: str, message: str
) -> None:
    with pytest.raises(NotImportable) as raised:
        imported(f"sensors: [{{name: x, address: 1, {entity}}}]")
    assert refusals(raised.value) == [f"8: modbus[0].sensors[0].{message}"]


@pytest.mark.parametrize(
    ("climate", "message"),
    [
        (
            "target_temp_register: 2, min_temp: 30, max_temp: 20",
            "max_temp: found 20, allowed: at least min_temp, 30",
        ),
        (
            "target_temp_register: 2, min_temp: 40",
            "min_temp: found 40, allowed: up to max_temp, 35",
        ),
        (
            "target_temp_register: [2, 3]",
            "target_temp_register: found 2 registers, allowed: 1, or 7, for auto, cool, dry, "
            "fan_only, heat, heat_cool, off",
        ),
    ],
)
def test_a_thermostat_without_a_setpoint_that_it_allows_is_refused(
    imported: Callable[..., Imported], climate: str, message: str
) -> None:
    with pytest.raises(NotImportable) as raised:
        imported(f"climates: [{{name: x, address: 1, {climate}}}]")
    assert refusals(raised.value) == [f"8: modbus[0].climates[0].{message}"]


def test_a_number_is_neither_text_nor_read_only(imported: Callable[..., Imported]) -> None:
    with pytest.raises(NotImportable) as raised:
        imported(
            "numbers: [{name: x, address: 1, data_type: string, count: 2}, "
            "{name: y, address: 1, input_type: input}, {name: z, address: 1, min_value: 200}]"
        )
    assert [line.partition(": found ")[0] for line in refusals(raised.value)] == [
        "8: modbus[0].numbers[0].data_type",
        "8: modbus[0].numbers[1].input_type",
        "8: modbus[0].numbers[2].min_value",
    ]


def test_what_a_line_can_not_have_is_refused(imported: Callable[..., Imported]) -> None:
    hub = (
        "- {name: line, type: serial, method: rtu, port: /dev/ttyUSB0, baudrate: 9600, timeout: "
        "-5, bytesize: 8, parity: E, stopbits: 1, sensors: {name: a, address: 1, slave: 0}}\n"
    )
    with pytest.raises(NotImportable) as raised:
        imported("", hub)
    assert [line.partition(": ")[2] for line in refusals(raised.value)] == [
        "[0].timeout: found -5, allowed: 0.001 to 31622400 seconds",
        "[0].sensors.slave: found 0, allowed: a unit id from 1 to 255",
    ]


def test_an_entity_ends_with_its_area(imported: Callable[..., Imported]) -> None:
    with pytest.raises(NotImportable, match="x is at 65535 to 65536, allowed: up to 65535"):
        imported("sensors: [{name: x, address: 65535, data_type: uint32}]")


def test_no_entity_gets_the_name_of_one_that_was_removed(
    imported: Callable[..., Imported], tmp_path: Path
) -> None:
    (tmp_path / "secrets.yaml").write_text("id: hunter2\n")
    switches = [
        "{name: Насос, address: 5, slave: 1, write_type: coil, verify: }",
        "{name: Котёл, address: 6, slave: 1, write_type: coil, verify: {address: 9}}",
        "{name: Coil 5, address: 4, slave: 1, write_type: coil}",
        "{name: Główny, address: 8, slave: 1, command_on: 1}",
        "{name: Główna, address: 8, slave: 1, command_on: 2}",
        "{name: Główne, address: 8, slave: 1, command_on: 3}",
        "{name: Außen, address: 9, slave: 1}",
        "{name: Pump, address: 10, slave: 1, unique_id: valve}",
        "{name: pump, address: 11, slave: 1, unique_id: !secret id}",
        "{name: Valve, address: 12, slave: 1}",
    ]
    sensors = "sensors: [{name: Pump, address: 10, slave: 1}]"

    def found_with(entities: list[str]) -> Imported:
        return imported(f"switches: [{', '.join(entities)}]\n    {sensors}")

    found = found_with(switches)
    names = ["holding_register-10-sensor", "coil-5-switch", "coil-6-switch", "coil-9-switch_state"]
    names += ["coil_5", *(f"holding_register-8-switch-{number}-of-3" for number in (1, 2, 3))]
    names += ["aussen", "holding_register-10-switch", "holding_register-11-switch", "valve"]
    assert list(tags(found)) == names
    assert tags(found)["coil-6-switch"]["description"] == "Котёл"
    key = "8: modbus[0].switches"
    assert [note for note in notes(found) if "renamed" in note][-4:-1] == [
        f"{key}[5].name: changed: renamed to {names[7]}: a name has letters from a to z, digits "
        "and '_'",
        f"{key}[7].name: changed: renamed to {names[9]}: another entity has its name",
        f"{key}[8].name: changed: renamed to {names[10]}: another entity has its name",
    ]
    assert not [note for note in notes(found) if "hunter2" in note]
    for gone in range(len(switches)):
        rest = [each for index, each in enumerate(switches) if index != gone]
        for name, tag in tags(found_with(rest)).items():
            assert tags(found).get(name, tag) == tag


def test_details_that_mean_something_else_elsewhere(imported: Callable[..., Imported]) -> None:
    found = imported(
        "sensors: [{name: count, address: 1, count: 2}, "
        "{name: text, address: 3, data_type: string, count: 2, scale: 0.1}, "
        "{name: none, address: 5, data_type: uint16, nan_value: FFFF}]\n"
        "    switches: [{name: 'on', address: 1, write_type: coil, "
        "verify: {input_type: holding, address: 20, state_on: 3}}]"
    )
    found_tags = tags(found)
    assert found_tags["count"]["type"] == "int32"
    assert "scale" not in found_tags["text"]
    assert found_tags["none"]["null"] == [65535]
    assert found_tags["on_state"]["states"] == {0: "off", 3: "on"}
    assert not [note for note in notes(found) if "instead of a switch" in note]


@pytest.mark.parametrize(
    "text", ["", "modbus: []\n", "sensor: []\n", "3\n", "modbus: !include x\n"]
)
def test_a_file_without_hubs_is_refused(imported: Callable[..., Imported], text: str) -> None:
    with pytest.raises(NotImportable):
        imported("", text)


@pytest.mark.parametrize("text", ["default_config:\nautomation: []\n", "- {alias: x}\n"])
def test_a_file_without_the_section_names_the_file_to_import(
    imported: Callable[..., Imported], text: str
) -> None:
    with pytest.raises(NotImportable) as raised:
        imported("", text)
    message = "no section modbus, nor a hub with its type: import the file that has the hubs"
    assert [(each.line, each.message) for each in raised.value.problems] == [(1, message)]


@pytest.mark.parametrize("above", ["default_config:", "# \x85 \u2028 \u2029\r# \r\n#"])
def test_an_octal_number_is_refused(imported: Callable[..., Imported], above: str) -> None:
    hub = HUB.replace("default_config:", above)
    for address in ("0100", "&x 0100", "!!int &x 0100"):
        with pytest.raises(NotImportable, match=r"found 0100, .* as octal, allowed: 64"):
            imported(f"sensors: [{{name: a, address: {address}}}]", hub)
    for number, told in (("0_100", "octal, allowed: 64"), ("-0b_11", "binary, allowed: -3")):
        for keys in ("address: 1, nan_value", "address: 1, scale", "slave: 1, address"):
            with pytest.raises(NotImportable) as raised:
                imported(f"sensors: [{{name: a, {keys}: {number}}}]", hub)
            [only] = raised.value.problems
            assert only.message == f"found {number}, which the source read as {told}"
    quoted = imported("sensors: [{name: a, slave: 1, address: '0_100'}]", hub)
    assert tags(quoted)["a"]["address"] == 100
    for name in ("!!str 0_17", "! 0_17", "|-\n        0_17", "!!str 0100"):
        text = imported(f"sensors:\n    - address: 1\n      name: {name}\n", hub)
        assert list(tags(text)) == [name.split()[-1]]
    with pytest.raises(ConfigError, match="line hidden, as it may contain a secret"):
        imported("password: a: hunter2", hub)


def test_actions_that_write_are_noted_with_what_replaces_them(
    imported: Callable[..., Imported],
) -> None:
    hub = HUB.replace("automation: !include automations.yaml\n", "")
    found = imported(
        "sensors: [{name: Setpoint, slave: 1, address: 0, scale: 0.1}, "
        "{name: Power, slave: 1, address: 1, scan_interval: 5}]\n"
        "    binary_sensors: [{name: Door, slave: 1, address: 9, input_type: holding}]\n"
        "    switches: [{name: Pump, slave: 2, address: 5, write_type: coil}]\n"
        "automation:\n"
        "  - action:\n"
        "      - service: modbus.write_register\n"
        "        data: {hub: inverter, unit: 1, address: 0, value: 180}\n"
        "      - service_template: \"{{ 'modbus.write_coil' if x else 'light.toggle' }}\"\n"
        "        data_template: {hub: inverter, slave: 2, address: '5', state: true}\n"
        "script:\n"
        "  charge:\n"
        "    sequence:\n"
        "      - choose: [{sequence: [{action: modbus.write_register, data: "
        "{hub: inverter, slave: 1, address: 0, value: 1}}]}]\n"
        "      - {action: modbus.write_register, data: {address: '{{ a }}', value: 1}}\n"
        "      - {action: modbus.write_register, data: {hub: inverter, address: 9, value: 1}}\n"
        "      - {action: modbus.write_register, data: '{{ d }}'}\n"
        "      - {action: modbus.stop, data: {hub: inverter}}\n",
        hub,
    )
    stops = "stops when modbus is removed"
    unknown = f"{stops}: make a tag writable, and publish to its set topic"
    register = "check: modbus.write_register to address"
    assert [note for note in notes(found) if stops in note] == [
        f"12: automation[0].action[0].service: {register} 0 of unit 1 of hub 'inverter' {stops}: "
        "set writable: true for setpoint of inverter-1-15s, and publish the scaled value to "
        "plant/inverter-1-15s/setpoint/set (lines 12 and 19)",
        "14: automation[0].action[1].service_template: check: modbus.write_coil to address '5' of "
        f"unit 2 of hub 'inverter' {stops}: publish the value to plant/inverter-2/pump/set",
        f"20: script.charge.sequence[1].action: {register} '{{{{ a }}}}' of unit 1 of hub "
        f"'modbus_hub' {unknown}",
        f"21: script.charge.sequence[2].action: {register} 9 of unit 1 of hub 'inverter' {unknown}",
        f"22: script.charge.sequence[3].action: {register} nothing of unit 1 of hub 'modbus_hub' "
        f"{unknown}",
    ]


@pytest.mark.parametrize(
    ("entities", "instead"),
    [
        ("numbers: [{name: level, slave: 1, address: 5}]", "publish the value to"),
        (
            "numbers: [{name: level, slave: 1, address: 5, scan_interval: 60}]",
            "publish the value to",
        ),
        (
            "climates: [{name: room, slave: 1, address: 5, target_temp_register: 7}]",
            "set writable: true for room of inverter, and publish the value to",
        ),
        (
            "numbers: [{name: level, slave: 1, address: 5}]\n"
            "  - {name: inverter, type: tcp, host: x, port: 502, "
            "sensors: {name: power, slave: 1, address: 9}}",
            "publish the value to",
        ),
    ],
)
def test_the_tag_that_replaces_an_action_is_writable_or_of_one_register(
    imported: Callable[..., Imported], entities: str, instead: str
) -> None:
    found = imported(
        "sensors: [{name: energy, slave: 1, address: 5, data_type: uint32}]\n"
        f"    {entities}\n"
        "script: {x: {sequence: [{action: modbus.write_register, "
        "data: {hub: inverter, slave: 1, address: 5, value: 1}}]}}\n",
        HUB.replace("automation: !include automations.yaml\n", ""),
    )
    [note] = [each for each in notes(found) if "stops when modbus is removed: " in each]
    [place] = [
        f"{device}/{name}"
        for device, settings in found.data["devices"].items()
        for name, tag in settings["tags"].items()
        if tag["address"] == 5 and name != "energy"
    ]
    assert note.endswith(f"removed: {instead} plant/{place}/set")


def test_actions_in_other_files_and_entities_without_a_unit_are_to_be_checked(
    imported: Callable[..., Imported],
) -> None:
    found = imported(
        "sensors: [{name: a, address: 1}, {name: b, address: 2}, {name: c, slave: 1, address: 3}]"
    )
    assert [note.partition(": check: ")[2] for note in notes(found)][3:] == [
        "neighbours are read together: remove a tag that the device never answers, or only with "
        "04; set max_registers if it answers only short requests",
        "modbus.write_register or modbus.write_coil in automations and scripts stops, also in "
        "other files: publish to set topics instead, with writes: true in the output",
        "no slave: unit 1, as in newer versions; older ones asked 0 (and 1 more)",
    ]


def test_the_command_says_what_comes_next(tmp_path: Path) -> None:
    file = tmp_path / "modbus.yaml"
    file.write_text(HUB.replace("{entities}", "sensors: [{name: a, address: 1}]"))
    output = tmp_path / "plant.yaml"
    command = ["import", "home-assistant", str(file), "--output", str(output)]
    result = CliRunner().invoke(main, command)
    assert result.exit_code == 0, result.output
    assert f"next: holdfast check {output}" in result.stderr
    assert load(output).devices["inverter"].unit == 1

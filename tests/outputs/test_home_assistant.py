"""Discovery: entities that Home Assistant takes, with states, commands and availability."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.config.models.devices import DeviceIdentityConfig
from holdfast.config.models.outputs import MqttOutputConfig
from holdfast.outputs import sender
from holdfast.outputs.device_access import DeviceInfo
from holdfast.outputs.mqtt.home_assistant import Discovery
from holdfast.outputs.mqtt.messages import Payloads
from holdfast.tags import Tag
from holdfast.tags.scale import RegisterScale
from support import wire
from support.home_assistant import UNITS, Entity, entity
from support.mqtt_plant import TAGS, Plant
from support.readings import reading, tag

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@pytest.fixture(autouse=True)
def short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("FIRST_PAUSE_S", "MAX_PAUSE_S", "CHECK_INTERVAL_S"):
        monkeypatch.setattr(sender, name, 0.05)


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[Plant]:
    with Plant(tmp_path) as started:
        yield started


def settings(**more: Any) -> MqttOutputConfig:
    fields = {"type": "mqtt", "url": "mqtt://127.0.0.1", "discovery": "homeassistant"}
    return MqttOutputConfig.model_validate(fields | {"writes": True} | more)


def found(of: Tag, device: str = "pump", **more: Any) -> Entity:
    """The only entity of a tag."""
    [made] = [
        each
        for each in all_of({device: [of]}, **more)
        if each.config.get("entity_category") != "diagnostic"
    ]
    return made


INFO = DeviceInfo("tcp://10.0.0.5:502, unit 1", "10.0.0.5", None, None, None)


def all_of(tags: dict[str, list[Tag]], info: DeviceInfo = INFO, **more: Any) -> list[Entity]:
    """All entities, in their order."""
    made = Discovery("home", settings(**more)).entities(tags, dict.fromkeys(tags, info))
    return [entity(*each) for each in made.items()]


STATES = {0: "off", 1: "it's on"}
ON_AT_170 = {85: "off", 170: "on"}

MOVING = RegisterScale("exponent", source=Tag("", "holding_registers", 1, "int16"))

COMPONENTS = [
    (tag(unit="W"), "sensor"),
    (tag(area="holding_registers", type="int16", scale=MOVING, writable=True), "sensor"),
    (tag(area="holding_registers", writable=True, min=5, max=5), "sensor"),
    (tag(area="holding_registers", writable=True, min=2e9), "sensor"),
    (tag(type="string:4"), "sensor"),
    (tag(type="uint16", states=STATES), "sensor"),
    (tag(area="coils", type="bool"), "binary_sensor"),
    (tag(type="bit:3"), "binary_sensor"),
    (tag(area="holding_registers", type="int16", scale=0.1, writable=True), "number"),
    (tag(area="holding_registers", type="float32", writable=True), "number"),
    (tag(area="holding_registers", type="bcd16", writable=True), "number"),
    (tag(area="holding_registers", type="uint16", states=STATES, writable=True), "select"),
    (tag(area="coils", type="bool", writable=True), "switch"),
    (tag(area="coils", type="bool", writable=True, states=STATES), "switch"),
]


@pytest.mark.parametrize(("of", "component"), COMPONENTS)
def test_each_kind_of_tag_is_a_valid_entity(of: Tag, component: str) -> None:
    assert found(of).component == component


@pytest.mark.parametrize("writes", [False, True])
@pytest.mark.parametrize(
    "of",
    [
        tag(area="coils", type="bool", states={0: "on", 1: "off"}, writable=True),
        tag(area="holding_registers", type="uint16", states=ON_AT_170, writable=True),
    ],
)
def test_what_is_on_or_off_by_its_states_is_a_switch(of: Tag, writes: bool) -> None:
    entity = found(of, writes=writes)
    assert entity.component == ("switch" if writes else "binary_sensor")
    assert (entity.config["payload_on"], entity.config["payload_off"]) == ("on", "off")


@pytest.mark.parametrize(
    "unit", sorted({unit for units in UNITS.values() for unit in units} | {"%", ""})
)
def test_units_have_a_class_that_takes_them(unit: str) -> None:
    """The parser checks the combination."""
    assert found(tag(unit=unit)).config.get("unit_of_measurement", "") == unit


OUTLET = {"area": "coils", "type": "bool", "device_class": "outlet"}


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"unit": "kWh"}, ("energy", "total_increasing", "kWh")),
        ({"unit": "kWh", "state_class": "total"}, ("energy", "total", "kWh")),
        ({"unit": "kWh", "state_class": "measurement"}, (None, "measurement", "kWh")),
        (
            {"unit": "kWh", "device_class": "energy_storage"},
            ("energy_storage", "measurement", "kWh"),
        ),
        ({"unit": "m³", "device_class": "water"}, ("water", "total_increasing", "m³")),
        ({"unit": "%", "device_class": "battery"}, ("battery", "measurement", "%")),
        (
            {"unit": "°", "device_class": "wind_direction"},
            ("wind_direction", "measurement_angle", "°"),
        ),
        ({"unit": "°C", "state_class": "total"}, (None, "total", "°C")),
        (
            {"unit": "h", "device_class": "duration", "state_class": "total_increasing"},
            ("duration", "total_increasing", "h"),
        ),
        ({"unit": "V", "device_class": "door"}, ("voltage", "measurement", "V")),
        ({"unit": "kVAr"}, (None, "measurement", "kVAr")),
        (
            {"unit": "kVAr", "device_class": "reactive_power"},
            ("reactive_power", "measurement", "kvar"),
        ),
        ({"type": "string:8", "device_class": "timestamp"}, ("timestamp", None, None)),
        ({"type": "uint16", "states": STATES, "device_class": "power"}, ("enum", None, None)),
        ({"type": "bit:3", "device_class": "door", "state_class": "total"}, ("door", None, None)),
        (OUTLET, (None, None, None)),
        (OUTLET | {"writable": True}, ("outlet", None, None)),
        (OUTLET | {"writable": True, "device_class": "door"}, (None, None, None)),
    ],
)
def test_the_classes_of_a_tag_are_those_of_its_entity(
    given: dict[str, Any], expected: tuple[str | None, ...]
) -> None:
    """The parser refuses what Home Assistant would."""
    config = found(tag(**given)).config
    keys = ("device_class", "state_class", "unit_of_measurement")
    assert tuple(config.get(key) for key in keys) == expected


def test_a_class_of_a_later_version_is_passed_on() -> None:
    made = Discovery("home", settings()).entities(
        {"pump": [tag(unit="W", device_class="grid", state_class="peak")]}, {"pump": INFO}
    )
    [message] = [value for topic, value in made.items() if topic.endswith("--t/config")]
    assert b'"device_class":"grid","state_class":"peak"' in message


def test_without_writes_everything_is_read_only() -> None:
    for of, _ in COMPONENTS:
        assert "command_topic" not in found(of, writes=False).config


def test_numbers_have_the_bounds_of_the_tag_or_of_its_registers() -> None:
    shared: dict[str, Any] = {"area": "holding_registers", "writable": True}
    given = found(tag(type="int16", scale=0.1, min=5, max=30, **shared)).config
    assert (given["min"], given["max"], given["step"]) == (5, 30, 0.1)
    own = found(tag(type="uint16", scale=2, offset=10, **shared)).config
    assert (own["min"], own["max"], own["step"]) == (10, 131080, 2)
    exact = tag(type="int16", scale=0.01, offset=273.15, **shared)
    ends = found(exact).config
    # In binary, the largest is 600.8199999999999, and Home Assistant would not send 600.82.
    assert (
        (ends["min"], ends["max"])
        == (-54.53, 600.82)
        == tuple(exact.value(end) for end in (-32768, 32767))
    )
    bcd = found(tag(type="bcd32", scale=-0.1, **shared)).config
    assert (bcd["min"], bcd["max"]) == (-9999999.9, 0)


def test_no_two_tags_have_one_id() -> None:
    names = {"a": ["b_c", "b-c", "b.c"], "a_b": ["c"], "a-b": ["c"], "a.b": ["c"], "a-": ["-b"]}
    tags = {device: [tag(name) for name in some] for device, some in names.items()}
    ids = [each.config["unique_id"] for each in all_of(tags)]
    assert len(set(ids)) == len(ids) == 7 + 1 + 2 * len(tags)


@pytest.mark.parametrize("form", ["plain", "json", "device"])
@pytest.mark.parametrize(
    ("of", "value", "shown"),
    [
        (tag(), 1.5, "1.5"),
        (tag(), None, "None"),
        (tag(area="holding_registers", writable=True, min=-5, max=30.5), 30.5, "30.5"),
        (tag(area="holding_registers", writable=True, min=-5, max=30), 30.5, "None"),
        (tag(area="holding_registers", writable=True, min=-5, max=30), None, "None"),
        (tag(area="holding_registers", type="float32", writable=True), -math.inf, "None"),
        (tag(area="holding_registers", type="uint64", writable=True), 2**64 - 1, str(2**64 - 1)),
        (tag(type="uint16", states=STATES), 1, "it's on"),
        (tag(type="uint16", states=STATES), 7, "None"),
        (tag(type="uint16", scale=0.5, states=STATES), 1.0, "it's on"),
        (tag(type="uint16", scale=0.5, states=STATES), 0.5, "None"),
        (tag(type="uint16", states=STATES), None, "None"),
        (tag(type="uint16", states=ON_AT_170), 170, "on"),
        (tag(type="uint16", states=ON_AT_170), 1, "None"),
        (tag(area="coils", type="bool"), True, "true"),
        (tag(area="coils", type="bool"), False, "false"),
        (tag(area="coils", type="bool"), None, "None"),
        (tag(area="coils", type="bool", states=STATES), True, "it's on"),
    ],
)
def test_a_published_value_is_what_is_shown(form: str, of: Tag, value: Any, shown: str) -> None:
    made = found(of, payload=form)
    [message] = Payloads(settings(payload=form)).messages([reading(value, tag=of)])
    assert message.topic[2:].decode() == made.config["state_topic"]
    assert made.shown(message.payload) == shown


def test_entities_appear_with_their_availability(plant: Plant) -> None:
    plant.device().set(215)
    probe = plant.probe("#")
    plant.run(discovery="homeassistant", writes=True)
    seen = probe.until("plant/holdfast/status/pump", "online")
    entities = [
        entity(message.topic, message.payload)
        for message in seen
        if message.topic.startswith("homeassistant/")
    ]
    shown = [each for each in entities if "entity_category" not in each.config]
    assert sorted(each.component for each in shown) == ["number", "select", "sensor", "switch"]
    topics = {message.topic for message in seen}
    for each in entities:
        assert {of["topic"] for of in each.config.get("availability", ())} <= topics
        # A device that answers while the output connects is online just before its values.
        while each.config["state_topic"] not in topics:
            topics.add(probe.get().topic)
    assert {each.config["device"]["name"] for each in shown} == {"pump"}


def test_a_device_has_its_maker_model_version_and_address() -> None:
    info = DeviceInfo("tcp://10.0.0.5:502, unit 1", "10.0.0.5", "Acme", "HF-1", "1.2")
    *_, made = all_of({"pump": [tag()]}, info)
    assert made.config["device"] == {
        "identifiers": ["holdfast_home_pump"],
        "name": "pump",
        "manufacturer": "Acme",
        "model": "HF-1",
        "sw_version": "1.2",
        "configuration_url": "http://10.0.0.5/",
        "via_device": "holdfast_home",
    }


@pytest.mark.parametrize(
    ("host", "page"),
    [
        ("plc.example", "http://plc.example/"),
        ("fd00::5", "http://[fd00::5]/"),
        ("127.0.0.1", None),
        ("::1", None),
        ("localhost", None),
        (None, None),
    ],
)
def test_a_device_on_the_network_has_a_link_to_its_page(host: str | None, page: str | None) -> None:
    *_, made = all_of({"pump": [tag()]}, INFO._replace(host=host))
    assert made.config["device"].get("configuration_url") == page


def test_connections_and_addresses_are_diagnostic_entities() -> None:
    hub, connection, address, value = all_of({"pump": [tag()]})
    assert hub.config["device"]["name"] == "Holdfast home"
    assert hub.config["state_topic"] == "plant/holdfast/status"
    assert "availability" not in hub.config
    assert connection.config["state_topic"] == "plant/holdfast/status/pump"
    assert connection.config["availability"] == [{"topic": "plant/holdfast/status"}]
    for each in (hub, connection):
        assert each.config["device_class"] == "connectivity"
        assert (each.config["payload_on"], each.config["payload_off"]) == ("online", "offline")
    assert address.shown(b"online") == address.shown(b"offline") == "tcp://10.0.0.5:502, unit 1"
    assert [each.config.get("entity_category") for each in (hub, connection, address, value)] == [
        *["diagnostic"] * 3,
        None,
    ]


def test_a_reload_publishes_another_maker(plant: Plant) -> None:
    plant.device()
    probe = plant.probe("#")
    appliance = plant.run(discovery="homeassistant")
    probe.until("plant/holdfast/status/pump", "online")
    config = plant.config({"discovery": "homeassistant"})
    pump = config.devices["pump"]
    identity = DeviceIdentityConfig(vendor_name="Acme")
    changed = pump.model_copy(update={"identity": identity})
    appliance.reload(config.model_copy(update={"devices": {"pump": changed}}))
    topic = "homeassistant/binary_sensor/holdfast_home/pump-connection/config"
    found = entity(topic, probe.next_of(topic).payload).config["device"]
    assert (found["manufacturer"], found["name"]) == ("Acme", "pump")


def test_a_reload_publishes_another_class(plant: Plant) -> None:
    plant.device()
    probe = plant.probe("#")
    appliance = plant.run(discovery="homeassistant")
    probe.until("plant/holdfast/status/pump", "online")
    valve = {**TAGS["valve"], "device_class": "opening"}
    appliance.reload(plant.config({"discovery": "homeassistant"}, {**TAGS, "valve": valve}))
    topic = "homeassistant/binary_sensor/holdfast_home/pump--valve/config"
    assert b'"device_class":"opening"' in probe.next_of(topic).payload


DIAGNOSTICS = 3
"""The diagnostic entities of an output with one device."""


def configs(plant: Plant) -> set[str]:
    """The retained discovery topics of the broker."""
    probe = plant.probe("homeassistant/#")
    probe.publish("homeassistant/end", "end")
    seen = probe.until("homeassistant/end", "end")
    return {message.topic for message in seen if message.topic.endswith("/config")}


def test_a_start_of_home_assistant_has_entities_published_again(plant: Plant) -> None:
    plant.device()
    probe = plant.probe("#")
    plant.run(discovery="homeassistant")
    probe.until("plant/holdfast/status/pump", "online")
    probe.publish("homeassistant/status", "online")
    topic = "homeassistant/binary_sensor/holdfast_home/pump--valve/config"
    assert entity(topic, probe.next_of(topic).payload)


def test_removed_entities_disappear_with_a_reload(plant: Plant) -> None:
    plant.device()
    probe = plant.probe("#")
    appliance = plant.run(discovery="homeassistant")
    probe.until("plant/holdfast/status/pump", "online")
    tags = {name: of for name, of in TAGS.items() if name != "valve"}
    appliance.reload(plant.config({"discovery": "homeassistant"}, tags))
    probe.until("plant/pump/valve", "")
    probe.until("homeassistant/binary_sensor/holdfast_home/pump--valve/config", "")
    assert len(configs(plant)) == 3 + DIAGNOSTICS


@pytest.mark.parametrize("after", [{"discovery": "homeassistant", "discovery_prefix": "ha"}, {}])
def test_a_reload_with_another_prefix_or_without_discovery_removes_all_entities(
    plant: Plant, after: dict[str, str]
) -> None:
    plant.device()
    probe = plant.probe("#")
    appliance = plant.run(discovery="homeassistant")
    probe.until("plant/holdfast/status/pump", "online")
    assert configs(plant)
    appliance.reload(plant.config(after))
    wire.until(lambda: not configs(plant), "all are removed")


def test_the_output_is_online_before_its_entities_are_published(plant: Plant) -> None:
    plant.device()
    probe = plant.probe("#")
    plant.run(discovery="homeassistant")
    seen = probe.until("plant/holdfast/status", "online")
    assert not [each for each in seen if each.topic.startswith("homeassistant/")]


@pytest.mark.parametrize("version", ["5", "3.1.1"])
def test_entities_that_were_removed_while_it_was_stopped_disappear(
    plant: Plant, version: str
) -> None:
    plant.device()
    probe = plant.probe("#")
    plant.run(discovery="homeassistant", version=version)
    probe.until("plant/holdfast/status/pump", "online")
    plant.stop()
    foreign = "homeassistant/sensor/other/pump/config"
    probe.publish(foreign, "{}", retain=True)
    tags = {name: of for name, of in TAGS.items() if name != "valve"}
    plant.run(tags, discovery="homeassistant", version=version)
    wire.until(lambda: len(configs(plant)) == 4 + DIAGNOSTICS, "one of ours is gone")
    assert foreign in configs(plant)

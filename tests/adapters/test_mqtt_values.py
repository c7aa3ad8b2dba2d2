"""Topics with plain values: what their messages write, and what is refused."""

from __future__ import annotations

import struct
from contextlib import closing
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.appliance import Appliance
from holdfast.config.models.root import MappedTag
from holdfast.config.models.services import MqttConfig
from holdfast.tags import Tag
from support import wire
from support.config_folder import Folder, written
from support.mqtt_rig import Rig, Running, settings
from support.nats_bus import logged
from support.tcp_proxy import Proxy

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

TOPIC = "sensors/boiler/temp"


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with Rig(tmp_path) as started:
        yield started


def config(url: str, tag: dict[str, Any], *subscriptions: Any, **more: Any) -> MqttConfig:
    entry = {"topic": TOPIC, "memory": "plant", "tag": tag} | more.pop("entry", {})
    return settings(url, *subscriptions, map=[entry], **more)


def started(rig: Rig, tag: dict[str, Any], **more: Any) -> tuple[Running, Any]:
    """An adapter with one topic, and a client."""
    broker = rig.broker()
    found = config(broker.url, tag, **more)
    mapped = {TOPIC: MappedTag("plant", Tag("tag", **tag))}
    running = rig.run(found, mapped=mapped)
    running.wait_until_connected()
    return running, rig.probe(broker)


REGISTER = {"area": "holding_registers", "address": 4}

WRITTEN: list[tuple[dict[str, Any], str, list[int]]] = [
    (REGISTER | {"type": "uint16"}, "21", [21]),
    (REGISTER | {"type": "int16", "scale": 0.1}, "-21.5", [65536 - 215]),
    (REGISTER | {"type": "int16", "scale": 0.1}, "21.53", [215]),
    (REGISTER | {"type": "int16", "scale": 0.1}, "-21.57", [65536 - 216]),
    (REGISTER | {"type": "uint16"}, "1.5", [2]),
    (REGISTER | {"type": "uint16", "round": "nearest"}, "2.5", [2]),
    (REGISTER | {"type": "uint16[2]", "scale": 0.5}, "[0.74, 1]", [1, 2]),
    (REGISTER | {"type": "float32"}, "21.5", list(struct.unpack(">HH", struct.pack(">f", 21.5)))),
    (REGISTER | {"type": "float32"}, "1e-400", [0, 0]),
    (REGISTER | {"type": "float32[2]"}, "[1e-400, 1e-46]", [0, 0, 0, 0]),
    (REGISTER | {"type": "uint32", "order": "CDAB"}, "65538", [2, 1]),
    (REGISTER | {"type": "uint16", "states": {0: "off", 3: "fault"}}, "fault", [3]),
    (REGISTER | {"type": "string:2"}, "ab", [0x6162, 0]),
    (REGISTER | {"type": "uint16[2]"}, "[7, 8]", [7, 8]),
]


@pytest.mark.parametrize(("tag", "text", "values"), WRITTEN)
def test_a_plain_value_is_written_by_its_tag(
    rig: Rig, tag: dict[str, Any], text: str, values: list[int]
) -> None:
    running, probe = started(rig, tag)
    probe.publish(TOPIC, text)
    running.wait_until_received(1)
    assert rig.registers(4, len(values)) == values


def test_a_value_that_is_published_during_an_outage_is_written(rig: Rig) -> None:
    broker = rig.broker()
    with closing(Proxy(broker.port)) as proxy:
        mapped = {TOPIC: MappedTag("plant", Tag("tag", "holding_registers", 4))}
        running = rig.run(config(proxy.url, REGISTER), mapped=mapped)
        running.wait_until_connected()
        probe = rig.probe(broker)
        probe.publish(TOPIC, "10", retain=True)
        running.wait_until_received(1)
        proxy.down()
        probe.publish(TOPIC, "20", retain=True)
        proxy.up()
        running.wait_until_received(2)
    assert rig.registers(4, 1) == [20]


def test_a_coil_takes_words(rig: Rig) -> None:
    running, probe = started(rig, {"area": "coils", "address": 2, "type": "bool"})
    probe.publish(TOPIC, "on")
    running.wait_until_received(1)
    assert rig.memory.read("coils", 2, 1) == [1]


@pytest.mark.parametrize(
    "payload", [b"", b"warm", b"21,5", b"\xff", b"1e999", b"70000", b"65535.5", b"9" * 5000, b"nan"]
)
def test_a_bad_payload_is_refused_counted_and_logged(
    rig: Rig, payload: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    rig.memory.write("holding_registers", 4, [77])
    running, probe = started(rig, REGISTER | {"type": "uint16"})
    probe.publish(TOPIC, payload)
    running.wait_until_received(1)
    counts: Any = rig.memory_access.counts()
    assert counts["refused"] == {"invalid_value": 1}
    assert rig.registers(4, 1) == [77]
    assert "ingest_refused" in [record.message for record in caplog.records]
    probe.publish(TOPIC, "5")
    running.wait_until_received(2)
    assert rig.registers(4, 1) == [5]


@pytest.mark.parametrize("kind", ["string:2", "bytes:2", "uint16"])
def test_an_empty_payload_leaves_the_value(
    rig: Rig, kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    rig.memory.write("holding_registers", 4, [0x6162])
    running, probe = started(rig, REGISTER | {"type": kind})
    probe.publish(TOPIC, b"")
    running.wait_until_received(1)
    [fields] = refusals(caplog)
    assert (fields["reason"], fields["cause"]) == ("invalid_value", "the payload is empty")
    assert rig.registers(4, 1) == [0x6162]


REFUSED: list[tuple[dict[str, Any], str, str, float | None]] = [
    (
        {"scale": 0.1, "round": "exact"},
        "21.53",
        "21.53 is between two values of the registers, allowed: steps of 0.1",
        0.1,
    ),
    ({"scale": 0.1}, "6553.6", "65536 is outside 0 to 65535 of uint16", 0.1),
    (
        {"scale": 0.5, "max": 20.3},
        "20.3",
        "20.3 is 20.5 in steps of 0.5, outside the limits, allowed: up to 20.3",
        0.5,
    ),
    ({"scale": 0.1}, "warm", "'warm' is not a number", 0.1),
    (
        {"states": {0: "off", 1: "on"}},
        "0.7",
        "0.7 is between two values of the registers, allowed: steps of 1",
        None,
    ),
]


@pytest.mark.parametrize(("tag", "text", "cause", "step"), REFUSED)
def test_a_refusal_names_the_tag_the_value_the_step_and_the_cause(
    rig: Rig,
    tag: dict[str, Any],
    text: str,
    cause: str,
    step: float | None,
    caplog: pytest.LogCaptureFixture,
) -> None:
    running, probe = started(rig, REGISTER | tag)
    probe.publish(TOPIC, text)
    running.wait_until_received(1)
    [fields] = refusals(caplog)
    named = {key: fields.get(key) for key in ("tag", "value", "step", "cause", "address")}
    expected = {"tag": "tag", "value": text, "step": step, "cause": cause, "address": 4}
    assert named == expected
    assert rig.registers(4, 1) == [0]


def test_of_the_bad_values_of_a_topic_one_is_logged(
    rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    running, probe = started(rig, REGISTER | {"round": "exact"})
    for number in range(9):
        probe.publish(TOPIC, f"{number}.5")
    running.wait_until_received(9)
    counts: Any = rig.memory_access.counts()
    assert counts["refused"] == {"invalid_value": 9}
    assert [fields["value"] for fields in refusals(caplog)] == ["0.5"]


def test_the_bad_values_of_each_topic_are_logged_and_the_others_counted(
    rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    """The broker has an IP address: it is one source for all topics."""
    topics = [f"sensors/{number}" for number in range(20)]
    tag: dict[str, Any] = REGISTER | {"round": "exact"}
    broker = rig.broker()
    entries = [{"topic": topic, "memory": "plant", "tag": tag} for topic in topics]
    mapped = {topic: MappedTag("plant", Tag("tag", **tag)) for topic in topics}
    running = rig.run(settings(broker.url, map=entries), mapped=mapped)
    running.wait_until_connected()
    probe = rig.probe(broker)
    for topic in topics * 3:
        probe.publish(topic, "0.5")
    running.wait_until_received(60)
    assert [fields["source"] for fields in refusals(caplog)] == topics
    running.stop()
    held_back = logged(caplog, "held_back")
    assert [(fields["source"], fields["count"]) for fields in held_back] == [
        (topic, 2) for topic in topics
    ]


def refusals(caplog: pytest.LogCaptureFixture) -> list[dict[str, Any]]:
    """The fields of the refusals in the log."""
    records = [record for record in caplog.records if record.message == "ingest_refused"]
    return [vars(record)["fields"] for record in records]


def test_values_and_commands_have_topics_of_their_own(rig: Rig) -> None:
    running, probe = started(rig, REGISTER, entry={"qos": 1})
    probe.publish("plant/ingest", "21")
    running.wait_until_received(1)
    counts: Any = rig.memory_access.counts()
    assert counts["refused"] == {"malformed": 1}


def appliance(url: str, address: int = 0) -> str:
    tags = {"flow": {"area": "input_registers", "address": address, "type": "uint16", "scale": 0.1}}
    entry = {"topic": TOPIC, "memory": "plant", "profile": "sensors", "name": "flow"}
    return written(
        {
            "memories": {"plant": {"input_registers": 10}},
            "profiles": {"sensors": {"tags": tags}},
            "mqtt": {"url": url, "client_id": "values", "map": [entry]},
        }
    )


def test_a_tag_of_a_profile_follows_a_reload(rig: Rig, tmp_path: Path) -> None:
    broker = rig.broker()
    folder = Folder(tmp_path)
    with Appliance(folder.config(appliance(broker.url))) as running:
        memory = running.memories["plant"]
        probe = rig.probe(broker)
        probe.publish(TOPIC, "1.5", retain=True)
        wire.until(lambda: memory.read("input_registers", 0, 1) == [15], "written")
        running.reload(folder.config(appliance(broker.url, address=3)))
        wire.until(lambda: memory.read("input_registers", 3, 1) == [15], "written elsewhere")


ENTRY = "{topic: a, memory: plant, tag: {area: coils, address: 0}}"


@pytest.mark.parametrize(
    ("entries", "problem"),
    [
        ("", "mqtt.subscriptions: missing, allowed: a list with at least one entry"),
        (f"{ENTRY}, {ENTRY}", "mqtt.map[1].topic: found 'a'"),
        ("{topic: a/#, memory: plant, tag: {area: coils, address: 0}}", "mqtt.map[0].topic: "),
        ("{topic: a, memory: plnt, tag: {area: coils, address: 0}}", "did you mean 'plant'?"),
        (
            "{topic: a, memory: plant}",
            "mqtt.map[0].tag: missing, allowed: tag, or profile and name",
        ),
        (
            "{topic: a, memory: plant, tag: {area: coils, address: 0}, profile: p}",
            "mqtt.map[0].profile: found together with tag",
        ),
        ("{topic: a, memory: plant, profile: p, name: t}", "none, there are no profiles"),
        (
            "{topic: a, memory: plant, tag: {area: holding_registers, address: 0}}",
            "found holding_registers, which the memory plant does not have",
        ),
        (
            "{topic: a, memory: plant, tag: {area: coils, address: 16}}",
            "found coils 16 to 16, allowed: addresses 0 to 15",
        ),
        (
            "{topic: a, memory: plant, tag: {area: input_registers, address: 0, type: 'bit:3'}}",
            "mqtt.map[0].tag.type: found the type bit:3",
        ),
        (
            "{topic: a, memory: plant, tag: {area: input_registers, address: 0, type: what}}",
            "mqtt.map[0].tag.type: ",
        ),
        (
            "{topic: a, memory: plant, tag: {area: input_registers, address: 0, "
            "scale: {from: sf, as: exponent}}}",
            "mqtt.map[0].tag.scale: the scale is the exponent from sf, allowed: a number",
        ),
    ],
)
def test_errors_in_a_map_are_named(tmp_path: Path, entries: str, problem: str) -> None:
    text = (
        "memories: {plant: {coils: 16, input_registers: 4}}\n"
        "mqtt: {url: 'mqtt://127.0.0.1', client_id: a, map: [" + entries + "]}\n"
    )
    found = Folder(tmp_path).problems(text)
    assert any(problem in each for each in found), found


def test_subscriptions_are_optional_with_a_map(tmp_path: Path) -> None:
    text = (
        "memories: {plant: {coils: 16}}\n"
        "mqtt: {url: 'mqtt://127.0.0.1', client_id: a, map: [" + ENTRY + "]}\n"
    )
    assert Folder(tmp_path).config(text).mqtt_tags()["a"].memory == "plant"

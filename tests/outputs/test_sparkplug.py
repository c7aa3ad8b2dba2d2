"""Sparkplug outputs with a real broker: sessions, births, data and deaths."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.outputs import sender
from holdfast.outputs.mqtt import session
from holdfast.outputs.sparkplug import primary_host
from support import wire
from support.mqtt_plant import TAGS, Plant
from support.sparkplug_watch import SETTINGS, Said, Watch
from support.tcp_proxy import Proxy

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

REBIRTH: dict[str, Any] = {"name": "Node Control/Rebirth", "datatype": 11, "boolean_value": True}


@pytest.fixture(autouse=True)
def short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("FIRST_PAUSE_S", "MAX_PAUSE_S", "CHECK_INTERVAL_S"):
        monkeypatch.setattr(sender, name, 0.05)
    monkeypatch.setattr(primary_host, "HOST_STATE_TIMEOUT_S", 0.05)


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[Plant]:
    with Plant(tmp_path) as started:
        yield started


@pytest.fixture
def proxy(plant: Plant) -> Iterator[Proxy]:
    """A proxy between the node and the broker."""
    made = Proxy(plant.broker.port)
    yield made
    if plant.appliance is not None:
        plant.stop()
    made.close()


def watch(plant: Plant) -> Watch:
    return Watch(plant.probe("spBv1.0/plant/#"))


def session_of(said: Said) -> int:
    return int(said.metrics["bdSeq"].long_value)


def first_values_wait(plant: Plant) -> None:
    wire.until(partial(plant.has_waiting, len(TAGS)), "the first values wait")


def all_are_sent(plant: Plant) -> None:
    wire.until(lambda: not plant.status()["waiting"], "all values are sent")


def the_host_is_missed(plant: Plant) -> None:
    missing = "the primary host scada is offline"
    wire.until(lambda: plant.status().get("last_error") == missing, "the node is connected")


def set_and_wait(plant: Plant, value: int) -> None:
    """Has a value polled that can't be sent."""
    waiting = plant.status()["waiting"]
    plant.devices["pump"].set(value)
    wire.until(partial(plant.has_waiting, waiting + 1), "the value waits")


@pytest.mark.parametrize("version", ["3.1.1", "5"])
def test_a_session_has_births_then_data_then_a_death(plant: Plant, version: str) -> None:
    device = plant.device()
    device.set(215)
    watching = watch(plant)
    plant.run(**SETTINGS, version=version)
    node = watching.next()
    assert node.kind == "NBIRTH"
    assert set(node.metrics) == {"bdSeq", "Node Control/Rebirth"}
    rebirth = node.metrics["Node Control/Rebirth"]
    assert (rebirth.datatype, rebirth.boolean_value) == (11, False)
    assert not rebirth.HasField("alias")
    assert (node.metrics["bdSeq"].datatype, session_of(node)) == (4, 0)
    birth = watching.until("DBIRTH", "pump")
    assert set(birth.metrics) == {"temperature", "state", "flow", "valve"}
    temperature = birth.metrics["temperature"]
    assert (temperature.datatype, temperature.double_value) == (10, 21.5)
    assert list(temperature.properties.keys) == ["Quality", "engUnit"]
    assert temperature.properties.values[0].int_value == 192
    assert temperature.properties.values[1].string_value == "°C"
    device.set(216)
    data = watching.until_value(birth, "temperature", 21.6, "double_value")
    assert all(metric.timestamp and not metric.name for metric in data.payload.metrics)
    numbers = watching.sequence()
    assert numbers == list(range(len(numbers)))
    assert {(said.qos, said.retain) for said in watching.said} == {(0, False)}
    plant.stop()
    death = watching.until("NDEATH")
    assert [metric.name for metric in death.payload.metrics] == ["bdSeq"]
    assert (session_of(death), death.payload.HasField("seq")) == (0, False)


@pytest.mark.parametrize("version", ["3.1.1", "5"])
def test_an_end_that_was_not_confirmed_has_the_will(
    plant: Plant, version: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "STOP_TIMEOUT_S", 0.0)
    plant.device()
    watching = watch(plant)
    plant.run(**SETTINGS, version=version)
    wire.until(lambda: plant.status().get("born"), "the broker has confirmed the births")
    plant.stop()
    while watching.next().kind != "NDEATH":
        pass


def test_a_rebirth_is_a_new_birth_in_the_same_session(plant: Plant) -> None:
    plant.device()
    watching = watch(plant)
    plant.run(**SETTINGS)
    watching.until("DBIRTH", "pump")
    watching.command(None, **REBIRTH)
    node = watching.until("NBIRTH")
    assert (node.payload.seq, session_of(node)) == (0, 0)
    assert watching.next().kind == "DBIRTH"


def test_commands_that_make_no_sense_change_nothing(plant: Plant) -> None:
    plant.device()
    watching = watch(plant)
    plant.run(**SETTINGS)
    watching.until("DBIRTH", "pump")
    watching.raw_command(None, b"\xff" * 100)
    watching.command(None, name="Node Control/Reboot", datatype=11, boolean_value=True)
    watching.command(None, **{**REBIRTH, "boolean_value": False})
    watching.command(None, **REBIRTH)
    watching.until("NBIRTH")
    assert [said.kind for said in watching.said].count("NBIRTH") == 2
    assert plant.status()["commands_ignored"] == 2


def test_a_retained_rebirth_request_is_no_request(plant: Plant) -> None:
    plant.device()
    watching = watch(plant)
    watching.command(None, retain=True, **REBIRTH)
    plant.run(**SETTINGS)
    wire.until(lambda: plant.status().get("born"), "the node is born")
    watching.command(None, name="other")
    wire.until(lambda: plant.status()["commands_ignored"] == 2, "both are ignored")
    assert plant.status()["births"] == 1


def test_a_lost_connection_ends_the_session_with_the_will(plant: Plant, proxy: Proxy) -> None:
    device = plant.device()
    watching = watch(plant)
    plant.run(**SETTINGS, url=proxy.url)
    watching.until("DBIRTH", "pump")
    all_are_sent(plant)
    proxy.down()
    death = watching.until("NDEATH")
    assert (session_of(death), death.qos, death.retain) == (0, 1, False)
    device.set(7)
    wire.until(partial(plant.has_waiting, 1), "a value waits")
    device.set(8)
    wire.until(partial(plant.has_waiting, 2), "another value waits")
    proxy.up()
    node = watching.until("NBIRTH")
    assert node.payload.seq == 0
    assert session_of(node) > 0, "each attempt to connect has a number of its own"
    birth = watching.until("DBIRTH", "pump")
    assert birth.metrics["temperature"].double_value == 0.8
    late = watching.until("DDATA", "pump")
    [metric] = late.aliased(birth.metrics["temperature"].alias)
    assert (metric.double_value, metric.is_historical) == (0.7, True)
    device.set(9)
    data = watching.until_value(birth, "temperature", 0.9, "double_value")
    assert not data.payload.metrics[-1].is_historical


def test_what_the_broker_did_not_read_is_sent_again(plant: Plant, proxy: Proxy) -> None:
    plant.device()
    watching = watch(plant)
    plant.run(**SETTINGS, url=proxy.url)
    watching.until("DBIRTH", "pump")
    all_are_sent(plant)
    sent = plant.status()["readings"]["sent"]
    proxy.swallows = True
    set_and_wait(plant, 7)
    set_and_wait(plant, 8)
    assert plant.status()["readings"]["sent"] == sent
    proxy.cut()
    proxy.swallows = False
    birth = watching.until("NBIRTH") and watching.until("DBIRTH", "pump")
    watching.until_value(birth, "temperature", 0.7, "double_value")


def test_a_device_that_does_not_answer_dies_and_is_born_again(plant: Plant) -> None:
    device = plant.device()
    watching = watch(plant)
    plant.run(**SETTINGS)
    first = watching.until("DBIRTH", "pump")
    device.stop()
    death = watching.until("DDEATH", "pump")
    assert death.payload.seq > first.payload.seq
    device.set(50)
    device.start()
    again = watching.until("DBIRTH", "pump")
    assert again.metrics["temperature"].double_value == 5.0
    aliases = [{metric.alias for metric in birth.payload.metrics} for birth in (first, again)]
    assert not aliases[0] & aliases[1]
    assert "NBIRTH" not in [said.kind for said in watching.said[1:]]
    numbers = watching.sequence()
    assert numbers == list(range(len(numbers)))


def test_a_value_that_disappears_is_null_and_bad(plant: Plant) -> None:
    device = plant.device()
    watching = watch(plant)
    plant.run(**SETTINGS)
    birth = watching.until("DBIRTH", "pump")
    alias = birth.metrics["flow"].alias

    def is_null(wanted: bool, said: Said) -> bool:
        return [metric.is_null for metric in said.aliased(alias)] == [wanted]

    device.memory.write("input_registers", 0, [0x7FC0, 0])
    [gone] = watching.until("DDATA", "pump", partial(is_null, True)).aliased(alias)
    assert gone.properties.values[0].int_value == 0
    assert not gone.HasField("float_value")
    device.memory.write("input_registers", 0, [0x41AC, 0])
    [back] = watching.until("DDATA", "pump", partial(is_null, False)).aliased(alias)
    assert (back.float_value, back.properties.values[0].int_value) == (21.5, 192)


def test_nothing_is_published_before_the_primary_host_is_online(plant: Plant) -> None:
    plant.device()
    watching = watch(plant)
    plant.run(**SETTINGS, primary_host="scada")
    first_values_wait(plant)
    the_host_is_missed(plant)
    watching.host("other", 1000, online=True)
    watching.host("scada", 1000, online=False)
    watching.host("scada", 999, online=True)
    set_and_wait(plant, 6)
    assert not plant.status()["primary_host_online"]
    watching.host("scada", 1001, online=True)
    assert watching.next().kind == "NBIRTH"
    assert watching.until("DBIRTH", "pump").metrics["temperature"].double_value == 0.6


def test_the_session_ends_with_the_primary_host(plant: Plant) -> None:
    plant.device()
    watching = watch(plant)
    watching.host("scada", 1000, online=True)
    plant.run(**SETTINGS, primary_host="scada")
    watching.until("DBIRTH", "pump")
    wire.until(lambda: plant.status()["born"], "the broker has confirmed the births")
    watching.host("scada", 999, online=False)
    watching.raw_command(None, b"")
    watching.command(None, name="marker")
    wire.until(lambda: plant.status()["commands_ignored"], "the old state has come")
    assert plant.status()["born"]
    watching.host("scada", 1000, online=False)
    assert session_of(watching.until("NDEATH")) == 0
    set_and_wait(plant, 7)
    set_and_wait(plant, 8)
    watching.host("scada", 1002, online=True)
    node = watching.until("NBIRTH")
    assert session_of(node) > 0
    birth = watching.until("DBIRTH", "pump")
    [late] = watching.until("DDATA", "pump").aliased(birth.metrics["temperature"].alias)
    assert (late.double_value, late.is_historical) == (0.7, True)


def test_a_malformed_state_is_ignored(plant: Plant) -> None:
    plant.device()
    watching = watch(plant)
    client = plant.probe()
    client.publish("spBv1.0/STATE/scada", "ONLINE", retain=True)
    plant.run(**SETTINGS, primary_host="scada")
    the_host_is_missed(plant)
    for text in (
        "",
        "[]",
        "ONLINE",
        '{"online": 1, "timestamp": 5}',
        '{"online": true}',
        "[" * 9999,
    ):
        client.publish("spBv1.0/STATE/scada", text)
    client.publish("spBv1.0/STATE/scada", '{"online": true, "timestamp": 5}')
    watching.until("DBIRTH", "pump")


def test_a_reload_is_a_new_birth(plant: Plant) -> None:
    plant.device()
    plant.device("fan")
    watching = watch(plant)
    appliance = plant.run(**SETTINGS)
    while len(watching.births()) < 2:
        watching.next()
    del plant.devices["fan"]
    tags = {"new": {"area": "coils", "address": 5}}
    appliance.reload(plant.config(SETTINGS, tags))
    watching.until("DDEATH", "fan")
    node = watching.until("NBIRTH")
    assert session_of(node) == 0
    assert set(watching.until("DBIRTH", "pump").metrics) == {"new"}


def test_a_device_that_a_reload_moves_is_born_again_when_it_answers(plant: Plant) -> None:
    plant.device().set(100)
    watching = watch(plant)
    appliance = plant.run(**SETTINGS)
    assert watching.until("DBIRTH", "pump").metrics["temperature"].double_value == 10.0
    other = plant.slow_device()
    plant.devices["pump"].set(200)
    other.hold()
    appliance.reload(plant.config(SETTINGS))
    watching.until("DDEATH", "pump")
    other.go_on()
    assert watching.until("DBIRTH", "pump").metrics["temperature"].double_value == 20.0
    assert [said.kind for said in watching.said].count("DBIRTH") == 2


def test_values_from_before_a_restart_are_published_for_a_device_that_is_gone(
    plant: Plant,
) -> None:
    device = plant.device()
    watching = watch(plant)
    buffer = {"file": "kept.db"}
    plant.run(**SETTINGS, primary_host="scada", buffer=buffer)
    first_values_wait(plant)
    set_and_wait(plant, 5)
    plant.stop()
    device.stop()
    watching.host("scada", 1, online=True)
    plant.run(**SETTINGS, primary_host="scada", buffer=buffer)
    birth = watching.until("DBIRTH", "pump")
    assert birth.metrics["temperature"].is_null
    data = watching.until_value(birth, "temperature", 0.5, "double_value")
    assert all(metric.is_historical for metric in data.payload.metrics)
    watching.until("DDEATH", "pump")


def test_only_some_devices(plant: Plant) -> None:
    plant.device()
    plant.device("fan")
    watching = watch(plant)
    plant.run(TAGS, **SETTINGS, devices=["fan"])
    assert watching.next().kind == "NBIRTH"
    assert watching.next().device == "fan"
    plant.stop()
    watching.until("NDEATH")
    assert {said.device for said in watching.said} == {None, "fan"}

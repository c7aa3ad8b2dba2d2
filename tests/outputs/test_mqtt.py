"""MQTT outputs with a real broker: what is published, and what an outage costs."""

from __future__ import annotations

import itertools
import subprocess
from datetime import datetime
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.outputs import sender
from holdfast.outputs.mqtt import session
from support import wire
from support.certificates import Certificates
from support.machine import tool
from support.mqtt_plant import Plant, texts
from support.polled import until_polled

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


@pytest.mark.parametrize("version", ["5", "3.1.1"])
def test_values_are_published_as_plain_text(plant: Plant, version: str) -> None:
    device = plant.device()
    device.set(215)
    probe = plant.probe("plant/#")
    plant.run(version=version)
    probe.until("plant/pump/temperature", "21.5")
    device.set(216)
    probe.until("plant/pump/temperature", "21.6")


def test_values_are_retained(plant: Plant) -> None:
    plant.device().set(215)
    first = plant.probe("plant/#")
    plant.run()
    first.until("plant/pump/valve", "false")
    late = plant.probe("plant/#")
    seen = late.until("plant/pump/valve", "false")
    assert texts(seen, "plant/pump/state") in (["off"], [])


def test_status_is_online_then_offline(plant: Plant) -> None:
    plant.device()
    probe = plant.probe("plant/holdfast/#")
    plant.run()
    probe.until("plant/holdfast/status", "online")
    probe.until("plant/holdfast/status/pump", "online")
    plant.stop()
    probe.until("plant/holdfast/status", "offline")


@pytest.mark.parametrize("version", ["5", "3.1.1"])
def test_status_is_online_again_if_somebody_else_publishes_offline(
    plant: Plant, version: str
) -> None:
    plant.device()
    probe = plant.probe("plant/holdfast/status")
    plant.run(version=version, writes=True)
    probe.until("plant/holdfast/status", "online")
    wire.until(lambda: plant.count("sent") >= 4, "sent")
    for _ in range(2):
        plant.broker.publish("plant/holdfast/status", "offline", "-r")
        probe.until("plant/holdfast/status", "offline")
        probe.until("plant/holdfast/status", "online")


def test_a_device_that_does_not_answer_is_offline(plant: Plant) -> None:
    device = plant.device()
    probe = plant.probe("plant/#")
    plant.run()
    probe.until("plant/holdfast/status/pump", "online")
    device.stop()
    seen = probe.until("plant/holdfast/status/pump", "offline")
    assert "" not in texts(seen, "plant/pump/temperature")
    probe.until("plant/pump/temperature", "")
    device.set(100)
    device.start()
    seen = probe.until("plant/holdfast/status/pump", "online")
    if "10.0" not in texts(seen, "plant/pump/temperature"):
        probe.until("plant/pump/temperature", "10.0")


def test_a_device_is_offline_from_a_start_until_it_answers(plant: Plant) -> None:
    """The broker has kept `online` and the values of the run before."""
    device = plant.slow_device()
    probe = plant.probe("plant/holdfast/#")
    plant.run()
    probe.until("plant/holdfast/status/pump", "online")
    plant.stop()
    probe.until("plant/holdfast/status", "offline")
    device.hold()
    plant.run()
    seen = probe.until("plant/holdfast/status", "online")
    assert texts(seen, "plant/holdfast/status/pump") == ["offline"]
    device.go_on()
    probe.until("plant/holdfast/status/pump", "online")


def test_a_device_that_a_reload_moves_is_offline_until_it_answers(plant: Plant) -> None:
    plant.device().set(100)
    probe = plant.probe("plant/#")
    appliance = plant.run()
    probe.until("plant/pump/temperature", "10.0")
    probe.until("plant/holdfast/status/pump", "online")
    other = plant.slow_device()
    plant.devices["pump"].set(200)
    other.hold()
    appliance.reload(plant.config({}))
    probe.until("plant/holdfast/status/pump", "offline")
    other.go_on()
    seen = probe.until("plant/holdfast/status/pump", "online")
    assert texts(seen, "plant/pump/temperature") == ["20.0"], "no poll has failed"


def test_what_another_output_after_a_reload_does_not_publish_is_removed(plant: Plant) -> None:
    plant.device()
    plant.device("fan")
    probe = plant.probe("plant/#")
    appliance = plant.run(COUNTED)

    def until_removed(*topics: str) -> None:
        left = set(topics)
        while left:
            message = probe.get()
            if not message.payload:
                left.remove(message.topic)

    probe.until("plant/fan/n", "0")
    appliance.reload(plant.config({"devices": ["pump"]}, COUNTED))
    until_removed("plant/fan/n", "plant/holdfast/status/fan")
    wire.until(lambda: plant.count("sent") >= 1, "the other device is published")
    appliance.reload(plant.config({"topic": "site/{device}/{tag}"}, COUNTED))
    until_removed("plant/pump/n", "plant/holdfast/status/pump", "plant/holdfast/status")


def test_json_has_value_time_unit_and_state(plant: Plant) -> None:
    device = plant.device()
    device.set(215)
    device.set(1, address=1)
    probe = plant.probe("plant/#")
    plant.run(payload="json")
    temperature = probe.json("plant/pump/temperature")
    assert (temperature["value"], temperature["unit"]) == (21.5, "°C")
    assert datetime.fromisoformat(temperature["time"]).tzinfo is not None
    state = probe.json("plant/pump/state")
    assert (state["value"], state["state"]) == (1, "running")
    device.stop()
    without = probe.json("plant/pump/temperature")
    assert without["value"] is None
    assert without["error"]


def test_one_object_for_a_device_has_the_last_value_of_every_tag(plant: Plant) -> None:
    device = plant.device()
    device.set(215)
    probe = plant.probe("plant/#")
    plant.run(payload="device")
    first = probe.json("plant/pump")
    assert first["values"]["temperature"] == 21.5
    assert first["states"] == {"state": "off"}
    device.set(1, address=1)
    second = probe.json("plant/pump")
    assert second["values"] == first["values"] | {"state": 1}
    assert second["states"] == {"state": "running"}
    assert second["time"] > first["time"]


def test_qos_0_and_no_retain(plant: Plant) -> None:
    plant.device().set(215)
    probe = plant.probe("plant/#")
    plant.run(qos=0, retain=False)
    probe.until("plant/pump/valve", "false")
    wire.until(lambda: plant.count("sent") >= 4, "sent")
    late = plant.probe("plant/#")
    plant.stop()
    seen = late.until("plant/holdfast/status", "offline")
    assert [message.topic for message in seen] == ["plant/holdfast/status"]


COUNTED = {"n": {"area": "holding_registers", "address": 0}}


def polled(plant: Plant) -> None:
    """Waits for two polls, one of which has begun after the call."""
    assert plant.appliance is not None
    until_polled(plant.appliance, "pump", 2)


def test_values_wait_in_a_file_over_a_restart(plant: Plant) -> None:
    device = plant.device()
    options = {"payload": "json", "buffer": {"file": "kept.db"}}
    probe = plant.probe("plant/#")
    plant.run(COUNTED, **options)
    probe.json("plant/pump/n")
    wire.until(lambda: plant.status()["waiting"] == 0, "the broker has confirmed it")
    plant.broker.kill()
    wire.until(lambda: not plant.status()["connected"], "the connection is over")
    for number in (1, 2, 3):
        device.set(number)
        polled(plant)
    plant.stop()
    plant.broker.start()
    probe = plant.probe("plant/#")
    plant.run(COUNTED, **options)
    seen = [probe.json("plant/pump/n")["value"] for _ in range(3)]
    assert seen == [1, 2, 3]


@pytest.mark.parametrize("interval", [0.05, 3600])
def test_a_broker_that_has_lost_its_memory_gets_all_values_again(
    plant: Plant, interval: float
) -> None:
    plant.interval = interval
    device = plant.device()
    device.set(215)
    probe = plant.probe("plant/#")
    plant.run()
    probe.until("plant/pump/valve", "false")
    plant.broker.kill()
    plant.broker.start()
    probe = plant.probe("plant/#")
    probe.until("plant/pump/temperature", "21.5")
    assert plant.status()["reconnects"] == 1


def test_a_frozen_broker_delays_no_poll(plant: Plant, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "CONFIRM_TIMEOUT_S", 0.5)
    device = plant.device()
    probe = plant.probe("plant/pump/n")
    plant.run(COUNTED)
    probe.until("plant/pump/n", "0")
    plant.broker.freeze()
    device.set(1)
    wire.until(lambda: not plant.status()["connected"], "given up")
    polled(plant)
    plant.broker.thaw()
    probe.until("plant/pump/n", "1")


@pytest.mark.parametrize("version", ["5", "3.1.1"])
def test_a_broker_without_retained_messages_can_be_used(tmp_path: Path, version: str) -> None:
    with Plant(tmp_path, "allow_anonymous true", "retain_available false") as plant:
        plant.device()
        probe = plant.probe("plant/#")
        plant.run(retain=False, version=version)
        probe.until("plant/pump/valve", "false")
        plant.stop()
        probe.until("plant/holdfast/status", "offline")


def test_a_refused_message_is_counted_and_the_others_are_published(tmp_path: Path) -> None:
    rules = tmp_path / "acl"
    rules.write_text("topic read #\ntopic write plant/holdfast/#\ntopic write plant/pump/valve\n")
    with Plant(tmp_path, "allow_anonymous true", f"acl_file {rules}") as plant:
        plant.device()
        probe = plant.probe("plant/#")
        plant.run()
        probe.until("plant/pump/valve", "false")
        # Published again at once, then not for a minute.
        wire.until(lambda: plant.count("refused") == plant.status()["not_accepted"] == 6, "counted")
        wire.until(lambda: plant.count("sent") == 1, "so is the other one")


@pytest.mark.parametrize(
    ("payload", "topic"), [("plain", "plant/pump/temperature"), ("device", "plant/pump")]
)
def test_what_was_refused_is_published_once_the_broker_accepts_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, payload: str, topic: str
) -> None:
    monkeypatch.setattr(sender, "RENEWAL_INTERVAL_S", 0.05)
    rules = tmp_path / "acl"
    rules.write_text("topic read #\n")
    with Plant(tmp_path, "allow_anonymous true", f"acl_file {rules}") as plant:
        plant.device()
        probe = plant.probe("#")
        plant.run(discovery="homeassistant", payload=payload)
        wire.until(lambda: plant.count("refused") >= 4, "refused")
        rules.write_text("topic readwrite #\n")
        plant.broker.reload()
        missing = {
            topic,
            "plant/holdfast/status",
            "plant/holdfast/status/pump",
            "homeassistant/sensor/holdfast_home/pump--flow/config",
        }
        while missing:
            missing.discard(probe.get().topic)


def test_only_the_entity_that_was_refused_is_published_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sender, "RENEWAL_INTERVAL_S", 0.05)
    own, rules = "homeassistant/{}/holdfast_home/pump-{}/config", tmp_path / "acl"
    rules.write_text(f"topic readwrite #\ntopic deny {own.format('sensor', 'address')}\n")
    with Plant(tmp_path, "allow_anonymous true", f"acl_file {rules}") as plant:
        plant.device()
        probe = plant.probe("#")
        plant.run(discovery="homeassistant")
        wire.until(lambda: plant.status().get("not_accepted", 0) >= 4, "refused again")
        probe.publish("end", "1")
        seen = probe.until("end", "1")
    assert len(texts(seen, own.format("binary_sensor", "connection"))) == 1
    assert texts(seen, "plant/holdfast/status/pump").count("online") == 1


def test_a_removal_that_was_refused_is_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sender, "RENEWAL_INTERVAL_S", 0.05)
    rules = tmp_path / "acl"
    rules.write_text("topic readwrite #\n")
    output: dict[str, Any] = {"discovery": "homeassistant"}
    values = itertools.count(1)
    with Plant(tmp_path, "allow_anonymous true", f"acl_file {rules}") as plant:
        device = plant.device()
        plant.device("fan")

        def refuses_values() -> bool:
            device.set(next(values))
            return plant.count("refused") > 0

        def has_refused_others() -> bool:
            not_accepted = int(plant.status().get("not_accepted", 0))
            return not_accepted - plant.count("refused") >= 5

        probe = plant.probe("#")
        appliance = plant.run(**output)
        wire.until(lambda: plant.count("sent") >= 8, "all is published")
        rules.write_text("topic read #\n")
        plant.broker.reload()
        wire.until(refuses_values, "the broker has read the list")
        appliance.reload(plant.config({**output, "devices": ["pump"]}))
        wire.until(has_refused_others, "the removal is refused")
        rules.write_text("topic readwrite #\n")
        plant.broker.reload()
        missing = {
            "plant/fan/valve",
            "plant/holdfast/status/fan",
            "homeassistant/sensor/holdfast_home/fan--flow/config",
        }
        while missing:
            message = probe.get()
            if not message.payload:
                missing.discard(message.topic)


def test_a_refused_message_that_has_no_value_is_reported_too(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rules = tmp_path / "acl"
    rules.write_text("topic readwrite plant/#\n")
    with Plant(tmp_path, "allow_anonymous true", f"acl_file {rules}") as plant:
        plant.device()
        plant.run(discovery="homeassistant")
        wire.until(lambda: plant.status().get("not_accepted", 0) > 0, "counted")
    first = next(each for each in caplog.records if each.message == "output_not_accepted")
    fields = vars(first)["fields"]
    assert (fields["output"], fields["reason"]) == ("home", "Not authorized")
    assert fields["topic"].startswith("homeassistant/")


def test_a_broker_that_wants_a_password_gets_it(tmp_path: Path) -> None:
    users = tmp_path / "users"
    subprocess.run(
        [tool("mosquitto_passwd"), "-b", "-c", str(users), "plant", "secret"], check=True
    )
    (tmp_path / "password").write_text("wrong\n")
    with Plant(tmp_path, "allow_anonymous false", f"password_file {users}") as plant:
        plant.device()
        plant.run(username="plant", password_file="password")
        wire.until(lambda: plant.status()["last_error"] is not None, "an error")
        assert "Not authorized" in plant.status()["last_error"]
        (tmp_path / "password").write_text("secret\n")
        wire.until(lambda: plant.count("sent") >= 4, "values are sent")


def test_a_broker_with_tls_is_trusted_by_its_authority(tmp_path: Path) -> None:
    folder = tmp_path / "authority"
    folder.mkdir()
    authority = Certificates(folder)
    certificate, key = authority.issue("broker", "IP:127.0.0.1")
    options = (f"cafile {authority.ca}", f"certfile {certificate}", f"keyfile {key}")
    with Plant(tmp_path, "allow_anonymous true", *options) as plant:
        plant.device()
        plant.url = plant.url.replace("mqtt:", "mqtts:")
        plant.run()
        wire.until(lambda: plant.status().get("last_error") is not None, "an error")
        assert "the issuer of the certificate is unknown" in plant.status()["last_error"]
        plant.stop()
        plant.run(tls={"ca_file": str(authority.ca)})
        wire.until(lambda: plant.count("sent") >= 4, "values are sent")

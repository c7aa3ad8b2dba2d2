"""Set topics: values from a broker are written to devices, with a reply for each."""

from __future__ import annotations

import json
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.appliance import Appliance
from holdfast.appliance.parts import tag_writes
from holdfast.appliance.parts.tag_writes import TagWrites
from holdfast.appliance.services.outputs import _Site
from holdfast.events.audit.refusal_summaries import WHOLE_WRITES
from holdfast.outputs import sender
from holdfast.outputs.device_access import NotWritten
from holdfast.outputs.mqtt import commands
from holdfast.polling.faults import STANDBY, fault_word
from holdfast.runtime.standstill import STANDSTILL_S
from holdfast.tags.text import value_from
from support import wire
from support.audits import await_writes, full, lines, writes
from support.mqtt_plant import TAGS, Client, Plant

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from holdfast.tags import Tag


@pytest.fixture(autouse=True)
def short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("FIRST_PAUSE_S", "MAX_PAUSE_S", "CHECK_INTERVAL_S"):
        monkeypatch.setattr(sender, name, 0.05)


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[Plant]:
    with Plant(tmp_path) as started:
        yield started


def reply(probe: Client, tag: str) -> dict[str, Any]:
    found: dict[str, Any] = probe.json(f"plant/pump/{tag}/set/reply")
    return found


@pytest.mark.parametrize("version", ["5", "3.1.1"])
def test_a_value_is_written_and_confirmed(plant: Plant, version: str) -> None:
    device = plant.device()
    probe = plant.probe("plant/#")
    # The next poll may read the value before the write is answered.
    values = plant.probe("plant/pump/temperature")
    plant.run(writes=True, version=version)
    probe.until("plant/holdfast/status/pump", "online")
    probe.publish("plant/pump/temperature/set", "21.5")
    assert reply(probe, "temperature") == {
        "status": "accepted",
        "device": "pump",
        "tag": "temperature",
    }
    assert device.memory.read("holding_registers", 0, 1) == [215]
    values.until("plant/pump/temperature", "21.5")


@pytest.mark.parametrize(
    ("tag", "text", "written"),
    [("state", "running", ("holding_registers", 1, 1)), ("valve", "on", ("coils", 0, 1))],
)
def test_names_of_states_and_switches_are_written(
    plant: Plant, tag: str, text: str, written: tuple[Any, int, int]
) -> None:
    device = plant.device()
    probe = plant.probe("plant/#")
    plant.run(writes=True)
    probe.until("plant/holdfast/status/pump", "online")
    probe.publish(f"plant/pump/{tag}/set", text)
    assert reply(probe, tag)["status"] == "accepted"
    area, address, value = written
    assert device.memory.read(area, address, 1) == [value]


@pytest.mark.parametrize(
    ("text", "detail"),
    [
        ("31", "31 is outside 5.0 to 30.0"),
        (
            "21.55",
            "21.55 is between two values of the registers, allowed: steps of 0.1, or "
            "`round: nearest` in the tag",
        ),
        ("21,5", "'21,5' has a decimal comma, allowed: a decimal point, as in 21.5"),
        ("warm", "'warm' is not a number"),
        (b"\xff", "the payload is not UTF-8"),
    ],
)
def test_a_value_that_does_not_fit_is_refused(plant: Plant, text: str | bytes, detail: str) -> None:
    device = plant.device()
    device.set(77)
    probe = plant.probe("plant/#")
    plant.run(writes=True)
    probe.until("plant/holdfast/status/pump", "online")
    probe.publish("plant/pump/temperature/set", text)
    answer = reply(probe, "temperature")
    assert (answer["reason"], answer["detail"]) == ("invalid_value", detail)
    assert device.memory.read("holding_registers", 0, 1) == [77]
    assert plant.status()["commands"]["refused"] == 1


def test_a_fault_in_one_command_ends_no_other(
    plant: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(tag: Tag, *more: Any, **options: Any) -> Any:
        if tag.name == "temperature":
            raise RuntimeError("a bug")
        return value_from(tag, *more, **options)

    monkeypatch.setattr("holdfast.appliance.parts.tag_writes.value_from", fails)
    plant.device()
    probe = plant.probe("plant/#")
    plant.run(writes=True)
    probe.until("plant/holdfast/status/pump", "online")
    probe.publish("plant/pump/temperature/set", "21.5")
    probe.publish("plant/pump/valve/set", "true")
    assert reply(probe, "temperature")["reason"] == "internal_error"
    assert reply(probe, "valve")["status"] == "accepted"
    assert plant.status()["reconnects"] == 0


def test_the_reply_goes_to_the_response_topic(plant: Plant) -> None:
    plant.device()
    probe = plant.probe("plant/#", "answers")
    plant.run(writes=True)
    probe.until("plant/holdfast/status/pump", "online")
    probe.publish(
        "plant/pump/temperature/set", "21.5", ResponseTopic="answers", CorrelationData=b"17"
    )
    message = probe.next_of("answers")
    assert json.loads(message.payload)["status"] == "accepted"
    assert message.properties is not None
    assert vars(message.properties)["CorrelationData"] == b"17"


@pytest.mark.parametrize("version", ["5", "3.1.1"])
def test_a_retained_command_moves_nothing(plant: Plant, version: str) -> None:
    device = plant.device()
    device.set(77)
    probe = plant.probe("plant/#")
    probe.publish("plant/pump/temperature/set", "21.5", retain=True)
    plant.run(writes=True, version=version)
    probe.until("plant/holdfast/status/pump", "online")
    probe.publish("plant/pump/valve/set", "true")
    assert reply(probe, "valve")["status"] == "accepted"
    assert device.memory.read("holding_registers", 0, 1) == [77]
    assert plant.status()["commands"]["written"] == 1


def test_commands_during_an_outage_are_not_carried_out_later(plant: Plant) -> None:
    """The broker keeps no session, so it queues no commands."""
    device = plant.device()
    device.set(77)
    probe = plant.probe("plant/#")
    plant.run(writes=True, client_id="fixed")
    probe.until("plant/holdfast/status/pump", "online")
    plant.stop()
    probe.publish("plant/pump/temperature/set", "21.5")
    plant.run(writes=True, client_id="fixed")
    probe.until("plant/holdfast/status/pump", "online")
    probe.publish("plant/pump/valve/set", "true")
    assert reply(probe, "valve")["status"] == "accepted"
    assert device.memory.read("holding_registers", 0, 1) == [77]
    clean = [line for line in plant.broker.log.splitlines() if " as fixed (" in line]
    assert len(clean) == 2
    assert all(", c1, " in line for line in clean)


def test_without_writes_nothing_is_subscribed_to(plant: Plant) -> None:
    plant.device()
    plant.run()
    wire.until(lambda: plant.count("sent") >= 4, "values")
    assert "/set" not in plant.broker.log


def test_a_tag_that_is_not_writable_has_no_set_topic(plant: Plant) -> None:
    plant.device()
    probe = plant.probe("plant/#")
    plant.run(writes=True)
    probe.until("plant/holdfast/status/pump", "online")
    wire.until(lambda: "plant/pump/valve/set" in plant.broker.log, "subscribed")
    assert "plant/pump/flow/set" not in plant.broker.log


def test_a_device_that_does_not_answer_is_named(plant: Plant) -> None:
    device = plant.device()
    probe = plant.probe("plant/#")
    plant.run(writes=True)
    probe.until("plant/holdfast/status/pump", "online")
    device.stop()
    probe.until("plant/holdfast/status/pump", "offline")
    probe.publish("plant/pump/temperature/set", "21.5")
    answer = reply(probe, "temperature")
    assert answer["status"] == "rejected"
    assert answer["detail"]


def test_writes_are_in_the_audit_log(plant: Plant, tmp_path: Path) -> None:
    plant.device()
    probe = plant.probe("plant/#")
    output = {"writes": True}
    config = plant.config(output, audit={"file": "audit.log"})
    plant.appliance = Appliance(config).start()
    probe.until("plant/holdfast/status/pump", "online")
    for text in ("21.5", "99"):
        probe.publish("plant/pump/temperature/set", text)
        reply(probe, "temperature")
    plant.stop()
    written = [line for line in lines(tmp_path / "audit.log") if line.get("function") == "write"]
    assert [line["outcome"] for line in written] == ["done", "invalid_value"]
    first = written[0]
    assert (first["listener"], first["device"], first["tag"]) == (
        "output/home",
        "pump",
        "temperature",
    )
    assert (first["area"], first["address"], first["values"]) == ("holding_registers", 0, [215])
    assert first["peer"].endswith("plant/pump/temperature/set")


def test_refused_commands_do_not_fill_the_audit_log(plant: Plant) -> None:
    plant.device()
    probe = plant.probe("plant/#")
    plant.appliance = Appliance(plant.config({"writes": True}, audit={"file": "audit.log"}))
    plant.appliance.start()
    probe.until("plant/holdfast/status/pump", "online")
    for _ in range(WHOLE_WRITES + 5):
        probe.publish("plant/pump/temperature/set", "99")
        assert reply(probe, "temperature")["reason"] == "invalid_value"
    plant.stop()
    found = lines(plant.folder / "audit.log")
    assert sum(line.get("function") == "write" for line in found) == WHOLE_WRITES
    [summary] = [line for line in found if line.get("event") == "refused_write"]
    told = [summary[key] for key in ("listener", "outcome", "peer", "count")]
    assert told == ["output/home", "invalid_value", "127.0.0.1", 5]


def test_a_command_that_may_be_carried_out_is_recorded_when_the_disk_has_room(
    plant: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("holdfast.appliance.parts.audit.RETRY_S", 0.01)
    device, probe = plant.slow_device(), plant.probe("plant/#")
    audit = {"file": "audit.log", "fail": "closed"}
    plant.appliance = Appliance(plant.config({"writes": True}, audit=audit)).start()
    probe.until("plant/holdfast/status/pump", "online")
    make_room = full(monkeypatch)
    device.close()
    probe.publish("plant/pump/temperature/set", "21.5")
    assert reply(probe, "temperature")["status"] == "rejected"
    log = plant.folder / "audit.log"
    assert writes(log) == []
    make_room()
    [line] = await_writes(log, 1)
    assert (line["device"], line["tag"], line["values"]) == ("pump", "temperature", [215])


def followed_by(event: threading.Event, call: Callable[..., None]) -> Callable[..., None]:
    def called(*given: Any) -> None:
        call(*given)
        event.set()

    return called


class Held:
    """A write that its device has not answered, and a plant that can be stopped."""

    def __init__(self, plant: Plant, monkeypatch: pytest.MonkeyPatch) -> None:
        self.sent, self.stopping = threading.Event(), threading.Event()
        for name, event in (("_send", self.sent), ("stop", self.stopping)):
            monkeypatch.setattr(TagWrites, name, followed_by(event, getattr(TagWrites, name)))
        self.plant, self.device, self.probe = plant, plant.slow_device(), plant.probe("plant/#")
        plant.appliance = Appliance(plant.config({"writes": True}, audit={"file": "audit.log"}))
        plant.appliance.start()
        self.probe.until("plant/holdfast/status/pump", "online")
        self.device.hold()
        self.probe.publish("plant/pump/temperature/set", "21.5")
        assert self.sent.wait(wire.DEADLINE)

    def outcomes(self) -> list[str]:
        """Those of the audit log."""
        found = lines(self.plant.folder / "audit.log")
        return [line["outcome"] for line in found if line.get("function") == "write"]


def test_the_stop_waits_for_a_write_and_refuses_others(
    plant: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tag_writes, "STOP_TIMEOUT_S", wire.DEADLINE)
    monkeypatch.setattr(commands, "END_TIMEOUT_S", wire.DEADLINE)
    held = Held(plant, monkeypatch)
    with ThreadPoolExecutor(1) as threads:
        stopped = threads.submit(plant.stop)
        assert held.stopping.wait(wire.DEADLINE)
        held.probe.publish("plant/pump/valve/set", "true")
        assert reply(held.probe, "valve")["reason"] == "stopping"
        held.device.go_on()
        assert reply(held.probe, "temperature")["status"] == "accepted"
        stopped.result()
    assert held.outcomes() == ["stopping", "done"]


def test_a_write_without_an_answer_at_the_stop_is_reported(
    plant: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tag_writes, "STOP_TIMEOUT_S", 0.05)
    held = Held(plant, monkeypatch)
    plant.stop()
    assert reply(held.probe, "temperature")["reason"] == "unanswered"
    assert held.outcomes() == ["unanswered"]


@pytest.mark.parametrize("is_known", [True, False], ids=["known", "just lost"])
def test_a_command_for_a_device_that_another_node_polls_has_no_reply(
    plant: Plant, monkeypatch: pytest.MonkeyPatch, is_known: bool
) -> None:
    write = _Site.write

    def refuse(site: _Site, device: str, *more: Any) -> None:
        if device == "pump":
            raise NotWritten(fault_word(STANDBY), "this node may not use the device now")
        write(site, device, *more)

    if is_known:
        monkeypatch.setattr(_Site, "standby", frozenset({"pump"}))
    else:
        monkeypatch.setattr(_Site, "write", refuse)
    for name in ("pump", "fan"):
        plant.device(name)
    probe = plant.probe("plant/+/+/set/reply", "plant/holdfast/status/fan")
    plant.run(writes=True)
    probe.until("plant/holdfast/status/fan", "online")
    probe.publish("plant/pump/temperature/set", "99")
    probe.publish("plant/fan/valve/set", "true")
    assert probe.get().topic == "plant/fan/valve/set/reply"
    counts = {"written": 1, "refused": 0, "ignored": 0, "replies_dropped": 0}
    assert plant.status()["commands"] == counts


def test_a_reload_brings_new_set_topics(plant: Plant) -> None:
    plant.device()
    probe = plant.probe("plant/#")
    tags = {name: tag for name, tag in TAGS.items() if name != "valve"}
    appliance = plant.run(tags, writes=True)
    probe.until("plant/holdfast/status/pump", "online")
    appliance.reload(plant.config({"writes": True}))
    probe.until("plant/pump/valve", "false")
    wire.until(lambda: "plant/pump/valve/set" in plant.broker.log, "subscribed")
    probe.publish("plant/pump/valve/set", "true")
    assert reply(probe, "valve")["status"] == "accepted"


def test_commands_that_waited_while_the_output_stood_still_are_not_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    devices = {"pump": "5", "fan": "3.1.1"}
    """The version of MQTT for each of them, which has a broker of its own."""
    written: dict[str, list[str]] = {device: [] for device in devices}
    goes_on = threading.Event()
    write = _Site.write

    def wait_and_write(site: _Site, device: str, tag: str, text: str, *more: Any) -> None:
        written[device].append(text)
        if text == "1":
            goes_on.wait(3 * wire.DEADLINE)
        write(site, device, tag, text, *more)

    monkeypatch.setattr(_Site, "write", wait_and_write)
    with ExitStack() as opened:
        plants: dict[str, Plant] = {}
        probes: dict[str, Client] = {}
        for device, version in devices.items():
            folder = tmp_path / device
            folder.mkdir()
            plant = plants[device] = opened.enter_context(Plant(folder))
            plant.device(device)
            probe = probes[device] = plant.probe("plant/#")
            plant.run(writes=True, version=version)
            probe.until(f"plant/holdfast/status/{device}", "online")
            probe.publish(f"plant/{device}/temperature/set", "1")
        wire.until(lambda: all(written.values()), "they are being written")
        for device, probe in probes.items():
            for _ in range(50):  # More than the broker sends before it has confirmations.
                probe.publish(f"plant/{device}/temperature/set", "2")
        end = time.monotonic() + STANDSTILL_S + 0.5
        wire.until(lambda: time.monotonic() > end, "they stood still for long enough")
        goes_on.set()

        def are_written() -> bool:
            for device, probe in probes.items():
                probe.publish(f"plant/{device}/temperature/set", "3")
            return all("3" in texts for texts in written.values())

        wire.until(are_written, "new commands are written")
        assert not any("2" in texts for texts in written.values())
        assert all(plant.status()["reconnects"] >= 1 for plant in plants.values())

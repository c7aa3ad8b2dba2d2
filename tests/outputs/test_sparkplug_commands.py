"""Sparkplug commands: DCMD writes to tags, and nothing else does."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.appliance import Appliance
from holdfast.outputs import sender
from support import wire
from support.audits import lines
from support.mqtt_plant import TAGS, Plant
from support.sparkplug_watch import SETTINGS, Watch

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

MORE: dict[str, Any] = {
    "speeds": {
        "area": "holding_registers",
        "address": 10,
        "type": "int16[2]",
        "writable": True,
    },
    "marked": {
        "area": "holding_registers",
        "address": 12,
        "type": "int16[2]",
        "null": [-1],
        "writable": True,
    },
    "names": {
        "area": "holding_registers",
        "address": 20,
        "type": "string:2[2]",
        "writable": True,
    },
    "valves": {"area": "coils", "address": 10, "type": "bool[3]", "writable": True},
    "code": {"area": "holding_registers", "address": 30, "type": "bytes:4", "writable": True},
    "level": {"area": "holding_registers", "address": 32, "type": "int16", "writable": True},
    "rate": {"area": "holding_registers", "address": 34, "type": "float32", "writable": True},
    "gear": {
        "area": "holding_registers",
        "address": 36,
        "states": {0: "1", 1: "2", 2: "3"},
        "writable": True,
    },
    "motor": {"area": "coils", "address": 20, "states": {0: "true", 1: "false"}, "writable": True},
}


@pytest.fixture(autouse=True)
def short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("FIRST_PAUSE_S", "MAX_PAUSE_S", "CHECK_INTERVAL_S"):
        monkeypatch.setattr(sender, name, 0.05)


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[Plant]:
    with Plant(tmp_path) as started:
        yield started


def watch(plant: Plant) -> Watch:
    return Watch(plant.probe("spBv1.0/plant/#"))


def outcomes(plant: Plant) -> int:
    status = plant.status()
    return sum(int(status[f"commands_{name}"]) for name in ("written", "refused", "ignored"))


@pytest.mark.parametrize(
    ("name", "metric", "written"),
    [
        ("temperature", {"datatype": 10, "double_value": 21.5}, [215]),
        ("temperature", {"datatype": 9, "float_value": 21.3}, [213]),
        ("temperature", {"datatype": 3, "int_value": 21}, [210]),
        ("state", {"datatype": 6, "int_value": 1}, [1]),
        ("state", {"long_value": 1}, [1]),
        ("speeds", {"bytes_value": struct.pack("<2h", -5, 7)}, [0xFFFB, 7]),
        ("names", {"bytes_value": b"ab\0cd\0"}, [0x6162, 0x6364]),
        ("valves", {"bytes_value": b"\3\0\0\0\xa0"}, [1, 0, 1]),
        ("code", {"bytes_value": b"abcd"}, [0x6162, 0x6364]),
        ("level", {"datatype": 2, "int_value": 0xFFFB}, [0xFFFB]),
        ("level", {"datatype": 1, "int_value": 251}, [0xFFFB]),
        ("rate", {"datatype": 2, "int_value": 0xFFFB}, [0xC0A0, 0]),
        ("gear", {"int_value": 1}, [1]),
        ("motor", {"boolean_value": True}, [1]),
    ],
)
@pytest.mark.parametrize("by", ["alias", "name"])
def test_a_value_is_written(
    plant: Plant, name: str, metric: dict[str, Any], written: list[int], by: str
) -> None:
    device = plant.device()
    watching = watch(plant)
    tags = TAGS | MORE
    plant.run(tags, **SETTINGS, writes=True)
    birth = watching.until("DBIRTH", "pump")
    named = {"name": name} if by == "name" else {"alias": birth.metrics[name].alias}
    watching.command("pump", **named, **metric)
    wire.until(lambda: plant.status()["commands_written"] == 1, "the value is written")
    tag = tags[name]
    assert device.memory.read(tag["area"], tag["address"], len(written)) == written


@pytest.mark.parametrize(
    "metric",
    [
        {"name": "temperature", "double_value": 31.0},
        {"name": "temperature", "double_value": 21.55},
        {"name": "temperature", "double_value": float("nan")},
        {"name": "temperature", "is_null": True},
        {"name": "temperature"},
        {"name": "temperature", "string_value": "21"},
        {"name": "temperature", "boolean_value": True},
        {"name": "state", "int_value": 65536},
        {"name": "state", "datatype": 3, "int_value": 0xFFFFFFFF},
        {"name": "state", "double_value": 1.0},
        {"name": "valve", "int_value": 1},
        {"name": "flow", "float_value": 1.0},
        {"name": "absent", "int_value": 1},
        {"alias": 0, "int_value": 1},
        {"name": "speeds", "bytes_value": b"\0\0\0"},
        {"name": "speeds", "bytes_value": b"\0\0\0\0\0\0"},
        {"name": "valves", "bytes_value": b"\3\0\0"},
        {"name": "valves", "bytes_value": b"\xff\xff\xff\xff\0"},
        {"name": "names", "bytes_value": b"\xff\0\xff\0"},
        {"name": "marked/0", "datatype": 2, "int_value": 5},
        {"name": "code", "bytes_value": b"abc"},
        {"name": "rate", "int_value": 1},
        {"name": "temperature", "datatype": 10, "int_value": 21},
        {"name": "gear", "string_value": "2"},
        {"name": "temperature", "is_historical": True, "double_value": 21.5},
    ],
    ids=str,
)
def test_a_value_that_can_not_be_written_is_refused(plant: Plant, metric: dict[str, Any]) -> None:
    device = plant.device()
    device.memory.write("holding_registers", 0, [100] * 40)
    watching = watch(plant)
    plant.run(TAGS | MORE, **SETTINGS, writes=True)
    watching.until("DBIRTH", "pump")
    watching.command("pump", **metric)
    wire.until(lambda: outcomes(plant) == 1, "the command has an outcome")
    assert plant.status()["commands_refused"] == 1
    assert device.memory.read("holding_registers", 0, 40) == [100] * 40
    assert not any(device.memory.read("coils", 0, 20))


def test_a_command_of_the_past_is_refused_as_such(
    plant: Plant, caplog: pytest.LogCaptureFixture
) -> None:
    device = plant.device()
    watching = watch(plant)
    plant.run(**SETTINGS, writes=True)
    watching.until("DBIRTH", "pump")
    watching.command("pump", name="temperature", is_historical=True, double_value=21.5)
    watching.command("pump", name="temperature", is_historical=False, double_value=6.0)
    wire.until(lambda: outcomes(plant) == 2, "both have outcomes")
    assert device.memory.read("holding_registers", 0, 1) == [60]
    reasons = [
        entry.fields["reason"]  # type: ignore[attr-defined]
        for entry in caplog.records
        if "output_command_refused" in entry.getMessage()
    ]
    assert reasons == ["historical"]


def test_an_alias_of_an_earlier_birth_writes_nothing(plant: Plant) -> None:
    plant.device()
    watching = watch(plant)
    plant.run(**SETTINGS, writes=True)
    birth = watching.until("DBIRTH", "pump")
    watching.command(None, name="Node Control/Rebirth", datatype=11, boolean_value=True)
    watching.until("DBIRTH", "pump")
    watching.command("pump", alias=birth.metrics["temperature"].alias, double_value=21.5)
    wire.until(lambda: plant.status()["commands_refused"] == 1, "the command is refused")


def test_retained_and_malformed_commands_write_nothing(plant: Plant) -> None:
    device = plant.device()
    watching = watch(plant)
    value: dict[str, Any] = {"name": "temperature", "double_value": 21.5}
    watching.command("pump", retain=True, **value)
    plant.run(**SETTINGS, writes=True)
    watching.until("DBIRTH", "pump")
    watching.raw_command("pump", b"\xff\xff")
    watching.raw_command("pump", b"")
    watching.raw_command("pump", b"\x12\x03\x0a\x01\xff")
    watching.command("pump", **(value | {"double_value": 6.0}))
    wire.until(lambda: plant.status()["commands_written"] == 1, "the last one is written")
    assert device.memory.read("holding_registers", 0, 1) == [60]
    assert plant.status()["commands_refused"] == 1, "the metric without a valid name"


def test_without_writes_nothing_is_written(plant: Plant) -> None:
    device = plant.device()
    watching = watch(plant)
    plant.run(**SETTINGS)
    birth = watching.until("DBIRTH", "pump")
    watching.command("pump", name="temperature", double_value=21.5)
    device.set(7)
    watching.until_value(birth, "temperature", 0.7, "double_value")
    assert outcomes(plant) == 0


def test_writes_are_in_the_audit_log(plant: Plant) -> None:
    plant.device()
    watching = watch(plant)
    config = plant.config(SETTINGS | {"writes": True}, audit={"file": "audit.log"})
    plant.appliance = Appliance(config).start()
    watching.until("DBIRTH", "pump")
    watching.command("pump", name="temperature", double_value=21.5)
    watching.command("pump", name="temperature", double_value=31.0)
    wire.until(lambda: outcomes(plant) == 2, "both have outcomes")
    plant.stop()
    written = [line for line in lines(plant.folder / "audit.log") if "tag" in line]
    # A refusal does not wait for the device.
    done, refused = sorted(written, key=lambda line: line["outcome"] != "done")
    assert (done["tag"], done["values"], done["outcome"]) == ("temperature", [215], "done")
    assert done["listener"] == "output/home"
    assert done["peer"] == f"127.0.0.1:{plant.broker.port} spBv1.0/plant/DCMD/edge/pump"
    assert refused["outcome"] == "invalid_value"

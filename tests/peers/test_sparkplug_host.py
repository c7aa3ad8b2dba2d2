"""Sparkplug outputs and the host application of Eclipse Tahu: it assumes the role of a SCADA host.

It checks sequence numbers and requests a rebirth if one is missing.
"""

from __future__ import annotations

import json
import os
import queue
import subprocess
import threading
from contextlib import ExitStack
from functools import partial
from typing import TYPE_CHECKING, Any

import pytest

from support import wire
from support.mqtt_plant import Plant
from support.peer_programs import java
from support.sparkplug_watch import SETTINGS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path
    from types import TracebackType
    from typing import Self

PUMP = "plant/edge/pump"

TAGS: dict[str, Any] = {
    "int16": {"area": "holding_registers", "address": 0, "type": "int16", "writable": True},
    "uint16": {"area": "holding_registers", "address": 1, "writable": True},
    "int32": {"area": "holding_registers", "address": 2, "type": "int32", "writable": True},
    "uint32": {"area": "holding_registers", "address": 4, "type": "uint32", "writable": True},
    "int64": {"area": "holding_registers", "address": 6, "type": "int64", "writable": True},
    "uint64": {"area": "holding_registers", "address": 10, "type": "uint64"},
    "float32": {
        "area": "holding_registers",
        "address": 14,
        "type": "float32",
        "unit": "m³/h",
        "writable": True,
    },
    "float64": {"area": "holding_registers", "address": 16, "type": "float64"},
    "scaled": {
        "area": "holding_registers",
        "address": 20,
        "type": "int16",
        "scale": 0.1,
        "writable": True,
    },
    "text": {
        "area": "holding_registers",
        "address": 21,
        "type": "string:6",
        "writable": True,
    },
    "bit": {"area": "holding_registers", "address": 24, "type": "bit:3"},
    "coil": {"area": "coils", "address": 0, "writable": True},
    "int16s": {"area": "holding_registers", "address": 30, "type": "int16[3]"},
    "uint32s": {"area": "holding_registers", "address": 33, "type": "uint32[2]"},
    "float32s": {"area": "holding_registers", "address": 37, "type": "float32[2]"},
    "coils": {"area": "coils", "address": 1, "type": "bool[10]"},
    "nulls": {"area": "holding_registers", "address": 41, "type": "int16[2]", "null": [-32768]},
}


class Host:
    """The host application, with what it has told."""

    def __init__(self, broker: str, name: str) -> None:
        driver = java("SparkplugHost")
        self._process = subprocess.Popen(
            [*driver.command, broker.replace("mqtt:", "tcp:"), name],
            cwd=driver.folder,
            env=os.environ | driver.environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._lines: queue.Queue[dict[str, Any]] = queue.Queue()
        self._thread = threading.Thread(target=self._read)
        self._thread.start()
        self.told: list[dict[str, Any]] = []

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith("{"):
                self._lines.put(json.loads(line))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._process.kill()
        self._thread.join(wire.DEADLINE)
        with self._process:
            pass

    def until(self, wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """The next event that is wanted."""
        while True:
            try:
                event = self._lines.get(timeout=wire.DEADLINE)
            except queue.Empty:
                raise AssertionError(f"no more events after {self.told[-30:]}") from None
            self.told.append(event)
            if wanted(event):
                return event

    def until_event(self, event: str, of: str) -> dict[str, Any]:
        return self.until(lambda told: (told["event"], told["of"]) == (event, of))

    def until_value(self, name: str, value: Any) -> dict[str, Any]:
        return self.until(
            lambda told: (
                told["event"] == "data_metric" and (told["name"], told["value"]) == (name, value)
            )
        )

    def births(self) -> dict[str, dict[str, Any]]:
        """The metrics of the last births."""
        return {told["name"]: told for told in self.told if told["event"] == "birth_metric"}

    def command(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(f"{line}\n")
        self._process.stdin.flush()

    def stop(self) -> None:
        """Ends in an orderly way."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(wire.DEADLINE)


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[Plant]:
    with Plant(tmp_path) as started:
        yield started


@pytest.fixture
def running() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def host(plant: Plant, running: ExitStack, name: str = "scada") -> Host:
    started = running.enter_context(Host(plant.broker.url, name))
    started.until_event("connected", "")
    return started


def test_a_host_understands_every_type(plant: Plant, running: ExitStack) -> None:
    device = plant.device()
    registers = [
        *(0x8AD0, 0xCC88, 0xFFFF, 0xFFFE, 0xC455, 0xFB49),
        *(0xFFFF, 0xFFFF, 0xFFFF, 0xFFFD, 0xFFFF, 0xFFFF, 0xFFFF, 0xFFFF),
        *(0x41AC, 0x0000, 0x3FF8, 0, 0, 0, 215, 0x4142, 0x4300, 0, 0b1000),
    ]
    device.memory.write("holding_registers", 0, registers)
    device.memory.write("holding_registers", 30, [1, 0xFFFE, 3, 0, 52, 0xC455, 0xFB49])
    device.memory.write("holding_registers", 37, [0x3F80, 0, 0xC020, 0, 0x8000, 7])
    device.memory.write("coils", 0, [1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 1])
    scada = host(plant, running)
    plant.run(TAGS, **SETTINGS)
    scada.until_event("device_birth", PUMP)
    born = scada.births()
    assert {name: (told["type"], told["value"]) for name, told in born.items() if name in TAGS} == {
        "int16": ("Int16", -30000),
        "uint16": ("UInt16", 52360),
        "int32": ("Int32", -2),
        "uint32": ("UInt32", 3293969225),
        "int64": ("Int64", -3),
        "uint64": ("UInt64", 2**64 - 1),
        "float32": ("Float", 21.5),
        "float64": ("Double", 1.5),
        "scaled": ("Double", 21.5),
        "text": ("String", "ABC"),
        "bit": ("Boolean", True),
        "coil": ("Boolean", True),
        "int16s": ("Int16Array", [1, -2, 3]),
        "uint32s": ("UInt32Array", [52, 3293969225]),
        "float32s": ("FloatArray", [1.0, -2.5]),
        "coils": ("BooleanArray", [True, *[False] * 8, True]),
    }
    assert (born["nulls/0"]["value"], born["nulls/0"]["quality"]) == (None, 0)
    assert (born["nulls/1"]["value"], born["nulls/1"]["quality"]) == (7, 192)


def test_a_host_writes_every_type(plant: Plant, running: ExitStack) -> None:
    plant.device()
    scada = host(plant, running)
    plant.run(TAGS, writes=True, **SETTINGS)
    scada.until_event("device_birth", PUMP)
    for name, kind, value in (
        ("int16", "Int16", -5),
        ("uint16", "UInt16", 52360),
        ("int32", "Int32", -70000),
        ("uint32", "UInt32", 3293969225),
        ("int64", "Int64", -5),
        ("float32", "Float", 21.5),
        ("scaled", "Double", 21.4),
        ("scaled", "Float", 21.3),
        ("text", "String", "hello"),
        ("coil", "Boolean", True),
    ):
        text = str(value).lower() if isinstance(value, bool) else value
        scada.command(f"write plant edge pump {name} {kind} {text}")
        scada.until_value(name, value)
    assert plant.status()["commands_written"] == 10


def test_a_host_follows_the_life_of_node_and_device(plant: Plant, running: ExitStack) -> None:
    device = plant.device()
    scada = host(plant, running)
    plant.run(TAGS, **SETTINGS)
    scada.until_event("device_birth", PUMP)
    device.stop()
    scada.until_event("device_death", PUMP)
    device.start()
    scada.until_event("device_birth", PUMP)
    device.set(7)
    scada.until_value("int16", 7)
    scada.command("rebirth plant edge")
    scada.until_event("node_birth", "plant/edge")
    scada.until_event("device_birth", PUMP)
    for value in range(1000, 1010):
        device.set(value)
        scada.until_value("int16", value)
    plant.stop()
    scada.until_event("node_death", "plant/edge")
    births = [told for told in scada.told if told["event"] == "node_birth"]
    assert len(births) == 2, "the host found no sequence number missing"


def test_a_primary_host_gets_what_was_read_while_it_was_gone(
    plant: Plant, running: ExitStack
) -> None:
    device = plant.device()
    first = host(plant, running)
    plant.run(TAGS, primary_host="scada", **SETTINGS)
    first.until_event("device_birth", PUMP)
    first.stop()
    wire.until(lambda: not plant.status()["born"], "the node waits for its host")
    for value in (1, 2, 3):
        waiting = plant.status()["waiting"]
        device.set(value)
        wire.until(partial(plant.has_waiting, waiting + 1), "the value waits")
    again = host(plant, running)
    again.until_event("device_birth", PUMP)
    assert again.births()["int16"]["value"] == 3
    assert [again.until_value("int16", value)["historical"] for value in (1, 2)] == [True, True]
    device.set(4)
    assert again.until_value("int16", 4)["historical"] is False

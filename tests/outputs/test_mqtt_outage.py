"""Outages of a broker: nothing is lost, the order stays, and polls go on.

`HOLDFAST_TORTURE=1` takes 10,000 tags and an outage of a minute.
"""

from __future__ import annotations

import os
import subprocess
from contextlib import contextmanager
from typing import TYPE_CHECKING

import msgspec
import pytest

from holdfast.outputs import sender
from support import wire
from support.machine import tool
from support.mqtt_plant import Plant
from support.polled import counters, until_polled

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

IS_LONG = bool(os.environ.get("HOLDFAST_TORTURE"))
TAGS, CHANGES, INTERVAL = (10_000, 30, 1.0) if IS_LONG else (500, 10, 0.02)
"""How many tags, how often they change during the outage, and seconds between polls. A change takes
two polls."""

SECONDS = 600


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[Plant]:
    with Plant(tmp_path, "allow_anonymous true", "max_queued_messages 0") as started:
        started.interval = INTERVAL
        yield started


@pytest.fixture(autouse=True)
def short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("FIRST_PAUSE_S", "MAX_PAUSE_S", "CHECK_INTERVAL_S"):
        monkeypatch.setattr(sender, name, 0.05)


class Message(msgspec.Struct):
    """What is published of a tag."""

    value: int
    time: str


@contextmanager
def recorded(plant: Plant, file: Path) -> Iterator[None]:
    """Records all messages of values with Mosquitto's own tool, one on each line."""
    command = [tool("mosquitto_sub"), "-p", str(plant.broker.port), "-q", "1", "-v"]
    with file.open("wb") as lines:
        process = subprocess.Popen([*command, "-t", "plant/pump/+", "-t", "end"], stdout=lines)
        try:
            wire.until(lambda: "plant/pump/+" in plant.broker.log, "subscribed")
            yield
            plant.broker.publish("end", "end", "-q", "1")
            wire.until(lambda: b"end end" in file.read_bytes()[-20:], "the end", SECONDS)
        finally:
            process.terminate()
            process.wait()


@pytest.mark.timeout(900)
def test_nothing_is_lost_or_out_of_order(plant: Plant, tmp_path: Path) -> None:
    """Each change of each tag is published, in order, with the time of its poll."""
    device, proxy = plant.device(registers=TAGS), plant.proxy()
    tags = {
        f"n{number}": {"area": "holding_registers", "address": number} for number in range(TAGS)
    }
    with recorded(plant, tmp_path / "messages"):
        appliance = plant.run(tags, payload="json")
        for number in range(1, 3 * CHANGES):
            if number == CHANGES:
                proxy.down()
            if number == 2 * CHANGES:
                assert plant.status()["waiting"] > 0
                proxy.up()
            # Two polls, one of which has begun after the change.
            device.set(number, count=TAGS)
            until_polled(appliance, "pump", 2)
        # On a loaded machine, the output may be offered the last polls much later.
        last = {3 * CHANGES - 1}
        readings = appliance.diagnostics.tag_values
        wire.until(
            lambda: {each.value for each, _ in readings()} == last, "all is offered", SECONDS
        )
        wire.until(lambda: plant.status()["waiting"] == 0, "all is sent", SECONDS)
        wire.until(lambda: plant.status()["connected"], "connected")
        assert plant.count("dropped") == plant.count("refused") == 0
        if IS_LONG:
            assert counters(appliance, "pump")["missed"] == 0
    seen: dict[bytes, list[Message]] = {}
    decode = msgspec.json.Decoder(Message).decode
    for line in (tmp_path / "messages").read_bytes().splitlines():
        topic, _, payload = line.partition(b" ")
        if topic != b"end":
            seen.setdefault(topic, []).append(decode(payload))
    assert len(seen) == TAGS
    for messages in seen.values():
        values = [message.value for message in messages]
        first = list(dict.fromkeys(values))
        assert first == sorted(first)
        assert set(range(1, 3 * CHANGES)) <= set(values)
        assert values[-1] == 3 * CHANGES - 1
        times = {message.value: message.time for message in reversed(messages)}
        assert [times[value] for value in sorted(times)] == sorted(times.values())

"""The values of tags in a running appliance: outputs, metrics, reloads and outages."""

from __future__ import annotations

import json
import queue
import urllib.request
from collections import deque
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest

import holdfast
from holdfast.adapters.metrics.families import tag_metrics
from holdfast.appliance import Appliance
from holdfast.appliance.parts import tag_values
from holdfast.appliance.parts.tag_values import TagValues
from holdfast.appliance.services import outputs
from holdfast.appliance.services.supervision import Supervisor
from holdfast.config import load
from holdfast.events import log_lines
from holdfast.outputs.buffer_file import BufferFile
from support import wire
from support.polled import Fake, data, exception
from support.readings import tag
from support.running import endpoint

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.config import Config
    from support.running import Serve

METER = {
    "tags": {
        "power": {"area": "holding_registers", "address": 0, "scale": 0.1, "unit": "W"},
        "on": {"area": "coils", "address": 0},
        "label": {"area": "holding_registers", "address": 2, "type": "string:4"},
        "phases": {"area": "holding_registers", "address": 4, "type": "int16[2]"},
    }
}


def settings(port: int, **more: Any) -> dict[str, Any]:
    device = {"url": f"tcp://127.0.0.1:{port}", "profile": "meter", "interval": 0.02}
    out = {"type": "file", "file": "out.jsonl", "format": "jsonl"}
    return {
        "profiles": {"meter": METER},
        "devices": {"m": device},
        "outputs": {"out": out},
        **more,
    }


def saved(folder: Path, made: dict[str, Any]) -> Path:
    file = folder / "appliance.yaml"
    file.write_text(json.dumps(made))
    return file


def rows(folder: Path, name: str = "out.jsonl") -> list[dict[str, Any]]:
    file = folder / name
    if not file.exists():
        return []
    return [json.loads(line) for line in file.read_text("utf-8").splitlines()]


def values(folder: Path, of: str, name: str = "out.jsonl") -> list[Any]:
    return [row["value"] for row in rows(folder, name) if row["tag"] == of]


def _until_power_is(folder: Path, expected: list[float]) -> None:
    wire.until(lambda: values(folder, "power") == expected, "all changes are there")


@pytest.fixture
def memory() -> holdfast.Memory:
    made = holdfast.Memory(holding_registers=10, coils=8)
    made.write("holding_registers", 0, [215, 0, 0x6162, 0x6300, 7, 65535])
    return made


@pytest.fixture
def device(memory: holdfast.Memory, serve: Serve) -> int:
    return serve({1: memory}).address[1]


def test_changes_of_values_reach_a_file(
    tmp_path: Path, device: int, memory: holdfast.Memory
) -> None:
    with Appliance(load(saved(tmp_path, settings(device)))):
        wire.until(lambda: len(rows(tmp_path)) == 4, "all values are there")
        found = {row["tag"]: (row["value"], row["unit"], row["error"]) for row in rows(tmp_path)}
        assert found == {
            "power": (21.5, "W", None),
            "on": (False, "", None),
            "label": ("abc", "", None),
            "phases": ([7, -1], "", None),
        }
        for number in range(1, 4):
            memory.write_many([("holding_registers", 0, [number]), ("coils", 0, [number % 2])])
            expected = [21.5, *(each / 10 for each in range(1, number + 1))]
            _until_power_is(tmp_path, expected)
            # A poll reads both one after the other: the write may have come in between.
            switched = [False, True, False, True][: number + 1]
            wire.until(lambda: values(tmp_path, "on") == switched, "so is the coil")  # noqa: B023
    assert values(tmp_path, "power") == [21.5, 0.1, 0.2, 0.3]
    assert values(tmp_path, "on") == [False, True, False, True]
    assert len(values(tmp_path, "label")) == 1


def test_what_is_read_while_outputs_end_reaches_none_of_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = settings(0)
    made["outputs"]["other"] = made["outputs"]["out"] | {"file": "other.jsonl"}
    answered, value, stop = [0], [1], Supervisor.stop

    def answer(request: wire.Frame) -> bytes:
        answered[0] += 1
        return data(request, value[0])

    def slow_stop(output: Supervisor) -> None:
        stop(output)
        if value == [1]:
            value[0], end = 2, answered[0] + 20
            wire.until(lambda: answered[0] > end, "the device is still polled")

    monkeypatch.setattr(Supervisor, "stop", slow_stop)
    with Fake(answer) as fake:
        made["devices"]["m"]["url"] = f"tcp://127.0.0.1:{fake.port}"
        with Appliance(load(saved(tmp_path, made))):
            for name in ("out.jsonl", "other.jsonl"):
                wire.until(lambda: values(tmp_path, "power", name) == [0.1], "a value")  # noqa: B023
    assert values(tmp_path, "power") == values(tmp_path, "power", "other.jsonl") == [0.1]


def test_a_device_that_stops_answering_has_no_value(tmp_path: Path) -> None:
    with Fake(data) as fake, Appliance(load(saved(tmp_path, settings(fake.port)))):
        wire.until(lambda: values(tmp_path, "power") == [0.0], "it has a value")
        fake.answer = lambda request: exception(request, 4)
        wire.until(lambda: values(tmp_path, "power") == [0.0, None], "it has none")
        fake.answer = data
        wire.until(lambda: values(tmp_path, "power") == [0.0, None, 0.0], "it is back")
    [row] = [row for row in rows(tmp_path) if row["tag"] == "power" and row["error"]]
    assert row["error"] == "exception 04 (Server Device Failure)"


def test_an_output_publishes_only_its_devices(tmp_path: Path, device: int) -> None:
    made = settings(device)
    made["devices"]["other"] = made["devices"]["m"]
    made["outputs"]["out"]["devices"] = ["other"]
    made["outputs"]["all"] = {"type": "file", "file": "all.jsonl", "format": "jsonl"}
    with Appliance(load(saved(tmp_path, made))):
        wire.until(lambda: len(rows(tmp_path, "all.jsonl")) == 8, "all are there")
        wire.until(lambda: len(rows(tmp_path)) == 4, "its own are there")
    assert {row["device"] for row in rows(tmp_path)} == {"other"}


def test_tags_and_reads_share_a_poll_and_only_reads_are_stored(
    tmp_path: Path, device: int, memory: holdfast.Memory
) -> None:
    read = {"area": "holding_registers", "address": 0, "count": 2}
    read["into"] = {"memory": "p", "area": "holding_registers", "address": 0}
    made = settings(device, memories={"p": {"holding_registers": 10}})
    made["devices"]["m"]["reads"] = [read]
    with Appliance(load(saved(tmp_path, made))) as appliance:
        wire.until(lambda: len(rows(tmp_path)) == 4, "all values are there")
        there = appliance.memories["p"]
        wire.until(
            lambda: there.read("holding_registers", 0, 2) == [215, 0], "the read is mirrored"
        )
        counters = appliance.diagnostics.stats()["devices"]["m"]
    assert counters["requests_per_poll"] == 2
    assert there.read("holding_registers", 2, 8) == [0] * 8
    assert memory.read("holding_registers", 0, 1) == [215]


def test_a_receiver_that_can_not_be_reached_delays_nothing_else(
    tmp_path: Path, device: int, memory: holdfast.Memory
) -> None:
    made = settings(device)
    memory.write("holding_registers", 0, [0])
    down = {"type": "influx", "url": "http://127.0.0.1:9", "bucket": "b"}
    made["outputs"]["down"] = {**down, "buffer": {"file": "down.db"}}
    with Appliance(load(saved(tmp_path, made))) as appliance:
        for number in range(20):
            memory.write("holding_registers", 0, [number])
            expected = [each / 10 for each in range(number + 1)]
            _until_power_is(tmp_path, expected)
        wire.until(lambda: appliance.diagnostics.adapter("output/down"), "it has a status")
        status = appliance.diagnostics.adapter("output/down")
        assert status is not None
        assert (status["connected"], status["readings"]["sent"]) == (False, 0)
    stored = BufferFile(tmp_path / "down.db", 2**30, lambda _, name: tag(name))
    kept = []
    while found := stored.first(1):
        kept += [each.value for each in found if each.name == "power"]
        stored.remove_first()
    stored.close()
    assert kept == values(tmp_path, "power")


def test_line_protocol_has_no_readings_without_a_value(tmp_path: Path) -> None:
    """They do not count as sent, nor do they hide that nobody listens."""
    made = settings(0)
    empty = {"area": "holding_registers", "address": 8, "type": "int16[2]", "null": [0]}
    made["profiles"] = {"meter": {"tags": METER["tags"] | {"empty": empty}}}
    made["outputs"]["lines"] = {"type": "file", "file": "lines", "format": "influx"}
    made["outputs"]["down"] = {"type": "influx", "url": "http://127.0.0.1:9", "bucket": "b"}
    with Fake(lambda request: exception(request, 4)) as fake:
        made["devices"]["m"]["url"] = f"tcp://127.0.0.1:{fake.port}"
        with Appliance(load(saved(tmp_path, made))) as appliance:

            def status(name: str) -> Any:
                return appliance.diagnostics.adapter(f"output/{name}") or {}

            wire.until(lambda: status("down").get("connected") is False, "nobody listens")
            wire.until(lambda: status("out")["readings"]["sent"] == 5, "the other has them")
            fake.answer = data
            wire.until(lambda: status("lines")["readings"]["sent"] == 4, "values are sent")
            wire.until(lambda: status("down")["waiting"] == 4, "values wait")


@pytest.mark.parametrize("after", [{}, {"buffer": {"file": "other.db"}}], ids=["none", "other"])
def test_values_in_a_file_that_a_reload_takes_away_are_logged(
    tmp_path: Path, device: int, caplog: pytest.LogCaptureFixture, after: dict[str, Any]
) -> None:
    made = settings(device)
    down = {"type": "influx", "url": "http://127.0.0.1:9", "bucket": "b"}
    made["outputs"] = {"down": {**down, "buffer": {"file": "down.db"}}}
    with Appliance(load(saved(tmp_path, made))) as appliance:
        status = appliance.diagnostics.adapter
        wire.until(lambda: (status("output/down") or {}).get("waiting") == 4, "all wait")
        made["outputs"] = {"down": down | after}
        appliance.reload(load(saved(tmp_path, made)))
    # At the end, values wait in a file for the next start.
    [record] = [each for each in caplog.records if each.message == "output_file_left"]
    stored = BufferFile(tmp_path / "down.db", 2**30, lambda _, name: tag(name))
    stored.close()
    expected = {"output": "down", "file": str(stored.file), "count": stored.count}
    assert vars(record)["fields"] == expected
    assert stored.count >= 4


@pytest.mark.parametrize("is_removed", [False, True])
def test_values_that_are_lost_at_the_end_of_an_output_are_logged(
    tmp_path: Path, device: int, caplog: pytest.LogCaptureFixture, is_removed: bool
) -> None:
    """At a reload with other settings, the output goes on with what waits."""
    made = settings(device)
    made["outputs"]["down"] = {"type": "influx", "url": "http://127.0.0.1:9", "bucket": "b"}
    with Appliance(load(saved(tmp_path, made))) as appliance:
        status = appliance.diagnostics.adapter
        wire.until(lambda: (status("output/down") or {}).get("waiting") == 4, "all wait")
        made["outputs"]["down"]["bucket"] = "other"
        if is_removed:
            del made["outputs"]["down"]
        appliance.reload(load(saved(tmp_path, made)))
        logged = [each for each in caplog.records if each.message == "output_unsent"]
        assert len(logged) == is_removed
    [record] = [each for each in caplog.records if each.message == "output_unsent"]
    assert vars(record)["fields"]["count"] >= 4


@pytest.mark.parametrize("is_removed", [False, True])
def test_values_of_an_output_that_never_starts_again_are_logged_as_lost(
    tmp_path: Path,
    device: int,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
    is_removed: bool,
) -> None:
    """At the end of the program, or when a reload removes it."""

    def fail(*_: object) -> Any:
        raise OSError("can't be opened")

    def logged() -> list[int]:
        found = [each for each in caplog.records if each.message == "output_unsent"]
        return [vars(each)["fields"]["count"] for each in found]

    made = settings(device)
    made["outputs"]["down"] = {"type": "influx", "url": "http://127.0.0.1:9", "bucket": "b"}
    with Appliance(load(saved(tmp_path, made))) as appliance:
        status = appliance.diagnostics.adapter
        wire.until(lambda: (status("output/down") or {}).get("waiting") == 4, "all wait")
        monkeypatch.setattr(outputs, "receiver", fail)
        made["outputs"]["down"]["bucket"] = "other"
        appliance.reload(load(saved(tmp_path, made)))
        wire.until(lambda: (status("output/down") or {}).get("state") == "failed", "it fails")
        assert logged() == []
        if is_removed:
            del made["outputs"]["down"]
            appliance.reload(load(saved(tmp_path, made)))
            assert len(logged()) == 1
    [count] = logged()
    assert count >= 4


def test_a_reload_changes_tags_and_outputs_and_loses_nothing(
    tmp_path: Path, device: int, memory: holdfast.Memory
) -> None:
    made = settings(device)
    with Appliance(load(saved(tmp_path, made))) as appliance:
        wire.until(lambda: len(rows(tmp_path)) == 4, "all values are there")
        made["profiles"]["meter"] = {
            "tags": {"power": {"area": "holding_registers", "address": 0, "scale": 10}}
        }
        made["outputs"]["new"] = {"type": "file", "file": "new.jsonl", "format": "jsonl"}
        changed = appliance.reload(load(saved(tmp_path, made)))
        assert changed == ["devices.m", "outputs.new"]
        wire.until(lambda: values(tmp_path, "power")[-1] == 2150, "it has another scale")
        wire.until(lambda: values(tmp_path, "power", "new.jsonl") == [2150], "both have it")
        del made["outputs"]["out"]
        assert appliance.reload(load(saved(tmp_path, made))) == ["outputs.out"]
        memory.write("holding_registers", 0, [1])
        wire.until(lambda: values(tmp_path, "power", "new.jsonl")[-1] == 10, "one is left")
        assert values(tmp_path, "power")[-1] == 2150
        assert set(appliance.diagnostics.stats()["adapters"]) == {"output/new"}


def test_a_reload_can_add_the_first_tags(tmp_path: Path, device: int) -> None:
    made = settings(device, gateway=None)
    first: dict[str, Any] = {"memories": {"p": {"coils": 1}}, "listeners": {}}
    first["rest"] = {"bind": "127.0.0.1:0", "sources": ["127.0.0.0/8"], "tokens": "none"}
    del first["listeners"], made["gateway"]
    with Appliance(load(saved(tmp_path, first))) as appliance:
        appliance.reload(load(saved(tmp_path, {**made, **first})))
        wire.until(lambda: len(rows(tmp_path)) == 4, "all values are there")


class Polls:
    """Hands out the polls of a test, as the native receiver does."""

    def __init__(self) -> None:
        self.waiting: queue.Queue[Any] = queue.Queue()
        self.empty = 0
        """How often there was none."""
        self.dropped = 0

    def take(self, _: float) -> Any:
        try:
            return self.waiting.get(timeout=0.01)
        except queue.Empty:
            self.empty += 1
            return [], []


def adopt(values: TagValues, config: Config) -> dict[str, str]:
    """Takes over a configuration in which all may differ. Returns the names in polls."""
    tagged = values.tagged(config, config.devices)
    values.adopt(config, tagged)
    return {name: each.reported_as for name, each in tagged.items()}


def registers(power: int = 0) -> list[Any]:
    """The blocks of a poll."""
    words = power.to_bytes(2, "big") + bytes(10)
    return [("holding_registers", 0, 6, words, 0, 0.0), ("coils", 0, 1, b"\0", 0, 0.0)]


def power(values: TagValues) -> list[Any]:
    return [each.value for each in values.latest() if each.tag.name == "power"]


@pytest.mark.parametrize("change", [{"url": "tcp://127.0.0.1:503"}, {"unit": 2}])
def test_polls_of_the_machine_before_a_reload_are_not_of_the_new_one(
    tmp_path: Path, change: dict[str, Any]
) -> None:
    made = settings(502)
    made["outputs"]["out"]["publish"] = "change"
    found = TagValues(cast("Any", Polls()))
    before = adopt(found, load(saved(tmp_path, made)))["m"]
    assert (found.answering(), found.answers) == ({"m": False}, 1)
    found._handle(deque([(before, 0.0, registers(10))]))
    assert (power(found), found.answering(), found.answers) == ([1.0], {"m": True}, 2)
    made["devices"]["m"] |= change
    now = adopt(found, load(saved(tmp_path, made)))["m"]
    assert (found.latest(), found.answering(), found.answers) == ([], {"m": False}, 3)
    buffer = found._outputs["out"].buffer
    waiting = len(buffer)
    # The first poll of the new machine may come before the late one.
    for reported_as, value in ((now, 10), (before, 20)):
        found._handle(deque([(reported_as, 0.0, registers(value))]))
    assert power(found) == [1.0]
    assert len(buffer) == waiting + 4, "the same values, of another machine"
    assert (found.answering(), found.answers) == ({"m": True}, 4)


def test_a_poll_under_way_counts_if_a_reload_changes_only_other_settings(tmp_path: Path) -> None:
    made = settings(502)
    found = TagValues(cast("Any", Polls()))
    name = adopt(found, load(saved(tmp_path, made)))["m"]
    made["devices"]["m"]["timeout"] = 0.5
    assert adopt(found, load(saved(tmp_path, made))) == {"m": name}
    found._handle(deque([(name, 0.0, registers(10))]))
    assert power(found) == [1.0]


def test_a_reload_keeps_the_values_of_tags_that_stay(tmp_path: Path) -> None:
    made = settings(502)
    found = TagValues(cast("Any", Polls()))
    before = adopt(found, load(saved(tmp_path, made)))["m"]
    found._handle(deque([(before, 0.0, registers(10))]))
    changed = {"on": {"area": "coils", "address": 1}, "new": {"area": "coils", "address": 2}}
    made["profiles"] = {"meter": {"tags": METER["tags"] | changed}}
    adopt(found, load(saved(tmp_path, made)))
    assert {each.name for each in found.latest()} == {"power", "label", "phases"}
    # It does not have the new tags.
    found._handle(deque([(before, 0.0, registers(20))]))
    assert power(found) == [1.0]
    adopt(found, load(saved(tmp_path, settings(502, devices={}))))
    assert found.latest() == []


@pytest.mark.parametrize("is_tag_changed", [False, True])
def test_a_reload_keeps_the_values_of_the_same_machine_and_tags(
    tmp_path: Path, is_tag_changed: bool
) -> None:
    """Also if the URL has another spelling, or a tag another description."""
    made = settings(502)
    power_tag = METER["tags"]["power"]
    found = TagValues(cast("Any", Polls()))
    before = adopt(found, load(saved(tmp_path, made)))
    found._handle(deque([(before["m"], 0.0, registers(10))]))
    state = found.answers, len(found.latest())
    revision = found.revision
    if is_tag_changed:
        changed = {"power": power_tag | {"description": "of all phases", "writable": True}}
        made["profiles"] = {"meter": {"tags": METER["tags"] | changed}}
    else:
        made["devices"]["m"]["url"] += "/"
    config = load(saved(tmp_path, made))
    tagged = found.tagged(config, config.devices)
    assert found.adopt(config, tagged) == set(), "nothing has to be read at once"
    assert {"m": tagged["m"].reported_as} == before
    assert (found.answers, len(found.latest())) == state
    assert found.revision == revision + is_tag_changed
    assert all(found.find("m", each.name) is each.tag for each in found.latest())
    found._handle(deque([(before["m"], 0.0, registers(20))]))
    assert power(found) == [2.0], "a poll under way counts"


@pytest.mark.parametrize(
    "changed", [{"scale": 1}, {"offset": 1}, {"type": "int16"}, {"address": 1}, {"unit": "kW"}]
)
def test_a_reload_forgets_the_value_of_a_tag_with_another_meaning(
    tmp_path: Path, changed: dict[str, Any]
) -> None:
    made = settings(502)
    found = TagValues(cast("Any", Polls()))
    before = adopt(found, load(saved(tmp_path, made)))["m"]
    found._handle(deque([(before, 0.0, registers(10))]))
    tags = METER["tags"] | {"power": METER["tags"]["power"] | changed}
    made["profiles"] = {"meter": {"tags": tags}}
    config = load(saved(tmp_path, made))
    assert found.adopt(config, found.tagged(config, config.devices)) == {"m"}
    assert {each.name for each in found.latest()} == {"on", "label", "phases"}


def test_a_poll_of_other_ranges_is_none_of_a_device(tmp_path: Path) -> None:
    made = settings(502)
    found = TagValues(cast("Any", Polls()))
    before = adopt(found, load(saved(tmp_path, made)))
    made["devices"]["m"]["max_registers"] = 2
    assert adopt(found, load(saved(tmp_path, made))) == before, "all tags still fit"
    made["devices"]["m"]["max_registers"] = 1
    config = load(saved(tmp_path, made))
    now = found.tagged(config, config.devices)["m"]
    assert now.reported_as != before["m"]
    assert ("holding_registers", 5, 1) in now.reader.fields


def test_another_order_of_the_tags_of_a_register_is_no_change(tmp_path: Path) -> None:
    made = settings(502)
    bits = {
        name: {"area": "holding_registers", "address": 5, "type": f"bit:{bit}"}
        for bit, name in enumerate(("run", "trip"))
    }
    found = TagValues(cast("Any", Polls()))
    made["devices"]["m"]["tags"] = bits
    before = adopt(found, load(saved(tmp_path, made)))
    made["devices"]["m"]["tags"] = dict(reversed(bits.items()))
    assert adopt(found, load(saved(tmp_path, made))) == before


@pytest.mark.parametrize("is_moved", [False, True])
def test_after_a_reload_a_device_is_read_at_once(
    tmp_path: Path, device: int, serve: Serve, is_moved: bool
) -> None:
    """Also if it is read only once an hour: with another address, or with another tag."""
    made = settings(device)
    made["devices"]["m"]["interval"] = 3600
    made["outputs"]["out"]["publish"] = "change"
    with Appliance(load(saved(tmp_path, made))) as appliance:
        wire.until(lambda: len(rows(tmp_path)) == 4, "all values are there")
        if is_moved:
            other = holdfast.Memory(holding_registers=10, coils=8)
            other.write("holding_registers", 0, [215, 0, 0x6162, 0x6300, 8, 65535])
            made["devices"]["m"]["url"] = f"tcp://127.0.0.1:{serve({1: other}).address[1]}"
            appliance.reload(load(saved(tmp_path, made)))
            wire.until(lambda: len(rows(tmp_path)) == 8, "all are published, though some are equal")
            assert values(tmp_path, "phases") == [[7, -1], [8, -1]]
        else:
            new = {"new": {"area": "holding_registers", "address": 1}}
            made["profiles"] = {"meter": {"tags": METER["tags"] | new}}
            appliance.reload(load(saved(tmp_path, made)))
            wire.until(lambda: values(tmp_path, "new") == [0], "the new one is there")
        tags = {reading.name for reading, _ in appliance.diagnostics.tag_values()}
    assert tags == made["profiles"]["meter"]["tags"].keys()


def test_a_device_that_another_node_polls_has_no_values(tmp_path: Path) -> None:
    made = settings(502)
    made["outputs"]["out"]["publish"] = "change"
    config = load(saved(tmp_path, made))
    polls: Any = Polls()
    found = TagValues(polls)
    name = adopt(found, config)["m"]
    buffer = found._outputs["out"].buffer

    def poll(blocks: list[Any]) -> int:
        """How many readings the output got."""
        before = len(buffer)
        found._handle(deque([(name, 0.0, blocks)]))
        return len(buffer) - before

    assert poll([]) == 0
    assert (set(found.standby), found.answering()) == ({"m"}, {"m": False})
    assert (poll(registers()), poll(registers())) == (4, 0)
    found.renew("out", {("m", "power"), ("m", "gone")})
    assert (poll(registers()), poll(registers())) == (1, 0)
    assert (found.answering(), len(found.latest())) == ({"m": True}, 4)
    assert not found.standby
    answers = found.answers
    assert poll([]) == 0
    assert (set(found.standby), found.answering()) == ({"m"}, {"m": False})
    assert found.latest() == []
    assert found.answers == answers + 1
    waiting = len(buffer)
    found.refresh("out")
    assert len(buffer) == waiting
    adopt(found, config)
    assert found.standby == {"m"}
    # Another node may have published another value meanwhile.
    assert poll(registers()) == 4
    assert not found.standby
    poll([])
    adopt(found, load(saved(tmp_path, settings(502, devices={}))))
    assert not found.standby


def test_a_backlog_is_handled_in_turns_and_losses_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tag_values, "_TURN_S", 0.0)
    polls: Any = Polls()
    found = TagValues(polls)
    # On some Pythons, a clock that is set back lengthens such a wait.
    monkeypatch.setattr(found._stopping, "wait", None)
    turns: list[int] = []
    offer = found._offer

    def counted(polls: Any) -> None:
        turns.append(len(polls))
        offer(polls)

    monkeypatch.setattr(found, "_offer", counted)
    events: list[tuple[str, Any]] = []

    def observer(event: str, fields: Any, _by: object, _times: int) -> None:
        events.append((event, fields["count"]))

    name = adopt(found, load(saved(tmp_path, settings(502))))["m"]
    log_lines.observe(observer)
    found.start()
    try:
        polls.dropped = 7
        polls.waiting.put(([(name, float(at), registers()) for at in range(5)], []))
        wire.until(lambda: len(turns) >= 5 and bool(events), "all are handled")
    finally:
        polls.waiting.put(None)
        found.join(wire.DEADLINE)
        log_lines.forget(observer)
    assert turns == [1] * 5
    assert events == [("tag_polls_dropped", 7)]
    assert found.dropped == 7


def test_the_age_of_a_value_counts_a_suspend_and_does_not_follow_the_clock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clocks = SimpleNamespace(time=lambda: 1_700_000_002.0, monotonic=lambda: 7.0, now=lambda: 50.0)
    monkeypatch.setattr(tag_values, "time", clocks)
    monkeypatch.setattr(tag_values, "standstill", clocks)
    found = TagValues(cast("Any", Polls()))
    name = adopt(found, load(saved(tmp_path, settings(502))))["m"]
    blocks: list[Any] = [("holding_registers", 0, 6, bytes(12), 0, 1_700_000_000.0)]
    found._handle(deque([(name, 0.0, blocks)]))
    clocks.time, clocks.now = lambda: 1_700_003_602.0, lambda: 55.0
    _, ages = tag_metrics(cast("Any", SimpleNamespace(tag_values=found.latest_with_ages)))
    assert {sample.value for sample in ages.samples} == {7.0}


def test_values_are_metrics(tmp_path: Path, device: int, memory: holdfast.Memory) -> None:
    made = settings(device, metrics={"bind": "127.0.0.1:0", "values": True})
    with Appliance(load(saved(tmp_path, made))) as appliance:
        wire.until(lambda: len(rows(tmp_path)) == 4, "all values are there")
        host, port = endpoint(appliance, "metrics")
        with urllib.request.urlopen(f"http://{host}:{port}/metrics") as answer:
            lines = answer.read().decode().splitlines()
    found = [line for line in lines if line.startswith("holdfast_tag_value")]
    assert sorted(found) == [
        'holdfast_tag_value{device="m",tag="on",unit=""} 0.0',
        'holdfast_tag_value{device="m",tag="phases[0]",unit=""} 7.0',
        'holdfast_tag_value{device="m",tag="phases[1]",unit=""} -1.0',
        'holdfast_tag_value{device="m",tag="power",unit="W"} 21.5',
    ]
    ages = [line for line in lines if line.startswith("holdfast_tag_age_seconds{")]
    assert len(ages) == 4
    assert memory.read("coils", 0, 1) == [False]

"""The MQTT adapter with Mosquitto: messages are written, and it comes back whatever happens."""

from __future__ import annotations

import json
import logging
import os
import socket
import subprocess
import sys
import threading
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import HealthCheck, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from holdfast.adapters.mqtt import inbox, sessions
from holdfast.ingest import MemoryAccess
from support import wire
from support.brokers import free_port
from support.cases import examples
from support.machine import tool
from support.mqtt_rig import Rig, command, handled, settings, subscription, text

if TYPE_CHECKING:
    from collections.abc import Iterator

    from holdfast.ingest import Grant, Written

VERSIONS = ["5", "3.1.1"]


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with Rig(tmp_path) as rig:
        yield rig


# Messages


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("qos", [0, 1, 2])
def test_a_message_is_written(rig: Rig, version: str, qos: int) -> None:
    broker = rig.broker()
    running = rig.connected(broker, subscription(qos=qos), version=version)

    broker.publish("plant/ingest", text(command([100, 200, 300])), "-q", str(qos))
    rig.probe(broker).publish("plant/ingest", text(command([65535], 10)), qos)
    running.wait_until_received(2)

    assert rig.registers(0, 4) == [100, 200, 300, 0]
    assert rig.registers(10, 1) == [65535]
    assert running.status()["topics"] == [{"topic": "plant/ingest", "qos": qos, "granted": qos}]
    assert running.status()["received"] == 2
    assert running.status()["version"] == version


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("qos", [0, 1, 2])
def test_many_messages_are_written_in_order(rig: Rig, version: str, qos: int) -> None:
    broker = rig.broker("allow_anonymous true", "max_queued_messages 0")
    running = rig.connected(broker, subscription(qos=qos), version=version)
    lines = "\n".join(text(command([number, number], number % 7)) for number in range(500))

    subprocess.run(
        [tool("mosquitto_pub"), "-p", str(broker.port), "-t", "plant/ingest", "-q", str(qos), "-l"],
        input=lines.encode(),
        check=True,
        timeout=wire.DEADLINE,
    )
    running.wait_until_received(500)

    assert rig.memory_access.counts()["accepted"] == 500
    expected: dict[int, int] = {}
    for number in range(500):
        expected |= {number % 7: number, number % 7 + 1: number}
    assert rig.registers(0, 8) == [expected[address] for address in range(8)]


def test_all_areas_and_a_batch_over_two_memories(rig: Rig) -> None:
    broker = rig.broker()
    areas = ["coils", "discrete_inputs", "holding_registers", "input_registers"]
    running = rig.connected(broker, subscription(memories=["plant", "other"], areas=areas))

    batch = text(
        command([1, 0, True], area="coils"),
        {"memory": "plant", "area": "discrete_inputs", "address": 5, "bools": [True, False, 1]},
        command([7], 3),
        command([8, 9], 4, memory="other", area="input_registers"),
    )
    rig.probe(broker).publish("plant/ingest", batch)
    running.wait_until_received(1)

    assert rig.memory.read("coils", 0, 3) == [1, 0, 1]
    assert rig.memory.read("discrete_inputs", 5, 3) == [1, 0, 1]
    assert rig.registers(3, 1) == [7]
    assert rig.other.read("input_registers", 4, 2) == [8, 9]


@pytest.mark.parametrize("version", VERSIONS)
def test_a_retained_message_is_delivered_at_the_start(rig: Rig, version: str) -> None:
    broker = rig.broker()
    broker.publish("plant/ingest", text(command([42])), "-r", "-q", "1")

    running = rig.run(settings(broker.url, version=version))
    running.wait_until_received(1)

    assert rig.registers(0, 1) == [42]


@pytest.mark.parametrize("version", VERSIONS)
def test_a_retained_message_is_not_delivered_again_when_only_the_connection_broke(
    rig: Rig, version: str
) -> None:
    broker = rig.broker()
    proxy = rig.proxy(broker)
    broker.publish("plant/ingest", text(command([42])), "-r", "-q", "1")
    running = rig.run(settings(proxy.url, version=version))
    running.wait_until_received(1)
    # A message whose acknowledgement has not come is sent again, and rightly so.
    wire.until(lambda: "Received PUBACK from holdfast-test" in broker.log, "acknowledged")
    rig.memory.write("holding_registers", 0, [43])

    proxy.cut()
    wire.until(lambda: running.status()["reconnects"] == 1, "reconnected")
    running.wait_until_connected()
    rig.probe(broker).publish("plant/ingest", text(command([44], 1)))
    running.wait_until_received(2)

    assert rig.registers(0, 2) == [43, 44]


@pytest.mark.parametrize("version", VERSIONS)
def test_a_retained_message_is_not_delivered_again_to_an_adapter_that_replaces_another(
    rig: Rig, version: str
) -> None:
    broker = rig.broker()
    broker.publish("plant/ingest", text(command([42])), "-r", "-q", "1")
    broker.publish("plant/more", text(command([52], 1)), "-r", "-q", "1")
    running = rig.run(settings(broker.url, version=version))
    running.wait_until_received(1)
    wire.until(lambda: "Received PUBACK from holdfast-test" in broker.log, "acknowledged")
    rig.memory.write("holding_registers", 0, [43])
    running.stop()

    both = [subscription(), subscription("plant/more")]
    after = rig.run(settings(broker.url, *both, version=version))
    after.wait_until_received(2)
    after.wait_until_connected()
    rig.probe(broker).publish("plant/ingest", text(command([44], 2)))
    after.wait_until_received(3)

    assert rig.registers(0, 3) == [43, 52, 44]


def test_a_retained_message_is_not_delivered_again_to_a_memory_that_was_restored(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    broker = rig.broker()
    broker.publish("plant/ingest", text(command([42])), "-r", "-q", "1")
    broker.publish("plant/other", text(command([52], memory="other")), "-r", "-q", "1")
    both = [subscription(), subscription("plant/other", memories=["plant", "other"])]
    running = rig.run(settings(broker.url, *both), restored={"plant"})
    running.wait_until_received(2)
    wire.until(lambda: broker.log.count("Received PUBACK from holdfast-test") == 2, "acknowledged")
    rig.memory.write("holding_registers", 0, [43])
    rig.other.write("holding_registers", 0, [53])
    running.stop()

    # Another process knows nothing of the session, which the topic `new` is not in.
    monkeypatch.setattr(sessions, "_SESSIONS", {})
    broker.publish("plant/new", text(command([62], 1)), "-r", "-q", "1")
    after = rig.run(settings(broker.url, *both, subscription("plant/new")), restored={"plant"})
    after.wait_until_received(4)
    after.wait_until_connected()
    rig.probe(broker).publish("plant/ingest", text(command([44], 2)))
    after.wait_until_received(5)

    assert rig.registers(0, 3) == [43, 62, 44]
    assert rig.other.read("holding_registers", 0, 1) == [52]


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("first", [0, 1])
def test_the_first_of_overlapping_filters_gives_the_grant(
    rig: Rig, version: str, first: int
) -> None:
    broker = rig.broker()
    narrow = subscription("plant/+", areas=["holding_registers"])
    wide = subscription("plant/#", areas=["coils"])
    filters = (narrow, wide) if first == 0 else (wide, narrow)
    running = rig.connected(broker, *filters, version=version)

    probe = rig.probe(broker)
    probe.publish("plant/a", text(command([1])))
    probe.publish("plant/a", text(command([1], area="coils")))
    probe.publish("plant/a/b", text(command([1], 1, area="coils")))
    probe.publish("plant/a/b", text(command([1], 1)))
    running.wait_until_received(4)
    probe.publish("plant/last/b", text(command([1], 2, area="coils")))
    wire.until(lambda: rig.memory.read("coils", 2, 1) == [1], "the last message")

    assert rig.registers(0, 2) == ([1, 0] if first == 0 else [0, 0])
    assert rig.memory.read("coils", 0, 2) == ([0, 1] if first == 0 else [1, 1])


def test_a_shared_subscription(rig: Rig) -> None:
    broker = rig.broker()
    running = rig.connected(broker, subscription("$share/holdfasts/plant/+"))

    rig.probe(broker).publish("plant/ingest", text(command([5])))
    running.wait_until_received(1)

    assert rig.registers(0, 1) == [5]


def test_a_subscription_does_not_reach_the_memory_of_another(rig: Rig) -> None:
    broker = rig.broker()
    own = subscription("plant/ingest", memories=["plant"])
    running = rig.connected(broker, own, subscription("other/ingest", memories=["other"]))

    probe = rig.probe(broker)
    probe.publish("plant/ingest", text(command([1], memory="other")))
    probe.publish("other/ingest", text(command([1], memory="plant")))
    probe.publish("plant/ingest", text(command([1], 1), command([1], memory="other")))
    probe.publish("plant/ingest", text(command([2], 9)))
    probe.publish("other/ingest", text(command([3], 9, memory="other")))
    running.wait_until_received(5)

    assert rig.registers(0, 10) == [0] * 9 + [2]
    assert rig.other.read("holding_registers", 0, 10) == [0] * 9 + [3]
    assert rig.memory_access.counts()["refused"] == {"not_granted": 3}


# Messages that are refused

BAD = {
    "garbage": ("\0\xff{", "malformed"),
    "empty": ("", "malformed"),
    "not JSON": ("{", "malformed"),
    "deep": ("[" * 100_000, "malformed"),
    "a number": ("1", "malformed"),
    "an empty batch": ("[]", "malformed"),
    "a key too many": (text(command([1]) | {"more": 1}), "malformed"),
    "a key too few": ('{"memory": "plant"}', "malformed"),
    "a float": (text(command([1, 1.0])), "invalid_value"),
    "text": (text(command(["1"])), "invalid_value"),
    "a boolean": (text(command([True])), "invalid_value"),
    "too large": (text(command([65536])), "invalid_value"),
    "huge": (text(command([10**400])), "invalid_value"),
    "negative": (text(command([1, -1])), "invalid_value"),
    "no bit": (text(command([0, 2], area="coils")), "invalid_value"),
    "no values": (text(command([])), "malformed"),
    "outside": (text(command([1, 2], 999)), "out_of_range"),
    "no such memory": (text(command([1], memory="nowhere")), "unknown_memory"),
    "a memory of others": (text(command([1], memory="other")), "not_granted"),
    "an area of others": (text(command([1], area="input_registers")), "not_granted"),
    "no area": (text(command([1], area="registers")), "invalid_area"),
    "bad at the end": (
        text(command([1]), command([2], 5), command([1, 70000], 7)),
        "invalid_value",
    ),
    "too many bytes": (" " * (inbox.MAX_PAYLOAD_BYTES - 1) + "{}", "too_large"),
}


@pytest.mark.parametrize("version", VERSIONS)
def test_bad_messages_change_nothing_and_do_not_stop_the_good_ones(rig: Rig, version: str) -> None:
    broker = rig.broker()
    running = rig.connected(broker, version=version)
    rig.memory.write("holding_registers", 500, [1, 2, 3])
    probe = rig.probe(broker)

    for number, (name, (payload, _)) in enumerate(BAD.items()):
        before = rig.all_content()
        probe.publish("plant/ingest", payload.encode(errors="surrogateescape"), number % 3)
        running.wait_until_received(2 * number + 1)
        assert rig.all_content() == before, name
        probe.publish("plant/ingest", text(command([number + 1], 900)), number % 3)
        running.wait_until_received(2 * number + 2)
        assert rig.registers(900, 1) == [number + 1], name

    counts: Any = rig.memory_access.counts()
    reasons = [reason for _, reason in BAD.values()]
    assert counts["refused"] == {reason: reasons.count(reason) for reason in reasons}
    assert counts["accepted"] == len(BAD)


def test_the_largest_message_is_taken(rig: Rig) -> None:
    broker = rig.broker()
    running = rig.connected(broker)

    payload = text(command([7])).ljust(inbox.MAX_PAYLOAD_BYTES)
    rig.probe(broker).publish("plant/ingest", payload)
    running.wait_until_received(1)

    assert rig.registers(0, 1) == [7]


def test_a_message_of_many_times_the_limit(rig: Rig) -> None:
    broker = rig.broker()
    running = rig.connected(broker)

    probe = rig.probe(broker)
    probe.publish("plant/ingest", b"[" * (10 * inbox.MAX_PAYLOAD_BYTES))
    probe.publish("plant/ingest", text(command([7])))
    running.wait_until_received(2)

    assert rig.registers(0, 1) == [7]
    assert rig.memory_access.counts()["refused"] == {"too_large": 1}


def test_a_concurrent_reader_never_sees_a_part_of_a_batch(rig: Rig) -> None:
    broker = rig.broker()
    running = rig.connected(broker, subscription(memories=["plant", "other"]))
    seen: set[tuple[int, ...]] = set()
    over = threading.Event()

    def read() -> None:
        while not over.is_set():
            (low,), (high,) = rig.memory.read_many(
                [("holding_registers", 0, 1), ("holding_registers", 999, 1)]
            )
            seen.add((low, high))

    reader = threading.Thread(target=read)
    reader.start()
    try:
        probe = rig.probe(broker)
        for number in range(1, 300):
            probe.publish("plant/ingest", text(command([number]), command([number], 999)), 0)
        running.wait_until_received(299)
        wire.until(lambda: (299, 299) in seen, "the reader sees the last batch")
    finally:
        over.set()
        reader.join()

    assert {low - high for low, high in seen} == {0}
    assert len(seen) > 2


# Answers


@pytest.mark.parametrize("qos", [0, 1, 2])
def test_messages_with_a_response_topic_are_answered_there(rig: Rig, qos: int) -> None:
    broker = rig.broker()
    running = rig.connected(broker, subscription(qos=2))
    probe = rig.probe(broker)
    probe.subscribe("answers/me", 2)

    def ask(payload: str, correlation: bytes) -> dict[str, Any]:
        probe.publish(
            "plant/ingest", payload, qos, ResponseTopic="answers/me", CorrelationData=correlation
        )
        message = probe.get()
        assert message.topic == "answers/me"
        assert getattr(message.properties, "CorrelationData", None) == correlation
        return dict(json.loads(message.payload))

    assert ask(text(command([1, 2, 3])), b"\0\xff first") == {
        "status": "accepted",
        "memory": "plant",
        "written": 3,
    }
    assert ask(text(command([1]), command([2], 1)), b"second") == {
        "status": "accepted",
        "commands": 2,
        "written": 2,
    }
    assert ask(text(command([1, 70000])), b"third" * 10_000) == {
        "status": "rejected",
        "reason": "invalid_value",
        "index": 1,
        "detail": "values[1] is 70000, outside 0..65535",
    }
    wire.until(lambda: running.status()["answers"] == 3, "all are counted")
    assert running.status()["answers_dropped"] == 0


def test_an_answer_without_correlation_data_has_none(rig: Rig) -> None:
    broker = rig.broker()
    rig.connected(broker)
    probe = rig.probe(broker)
    probe.subscribe("answers")

    probe.publish("plant/ingest", text(command([1])), ResponseTopic="answers")

    assert not hasattr(probe.get().properties, "CorrelationData")


def test_an_answer_that_would_come_back_is_dropped(rig: Rig) -> None:
    broker = rig.broker()
    running = rig.connected(broker, subscription(), subscription("loop/+/#", 0))
    probe = rig.probe(broker)

    for topic in ("plant/ingest", "loop/a", "loop/a/b/c"):
        probe.publish("plant/ingest", text(command([1])), ResponseTopic=topic)
    probe.publish("plant/ingest", text(command([2])))
    running.wait_until_received(4)
    wire.until(lambda: running.status()["answers_dropped"] == 3, "three are counted")

    assert running.status()["answers"] == 0
    assert running.status()["received"] == 4


# The connection


@pytest.mark.parametrize("version", VERSIONS)
def test_it_comes_back_when_the_broker_was_killed(rig: Rig, version: str) -> None:
    broker = rig.broker()
    running = rig.connected(broker, subscription(), subscription("second/#", 2), version=version)
    broker.publish("plant/ingest", text(command([1])))
    running.wait_until_received(1)

    for number in (2, 3):
        broker.kill()
        wire.until(lambda: not running.status()["connected"], "the end is noticed")
        assert [topic["granted"] for topic in running.status()["topics"]] == [None, None]
        broker.start()
        running.wait_until_connected()
        broker.publish("second/topic", text(command([number])), "-q", "2")
        running.wait_until_received(number)

    assert rig.registers(0, 1) == [3]
    assert running.status()["reconnects"] == 2
    assert [topic["granted"] for topic in running.status()["topics"]] == [1, 2]


def test_a_broker_that_hangs_is_left_and_found_again(rig: Rig) -> None:
    broker = rig.broker()
    running = rig.connected(broker, keep_alive=1)

    broker.freeze()
    wire.until(lambda: not running.status()["connected"], "the silence is noticed")
    broker.thaw()
    running.wait_until_connected()
    broker.publish("plant/ingest", text(command([1])), "-q", "1")
    running.wait_until_received(1)

    assert running.status()["last_error"] == "Keep alive timeout"


def test_a_broker_that_comes_later_is_found(rig: Rig) -> None:
    broker = rig.broker()
    broker.kill()
    running = rig.run(settings(broker.url))
    wire.until(lambda: running.status()["last_error"] is not None, "it failed")
    assert "refused" in str(running.status()["last_error"])

    broker.start()
    running.wait_until_connected()

    assert running.status()["reconnects"] == 0


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("qos", [1, 2])
def test_messages_published_while_it_was_away_are_delivered(
    rig: Rig, version: str, qos: int
) -> None:
    broker = rig.broker()
    running = rig.connected(broker, subscription(qos=qos), version=version)
    running.stop()

    for number in range(5):
        broker.publish("plant/ingest", text(command([number + 1], number)), "-q", str(qos))
    again = rig.run(settings(broker.url, subscription(qos=qos), version=version))
    again.wait_until_received(5)

    assert rig.registers(0, 5) == [1, 2, 3, 4, 5]


def test_a_topic_that_is_no_longer_configured_writes_nothing(rig: Rig) -> None:
    broker = rig.broker()
    rig.connected(broker, subscription("old/topic")).stop()

    broker.publish("old/topic", text(command([1])), "-q", "1")
    running = rig.connected(broker, subscription("new/topic"))
    running.wait_until_received(1)

    assert rig.registers(0, 1) == [0]
    assert rig.memory_access.counts()["refused"] == {"not_granted": 1}


def test_it_works_at_an_ipv6_address(rig: Rig) -> None:
    broker = rig.broker(host="::1")
    running = rig.connected(broker)

    broker.publish("plant/ingest", text(command([1])), "-q", "1")
    running.wait_until_received(1)

    assert running.status()["broker"] == f"[::1]:{broker.port}"
    assert rig.registers(0, 1) == [1]


def test_it_works_with_descriptors_above_those_that_select_can_wait_for(rig: Rig) -> None:
    broker = rig.broker()
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard < 2048:
        pytest.skip("the system lets a process open too few files")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, 2048), hard))
    with ExitStack() as opened:
        opened.callback(resource.setrlimit, resource.RLIMIT_NOFILE, (soft, hard))
        for _ in range(1100):
            opened.enter_context(Path(os.devnull).open("rb"))
        running = rig.connected(broker)
        broker.publish("plant/ingest", text(command([1])), "-q", "1")
        running.wait_until_received(1)
        running.stop()


# Credentials


@pytest.mark.parametrize("version", VERSIONS)
def test_a_wrong_password_is_refused_and_the_right_one_taken_as_soon_as_it_is_there(
    rig: Rig, version: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    users, secret = tmp_path / "users", tmp_path / "secret"
    subprocess.run(
        [tool("mosquitto_passwd"), "-c", "-b", str(users), "plant", "the right one"], check=True
    )
    broker = rig.broker("allow_anonymous false", f"password_file {users}")
    secret.write_text("the wrong one\n")
    running = rig.run(settings(broker.url, username="plant", password_file=secret, version=version))
    wire.until(lambda: broker.log.count("not authorised") >= 3, "three attempts")
    assert not running.status()["connected"]
    assert "refused the connection: Not authorized" in running.status()["last_error"]

    secret.unlink()
    wire.until(lambda: "No such file" in running.status()["last_error"], "the file is missed")

    (tmp_path / "new").write_text("the right one\n")
    (tmp_path / "new").rename(secret)
    running.wait_until_connected()
    broker.publish(
        *("plant/ingest", text(command([1])), "-q", "1", "-u", "plant", "-P", "the right one")
    )
    running.wait_until_received(1)
    running.stop()

    told = [record.getMessage() for record in caplog.records]
    assert told.count("mqtt_connect_failed") == 2
    for record in caplog.records:
        everything = f"{record.getMessage()} {record.__dict__}"
        assert "the right one" not in everything
        assert "the wrong one" not in everything
    assert "right" not in str(running.status())


@pytest.mark.parametrize("end", ["", "\n", "\r\n"])
def test_one_newline_after_the_password_is_left_out(rig: Rig, end: str, tmp_path: Path) -> None:
    users, secret = tmp_path / "users", tmp_path / "secret"
    subprocess.run(
        [tool("mosquitto_passwd"), "-c", "-b", str(users), "plant", " päss word "], check=True
    )
    broker = rig.broker("allow_anonymous false", f"password_file {users}")
    secret.write_bytes(f" päss word {end}".encode())

    rig.connected(broker, username="plant", password_file=secret)


def test_a_password_too_long_is_a_failure_like_others(rig: Rig, tmp_path: Path) -> None:
    broker = rig.broker()
    secret = tmp_path / "secret"
    secret.write_bytes(b"x" * 65536)
    running = rig.run(settings(broker.url, username="plant", password_file=secret))
    wire.until(lambda: "65535" in str(running.status()["last_error"]), "it is refused")

    secret.write_bytes(b"x" * 65535)
    running.wait_until_connected()


# Batches


@given(
    good=st.lists(
        st.tuples(st.integers(0, 990), st.lists(st.integers(0, 65535), min_size=1, max_size=9)),
        min_size=1,
        max_size=20,
    ),
    bad=st.sampled_from(
        [
            command([1, 65536]),
            command([1, -1]),
            command([1, 0.5]),
            command([1, None]),
            command([2], area="coils"),
            command([1], 1000),
            command([1], memory="other"),
            command([1], area="input_registers"),
        ]
    ),
)
@hypothesis_settings(
    max_examples=examples(50),
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
def test_one_bad_command_at_the_end_of_a_batch_changes_nothing(
    batches: Batches, good: list[tuple[int, list[int]]], bad: dict[str, Any]
) -> None:
    commands = [command(values, address) for address, values in good]
    before = batches.rig.all_content()

    assert batches.outcome([*commands, bad])["status"] == "rejected"
    assert batches.rig.all_content() == before

    assert batches.outcome(commands)["status"] == "accepted"
    written = {
        address + place: value for address, values in good for place, value in enumerate(values)
    }
    now = batches.rig.registers(0, 1000)
    assert {address: now[address] for address in written} == written


class Batches:
    """Sends one batch at a time, and waits for the answer."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        broker = rig.broker("allow_anonymous true", "set_tcp_nodelay true")
        rig.connected(broker)
        self._probe = rig.probe(broker)
        self._probe.subscribe("answers", 0)

    def outcome(self, commands: list[dict[str, Any]]) -> dict[str, Any]:
        self._probe.publish("plant/ingest", json.dumps(commands), 0, ResponseTopic="answers")
        return dict(json.loads(self._probe.get().payload))


@pytest.fixture
def batches(rig: Rig) -> Batches:
    return Batches(rig)


# A crash

BLOCKED_IN_THE_WRITE = """
import json, sys, time
import holdfast
from holdfast.adapters import Stop
from holdfast.adapters.mqtt import Mqtt
from holdfast.config.models.services import MqttConfig
from holdfast.ingest import MemoryAccess

class Blocked(MemoryAccess):
    def ingest(self, body, grant, peer, *, stale):
        print("in the write", flush=True)
        sys.stdin.read()
        raise AssertionError

memory_access = Blocked("mqtt", {"plant": holdfast.Memory(holding_registers=1000, coils=1000)})
Mqtt(MqttConfig.model_validate(json.loads(sys.argv[1])), memory_access).run(Stop())
"""


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("qos", [1, 2])
def test_a_message_is_delivered_again_when_the_process_crashed_before_the_write(
    rig: Rig, version: str, qos: int
) -> None:
    broker = rig.broker()
    config = settings(broker.url, subscription(qos=qos), version=version)
    with subprocess.Popen(
        [sys.executable, "-c", BLOCKED_IN_THE_WRITE, config.model_dump_json(exclude_none=True)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            wire.until(lambda: "Sending SUBACK to holdfast-test" in broker.log, "subscribed")
            broker.publish("plant/ingest", text(command([1])), "-q", str(qos))
            assert process.stdout is not None
            assert process.stdout.readline() == "in the write\n"
        finally:
            process.kill()

    running = rig.run(config)
    running.wait_until_received(1)

    assert rig.registers(0, 1) == [1]


# The end


def test_it_ends_at_once_while_it_is_connected(rig: Rig) -> None:
    broker = rig.broker()
    running = rig.connected(broker)

    running.stop(1.0)

    wire.until(lambda: "Received DISCONNECT from holdfast-test" in broker.log, "a last word")
    assert running.status()["connected"] is False


def test_it_ends_at_once_while_nobody_listens(rig: Rig) -> None:
    running = rig.run(settings(f"mqtt://127.0.0.1:{free_port()}"), first_pause=60.0)
    wire.until(lambda: running.status()["last_error"] is not None, "it failed")

    running.stop(1.0)


def test_it_ends_at_once_while_an_address_does_not_answer(rig: Rig) -> None:
    with socket.socket() as full:
        full.bind(("127.0.0.1", 0))
        full.listen(0)
        port = full.getsockname()[1]
        with ExitStack() as waiting:
            for _ in range(3):
                one = waiting.enter_context(socket.socket())
                one.setblocking(False)
                one.connect_ex(("127.0.0.1", port))
            running = rig.run(settings(f"mqtt://127.0.0.1:{port}"))
            running.stop(1.0)
            assert running.status()["last_error"] is None


def test_a_name_that_does_not_exist_is_a_failure_like_others(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unknown(*_: object, **__: object) -> list[Any]:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    running = rig.run(settings("mqtt://broker.example:1883"))
    wire.until(lambda: running.status()["last_error"] is not None, "it failed")
    running.stop(1.0)


def test_it_ends_at_once_while_a_name_is_looked_up(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, answer = threading.Event(), threading.Event()

    def slow(*_: object, **__: object) -> list[Any]:
        asked.set()
        answer.wait(wire.DEADLINE)
        return []

    monkeypatch.setattr(socket, "getaddrinfo", slow)
    try:
        running = rig.run(settings("mqtt://broker.example:1883"))
        assert asked.wait(wire.DEADLINE)
        running.stop(1.0)
    finally:
        answer.set()


# Faults


def test_a_fault_in_the_write_does_not_stop_the_next_message(
    rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    class Faulty(MemoryAccess):
        def ingest(
            self,
            body: bytes | bytearray | memoryview,
            grant: Grant,
            peer: str,
            *,
            stale: str | None = None,
        ) -> Written:
            if b"fault" in bytes(body):
                raise RuntimeError("a fault")
            return super().ingest(body, grant, peer, stale=stale)

    memory_access = Faulty("mqtt", {"plant": rig.memory})
    broker = rig.broker()
    running = rig.run(settings(broker.url), memory_access)
    running.wait_until_connected()
    probe = rig.probe(broker)
    probe.subscribe("answers")

    probe.publish("plant/ingest", "fault", ResponseTopic="answers")
    assert json.loads(probe.get().payload)["reason"] == "internal_error"
    probe.publish("plant/ingest", text(command([1])))
    wire.until(lambda: handled(memory_access) == 2, "both messages")

    assert rig.registers(0, 1) == [1]
    assert running.status()["reconnects"] == 0
    assert "mqtt_message_failed" in [record.getMessage() for record in caplog.records]

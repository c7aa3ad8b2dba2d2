"""What the scanner tells other services: logs, heartbeats, variables, and other scanners."""

from __future__ import annotations

import json
import logging
import threading
import time
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast.events import log_lines
from holdfast.net.nats.connection import Ping
from holdfast.scanner import presence
from holdfast.scanner.jetstream import heartbeat_key
from support import wire
from support.brokers import NatsServer
from support.fake_device import FakeDevice, exception, registers
from support.nats_bus import Caller, logged, subscription, tag
from support.scanner_parts import presence_of
from support.tentacle import plc_subscribe, plc_tag

if TYPE_CHECKING:
    from support.nats_bus import Inbox, Run


# Logs.


def entry(inbox: Inbox, event: str) -> Any:
    return inbox.until(lambda each: each["message"].startswith(event), f"{event} is published")


def test_the_log_is_published_as_tentacle_services_do(
    run_scanner: Run, caller: Caller, server: holdfast.Server, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "holdfast")
    inbox = caller.listen("service.logs.modbus.modbus")
    run_scanner()
    caller.request("modbus.subscribe", subscription(server, tag("a", 0)))
    found = entry(inbox, "subscribed")
    assert abs(found.pop("timestamp") - time.time() * 1000) < 3_600_000
    assert found == {
        "level": "info",
        "message": "subscribed device=plc1 subscriber=hmi tags=1 scan_rate=50",
        "serviceType": "modbus",
        "moduleId": "modbus",
        "logger": "modbus:scanner",
    }
    caller.request("modbus.subscribe", "nonsense")
    assert entry(inbox, "request_refused")["level"] == "warn"


def test_only_the_scanner_s_own_log_is_published(
    run_scanner: Run, caller: Caller, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "holdfast")
    inbox = caller.listen("service.logs.>")
    run_scanner()
    other = threading.Thread(target=log_lines.write, args=(logging.WARNING, "of_another_service"))
    other.start()
    other.join()
    caller.request("modbus.subscribe", "nonsense")
    entry(inbox, "request_refused")
    assert "of_another_service" not in json.dumps(inbox.take())
    assert logged(caplog, "of_another_service") == [{}]


def test_the_log_is_not_published_if_that_is_switched_off(
    run_scanner: Run, caller: Caller, server: holdfast.Server, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "holdfast")
    inbox = caller.listen("service.logs.>")
    data = caller.listen("modbus.data.plc1")
    run_scanner(publish_logs=False)
    caller.request("modbus.subscribe", subscription(server, tag("a", 0)))
    data.next()
    assert inbox.take() == []
    assert logged(caplog, "subscribed")


def test_a_log_that_may_not_be_published_causes_no_flood(
    run_scanner: Run, tmp_path: Any, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "holdfast")
    file = tmp_path / "nats.conf"
    file.write_text(
        "authorization { users: [{user: a, password: b, "
        'permissions: {publish: {deny: "service.>"}}}] }'
    )
    server = NatsServer(tmp_path, "-c", str(file))
    try:
        from holdfast.net.nats.connection import Servers

        url = server.url.replace("nats://", "nats://a:b@")
        scanner = run_scanner(servers=Servers((url,)))
        with Caller(url) as caller:
            wire.until(lambda: logged(caplog, "nats_error"), "it is logged")
            for _ in range(30):
                assert not caller.request("modbus.subscribe", "nonsense")["success"]
        scanner.stop()
        # At most one for each record before the first error arrived.
        assert len(logged(caplog, "nats_error")) < 10
    finally:
        server.kill()


# Heartbeats and other scanners.


def beat(caller: Caller) -> Any:
    return caller.kept("service_heartbeats").get("modbus")


def test_the_heartbeat_counts_devices_and_tags(
    run_scanner: Run, caller: Caller, server: holdfast.Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(presence, "HEARTBEAT_INTERVAL_S", 0.05)
    run_scanner()
    for id in ("one", "two"):
        request = subscription(server, tag("a", 0), tag("b", 1), deviceId=id)
        caller.request("modbus.subscribe", request)
    expected = {"deviceCount": 2, "tagCount": 4, "version": holdfast.__version__}
    wire.until(lambda: beat(caller)["metadata"] == expected, "the heartbeat has the counts")


def test_a_second_scanner_is_logged_by_both_and_shown(
    run_scanner: Run, caller: Caller, caplog: pytest.LogCaptureFixture
) -> None:
    first = run_scanner()
    assert "otherScanners" not in caller.request("modbus.browse", b"")["service"]
    second = run_scanner()
    wire.until(lambda: len(logged(caplog, "another_scanner")) == 2, "both say so")
    started = {presence_of(each.scanner).heartbeat.started for each in (first, second)}
    shown = caller.request("modbus.browse", b"")["service"]
    assert {shown["startedAt"], *(each["startedAt"] for each in shown["otherScanners"])} == started
    run_scanner(prefix="plant")
    assert "otherScanners" not in caller.request("plant.browse", b"")["service"]


def test_announcements_without_end_are_neither_logged_nor_answered(
    caplog: pytest.LogCaptureFixture,
) -> None:
    others = presence.OtherScanners(started=0)
    found = [others.saw(started) for started in range(1, 1000)]
    assert found == [True] * presence.MAX_SCANNERS + [False] * (999 - presence.MAX_SCANNERS)
    assert len(others.current()) == presence.MAX_SCANNERS
    assert len(logged(caplog, "another_scanner")) < presence.MAX_SCANNERS


def test_another_service_is_noticed_by_its_heartbeat(
    run_scanner: Run,
    caller: Caller,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(presence, "HEARTBEAT_INTERVAL_S", 0.05)
    run_scanner()
    wire.until(lambda: beat(caller), "there is a heartbeat")
    started = beat(caller)["startedAt"]

    async def beat_too() -> None:
        bucket = await caller.client.jetstream().key_value(heartbeat_key.BUCKET)
        other = {"serviceType": "modbus", "moduleId": "modbus", "lastSeen": 5, "startedAt": 7}
        await bucket.put("modbus", json.dumps({**other, "metadata": {}}).encode())

    def is_noticed() -> bool:
        # As often as a service does: one that comes between a look and a heartbeat is written over.
        caller.do(beat_too())
        return bool(logged(caplog, "another_scanner"))

    wire.until(is_noticed, "it is noticed")
    [record] = logged(caplog, "another_scanner")
    assert record["started"] == "1970-01-01T00:00:00.007Z"
    [shown] = caller.request("modbus.browse", b"")["service"]["otherScanners"]
    assert shown == {"startedAt": 7}
    wire.until(lambda: beat(caller)["startedAt"] == started, "its own heartbeat is back")


@pytest.mark.usefixtures("scanner")
@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"7",
        b"{}",
        b'{"startedAt": "x"}',
        b'{"startedAt": -1}',
        b'{"startedAt": %b}' % (400 * b"9"),
        b"\xff",
        b'{"startedAt":1,"fleet":"\xff"}',
        b"[" * 5000,
    ],
)
def test_a_malformed_announcement_is_ignored(caller: Caller, text: bytes) -> None:
    caller.publish("modbus.scanner", text)
    assert "otherScanners" not in caller.request("modbus.browse", b"")["service"]


def test_a_frozen_server_is_found(
    run_scanner: Run, own_nats: NatsServer, caplog: pytest.LogCaptureFixture
) -> None:
    assert Ping().interval * (Ping().outstanding + 1) < 5
    scanner = run_scanner(own_nats, ping=Ping(interval=0.1, outstanding=2))
    own_nats.freeze()
    try:
        wire.until(lambda: not scanner.serves, "it is found")
        wire.until(lambda: logged(caplog, "nats_disconnected"), "it is logged")
    finally:
        own_nats.thaw()
    wire.until(lambda: scanner.serves, "it is connected again")


# Variables.


def variables(caller: Caller, request: object = b"") -> dict[tuple[str, str], Any]:
    found = caller.request("modbus.variables", request)
    return {(each["deviceId"], each["variableId"]): each for each in found}


@pytest.mark.usefixtures("scanner")
def test_a_late_joiner_gets_the_last_value_of_every_tag(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    assert caller.request("modbus.variables", b"") == []
    memory.write("holding_registers", 0, [7, 0x7FC0, 0])
    memory.write("coils", 3, [1])
    tags = [
        plc_tag("word", 0),
        plc_tag("nan", 1, "float32"),
        plc_tag("coil", 3, "boolean", function="coil"),
        plc_tag("absent", 5000),
    ]
    caller.request("modbus.subscribe", plc_subscribe(server, *tags, device="Pump 1"))
    other = subscription(server, tag("x", 0, description="level"), deviceId="b")
    caller.request("modbus.subscribe", other)
    wire.until(
        lambda: (
            {each["quality"] for each in variables(caller).values()} == {"good", "uncertain"}
            and variables(caller)["b", "x"]["quality"] == "good"
        ),
        "all are read",
    )
    found = variables(caller)
    stamps = [each.pop("lastUpdated", None) for each in found.values()]
    assert [stamp is not None for stamp in stamps] == [True, True, True, False, True]
    assert found["Pump 1", "word"] == {
        "moduleId": "modbus",
        "deviceId": "Pump 1",
        "variableId": "word",
        "value": 7,
        "datatype": "number",
        "quality": "good",
        "origin": "modbus",
    }
    assert found["Pump 1", "nan"]["value"] is None
    assert found["Pump 1", "coil"]["value"] is True
    assert (found["Pump 1", "absent"]["value"], found["Pump 1", "absent"]["quality"]) == (
        None,
        "uncertain",
    )
    assert found["b", "x"]["description"] == "level"
    assert set(variables(caller, {"deviceId": "b"})) == {("b", "x")}
    assert list(variables(caller, {"offset": 3})) == list(found)[3:]
    assert caller.request("modbus.variables", {"offset": 9}) == []
    assert caller.request("modbus.variables", {"deviceId": "c"}) == []
    assert "offset" in caller.request("modbus.variables", {"offset": -1})["error"]


@pytest.mark.usefixtures("scanner")
def test_the_last_value_stays_while_the_device_fails(
    caller: Caller, server: holdfast.Server
) -> None:
    answers = {"good": True}

    def answer(pdu: bytes) -> bytes:
        return registers(pdu, 7) if answers["good"] else exception(pdu, 2)

    with FakeDevice(answer) as fake:
        place = {"host": None, "port": None, "url": fake.url}
        request = subscription(server, tag("a", 7)) | place
        assert caller.request("modbus.subscribe", request)["success"]
        wire.until(lambda: variables(caller)["plc1", "a"]["quality"] == "good", "there is a value")
        answers["good"] = False
        wire.until(
            lambda: variables(caller)["plc1", "a"]["quality"] == "bad", "the device refuses it"
        )
        assert variables(caller)["plc1", "a"]["value"] == 7


def test_a_variable_that_is_larger_than_an_answer_does_not_hide_the_next(
    run_scanner: Run, small_nats: NatsServer, server: holdfast.Server
) -> None:
    scanner = run_scanner(small_nats)
    with Caller(small_nats.url) as caller:
        large = {**tag("bits", 0, "boolean[900]"), "functionCode": "coil"}
        request = subscription(server, tag("a", 0), large, tag("b", 1))
        assert caller.request("modbus.subscribe", request)["success"]

        def paged() -> list[Any]:
            found: list[Any] = []
            while more := caller.request("modbus.variables", {"offset": len(found)}):
                found += more
            return found

        read = [("a", "good"), ("bits", "bad"), ("b", "good")]
        wire.until(
            lambda: [(each["variableId"], each["quality"]) for each in paged()] == read,
            "all are read",
        )
        found = paged()[1]
        assert found["value"] is None
        assert found["error"].startswith("too large: found ")
        scanner.stop()


def test_the_answer_has_as_many_variables_as_fit(
    run_scanner: Run, caller: Caller, server: holdfast.Server
) -> None:
    run_scanner()
    tags = [tag(f"{'x' * 200}{number:04}", number % 900) for number in range(5000)]
    for start in range(0, 5000, 2500):
        request = subscription(server, *tags[start : start + 2500], scanRate=60_000)
        assert caller.request("modbus.subscribe", request)["success"]
    seen: list[str] = []
    while True:
        found = caller.request("modbus.variables", {"offset": len(seen)})
        if not found:
            break
        seen += [each["variableId"] for each in found]
    assert seen == [each["id"] for each in tags]

"""What the scanner does when devices, NATS or JetStream fail, and how it ends."""

from __future__ import annotations

import itertools
import json
import logging
import os
import signal
import socket
import time
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast.events import log_lines
from holdfast.events.throttle import Throttle
from holdfast.net.nats.connection import MAX_PAUSE_S
from holdfast.scanner.jetstream.availability import State
from holdfast.scanner.subscriptions import device as devices
from support import wire
from support.brokers import NatsServer
from support.fake_device import HANG_UP, FakeDevice, exception, registers
from support.nats_bus import Caller, leaving, logged, subscription, tag
from support.scanner_parts import broker_of, client_of, presence_of, registry_of

if TYPE_CHECKING:
    from pathlib import Path

    from support.nats_bus import Run
    from support.running import Process, Serve


def events(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.name == "holdfast"]


# NATS


def test_a_value_that_is_larger_than_a_message_costs_no_other(
    run_scanner: Run,
    small_nats: NatsServer,
    server: holdfast.Server,
    caplog: pytest.LogCaptureFixture,
) -> None:
    scanner = run_scanner(small_nats)
    with Caller(small_nats.url) as caller:
        data = caller.listen("modbus.data.plc1")
        large = {**tag("bits", 0, "boolean[900]"), "functionCode": "coil"}
        request = subscription(server, tag("a", 0), large, tag("b", 900))
        assert caller.request("modbus.subscribe", request)["success"]
        assert {data.next()["variableId"] for _ in range(10)} == {"a", "b"}
        [found] = logged(caplog, "message_too_large")
        assert (found["subject"], found["tag"]) == ("modbus.data.plc1", "bits")
        assert client_of(scanner.scanner).stats["reconnects"] == 0
        scanner.stop()


def test_nats_comes_back_and_everything_goes_on_with_the_newest_values(
    run_scanner: Run,
    own_nats: NatsServer,
    own_caller: Caller,
    server: holdfast.Server,
    memory: holdfast.Memory,
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "holdfast")
    scanner = run_scanner(own_nats)
    data = own_caller.listen("modbus.data.plc1")
    tags = [tag("a", 0), tag("b", 1)]
    own_caller.request("modbus.subscribe", subscription(server, *tags))
    data.next()

    own_nats.kill()
    wire.until(lambda: "nats_disconnected" in events(caplog), "the scanner noticed")
    data.take()
    outbox = scanner.scanner.outbox
    memory.write("holding_registers", 0, [1, 1])
    replaced = outbox.replaced
    wire.until(lambda: outbox.replaced > replaced + 8, "scans go on")
    memory.write("holding_registers", 0, [2, 3])
    replaced = outbox.replaced
    wire.until(lambda: outbox.replaced > replaced + 8, "scans go on")
    assert outbox.dropped == 0

    own_nats.start()
    found: dict[str, list[int]] = {"a": [], "b": []}
    while not (found["a"] and found["b"]):
        message = data.next()
        found[message["variableId"]].append(message["value"])
    assert {id: set(values) for id, values in found.items()} == {"a": {2}, "b": {3}}
    wire.until(lambda: events(caplog).count("nats_connected") == 2, "it is logged")
    assert "nats_connect_failed" in events(caplog)
    assert own_caller.request("modbus.unsubscribe", leaving("a", "b"))["success"]


def test_a_client_that_nats_throws_out_is_replaced(
    run_scanner: Run,
    own_nats: NatsServer,
    own_caller: Caller,
    server: holdfast.Server,
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "holdfast")
    scanner = run_scanner(own_nats)
    data = own_caller.listen("modbus.data.plc1")
    own_caller.request("modbus.subscribe", subscription(server, tag("a", 0)))
    data.next()
    # A text that is no command: the server says so and closes, and nats-py gives up for good.
    scanner.do(_nonsense(scanner.scanner))
    wire.until(lambda: events(caplog).count("nats_connected") == 2, "there is another client")
    [lost] = logged(caplog, "nats_disconnected")
    assert lost["reason"] == "the server ended the connection: Unknown Protocol Operation"
    data.take()
    assert data.next()["value"] == 0
    wire.until(lambda: scanner.serves, "requests reach it")
    assert own_caller.request("modbus.browse", b"")["count"] == 1


async def _nonsense(scanner: Any) -> None:
    client = client_of(scanner)
    await client._send_command(b"NONSENSE\r\n")
    await client._flush_pending()


def test_a_scanner_waits_for_nats(
    run_scanner: Run, tmp_path: Path, server: holdfast.Server, caplog: pytest.LogCaptureFixture
) -> None:
    own_nats = NatsServer(tmp_path)
    own_nats.kill()
    scanner = run_scanner(own_nats, wait=False)
    wire.until(lambda: "nats_connect_failed" in events(caplog), "it is logged")
    own_nats.start()
    try:
        wire.until(lambda: scanner.serves, "it is connected")
        with Caller(own_nats.url) as caller:
            data = caller.listen("modbus.data.plc1")
            caller.request("modbus.subscribe", subscription(server, tag("a", 0)))
            data.next()
    finally:
        scanner.stop()
        own_nats.kill()


def test_nats_that_hangs_holds_up_nothing(
    run_scanner: Run,
    own_nats: NatsServer,
    own_caller: Caller,
    server: holdfast.Server,
    memory: holdfast.Memory,
) -> None:
    scanner = run_scanner(own_nats)
    data = own_caller.listen("modbus.data.plc1")
    tags = [tag(f"t{address}", address) for address in range(900)]
    own_caller.request("modbus.subscribe", subscription(server, *tags))
    data.next()
    own_nats.freeze()
    try:
        outbox = scanner.scanner.outbox
        wire.until(lambda: outbox.replaced > 1000, "the newest values are kept", 30)
        memory.write("holding_registers", 0, [7] * 900)
        replaced = outbox.replaced
        wire.until(lambda: outbox.replaced > replaced + 800, "scans go on")
    finally:
        own_nats.thaw()
    data.until(lambda message: message["value"] == 7, "the newest values")


def test_what_nats_took_before_it_died_is_published_anew(
    run_scanner: Run,
    own_nats: NatsServer,
    own_caller: Caller,
    server: holdfast.Server,
    memory: holdfast.Memory,
) -> None:
    scanner = run_scanner(own_nats)
    data = own_caller.listen("modbus.data.plc1")
    status = own_caller.listen("modbus.status.plc1")
    changes = subscription(server, tag("a", 0), tag("b", 1), publish="change")
    seldom = subscription(server, tag("c", 2), subscriberId="x", scanRate=3_600_000)
    for request in (changes, seldom):
        assert own_caller.request("modbus.subscribe", request)["success"]
    assert {data.next()["variableId"] for _ in range(3)} == {"a", "b", "c"}
    status.until(lambda message: message["state"] == "online", "it is online")

    own_nats.freeze()
    memory.write("holding_registers", 0, [7])
    device = registry_of(scanner.scanner).devices["plc1"]
    seen = device.health.scans + 3
    wire.until(lambda: device.health.scans > seen, "the change was handed to NATS")

    async def restart() -> None:
        # In the scanner's event loop: it can't connect before the caller, who would miss something.
        own_nats.kill()
        wire.until(lambda: not own_caller.client.is_connected, "the caller has noticed")
        own_nats.start()
        wire.until(lambda: own_caller.client.is_connected, "the caller is back")
        own_caller.publish("behind.its.subscriptions")

    scanner.do(restart())
    found: dict[str, int] = {}
    while len(found) < 3:
        message = data.next()
        found[message["variableId"]] = message["value"]
    assert found == {"a": 7, "b": 0, "c": 0}
    assert status.next()["state"] == "online"


def test_nats_that_was_away_for_long_is_tried_every_other_second(run_scanner: Run) -> None:
    broker = broker_of(run_scanner(max_pause_s=MAX_PAUSE_S).scanner)
    client = broker.client
    assert client is not None
    broker._note_lost("tested")
    pauses = set()
    for _ in range(50):
        broker._note(client, OSError("no route"))
        pauses.add(client.options["reconnect_time_wait"])
    assert max(pauses) <= MAX_PAUSE_S
    assert len({pause for pause in pauses if pause >= 0.75 * MAX_PAUSE_S}) > 40, "with jitter"
    broker._note_connected(client)


# Devices


def test_a_device_that_dies_and_comes_back_is_told_of(
    run_scanner: Run, caller: Caller, serve: Serve, memory: holdfast.Memory
) -> None:
    run_scanner()
    memory.write("holding_registers", 0, [1])
    server = serve({1: memory})
    host, port = server.address
    status = caller.listen("modbus.status.plc1")
    data = caller.listen("modbus.data.plc1")
    caller.request("modbus.subscribe", subscription(server, tag("a", 0)))
    assert data.next()["value"] == 1
    first, second = status.next(), status.next()
    assert first.pop("timestamp") <= second.pop("timestamp")
    assert first == {"deviceId": "plc1", "state": "connecting", "failures": 0}
    assert second == {"deviceId": "plc1", "state": "online", "failures": 0}

    server.stop()
    lost = status.next()
    assert lost.pop("timestamp")
    assert lost.pop("error") in ("the connection was lost", "no connection")
    assert lost == {"deviceId": "plc1", "state": "offline", "failures": 1}
    data.take()
    memory.write("holding_registers", 0, [2])
    serve({1: memory}, bind=f"{host}:{port}")
    assert status.next()["state"] == "online"
    assert data.next()["value"] == 2
    assert status.take() == []


def test_a_device_that_is_not_there_costs_the_others_nothing(
    run_scanner: Run, caller: Caller, server: holdfast.Server
) -> None:
    run_scanner()
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    status = caller.listen("modbus.status.dead")
    dead = subscription(server, tag("a", 0), deviceId="dead", port=port)
    data = caller.listen("modbus.data.plc1")
    caller.request("modbus.subscribe", subscription(server, tag("a", 0)))
    caller.request("modbus.subscribe", dead)
    assert status.next()["state"] == "connecting"
    # A new connection to the broker publishes the state again.
    state = status.until(lambda state: state["state"] != "connecting", "a result")
    assert state["state"] == "offline"
    # The other is polled at its rate between any two attempts to connect to the dead one.
    for _ in range(25):
        assert data.next()["value"] is not None
    assert status.take() == []
    caller.request("modbus.unsubscribe", leaving("a", deviceId="dead"))


def test_a_device_that_is_silent_is_offline_until_it_answers(
    run_scanner: Run, caller: Caller, server_process: Process
) -> None:
    run_scanner()
    plc = server_process()
    host, port = plc.address
    status, data = caller.listen("modbus.status.plc1"), caller.listen("modbus.data.plc1")
    request = {
        "deviceId": "plc1",
        "subscriberId": "x",
        "host": host,
        "port": port,
        "timeout": 100,
        "scanRate": 100,
        "tags": [tag("a", 0)],
    }
    caller.request("modbus.subscribe", request)
    data.next()
    os.kill(plc.pid, signal.SIGSTOP)
    status.until(lambda message: message["state"] == "offline", "it is offline")
    data.take()
    os.kill(plc.pid, signal.SIGCONT)
    status.until(lambda message: message["state"] == "online", "it is online again")
    data.next()
    caller.request("modbus.unsubscribe", leaving("a", subscriberId="x"))


def test_a_device_that_comes_and_goes_does_not_fill_the_log(
    run_scanner: Run,
    caller: Caller,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(log_lines, "_REFUSALS", Throttle(burst=2, window=3600))
    caplog.set_level(logging.INFO, "holdfast")
    run_scanner()
    answers = itertools.cycle((registers, lambda pdu: exception(pdu, 4)))
    with FakeDevice(lambda pdu: next(answers)(pdu)) as plc:
        request = {"deviceId": "plc1", "subscriberId": "x", "url": plc.url, "scanRate": 50}
        status = caller.listen("modbus.status.plc1")
        caller.request("modbus.subscribe", request | {"tags": [tag("a", 0)]})
        for _ in range(10):
            status.next()
        caller.request("modbus.unsubscribe", leaving("a", subscriberId="x"))
    assert events(caplog).count("device_online") == 2


def test_requests_without_end_do_not_fill_the_log(
    run_scanner: Run,
    caller: Caller,
    server: holdfast.Server,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(log_lines, "_REQUESTS", Throttle(burst=2, window=3600))
    caplog.set_level(logging.INFO, "holdfast")
    run_scanner()
    tags = [tag(id, 0, byteOrder="BADC", writable=True) for id in "abcd"]
    for _ in range(5):
        assert caller.request("modbus.subscribe", subscription(server, *tags))["success"]
        assert caller.request("modbus.unsubscribe", leaving(tagIds="all"))["success"]
    log_lines.tell_held_back(all_of_them=True)
    logged = ("subscribed", "unsubscribed", "byte_order_differs")
    assert [events(caplog).count(event) for event in logged] == [2, 2, 2]
    told = [vars(each)["fields"] for each in caplog.records if each.message == "held_back"]
    assert {(each["of"], each["count"]) for each in told} == {
        ("subscribed", 3),
        ("unsubscribed", 3),
        ("byte_order_differs", 3),
    }


def test_an_adjustment_that_was_held_back_is_logged_with_a_later_request(
    run_scanner: Run,
    caller: Caller,
    server: holdfast.Server,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run_scanner()
    for _ in range(2):
        monkeypatch.setattr(log_lines, "_REQUESTS", Throttle(burst=1, window=3600))
        for name in ("a", "b", "c"):
            request = subscription(server, tag("a", 0), subscriberId=name, scanRate=1)
            assert caller.request("modbus.subscribe", request)["success"]
    found = [vars(each)["fields"] for each in caplog.records if each.message == "scan_rate_raised"]
    assert [each["subscriber"] for each in found] == ["a", "b"]


def test_requests_that_end_nothing_do_not_hide_the_end_of_a_subscription(
    run_scanner: Run,
    caller: Caller,
    server: holdfast.Server,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(log_lines, "_REQUESTS", Throttle(burst=2, window=3600))
    caplog.set_level(logging.INFO, "holdfast")
    run_scanner()
    assert caller.request("modbus.subscribe", subscription(server, tag("a", 0)))["success"]
    for _ in range(5):
        assert caller.request("modbus.unsubscribe", leaving("b"))["success"]
        assert caller.request("modbus.unsubscribe", leaving(deviceId="x", tagIds="all"))["success"]
    assert caller.request("modbus.unsubscribe", leaving(tagIds="all"))["success"]
    found = [vars(each)["fields"] for each in caplog.records if each.message == "unsubscribed"]
    assert (found[-1]["device"], found[-1]["tags"]) == ("plc1", "all")


def test_a_bad_address_in_the_middle_of_a_block_costs_its_own_tag_only(
    run_scanner: Run, caller: Caller
) -> None:
    run_scanner()

    def answer(pdu: bytes) -> bytes:
        start, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        if start <= 17 < start + count:
            return exception(pdu, 2)
        return registers(pdu, start)

    with FakeDevice(answer) as plc:
        tags = [tag(f"t{address}", address) for address in range(40)]
        request = {"deviceId": "plc1", "subscriberId": "x", "url": plc.url, "scanRate": 50}
        data, status = caller.listen("modbus.data.plc1"), caller.listen("modbus.status.plc1")
        caller.request("modbus.subscribe", request | {"tags": tags})
        found: set[str] = set()
        while len(found) < 39:
            found.add(data.next()["variableId"])
        assert found == {f"t{address}" for address in range(40)} - {"t17"}
        online = status.until(lambda message: message["state"] == "online", "it is online")
        assert online["error"] == "exception 02 (Illegal Data Address)"
        data.take()
        # The plan that works is kept: a scan is a few requests, not a search.
        data.until(lambda message: message["variableId"] == "t39", "the end of a scan")
        [device] = caller.request("modbus.browse", b"")["devices"]
        assert len(device["blocks"]) <= 12
        errors = {each["id"]: each["error"] for each in device["tags"] if "error" in each}
        assert errors == {"t17": "exception 02 (Illegal Data Address)"}
        caller.request(
            "modbus.unsubscribe", leaving(*(each["id"] for each in tags), subscriberId="x")
        )


@pytest.mark.parametrize("after", [0, 1])
def test_a_device_that_hangs_up_is_asked_again(
    run_scanner: Run, caller: Caller, after: int
) -> None:
    run_scanner()
    asked = 0

    def answer(pdu: bytes) -> bytes:
        nonlocal asked
        asked += 1
        return HANG_UP if asked % 4 == after else registers(pdu, 9)

    with FakeDevice(answer) as plc:
        request = {"deviceId": "plc1", "subscriberId": "x", "url": plc.url, "scanRate": 50}
        data = caller.listen("modbus.data.plc1")
        caller.request("modbus.subscribe", request | {"tags": [tag("a", 0)]})
        assert [data.next()["value"] for _ in range(10)] == [9] * 10
        caller.request("modbus.unsubscribe", leaving("a", subscriberId="x"))


def test_a_name_is_looked_up_again_when_the_device_does_not_answer(
    run_scanner: Run, caller: Caller, server: holdfast.Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(devices, "LOOKUP_INTERVAL_S", 0.0)
    port = server.address[1]
    known = [(socket.AF_INET, 1, 6, "", (host, port)) for host in ("127.0.0.2", "127.0.0.1")]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: known)
    run_scanner()
    data = caller.listen("modbus.data.plc1")
    request = subscription(server, tag("a", 0), host="plc.test")
    assert caller.request("modbus.subscribe", request)["success"]
    data.next()
    [device] = caller.request("modbus.browse", b"")["devices"]
    assert device["address"] == f"tcp://127.0.0.1:{port}"


# Heartbeat


def test_the_heartbeat_is_in_its_bucket_and_gone_after_the_end(
    run_scanner: Run, own_nats: NatsServer, own_caller: Caller
) -> None:
    scanner = run_scanner(own_nats)

    async def entry() -> Any:
        bucket = await own_caller.client.jetstream().key_value("service_heartbeats")
        status = await bucket.status()
        assert (status.ttl, status.history) == (60.0, 1)
        try:
            return json.loads((await bucket.get("modbus")).value or b"null")
        except Exception as error:  # There is no such key, or no longer.
            return type(error).__name__

    def beats() -> bool:
        try:
            return isinstance(own_caller.do(entry()), dict)
        except Exception:  # The bucket is not there yet.
            return False

    wire.until(beats, "there is a heartbeat")
    found = own_caller.do(entry())
    assert found.pop("startedAt") <= found.pop("lastSeen") <= time.time() * 1000
    metadata = {"deviceCount": 0, "tagCount": 0, "version": holdfast.__version__}
    assert found == {"serviceType": "modbus", "moduleId": "modbus", "metadata": metadata}
    scanner.stop()
    assert own_caller.do(entry()) == "KeyNotFoundError"


def test_without_jetstream_it_says_so_once_and_goes_on(
    run_scanner: Run, tmp_path: Path, server: holdfast.Server, caplog: pytest.LogCaptureFixture
) -> None:
    bare = NatsServer(tmp_path, jetstream=False)
    try:
        scanner = run_scanner(bare)
        wire.until(lambda: "no_heartbeat" in events(caplog), "it is logged")
        with Caller(bare.url) as caller:
            data = caller.listen("modbus.data.plc1")
            caller.request("modbus.subscribe", subscription(server, tag("a", 0)))
            data.next()
            for _ in range(3):
                scanner.do(
                    presence_of(scanner.scanner).heartbeat.beat(broker_of(scanner.scanner).client)
                )
        [record] = [each for each in caplog.records if each.getMessage() == "no_heartbeat"]
        reason = "JetStream is not enabled on the server or for this account"
        assert record.__dict__["fields"]["reason"] == reason
        [record] = [each for each in caplog.records if "_not_kept" in each.getMessage()]
        assert record.__dict__["fields"] == {"bucket": "holdfast_scanner", "reason": reason}
        scanner.stop()
    finally:
        bare.kill()


def test_a_bucket_in_which_heartbeats_stay_for_ever_is_told_of_once(
    run_scanner: Run, own_nats: NatsServer, own_caller: Caller, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "holdfast")
    own_caller.do(_bucket_without_end(own_caller))
    scanner = run_scanner(own_nats)
    wire.until(lambda: "heartbeat" in events(caplog), "there is a heartbeat")
    heart, broker = presence_of(scanner.scanner).heartbeat, broker_of(scanner.scanner)
    heart._availability.state = State.UNKNOWN
    scanner.do(heart.beat(broker.client))
    [record] = [each for each in caplog.records if each.getMessage() == "heartbeat_has_no_end"]
    assert record.__dict__["fields"]["bucket"] == "service_heartbeats"
    assert "delete the bucket" in record.__dict__["fields"]["todo"]


async def _bucket_without_end(caller: Caller) -> None:
    await caller.client.jetstream().create_key_value(bucket="service_heartbeats")


# The end


def test_a_message_ends_it(run_scanner: Run, caller: Caller, server: holdfast.Server) -> None:
    scanner = run_scanner()
    data = caller.listen("modbus.data.plc1")
    caller.request("modbus.subscribe", subscription(server, tag("a", 0)))
    data.next()
    caller.publish("modbus.shutdown")
    scanner.ended.result(wire.DEADLINE)
    counters = server.counters()
    assert "connections" in counters
    wire.until(lambda: _open(server) == 0, "all connections are closed")


def _open(server: holdfast.Server) -> int:
    counters = server.counters()
    assert "connections" in counters
    return counters["connections"]["open"]


def test_it_ends_while_everything_hangs(
    run_scanner: Run, own_nats: NatsServer, own_caller: Caller, server_process: Process
) -> None:
    scanner = run_scanner(own_nats)
    plc = server_process()
    host, port = plc.address
    data = own_caller.listen("modbus.data.tcp")
    for id, transport in (("tcp", "tcp"), ("rtu", "rtu+tcp")):
        request = {
            "deviceId": id,
            "subscriberId": "x",
            "host": host,
            "port": port,
            "transport": transport,
            "timeout": 3000,
            "scanRate": 50,
            "tags": [tag(f"{id}-{address}", address, writable=True) for address in range(900)],
        }
        own_caller.request("modbus.subscribe", request)
    data.next()
    try:
        os.kill(plc.pid, signal.SIGSTOP)
        os.waitid(os.P_PID, plc.pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)
        own_caller.publish("modbus.command.tcp-1", "1")
        own_caller.publish("modbus.command.rtu-1", "1")
        own_nats.freeze()
        began = time.monotonic()
        scanner.stop()
        assert time.monotonic() - began < wire.DEADLINE
    finally:
        own_nats.thaw()
        os.kill(plc.pid, signal.SIGCONT)


# Messages that are none


def _raw(server: NatsServer, lines: bytes) -> None:
    """Sends bytes as they are, and returns when the server has dealt with them."""
    with socket.create_connection(("127.0.0.1", server.port), wire.DEADLINE) as raw:
        options = {"verbose": False, "pedantic": False, "headers": True, "protocol": 1}
        raw.sendall(b"CONNECT %b\r\n%bPING\r\n" % (json.dumps(options).encode(), lines))
        seen = b""
        while b"PONG\r\n" not in seen:
            part = raw.recv(4096)
            assert part, seen
            seen += part
        assert b"-ERR" not in seen, seen


@pytest.mark.parametrize(
    "lines",
    [
        b"PUB modbus.command.\xff\xfe 1\r\n1\r\n",
        b"PUB modbus.browse _I.\xff 0\r\n\r\n",
        b"PUB modbus.command.\x0b 1\r\n1\r\n",
        b"PUB modbus.command.a\x0bb\x0cc 1\r\n1\r\n",
        b"PUB modbus.command.%b a\x0bb 1\r\n1\r\n" % (b"x\x0b" * 1500),
        *(
            b"HPUB modbus.browse _I.h %d %d\r\n%b\r\n" % (len(header), len(header), header)
            for header in (
                b"garbage",
                b"NATS/1.0\r\n\r\n",
                b"NATS/1.0 \xff\xff\xff\r\n\r\n",
                b"NATS/1.0 503 \xff\xff\r\n\r\n",
                b"NATS/1.0\r\n\xff: \xfe\r\n\r\n",
            )
        ),
    ],
)
def test_a_message_that_is_none_costs_no_other(
    run_scanner: Run, own_nats: NatsServer, own_caller: Caller, lines: bytes
) -> None:
    scanner = run_scanner(own_nats)
    client = client_of(scanner.scanner)
    _raw(own_nats, 3 * lines)
    assert own_caller.request("modbus.browse", b"")["success"]
    _raw(own_nats, lines)
    assert own_caller.request("modbus.browse", b"")["success"]
    assert client_of(scanner.scanner) is client
    assert client is not None
    assert client.stats["reconnects"] == 0


def test_a_message_that_is_none_is_told_of_now_and_then(
    run_scanner: Run, own_nats: NatsServer, own_caller: Caller, caplog: pytest.LogCaptureFixture
) -> None:
    run_scanner(own_nats)
    _raw(own_nats, 200 * b"PUB modbus.command.\xff 1\r\n1\r\n")
    assert own_caller.request("modbus.browse", b"")["success"]
    assert 1 <= events(caplog).count("message_malformed") <= 40
    [record, *_] = [each for each in caplog.records if each.getMessage() == "message_malformed"]
    assert record.__dict__["fields"] == {
        "subject": "modbus.command.\\xff",
        "reason": "invalid UTF-8 in the subject, the reply subject or a header",
    }


def test_what_a_device_is_asked_for_is_told_though_it_is_not_there(
    run_scanner: Run, caller: Caller
) -> None:
    run_scanner()
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    status = caller.listen("modbus.status.plc1")
    tags = [tag("a", 0), tag("b", 100), tag("c", 200)]
    request = {"deviceId": "plc1", "subscriberId": "x", "host": "127.0.0.1", "port": port}
    assert caller.request("modbus.subscribe", request | {"tags": tags})["success"]
    status.until(lambda message: message["state"] == "offline", "it is offline")
    [device] = caller.request("modbus.browse", b"")["devices"]
    assert sorted(block["address"] for block in device["blocks"]) == [0, 100, 200]
    assert [each["error"] for each in device["blocks"] if "error" in each] == ["no connection"]
    assert device["lastError"] == device["error"] == "no connection"
    assert device["lastErrorAt"] >= device["stateSince"] > 1_700_000_000_000

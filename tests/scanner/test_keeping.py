"""What the scanner keeps in JetStream, and what a restarted scanner makes of it."""

from __future__ import annotations

import asyncio
import json
import logging
import shutil
import threading
from concurrent.futures import Future
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import msgspec
import pytest
from nats.js import JetStreamContext
from nats.js.kv import KeyValue

from holdfast.scanner.errors import Refused
from holdfast.scanner.jetstream import changes_before_read, entries, restore, store
from holdfast.scanner.jetstream.restore import StoredSubscriptions
from holdfast.scanner.jetstream.store import BUCKET
from holdfast.scanner.messages.types import SubscribeRequest, TagRequest
from holdfast.scanner.publish.publishers import Publishers
from holdfast.scanner.subscriptions.key import SubscriptionKey
from holdfast.scanner.subscriptions.registry import Registry
from holdfast.scanner.subscriptions.request_rules import Rules, ScannerLimits
from support import wire
from support.brokers import NatsServer
from support.nats_bus import (
    SMALL_PAYLOAD,
    Caller,
    leaving,
    logged,
    refuse_updates,
    subscription,
    tag,
)
from support.scanner_parts import store_of
from support.tentacle import plc_subscribe, plc_tag, plc_unsubscribe

if TYPE_CHECKING:
    from pathlib import Path

    import holdfast
    from support.nats_bus import Run


def device(caller: Caller, id: str) -> Any:
    """What browsing tells of a device, apart from what moves by itself."""
    [found] = caller.request("modbus.browse", {"deviceId": id})["devices"]
    moving = {"scans", "missed", "roundTrip", "lastAnswer", "state", "stateSince", "blocks"}
    moving |= {"failures", "error", "lastError", "lastErrorAt"}
    for each in found["tags"]:
        each.pop("error", None)
    return {key: value for key, value in found.items() if key not in moving}


def subscriptions(caller: Caller) -> dict[str, Any]:
    return {key: each for key, each in caller.kept(BUCKET).items() if "subscription" in key}


def put(caller: Caller, key: str, value: bytes) -> None:
    async def put_it() -> None:
        bucket = await caller.client.jetstream().key_value(BUCKET)
        await bucket.put(key, value)

    caller.do(put_it())


def test_a_restarted_scanner_goes_on_for_callers_that_never_repeat(
    run_scanner: Run, caller: Caller, server: holdfast.Server, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "holdfast")
    first = run_scanner()
    data = caller.listen("modbus.data.Pump_1")
    request = plc_subscribe(server, plc_tag("a", 0), plc_tag("b", 1), device="Pump 1", rate=100)
    assert caller.request("modbus.subscribe", request)["success"]
    data.next()
    first.stop()
    data.take()

    second = run_scanner()
    assert {data.next()["variableId"] for _ in range(4)} == {"a", "b"}
    assert caller.request("modbus.command.a", "7") == {"success": True}
    assert logged(caplog, "restored") == [
        {"device": "Pump 1", "subscriber": "my-project", "tags": 2}
    ]
    left = plc_unsubscribe("a", "b", device="Pump 1")
    assert caller.request("modbus.unsubscribe", left)["success"]
    second.stop()
    run_scanner()
    assert caller.request("modbus.browse", b"")["count"] == 0


def test_a_state_that_is_being_stored_is_removed_when_the_scanner_stops(
    run_scanner: Run,
    caller: Caller,
    server: holdfast.Server,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    begun, stopping, put = threading.Event(), threading.Event(), KeyValue.put
    purge, stop = JetStreamContext.purge_stream, store.EntryStore.stop
    sent: list[Future[int]] = []
    arrived: list[bool] = []

    async def late(key: str, value: bytes) -> int:
        bucket = await caller.client.jetstream().key_value(BUCKET)
        begun.set()
        assert await asyncio.to_thread(stopping.wait, wire.DEADLINE)
        return await put(bucket, key, value)

    async def put_late(bucket: KeyValue, key: str, value: bytes) -> int:
        if "status" not in key:
            return await put(bucket, key, value)
        # What is on its way arrives, also if nobody waits for it.
        sent.append(asyncio.run_coroutine_threadsafe(late(key, value), caller.loop))
        return await asyncio.shield(asyncio.wrap_future(sent[-1]))

    async def noted_purge(jetstream: JetStreamContext, name: str, **more: Any) -> bool:
        arrived.append(all(each.done() for each in sent))
        return await purge(jetstream, name, **more)

    async def noted_stop(keeper: store.EntryStore) -> None:
        stopping.set()
        await stop(keeper)

    monkeypatch.setattr(KeyValue, "put", put_late)
    monkeypatch.setattr(JetStreamContext, "purge_stream", noted_purge)
    monkeypatch.setattr(store.EntryStore, "stop", noted_stop)
    running = run_scanner()
    caller.publish("modbus.subscribe", subscription(server, tag("a", 0)))
    assert begun.wait(wire.DEADLINE)
    running.stop()
    assert arrived[-1:] == [True]
    for each in sent:
        each.result(wire.DEADLINE)
    assert not [key for key in caller.kept(BUCKET) if "status" in key]


def test_everything_of_a_subscription_is_restored(
    run_scanner: Run, caller: Caller, server: holdfast.Server
) -> None:
    first = run_scanner()
    host, port = server.address
    url = f"tcp://{host}:{port}?retries=1"
    tags = [
        tag("f", 0, "float32", byteOrder="CDAB", null=["nan", -1], writable=False),
        tag("s", 10, "string:4", encoding="latin-1", description="näme"),
        tag("c", 3, "boolean", functionCode="coil", writable=True),
        tag("w", 20, "uint16[124]"),
        tag("l", 300, "uint32"),
    ]
    more: dict[str, Any] = {
        "host": None,
        "port": None,
        "url": url,
        "timeout": 20_700,
        "byteOrder": "little",
        "publish": "change",
        "deadband": 0.5,
        "scanRate": 60_000,
        "release": True,
        "plan": {"max_gap": 3, "readable": [[0, 900]] * 20, "forbidden": [["coil", 9, 9]]},
    }
    ids = {"deviceId": "a b/ü", "subscriberId": "who ever.*"}
    assert caller.request("modbus.subscribe", subscription(server, *tags) | more | ids)["success"]
    plain = subscription(server, tag("x", 5), timeout=20_900, deviceId="udp", transport="udp")
    assert caller.request("modbus.subscribe", plain)["success"]
    before = [device(caller, "a b/ü"), device(caller, "udp")]
    stored = caller.kept(BUCKET)
    assert set(stored) == {
        "modbus.subscription.=d2hvIGV2ZXIuKg.a_b__.0",
        "modbus.status.a_b__",
        "modbus.subscription.hmi.udp.0",
        "modbus.status.udp",
    }
    assert stored["modbus.status.udp"]["deviceId"] == "udp"
    first.stop()
    # The states are gone with the scanner, the subscriptions are not.
    assert set(caller.kept(BUCKET)) == {key for key in stored if "subscription" in key}
    run_scanner()
    assert [device(caller, "a b/ü"), device(caller, "udp")] == before


def test_a_large_subscription_is_kept_in_parts(
    run_scanner: Run,
    caller: Caller,
    server: holdfast.Server,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(entries, "MAX_PART_BYTES", 300)
    first = run_scanner()
    for start in range(0, 20, 5):
        tags = [tag(f"t{number}", number) for number in range(start, start + 5)]
        request = subscription(server, *tags, scanRate=60_000)
        assert caller.request("modbus.subscribe", request)["success"]
    found = subscriptions(caller)
    assert len(found) > 5
    assert {each["id"] for part in found.values() for each in part["tags"]} == {
        f"t{number}" for number in range(20)
    }
    first.stop()
    second = run_scanner()
    assert device(caller, "plc1")["tagCount"] == 20
    assert caller.request("modbus.unsubscribe", leaving("t0", "t1", "t2"))["success"]
    assert len(subscriptions(caller)) < len(found)
    assert caller.request("modbus.unsubscribe", leaving() | {"tagIds": "all"})["success"]
    assert caller.kept(BUCKET) == {}
    second.stop()


def test_no_part_of_a_subscription_is_larger_than_a_message(
    run_scanner: Run, small_nats: NatsServer, server: holdfast.Server
) -> None:
    first = run_scanner(small_nats)
    with Caller(small_nats.url) as caller:
        for start in range(0, 200, 10):
            tags = [
                tag(f"t{number}", number, description="d" * 100)
                for number in range(start, start + 10)
            ]
            request = subscription(server, *tags, scanRate=60_000)
            assert caller.request("modbus.subscribe", request)["success"]
        stored = subscriptions(caller)
        assert len(stored) > 1
        first.stop()
        run_scanner(small_nats, allow=("192.0.2.0/24",)).stop()
        assert subscriptions(caller) == stored
        second = run_scanner(small_nats)
        assert device(caller, "plc1")["tagCount"] == 200
        second.stop()


def test_a_tag_that_is_larger_than_a_message_costs_only_itself(
    run_scanner: Run,
    small_nats: NatsServer,
    server: holdfast.Server,
    caplog: pytest.LogCaptureFixture,
) -> None:
    first = run_scanner(small_nats)

    def asked(id: str, description: str) -> dict[str, Any]:
        return subscription(server, tag(id, 0, description=description), scanRate=60_000)

    # What is stored has the defaults, too.
    empty = len(json.dumps(asked("large", ""), ensure_ascii=False))
    large = asked("large", "ü" * ((SMALL_PAYLOAD - empty) // 2))
    with Caller(small_nats.url) as caller:
        assert caller.request("modbus.subscribe", asked("a", ""))["success"]
        text = json.dumps(large, ensure_ascii=False)
        reason = "subscribed, but not kept: an entry takes "
        for _ in range(2):
            answer = caller.request("modbus.subscribe", text)
            assert not answer["success"]
            assert answer["error"].startswith(reason)
        [found] = logged(caplog, "subscriptions_not_kept")
        assert (found["device"], found["subscriber"]) == ("plc1", "hmi")
        # Others of the same subscriber are kept, and a request without tags changes nothing.
        for more in (asked("c", ""), subscription(server, scanRate=60_000)):
            assert caller.request("modbus.subscribe", more)["success"]
        other = asked("b", "") | {"subscriberId": "historian"}
        assert caller.request("modbus.subscribe", other)["success"]
        assert "modbus.subscription.historian.plc1.0" in subscriptions(caller)
        assert device(caller, "plc1")["tagCount"] == 4
        assert caller.request("modbus.unsubscribe", leaving("a"))["success"]
        first.stop()
        run_scanner(small_nats, allow=("192.0.2.0/24",)).stop()
        second = run_scanner(small_nats)
        assert tags_by_subscription(caller) == {
            ("plc1", "hmi"): {"c"},
            ("plc1", "historian"): {"b"},
        }
        second.stop()


def test_what_is_stored_stays_if_the_server_takes_less(
    run_scanner: Run,
    own_nats: NatsServer,
    own_caller: Caller,
    server: holdfast.Server,
    tmp_path: Path,
) -> None:
    ask = own_caller.request
    first = run_scanner(own_nats)
    tags = [tag(f"t{number}", number, description="d" * 50) for number in range(100)]
    large = tag("large", 0, description="ü" * (SMALL_PAYLOAD // 2))
    for request in (
        subscription(server, *tags),
        subscription(server, large, deviceId="large"),
    ):
        assert ask("modbus.subscribe", request | {"scanRate": 60_000})["success"]
    first.stop()
    stored = subscriptions(own_caller)
    assert len(stored) == 2

    file = tmp_path / "small.conf"
    file.write_text(f"max_payload: {SMALL_PAYLOAD}\n")
    own_nats.restarted(*own_nats.options, "-c", str(file))
    wanted = {
        ("plc1", "hmi"): {each["id"] for each in tags[1:]},
        ("large", "hmi"): {"large"},
    }
    with Caller(own_nats.url) as caller:
        second = run_scanner(own_nats, allow=("192.0.2.0/24",))
        assert caller.request("modbus.unsubscribe", leaving("unknown"))["success"]
        assert subscriptions(caller) == stored
        assert caller.request("modbus.unsubscribe", leaving("t0"))["success"]
        second.stop()
        assert stored_tags(caller) == wanted
        third = run_scanner(own_nats)
        found = caller.request("modbus.browse", b"")["devices"]
        counts = {each["deviceId"]: each["tagCount"] for each in found}
        assert counts == {"plc1": 99, "large": 1}
        assert caller.request("modbus.unsubscribe", leaving("t1"))["success"]
        # What is stored of a tag that is too large now is all that there is of it.
        other_rate = subscription(server, deviceId="large", scanRate=50_000)
        assert caller.request("modbus.subscribe", other_rate)["success"]
        third.stop()
        wanted["plc1", "hmi"].remove("t1")
        assert stored_tags(caller) == wanted


def test_a_pending_subscription_does_not_replace_another_one_with_the_same_key(
    run_scanner: Run, caller: Caller, server: holdfast.Server
) -> None:
    first = run_scanner()
    request = subscription(server, tag("a", 0), tag("b", 0), deviceId="pump 1", host="127.0.0.2")
    assert caller.request("modbus.subscribe", request)["success"]
    first.stop()
    second = run_scanner(allow=("127.0.0.1/32",))
    request = subscription(server, tag("c", 0), deviceId="pump_1", host="127.0.0.1")
    assert caller.request("modbus.subscribe", request)["success"]
    for id in ("a", "unknown"):
        assert caller.request("modbus.unsubscribe", leaving(id, deviceId="pump 1"))["success"]
        assert stored_tags(caller) == {("pump_1", "hmi"): {"c"}}
    second.stop()


def test_the_state_of_a_device_is_there_for_those_who_come_late(
    run_scanner: Run, caller: Caller, server: holdfast.Server
) -> None:
    run_scanner()
    caller.request("modbus.subscribe", subscription(server, tag("a", 0)))

    def state() -> Any:
        return caller.kept(BUCKET).get("modbus.status.plc1", {}).get("state")

    wire.until(lambda: state() == "online", "the state is kept")
    caller.request("modbus.unsubscribe", leaving("a"))
    wire.until(lambda: state() is None, "it is gone with the device")


def test_nothing_is_kept_if_that_is_switched_off(
    run_scanner: Run, caller: Caller, server: holdfast.Server
) -> None:
    first = run_scanner(keep_subscriptions=False)
    request = subscription(server, tag("a", 0))
    assert caller.request("modbus.subscribe", request)["success"]
    assert caller.kept(BUCKET) == {}
    first.stop()
    run_scanner()
    assert caller.request("modbus.browse", b"")["count"] == 0


def test_prefixes_are_kept_apart(run_scanner: Run, caller: Caller, server: holdfast.Server) -> None:
    first = run_scanner(prefix="plant.one")
    request = subscription(server, tag("a", 0))
    assert caller.request("plant.one.subscribe", request)["success"]
    first.stop()
    run_scanner()
    assert caller.request("modbus.browse", b"")["count"] == 0
    run_scanner(prefix="plant.one")
    assert caller.request("plant.one.browse", b"")["count"] == 1


def test_what_is_not_a_subscription_or_no_longer_allowed_is_logged_and_left_alone(
    run_scanner: Run, caller: Caller, server: holdfast.Server, caplog: pytest.LogCaptureFixture
) -> None:
    first = run_scanner()
    assert caller.request("modbus.subscribe", subscription(server, tag("a", 0)))["success"]
    first.stop()
    other = subscription(server, tag("a", 0), deviceId="gone", host="8.8.8.8")
    put(caller, "modbus.subscription.hmi.gone.0", json.dumps(other).encode())
    put(caller, "modbus.subscription.hmi.bad.0", b'"nonsense"')
    put(caller, "modbus.subscription.hmi.worse.x", b"\xff{")
    put(caller, "modbus.status.bad", b"7")
    put(caller, "modbus.status.worse", b'{"deviceId":"\xff"}')
    second = run_scanner()
    assert caller.request("modbus.browse", b"")["count"] == 1
    [refused] = logged(caplog, "not_restored")
    assert (refused["device"], refused["subscriber"]) == ("gone", "hmi")
    assert refused["reason"].startswith("8.8.8.8 is not allowed")
    assert {each["key"] for each in logged(caplog, "kept_entry_malformed")} == {
        "modbus.subscription.hmi.bad.0",
        "modbus.subscription.hmi.worse.x",
        "modbus.status.bad",
        "modbus.status.worse",
    }
    second.stop()
    # With the device allowed, its subscription is there again; callers can also end it.
    third = run_scanner(allow=("127.0.0.0/8", "8.8.8.8/32"))
    wire.until(lambda: caller.request("modbus.browse", b"")["count"] == 2, "it is restored")
    third.stop()
    run_scanner()
    ended = caller.request("modbus.unsubscribe", leaving("a", deviceId="gone"))
    assert ended == {"success": True}
    assert "modbus.subscription.hmi.gone.0" not in caller.keys(BUCKET)


def test_a_refused_device_has_a_state_only_under_a_valid_name_of_its_own(
    run_scanner: Run,
    caller: Caller,
    server: holdfast.Server,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    published: list[str] = []
    monkeypatch.setattr(
        Publishers, "publish_given_up", lambda _self, device, _reason: published.append(device)
    )
    first = run_scanner()
    request = subscription(server, tag("a", 0), deviceId="plc_1")
    assert caller.request("modbus.subscribe", request)["success"]
    first.stop()
    refused = {"x\r\nPUB y 2\r\nhi": {}, "plc 1": {}, "gone": {"host": "192.0.2.1"}}
    for number, (id, more) in enumerate(refused.items()):
        text = json.dumps(request | {"deviceId": id} | more)
        put(caller, f"modbus.subscription.hmi.refused{number}.0", text.encode())
    run_scanner()
    assert caller.request("modbus.browse", b"")["count"] == 1
    wire.until(lambda: len(logged(caplog, "not_restored")) == len(refused), "all are refused")
    assert caller.request("modbus.browse", b"")["count"] == 1
    assert published == ["gone"]


def test_a_kept_description_that_is_too_long_is_cut(
    run_scanner: Run, caller: Caller, server: holdfast.Server
) -> None:
    request = subscription(server, tag("a", 0, description="ä" * 5000), tag("b", 1))
    first = run_scanner()
    assert caller.request("modbus.subscribe", subscription(server, tag("b", 1)))["success"]
    first.stop()
    put(caller, "modbus.subscription.hmi.plc1.0", json.dumps(request).encode())
    run_scanner()
    found = {each["id"]: each.get("description") for each in device(caller, "plc1")["tags"]}
    assert found == {"a": "ä" * 4096, "b": None}


def test_a_tag_of_a_pending_subscription_can_be_left(
    run_scanner: Run, caller: Caller, server: holdfast.Server
) -> None:
    first = run_scanner()
    request = subscription(server, tag("a", 0), tag("b", 1))
    assert caller.request("modbus.subscribe", request)["success"]
    first.stop()
    second = run_scanner(allow=("192.0.2.0/24",))
    assert caller.request("modbus.unsubscribe", leaving("a"))["success"]
    second.stop()
    run_scanner()
    assert [each["id"] for each in device(caller, "plc1")["tags"]] == ["b"]


def test_a_bucket_that_is_lost_is_written_again(
    run_scanner: Run,
    own_nats: NatsServer,
    own_caller: Caller,
    server: holdfast.Server,
    tmp_path: Path,
) -> None:
    scanner = run_scanner(own_nats)
    assert own_caller.request("modbus.subscribe", subscription(server, tag("a", 0)))["success"]
    assert len(subscriptions(own_caller)) == 1
    own_nats.kill()
    shutil.rmtree(tmp_path / "store")
    own_nats.start()
    wire.until(lambda: scanner.serves, "it is connected again")
    wire.until(lambda: len(own_caller.kept(BUCKET)) == 2, "both entries are there again")


@pytest.mark.parametrize("is_made_again", [False, True])
def test_a_bucket_that_is_deleted_is_written_again(
    run_scanner: Run,
    caller: Caller,
    server: holdfast.Server,
    monkeypatch: pytest.MonkeyPatch,
    is_made_again: bool,
) -> None:
    monkeypatch.setattr(store, "CHECK_INTERVAL_S", 0.1)
    run_scanner()
    assert caller.request("modbus.subscribe", subscription(server, tag("a", 0)))["success"]
    wire.until(lambda: len(caller.kept(BUCKET)) == 2, "both entries are there")
    caller.forget(BUCKET)
    if is_made_again:
        caller.put(BUCKET, "another", "1")
    wire.until(lambda: len(subscriptions(caller)) == 1, "the subscription is there again")


def set_ttl(caller: Caller, seconds: float) -> None:
    jetstream = caller.client.jetstream()
    found = caller.do(jetstream.stream_info(f"KV_{BUCKET}")).config
    changed = replace(found, max_age=seconds, duplicate_window=seconds)
    caller.do(jetstream.update_stream(changed))


def ttl(caller: Caller) -> float | None:
    return caller.do(caller.client.jetstream().stream_info(f"KV_{BUCKET}")).config.max_age


def test_a_ttl_of_the_bucket_is_removed_and_what_it_has_ended_is_stored_again(
    run_scanner: Run, caller: Caller, server: holdfast.Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    running = run_scanner()
    assert caller.request("modbus.subscribe", subscription(server, tag("a", 0)))["success"]
    set_ttl(caller, 0.1)  # While it runs.
    wire.until(lambda: not caller.keys(BUCKET), "the server has removed all")
    monkeypatch.setattr(store, "CHECK_INTERVAL_S", 0.1)
    assert caller.request("modbus.subscribe", subscription(server, tag("b", 1)))["success"]
    wire.until(lambda: not ttl(caller), "it is removed")
    wire.until(lambda: len(caller.kept(BUCKET)) == 2, "both entries are there again")
    running.stop()
    set_ttl(caller, 3600)
    run_scanner()
    assert [each["id"] for each in device(caller, "plc1")["tags"]] == ["a", "b"]
    wire.until(lambda: not ttl(caller), "it is removed at the start")


def test_a_ttl_that_stays_stops_no_scanner(
    run_scanner: Run,
    caller: Caller,
    server: holdfast.Server,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first = run_scanner()
    assert caller.request("modbus.subscribe", subscription(server, tag("a", 0)))["success"]
    first.stop()
    set_ttl(caller, 3600)
    refuse_updates(monkeypatch)
    run_scanner()
    assert [each["id"] for each in device(caller, "plc1")["tags"]] == ["a"]
    wire.until(lambda: logged(caplog, "subscriptions_not_kept"), "it is logged")
    [found] = logged(caplog, "subscriptions_not_kept")
    assert "TTL of 3600 s, which stays: not today" in found["reason"]
    assert caller.request("modbus.subscribe", subscription(server, tag("b", 1)))["success"]
    [stored] = subscriptions(caller).values()
    assert [each["id"] for each in stored["tags"]] == ["a", "b"]


def test_jetstream_that_fails_holds_no_request_up_and_gets_everything_later(
    run_scanner: Run,
    tmp_path: Path,
    server: holdfast.Server,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(store, "MAX_RETRY_S", 0.1)
    bare = NatsServer(tmp_path, jetstream=False)
    try:
        scanner = run_scanner(bare)
        with Caller(bare.url) as caller:
            for name in ("hmi", "historian"):
                request = subscription(server, tag("a", 0), subscriberId=name)
                assert caller.request("modbus.subscribe", request)["success"]
            gone = leaving("a", subscriberId="historian")
            assert caller.request("modbus.unsubscribe", gone)["success"]
            assert len(logged(caplog, "subscriptions_not_kept")) == 1
            bare.kill()
            bare.options = ("-js", "-sd", str(tmp_path / "store"))
            bare.start()
            wire.until(lambda: len(caller.kept(BUCKET)) == 2, "it is kept")
            assert set(caller.kept(BUCKET)) == {
                "modbus.subscription.hmi.plc1.0",
                "modbus.status.plc1",
            }
        scanner.stop()
    finally:
        bare.kill()


def test_a_request_is_answered_when_it_is_kept(
    run_scanner: Run, caller: Caller, server: holdfast.Server
) -> None:
    run_scanner()
    for number in range(20):
        tags = [tag("a", 0), tag("b", number)]
        request = subscription(server, *tags, deviceId=f"d{number}", scanRate=60_000)
        assert caller.request("modbus.subscribe", request)["success"]
        assert f"modbus.subscription.hmi.d{number}.0" in caller.keys(BUCKET)


def test_many_requests_at_once_are_all_kept(
    run_scanner: Run, caller: Caller, server: holdfast.Server
) -> None:
    run_scanner()

    async def ask(number: int) -> bytes:
        request = subscription(
            server, tag("a", 0), deviceId=f"d{number % 7}", subscriberId=f"s{number}"
        )
        data = json.dumps(request | {"scanRate": 60_000}).encode()
        return (await caller.client.request("modbus.subscribe", data, timeout=10)).data

    async def ask_all() -> list[bytes]:
        return await asyncio.gather(*map(ask, range(100)))

    assert set(caller.do(ask_all())) == {b'{"success":true,"count":1}'}
    assert len(subscriptions(caller)) == 100


def tags_by_subscription(caller: Caller) -> dict[tuple[str, str], set[str]]:
    """Returns the tags of each subscription that is carried out, by device and subscriber."""
    return {
        (found["deviceId"], subscriber["id"]): set(subscriber["tagIds"])
        for found in caller.request("modbus.browse", b"")["devices"]
        for subscriber in found["subscribers"]
    }


def stored_tags(caller: Caller) -> dict[tuple[str, str], set[str]]:
    found: dict[tuple[str, str], set[str]] = {}
    for each in subscriptions(caller).values():
        owner = each["deviceId"], each["subscriberId"]
        found.setdefault(owner, set()).update(tag["id"] for tag in each["tags"])
    return found


@pytest.mark.parametrize("reloads", [False, True], ids=["", "reloaded"])
def test_what_is_requested_before_the_entries_are_read_is_on_top_of_them(
    run_scanner: Run,
    own_nats: NatsServer,
    own_caller: Caller,
    server: holdfast.Server,
    monkeypatch: pytest.MonkeyPatch,
    reloads: bool,
) -> None:
    monkeypatch.setattr(store, "MAX_RETRY_S", 0.1)
    ask = own_caller.request

    def add(device: str, *ids: str, **more: Any) -> None:
        tags = [tag(id, ord(id)) for id in ids]
        request = subscription(server, *tags, deviceId=device, scanRate=60_000, **more)
        assert ask("modbus.subscribe", request)["success"]

    def leave(device: str, *ids: str, **more: Any) -> None:
        assert ask("modbus.unsubscribe", leaving(*ids, deviceId=device, **more))["success"]

    settings = {"timeout": 20_700}
    devices = "same", "more", "fewer", "ended", "begun anew", "moved", "shared", "untouched"
    first = run_scanner(own_nats)
    for each in devices:
        add(each, "a", "b", **settings)
    add("shared", "b", "c", subscriberId="historian", **settings)
    first.stop()

    jetstream = own_nats.restarted()
    scanner = run_scanner(own_nats)
    add("same", "a", "b", **settings)
    add("more", "c")
    leave("fewer", "a")
    leave("ended", tagIds="all")
    leave("begun anew", tagIds="all")
    add("begun anew", "c")
    add("moved", "c", host="127.0.0.2")
    leave("shared", "a")
    add("shared", "d", subscriberId="historian")
    add("new", "a", "b")
    leave("new", "a")
    if reloads:
        scanner.stop()
        scanner = run_scanner(own_nats, former=list(scanner.scanner.stored_requests()))
    own_nats.restarted(*jetstream)
    wanted = {
        ("same", "hmi"): {"a", "b"},
        ("more", "hmi"): {"a", "b", "c"},
        ("fewer", "hmi"): {"b"},
        ("begun anew", "hmi"): {"c"},
        ("moved", "hmi"): {"a", "b", "c"},
        ("shared", "hmi"): {"b"},
        ("shared", "historian"): {"b", "c", "d"},
        ("untouched", "hmi"): {"a", "b"},
        ("new", "hmi"): {"b"},
    }
    wire.until(lambda: scanner.serves, "it is connected again")
    wire.until(lambda: tags_by_subscription(own_caller) == wanted, "they are carried out")
    wire.until(lambda: stored_tags(own_caller) == wanted, "they are stored")
    scanner.stop()
    run_scanner(own_nats)
    wire.until(lambda: tags_by_subscription(own_caller) == wanted, "they are restored")
    assert device(own_caller, "moved")["url"].startswith("tcp://127.0.0.2:")
    assert device(own_caller, "more")["timeout"] == 20_700


def test_the_dialect_of_whole_subscriptions_replaces_what_is_not_read_yet(
    run_scanner: Run,
    own_nats: NatsServer,
    own_caller: Caller,
    server: holdfast.Server,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(store, "MAX_RETRY_S", 0.1)
    requests = [subscription(server, tag(id, 0), deviceId="d") for id in ("a", "b")]
    first = run_scanner(own_nats, dialect="tentacle-next")
    assert own_caller.request("modbus.subscribe", requests[0])["success"]
    first.stop()
    jetstream = own_nats.restarted()
    run_scanner(own_nats, dialect="tentacle-next")
    assert own_caller.request("modbus.subscribe", requests[1])["success"]
    own_nats.restarted(*jetstream)
    wanted = {("d", "hmi"): {"b"}}
    wire.until(lambda: stored_tags(own_caller) == wanted, "the new one is stored")
    assert tags_by_subscription(own_caller) == wanted


def test_a_request_adds_tags_to_a_refused_subscription(
    run_scanner: Run, caller: Caller, server: holdfast.Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(restore, "MAX_RETRY_S", 0.1)
    first = run_scanner()
    request = subscription(server, tag("a", 0), tag("b", 1), host="127.0.0.2", timeout=20_700)
    assert caller.request("modbus.subscribe", request)["success"]
    first.stop()
    second = run_scanner(allow=("127.0.0.1/32",))
    assert tags_by_subscription(caller) == {}
    request = subscription(server, tag("b", 2), tag("c", 3), host="127.0.0.1")
    assert caller.request("modbus.subscribe", request)["success"]
    wanted = {("plc1", "hmi"): {"a", "b", "c"}}
    assert stored_tags(caller) == wanted
    wire.until(lambda: tags_by_subscription(caller) == wanted, "all are carried out")
    found = device(caller, "plc1")
    assert found["timeout"] == 20_700
    assert [each["address"] for each in found["tags"] if each["id"] == "b"] == [2]
    second.stop()
    run_scanner()
    assert device(caller, "plc1") == found


def test_a_refused_part_of_a_subscription_is_kept_and_does_not_refuse_the_others(
    run_scanner: Run, caller: Caller, server: holdfast.Server, caplog: pytest.LogCaptureFixture
) -> None:
    run_scanner().stop()
    parts = tag("a", 0), tag("p", 1, profile="gone")
    for number, part in enumerate(parts):
        text = json.dumps(subscription(server, part))
        put(caller, f"modbus.subscription.hmi.plc1.{number}", text.encode())
    second = run_scanner()
    assert tags_by_subscription(caller) == {("plc1", "hmi"): {"a"}}
    assert len(logged(caplog, "not_restored")) == 1
    assert caller.request("modbus.subscribe", subscription(server, tag("b", 2)))["success"]
    assert stored_tags(caller) == {("plc1", "hmi"): {"a", "b", "p"}}
    second.stop()
    third = run_scanner(former=list(second.scanner.stored_requests()))
    wanted = {("plc1", "hmi"): {"a", "b"}}
    wire.until(lambda: tags_by_subscription(caller) == wanted, "what is not refused")
    wire.until(
        lambda: stored_tags(caller) == {("plc1", "hmi"): {"a", "b", "p"}}, "it is all stored"
    )
    third.stop()
    run_scanner()
    assert tags_by_subscription(caller) == wanted
    assert caller.request("modbus.unsubscribe", leaving("p"))["success"]
    assert stored_tags(caller) == wanted


def test_without_storage_a_request_adds_tags_to_a_refused_subscription_too(
    run_scanner: Run, caller: Caller, server: holdfast.Server
) -> None:
    scanner = run_scanner(keep_subscriptions=False)

    def reload(**more: Any) -> None:
        nonlocal scanner
        scanner.stop()
        former = list(scanner.scanner.stored_requests())
        scanner = run_scanner(keep_subscriptions=False, former=former, **more)

    request = subscription(server, tag("a", 0), tag("b", 1), host="127.0.0.2")
    assert caller.request("modbus.subscribe", request)["success"]
    reload(allow=("127.0.0.1/32",))
    assert tags_by_subscription(caller) == {}
    request = subscription(server, tag("c", 3), host="127.0.0.1")
    assert caller.request("modbus.subscribe", request)["success"]
    assert caller.request("modbus.unsubscribe", leaving("a"))["success"]
    reload(allow=("127.0.0.1/32",))
    assert tags_by_subscription(caller) == {("plc1", "hmi"): {"b", "c"}}


def test_without_storage_a_refused_subscription_does_not_end_a_later_one(
    run_scanner: Run, caller: Caller, server: holdfast.Server
) -> None:
    request = subscription(server, tag("p", 1, profile="gone"))
    former = [msgspec.json.decode(json.dumps(request), type=SubscribeRequest)]
    scanner = run_scanner(keep_subscriptions=False, former=former)
    assert caller.request("modbus.subscribe", subscription(server, tag("c", 3)))["success"]
    for _ in range(2):
        scanner.stop()
        more = list(scanner.scanner.stored_requests())
        scanner = run_scanner(keep_subscriptions=False, former=more)
        assert tags_by_subscription(caller) == {("plc1", "hmi"): {"c"}}


@pytest.mark.parametrize("adds", [False, True], ids=["", "adds"])
def test_a_tag_of_a_pending_subscription_that_is_left_without_jetstream_stays_so(
    run_scanner: Run,
    own_nats: NatsServer,
    own_caller: Caller,
    server: holdfast.Server,
    monkeypatch: pytest.MonkeyPatch,
    adds: bool,
) -> None:
    monkeypatch.setattr(store, "MAX_RETRY_S", 0.1)
    first = run_scanner(own_nats)
    request = subscription(server, tag("a", 0), tag("b", 1), host="127.0.0.2")
    assert own_caller.request("modbus.subscribe", request)["success"]
    first.stop()
    scanner = run_scanner(own_nats, allow=("127.0.0.1/32",))
    assert tags_by_subscription(own_caller) == {}  # Answered when the entries are read.
    jetstream = own_nats.restarted()
    wire.until(lambda: scanner.serves, "it is connected again")
    wanted = {("plc1", "hmi"): {"b"}}
    left = ["a"]
    if adds:
        added = subscription(server, tag("c", 2), host="127.0.0.1")
        assert own_caller.request("modbus.subscribe", added)["success"]
        wanted, left = {("plc1", "hmi"): {"c"}}, ["a", "b"]
    assert own_caller.request("modbus.unsubscribe", leaving(*left))["success"]
    scanner.stop()
    scanner = run_scanner(own_nats, former=list(scanner.scanner.stored_requests()))
    own_nats.restarted(*jetstream)
    wire.until(lambda: scanner.serves, "it is connected again")
    wire.until(lambda: stored_tags(own_caller) == wanted, "what is left is stored")
    assert tags_by_subscription(own_caller) == wanted


def test_what_is_remembered_without_jetstream_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(changes_before_read, "MAX_CHANGED", 3)
    monkeypatch.setattr(changes_before_read, "MAX_REMOVED_IDS", 5)
    stored = StoredSubscriptions("modbus", Registry(ScannerLimits()), Rules())
    owners = [SubscriptionKey("plc1", f"s{number}") for number in range(5)]
    for ids in (["a", "b"], ["b"], [f"{number}" for number in range(1, 100)]):
        for owner in owners[:2]:
            stored.on_unsubscribed(owner.removal(ids))
    assert sum(len(each.ids or ()) for each in stored.removals(())) == 5
    for owner in owners:
        stored.on_unsubscribed(owner.removal())
    assert len([*stored.removals(())]) == 3


def test_only_what_is_to_be_stored_waits_for_jetstream(
    run_scanner: Run,
    own_nats: NatsServer,
    own_caller: Caller,
    server: holdfast.Server,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(store, "MAX_RETRY_S", 0.1)
    jetstream = own_nats.restarted()
    request = subscription(server, tag("a", 0), host="127.0.0.2")
    former = [msgspec.json.decode(json.dumps(request), type=SubscribeRequest)]
    scanner = run_scanner(own_nats, former=former, allow=("127.0.0.1/32",))
    assert own_caller.request("modbus.unsubscribe", leaving("a", deviceId="unknown"))["success"]
    wire.until(lambda: not store_of(scanner.scanner).touched, "what nobody has is forgotten")
    own_nats.restarted(*jetstream)
    wanted = {("plc1", "hmi"): {"a"}}
    wire.until(lambda: stored_tags(own_caller) == wanted, "what is refused is stored")


def test_what_is_unsubscribed_without_jetstream_stays_so_after_a_reload(
    run_scanner: Run,
    own_nats: NatsServer,
    own_caller: Caller,
    server: holdfast.Server,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(store, "MAX_RETRY_S", 0.1)
    scanner = run_scanner(own_nats)
    for id in ("ended", "fewer"):
        request = subscription(server, tag("a", 0), tag("b", 1), deviceId=id)
        assert own_caller.request("modbus.subscribe", request)["success"]
    jetstream = own_nats.restarted()
    wire.until(lambda: scanner.serves, "it is connected again")
    for ids, id in (("all", "ended"), (["a"], "fewer")):
        left = leaving(deviceId=id, tagIds=ids)
        assert own_caller.request("modbus.unsubscribe", left)["success"]
    scanner.stop()
    run_scanner(own_nats, former=list(scanner.scanner.stored_requests()))
    own_nats.restarted(*jetstream)
    wanted = {("fewer", "hmi"): {"b"}}
    wire.until(lambda: stored_tags(own_caller) == wanted, "what is left is stored")
    assert tags_by_subscription(own_caller) == wanted


@pytest.mark.parametrize("is_read", [True, False], ids=["", "never read"])
def test_what_is_changed_without_jetstream_and_refused_after_a_reload_is_stored(
    run_scanner: Run,
    own_nats: NatsServer,
    own_caller: Caller,
    server: holdfast.Server,
    monkeypatch: pytest.MonkeyPatch,
    is_read: bool,
) -> None:
    monkeypatch.setattr(store, "MAX_RETRY_S", 0.1)

    def add(*tags: dict[str, Any], **more: Any) -> None:
        request = subscription(server, *tags, host="127.0.0.2", **more)
        assert own_caller.request("modbus.subscribe", request)["success"]

    scanner = run_scanner(own_nats)
    add(tag("a", 0), tag("b", 1), timeout=20_700, release=True)
    if is_read:
        jetstream = own_nats.restarted()
    else:
        scanner.stop()
        jetstream = own_nats.restarted()
        scanner = run_scanner(own_nats)
    wire.until(lambda: scanner.serves, "it is connected again")
    add(tag("c", 2), release=False)
    assert own_caller.request("modbus.unsubscribe", leaving("a"))["success"]
    for _ in range(2):
        scanner.stop()
        former = list(scanner.scanner.stored_requests())
        scanner = run_scanner(own_nats, former=former, allow=("127.0.0.1/32",))
        assert tags_by_subscription(own_caller) == {}
    own_nats.restarted(*jetstream)
    wire.until(lambda: scanner.serves, "it is connected again")
    wanted = {("plc1", "hmi"): {"b", "c"}}
    wire.until(lambda: stored_tags(own_caller) == wanted, "what is refused is stored")
    settings = {(each["timeout"], each["release"]) for each in subscriptions(own_caller).values()}
    assert settings == {(20_700, False)}
    scanner.stop()
    run_scanner(own_nats)
    wire.until(lambda: tags_by_subscription(own_caller) == wanted, "it is accepted")


class ControlWithoutEntries:
    """Stands for the scanner of stored subscriptions."""

    def __init__(self) -> None:
        self._lock = asyncio.Lock()

    def lock(self, _device: str) -> asyncio.Lock:
        return self._lock

    def is_entry(self, _owner: SubscriptionKey) -> bool:
        return False


def test_a_refused_request_of_a_former_scanner_is_tried_again_and_handed_over() -> None:
    tags = [TagRequest(id, number, "holding", "int16") for number, id in enumerate("abc")]
    older, newer = (
        SubscribeRequest("plc1", "hmi", each, host="127.0.0.1") for each in (tags[:2], tags[1:])
    )
    owner = SubscriptionKey.of(newer)
    stored = StoredSubscriptions("modbus", Registry(ScannerLimits()), Rules())
    carried_out: list[SubscribeRequest] = []

    class Control(ControlWithoutEntries):
        async def restore(self, request: SubscribeRequest) -> None:
            carried_out.append(request)

    stored._device_control = stored._subscription_control = Control()  # type: ignore[assignment]
    stored.on_unsubscribed(owner.removal())
    assert stored.take_over_refused(newer)
    stored._on_read([("modbus.subscription.hmi.plc1.0", msgspec.json.encode(older))])
    # Until it is stored, the next scanner must remove what only the older request has.
    assert [*stored.removals(())] == [owner.removal(["a"])]
    asyncio.run(stored._restore_all())
    assert [[each.id for each in request.tags] for request in carried_out] == [["b", "c"]]


def test_a_pending_subscription_that_a_caller_ends_meanwhile_is_not_carried_out() -> None:
    owner = SubscriptionKey("plc1", "hmi")
    carried_out: list[SubscribeRequest] = []

    class Control(ControlWithoutEntries):
        def __init__(self) -> None:
            super().__init__()
            self.waits = asyncio.Event()

        def lock(self, device: str) -> asyncio.Lock:
            self.waits.set()
            return super().lock(device)

        async def restore(self, request: SubscribeRequest) -> None:
            carried_out.append(request)

    async def run(*, ends: bool) -> None:
        stored = StoredSubscriptions("modbus", Registry(ScannerLimits()), Rules())
        control: Any = Control()
        stored._device_control = stored._subscription_control = control
        tags = [TagRequest("a", 0, "holding", "int16")]
        value = msgspec.json.encode(SubscribeRequest("plc1", "hmi", tags, host="127.0.0.1"))
        stored._on_read([("modbus.subscription.hmi.plc1.0", value)])
        async with control.lock("plc1"):
            control.waits.clear()
            restoring = asyncio.create_task(stored._restore_all())
            await asyncio.wait_for(control.waits.wait(), wire.DEADLINE)
            if ends:
                stored.on_unsubscribed(owner.removal())
        await restoring

    asyncio.run(run(ends=False))
    assert len(carried_out) == 1
    asyncio.run(run(ends=True))
    assert len(carried_out) == 1


def test_a_request_does_not_wait_for_all_parts_of_a_refused_subscription() -> None:
    tried: list[SubscribeRequest] = []

    class Control(ControlWithoutEntries):
        def __init__(self) -> None:
            super().__init__()
            self.has_begun = asyncio.Event()

        def give_up(self, _device: str, _reason: str) -> None: ...

        async def restore(self, request: SubscribeRequest) -> None:
            tried.append(request)
            if len(tried) == 2:  # The first part, after the whole subscription.
                self.has_begun.set()
            for _ in range(5):
                await asyncio.sleep(0)
            raise Refused("no address")

    async def run() -> None:
        stored = StoredSubscriptions("modbus", Registry(ScannerLimits()), Rules())
        control: Any = Control()
        stored._device_control = stored._subscription_control = control
        entries = []
        for number in range(5):
            tags = [TagRequest(f"t{number}", number, "holding", "int16")]
            request = SubscribeRequest("plc1", "hmi", tags, host="plc.local")
            key = f"modbus.subscription.hmi.plc1.{number}"
            entries.append((key, msgspec.json.encode(request)))
        stored._on_read(entries)
        restoring = asyncio.create_task(stored._restore_all())
        await asyncio.wait_for(control.has_begun.wait(), wire.DEADLINE)
        async with control.lock("plc1"):
            assert len(tried) == 2
            # What this request changes is not carried out as it was stored.
            stored.on_unsubscribed(SubscriptionKey("plc1", "hmi").removal(["t4"]))
        await restoring
        assert len(tried) == 2

    asyncio.run(run())


def test_a_device_that_gets_another_id_with_the_same_keys_stays_stored() -> None:
    old, new = SubscriptionKey("pump 1", "hmi"), SubscriptionKey("pump_1", "hmi")
    key = "modbus.subscription.hmi.pump_1.0"
    wanted: dict[SubscriptionKey, dict[str, bytes]] = {old: {key: b"old"}}
    bucket: dict[str, bytes] = {}

    class Bucket:
        async def put(self, key: str, value: bytes) -> None:
            bucket[key] = value

    class JetStream:
        async def purge_stream(self, _name: str, subject: str) -> None:
            for _ in range(5):  # It is carried out after requests that are sent later.
                await asyncio.sleep(0)
            bucket.pop(subject.removeprefix(store.KEY_SUBJECTS), None)

    async def run() -> None:
        entries = store.EntryStore("modbus", lambda owner: wanted.get(owner, {}), lambda _: {})

        async def write(*owners: SubscriptionKey) -> None:
            for owner in owners:
                entries.touch(owner)
            await entries._write(JetStream(), Bucket())  # type: ignore[arg-type]

        await write(old)
        assert bucket == {key: b"old"}
        wanted[new] = {key: b"new"}
        del wanted[old]
        await write(old, new)
        assert bucket == {key: b"new"}
        await write(old)
        assert bucket == {key: b"new"}
        wanted[old] = {key: b"old"}
        del wanted[new]
        await write(new, old)
        assert bucket == {key: b"old"}
        del wanted[old]
        await write(old, new)
        assert bucket == {}

    asyncio.run(run())

"""The messages of the programs of tentacle-next, played against the scanner."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

import holdfast
from holdfast.scanner.dialects import DIALECTS, tentacle_next
from holdfast.scanner.errors import Refused
from holdfast.scanner.jetstream.key_watch import WATCH_TIMES, WatchTimes
from holdfast.scanner.jetstream.store import BUCKET as KEPT
from holdfast.scanner.messages.decoding import Adjustments, decode_lenient
from holdfast.scanner.messages.types import SubscribeRequest
from holdfast.scanner.subscriptions.request_rules import Defaults
from support import wire
from support.brokers import NatsServer
from support.nats_bus import Caller, leaving, logged, subscription, tag
from support.scanner_parts import allowed_of, polling_of, registry_of
from support.tentacle_next import (
    BUCKET,
    ENABLED,
    command,
    enabled,
    gateway_entry,
    gateway_tag,
    key,
    library_command,
    library_register,
    library_subscribe,
    subject_part,
)

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from support.nats_bus import Inbox, Run, Running
    from support.running import Serve

NEXT: dict[str, Any] = {
    "dialect": "tentacle-next",
    "defaults": Defaults(publish="change"),
    "watch_times": WatchTimes(quiet_s=0.2, settle_s=0.02, retry_s=0.1),
}


@pytest.fixture
def scanner(run_scanner: Run, caller: Caller) -> Iterator[Running]:
    """A scanner for programs of tentacle-next. Their buckets are removed after the test."""
    running = run_scanner(**NEXT)
    yield running
    running.stop()
    caller.forget(BUCKET)
    caller.forget(ENABLED)


def devices(caller: Caller) -> dict[str, Any]:
    """The known devices, by id."""
    found = caller.request("modbus.browse", b"")["devices"]
    return {each["deviceId"]: each for each in found}


def tags(caller: Caller, device: str = "plc1") -> set[str]:
    """The ids of the tags of a device."""
    found = devices(caller).get(device)
    return set() if found is None else {each["id"] for each in found["tags"]}


def refused(caller: Caller) -> dict[str, str]:
    """The reasons of refused entries, by key."""
    service = caller.request("modbus.browse", b"")["service"]
    return {each["key"]: each["error"] for each in service.get("refusedEntries", [])}


def variables(caller: Caller) -> dict[str, Any]:
    """The latest values and qualities, by tag id. Its API sends an empty request."""
    found = caller.request("modbus.variables", b"")
    return {each["variableId"]: (each["value"], each["quality"]) for each in found}


def has(inbox: Inbox, value: object) -> Any:
    """Returns the next message with a value."""
    return inbox.until(lambda message: message["value"] == value, f"the value {value}")


# Its gateway.


@pytest.mark.usefixtures("scanner")
def test_an_entry_is_a_subscription(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 0, [7, 0x42F6, 0xE979, 2])
    memory.write("coils", 4, [1])
    speed = caller.listen("modbus.data.plc1.speed")
    pressure = caller.listen("modbus.data.plc1.pressure")
    running = caller.listen("modbus.data.plc1.running")
    batches = caller.listen("modbus.data.plc1")
    entry = gateway_entry(
        server,
        gateway_tag("speed", 0),
        gateway_tag("pressure", 1, "float32", order="ABCD"),
        gateway_tag("running", 4, function="coil"),
        gateway_tag("alarm", 3, "boolean"),
        rate=50,
    )
    alarm = caller.listen("modbus.data.plc1.alarm")
    caller.put(BUCKET, key(), entry)
    message = speed.next()
    assert message.pop("timestamp") > 1_600_000_000_000
    assert message == {
        "moduleId": "modbus",
        "deviceId": "plc1",
        "variableId": "speed",
        "value": 7,
        "datatype": "number",
    }
    assert pressure.next()["value"] == 123.45600128173828
    found = running.next()
    assert (found["value"], found["datatype"]) == (True, "boolean")
    assert alarm.next()["value"] is True
    memory.write("holding_registers", 0, [8])
    assert has(speed, 8)["variableId"] == "speed"
    assert batches.take() == []


@pytest.mark.usefixtures("scanner")
def test_only_changes_are_published_where_that_is_the_default(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    data = caller.listen("modbus.data.plc1.>")
    entry = gateway_entry(server, gateway_tag("still", 0), gateway_tag("moving", 1), rate=50)
    caller.put(BUCKET, key(), entry)
    for value in range(1, 6):
        memory.write("holding_registers", 1, [value])
        has(data, value)
    assert [each for each in data.take() if each["variableId"] == "still"] == []


@pytest.mark.usefixtures("scanner")
def test_a_deleted_entry_ends_the_subscription(caller: Caller, server: holdfast.Server) -> None:
    caller.put(BUCKET, key(), gateway_entry(server, gateway_tag("a", 0)))
    caller.put(
        BUCKET, key(gateway="other"), gateway_entry(server, gateway_tag("b", 1), gateway="other")
    )
    wire.until(lambda: tags(caller) == {"a", "b"}, "both are subscribed")
    caller.delete(BUCKET, key())
    wire.until(lambda: tags(caller) == {"b"}, "one has ended")
    caller.delete(BUCKET, key(gateway="other"))
    wire.until(lambda: devices(caller) == {}, "both have ended")
    wire.until(lambda: server.counters()["connections"]["open"] == 0, "the connection is closed")


@pytest.mark.usefixtures("scanner")
def test_an_entry_is_the_whole_subscription(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 0, [10, 11, 12])
    entry = gateway_entry(server, gateway_tag("a", 0), gateway_tag("b", 1))
    data = caller.listen("modbus.data.plc1.>")
    caller.put(BUCKET, key(), entry)
    wire.until(lambda: {each["variableId"] for each in data.take()} != set(), "it is published")
    wire.until(lambda: variables(caller) == {"a": (10, "good"), "b": (11, "good")}, "it is read")
    data.take()
    caller.put(BUCKET, key(), gateway_entry(server, gateway_tag("b", 2), gateway_tag("c", 0)))
    wire.until(lambda: tags(caller) == {"b", "c"}, "it is replaced")
    found = {each["variableId"]: each["value"] for each in (data.next(), data.next())}
    assert found == {"b": 12, "c": 10}


def test_its_gateway_gets_every_value_when_it_writes_its_entries_again(
    run_scanner: Run, caller: Caller, server: holdfast.Server
) -> None:
    running = run_scanner(**NEXT | {"watch_times": WATCH_TIMES})
    entry = gateway_entry(server, gateway_tag("a", 0), gateway_tag("b", 1), rate=50)
    caller.put(BUCKET, key(), entry)
    wire.until(lambda: variables(caller).keys() == {"a", "b"}, "it is subscribed")
    wire.until(lambda: variables(caller)["a"] == (0, "good"), "it is read")
    data = caller.listen("modbus.data.plc1.>")
    # It deletes each entry before it writes it again, when its configuration changes.
    caller.delete(BUCKET, key())
    caller.put(BUCKET, key(), entry)
    assert {data.next()["variableId"], data.next()["variableId"]} == {"a", "b"}
    running.stop()
    caller.forget(BUCKET)


@pytest.mark.usefixtures("scanner")
def test_names_in_subjects_are_those_that_its_programs_listen_to(
    caller: Caller, server: holdfast.Server
) -> None:
    device, id = "Pump 100%/1", "Zulauf: Höhe.Ist=1;2"
    data = caller.listen(f"modbus.data.{subject_part(device)}.{subject_part(id)}")
    status = caller.listen(f"modbus.status.{subject_part(device)}")
    assert subject_part(device) == "Pump_100%/1"
    request = gateway_entry(server, gateway_tag(id, 0), device=device)
    assert caller.request("modbus.subscribe", request)["success"]
    message = data.next()
    assert (message["deviceId"], message["variableId"]) == (device, id)
    assert status.next()["deviceId"] == device


def test_entries_are_read_by_a_scanner_that_starts_later(
    run_scanner: Run, caller: Caller, server: holdfast.Server
) -> None:
    for number in range(20):
        device = f"plc.{number}"
        entry = gateway_entry(server, gateway_tag(f"a{number}", number), device=device)
        caller.put(BUCKET, key(device), entry)
    caller.delete(BUCKET, key("plc.7"))
    first = run_scanner(**NEXT)
    assert devices(caller).keys() == {f"plc.{number}" for number in range(20) if number != 7}
    first.stop()
    caller.delete(BUCKET, key("plc.3"))
    run_scanner(**NEXT)
    assert len(devices(caller)) == 18
    assert [each for each in caller.kept(KEPT) if "subscription" in each] == []
    caller.forget(BUCKET)


def test_entries_are_read_again_after_a_reconnect(
    run_scanner: Run, own_nats: NatsServer, own_caller: Caller, server: holdfast.Server
) -> None:
    running = run_scanner(own_nats, **NEXT)
    for device in ("a", "b", "c"):
        entry = gateway_entry(server, gateway_tag(device, 0), device=device)
        own_caller.put(BUCKET, key(device), entry)
    wire.until(lambda: devices(own_caller).keys() == {"a", "b", "c"}, "all are subscribed")
    own_nats.kill()
    wire.until(lambda: not running.serves, "the connection is lost")
    own_nats.start()
    wire.until(lambda: running.serves, "it is connected again")
    own_caller.delete(BUCKET, key("b"))
    changed = gateway_entry(server, gateway_tag("other", 1), device="c")
    own_caller.put(BUCKET, key("c"), changed)
    wire.until(lambda: devices(own_caller).keys() == {"a", "c"}, "one has ended")
    wire.until(lambda: tags(own_caller, "c") == {"other"}, "one has changed")


def lost(caplog: pytest.LogCaptureFixture) -> set[tuple[str, int]]:
    """The lost buckets, and how many keys of them were known."""
    return {(each["bucket"], each["keys"]) for each in logged(caplog, "bucket_lost")}


@pytest.mark.parametrize("is_made_again", [True, False])
def test_a_lost_bucket_neither_ends_subscriptions_nor_enables_the_scanner(
    run_scanner: Run,
    own_nats: NatsServer,
    own_caller: Caller,
    server: holdfast.Server,
    caplog: pytest.LogCaptureFixture,
    *,
    is_made_again: bool,
) -> None:
    running = run_scanner(own_nats, **NEXT)
    for device in ("a", "b"):
        entry = gateway_entry(server, gateway_tag(device, 0), device=device)
        own_caller.put(BUCKET, key(device), entry)
    own_caller.put(ENABLED, "modbus", enabled(False))
    wire.until(lambda: devices(own_caller).keys() == {"a", "b"}, "both are subscribed")
    wire.until(lambda: logged(caplog, "scanner_disabled") != [], "it is disabled")

    if not is_made_again:  # It is the same one, and its numbers go on.
        for bucket in (BUCKET, ENABLED):
            own_caller.do(own_caller.client.jetstream().purge_stream(f"KV_{bucket}"))
    for loses in (is_made_again, False):  # Nor when it is read once more.
        own_nats.kill()
        wire.until(lambda: not running.serves, "the connection is lost")
        if loses:
            own_nats.lose_store()
        own_nats.start()
        wire.until(lambda: running.serves, "it is connected again")
        own_caller.put(BUCKET, key("c"), gateway_entry(server, gateway_tag("c", 0), device="c"))
        wire.until(lambda: "c" in devices(own_caller), "a new entry is carried out")
        own_caller.delete(BUCKET, key("c"))
        wire.until(lambda: devices(own_caller).keys() == {"a", "b"}, "it has ended")
    expected = {(BUCKET, 2), (ENABLED, 1)}
    wire.until(lambda: lost(caplog) == expected, "both losses are logged")
    assert own_caller.request("modbus.browse", b"")["service"]["enabled"] is False
    own_caller.delete(BUCKET, key("a"))
    changed = gateway_entry(server, gateway_tag("other", 0), device="b")
    own_caller.put(BUCKET, key("b"), changed)
    wire.until(lambda: devices(own_caller).keys() == {"b"}, "one is ended")
    wire.until(lambda: tags(own_caller, "b") == {"other"}, "one is replaced")
    own_caller.delete(ENABLED, "modbus")
    wire.until(lambda: variables(own_caller) == {"other": (0, "good")}, "it is enabled")
    own_caller.forget(BUCKET)
    own_caller.put(BUCKET, key("a"), gateway_entry(server, gateway_tag("a", 0), device="a"))
    wire.until(lambda: devices(own_caller).keys() == {"a", "b"}, "a deleted bucket is followed")


def test_a_purged_entry_ends_the_subscription(
    run_scanner: Run, own_nats: NatsServer, own_caller: Caller, server: holdfast.Server
) -> None:
    run_scanner(own_nats, **NEXT)
    own_caller.put(BUCKET, key(), gateway_entry(server, gateway_tag("a", 0)))
    wire.until(lambda: tags(own_caller) == {"a"}, "it is subscribed")

    async def purge() -> None:
        await (await own_caller.client.jetstream().key_value(BUCKET)).purge(key())

    own_caller.do(purge())
    wire.until(lambda: devices(own_caller) == {}, "it has ended")


def test_entries_are_followed_when_the_server_has_lost_the_reader(
    run_scanner: Run,
    own_nats: NatsServer,
    own_caller: Caller,
    server: holdfast.Server,
) -> None:
    run_scanner(own_nats, **NEXT)
    own_caller.put(BUCKET, key(), gateway_entry(server, gateway_tag("a", 0)))
    wire.until(lambda: tags(own_caller) == {"a"}, "it is subscribed")

    async def lose() -> None:
        jetstream = own_caller.client.jetstream()
        for consumer in await jetstream.consumers_info(f"KV_{BUCKET}"):
            await jetstream.delete_consumer(f"KV_{BUCKET}", consumer.name)

    own_caller.do(lose())
    own_caller.put(BUCKET, key(), gateway_entry(server, gateway_tag("b", 0)))
    wire.until(lambda: tags(own_caller) == {"b"}, "the change is seen")


def test_a_kept_request_that_an_entry_has_replaced_is_not_restored(
    run_scanner: Run, caller: Caller, server: holdfast.Server
) -> None:
    first = run_scanner(**NEXT)
    request = gateway_entry(server, gateway_tag("a", 0))
    assert caller.request("modbus.subscribe", request)["success"]
    first.stop()
    caller.put(BUCKET, key(), gateway_entry(server, gateway_tag("b", 0)))
    second = run_scanner(**NEXT)
    wire.until(lambda: tags(caller) == {"b"}, "the entry is subscribed")
    wire.until(
        lambda: not any("subscription" in each for each in caller.kept(KEPT)),
        "the request is not kept any more",
    )
    second.stop()
    caller.forget(BUCKET)


def test_requests_work_without_jetstream(
    run_scanner: Run, tmp_path: Path, server: holdfast.Server, caplog: pytest.LogCaptureFixture
) -> None:
    plain = NatsServer(tmp_path, jetstream=False)
    try:
        run_scanner(plain, **NEXT)
        with Caller(plain.url) as caller:
            request = gateway_entry(server, gateway_tag("a", 0))
            assert caller.request("modbus.subscribe", request)["success"]
            wire.until(lambda: variables(caller) == {"a": (0, "good")}, "it is polled")
        found = {each["bucket"]: each["reason"] for each in logged(caplog, "bucket_not_watched")}
        reason = "JetStream is not enabled on the server or for this account"
        assert found == {BUCKET: reason, ENABLED: reason}
    finally:
        plain.kill()


# Entries that are refused.


@pytest.mark.usefixtures("scanner")
@pytest.mark.parametrize(
    ("value", "reason"),
    [
        (b"{", "not JSON"),
        (b"", "not JSON"),
        (b"[]", "Expected `object`"),
        (b'{"subscriberId":"gateway-gateway","deviceId":"plc1","tags":[]}', "host is missing"),
        (b'{"deviceId":"plc1","host":"127.0.0.1","tags":[]}', "subscriberId"),
    ],
)
def test_a_malformed_entry_is_refused_and_logged_once(
    caller: Caller,
    server: holdfast.Server,
    caplog: pytest.LogCaptureFixture,
    value: bytes,
    reason: str,
) -> None:
    caller.put(BUCKET, key(), value)
    wire.until(lambda: key() in refused(caller), "it is refused")
    assert reason in refused(caller)[key()]
    caller.put(BUCKET, key(), value)
    caller.put(BUCKET, key("plc2"), gateway_entry(server, gateway_tag("a", 0), device="plc2"))
    wire.until(lambda: tags(caller, "plc2") == {"a"}, "another entry is subscribed")
    [entry] = logged(caplog, "entry_refused")
    assert (entry["key"], entry["bucket"]) == (key(), BUCKET)
    caller.delete(BUCKET, key())
    wire.until(lambda: refused(caller) == {}, "it is forgotten")


@pytest.mark.usefixtures("scanner")
@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        (gateway_tag("bad", 70_000), "address"),
        (gateway_tag("bad", 0, "decimal"), "decimal"),
        (gateway_tag("bad", 0, function="register"), "functionCode"),
        (gateway_tag("bad", 0, order="middle"), "middle"),
        (gateway_tag("go.od", 5), "same name in subjects"),
        (gateway_tag("go_od", 5), "'go_od' is uint16 ABCD at holding 5, and already uint16 ABCD"),
    ],
)
def test_a_changed_entry_that_is_refused_ends_its_former_subscription(
    caller: Caller, server: holdfast.Server, wrong: dict[str, Any], reason: str
) -> None:
    caller.put(BUCKET, key(), gateway_entry(server, gateway_tag("go_od", 0)))
    wire.until(lambda: variables(caller) == {"go_od": (0, "good")}, "it is subscribed")
    caller.put(BUCKET, key(), gateway_entry(server, gateway_tag("go_od", 0), wrong))
    wire.until(lambda: key() in refused(caller), "it is refused")
    assert reason in refused(caller)[key()]
    assert devices(caller) == {}
    found = caller.request("modbus.variables", b"")
    assert {each["variableId"] for each in found} == {"go_od", wrong["id"]}
    assert len(found) == len({"go_od", wrong["id"]})
    assert {(each["value"], each["quality"]) for each in found} == {(None, "bad")}
    assert {each["error"] for each in found} == {refused(caller)[key()]}
    caller.put(BUCKET, key(), gateway_entry(server, gateway_tag("go_od", 0)))
    wire.until(lambda: variables(caller) == {"go_od": (0, "good")}, "it is corrected")
    assert refused(caller) == {}


@pytest.mark.usefixtures("scanner")
def test_the_key_and_the_value_must_name_the_same_subscription(
    caller: Caller, server: holdfast.Server
) -> None:
    caller.put(BUCKET, key("plc2"), gateway_entry(server, gateway_tag("a", 0)))
    wire.until(lambda: key("plc2") in refused(caller), "it is refused")
    assert refused(caller)[key("plc2")] == (
        "the key is 'gateway-gateway.plc2', allowed: SUBSCRIBER.DEVICE of its value: "
        "'gateway-gateway.plc1'"
    )
    assert devices(caller) == {}


@pytest.mark.usefixtures("scanner")
def test_an_entry_that_another_one_refuses_is_carried_out_when_that_one_changes(
    caller: Caller, server: holdfast.Server
) -> None:
    caller.put(
        BUCKET, key(gateway="one"), gateway_entry(server, gateway_tag("a", 0), gateway="one")
    )
    wire.until(lambda: tags(caller) == {"a"}, "one is subscribed")
    two = gateway_entry(server, gateway_tag("a", 5), gateway="two")
    caller.put(BUCKET, key(gateway="two"), two)
    wire.until(lambda: key(gateway="two") in refused(caller), "the other one is refused")
    assert "gateway-one must unsubscribe first" in refused(caller)[key(gateway="two")]
    one = gateway_entry(server, gateway_tag("a", 5), gateway="one")
    caller.put(BUCKET, key(gateway="one"), one)
    wire.until(lambda: refused(caller) == {}, "both agree")
    [device] = devices(caller).values()
    assert {each["id"] for each in device["subscribers"]} == {"gateway-one", "gateway-two"}


def test_an_entry_whose_host_is_not_found_is_tried_again(
    run_scanner: Run, caller: Caller, server: holdfast.Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    running = run_scanner(**NEXT)
    address = allowed_of(running.scanner).address

    async def not_found(*_: Any, **__: Any) -> Any:
        raise Refused("host plc.example: no such name")

    monkeypatch.setattr(allowed_of(running.scanner), "address", not_found)
    caller.put(BUCKET, key(), gateway_entry(server, gateway_tag("a", 0)))
    wire.until(lambda: key() in refused(caller), "it is refused")
    monkeypatch.setattr(allowed_of(running.scanner), "address", address)
    wire.until(lambda: tags(caller) == {"a"}, "it is subscribed")
    assert refused(caller) == {}
    running.stop()
    caller.forget(BUCKET)


@pytest.mark.usefixtures("scanner")
def test_a_request_does_not_change_the_subscription_of_an_entry(
    caller: Caller, server: holdfast.Server
) -> None:
    caller.put(BUCKET, key(), gateway_entry(server, gateway_tag("a", 0)))
    wire.until(lambda: tags(caller) == {"a"}, "it is subscribed")
    reason = (
        "the subscription of 'gateway-gateway' to 'plc1' is the entry 'gateway-gateway.plc1' of "
        "the bucket scanner_config_modbus: change that entry"
    )
    request = gateway_entry(server, gateway_tag("b", 1))
    answer = {"success": False, "error": reason}
    assert caller.request("modbus.subscribe", request) == answer
    left = leaving("a", subscriberId="gateway-gateway")
    assert caller.request("modbus.unsubscribe", left) == answer
    assert tags(caller) == {"a"}


@pytest.mark.usefixtures("scanner")
def test_an_entry_takes_over_the_subscription_of_a_request(
    caller: Caller, server: holdfast.Server
) -> None:
    request = gateway_entry(server, gateway_tag("a", 0))
    assert caller.request("modbus.subscribe", request)["success"]
    assert any("subscription" in each for each in caller.kept(KEPT))
    caller.put(BUCKET, key(), gateway_entry(server, gateway_tag("b", 0)))
    wire.until(lambda: tags(caller) == {"b"}, "it is replaced")
    wire.until(
        lambda: not any("subscription" in each for each in caller.kept(KEPT)),
        "it is not kept twice",
    )


@pytest.mark.usefixtures("scanner")
def test_a_refused_entry_does_not_end_the_subscription_of_a_request(
    caller: Caller, server: holdfast.Server
) -> None:
    other = subscription(server, tag("a", 0), subscriberId="hmi")
    assert caller.request("modbus.subscribe", other)["success"]
    request = gateway_entry(server, gateway_tag("a", 0))
    assert caller.request("modbus.subscribe", request)["success"]
    caller.put(BUCKET, key(), gateway_entry(server, gateway_tag("a", 7)))
    wire.until(lambda: key() in refused(caller), "it is refused")
    [device] = devices(caller).values()
    assert {each["id"] for each in device["subscribers"]} == {"hmi", "gateway-gateway"}
    assert [each["address"] for each in device["tags"]] == [0]


@pytest.mark.usefixtures("scanner")
def test_an_entry_has_no_ttl(caller: Caller, server: holdfast.Server) -> None:
    host, port = server.address
    value = {
        "subscriberId": "gateway-gateway",
        "deviceId": "plc1",
        "host": host,
        "port": port,
        "tags": [gateway_tag("a", 0)],
        "ttl": 5,
    }
    caller.put(BUCKET, key(), value)
    wire.until(lambda: key() in refused(caller), "it is refused")
    assert refused(caller)[key()] == "ttl is given; an entry lasts until it is deleted"


# Its API.


@pytest.mark.usefixtures("scanner")
def test_commands_are_json(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    entry = gateway_entry(
        server,
        gateway_tag("speed", 0),
        gateway_tag("set.point", 1, "float32"),
        gateway_tag("running", 0, function="coil"),
    )
    caller.put(BUCKET, key(), entry)
    wire.until(lambda: len(tags(caller)) == 3, "it is subscribed")
    caller.publish("modbus.command.running", command(True))
    wire.until(lambda: memory.read("coils", 0, 1) == [1], "the coil is on")
    caller.publish("modbus.command.speed", command(1450))
    wire.until(lambda: memory.read("holding_registers", 0, 1) == [1450], "it is written")
    # The gateway does not change the id of a tag in the subject of a command.
    caller.publish("modbus.command.set.point", command(21.5))
    wire.until(lambda: memory.read("holding_registers", 1, 2) == [0x41AC, 0], "it is written")
    assert caller.request("modbus.command.set_point", command(1)) == {"success": True}
    assert caller.request("modbus.command.plc1.speed", command(7)) == {"success": True}
    # Its Sparkplug bridge sends the value alone.
    assert caller.request("modbus.command.speed", "8") == {"success": True}
    assert memory.read("holding_registers", 0, 3) == [8, 0x3F80, 0]


@pytest.mark.usefixtures("scanner")
@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (command(12.7), "'12.7' is not a valid uint16"),
        (command(70_000), "70000 is outside 0 to 65535 of uint16"),
        (command(True), "'true' is not a valid uint16, allowed: a JSON number"),
        (command(None), "the value is null, allowed: numbers, booleans, texts and arrays"),
        (command({"a": 1}), "the value is an object, allowed: numbers, booleans, texts and"),
        ('{"values":1}', "Object missing required field `value`, allowed: "),
        ("seven", "not JSON: "),
        ('{"value":', "not JSON: "),
    ],
)
def test_a_command_without_a_fitting_value_is_refused(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory, payload: str, reason: str
) -> None:
    memory.write("holding_registers", 0, [5])
    caller.put(BUCKET, key(), gateway_entry(server, gateway_tag("speed", 0)))
    wire.until(lambda: tags(caller) == {"speed"}, "it is subscribed")
    answer = caller.request("modbus.command.speed", payload)
    assert not answer["success"]
    assert answer["error"].startswith(reason)
    assert memory.read("holding_registers", 0, 1) == [5]


@pytest.mark.usefixtures("scanner")
def test_a_command_to_a_tag_of_two_devices_is_refused(
    caller: Caller, server: holdfast.Server
) -> None:
    for device in ("plc1", "plc2"):
        entry = gateway_entry(server, gateway_tag("speed", 0), device=device)
        caller.put(BUCKET, key(device), entry)
    wire.until(lambda: len(devices(caller)) == 2, "both are subscribed")
    answer = caller.request("modbus.command.speed", command(1))
    assert answer["error"] == "'speed' is ambiguous: plc1.speed, plc2.speed"


@pytest.mark.usefixtures("scanner")
def test_the_scanner_can_be_disabled(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    entry = gateway_entry(server, gateway_tag("a", 0), rate=50)
    caller.put(BUCKET, key(), entry)
    wire.until(lambda: variables(caller) == {"a": (0, "good")}, "it is read")
    status = caller.listen("modbus.status.plc1")
    caller.put(ENABLED, "modbus", enabled(False))
    status.until(lambda each: each.get("error") == "the scanner is disabled", "it is offline")
    wire.until(lambda: server.counters()["connections"]["open"] == 0, "the connection is closed")
    assert variables(caller) == {"a": (0, "bad")}
    answer = caller.request("modbus.command.a", command(1))
    assert answer["error"] == "not written: the scanner is disabled"
    assert caller.request("modbus.browse", b"")["service"]["enabled"] is False
    heartbeat = caller.kept("service_heartbeats")["modbus"]
    assert heartbeat["metadata"].keys() == {"deviceCount", "tagCount", "version", "enabled"}
    wire.until(
        lambda: caller.kept("service_heartbeats")["modbus"]["metadata"]["enabled"] is False,
        "the heartbeat has it",
    )
    # Subscriptions can change meanwhile.
    other = gateway_entry(server, gateway_tag("b", 1), device="plc2")
    caller.put(BUCKET, key("plc2"), other)
    wire.until(lambda: len(devices(caller)) == 2, "another device is known")
    assert variables(caller)["b"] == (None, "uncertain")
    memory.write("holding_registers", 0, [9])
    caller.put(ENABLED, "modbus", enabled(True))
    wire.until(lambda: variables(caller) == {"a": (9, "good"), "b": (0, "good")}, "both are read")


@pytest.mark.usefixtures("scanner")
def test_a_deleted_or_malformed_state_does_not_disable_the_scanner(
    caller: Caller, server: holdfast.Server, caplog: pytest.LogCaptureFixture
) -> None:
    caller.put(BUCKET, key(), gateway_entry(server, gateway_tag("a", 0), rate=50))
    caller.put(ENABLED, "modbus", enabled(False))
    caller.put(ENABLED, "snmp", enabled(True))
    wire.until(lambda: logged(caplog, "scanner_disabled") != [], "it is disabled")
    caller.delete(ENABLED, "modbus")
    wire.until(lambda: variables(caller) == {"a": (0, "good")}, "it is enabled")
    caller.put(ENABLED, "modbus", '{"enabled":"no"}')
    wire.until(lambda: logged(caplog, "enabled_entry_malformed") != [], "it is logged")
    assert caller.request("modbus.browse", b"")["service"]["enabled"] is True


def test_devices_can_go_and_move_while_the_scanner_is_disabled(
    caller: Caller, server: holdfast.Server, serve: Serve, scanner: Running
) -> None:
    for device in ("plc1", "plc2", "plc3"):
        entry = gateway_entry(server, gateway_tag(device, 0), device=device, rate=50)
        caller.put(BUCKET, key(device), entry)
    good = dict.fromkeys(("plc1", "plc2", "plc3"), (0, "good"))
    wire.until(lambda: variables(caller) == good, "all are read")
    caller.put(ENABLED, "modbus", enabled(False))
    wire.until(lambda: server.counters()["connections"]["open"] == 0, "the connection is closed")
    caller.delete(BUCKET, key("plc1"))
    wire.until(lambda: devices(caller).keys() == {"plc2", "plc3"}, "one is gone")
    memory = holdfast.Memory(holding_registers=1)
    memory.write("holding_registers", 0, [7])
    other = serve({1: memory})
    entry = gateway_entry(other, gateway_tag("plc2", 0), device="plc2", rate=50)
    caller.put(BUCKET, key("plc2"), entry)
    url = f"tcp://127.0.0.1:{other.address[1]}"
    wire.until(lambda: devices(caller)["plc2"]["url"] == url, "another has moved")
    caller.put(ENABLED, "modbus", enabled(True))
    now = {"plc2": (7, "good"), "plc3": (0, "good")}
    wire.until(lambda: variables(caller) == now, "the others are read")
    polled = polling_of(scanner.scanner)._devices.values()
    assert set(polled) == set(registry_of(scanner.scanner).devices.values())


def test_a_disabled_scanner_does_not_poll_when_it_starts(
    run_scanner: Run, caller: Caller, server: holdfast.Server
) -> None:
    caller.put(ENABLED, "modbus", enabled(False))
    caller.put(BUCKET, key(), gateway_entry(server, gateway_tag("a", 0), rate=50))
    running = run_scanner(**NEXT)
    assert caller.request("modbus.browse", b"")["service"]["enabled"] is False
    wire.until(lambda: variables(caller) == {"a": (None, "uncertain")}, "it is subscribed")
    assert server.counters()["connections"]["accepted"] == 0
    running.stop()
    caller.forget(BUCKET)
    caller.forget(ENABLED)


# Its PLC library.


@pytest.mark.usefixtures("scanner")
def test_its_plc_library_reads_and_writes(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 0, [7, 0xE979, 0x42F6])
    memory.write("discrete_inputs", 3, [1])
    data = caller.listen("*.data.plc1.Level_1")
    request = library_subscribe(
        server,
        library_register("Level.1", 1, "float32", order="CDAB"),
        library_register("speed", 0),
        library_register("contact", 3, "boolean", function=2),
    )
    assert caller.request("modbus.subscribe", request) == {"success": True, "count": 3}
    assert data.next()["value"] == 123.45600128173828
    wire.until(lambda: variables(caller).get("contact") == (True, "good"), "all are read")
    caller.publish(*library_command("speed", 12))
    wire.until(lambda: memory.read("holding_registers", 0, 1) == [12], "it is written")
    caller.publish(*library_command("Level.1", 1))
    wire.until(lambda: memory.read("holding_registers", 1, 2) == [0, 0x3F80], "it is written")
    # A program that starts again with other registers replaces them.
    request = library_subscribe(server, library_register("speed", 0))
    assert caller.request("modbus.subscribe", request) == {"success": True, "count": 1}
    assert tags(caller) == {"speed"}


@pytest.mark.usefixtures("scanner")
def test_what_only_the_first_generation_has_is_not_here(
    caller: Caller,
    server: holdfast.Server,
    memory: holdfast.Memory,
    caplog: pytest.LogCaptureFixture,
) -> None:
    memory.write("holding_registers", 0, struct.unpack(">4H", struct.pack(">d", 123.456))[::-1])
    data = caller.listen("modbus.data.plc1.total")
    found = [tag("total", 0, "float64", byteOrder="CDAB"), tag("a", 4, byteOrder="BADC")]
    for _ in range(2):  # It gets all values again with each request.
        assert caller.request("modbus.subscribe", subscription(server, *found))["success"]
        assert data.next()["value"] == 123.456
    assert logged(caplog, "byte_order_differs") == []
    left = {"deviceId": "plc1", "subscriberId": "hmi"}
    assert caller.request("modbus.unsubscribe", left) == {"success": True}
    assert devices(caller) == {}


def normalized(data: bytes) -> bytes:
    return msgspec.json.encode(tentacle_next.normalized(msgspec.json.decode(data)))


def test_missing_keys_of_a_tag_have_its_defaults() -> None:
    data = b'{"deviceId":"a","tags":[{"id":"t","functionCode":"","datatype":""},{"id":"u"},7]}'
    assert normalized(data) == (
        b'{"deviceId":"a","tags":[{"id":"t","functionCode":"holding","datatype":"uint16"},'
        b'{"id":"u","functionCode":"holding","datatype":"uint16"},7]}'
    )


def test_an_empty_list_of_go_has_no_tags() -> None:
    assert normalized(b'{"tags":null}') == b'{"tags":[]}'


def test_an_unknown_number_of_a_function_is_not_guessed() -> None:
    data = b'{"registers":[{"tag":"a","functionCode":16},7]}'
    assert normalized(data) == (b'{"tags":[{"id":"a","functionCode":16,"datatype":"uint16"},7]}')


def test_a_request_that_is_too_large_is_refused() -> None:
    with pytest.raises(Refused, match="has 13 bytes, allowed: 12"):
        decode_lenient(
            b'{"tags":null}', SubscribeRequest, 12, Adjustments(), tentacle_next.normalized
        )


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b'{"value":true}', "true"),
        (b'{"tag":"a","value":12.50}', "12.50"),
        (b'{"value":18446744073709551615}', "18446744073709551615"),
        (b'{"value":"on \\u00e4"}', "on ä"),
        (b'{"value":[1,2]}', "[1,2]"),
        (b" 7 ", " 7 "),
        (b'"on"', "on"),
    ],
)
def test_the_text_of_a_value_is_exact(data: bytes, text: str) -> None:
    assert DIALECTS["tentacle-next"].command_text(data) == text


# The other dialect.


def test_the_default_dialect_watches_no_bucket(
    run_scanner: Run, caller: Caller, server: holdfast.Server
) -> None:
    running = run_scanner()
    caller.put(BUCKET, key(), gateway_entry(server, gateway_tag("a", 0)))
    data = caller.listen("modbus.data.>")
    assert caller.request("modbus.subscribe", subscription(server, tag("b", 1)))["success"]
    assert data.next()["variableId"] == "b"
    assert devices(caller).keys() == {"plc1"}
    assert tags(caller) == {"b"}
    assert "enabled" not in caller.request("modbus.browse", b"")["service"]
    running.stop()
    caller.forget(BUCKET)

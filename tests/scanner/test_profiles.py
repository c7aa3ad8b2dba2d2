"""Tags that requests name by a profile of the configuration: scale, markers, limits of writes."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.scanner.jetstream import entries, restore, store
from holdfast.scanner.jetstream.store import BUCKET
from holdfast.scanner.messages.types import SubscribeRequest, TagRequest
from holdfast.tags import Tag, TagList
from holdfast.tags.scale import RegisterScale
from holdfast.values import encode
from support import wire
from support.nats_bus import leaving, logged, subscription, tag

if TYPE_CHECKING:
    import holdfast
    from support.brokers import NatsServer
    from support.nats_bus import Caller, Run, Running

PROFILE = TagList(
    [
        Tag("water", "holding_registers", 0, "int16", scale=0.1, null=frozenset([-1]), unit="°C"),
        Tag("setpoint", "holding_registers", 1, scale=0.1, writable=True, min=5, max=30),
        Tag("mode", "holding_registers", 2, states={0: "off", 1: "eco"}, writable=True),
        Tag("open", "coils", 3),
        Tag("flow", "holding_registers", 4, "float32"),
        Tag("flows", "holding_registers", 4, "float32[2]", scale=0.1),
    ]
)
METER = TagList(
    [
        Tag("power", "holding_registers", 0, "int16", scale=RegisterScale("exponent", "sf")),
        Tag(
            "limit",
            "holding_registers",
            1,
            scale=RegisterScale("exponent", "sf"),
            writable=True,
        ),
        Tag("sf", "holding_registers", 50, "int16"),
    ]
)


@pytest.fixture(autouse=True)
def scanner(run_scanner: Run) -> None:
    run_scanner(profiles={"heater": PROFILE, "meter": METER}, writes="tags")


def first(data: Any, count: int) -> dict[str, Any]:
    found: dict[str, Any] = {}
    while len(found) < count:
        message = data.next()
        found[message["variableId"]] = message["value"]
    return found


def test_the_values_of_a_profile_are_scaled(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 0, [215, 175, 1])
    memory.write("holding_registers", 4, encode([230.1, math.inf], "float32[2]"))
    data = caller.listen("modbus.data.plc1")
    request = subscription(server, tag("raw", 0), profile="heater")
    request["tags"].append(tag("raw_flow", 4, datatype="float32"))
    assert caller.request("modbus.subscribe", request) == {"success": True, "count": 8}
    values: dict[str, Any] = {"raw": 215, "water": 21.5, "setpoint": 17.5, "mode": 1, "open": False}
    # A tag of a profile has the digits of its type, any other is the number in the registers.
    values |= {"flow": 230.1, "flows": [23.01, None], "raw_flow": 230.10000610351562}
    assert first(data, 8) == values
    memory.write("holding_registers", 0, [65535])
    wire.until(lambda: first(data, 8)["water"] is None, "the marker is no value")
    [device] = caller.request("modbus.browse", b"")["devices"]
    shown = {each["id"]: (each.get("profile"), each.get("unit")) for each in device["tags"]}
    assert shown["water"] == ("heater", "°C")
    assert shown["raw"] == (None, None)
    latest = caller.request("modbus.variables", b"")
    assert latest
    caller.request("modbus.unsubscribe", leaving())


def test_commands_are_scaled_and_have_the_limits_of_the_profile(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    caller.request("modbus.subscribe", subscription(server, profile="heater"))
    for id, text, raw in (("setpoint", "19.5", [195, 0]), ("mode", "eco", [195, 1])):
        assert caller.request(f"modbus.command.plc1.{id}", text) == {"success": True}
        assert memory.read("holding_registers", 1, 2) == raw
    for id, text, error in (
        ("setpoint", "31", "31 is outside 5 to 30"),
        ("setpoint", "19.55", "between two values of the registers"),
        ("setpoint", "19,5", "decimal comma"),
        ("mode", "turbo", "turbo"),
        ("water", "20", "not writable"),
    ):
        answer = caller.request(f"modbus.command.plc1.{id}", text)
        assert answer["success"] is False
        assert error in answer["error"]
    assert memory.read("holding_registers", 1, 2) == [195, 1]
    caller.request("modbus.unsubscribe", leaving())


@pytest.mark.parametrize(
    "request_",
    [
        {"tags": [tag("water", 0, profile="heater")]},
        {"tags": [tag("water", 0, profile="heater")], "profile": "heater"},
        {"tags": [tag("water", 0, profile="heater", writable=True)]},
    ],
)
def test_a_request_does_not_make_a_tag_of_a_profile_writable(
    caller: Caller, server: holdfast.Server, request_: dict[str, Any]
) -> None:
    caller.request("modbus.subscribe", subscription(server) | request_)
    answer = caller.request("modbus.command.plc1.water", "20")
    assert answer == {
        "success": False,
        "error": "tag 'water' of plc1 is not writable: writable is not true in the profile heater",
    }
    [device] = caller.request("modbus.browse", b"")["devices"]
    assert {each["id"]: each["writable"] for each in device["tags"]}["water"] is False
    caller.request("modbus.unsubscribe", leaving())


@pytest.mark.parametrize(
    ("request_", "error"),
    [
        ({"profile": "pump"}, "profile is 'pump', allowed: heater, meter"),
        ({"tags": [tag("x", 0, profile="heater")]}, "tags[0]: the profile heater has no tag 'x'"),
        ({"tags": [tag("x", 0, profile="y")]}, "tags[0].profile is 'y', allowed: heater, meter"),
    ],
)
def test_an_unknown_profile_refuses_the_request(
    caller: Caller, server: holdfast.Server, request_: dict[str, Any], error: str
) -> None:
    answer = caller.request("modbus.subscribe", subscription(server) | request_)
    assert answer == {"success": False, "error": error}


def test_a_subscription_to_a_profile_survives_a_restart(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory, run_scanner: Run
) -> None:
    memory.write("holding_registers", 0, [215, 175, 1])
    other: dict[str, Any] = {"prefix": "line2", "profiles": {"heater": PROFILE}}
    running = run_scanner(**other)
    request = subscription(server, profile="heater")
    assert caller.request("line2.subscribe", request)["success"] is True
    running.stop()
    data = caller.listen("line2.data.plc1")
    run_scanner(**other)
    assert first(data, 4) == {"water": 21.5, "setpoint": 17.5, "mode": 1, "open": False}
    answer = caller.request("line2.command.plc1.setpoint", "4")
    assert "4 is outside 5 to 30" in answer["error"]


@pytest.mark.parametrize("part_bytes", [1, entries.MAX_PART_BYTES])
def test_a_kept_subscription_has_the_tags_that_its_profile_has_now(
    caller: Caller,
    server: holdfast.Server,
    run_scanner: Run,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
    part_bytes: int,
) -> None:
    monkeypatch.setattr(entries, "MAX_PART_BYTES", part_bytes)
    other = TagList(
        [
            Tag("water", "holding_registers", 5, "int16", description="now described"),
            Tag("setpoint", "holding_registers", 1, scale=0.1, writable=True, min=5, max=30),
            Tag("operation", "holding_registers", 2, states={0: "off", 1: "eco"}, writable=True),
            Tag("open", "coils", 3),
        ]
    )

    def running(profile: TagList) -> Running:
        return run_scanner(prefix="line2", profiles={"heater": profile}, writes="explicit")

    def tags() -> dict[str, dict[str, Any]]:
        found = caller.request("line2.browse", b"")["devices"]
        return {each["deviceId"]: {tag["id"]: tag for tag in each["tags"]} for each in found}

    first = running(PROFILE)
    mode, own = tag("mode", 0, profile="heater"), tag("own", 9)
    replaced = tag("open", 3, "boolean", functionCode="coil")
    for request in (
        subscription(server, own, replaced, profile="heater"),
        subscription(server, own, mode, deviceId="plc2"),
        subscription(server, mode, deviceId="plc3"),
    ):
        assert caller.request("line2.subscribe", request)["success"]
    before = tags()
    first.stop()
    second = running(PROFILE)
    assert tags() == before
    second.stop()
    status = caller.listen("line2.status.plc3")
    third = running(other)
    assert status.next() | {"timestamp": 0} == {
        "deviceId": "plc3",
        "state": "offline",
        "failures": 0,
        "error": "tags[0]: the profile heater has no tag 'mode'",
        "timestamp": 0,
    }
    now = tags()
    assert {id: set(found) for id, found in now.items()} == {
        "plc1": {"own", "open", "water", "setpoint", "operation"},
        "plc2": {"own"},
    }
    for id in ("own", "open", "setpoint"):
        assert now["plc1"][id] == before["plc1"][id]
    water = now["plc1"]["water"]
    assert (water["address"], water["description"]) == (5, "now described")
    assert now["plc1"]["operation"]["writable"]
    lost = {
        (each["device"], tag)
        for each in logged(caplog, "tags_not_restored")
        for tag in each["tags"].split(", ")
    }
    assert lost == {("plc1", "mode"), ("plc1", "flow"), ("plc1", "flows"), ("plc2", "mode")}

    # A subscription that has left a tag of its profile stays as it is.
    assert caller.request("line2.unsubscribe", leaving("water"))["success"]
    third.stop()
    running(PROFILE)
    assert set(tags()["plc1"]) == {"own", "open", "setpoint"}


def test_a_pending_subscription_that_leaves_a_tag_of_its_profile_has_not_all_of_it() -> None:
    tags = [TagRequest("a", 0, "holding", "int16", profile="p"), TagRequest("b", 1, "coil", "bool")]
    request = SubscribeRequest("plc1", "hmi", tags, profile="p")
    [own_left] = entries.without([request], {"b"}, {})
    assert (own_left.profile, own_left.tags) == ("p", tags[:1])
    [profile_left] = entries.without([request], {"a"}, {})
    assert (profile_left.profile, profile_left.tags) == (None, tags[1:])
    assert entries.without([request], {"a", "b"}, {}) == []
    parts = [SubscribeRequest("plc1", "hmi", [each], profile="p") for each in tags]
    [second_left] = entries.without(parts, {"a"}, {})
    assert (second_left.profile, second_left.tags) == (None, tags[1:])


SMALL = TagList([Tag("a", "holding_registers", 0, writable=True, description="first")])
GAINED = TagList([*SMALL, Tag("b", "holding_registers", 1)])


@pytest.mark.parametrize("is_read", [True, False])
def test_a_gained_tag_that_is_left_before_the_subscription_is_restored_does_not_return(
    own_caller: Caller,
    own_nats: NatsServer,
    server: holdfast.Server,
    run_scanner: Run,
    monkeypatch: pytest.MonkeyPatch,
    is_read: bool,
) -> None:
    monkeypatch.setattr(store, "MAX_RETRY_S", 0.1)
    request = subscription(server, profile="small")
    first = run_scanner(own_nats, profiles={"small": SMALL}, writes="explicit")
    assert own_caller.request("modbus.subscribe", request)["success"]
    before = tags_of(own_caller)
    first.stop()
    options: dict[str, Any] = {"profiles": {"small": GAINED}, "writes": "explicit"}
    if is_read:
        second = run_scanner(own_nats, allow=("192.0.2.0/24",), **options)
        assert own_caller.request("modbus.unsubscribe", leaving("b"))["success"]
    else:
        jetstream = own_nats.restarted()
        second = run_scanner(own_nats, **options)
        assert own_caller.request("modbus.subscribe", request)["success"]
        assert own_caller.request("modbus.unsubscribe", leaving("b"))["success"]
        own_nats.restarted(*jetstream)
        wire.until(lambda: second.serves, "it is connected again")
        key, unknown = "modbus.subscription.hmi.plc1.0", {"profile": ""}
        wire.until(
            lambda: "profile" not in own_caller.kept(BUCKET).get(key, unknown), "it is stored"
        )
    second.stop()
    run_scanner(own_nats, **options)
    assert tags_of(own_caller) == before


def tags_of(caller: Caller) -> dict[str, dict[str, Any]]:
    [found] = caller.request("modbus.browse", b"")["devices"]
    return {tag["id"]: tag for tag in found["tags"]}


def test_a_pending_subscription_with_another_profile_keeps_what_its_own_sets(
    caller: Caller, server: holdfast.Server, run_scanner: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(restore, "MAX_RETRY_S", 0.1)
    more: dict[str, Any] = {"profiles": {"small": SMALL, "heater": PROFILE}}
    more |= {"prefix": "line2", "writes": "explicit"}

    def tags() -> dict[str, dict[str, Any]]:
        found = caller.request("line2.browse", b"")["devices"]
        return {tag["id"]: tag for each in found for tag in each["tags"]}

    first = run_scanner(**more)
    request = subscription(server, profile="small", host="127.0.0.2")
    assert caller.request("line2.subscribe", request)["success"]
    first.stop()
    run_scanner(allow=("127.0.0.1/32",), **more)
    request = subscription(server, profile="heater", host="127.0.0.1")
    assert caller.request("line2.subscribe", request)["success"]
    wire.until(lambda: "a" in tags(), "it is carried out")
    found = tags()["a"]
    assert (found["writable"], found["description"]) == (True, "first")


def test_a_tag_that_was_read_only_in_a_whole_profile_can_become_writable(
    caller: Caller, server: holdfast.Server, run_scanner: Run
) -> None:
    def running(*, writable: bool) -> Running:
        a = Tag("a", "holding_registers", 0, writable=writable)
        small = TagList([a, Tag("b", "holding_registers", 1)])
        return run_scanner(prefix="line2", profiles={"small": small})

    first = running(writable=False)
    request = subscription(server, profile="small")
    assert caller.request("line2.subscribe", request)["success"]
    assert caller.request("line2.unsubscribe", leaving("b"))["success"]
    first.stop()
    running(writable=True)
    assert caller.request("line2.command.plc1.a", "5") == {"success": True}


@pytest.mark.parametrize("part_bytes", [1, entries.MAX_PART_BYTES])
@pytest.mark.parametrize("keeps", [True, False])
def test_a_tag_that_a_profile_gains_ends_no_subscription(
    caller: Caller,
    server: holdfast.Server,
    run_scanner: Run,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
    part_bytes: int,
    keeps: bool,
) -> None:
    monkeypatch.setattr(entries, "MAX_PART_BYTES", part_bytes)
    now = TagList([*PROFILE, Tag("level", "holding_registers", 8, "int16")])

    def running(profile: TagList, before: Running | None = None) -> Running:
        if before is not None:
            before.stop()
        former = () if before is None or keeps else tuple(before.scanner.stored_requests())
        return run_scanner(
            former=former,
            prefix="line2",
            profiles={"heater": profile},
            writes="explicit",
            keep_subscriptions=keeps,
        )

    def tags() -> dict[str, dict[str, Any]]:
        [found] = caller.request("line2.browse", b"")["devices"]
        return {tag["id"]: tag for tag in found["tags"]}

    open_ = tag("open", 3, "boolean", functionCode="coil")
    first = running(PROFILE)
    for request in (
        subscription(server, tag("own", 9), open_, profile="heater"),
        subscription(server, tag("level", 7), open_, subscriberId="log"),
    ):
        assert caller.request("line2.subscribe", request)["success"]
    before = tags()
    second = running(now, first)
    assert tags() == before
    [left] = logged(caplog, "tags_not_restored")
    assert (left["device"], left["subscriber"], left["tags"]) == ("plc1", "hmi", "level")
    assert left["reason"].startswith("tag 'level' of plc1 already has another definition")
    assert not logged(caplog, "not_restored")
    # It has the tag when the cause of the refusal is gone.
    assert caller.request("line2.unsubscribe", leaving("level", subscriberId="log"))["success"]
    third = running(now, second)
    gained = tags()
    assert gained.pop("level")["profile"] == "heater"
    del before["level"]
    assert gained == before
    third.stop()


def test_a_scale_in_a_register_is_that_of_the_same_scan(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write_many([("holding_registers", 0, [432, 7]), ("holding_registers", 50, [1])])
    data = caller.listen("modbus.data.plc1")
    request = subscription(server, profile="meter")
    assert caller.request("modbus.subscribe", request) == {"success": True, "count": 3}
    assert first(data, 3) == {"power": 4320, "limit": 70, "sf": 1}
    memory.write_many([("holding_registers", 0, [4320, 70]), ("holding_registers", 50, [0])])
    wire.until(lambda: first(data, 3) == {"power": 4320, "limit": 70, "sf": 0}, "the new scale")
    [device] = caller.request("modbus.browse", b"")["devices"]
    [block] = device["blocks"]
    assert (block["address"], block["count"], block["holes"]) == (0, 51, 48)
    refused = caller.request("modbus.command.plc1.limit", b"80")
    assert "the scale is in holding_registers 50" in refused["error"]
    memory.write("holding_registers", 50, [0x8000])
    wire.until(lambda: first(data, 3)["power"] is None, "no valid scale")
    [device] = caller.request("modbus.browse", b"")["devices"]
    errors = {each["id"]: each.get("error") for each in device["tags"]}
    assert "10^-32768" in errors["power"]
    latest = {each["variableId"]: each for each in caller.request("modbus.variables", b"")}
    assert (latest["power"]["value"], latest["power"]["quality"]) == (None, "bad")
    caller.request("modbus.unsubscribe", leaving())

"""The messages of tentacle-plc and tentacle-gateway, played against the scanner."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast import _core
from holdfast.scanner.dialects import DIALECTS
from holdfast.scanner.settings import Settings
from holdfast.scanner.subscriptions.request_rules import Defaults
from support import wire
from support.nats_bus import leaving, logged, subscription, tag
from support.tentacle import (
    gateway_tag,
    plc_subscribe,
    plc_tag,
    plc_unsubscribe,
    scanner_tag,
    subject_part,
    text,
)

if TYPE_CHECKING:
    from support.nats_bus import Caller, Inbox, Run
    from support.running import Serve


def device(caller: Caller, id: str) -> Any:
    [found] = caller.request("modbus.browse", {"deviceId": id})["devices"]
    return found


def connections(server: holdfast.Server) -> int:
    """How many are open."""
    counters = server.counters()
    assert "connections" in counters
    return counters["connections"]["open"]


def values(data: Inbox, *ids: str) -> dict[str, Any]:
    """The next values of these tags."""
    found: dict[str, Any] = {}
    while not found.keys() >= set(ids):
        message = data.next()
        found[message["variableId"]] = message["value"]
    return {id: found[id] for id in ids}


# tentacle-plc and tentacle-gateway.


@pytest.mark.usefixtures("scanner")
def test_tentacle_plc_reads_and_writes_unchanged(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 0, [7, 0x42F6, 0xE979])
    data = caller.listen(f"modbus.data.{subject_part('pump-skid')}")
    tags = [
        plc_tag("pump_speed", 0),
        plc_tag("pressure", 1, "float32"),
        plc_tag("pump_running", 0, "boolean", function="coil"),
    ]
    request = plc_subscribe(server, *tags)
    assert caller.request("modbus.subscribe", request) == {"success": True, "count": 3}
    assert values(data, "pump_speed", "pressure", "pump_running") == {
        "pump_speed": 7,
        "pressure": 123.45600128173828,
        "pump_running": False,
    }

    # String(newValue), without a reply subject.
    caller.publish("modbus.command.pump_running", "true")
    caller.publish("modbus.command.pump_speed", "1450")
    caller.publish("modbus.command.pressure", "21.5")
    wire.until(lambda: memory.read("coils", 0, 1) == [1], "the coil is on")
    wire.until(lambda: memory.read("holding_registers", 0, 3) == [1450, 0x41AC, 0], "written")

    left = plc_unsubscribe("pump_speed", "pressure", "pump_running")
    assert caller.request("modbus.unsubscribe", left) == {"success": True}
    assert caller.request("modbus.browse", b"")["count"] == 0


@pytest.mark.usefixtures("scanner")
def test_tentacle_gateway_sends_big_and_uint16_for_everything(
    caller: Caller,
    server: holdfast.Server,
    memory: holdfast.Memory,
    caplog: pytest.LogCaptureFixture,
) -> None:
    memory.write("holding_registers", 3, [0x0102])
    memory.write("coils", 4, [1])
    memory.write("discrete_inputs", 5, [1])
    data = caller.listen("modbus.data.plc_1")
    tags = [
        gateway_tag("word", 3),
        gateway_tag("coil", 4, function=1),
        gateway_tag("contact", 5, function=2),
    ]
    request = plc_subscribe(server, *tags, device="plc 1", project="gateway", order="big")
    for _ in range(2):
        assert caller.request("modbus.subscribe", request) == {"success": True, "count": 3}
    found = {message["variableId"]: message for message in (data.next() for _ in range(3))}
    assert {id: (each["value"], each["datatype"]) for id, each in found.items()} == {
        "word": (0x0102, "number"),
        "coil": (True, "boolean"),
        "contact": (True, "boolean"),
    }
    assert {each["deviceId"] for each in found.values()} == {"plc 1"}
    assert logged(caplog, "datatype_ignored") == [
        {
            "subscriber": "gateway",
            "device": "plc 1",
            "found": "coil (uint16 in coils), contact (uint16 in discrete_inputs)",
        }
    ]


@pytest.mark.usefixtures("scanner")
def test_little_is_the_order_dcba(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 0, [0x0403, 0x0201])
    data = caller.listen("modbus.data.pump-skid")
    little = plc_tag("a", 0, "uint32", order="little")
    left_out = {**plc_tag("b", 0, "uint32"), "byteOrder": None}
    caller.request("modbus.subscribe", plc_subscribe(server, little, left_out, order="little"))
    assert values(data, "a", "b") == {"a": 0x01020304, "b": 0x01020304}


def words_of(value: float, *words: int) -> list[int]:
    """The registers of a float64 whose words are sent in this order."""
    found = struct.unpack(">4H", struct.pack(">d", value))
    return [found[word] for word in words]


@pytest.mark.usefixtures("scanner")
@pytest.mark.parametrize("order_of", ["tag", "device"])
def test_cdab_of_a_float64_swaps_the_words_of_each_half(
    caller: Caller,
    server: holdfast.Server,
    memory: holdfast.Memory,
    caplog: pytest.LogCaptureFixture,
    order_of: str,
) -> None:
    memory.write("holding_registers", 0, words_of(123.456, 1, 0, 3, 2))
    memory.write("holding_registers", 4, words_of(-7.25, 3, 2, 1, 0))
    data = caller.listen("modbus.data.pump-skid")
    tags = [
        plc_tag("total", 0, "float64", order="CDAB"),
        plc_tag("exact", 4, "float64", order="GHEFCDAB"),
        plc_tag("flow", 8, "float32", order="CDAB"),
    ]
    if order_of == "device":
        del tags[0]["byteOrder"], tags[2]["byteOrder"]
    request = plc_subscribe(server, *tags, order="CDAB")
    for _ in range(2):
        assert caller.request("modbus.subscribe", request) == {"success": True, "count": 3}
    assert values(data, "total", "exact") == {"total": 123.456, "exact": -7.25}
    shown = {each["id"]: each["byteOrder"] for each in device(caller, "pump-skid")["tags"]}
    assert shown == {"total": "CDABGHEF", "exact": "GHEFCDAB", "flow": "CDAB"}

    assert caller.request("modbus.command.total", "2.5e-3") == {"success": True}
    assert caller.request("modbus.command.exact", "2.5e-3") == {"success": True}
    assert memory.read("holding_registers", 0, 4) == words_of(2.5e-3, 1, 0, 3, 2)
    assert memory.read("holding_registers", 4, 4) == words_of(2.5e-3, 3, 2, 1, 0)
    assert logged(caplog, "byte_order_differs") == [
        {
            "subscriber": "my-project",
            "device": "pump-skid",
            "count": 1,
            "tags": "total",
            "note": "CDAB of a float64 is read and written as CDABGHEF, as tentacle-modbus does; "
            "write CDABGHEF, or the order that you mean, with eight letters",
        }
    ]


def test_a_restored_float64_keeps_its_order(
    run_scanner: Run, caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 0, words_of(123.456, 1, 0, 3, 2))
    first = run_scanner()
    request = plc_subscribe(server, plc_tag("total", 0, "float64", order="CDAB"))
    assert caller.request("modbus.subscribe", request)["success"]
    first.stop()
    data = caller.listen("modbus.data.pump-skid")
    run_scanner()
    assert values(data, "total") == {"total": 123.456}


@pytest.mark.usefixtures("scanner")
def test_each_register_whose_bytes_are_swapped_in_writes_too_is_named(
    caller: Caller,
    server: holdfast.Server,
    memory: holdfast.Memory,
    caplog: pytest.LogCaptureFixture,
) -> None:
    memory.write("holding_registers", 0, [0x0102, 0x0102])
    data = caller.listen("modbus.data.pump-skid")
    tags = [
        plc_tag("speed", 0, "int16", order="BADC"),
        plc_tag("speed 2", 0, "int16", order="BADC"),
        plc_tag("level", 1, "uint16", order="little"),
        # Nothing of these is written in another way than before.
        plc_tag("plain", 2, "uint16", order="ABCD"),
        plc_tag("wide", 3, "uint32", order="BADC"),
        plc_tag("flag", 5, "boolean", order="DCBA"),
        plc_tag("input", 0, "uint16", order="DCBA", function="input"),
        plc_tag("coil", 0, "uint16", order="DCBA", function="coil"),
        plc_tag("fixed", 6, "uint16", order="DCBA") | {"writable": False},
    ]
    request = plc_subscribe(server, *tags)
    for _ in range(2):
        assert caller.request("modbus.subscribe", request)["success"]
    assert values(data, "speed", "level") == {"speed": 0x0201, "level": 0x0201}
    for name in ("speed", "level"):
        assert caller.request(f"modbus.command.{name}", str(0x0304)) == {"success": True}
    assert memory.read("holding_registers", 0, 2) == [0x0403, 0x0403]

    found = logged(caplog, "byte_order_differs")
    assert [(each["device"], each["count"], each["tags"]) for each in found] == [
        ("pump-skid", 2, "speed, speed 2"),
        ("pump-skid", 1, "level"),
    ]
    assert found[1]["note"] == (
        "DCBA swaps the bytes of the uint16 in reads and in writes; tentacle-modbus swaps them in "
        "reads only: a program that swaps the bytes of its commands itself must not do so any more"
    )


# Subscribing again, and leaving.


def test_a_request_that_is_repeated_publishes_no_value_again(
    run_scanner: Run, caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    run_scanner(defaults=Defaults(publish="change"))
    memory.write("holding_registers", 0, [7, 8])
    data = caller.listen("modbus.data.pump-skid")
    request = plc_subscribe(server, plc_tag("a", 0), rate=50)
    assert caller.request("modbus.subscribe", request)["success"]
    assert values(data, "a") == {"a": 7}
    for _ in range(2):
        assert caller.request("modbus.subscribe", request) == {"success": True, "count": 1}
    more = plc_subscribe(server, plc_tag("a", 0), plc_tag("b", 1), rate=50)
    assert caller.request("modbus.subscribe", more) == {"success": True, "count": 2}
    assert data.next()["variableId"] == "b"
    # Another subscriber gets a first value of its tags.
    late = plc_subscribe(server, plc_tag("b", 1), rate=50, project="other")
    assert caller.request("modbus.subscribe", late)["success"]
    assert data.next()["variableId"] == "b"
    memory.write("holding_registers", 0, [9])
    assert values(data, "a") == {"a": 9}
    # Who has left a tag, or has it in another form, gets its value.
    caller.request("modbus.unsubscribe", plc_unsubscribe("a"))
    assert caller.request("modbus.subscribe", request)["success"]
    assert (data.next()["value"], data.take()) == (9, [])
    boolean = plc_subscribe(server, plc_tag("a", 0, "boolean"), rate=50)
    assert caller.request("modbus.subscribe", boolean)["success"]
    assert data.next()["value"] is True


def test_a_request_that_is_repeated_causes_no_scan(
    run_scanner: Run, caller: Caller, server: holdfast.Server
) -> None:
    run_scanner(defaults=Defaults(publish="change"))
    data = caller.listen("modbus.data.pump-skid")
    request = plc_subscribe(server, plc_tag("a", 0), rate=60_000)
    assert caller.request("modbus.subscribe", request)["success"]
    values(data, "a")
    for _ in range(2):
        assert caller.request("modbus.subscribe", request)["success"]
    more = plc_subscribe(server, plc_tag("b", 1), rate=60_000)
    assert caller.request("modbus.subscribe", more)["success"]
    assert data.next()["variableId"] == "b"


@pytest.mark.usefixtures("scanner")
def test_who_leaves_must_say_what(
    caller: Caller, server: holdfast.Server, caplog: pytest.LogCaptureFixture
) -> None:
    caller.request("modbus.subscribe", plc_subscribe(server, plc_tag("a", 0), plc_tag("b", 1)))
    left = {"deviceId": "pump-skid", "subscriberId": "my-project"}
    error = 'tagIds is missing, allowed: a list of tag ids, or "all"'
    for request in (left, left | {"tagIds": None}, left | {"subscriberId": "nobody"}):
        refused = {"success": False, "error": error}
        assert caller.request("modbus.unsubscribe", request) == refused
    other = caller.request("modbus.unsubscribe", left | {"tagIds": "some"})
    assert other["error"].endswith('at `$.tagIds`, allowed: a list of tag ids, "all"')
    assert device(caller, "pump-skid")["tagCount"] == 2
    caplog.set_level("INFO", "holdfast")
    assert caller.request("modbus.unsubscribe", left | {"tagIds": "all"}) == {"success": True}
    assert caller.request("modbus.browse", b"")["count"] == 0
    assert [each["tags"] for each in logged(caplog, "unsubscribed")] == ["all"]


# A device that can't be reached.


def test_the_pauses_of_the_first_generation_are_2_s_to_60_s() -> None:
    assert DIALECTS[Settings().dialect].reconnect_pauses_s == (2.0, 60.0)


@pytest.mark.parametrize("dialect", ["tentacle", "tentacle-next"])
def test_only_the_first_generation_waits_for_exact_pauses(
    run_scanner: Run, caller: Caller, dialect: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[dict[str, Any]] = []
    polled_device = _core.PolledDevice

    def noted(*args: Any, **more: Any) -> _core.PolledDevice:
        made.append(more)
        return polled_device(*args, **more)

    monkeypatch.setattr(_core, "PolledDevice", noted)
    shorter = (0.01, 0.04) if dialect == "tentacle" else None
    running = run_scanner(dialect=dialect, exact_pauses_s=shorter)
    units = {1: holdfast.Memory(holding_registers=1)}
    with holdfast.Server(units, bind="127.0.0.1:0", access="read-only") as gone:
        # Without them, the next scan would be tried in a minute.
        request = subscription(gone, tag("a", 0), scanRate=60_000)
    assert caller.request("modbus.subscribe", request)["success"]
    if dialect == "tentacle":
        wire.until(lambda: device(caller, "plc1")["failures"] > 3, "it is tried again and again")
    assert {(each["retry"], each["jitter"]) for each in made} == {(shorter, shorter is None)}
    running.stop()
    for bucket in ("scanner_config_modbus", "service_enabled"):
        caller.forget(bucket)


# What requests leave out.


@pytest.mark.usefixtures("scanner")
def test_a_request_is_timed_out_after_3_s_unless_it_says_otherwise(
    caller: Caller, server: holdfast.Server
) -> None:
    caller.request("modbus.subscribe", plc_subscribe(server, plc_tag("a", 0)))
    assert device(caller, "pump-skid")["timeout"] == 3000


def test_the_settings_say_what_a_request_leaves_out(
    run_scanner: Run, caller: Caller, server: holdfast.Server
) -> None:
    run_scanner(defaults=Defaults(timeout=700, publish="change", deadband=2.5, scan_rate=100))
    host, port = server.address
    bare = {"deviceId": "a", "host": host, "port": port, "tags": [tag("x", 0)]}
    assert caller.request("modbus.subscribe", {**bare, "subscriberId": "s"})["success"]
    said = {"timeout": 900, "publish": "scan", "scanRate": 200}
    assert caller.request(
        "modbus.subscribe", {**bare, **said, "deviceId": "b", "subscriberId": "s"}
    )
    found = device(caller, "a")
    assert (found["timeout"], found["scanRate"]) == (700, 100)
    assert found["subscribers"][0]["publish"] == "change"
    assert found["subscribers"][0]["deadband"] == 2.5
    found = device(caller, "b")
    assert (found["timeout"], found["scanRate"]) == (900, 200)
    assert found["subscribers"][0]["publish"] == "scan"
    assert "deadband" not in found["subscribers"][0]


# What may be written.


@pytest.mark.parametrize(
    ("writes", "expected"),
    [
        ("tags", {"left_out": True, "yes": True, "no": False}),
        ("explicit", {"left_out": False, "yes": True, "no": False}),
        ("none", {"left_out": False, "yes": False, "no": False}),
    ],
)
def test_the_settings_say_which_tags_are_written(
    run_scanner: Run,
    caller: Caller,
    server: holdfast.Server,
    memory: holdfast.Memory,
    writes: str,
    expected: dict[str, bool],
) -> None:
    run_scanner(writes=writes)
    tags = [tag("left_out", 0), tag("yes", 1, writable=True), tag("no", 2, writable=False)]
    caller.request("modbus.subscribe", subscription(server, *tags))
    shown = {each["id"]: each["writable"] for each in device(caller, "plc1")["tags"]}
    assert shown == expected
    for id, allowed in expected.items():
        answer = caller.request(f"modbus.command.{id}", "9")
        assert answer["success"] is allowed
        assert allowed or f"tag '{id}' of plc1 is not writable: " in answer["error"]
    assert memory.read("holding_registers", 0, 3) == [9 * each for each in expected.values()]


def test_the_start_says_what_may_be_written_where_and_by_whom(
    run_scanner: Run, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "holdfast")
    run_scanner()
    run_scanner(writes="explicit", prefix="plant", allow=("192.0.2.0/24", "/dev/ttyUSB0"))
    run_scanner(writes="none")
    wire.until(lambda: len(logged(caplog, "write_access")) == 3, "each has logged it")
    usual, explicit, none = logged(caplog, "write_access")
    assert usual == {
        "tags": 'every subscribed coil and holding register without "writable": false',
        "devices": "at private and loopback addresses",
        "by": "every NATS client that may publish to modbus.subscribe, modbus.command.>",
        "narrowed_by": "nats.writes (--writes): explicit or none; nats.devices (--allow); "
        "permissions in NATS",
    }
    assert explicit == {
        "tags": 'subscribed coils and holding registers with "writable": true',
        "devices": "192.0.2.0/24, /dev/ttyUSB0",
        "by": "every NATS client that may publish to plant.subscribe, plant.command.>",
        "narrowed_by": "nats.writes (--writes): none; nats.devices (--allow); permissions in NATS",
    }
    assert none == {
        "tags": "none: all commands are refused",
        "set_by": "nats.writes (--writes): none",
    }


def test_a_write_outside_the_allow_list_is_impossible(
    run_scanner: Run, caller: Caller, server: holdfast.Server
) -> None:
    run_scanner(allow=("192.0.2.0/24",))
    answer = caller.request("modbus.subscribe", plc_subscribe(server, plc_tag("a", 0)))
    assert answer["error"] == "127.0.0.1 is not allowed, allowed: 192.0.2.0/24"
    assert caller.request("modbus.command.a", "1") == {"success": False, "error": "no tag 'a'"}


@pytest.mark.usefixtures("scanner")
@pytest.mark.parametrize("value", ["+5", "5.", "5", "5.0", " 5 ", "0.5e1"])
def test_a_number_is_written_in_every_exact_notation(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory, value: str
) -> None:
    caller.request("modbus.subscribe", plc_subscribe(server, plc_tag("a", 0)))
    assert caller.request("modbus.command.a", value) == {"success": True}
    assert memory.read("holding_registers", 0, 1) == [5]


@pytest.mark.usefixtures("scanner")
def test_a_fraction_may_begin_with_the_point(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    caller.request("modbus.subscribe", plc_subscribe(server, plc_tag("a", 0, "float32")))
    assert caller.request("modbus.command.a", ".5") == {"success": True}
    assert memory.read("holding_registers", 0, 2) == [0x3F00, 0]


@pytest.mark.usefixtures("scanner")
@pytest.mark.parametrize(
    "value", ["12.7", "65536", "-1", "1e30", "NaN", "Infinity", "0x10", "", ".", "+", "1,5", "5 6"]
)
def test_a_value_that_does_not_fit_is_refused_with_a_reply(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory, value: str
) -> None:
    caller.request("modbus.subscribe", plc_subscribe(server, plc_tag("a", 0)))
    answer = caller.request("modbus.command.a", value)
    assert answer["success"] is False
    assert "uint16" in answer["error"]
    assert memory.read("holding_registers", 0, 1) == [0]


# Requests that are not exact.


@pytest.mark.usefixtures("scanner")
def test_unknown_keys_are_ignored_and_logged_once_for_each_subscriber(
    caller: Caller, server: holdfast.Server, caplog: pytest.LogCaptureFixture
) -> None:
    more = {"protocol": "modbus", "units": 1}
    for name in ("hmi", "hmi", "historian"):
        request = subscription(server, tag("a", 0, units="bar"), subscriberId=name, **more)
        assert caller.request("modbus.subscribe", request) == {"success": True, "count": 1}
    assert caller.request("modbus.unsubscribe", leaving("a", all=True)) == {"success": True}
    found = logged(caplog, "keys_ignored")
    assert [(each["subscriber"], each["found"]) for each in found] == [
        ("hmi", "protocol, units"),
        ("historian", "protocol, units"),
    ]


@pytest.mark.usefixtures("scanner")
def test_a_key_of_the_plan_is_never_ignored(caller: Caller, server: holdfast.Server) -> None:
    request = subscription(server, tag("a", 0), plan={"maxGap": 1})
    answer = caller.request("modbus.subscribe", request)
    assert answer["error"] == "Object contains unknown field `maxGap` - at `$.plan`"


@pytest.mark.usefixtures("scanner")
@pytest.mark.parametrize("rate", [0, -5, 1, 49, "0", 49.0])
def test_a_scan_rate_that_is_too_short_is_raised(
    caller: Caller, server: holdfast.Server, caplog: pytest.LogCaptureFixture, rate: object
) -> None:
    request = subscription(server, tag("a", 0), scanRate=rate)
    assert caller.request("modbus.subscribe", request)["success"]
    assert device(caller, "plc1")["scanRate"] == 50
    [found] = logged(caplog, "scan_rate_raised")
    assert found["found"] == f"{int(float(str(rate)))} to 50 ms"


@pytest.mark.usefixtures("scanner")
def test_numbers_as_text_are_taken_where_they_are_exact(
    caller: Caller, server: holdfast.Server
) -> None:
    sent: dict[str, Any] = {
        "port": str(server.address[1]),
        "unitId": "1",
        "scanRate": " 1e3 ",
        "timeout": "1500.0",
        "publish": "change",
        "deadband": "0.25",
        "tags": [tag("a", 0) | {"address": "3"}],
    }
    assert caller.request("modbus.subscribe", subscription(server) | sent)["success"]
    found = device(caller, "plc1")
    assert (found["unitId"], found["scanRate"], found["timeout"]) == (1, 1000, 1500)
    assert found["tags"][0]["address"] == 3
    assert found["subscribers"][0]["deadband"] == 0.25


@pytest.mark.usefixtures("scanner")
def test_of_a_repeated_tag_id_the_last_one_holds(
    caller: Caller, server: holdfast.Server, caplog: pytest.LogCaptureFixture
) -> None:
    request = subscription(server, tag("a", 0), tag("b", 1), tag("a", 2, "int16"))
    assert caller.request("modbus.subscribe", request) == {"success": True, "count": 3}
    shown = {each["id"]: each for each in device(caller, "plc1")["tags"]}
    assert (shown["a"]["address"], shown["a"]["datatype"]) == (2, "int16")
    assert [each["found"] for each in logged(caplog, "tag_repeated")] == ["a"]


@pytest.mark.usefixtures("scanner")
def test_writable_is_ignored_where_nothing_can_be_written(
    caller: Caller, server: holdfast.Server, caplog: pytest.LogCaptureFixture
) -> None:
    tags = [
        scanner_tag("a", 0, functionCode="input"),
        scanner_tag("b", 0, functionCode="discrete", datatype="boolean"),
        scanner_tag("c", 0),
    ]
    assert caller.request("modbus.subscribe", subscription(server, *tags))["success"]
    shown = {each["id"]: each["writable"] for each in device(caller, "plc1")["tags"]}
    assert shown == {"a": False, "b": False, "c": True}
    [found] = logged(caplog, "writable_ignored")
    assert found["found"] == "a (input_registers), b (discrete_inputs)"
    assert "not writable" in caller.request("modbus.command.a", "1")["error"]


# What a subscriber replaces.


@pytest.mark.usefixtures("scanner")
def test_a_subscriber_comes_back_with_another_definition_of_its_tag(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 0, [65535, 7])
    data = caller.listen("modbus.data.pump-skid")
    for made, value in (
        (plc_tag("a", 0), 65535),
        (plc_tag("a", 0, "int16"), -1),
        (plc_tag("a", 1), 7),
        (plc_tag("a", 0, "boolean", function="coil"), False),
    ):
        answer = caller.request("modbus.subscribe", plc_subscribe(server, made, rate=100))
        assert answer == {"success": True, "count": 1}

        def is_new(message: Any, value: object = value) -> bool:
            return message["value"] == value and type(message["value"]) is type(value)

        data.until(is_new, f"the value {value}")
    data.take()
    assert {data.next()["value"] for _ in range(5)} == {False}


@pytest.mark.usefixtures("scanner")
def test_a_subscriber_comes_back_with_another_address_of_its_device(
    caller: Caller, serve: Serve, memory: holdfast.Memory
) -> None:
    other = holdfast.Memory(holding_registers=10)
    memory.write("holding_registers", 0, [1, 10])
    other.write("holding_registers", 0, [2, 20])
    old, new = serve({1: memory}), serve({1: other})
    data = caller.listen("modbus.data.pump-skid")
    caller.request("modbus.subscribe", plc_subscribe(old, plc_tag("a", 0), plc_tag("b", 1)))
    assert values(data, "a", "b") == {"a": 1, "b": 10}
    assert caller.request("modbus.subscribe", plc_subscribe(new, plc_tag("a", 0)))["success"]
    # From then on, nothing of the old device is published, and the other tag is the new one's too.
    data.take()
    assert values(data, "a", "b") == {"a": 2, "b": 20}
    wire.until(lambda: connections(old) == 0, "the old one is closed")
    assert caller.request("modbus.command.a", "5") == {"success": True}
    assert memory.read("holding_registers", 0, 1) == [1]
    assert other.read("holding_registers", 0, 1) == [5]
    caller.request("modbus.unsubscribe", plc_unsubscribe("a", "b"))
    wire.until(lambda: connections(new) == 0, "the new one is closed")
    assert caller.request("modbus.browse", b"")["count"] == 0


@pytest.mark.usefixtures("scanner")
@pytest.mark.parametrize(
    ("change", "key", "value"),
    [
        ({"timeout": 500}, "timeout", 500),
        ({"release": True}, "release", True),
        ({"plan": {"max_gap": 0}}, "plan", {"max_gap": 0, "max_registers": 125, "max_bits": 2000}),
    ],
)
def test_a_subscriber_comes_back_with_another_setting_of_its_device(
    caller: Caller, server: holdfast.Server, change: dict[str, Any], key: str, value: object
) -> None:
    first = subscription(server, tag("a", 0), timeout=900)
    caller.request("modbus.subscribe", first)
    again = subscription(server, tag("a", 0)) | change
    assert caller.request("modbus.subscribe", again)["success"]
    found = device(caller, "plc1")
    assert found[key] == value
    assert found["timeout"] == (500 if key == "timeout" else 900)


# Device ids.


@pytest.mark.usefixtures("scanner")
@pytest.mark.parametrize(
    ("id", "part"),
    [
        ("Pump 1", "Pump_1"),
        ("line.1", "line_1"),
        ("a*>b", "a__b"),
        ("10.0.0.5:502", "10_0_0_5_502"),
        ("Kühler/1", "K_hler_1"),
        ("a%b", "a_b"),
    ],
)
def test_a_device_id_may_have_any_printable_characters(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory, id: str, part: str
) -> None:
    data = caller.listen(f"modbus.data.{part}")
    plc = caller.listen(f"modbus.data.{subject_part(id)}")
    status = caller.listen(f"modbus.status.{part}")
    request = plc_subscribe(server, plc_tag("a", 0), device=id)
    assert caller.request("modbus.subscribe", request)["success"]
    assert data.next()["deviceId"] == id
    assert plc.next()["deviceId"] == id
    assert status.next()["deviceId"] == id
    assert caller.request(f"modbus.command.{part}.a", "3") == {"success": True}
    assert memory.read("holding_registers", 0, 1) == [3]
    assert caller.request("modbus.unsubscribe", plc_unsubscribe("a", device=id))["success"]
    assert caller.request("modbus.browse", b"")["count"] == 0


@pytest.mark.usefixtures("scanner")
def test_two_device_ids_with_one_name_in_subjects_are_refused(
    caller: Caller, server: holdfast.Server
) -> None:
    def ask(id: str) -> Any:
        return caller.request("modbus.subscribe", plc_subscribe(server, plc_tag("a", 0), device=id))

    assert ask("Pump 1")["success"]
    assert ask("Pump.1")["error"] == (
        "deviceId 'Pump.1' has the same name in subjects as 'Pump 1', which is known: Pump_1; "
        "give one of them another id"
    )
    assert ask("Pump 1")["success"]
    caller.request("modbus.unsubscribe", plc_unsubscribe("a", device="Pump 1"))
    assert ask("Pump.1")["success"]


def test_the_fixtures_are_as_javascript_writes_them(server: holdfast.Server) -> None:
    assert text({"a": "ü", "b": [1, None]}) == '{"a":"ü","b":[1,null]}'
    assert plc_unsubscribe("a") == (
        '{"deviceId":"pump-skid","tagIds":["a"],"subscriberId":"my-project"}'
    )
    assert plc_subscribe(server, plc_tag("a", 0)).endswith(
        '"unitId":1,"byteOrder":"ABCD","scanRate":1000,"tags":[{"id":"a","address":0,'
        '"functionCode":"holding","datatype":"uint16","byteOrder":"ABCD"}],'
        '"subscriberId":"my-project"}'
    )

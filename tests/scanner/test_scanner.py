"""The scanner as its callers have it: the real NATS server, real Modbus devices."""

from __future__ import annotations

import asyncio
import itertools
import json
import threading
from typing import TYPE_CHECKING, Any

import pytest
from nats.aio.msg import Msg

import holdfast
from holdfast.scanner import requests as scanner_requests
from holdfast.scanner import responder
from holdfast.scanner.polling import poller
from holdfast.scanner.subscriptions.subscription import subscription_of
from support import wire
from support.fake_device import FakeDevice, registers
from support.nats_bus import leaving, subscription, tag
from support.scanner_parts import broker_of, client_of, polling_of, registry_of

if TYPE_CHECKING:
    from support.nats_bus import Caller, Inbox, Run, Running
    from support.running import Serve

pytestmark = pytest.mark.usefixtures("scanner")


def connections(server: holdfast.Server) -> int:
    """How many are open."""
    counters = server.counters()
    assert "connections" in counters
    return counters["connections"]["open"]


def requests(server: holdfast.Server) -> int:
    """How many there were."""
    counters = server.counters()
    assert "requests" in counters
    return sum(counters["requests"].values())


def device(caller: Caller, id: str = "plc1") -> Any:
    """What browsing tells of a device."""
    [found] = caller.request("modbus.browse", {"deviceId": id})["devices"]
    return found


def test_a_caller_of_tentacle_modbus_needs_no_change(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 100, [0x42F6, 0xE979, 65534])
    memory.write("coils", 3, [1])
    data = caller.listen("modbus.data.press-4")
    request = {
        "deviceId": "press-4",
        "host": server.address[0],
        "port": server.address[1],
        "unitId": 1,
        "byteOrder": "ABCD",
        "scanRate": 100,
        "tags": [
            {
                "id": "pressure",
                "description": "main line",
                "address": 100,
                "functionCode": "holding",
                "datatype": "float32",
                "byteOrder": "ABCD",
                "writable": False,
            },
            {"id": "offset", "address": 102, "functionCode": "holding", "datatype": "int16"},
            {
                "id": "running",
                "address": 3,
                "functionCode": "coil",
                "datatype": "boolean",
                "writable": True,
            },
        ],
        "subscriberId": "plc-project",
    }
    assert caller.request("modbus.subscribe", request) == {"success": True, "count": 3}

    found = {message["variableId"]: message for message in (data.next() for _ in range(3))}
    assert found["pressure"].pop("timestamp") > 1_700_000_000_000
    assert found["pressure"] == {
        "moduleId": "modbus",
        "deviceId": "press-4",
        "variableId": "pressure",
        "value": 123.45600128173828,
        "datatype": "number",
    }
    assert (found["offset"]["value"], found["offset"]["datatype"]) == (-2, "number")
    assert (found["running"]["value"], found["running"]["datatype"]) == (True, "boolean")

    caller.publish("modbus.command.running", "false")
    data.until(lambda message: message["value"] is False, "the coil is off")
    assert memory.read("coils", 3, 1) == [0]

    left = {"deviceId": "press-4", "tagIds": list(found), "subscriberId": "plc-project"}
    assert caller.request("modbus.unsubscribe", left) == {"success": True}
    wire.until(lambda: connections(server) == 0, "the connections are closed")


def test_null_in_place_of_what_may_be_left_out_is_leaving_it_out(
    caller: Caller, server: holdfast.Server
) -> None:
    request = subscription(server, tag("a", 0, byteOrder=None, null=None))
    more = dict.fromkeys(["byteOrder", "unitId", "transport", "plan", "release", "publish"])
    assert caller.request("modbus.subscribe", request | more)["success"]
    assert device(caller)["unitId"] == 1


def test_nothing_is_connected_before_somebody_subscribes_and_after_the_last_leaves(
    caller: Caller, server: holdfast.Server
) -> None:
    data = caller.listen("modbus.data.plc1")
    assert connections(server) == 0
    for name in ("hmi", "historian"):
        request = subscription(server, tag("a", 0), tag("b", 1), subscriberId=name)
        assert caller.request("modbus.subscribe", request)["success"]
    data.next()
    assert connections(server) == 1

    caller.request("modbus.unsubscribe", leaving("a", "b"))
    data.take()
    data.next()
    assert connections(server) == 1

    caller.request("modbus.unsubscribe", leaving("b", subscriberId="historian"))
    data.until(lambda message: message["variableId"] == "a", "what is left")
    caller.request("modbus.unsubscribe", leaving("a", subscriberId="historian"))
    wire.until(lambda: connections(server) == 0, "the connection is closed")
    answer = caller.request("modbus.browse", b"")
    assert (answer["success"], answer["count"], answer["devices"]) == (True, 0, [])
    assert answer["service"]["published"] > 0


def test_to_leave_what_is_not_known_is_no_error(caller: Caller, server: holdfast.Server) -> None:
    caller.request("modbus.subscribe", subscription(server, tag("a", 0)))
    for request in (leaving("a", deviceId="x"), leaving("a", subscriberId="x"), leaving("b")):
        assert caller.request("modbus.unsubscribe", request) == {"success": True}
    assert [each["id"] for each in device(caller)["tags"]] == ["a"]


def test_a_tag_may_be_left_twice_in_one_request(caller: Caller, server: holdfast.Server) -> None:
    caller.request("modbus.subscribe", subscription(server, tag("a", 0), tag("b", 1)))
    assert caller.request("modbus.unsubscribe", leaving("a", "a")) == {"success": True}
    assert [each["id"] for each in device(caller)["tags"]] == ["b"]
    assert caller.request("modbus.unsubscribe", leaving("b", "b")) == {"success": True}
    assert caller.request("modbus.browse", b"")["devices"] == []


def test_a_device_is_read_as_often_as_the_fastest_asks_and_each_tag_as_it_is_asked_for(
    caller: Caller, server: holdfast.Server
) -> None:
    data = caller.listen("modbus.data.plc1")
    slow = subscription(server, tag("slow", 0), tag("both", 1), scanRate=400, subscriberId="slow")
    fast = subscription(server, tag("fast", 2), tag("both", 1), scanRate=50, subscriberId="fast")
    for request in (slow, fast):
        assert caller.request("modbus.subscribe", request)["success"]
    assert device(caller)["scanRate"] == 50

    times: dict[str, list[int]] = {"slow": [], "fast": [], "both": []}

    def enough(message: Any) -> bool:
        times[message["variableId"]].append(message["timestamp"])
        # A scan that is late on a busy machine is closer to the next one.
        gaps = [later - earlier for earlier, later in itertools.pairwise(times["slow"][-4:])]
        return len(gaps) == 3 and min(gaps) >= 380

    data.until(enough, "four messages of the slow tag, each 400 ms after the last")
    assert times["slow"][-1] - times["slow"][0] >= 400 * (len(times["slow"]) - 2)
    assert len(times["fast"]) > 2 * len(times["slow"])
    assert len(times["both"]) > 2 * len(times["slow"])

    caller.request("modbus.unsubscribe", leaving("fast", "both", subscriberId="fast"))
    assert device(caller)["scanRate"] == 400
    data.take()
    assert data.next()["variableId"] in ("slow", "both")


def test_a_change_of_tags_keeps_the_connection_and_what_is_known_of_the_device(
    caller: Caller, server: holdfast.Server
) -> None:
    data = caller.listen("modbus.data.plc1")
    status = caller.listen("modbus.status.plc1")
    caller.request("modbus.subscribe", subscription(server, tag("tag0", 0)))
    data.next()
    for number in range(1, 8):
        request = subscription(server, tag(f"tag{number}", 2 * number))
        assert caller.request("modbus.subscribe", request)["success"]
        while data.next()["variableId"] != f"tag{number}":
            pass
    counters = server.counters()
    assert "connections" in counters
    assert counters["connections"]["accepted"] == 1
    # A new connection to the broker publishes the state again.
    states = [state for state, _ in itertools.groupby(status.take(), lambda each: each["state"])]
    assert states == ["connecting", "online"]


def test_tags_that_are_asked_for_one_by_one_do_not_flood_the_device(
    caller: Caller, server: holdfast.Server
) -> None:
    data = caller.listen("modbus.data.plc1")
    before = requests(server)
    for number in range(200):
        request = subscription(server, tag(f"tag{number}", 2 * number), scanRate=60_000)
        assert caller.request("modbus.subscribe", request)["success"]
    data.until(lambda message: message["variableId"] == "tag199", "the last tag")
    assert requests(server) - before < 100


def test_tags_near_each_other_are_read_by_one_request(
    caller: Caller, server: holdfast.Server
) -> None:
    data = caller.listen("modbus.data.plc1")
    tags = [
        tag("a", 0, "float32"),
        tag("b", 11, "float64"),
        tag("c", 26, "uint16"),
        tag("d", 5, functionCode="input"),
        tag("e", 900, "boolean", functionCode="coil"),
        tag("f", 0, "boolean", functionCode="coil"),
    ]
    caller.request("modbus.subscribe", subscription(server, *tags))
    data.next()
    blocks = [
        (block["area"], block["address"], block["count"], block["tags"], block["holes"])
        for block in device(caller)["blocks"]
    ]
    assert sorted(blocks) == [
        ("coils", 0, 1, 1, 0),
        ("coils", 900, 1, 1, 0),
        ("holding_registers", 0, 15, 2, 9),
        ("holding_registers", 26, 1, 1, 0),
        ("input_registers", 5, 1, 1, 0),
    ]


def test_a_plan_says_how_much_is_read_at_once_and_what_is_not(
    caller: Caller, server: holdfast.Server
) -> None:
    tags = [tag(f"t{address}", address) for address in (0, 2, 4, 6, 20)]
    plan = {
        "max_gap": 100,
        "max_registers": 5,
        "readable": [["holding", 0, 10]],
        "forbidden": [[3, 3], ["coil", 0, 100]],
    }
    caller.request("modbus.subscribe", subscription(server, *tags, plan=plan))
    data = caller.listen("modbus.data.plc1")
    data.next()
    found = device(caller)
    assert [(block["address"], block["count"]) for block in found["blocks"]] == [
        (0, 3),
        (4, 3),
        (20, 1),
    ]
    assert found["plan"]["max_registers"] == 5
    assert found["plan"]["forbidden"][0] == ["coils", 3, 4]


@pytest.mark.parametrize("release", [False, True])
def test_the_connection_can_be_released_after_each_scan(
    caller: Caller, server: holdfast.Server, release: bool
) -> None:
    data = caller.listen("modbus.data.plc1")
    caller.request("modbus.subscribe", subscription(server, tag("a", 0), release=release))
    for _ in range(5):
        data.next()
    counters = server.counters()
    assert "connections" in counters
    assert (counters["connections"]["accepted"] >= 5) == release


def test_devices_are_reached_over_every_transport_and_by_url(
    caller: Caller, memory: holdfast.Memory, run: Any
) -> None:
    del memory
    rule = "rules: [{sources: [127.0.0.1], units: {9: m}, access: read-write}]"
    appliance = run(
        f"""
memories: {{m: {{holding_registers: 10}}}}
listeners:
  tcp: {{type: modbus-tcp, bind: "127.0.0.1:0", {rule}}}
  udp: {{type: modbus-udp, bind: "127.0.0.1:0", {rule}}}
  rtu: {{type: modbus-rtu-over-tcp, bind: "127.0.0.1:0", {rule}}}
"""
    )
    appliance.memories["m"].write("holding_registers", 0, [77])
    ports = {endpoint.name: endpoint.port for endpoint in appliance.endpoints()}
    for name, transport in (("tcp", "tcp"), ("udp", "udp"), ("rtu", "rtu+tcp")):
        for by_url in (False, True):
            id = f"{name}-{by_url}"
            data = caller.listen(f"modbus.data.{id}")
            where: dict[str, Any] = {
                "host": "127.0.0.1",
                "port": ports[name],
                "transport": transport,
            }
            if by_url:
                where = {"url": f"{transport}://127.0.0.1:{ports[name]}"}
            who = {"deviceId": id, "subscriberId": "x", "unitId": 9}
            request = {**who, "scanRate": 50, "tags": [tag("a", 0)]}
            assert caller.request("modbus.subscribe", request | where)["success"]
            assert data.next()["value"] == 77


def test_many_units_behind_one_address_are_many_devices(caller: Caller, serve: Serve) -> None:
    memories = {unit: holdfast.Memory(holding_registers=10) for unit in range(1, 6)}
    server = serve(memories)
    data = caller.listen("modbus.data.*")
    for unit, memory in memories.items():
        memory.write("holding_registers", 0, [unit])
        request = subscription(server, tag("a", 0), deviceId=f"unit{unit}", unitId=unit)
        assert caller.request("modbus.subscribe", request)["success"]
    found: dict[str, int] = {}

    def all_there(message: Any) -> bool:
        found[message["deviceId"]] = message["value"]
        return len(found) == 5

    data.until(all_there, "values of all units")
    assert found == {f"unit{unit}": unit for unit in memories}
    assert connections(server) == 1


def test_what_is_browsed_tells_all_of_a_device(caller: Caller, server: holdfast.Server) -> None:
    data = caller.listen("modbus.data.plc1")
    request = subscription(
        server,
        tag("level", 3, "float32", writable=True, description="tank", byteOrder="CDAB"),
        publish="change",
        deadband=0.5,
    )
    caller.request("modbus.subscribe", request)
    data.next()
    found = device(caller)
    assert found.pop("lastAnswer") > 1_700_000_000_000
    assert found.pop("scans") >= 1
    assert found.pop("roundTrip") > 0
    assert found.pop("stateSince") > 1_700_000_000_000
    assert found == {
        "deviceId": "plc1",
        "url": f"tcp://127.0.0.1:{server.address[1]}",
        "address": f"tcp://127.0.0.1:{server.address[1]}",
        "unitId": 1,
        "state": "online",
        "failures": 0,
        "scanRate": 50,
        "timeout": 3000,
        "release": False,
        "missed": found["missed"],
        "tagCount": 1,
        "plan": {"max_gap": 10, "max_registers": 125, "max_bits": 2000},
        "blocks": [{"area": "holding_registers", "address": 3, "count": 2, "tags": 1, "holes": 0}],
        "tags": [
            {
                "id": "level",
                "address": 3,
                "functionCode": "holding",
                "datatype": "float32",
                "byteOrder": "CDAB",
                "writable": True,
                "description": "tank",
            }
        ],
        "subscribers": [
            {
                "id": "hmi",
                "scanRate": 50,
                "publish": "change",
                "deadband": 0.5,
                "tagIds": ["level"],
            }
        ],
    }


def test_what_does_not_fit_into_one_answer_is_browsed_in_several(
    caller: Caller, server: holdfast.Server
) -> None:
    tags = [tag(f"tag{'x' * 230}{number:05}", number % 900) for number in range(2000)]
    for number in range(4):
        request = subscription(server, *tags, deviceId=f"plc{number}", scanRate=60_000)
        assert caller.request("modbus.subscribe", request)["count"] == 2000
    found, answer = [], caller.request("modbus.browse", b"")
    found += answer["devices"]
    while "next" in answer:
        answer = caller.request("modbus.browse", {"offset": answer["next"]})
        found += answer["devices"]
    assert [each["deviceId"] for each in found] == ["plc0", "plc1", "plc2", "plc3"]
    assert [each["tagCount"] for each in found] == [2000] * 4


def test_the_prefix_of_all_subjects_can_be_chosen(
    run_scanner: Run, caller: Caller, server: holdfast.Server
) -> None:
    run_scanner(prefix="plant2.modbus")
    data: Inbox = caller.listen("plant2.modbus.data.plc1")
    request = subscription(server, tag("a", 0))
    assert caller.request("plant2.modbus.subscribe", request)["success"]
    assert data.next()["moduleId"] == "plant2.modbus"
    assert json.dumps(caller.request("modbus.browse", b"")["devices"]) == "[]"


@pytest.mark.parametrize("who", ["historian", "hmi"])
def test_who_subscribes_to_known_tags_of_a_slow_device_gets_values_and_the_state_soon(
    caller: Caller, server: holdfast.Server, who: str
) -> None:
    rates = {"scanRate": 3_600_000, "timeout": 30_000}
    request = subscription(server, tag("a", 0), tag("b", 1), **rates)
    data = caller.listen("modbus.data.plc1")
    assert caller.request("modbus.subscribe", request)["success"]
    assert {data.next()["variableId"] for _ in range(2)} == {"a", "b"}

    status = caller.listen("modbus.status.plc1")
    again = request | {"subscriberId": who, "tags": [tag("a", 0)]}
    assert caller.request("modbus.subscribe", again)["success"]
    assert status.next()["state"] == "online"
    assert data.next()["variableId"] == "a"
    assert data.take() == []


def test_who_leaves_a_slow_device_causes_no_scan(
    run_scanner: Run, caller: Caller, server: holdfast.Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    polling = polling_of(run_scanner().scanner)
    native, replaced = polling._poller, []

    class Spy:
        def __getattr__(self, name: str) -> Any:
            return getattr(native, name)

        def replace(self, name: str, device: Any, *, at_once: bool) -> None:
            replaced.append(at_once)
            native.replace(name, device, at_once=at_once)

    monkeypatch.setattr(polling, "_poller", Spy())
    data = caller.listen("modbus.data.plc1")
    for who, id, address in (("hmi", "a", 0), ("historian", "b", 100)):
        # A scan without an answer in time would be followed by the next an hour later.
        rates = {"scanRate": 3_600_000, "timeout": 30_000}
        request = subscription(server, tag(id, address), subscriberId=who, **rates)
        assert caller.request("modbus.subscribe", request)["success"]
        while data.next()["variableId"] != id:
            pass
    wire.until(lambda: replaced == [True], "it is polled for both")
    assert caller.request("modbus.unsubscribe", leaving("a"))["success"]
    wire.until(lambda: len(replaced) == 2, "it is polled for what is left")
    assert replaced == [True, False]


def test_a_scan_during_which_tags_change_is_published(
    caller: Caller, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(poller, "MIN_CHANGE_INTERVAL_S", 0.0)
    asked, may_answer = threading.Semaphore(0), threading.Semaphore(0)

    def answer(pdu: bytes) -> bytes:
        asked.release()
        assert may_answer.acquire(timeout=wire.DEADLINE)
        return registers(pdu, 7)

    with FakeDevice(answer) as plc:
        data = caller.listen("modbus.data.plc1")
        request = {"deviceId": "plc1", "url": plc.url, "scanRate": 100, "timeout": 30_000}
        first = request | {"subscriberId": "hmi", "tags": [tag("a", 0)]}
        assert caller.request("modbus.subscribe", first)["success"]
        assert asked.acquire(timeout=wire.DEADLINE)
        second = request | {"subscriberId": "historian", "tags": [tag("b", 500)]}
        assert caller.request("modbus.subscribe", second)["success"]
        may_answer.release()  # Only this read: the next scan waits.
        assert data.next()["variableId"] == "a"
        may_answer.release(1000)
        data.until(lambda message: message["variableId"] == "b", "it is in the next scan")


def test_a_tag_that_comes_back_has_no_value_from_before(scanner: Running, caller: Caller) -> None:
    goes_on = threading.Event()
    goes_on.set()

    def answer(pdu: bytes) -> bytes:
        assert goes_on.wait(wire.DEADLINE)
        return registers(pdu, 7)

    def latest() -> dict[str, tuple[Any, str]]:
        found = caller.request("modbus.variables", b"")
        return {each["variableId"]: (each["value"], each["quality"]) for each in found}

    with FakeDevice(answer) as plc:
        request = {"deviceId": "plc1", "url": plc.url, "scanRate": 100, "timeout": 30_000}
        stays = request | {"subscriberId": "historian", "tags": [tag("a", 0)]}
        goes = request | {"subscriberId": "hmi", "tags": [tag("b", 500)]}
        for each in (stays, goes):
            assert caller.request("modbus.subscribe", each)["success"]
        both = {"a": (7, "good"), "b": (7, "good")}
        wire.until(lambda: latest() == both, "both are read")
        assert caller.request("modbus.unsubscribe", leaving("b"))["success"]
        known = registry_of(scanner.scanner).devices["plc1"]
        wire.until(lambda: len(known.health.blocks) == 1, "it is not scanned any more")
        goes_on.clear()
        assert caller.request("modbus.subscribe", goes)["success"]
        assert latest() == {"a": (7, "good"), "b": (None, "uncertain")}
        goes_on.set()
        wire.until(lambda: latest() == both, "both are read again")


def test_numbers_without_a_fraction_are_integers_as_in_javascript(
    caller: Caller, server: holdfast.Server
) -> None:
    host, port = server.address
    text = f"""{{"deviceId": "plc1", "subscriberId": "x", "host": "{host}", "port": {port}.0,
        "unitId": 1.0, "scanRate": 1e3, "timeout": 1000.0, "plan": {{"max_gap": 5.0}},
        "tags": [{{"id": "a", "address": 3.0, "functionCode": "holding", "datatype": "float32",
                   "null": [-9999.0, 1e300, 0.5]}}]}}"""
    answer = caller.request("modbus.subscribe", text)
    assert "1e+300" in answer["error"]
    answer = caller.request("modbus.subscribe", text.replace("1e300", "1e30"))
    assert answer == {"success": True, "count": 1}
    found = device(caller)
    assert (found["scanRate"], found["tags"][0]["address"]) == (1000, 3)
    assert caller.request("modbus.browse", '{"offset": 0.0}')["count"] == 1


def test_a_subscriber_can_leave_without_naming_its_tags(
    caller: Caller, server: holdfast.Server
) -> None:
    for who in ("hmi", "historian"):
        request = subscription(server, tag("a", 0), tag(who, 1), subscriberId=who)
        assert caller.request("modbus.subscribe", request)["success"]
    assert caller.request("modbus.unsubscribe", leaving()) == {"success": True}
    assert len(device(caller)["subscribers"]) == 2
    first = {"deviceId": "plc1", "subscriberId": "hmi", "tagIds": "all"}
    assert caller.request("modbus.unsubscribe", first) == {"success": True}
    found = device(caller)
    assert [each["id"] for each in found["subscribers"]] == ["historian"]
    assert [each["id"] for each in found["tags"]] == ["a", "historian"]
    last = {"deviceId": "plc1", "subscriberId": "historian", "tagIds": "all"}
    assert caller.request("modbus.unsubscribe", last) == {"success": True}
    assert caller.request("modbus.browse", b"")["count"] == 0


def test_who_subscribes_to_no_tags_is_no_subscriber(
    caller: Caller, server: holdfast.Server
) -> None:
    nothing = subscription(server, scanRate=100)
    assert caller.request("modbus.subscribe", nothing) == {"success": True, "count": 0}
    assert caller.request("modbus.browse", b"")["count"] == 0
    assert connections(server) == 0
    refused = caller.request("modbus.subscribe", nothing | {"host": "8.8.8.8"})
    assert "8.8.8.8 is not allowed" in refused["error"]

    assert caller.request("modbus.subscribe", subscription(server, tag("a", 0)))["success"]
    assert caller.request("modbus.subscribe", nothing) == {"success": True, "count": 0}
    assert device(caller)["scanRate"] == 100
    stranger = nothing | {"subscriberId": "other"}
    assert caller.request("modbus.subscribe", stranger) == {"success": True, "count": 0}
    assert [each["id"] for each in device(caller)["subscribers"]] == ["hmi"]


def test_an_address_may_have_the_brackets_of_urls(caller: Caller, server: holdfast.Server) -> None:
    request = subscription(server, tag("a", 0), host="[::1]", scanRate=60_000)
    assert caller.request("modbus.subscribe", request)["success"]
    assert device(caller)["url"] == f"tcp://[::1]:{server.address[1]}"
    same = request | {"host": "::1"}
    assert caller.request("modbus.subscribe", same)["success"]


def test_a_device_that_does_not_fit_into_one_answer_is_browsed_in_pages(
    caller: Caller, server: holdfast.Server
) -> None:
    tags = [tag(f"tag{number:05}", 2 * number % 900) for number in range(3000)]
    for who in range(30):
        request = subscription(server, *tags, subscriberId=f"s{who}", scanRate=60_000)
        assert caller.request("modbus.subscribe", request)["count"] == 3000
    assert "tags" not in caller.request("modbus.browse", b"")["devices"][0]

    ids: list[str] = []
    wanted: dict[str, list[str]] = {f"s{who}": [] for who in range(30)}
    blocks = set()
    asked: dict[str, Any] = {"deviceId": "plc1"}
    while True:
        answer = caller.request("modbus.browse", asked)
        [found] = answer["devices"]
        ids += [each["id"] for each in found["tags"]]
        blocks |= {(each["address"], each["count"], each["tags"]) for each in found["blocks"]}
        for subscriber in found["subscribers"]:
            wanted[subscriber["id"]] += subscriber["tagIds"]
        if "nextTag" not in answer:
            break
        assert answer["nextTag"] == len(ids)
        asked["tagOffset"] = answer["nextTag"]
    assert ids == [each["id"] for each in tags]
    assert all(each == ids for each in wanted.values())
    assert sum(count for *_, count in blocks) == 3000
    last = caller.request("modbus.browse", {"deviceId": "plc1", "tagOffset": 3000})
    assert last["devices"][0]["tags"] == []
    lost = caller.request("modbus.browse", {"tagOffset": 1})
    assert lost == {"success": False, "error": "tagOffset requires deviceId"}


def test_between_two_large_requests_others_have_their_turn(
    run_scanner: Run, server: holdfast.Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    scanner = run_scanner()
    turn, turns = 0, []

    def noted(*arguments: Any) -> Any:
        turns.append(turn)
        return subscription_of(*arguments)

    monkeypatch.setattr(scanner_requests, "subscription_of", noted)
    monkeypatch.setattr(responder, "LARGE_REQUEST_BYTES", 100)

    async def ask() -> None:
        nonlocal turn
        handle = broker_of(scanner.scanner).handlers["modbus.subscribe"]
        client = client_of(scanner.scanner)
        for number in range(20):
            request = subscription(server, tag("a", 0), deviceId=f"d{number}", scanRate=60_000)
            await handle(Msg(client, data=json.dumps(request).encode()))
        while len(turns) < 20:
            turn += 1
            await asyncio.sleep(0)

    scanner.do(ask())
    assert len(set(turns)) == 20

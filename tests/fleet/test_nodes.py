"""Scanners of one fleet: any of them answers any request, and one of them polls each device."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
import threading
import time
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import pytest
from nats.errors import NoRespondersError
from nats.errors import TimeoutError as NoAnswer
from nats.js.api import StreamConfig

from holdfast.config.values.scanner_settings import parse_pollable
from holdfast.net.nats.connection import Servers
from holdfast.net.nats.key_bucket import Outdated
from holdfast.net.nats.outbox import Outbox
from holdfast.replication.leases.times import LEASE_TIMES, LeaseTimes
from holdfast.scanner.errors import Refused
from holdfast.scanner.fleet import desired_state, placement, reports
from holdfast.scanner.fleet.agreement import FleetRefused
from holdfast.scanner.service import Scanner
from holdfast.scanner.settings import FleetSettings, Settings
from holdfast.scanner.subscriptions.key import SubscriptionKey
from holdfast.tags import Tag, TagList
from support import wire
from support.brokers import NatsServer
from support.cli import invoke
from support.fake_device import FakeDevice, exception, registers
from support.fleet_nodes import FLEET, prepare
from support.judges import Judges
from support.leases import BRIEF, ENDLESS
from support.nats_bus import Caller, logged, refuse_updates
from support.scanner_parts import (
    allowed_of,
    broker_of,
    client_of,
    member_of,
    polling_of,
    registry_of,
    ttls_of,
)
from support.tentacle import subject_part

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from holdfast.scanner.subscriptions.device import ScannedDevice
    from holdfast.scanner.subscriptions.ttl import SubscriptionTtls
    from support.judges import Judge
    from support.nats_bus import Run, Running

Node = "Callable[..., Running]"
PARTITIONS = 16
WANTS = f"holdfast_fleet_{FLEET}_wants"
D0, D1 = "device.ZDA", "device.ZDE"
"""The keys of the devices `d0` and `d1`."""


@pytest.fixture
def judges() -> Iterator[Judges]:
    with Judges(4) as judges:
        yield judges


@pytest.fixture
def node(own_nats: NatsServer, run_scanner: Run) -> Callable[..., Running]:
    prepare(own_nats.url, PARTITIONS)

    def start(
        name: str,
        lease_times: LeaseTimes = LEASE_TIMES,
        check_interval_s: float = 5.0,
        **more: Any,
    ) -> Running:
        fleet = FleetSettings(FLEET, name, PARTITIONS, lease_times, check_interval_s)
        return run_scanner(own_nats, fleet=fleet, **more)

    return start


@pytest.fixture
def caller(own_nats: NatsServer) -> Iterator[Caller]:
    with Caller(own_nats.url) as caller:
        yield caller


def wanted(judge: Judge, number: int = 0, **more: Any) -> dict[str, Any]:
    tag = {"id": f"t{number}", "address": 0, "functionCode": "holding", "datatype": "uint16"}
    return {
        "deviceId": f"d{number}",
        "host": "127.0.0.1",
        "port": judge.port,
        "scanRate": 100,
        "subscriberId": "hmi",
        "tags": [tag],
        **more,
    }


def partitions(running: Running) -> int:
    member = member_of(running.scanner)
    return len(member.partition_leases.partitions)


def subscribe_all(caller: Caller, judges: Judges) -> None:
    for number, judge in enumerate(judges.devices):
        reply = caller.request("modbus.subscribe", wanted(judge, number))
        assert reply == {"success": True, "count": 1}


def is_polled(judge: Judge, more_than: int) -> bool:
    return len(judge.polls) > more_than


def share(*nodes: Running) -> None:
    """Waits until all partitions have a node, and each node has its share."""
    wire.until(
        lambda: sorted(map(partitions, nodes)) == [PARTITIONS // len(nodes)] * len(nodes),
        "the partitions are shared",
    )


def test_each_device_is_polled_by_one_node(
    node: Callable[..., Running], caller: Caller, judges: Judges
) -> None:
    one, two = node("a"), node("b")
    share(one, two)
    subscribe_all(caller, judges)
    for judge in judges.devices:
        wire.until(partial(is_polled, judge, 5), "it is polled")
        assert len(judge.peers) == 1


def test_a_third_node_takes_its_share_and_no_device_is_polled_twice(
    node: Callable[..., Running], caller: Caller, judges: Judges
) -> None:
    one = node("a")
    share(one)
    subscribe_all(caller, judges)
    two = node("b")
    share(one, two)
    before = [len(judge.polls) for judge in judges.devices]
    for judge, count in zip(judges.devices, before, strict=True):
        wire.until(partial(is_polled, judge, count + 5), "it is polled")
        assert not judge.overlaps
        assert not judge.returns()
    two.stop()
    share(one)
    before = [len(judge.polls) for judge in judges.devices]
    for judge, count in zip(judges.devices, before, strict=True):
        wire.until(partial(is_polled, judge, count + 5), "it is polled")
        assert not judge.overlaps
        assert not judge.returns()


def test_a_subscription_is_known_to_all_and_survives_all(
    node: Callable[..., Running], caller: Caller, judges: Judges
) -> None:
    one, two = node("a"), node("b")
    [judge, *_] = judges.devices
    caller.request("modbus.subscribe", wanted(judge))
    wire.until(lambda: len(judge.polls) > 2, "it is polled")
    one.stop()
    two.stop()
    polls = len(judge.polls)
    node("c")
    wire.until(lambda: len(judge.polls) > polls + 2, "it is polled again")
    # Both requests may reach any node.
    node("d")
    ended = {"deviceId": "d0", "subscriberId": "hmi", "tagIds": "all"}
    assert caller.request("modbus.unsubscribe", ended) == {"success": True}
    wire.until(lambda: caller.request("modbus.browse", "")["count"] == 0, "it is gone")
    wire.until(lambda: judge.busy is None, "its last poll has ended")


def test_requests_for_one_device_at_once_lose_nothing(
    node: Callable[..., Running], caller: Caller, judges: Judges
) -> None:
    node("a"), node("b"), node("c")
    [judge, *_] = judges.devices

    async def all_at_once() -> list[Any]:
        requests = [wanted(judge, subscriberId=f"hmi{number}") for number in range(12)]
        messages = await asyncio.gather(
            *(
                caller.client.request(
                    "modbus.subscribe", json.dumps(request).encode(), timeout=wire.DEADLINE
                )
                for request in requests
            )
        )
        return [json.loads(message.data) for message in messages]

    assert caller.do(all_at_once()) == [{"success": True, "count": 1}] * 12
    wire.until(
        lambda: len(caller.request("modbus.browse", "")["devices"][0]["subscribers"]) == 12,
        "all are known",
    )


def test_a_request_that_is_refused_changes_nothing_anywhere(
    node: Callable[..., Running], caller: Caller, judges: Judges
) -> None:
    node("a"), node("b")
    one, other, *_ = judges.devices
    caller.request("modbus.subscribe", wanted(one))
    for _ in range(6):
        refused = caller.request("modbus.subscribe", wanted(other, subscriberId="x"))
        assert not refused["success"]
        assert "hmi" in refused["error"]
    [device] = caller.request("modbus.browse", "")["devices"]
    assert [each["id"] for each in device["subscribers"]] == ["hmi"]


@pytest.mark.parametrize("part", ["port", "tag"])
def test_a_change_of_all_subscribers_at_once_is_adopted(
    node: Callable[..., Running], caller: Caller, judges: Judges, part: str
) -> None:
    running = node("a")
    share(running)
    former, new, *_ = judges.devices
    for subscriber in ("hmi", "log"):
        request = wanted(former, subscriberId=subscriber)
        assert caller.request("modbus.subscribe", request)["success"]
    # What a node finds that was cut off while others carried out all of it, one by one.
    before, after = f'"port":{former.port}', f'"port":{new.port}'
    if part == "tag":
        before, after = '"address":0', '"address":10'
    caller.put(WANTS, D0, caller.text(WANTS, D0).replace(before, after))
    if part == "tag":
        wire.until(lambda: devices_of(running)["d0"].tags["t0"].address == 10, "it is read there")
    else:
        wire.until(lambda: bool(new.polls), "it is polled at its new address")
        wire.until(lambda: not former.open, "and not at the former one")
    # One after the other: the first one may be seen alone.
    wire.until(lambda: set(devices_of(running)["d0"].subscribers) == {"hmi", "log"}, "both are")


def test_settings_of_a_shared_connection_that_change_are_adopted(
    node: Callable[..., Running], caller: Caller, judges: Judges
) -> None:
    running = node("a")
    share(running)
    url = f"tcp://127.0.0.1:{judges.devices[0].port}"
    for number in range(2):
        request = wanted(judges.devices[0], number, url=url, unitId=number + 1)
        del request["host"], request["port"]
        assert caller.request("modbus.subscribe", request)["success"]
    for key in (D0, D1):
        caller.put(WANTS, key, caller.text(WANTS, key).replace(url, f"{url}?retries=1"))

    def are_adopted() -> bool:
        devices = devices_of(running).values()
        return [each.source.target.tolerance.retries for each in devices] == [1, 1]

    wire.until(are_adopted, "both have the new settings")


def test_a_refused_device_is_not_polled_as_it_was_before(
    node: Callable[..., Running], caller: Caller, judges: Judges, own_nats: NatsServer
) -> None:
    running = node("a")
    share(running)
    assert caller.request("modbus.subscribe", wanted(judges.devices[0]))["success"]
    wire.until(lambda: bool(judges.devices[0].open), "it is connected")

    def shown() -> tuple[int, int]:
        result = invoke("fleet", "status", FLEET, "--nats", own_nats.url, "--json")
        return result.exit_code, json.loads(result.stdout)["nodes"][0]["refused"]

    good = caller.text(WANTS, D0)
    caller.put(WANTS, D0, good.replace("uint16", "uint17"))
    wire.until(lambda: not judges.devices[0].open, "it is not polled")
    wire.until(lambda: shown() == (3, 1), "it is shown as refused")
    answer = caller.request("modbus.subscribe", wanted(judges.devices[0], subscriberId="log"))
    assert "the fleet's subscriptions of d0: " in answer["error"]
    assert "uint17" in caller.text(WANTS, D0)
    caller.put(WANTS, D0, good)
    wire.until(lambda: bool(judges.devices[0].open), "it is connected again")
    wire.until(lambda: shown() == (0, 0), "it is not shown any more")


def devices_of(running: Running) -> dict[str, ScannedDevice]:
    return registry_of(running.scanner).devices.copy()


def test_a_command_reaches_the_device_whoever_receives_it(
    node: Callable[..., Running], caller: Caller, judges: Judges
) -> None:
    nodes = [node(name) for name in "abc"]
    # Each has its share: a device that moves is written to over another connection.
    wire.until(lambda: sorted(map(partitions, nodes)) == [5, 5, 6], "the partitions are shared")
    subscribe_all(caller, judges)
    for value in range(12):
        for number in range(len(judges.devices)):
            assert caller.request(f"modbus.command.t{number}", str(value)) == {"success": True}
    for judge in judges.devices:
        assert [value for _, value in judge.writes] == list(range(12))
        assert len({number for number, _ in judge.writes}) == 1
    refused = caller.request("modbus.command.t0", "70000")
    assert "outside" in refused["error"]


def record_requests(caller: Caller) -> None:
    """Has a stream record what nodes ask each other, and confirm it before they answer."""
    recorded = StreamConfig(name="recorded", subjects=["modbus.fleet.>"])
    caller.do(caller.client.jetstream().add_stream(recorded))


def test_a_command_that_may_be_carried_out_is_not_denied_whoever_receives_it(
    node: Callable[..., Running], caller: Caller, caplog: pytest.LogCaptureFixture
) -> None:
    share(*map(node, "ab"))

    def answer(pdu: bytes) -> bytes:
        return exception(pdu, 4) if pdu[0] == 6 else registers(pdu)

    with FakeDevice(answer) as device:
        tag = {"id": "t", "address": 0, "functionCode": "holding", "datatype": "uint16"}
        request = {"deviceId": "d0", "url": device.url, "scanRate": 100, "subscriberId": "hmi"}
        assert caller.request("modbus.subscribe", request | {"tags": [tag]})["success"]
        record_requests(caller)
        for value in range(8):
            error = caller.request("modbus.command.t", str(value))["error"]
            assert error.startswith("not confirmed: exception 04")
    logged = [vars(each)["fields"] for each in caplog.records if each.msg == "request_refused"]
    assert [each["outcome"] for each in logged] == ["not_confirmed"] * 8


def deaf(running: Running) -> None:
    """Changes of subscriptions don't reach a node, as between a new connection and its consumer."""
    bucket = member_of(running.scanner).desired._bucket
    assert bucket is not None, "it is open"
    running.do(bucket.unfollow())


def test_a_command_uses_the_newest_definition_of_its_tag(
    node: Callable[..., Running], caller: Caller, judges: Judges
) -> None:
    nodes = [node(name, check_interval_s=1000.0) for name in "ab"]
    share(*nodes)
    subscribe_all(caller, judges)
    wire.until(lambda: all(len(devices_of(each)) == 4 for each in nodes), "both know all")
    for each in nodes:
        deaf(each)
    for number in range(len(judges.devices)):
        key = D0.replace("ZDA", f"ZD{'AEIM'[number]}")
        changed = caller.text(WANTS, key).replace('"writable":null', '"writable":false')
        caller.put(WANTS, key, changed)
        for _ in range(6):  # Any node may receive it.
            answer = caller.request(f"modbus.command.t{number}", "1")
            assert "not writable" in answer.get("error", ""), answer
    assert not any(judge.writes for judge in judges.devices)


def test_a_command_uses_the_newest_address_of_its_device(
    node: Callable[..., Running], caller: Caller, judges: Judges
) -> None:
    running = node("a", check_interval_s=1000.0)
    share(running)
    former, new, *_ = judges.devices
    assert caller.request("modbus.subscribe", wanted(former))["success"]
    deaf(running)
    before, after = f'"port":{former.port}', f'"port":{new.port}'
    caller.put(WANTS, D0, caller.text(WANTS, D0).replace(before, after))
    assert caller.request("modbus.command.t0", "7") == {"success": True}
    assert ([value for _, value in new.writes], former.writes) == ([7], [])


def test_commands_stay_in_order_when_reads_overtake_each_other(
    node: Callable[..., Running],
    caller: Caller,
    judges: Judges,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    running = node("a")
    share(running)
    [judge, *_] = judges.devices
    assert caller.request("modbus.subscribe", wanted(judge))["success"]
    turns = [20, 0]

    async def read(_: str) -> None:
        for _turn in range(turns.pop(0)):
            await asyncio.sleep(0)

    async def write_both() -> None:
        write = running.scanner._commands.write
        await asyncio.gather(*(write("d0", "t0", text, lambda: 10.0) for text in "56"))

    monkeypatch.setattr(member_of(running.scanner).desired, "read", read)
    running.do(write_both())
    assert [value for _, value in judge.writes] == [5, 6]


@pytest.mark.parametrize(
    ("is_answered", "expected"),
    [
        (
            True,
            f"not stored in {WANTS}: an earlier change of d0 is not confirmed yet by a majority",
        ),
        (False, f"not stored: {WANTS} can't be read: timeout"),
    ],
)
def test_a_change_that_is_not_stored_without_a_majority_is_refused_for_that_reason(
    node: Callable[..., Running],
    caller: Caller,
    judges: Judges,
    monkeypatch: pytest.MonkeyPatch,
    *,
    is_answered: bool,
    expected: str,
) -> None:
    running = node("a")
    share(running)
    [judge, *_] = judges.devices
    desired = member_of(running.scanner).desired

    async def store(device: str, *_: object) -> int:
        raise Outdated(device)

    async def read(_: str) -> None:
        if not is_answered:
            raise NoAnswer

    with monkeypatch.context() as patched:
        patched.setattr(desired, "store", store)
        patched.setattr(desired, "read", read)
        error = caller.request("modbus.subscribe", wanted(judge))["error"]
    assert error.startswith(expected), error
    assert devices_of(running) == {}
    assert caller.request("modbus.subscribe", wanted(judge))["success"]


def test_a_command_is_refused_while_subscriptions_cant_be_read(
    node: Callable[..., Running], caller: Caller, judges: Judges
) -> None:
    running = node("a", check_interval_s=1000.0)
    share(running)
    [judge, *_] = judges.devices
    assert caller.request("modbus.subscribe", wanted(judge))["success"]
    caller.do(caller.client.jetstream().delete_stream(f"KV_{WANTS}"))
    answer = caller.request("modbus.command.t0", "7")
    assert answer["error"].startswith(f"not written: {WANTS} can't be read: "), answer
    assert not judge.writes
    wire.until(lambda: caller.request("modbus.command.t0", "8")["success"], "it is stored again")
    assert [value for _, value in judge.writes] == [8]


def test_a_name_that_is_looked_up_delays_no_other_device(
    node: Callable[..., Running],
    caller: Caller,
    judges: Judges,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    running = node("a")
    share(running)
    for number in range(2):
        request = wanted(judges.devices[number], number)
        assert caller.request("modbus.subscribe", request)["success"]
    allowed, is_asked = allowed_of(running.scanner), threading.Event()
    find = allowed.find

    async def slow(target: Any, **more: Any) -> Any:
        if target.host == "slow.example":
            is_asked.set()
            await asyncio.Event().wait()
        return await find(target, **more)

    monkeypatch.setattr(allowed, "find", slow)
    caller.put(WANTS, D0, caller.text(WANTS, D0).replace("127.0.0.1", "slow.example"))
    assert is_asked.wait(wire.DEADLINE)
    caller.put(WANTS, D1, caller.text(WANTS, D1).replace('"address":0', '"address":10'))
    wire.until(lambda: devices_of(running)["d1"].tags["t1"].address == 10, "it is adopted")


def test_a_process_that_has_not_joined_takes_no_requests_from_the_nodes(
    node: Callable[..., Running], caller: Caller, judges: Judges
) -> None:
    share(node("a"))
    subscribe_all(caller, judges)
    # It waits for ever until the name is free.
    other = node("a", ENDLESS, wait=False)
    wire.until(lambda: member_of(other.scanner).desired.is_read.is_set(), "it tries to join")
    assert not other.serves
    for _ in range(20):
        assert caller.request("modbus.browse", "")["count"] == 4
    broker = broker_of(other.scanner)
    other.do(broker.drain())
    [listening, _] = broker._works
    wire.until(listening.done, "it takes none if it joins while it stops")


def test_without_jetstream_callers_learn_that_there_is_no_node(
    run_scanner: Run, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bare = NatsServer(tmp_path, jetstream=False)
    try:
        running = run_scanner(bare, wait=False, fleet=FleetSettings(FLEET, "a", PARTITIONS))
        wire.until(lambda: logged(caplog, "leases_unavailable"), "it is logged")
        [found] = logged(caplog, "leases_unavailable")
        assert found["reason"] == "JetStream is not enabled on the server or for this account"
        with Caller(bare.url) as caller, pytest.raises(NoRespondersError):
            caller.request("modbus.browse", "")
        running.stop()
    finally:
        bare.kill()


def test_a_deletion_ends_everywhere(
    node: Callable[..., Running],
    caller: Caller,
    judges: Judges,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(desired_state, "DELETION_TTL_S", 1)
    nodes = [node(name, check_interval_s=0.1) for name in "ab"]
    share(*nodes)
    subscribe_all(caller, judges)
    for number in range(4):
        unsubscribe(caller, number)

    def remembered() -> list[object]:
        members = [member_of(each.scanner) for each in nodes]
        return [each for of in members for each in (*of.desired._values, *of._applied)]

    wire.until(lambda: subjects(caller) == {f"$KV.{WANTS}.terms": 1}, "the bucket has none of them")
    wire.until(lambda: not remembered(), "nor have the nodes")
    subscribe_all(caller, judges)
    wire.until(lambda: all(len(devices_of(each)) == 4 for each in nodes), "all are known again")


def subjects(caller: Caller) -> dict[str, int]:
    """The keys in the bucket of subscriptions, also those that are deleted."""
    jetstream = caller.client.jetstream()
    found = caller.do(jetstream.stream_info(f"KV_{WANTS}", subjects_filter=">"))
    return found.state.subjects or {}


def unsubscribe(caller: Caller, number: int) -> None:
    ended = {"deviceId": f"d{number}", "subscriberId": "hmi", "tagIds": "all"}
    assert caller.request("modbus.unsubscribe", ended) == {"success": True}


def end_deletion(caller: Caller, number: int) -> None:
    """Removes a device from the bucket without a message, as the end of its deletion does."""
    key = (D0, D1)[number]
    purge = caller.client.jetstream().purge_stream(f"KV_{WANTS}", subject=f"$KV.{WANTS}.{key}")
    assert caller.do(purge)


def test_a_deletion_that_ended_while_a_node_was_away_is_found(
    node: Callable[..., Running], caller: Caller, judges: Judges
) -> None:
    running = node("a", check_interval_s=0.1)
    share(running)
    subscribe_all(caller, judges)
    end_deletion(caller, 0)
    bucket = member_of(running.scanner).desired._bucket
    assert bucket is not None
    running.do(bucket.unfollow())
    wire.until(lambda: sorted(devices_of(running)) == ["d1", "d2", "d3"], "it is deleted here")


def test_a_change_of_a_device_whose_deletion_has_ended_begins_anew(
    node: Callable[..., Running], caller: Caller, judges: Judges
) -> None:
    running = node("a", check_interval_s=1000.0)
    share(running)
    subscribe_all(caller, judges)
    end_deletion(caller, 0)
    request = wanted(judges.devices[0], subscriberId="trend")
    assert caller.request("modbus.subscribe", request)["success"]
    assert list(devices_of(running)["d0"].subscribers) == ["trend"]
    end_deletion(caller, 0)
    assert running.do(written(running)) == "no tag 't0' of d0"


async def written(running: Running) -> str:
    """Why a command is refused, while the node follows the bucket anew."""
    desired = member_of(running.scanner).desired
    desired._doubted.add("d0")
    with pytest.raises(Refused) as refused:
        await running.scanner._commands.write("d0", "t0", "5", lambda: 10.0)
    return str(refused.value)


def test_deletions_end_in_a_bucket_that_was_made_without_ttls(
    node: Callable[..., Running], caller: Caller, judges: Judges
) -> None:
    config = StreamConfig(f"KV_{WANTS}", subjects=[f"$KV.{WANTS}.>"], max_msgs_per_subject=1)
    caller.do(caller.client.jetstream().add_stream(config))
    share(node("a"))
    subscribe_all(caller, judges)
    unsubscribe(caller, 0)
    found = caller.do(caller.client.jetstream().get_last_msg(f"KV_{WANTS}", f"$KV.{WANTS}.{D0}"))
    assert (found.headers or {})["Nats-TTL"] == "3600s"


def test_a_ttl_of_the_bucket_is_removed_and_no_other_setting(
    node: Callable[..., Running], caller: Caller, judges: Judges
) -> None:
    config = StreamConfig(
        f"KV_{WANTS}",
        subjects=[f"$KV.{WANTS}.>"],
        max_msgs_per_subject=1,
        max_age=3600.0,
        max_bytes=10**8,
        duplicate_window=60.0,
        description="of the plant",
    )
    made = caller.do(caller.client.jetstream().add_stream(config)).config
    share(node("a", check_interval_s=0.1))
    subscribe_all(caller, judges)

    def found() -> StreamConfig:
        config = caller.do(caller.client.jetstream().stream_info(f"KV_{WANTS}")).config
        return replace(config, metadata=None)  # It has the versions of the server.

    settings = replace(made, max_age=0.0, allow_msg_ttl=True, metadata=None)
    assert found() == settings
    # The same while a node runs.
    caller.do(caller.client.jetstream().update_stream(replace(settings, max_age=1800.0)))
    wire.until(lambda: found() == settings, "it is removed again")


def test_a_ttl_that_stays_stops_no_fleet(
    node: Callable[..., Running],
    caller: Caller,
    judges: Judges,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    refuse_updates(monkeypatch)
    caller.do(
        caller.client.jetstream().add_stream(
            StreamConfig(
                f"KV_{WANTS}",
                subjects=[f"$KV.{WANTS}.>"],
                max_msgs_per_subject=1,
                max_age=3600.0,
                allow_msg_ttl=True,
            )
        )
    )
    share(node("a", check_interval_s=0.1))
    subscribe_all(caller, judges)
    running = node("b")
    wire.until(lambda: len(devices_of(running)) == len(judges.devices), "it knows what is stored")
    found = logged(caplog, "subscriptions_not_kept")
    assert len(found) == 2, "once for each node"
    assert "TTL of 3600 s, which stays: not today" in found[0]["reason"]


def test_many_devices_are_browsed_in_pages(
    node: Callable[..., Running],
    caller: Caller,
    judges: Judges,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(reports, "DEVICES_PER_QUESTION", 3)
    share(node("a"), node("b"))
    subscribe_all(caller, judges)

    def page(offset: int) -> tuple[list[str], int, int | None]:
        found = caller.request("modbus.browse", {"offset": offset})
        return [each["deviceId"] for each in found["devices"]], found["count"], found.get("next")

    # The nodes know a subscription at different times.
    wire.until(lambda: page(0) == (["d0", "d1", "d2"], 4, 3), "the first page")
    wire.until(lambda: page(3) == (["d3"], 4, None), "the second page")
    wire.until(lambda: page(4) == ([], 4, None), "nothing is left")


def test_browse_and_variables_tell_of_all_nodes(
    node: Callable[..., Running], caller: Caller, judges: Judges
) -> None:
    one, two = node("a"), node("b")
    share(one, two)
    record_requests(caller)
    subscribe_all(caller, judges)
    wire.until(lambda: all(len(judge.polls) > 3 for judge in judges.devices), "all are polled")
    for _ in range(6):
        found = caller.request("modbus.browse", "")
        assert found["count"] == 4
        assert [each["state"] for each in found["devices"]] == ["online"] * 4
        [device] = caller.request("modbus.browse", {"deviceId": "d1", "tagOffset": 0})["devices"]
        assert (device["state"], len(device["tags"])) == ("online", 1)
        assert all(each["scans"] > 1 for each in found["devices"])
        assert found["service"]["fleet"]["nodes"] == ["a", "b"]
        values = caller.request("modbus.variables", "")
        assert [each["quality"] for each in values] == ["good"] * 4
        assert len(caller.request("modbus.variables", {"offset": 3})) == 1
        [value] = caller.request("modbus.variables", {"deviceId": "d2"})
        assert (value["variableId"], value["quality"]) == ("t2", "good")


@pytest.mark.parametrize(
    ("most", "connections", "id", "count", "tags"),
    [(4500, 4, "d{:02}", 8, 60), (20_000, 1, f"{'d' * 100}{{:02}}", 24, 6)],
    ids=["of one device", "of one node"],
)
def test_what_other_nodes_report_is_whole_though_it_takes_several_messages(
    node: Callable[..., Running],
    caller: Caller,
    judges: Judges,
    monkeypatch: pytest.MonkeyPatch,
    most: int,
    connections: int,
    id: str,
    count: int,
    tags: int,
) -> None:
    monkeypatch.setattr(Outbox, "max_answer", most)
    one, two = node("a"), node("b")
    share(one, two)
    made = [
        {"id": f"t{number:02}", "address": 0, "functionCode": "holding", "datatype": "uint16"}
        for number in range(tags)
    ]
    ids = [id.format(number) for number in range(count)]
    for number, each in enumerate(ids):
        request = wanted(judges.devices[number % connections], deviceId=each, tags=made)
        assert caller.request("modbus.subscribe", request | {"unitId": 1 + number})["success"]

    def values() -> list[tuple[str, str, str]]:
        found: list[Any] = []
        while more := caller.request("modbus.variables", {"offset": len(found)}):
            found += more
        return [(each["deviceId"], each["variableId"], each["quality"]) for each in found]

    def states() -> list[tuple[str, str, bool]]:
        found, answer = [], {"next": 0}
        while "next" in answer:
            answer = caller.request("modbus.browse", {"offset": answer["next"]})
            found += answer["devices"]
        return [(each["deviceId"], each["state"], each["scans"] > 0) for each in found]

    good = [(device, each["id"], "good") for device in ids for each in made]
    online = [(device, "online", True) for device in ids]
    wire.until(lambda: values() == good, "all are polled")
    for _ in range(6):
        assert values() == good
        assert states() == online


def test_messages_have_the_revision_of_the_lease(
    node: Callable[..., Running], caller: Caller, judges: Judges
) -> None:
    headers: list[Any] = []

    async def listen() -> None:
        async def take(message: Any) -> None:
            headers.append(message.headers)

        await caller.client.subscribe("modbus.data.>", cb=take)
        await caller.client.flush()

    caller.do(listen())
    one = node("a")
    caller.request("modbus.subscribe", wanted(judges.devices[0]))
    wire.until(lambda: len(headers) > 3, "values come")
    first = int(headers[-1]["Holdfast-Lease"])
    assert first > 0
    one.stop()
    headers.clear()
    node("b")
    wire.until(lambda: headers, "values come from the other node")
    assert int(headers[-1]["Holdfast-Lease"]) > first


def test_a_device_with_two_names_in_subjects_is_published_under_both(
    node: Callable[..., Running], caller: Caller, judges: Judges
) -> None:
    one = node("a")
    share(one)
    inboxes = [caller.listen(f"modbus.data.{name}") for name in ("K_che", subject_part("Küche"))]
    client = client_of(one.scanner)
    request = wanted(judges.devices[0], deviceId="Küche")
    assert caller.request("modbus.subscribe", request)["success"]
    for inbox in inboxes:
        assert {inbox.next()["deviceId"] for _ in range(3)} == {"Küche"}
    assert client_of(one.scanner) is client
    assert client.stats["reconnects"] == 0


def test_messages_over_a_new_connection_have_a_greater_number(
    node: Callable[..., Running], caller: Caller, judges: Judges
) -> None:
    """So a consumer drops what waited in a frozen server of the former connection."""
    numbers: dict[str, list[int]] = {"data": [], "status": []}

    async def listen() -> None:
        async def take(message: Any) -> None:
            kind = message.subject.split(".")[1]
            numbers[kind].append(int(message.headers["Holdfast-Lease"]))

        for kind in numbers:
            await caller.client.subscribe(f"modbus.{kind}.>", cb=take)
        await caller.client.flush()

    caller.do(listen())
    one = node("a")
    caller.request("modbus.subscribe", wanted(judges.devices[0]))
    wire.until(lambda: all(map(bool, numbers.values())), "values and a status come")
    [first] = set(numbers["data"])
    member, client = member_of(one.scanner), client_of(one.scanner)
    leases = member.partition_leases.leases
    held = next(key for key, since in leases.held.items() if since == first)
    wire.until(lambda: leases.revision(held) > first, "the lease is renewed")
    one.do(client.force_reconnect())
    wire.until(
        lambda: all(found[-1] > first for found in numbers.values()), "they have a greater number"
    )
    assert all(found == sorted(found) for found in numbers.values())
    assert leases.since(held) == first


def test_a_subscription_ends_by_its_ttl_unless_any_node_renews_it(
    node: Callable[..., Running], caller: Caller, judges: Judges
) -> None:
    nodes = [node("a"), node("b")]
    share(*nodes)
    timed, kept, *_ = judges.devices
    assert caller.request("modbus.subscribe", wanted(kept, 1))["success"]
    assert caller.request("modbus.subscribe", wanted(timed, 0, ttl=1000))["success"]
    key = SubscriptionKey("d0", "hmi")
    times = [ttls_of(running.scanner) for running in nodes]
    wire.until(lambda: all(key in each._ends for each in times), "both nodes know it")
    for _ in range(3):
        before = [each._ends[key] for each in times]
        assert caller.request("modbus.subscribe", wanted(timed, 0, ttl=1000))["success"]
        wire.until(partial(are_later, times, key, before), "both nodes have renewed it")
    for running in nodes:
        running.do(let_pass(ttls_of(running.scanner), 1000))
    wire.until(lambda: caller.request("modbus.browse", "")["count"] == 1, "it has ended")
    registries = [registry_of(running.scanner) for running in nodes]
    wire.until(lambda: all(len(each.devices) == 1 for each in registries), "for all")


def test_a_subscription_that_is_made_permanent_stays(
    node: Callable[..., Running], caller: Caller, judges: Judges
) -> None:
    nodes = [node("a"), node("b")]
    share(*nodes)
    [judge, *_] = judges.devices
    key = SubscriptionKey("d0", "hmi")
    times = [ttls_of(running.scanner) for running in nodes]
    assert caller.request("modbus.subscribe", wanted(judge, ttl=1000))["success"]
    wire.until(lambda: all(key in each._ends for each in times), "both nodes know it")
    assert caller.request("modbus.subscribe", wanted(judge))["success"]
    wire.until(lambda: not any(key in each._ends for each in times), "no node ends it")


@pytest.mark.parametrize("is_renewed", [True, False])
def test_a_subscription_that_another_node_has_changed_does_not_end(
    node: Callable[..., Running], caller: Caller, judges: Judges, is_renewed: bool
) -> None:
    running = node("a", check_interval_s=1000.0)
    share(running)
    assert caller.request("modbus.subscribe", wanted(judges.devices[0], ttl=1000))["success"]
    deaf(running)
    value = caller.text(WANTS, D0)
    if is_renewed:
        value = renewed(value)
    caller.put(WANTS, D0, value)
    key, times = SubscriptionKey("d0", "hmi"), ttls_of(running.scanner)
    before = times._ends[key]
    running.do(let_pass(times, 1000))
    wire.until(lambda: times._ends.get(key, 0.0) > before, "it is found again, with a new time")
    assert set(devices_of(running)["d0"].subscribers) == {"hmi"}
    assert json.loads(caller.text(WANTS, D0))["requests"]


def renewed(value: str) -> str:
    """A value of the bucket as a node stores it that has got the same requests again."""
    desired = json.loads(value)
    desired["renewed"] = {name: at + 1 for name, at in desired["renewed"].items()}
    return json.dumps(desired)


def test_a_renewal_at_another_node_causes_no_scan(
    node: Callable[..., Running], caller: Caller, judges: Judges
) -> None:
    running = node("a")
    share(running)
    [judge, *_] = judges.devices
    one = wanted(judge, scanRate=60_000)
    one["tags"][0]["null"] = [8, 0]
    other = {**one, "subscriberId": "log", "publish": "change", "ttl": 1000}
    for request in (one, other):
        assert caller.request("modbus.subscribe", request)["success"]
    key, times = SubscriptionKey("d0", "log"), ttls_of(running.scanner)
    before, device, polling = (
        times._ends[key],
        devices_of(running)["d0"],
        polling_of(running.scanner),
    )
    wire.until(lambda: device not in polling._pending_changes, "it is polled")
    polled_as = device.polled_as
    # Each process has its own order of the null values.
    value = renewed(caller.text(WANTS, D0)).replace("[8, 0]", "[0, 8]")
    caller.put(WANTS, D0, value)
    wire.until(lambda: times._ends[key] > before, "it is renewed")
    # An extra scan begins with another name in the poller.
    assert (device.polled_as, device in polling._pending_changes) == (polled_as, False)


def test_a_profile_with_more_tags_than_are_stored_causes_one_scan(
    node: Callable[..., Running],
    caller: Caller,
    judges: Judges,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    profile = TagList([Tag(id, "holding_registers", at) for at, id in enumerate("xyz")])
    running = node("a", profiles={"meter": profile})
    share(running)
    [judge, *_] = judges.devices
    request = wanted(judge, tags=[], profile="meter", scanRate=60_000)
    assert caller.request("modbus.subscribe", request)["success"]
    device, member = devices_of(running)["d0"], member_of(running.scanner)
    scanned: list[ScannedDevice] = []
    monkeypatch.setattr(
        polling_of(running.scanner), "renew", lambda device, **_more: scanned.append(device)
    )

    def scans_by(value: dict[str, Any]) -> int:
        """Stores a value as another node would, and returns how many scans that causes."""
        before = member._applied["d0"]
        scanned.clear()
        caller.put(WANTS, D0, value)
        wire.until(lambda: member._applied["d0"] > before, "it is adopted")
        return len(scanned)

    value = json.loads(caller.text(WANTS, D0))
    [stored] = value["requests"]
    stored["tags"].reverse()
    assert scans_by(value) == 0
    del stored["tags"][0]
    assert [scans_by(value), scans_by(value)] == [1, 0]
    assert set(device.tags) == {*"xyz"}
    # What ends at another node ends here, too.
    del stored["profile"]
    scans_by(value)
    assert set(device.tags) == {*"xy"}
    assert device.subscribers["hmi"].profile is None


def test_a_device_that_no_node_reports_is_not_online(
    node: Callable[..., Running], caller: Caller, judges: Judges
) -> None:
    running = node("a")
    share(running)
    assert caller.request("modbus.subscribe", wanted(judges.devices[0]))["success"]

    def shown() -> tuple[str, str | None, str]:
        [device] = caller.request("modbus.browse", "")["devices"]
        [value] = caller.request("modbus.variables", "")
        return device["state"], device.get("error"), value["quality"]

    wire.until(lambda: shown() == ("online", None, "good"), "it is scanned")

    async def lose() -> None:
        member_of(running.scanner)._lost(devices_of(running)["d0"].partition)

    running.do(lose())
    assert shown() == ("offline", "no node reports it", "bad")


def are_later(times: list[SubscriptionTtls], key: SubscriptionKey, before: list[float]) -> bool:
    return all(each._ends[key] > end for each, end in zip(times, before, strict=True))


async def let_pass(ttls: SubscriptionTtls, seconds: float) -> None:
    """Moves the clock of the subscriptions of a node."""
    ttls._clock = lambda: time.monotonic() + seconds
    ttls._changed.set()


def test_times_of_subscriptions_that_ended_are_forgotten(
    node: Callable[..., Running], caller: Caller, judges: Judges
) -> None:
    nodes = [node("a"), node("b")]
    share(*nodes)
    for subscriber in ("hmi", "log"):
        request = wanted(judges.devices[0], subscriberId=subscriber, ttl=3600)
        assert caller.request("modbus.subscribe", request)["success"]

    def noted() -> list[dict[str, set[str]]]:
        members = [member_of(each.scanner) for each in nodes]
        return [{id: set(times) for id, times in each._renewed.items()} for each in members]

    wire.until(lambda: noted() == [{"d0": {"hmi", "log"}}] * 2, "both nodes know both")
    ended = {"deviceId": "d0", "tagIds": "all"}
    caller.request("modbus.unsubscribe", ended | {"subscriberId": "hmi"})
    wire.until(lambda: noted() == [{"d0": {"log"}}] * 2, "one is left")
    caller.request("modbus.unsubscribe", ended | {"subscriberId": "log"})
    wire.until(lambda: noted() == [{}, {}], "none is left")


def test_one_node_or_all_are_shut_down(node: Callable[..., Running], caller: Caller) -> None:
    one, two = node("a"), node("b")
    share(one, two)
    for payload in ({"node": "b-2"}, {"Node": "a"}, {"node": "a", "x": 1}, {"node": None}):
        caller.publish("modbus.shutdown", payload)
    caller.publish("modbus.shutdown", {"node": "a"})
    wire.until(one.ended.done, "the node ends")
    share(two)
    assert not two.ended.done()
    caller.publish("modbus.shutdown", {})
    wire.until(two.ended.done, "the other node ends")
    with pytest.raises((NoAnswer, Exception)):
        caller.request("modbus.browse", "")


def test_a_node_with_another_jetstream_is_another_scanner(
    node: Callable[..., Running], caller: Caller, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As over a leaf node, which passes on messages, but not what is stored."""
    running = node("a")
    share(running)
    own = member_of(running.scanner).desired.made_at

    def others(started: int, **more: str) -> list[dict[str, int]]:
        caller.publish("modbus.scanner", json.dumps({"startedAt": started, "fleet": FLEET} | more))
        service = caller.request("modbus.browse", "")["service"]
        found: list[dict[str, int]] = service.get("otherScanners", [])
        return found

    assert others(1) == others(2, bucket=own) == []
    assert others(3, bucket="another") == [], "this node may not have found a new one yet"
    monkeypatch.setattr(placement, "FIND_BUCKET_S", 0.0)
    assert others(3, bucket="another") == [{"startedAt": 3}]


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ({"prefix": "other"}, "prefix is other, and modbus in the fleet"),
        ({"writes": "none"}, "writes is none, and tags in the fleet"),
        (
            {"allow": (parse_pollable("10.0.0.0/8"),)},
            "allow is ['10.0.0.0/8'], and [] in the fleet",
        ),
    ],
)
def test_other_settings_are_refused_and_named(
    node: Callable[..., Running], own_nats: NatsServer, other: dict[str, Any], said: str
) -> None:
    share(node("a"))
    fleet = FleetSettings(FLEET, "b", PARTITIONS)
    settings = Settings(Servers((own_nats.url,)), fleet=fleet, **other)

    async def run() -> None:
        async with asyncio.timeout(wire.DEADLINE):
            await Scanner(settings).run()

    with pytest.raises(FleetRefused) as refused:
        asyncio.run(run())
    assert str(refused.value) == said


def test_a_process_that_is_refused_says_why_and_ends(
    node: Callable[..., Running], own_nats: NatsServer
) -> None:
    share(node("a"))
    command = [sys.executable, "-m", "holdfast", "scan", "--nats", own_nats.url, "--fleet", FLEET]
    command += ["--node", "b", "--partitions", "8"]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    assert found.returncode == 2, found
    [said] = [line for line in found.stderr.splitlines() if line.startswith("holdfast: ")]
    assert said == f"holdfast: fleet plant: partitions is 8, and {PARTITIONS} in the fleet"


def test_without_nats_devices_rest_and_come_back(
    node: Callable[..., Running], caller: Caller, judges: Judges, own_nats: NatsServer
) -> None:
    running = node("a", BRIEF)
    [judge, *_] = judges.devices
    caller.request("modbus.subscribe", wanted(judge))
    wire.until(lambda: len(judge.polls) > 3, "it is polled")
    own_nats.kill()
    wire.until(lambda: partitions(running) == 0, "the leases are lost")
    polls = len(judge.polls)
    own_nats.start()
    wire.until(lambda: partitions(running) == PARTITIONS, "the leases are back")
    wire.until(lambda: len(judge.polls) > polls + 3, "it is polled again")
    wire.until(lambda: running.serves, "it serves")
    assert caller.request("modbus.browse", "")["count"] == 1


def test_the_command_line_shows_and_drains_nodes(
    node: Callable[..., Running], caller: Caller, judges: Judges, own_nats: NatsServer
) -> None:
    one, two = node("a"), node("b")
    share(one, two)
    subscribe_all(caller, judges)
    result = invoke("fleet", "status", "plant", "--nats", own_nats.url)
    assert result.exit_code == 0, result.output
    assert result.stdout.splitlines()[0] == f"fleet plant: 2 nodes, {PARTITIONS} partitions"
    result = invoke("fleet", "drain", "plant", "a", "--nats", own_nats.url)
    assert (result.exit_code, result.stdout) == (0, "a has left the fleet plant.\n")
    wire.until(one.ended.done, "it has ended")
    share(two)

    def shown() -> list[tuple[str, int]]:
        result = invoke("fleet", "status", "plant", "--nats", own_nats.url, "--json")
        return [(each["node"], each["devices"]) for each in json.loads(result.stdout)["nodes"]]

    # A node tells how many devices it has when it renews its lease.
    wire.until(lambda: shown() == [("b", 4)], "all devices are shown")
    result = invoke("fleet", "drain", "plant", "a", "--nats", own_nats.url)
    assert result.exit_code == 1
    assert "there is no live node a" in result.stderr
    record_requests(caller)
    result = invoke("fleet", "drain", "plant", "a", "--nats", own_nats.url)
    assert result.exit_code == 1
    assert "there is no live node a" in result.stderr
    result = invoke("fleet", "drain", "plant", "b", "--nats", own_nats.url)
    assert (result.exit_code, result.stdout) == (0, "b has left the fleet plant.\n")
    result = invoke("fleet", "status", "none", "--nats", own_nats.url)
    assert result.exit_code == 1
    assert "no fleet none" in result.stderr

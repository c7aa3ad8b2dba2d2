"""Subscriptions with a `ttl` end unless they are repeated."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.scanner.jetstream.store import BUCKET
from holdfast.scanner.subscriptions.key import SubscriptionKey
from holdfast.scanner.subscriptions.ttl import SubscriptionTtls
from support import wire
from support.nats_bus import Caller, leaving, subscription, tag

if TYPE_CHECKING:
    import holdfast
    from support.nats_bus import Run


class Clock:
    """A clock that the test moves."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def ttls(clock: Clock) -> SubscriptionTtls:
    made = SubscriptionTtls(clock)
    made.connected(True)
    return made


KEY = SubscriptionKey("plc1", "hmi")


def test_a_subscription_is_due_when_its_time_is_over(ttls: SubscriptionTtls, clock: Clock) -> None:
    ttls.renew(KEY, 10)
    clock.now += 9.9
    assert not ttls.is_due(KEY)
    clock.now += 0.1
    assert ttls.is_due(KEY)
    assert not ttls.is_due(SubscriptionKey("plc1", "other"))


def test_a_repeated_request_starts_the_time_again(ttls: SubscriptionTtls, clock: Clock) -> None:
    ttls.renew(KEY, 10)
    clock.now += 9
    ttls.renew(KEY, 10)
    clock.now += 9
    assert not ttls.is_due(KEY)


def test_a_request_without_a_time_ends_the_time(ttls: SubscriptionTtls, clock: Clock) -> None:
    ttls.renew(KEY, 10)
    ttls.renew(KEY, None)
    clock.now += 1000
    assert not ttls.is_due(KEY)


def test_the_time_does_not_run_without_nats(ttls: SubscriptionTtls, clock: Clock) -> None:
    ttls.renew(KEY, 10)
    ttls.connected(False)
    clock.now += 1000
    assert not ttls.is_due(KEY)
    ttls.connected(True)
    clock.now += 9
    assert not ttls.is_due(KEY)
    clock.now += 1
    assert ttls.is_due(KEY)


def test_each_due_subscription_ends_once(ttls: SubscriptionTtls, clock: Clock) -> None:
    ended: list[SubscriptionKey] = []

    async def end(key: SubscriptionKey) -> None:
        ended.append(key)
        ttls.renew(key, None)

    async def run() -> None:
        running = asyncio.create_task(ttls.run(end))
        ttls.renew(KEY, 10)
        ttls.renew(SubscriptionKey("plc1", "trend"), 20)
        clock.now += 10
        ttls.renew(SubscriptionKey("plc2", "hmi"), 5)
        for _ in range(100):
            await asyncio.sleep(0)
        running.cancel()

    asyncio.run(run())
    assert ended == [KEY]


def browsed(caller: Caller) -> list[Any]:
    found: list[Any] = caller.request("modbus.browse", b"")["devices"]
    return found


@pytest.mark.usefixtures("scanner")
def test_a_subscription_that_is_not_repeated_ends(caller: Caller, server: holdfast.Server) -> None:
    staying = subscription(server, tag("b", 1), subscriberId="trend")
    assert caller.request("modbus.subscribe", staying)["success"]
    assert caller.request("modbus.subscribe", subscription(server, tag("a", 0), ttl=1))["success"]
    [device] = browsed(caller)
    assert {each["id"]: each.get("ttl") for each in device["subscribers"]} == {
        "trend": None,
        "hmi": 1,
    }
    wire.until(lambda: len(browsed(caller)[0]["subscribers"]) == 1, "the subscription ends")
    [device] = browsed(caller)
    assert [each["id"] for each in device["subscribers"]] == ["trend"]
    assert [each["id"] for each in device["tags"]] == ["b"]
    assert {each["subscriberId"] for each in _kept(caller)} == {"trend"}


@pytest.mark.usefixtures("scanner")
def test_the_last_subscription_of_a_device_closes_its_connection(
    caller: Caller, server: holdfast.Server
) -> None:
    assert caller.request("modbus.subscribe", subscription(server, tag("a", 0), ttl="1"))["success"]
    wire.until(lambda: browsed(caller) == [], "the subscription ends")
    wire.until(lambda: server.counters()["connections"]["open"] == 0, "the connection is closed")


def test_a_restored_subscription_ends_too(
    run_scanner: Run, caller: Caller, server: holdfast.Server
) -> None:
    first = run_scanner()
    assert caller.request("modbus.subscribe", subscription(server, tag("a", 0), ttl=2))["success"]
    first.stop()
    assert [each["ttl"] for each in _kept(caller)] == [2]
    run_scanner()
    wire.until(lambda: browsed(caller) == [], "the subscription ends")
    wire.until(lambda: _kept(caller) == [], "it is not kept any more")


@pytest.mark.usefixtures("scanner")
def test_an_unsubscribed_subscription_does_not_end_a_later_one(
    caller: Caller, server: holdfast.Server
) -> None:
    ending = subscription(server, tag("a", 0), ttl=1)
    assert caller.request("modbus.subscribe", ending)["success"]
    assert caller.request("modbus.unsubscribe", leaving("a"))["success"]
    assert caller.request("modbus.subscribe", subscription(server, tag("a", 0)))["success"]
    other = subscription(server, tag("a", 0), deviceId="plc2", ttl=1)
    assert caller.request("modbus.subscribe", other)["success"]
    wire.until(lambda: len(browsed(caller)) == 1, "the other subscription ends")
    assert [each["deviceId"] for each in browsed(caller)] == ["plc1"]


@pytest.mark.usefixtures("scanner")
@pytest.mark.parametrize(("ttl", "found"), [(0, ">= 1"), (31_536_001, "<= 31536000"), ("x", "int")])
def test_an_impossible_time_is_refused(
    caller: Caller, server: holdfast.Server, ttl: object, found: str
) -> None:
    answer = caller.request("modbus.subscribe", subscription(server, tag("a", 0), ttl=ttl))
    assert not answer["success"]
    assert "ttl" in answer["error"]
    assert found in answer["error"]


def _kept(caller: Caller) -> list[Any]:
    return [each for key, each in caller.kept(BUCKET).items() if "subscription" in key]

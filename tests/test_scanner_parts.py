"""Parts of the scanner by themselves: what is due, what is kept, how a device does."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING, Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from holdfast.scanner import outbox as outboxes
from holdfast.scanner.decoding import decoder
from holdfast.scanner.devices import Device, Plan, Source, Subscriber, Wanted
from holdfast.scanner.groups import Group, grouped
from holdfast.scanner.health import Health
from holdfast.scanner.outbox import Outbox
from holdfast.scanner.publishing import Publisher
from holdfast.scanner.tags import Tag
from holdfast.target import NetworkTarget

if TYPE_CHECKING:
    from collections.abc import Sequence

    from nats.aio.client import Client

    from holdfast.scanner.messages import Publish
    from holdfast.scanner.polling import Block

TARGET = NetworkTarget("tcp", "127.0.0.1", 502)


def made(id: str, address: int = 0, type: str = "uint16") -> Tag:
    return Tag(id, "holding_registers", address, type, "ABCD", frozenset())


def device(**subscribers: tuple[int, Publish, float, str]) -> Device:
    """A device whose subscribers have rate, mode, deadband, and tags of one letter."""
    found = Device("plc", Source(TARGET, 1, 1000, False, Plan()), TARGET, Health())
    for name, (rate, publish, deadband, ids) in subscribers.items():
        found.subscribers[name] = Subscriber(
            rate, publish, deadband, dict.fromkeys(ids, Wanted(False, None))
        )
        found.tags |= {id: made(id, ord(id) - ord("a")) for id in ids}
    return found


def told(groups: Sequence[Group]) -> list[tuple[bool, int, str, tuple[float, ...]]]:
    return [
        (group.change, group.rate, "".join(tag.id for tag in group.tags), group.deadbands)
        for group in groups
    ]


def test_a_tag_is_published_as_often_as_the_fastest_wants_it() -> None:
    groups = grouped(device(slow=(1000, "scan", 0.0, "abc"), fast=(100, "scan", 0.0, "bcd")))
    assert told(groups) == [
        (False, 100, "bcd", (0.0, 0.0, 0.0)),
        (False, 1000, "a", (0.0,)),
    ]


def test_changes_are_wanted_beside_scans_only_where_they_come_sooner() -> None:
    groups = grouped(
        device(
            scan=(500, "scan", 0.0, "ab"),
            sooner=(100, "change", 2.0, "a"),
            later=(500, "change", 0.0, "b"),
        )
    )
    assert told(groups) == [(False, 500, "ab", (0.0, 0.0)), (True, 100, "a", (2.0,))]


def test_a_deadband_is_kept_only_where_no_other_is_as_narrow_and_as_fast() -> None:
    groups = grouped(
        device(
            fast=(100, "change", 5.0, "ab"),
            slow=(1000, "change", 1.0, "a"),
            wide=(1000, "change", 7.0, "ab"),
        )
    )
    assert told(groups) == [(True, 100, "ab", (5.0, 5.0)), (True, 1000, "a", (1.0,))]


@given(
    st.dictionaries(
        st.sampled_from("pqrs"),
        st.tuples(
            st.sampled_from([50, 100, 1000]),
            st.sampled_from(["scan", "change"]),
            st.sampled_from([0.0, 1.0]),
            st.text("abc", min_size=1, max_size=3),
        ),
        min_size=1,
    )
)
def test_nobody_is_forgotten(subscribers: dict[str, tuple[int, Publish, float, str]]) -> None:
    groups = grouped(device(**subscribers))
    for rate, publish, deadband, ids in subscribers.values():
        for id in ids:
            assert any(
                group.rate <= rate
                and (not group.change or (publish == "change" and width <= deadband))
                for group in groups
                for tag, width in zip(group.tags, group.deadbands, strict=True)
                if tag.id == id
            )


class Line:
    """A publisher, and what it publishes at given times."""

    def __init__(self) -> None:
        self.publisher = Publisher("modbus", "plc")

    def at(self, seconds: float, *registers: int, address: int = 0) -> dict[str, Any]:
        """The values that are published for registers."""
        data = b"".join(register.to_bytes(2) for register in registers)
        block: Block = ("holding_registers", address, len(registers), data, 0)
        found = {}
        for id, text in self.publisher.messages(1_700_000_000 + seconds, [block]):
            head, _, payload = text.partition(b"\r\n")
            word, subject, size = head.decode().split()
            assert (word, subject, int(size) + 2) == ("PUB", "modbus.data.plc", len(payload))
            message = json.loads(payload)
            assert message["variableId"] == id
            found[id] = message["value"]
        return found


@pytest.mark.parametrize(
    ("interval", "rate", "published"),
    [
        (1000, 1000, [0, 1, 2, 3, 4, 5, 6]),
        (1000, 2000, [0, 2, 4, 6]),
        (1000, 2500, [0, 3, 6]),
        (1000, 60_000, [0]),
    ],
)
def test_messages_are_never_closer_than_their_rate(
    interval: int, rate: int, published: list[int]
) -> None:
    line = Line()
    line.publisher.regroup([Group(rate, False, (made("a"),), (0.0,))], interval, set())
    jitter = [0.0, 0.01, -0.01, 0.02, 0.0, 0.01, 0.0]
    assert [second for second in range(7) if line.at(second + jitter[second], 1)] == published


def test_a_device_that_is_scanned_anew_does_not_publish_too_early() -> None:
    line = Line()
    group = Group(1000, False, (made("a"),), (0.0,))
    line.publisher.regroup([group], 1000, set())
    assert line.at(0, 1)
    more = Group(1000, False, (made("a"), made("b", 1)), (0.0, 0.0))
    line.publisher.regroup([more], 1000, {"b"})
    assert line.at(0.3, 1, 2) == {"b": 2}
    assert line.at(1.3, 1, 2) == {"a": 1, "b": 2}


@pytest.mark.parametrize("change", [False, True])
def test_a_new_tag_does_not_wait_for_the_others(change: bool) -> None:
    line = Line()

    def regroup(ids: str, *newcomers: str) -> None:
        tags = tuple(made(id, ord(id) - ord("a")) for id in ids)
        group = Group(60_000, change, tags, (0.0,) * len(tags))
        line.publisher.regroup([group], 60_000, set(newcomers))

    regroup("a", "a")
    assert line.at(0, 1, 2, 3) == {"a": 1}
    regroup("ab", "b")
    regroup("abc", "c")
    assert line.publisher.messages(1_700_000_000, []) == []
    assert line.at(0.1, 9, 2, 3) == {"b": 2, "c": 3}
    regroup("ab")
    assert line.at(0.2, 9, 2, 3) == {}
    assert line.at(60.2, 9, 2, 3) == ({"a": 9} if change else {"a": 9, "b": 2})
    assert line.at(120.2, 9, 2, 3) == ({} if change else {"a": 9, "b": 2})


def test_a_new_tag_comes_once_when_the_others_are_due_too() -> None:
    line = Line()
    line.publisher.regroup([Group(1000, False, (made("a"),), (0.0,))], 1000, set())
    assert line.at(0, 1)
    more = Group(1000, False, (made("a"), made("b", 1)), (0.0, 0.0))
    line.publisher.regroup([more], 1000, set())
    block: Block = ("holding_registers", 0, 2, b"\0\1\0\2", 0)
    ids = [id for id, _ in line.publisher.messages(1_700_000_001, [block])]
    assert sorted(ids) == ["a", "b"]


def test_a_clock_that_goes_back_stops_nothing() -> None:
    line = Line()
    line.publisher.regroup([Group(5000, False, (made("a"),), (0.0,))], 1000, set())
    assert line.at(0, 1)
    assert not line.at(1, 1)
    assert line.at(-3600, 1)


def test_a_value_that_somebody_else_got_is_no_change() -> None:
    line = Line()
    scans = Group(2000, False, (made("a"),), (0.0,))
    changes = Group(1000, True, (made("a"),), (0.0,))
    line.publisher.regroup([scans, changes], 1000, set())
    assert [line.at(second, 7) for second in range(4)] == [{"a": 7}, {}, {"a": 7}, {}]
    assert line.at(5, 8) == {"a": 8}


def test_a_tag_that_two_blocks_have_is_published_once() -> None:
    line = Line()
    line.publisher.regroup([Group(1000, False, (made("a", 1),), (0.0,))], 1000, set())
    one: Block = ("holding_registers", 0, 2, b"\0\0\0\1", 0)
    two: Block = ("holding_registers", 1, 1, b"\0\1", 0)
    assert len(line.publisher.messages(1_700_000_000, [one, two])) == 1
    failed: Block = ("holding_registers", 0, 2, None, 2)
    assert len(line.publisher.messages(1_700_000_001, [failed, two])) == 1


def test_blocks_that_change_all_the_time_are_not_all_remembered() -> None:
    line = Line()
    line.publisher.regroup([Group(50, False, (made("a", 500),), (0.0,))], 50, set())
    for start in range(300):
        assert line.at(start, *range(501), address=start)["a"] == 500 - start
    assert len(line.publisher._shapes) <= 64


@given(st.binary(min_size=3, max_size=3))
def test_bits_are_taken_from_their_places(data: bytes) -> None:
    tags = [Tag(f"{at}", "coils", at, "bool", "ABCD", frozenset()) for at in range(7, 31)]
    values = decoder(tags, 7, 24)(data)
    assert values == [bool(data[at // 8] >> at % 8 & 1) for at in range(24)]


class Wire:
    """A connection that takes as much as a test wants."""

    def __init__(self) -> None:
        self.is_connected = True
        self.pending_data_size = 0
        self.sent: list[bytes] = []
        self.stats = {"out_msgs": 0, "out_bytes": 0}
        self._flush_queue = None

    async def _send_command(self, texts: bytes) -> None:
        self.sent.append(texts)


async def _run(outbox: Outbox, seconds: float = 0.1) -> None:
    running = asyncio.create_task(outbox.run())
    await asyncio.wait([running], timeout=seconds)
    running.cancel()


def test_messages_flow_in_order_while_they_are_taken() -> None:
    async def flow() -> list[bytes]:
        wire, outbox = Wire(), Outbox()
        outbox.connected(cast("Client", wire))
        outbox.put([("a", b"1"), ("b", b"2"), ("a", b"3")])
        outbox.put([("a", b"4")])
        await _run(outbox)
        return wire.sent

    assert asyncio.run(flow()) == [b"1234"]


def test_each_has_its_turn_while_more_comes_than_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outboxes, "LOOK", 0.001)
    monkeypatch.setattr(outboxes, "PIECE", 20)
    keys = range(100)

    async def flow() -> list[bytes]:
        wire, outbox = Wire(), Outbox()
        outbox.put([(key, b"%02d" % key) for key in keys])
        outbox.connected(cast("Client", wire))
        running = asyncio.create_task(outbox.run())
        while len(wire.sent) < 30:
            await asyncio.sleep(0)
            wire.pending_data_size = 0
            outbox.put([(key, b"%02d" % key) for key in keys])
        running.cancel()
        return wire.sent

    sent = b"".join(asyncio.run(flow()))
    assert {int(sent[at : at + 2]) for at in range(0, len(sent), 2)} == set(keys)


@pytest.mark.parametrize("how", ["away", "slow"])
def test_the_newest_of_each_is_kept_while_they_are_not_taken(
    how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outboxes, "LOOK", 0.001)

    async def flow() -> tuple[Outbox, list[bytes]]:
        wire, outbox = Wire(), Outbox(most=3)
        if how == "slow":
            wire.pending_data_size = outboxes.BACKLOG
            outbox.connected(cast("Client", wire))
        for text in (b"a1", b"b1", b"a2", b"c1", b"b2", b"d1"):
            outbox.put([(text[:1], text)])
        await _run(outbox)
        assert wire.sent == []
        wire.pending_data_size = 0
        outbox.connected(cast("Client", wire))
        await _run(outbox)
        outbox.put([("e", b"e1"), ("e", b"e2")])
        await _run(outbox)
        return outbox, wire.sent

    outbox, sent = asyncio.run(flow())
    assert sent == [b"b2c1d1", b"e1e2"]
    assert (outbox.sent, outbox.replaced, outbox.dropped) == (5, 2, 1)


def judged(*polls: Sequence[int]) -> list[tuple[bool, str, int, str | None]]:
    """What becomes of a device whose blocks have these faults, poll by poll."""
    health = Health()
    found: list[tuple[bool, str, int, str | None]] = []
    for faults in polls:
        blocks: list[Block] = [
            ("coils", at, 1, None if fault else b"\0", fault) for at, fault in enumerate(faults)
        ]
        worth = health.judge(1.0, blocks)
        found.append((worth, health.state, health.failures, health.error))
    return found


def test_a_device_is_told_of_when_it_comes_or_goes_or_refuses_something_new() -> None:
    refused = "exception 02 (Illegal Data Address)"
    assert judged([0], [0], [0, 2], [0, 2], [0, 0], [0x8001], [0x8002], [2], [0x0B], [0]) == [
        (True, "online", 0, None),
        (False, "online", 0, None),
        (True, "online", 0, refused),
        (False, "online", 0, refused),
        (True, "online", 0, None),
        (True, "offline", 1, "no reply in time"),
        (False, "offline", 2, "no connection"),
        (True, "online", 0, refused),
        (True, "offline", 1, "exception 0B (Gateway Target Device Failed to Respond)"),
        (True, "online", 0, None),
    ]

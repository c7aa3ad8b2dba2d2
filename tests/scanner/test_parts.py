"""Parts of the scanner by themselves: what is due, what is kept, how a device does."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING, Any, cast

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nats.aio.msg import Msg

from holdfast.client.url import NetworkTarget
from holdfast.net.nats import batch
from holdfast.net.nats import outbox as outboxes
from holdfast.net.nats.connection import (
    FIRST_PAUSE_S,
    MAX_LOGGED,
    MAX_PAUSE_S,
    PROVEN_S,
    NatsConnection,
    Ping,
    Servers,
)
from holdfast.net.nats.outbox import Outbox
from holdfast.net.nats.tolerant_client import SafeClient
from holdfast.scanner import responder
from holdfast.scanner.commands import Commands
from holdfast.scanner.dialects import TENTACLE
from holdfast.scanner.errors import Moved
from holdfast.scanner.jetstream.heartbeat_key import HeartbeatKey
from holdfast.scanner.messages.decoding import Adjustments
from holdfast.scanner.messages.types import (
    Answer,
    BrowseRequest,
    EntryReport,
    HeartbeatMetadata,
    ServiceReport,
    SubscribeRequest,
    TagRequest,
)
from holdfast.scanner.placement import Placement
from holdfast.scanner.publish.publisher import Publisher
from holdfast.scanner.reports.browse import browsed
from holdfast.scanner.responder import Responder
from holdfast.scanner.settings import Settings
from holdfast.scanner.subscriptions.device import (
    ScannedDevice,
    Source,
    Subscriber,
    TagOptions,
)
from holdfast.scanner.subscriptions.groups import Group, grouped
from holdfast.scanner.subscriptions.health import Health
from holdfast.scanner.subscriptions.plan import Plan
from holdfast.scanner.subscriptions.registry import Registry
from holdfast.scanner.subscriptions.request_rules import Rules, ScannerLimits
from holdfast.scanner.subscriptions.subscription import subscription_of
from holdfast.scanner.subscriptions.tag import ScannedTag
from holdfast.tags.decoding import Places, decoder
from support.nats_bus import logged
from support.wire import DEADLINE

if TYPE_CHECKING:
    from collections.abc import Sequence

    from nats.aio.client import Client

    from holdfast.config.values.scanner_settings import Publish
    from holdfast.types import PolledBlock

TARGET = NetworkTarget("tcp", "127.0.0.1", 502)
ANSWERED = 1_700_000_000.0
"""Seconds since 1970."""


def made(id: str, address: int = 0, type: str = "uint16") -> ScannedTag:
    return ScannedTag(id, "holding_registers", address, type, "ABCD", frozenset())


def device(**subscribers: tuple[int, Publish, float, str]) -> ScannedDevice:
    """A device whose subscribers have rate, mode, deadband, and tags of one letter."""
    found = ScannedDevice("plc", Source(TARGET, 1, 1000, False, Plan()), TARGET, Health())
    for name, (rate, publish, deadband, ids) in subscribers.items():
        found.subscribers[name] = Subscriber(
            rate, publish, deadband, dict.fromkeys(ids, TagOptions(False, None))
        )
        found.tags |= {id: made(id, ord(id) - ord("a")) for id in ids}
    return found


def contents(groups: Sequence[Group]) -> list[tuple[bool, int, str, tuple[float, ...]]]:
    return [
        (group.change, group.rate, "".join(tag.id for tag in group.tags), group.deadbands)
        for group in groups
    ]


def test_a_tag_is_published_as_often_as_the_fastest_wants_it() -> None:
    groups = grouped(device(slow=(1000, "scan", 0.0, "abc"), fast=(100, "scan", 0.0, "bcd")))
    assert contents(groups) == [
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
    assert contents(groups) == [(False, 500, "ab", (0.0, 0.0)), (True, 100, "a", (2.0,))]


def test_a_deadband_is_kept_only_where_no_other_is_as_narrow_and_as_fast() -> None:
    groups = grouped(
        device(
            fast=(100, "change", 5.0, "ab"),
            slow=(1000, "change", 1.0, "a"),
            wide=(1000, "change", 7.0, "ab"),
        )
    )
    assert contents(groups) == [(True, 100, "ab", (5.0, 5.0)), (True, 1000, "a", (1.0,))]


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
        block: PolledBlock = ("holding_registers", address, len(registers), data, 0, ANSWERED)
        found = {}
        for id, text in self.publisher.messages(seconds, [block]):
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
        (900, 1000, [0, 2, 4, 6]),
        (1000, 1250, [0, 2, 4, 6]),
    ],
)
def test_messages_are_never_closer_than_their_rate(
    interval: int, rate: int, published: list[int]
) -> None:
    line = Line()
    line.publisher.regroup([Group(rate, False, (made("a"),), (0.0,))], set())
    scans = [line.at(0.123456789 + scan * interval / 1000, 1) for scan in range(7)]
    assert [scan for scan, values in enumerate(scans) if values] == published


def test_a_device_that_is_scanned_anew_does_not_publish_too_early() -> None:
    line = Line()
    group = Group(1000, False, (made("a"),), (0.0,))
    line.publisher.regroup([group], set())
    assert line.at(0, 1)
    more = Group(1000, False, (made("a"), made("b", 1)), (0.0, 0.0))
    line.publisher.regroup([more], {"b"})
    assert line.at(0.3, 1, 2) == {"b": 2}
    assert line.at(1.3, 1, 2) == {"a": 1, "b": 2}


@pytest.mark.parametrize("change", [False, True])
def test_everything_is_published_anew_when_that_is_asked_for(change: bool) -> None:
    line = Line()
    tags = tuple(made(id, ord(id) - ord("a")) for id in "abc")
    seldom = Group(60_000, change, tags[:2], (0.0, 0.0))
    often = Group(1000, False, tags[2:], (0.0,))
    line.publisher.update(lambda: [often, seldom])
    assert line.at(0, 1, 2, 3) == {"a": 1, "b": 2, "c": 3}
    assert line.at(1, 1, 2, 3) == {"c": 3}
    line.publisher.repeat_all()
    assert line.at(1.5, 1, 2, 3) == {"a": 1, "b": 2, "c": 3}
    assert line.at(2.5, 1, 2, 3) == {"c": 3}


def test_who_comes_to_known_tags_gets_their_next_values() -> None:
    line = Line()
    tags = tuple(made(id, ord(id) - ord("a")) for id in "ab")
    line.publisher.update(lambda: [Group(60_000, False, tags, (0.0, 0.0))])
    assert line.at(0, 1, 2) == {"a": 1, "b": 2}
    for newcomers in (["a"], ["b"]):
        line.publisher.update(lambda: [Group(60_000, False, tags, (0.0, 0.0))], newcomers)
    line.publisher.update(lambda: [Group(60_000, False, tags, (0.0, 0.0))])
    assert line.at(10, 1, 2) == {"a": 1, "b": 2}
    line.publisher.update(lambda: [Group(60_000, False, tags, (0.0, 0.0))], ["b", "gone"])
    assert line.at(20, 1, 2) == {"b": 2}
    assert line.at(30, 1, 2) == {}


def test_thousands_of_tags_far_apart_cost_no_more_each_than_a_few(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    count = 0
    end: Any = ScannedTag.end

    def counted(tag: ScannedTag) -> int:
        nonlocal count
        count += 1
        return int(end.fget(tag))

    monkeypatch.setattr(ScannedTag, "end", property(counted))
    tags = {f"t{at}": made(f"t{at}", 12 * at) for at in range(2000)}
    plc = device()
    plc.tags = tags
    plc.subscribers["x"] = Subscriber(
        1000, "scan", 0.0, dict.fromkeys(tags, TagOptions(False, None))
    )
    blocks: list[PolledBlock] = [
        ("holding_registers", 12 * at, 1, b"\0\1", 0, ANSWERED) for at in range(2000)
    ]
    line = Line()
    line.publisher.update(lambda: grouped(plc))
    assert len(line.publisher.messages(0, blocks)) == 2000
    assert count <= 2 * 2000
    plc.health.judge([(*block[:3], None, 2, ANSWERED) for block in blocks])
    service = ServiceReport(0, 0, 0, 0, 0)
    answer = browsed(BrowseRequest("plc"), {"plc": plc}, {}, service, 2**20)
    [report] = answer.devices
    assert len(report.blocks or []) == len(report.tags or []) == 2000
    assert all(each.error for each in report.tags or [])
    assert count <= 8 * 2000


@given(
    st.lists(st.tuples(st.integers(0, 60), st.integers(1, 5)), max_size=20),
    st.integers(0, 60),
    st.integers(1, 20),
)
def test_tags_are_found_where_a_block_has_them_whole(
    places: list[tuple[int, int]], address: int, count: int
) -> None:
    tags = [
        ScannedTag(f"{at}", area, start, f"uint16[{size}]", "ABCD", frozenset())
        for at, (start, size) in enumerate(places)
        for area in ("holding_registers", "input_registers")
    ]
    found = Places(tags).inside("input_registers", address, count)
    assert sorted(tag.id for tag in found) == sorted(
        tag.id
        for tag in tags
        if tag.area == "input_registers" and address <= tag.address
        if tag.address + tag.count <= address + count
    )


@pytest.mark.parametrize("change", [False, True])
def test_a_new_tag_does_not_wait_for_the_others(change: bool) -> None:
    line = Line()

    def regroup(ids: str, *newcomers: str) -> None:
        tags = tuple(made(id, ord(id) - ord("a")) for id in ids)
        group = Group(60_000, change, tags, (0.0,) * len(tags))
        line.publisher.regroup([group], set(newcomers))

    regroup("a", "a")
    assert line.at(0, 1, 2, 3) == {"a": 1}
    regroup("ab", "b")
    regroup("abc", "c")
    assert line.publisher.messages(0, []) == []
    assert line.at(0.1, 9, 2, 3) == {"b": 2, "c": 3}
    regroup("ab")
    assert line.at(0.2, 9, 2, 3) == {}
    assert line.at(60.2, 9, 2, 3) == ({"a": 9} if change else {"a": 9, "b": 2})
    assert line.at(120.2, 9, 2, 3) == ({} if change else {"a": 9, "b": 2})


def test_a_new_tag_comes_once_when_the_others_are_due_too() -> None:
    line = Line()
    line.publisher.regroup([Group(1000, False, (made("a"),), (0.0,))], set())
    assert line.at(0, 1)
    more = Group(1000, False, (made("a"), made("b", 1)), (0.0, 0.0))
    line.publisher.regroup([more], set())
    block: PolledBlock = ("holding_registers", 0, 2, b"\0\1\0\2", 0, ANSWERED)
    ids = [id for id, _ in line.publisher.messages(1, [block])]
    assert sorted(ids) == ["a", "b"]


def test_a_value_that_somebody_else_got_is_no_change() -> None:
    line = Line()
    scans = Group(2000, False, (made("a"),), (0.0,))
    changes = Group(1000, True, (made("a"),), (0.0,))
    line.publisher.regroup([scans, changes], set())
    assert [line.at(second, 7) for second in range(4)] == [{"a": 7}, {}, {"a": 7}, {}]
    assert line.at(5, 8) == {"a": 8}


def test_a_tag_that_two_blocks_have_is_published_once() -> None:
    line = Line()
    line.publisher.regroup([Group(1000, False, (made("a", 1),), (0.0,))], set())
    one: PolledBlock = ("holding_registers", 0, 2, b"\0\0\0\1", 0, ANSWERED)
    two: PolledBlock = ("holding_registers", 1, 1, b"\0\1", 0, ANSWERED)
    assert len(line.publisher.messages(0, [one, two])) == 1
    failed: PolledBlock = ("holding_registers", 0, 2, None, 2, ANSWERED)
    assert len(line.publisher.messages(1, [failed, two])) == 1


def test_a_block_has_all_of_its_tags_again_when_no_other_has_them() -> None:
    line = Line()
    tags = (made("a", 0), made("b", 1), made("c", 2))
    line.publisher.regroup([Group(1, False, tags, (0.0,) * 3)], set())
    one: PolledBlock = ("holding_registers", 0, 2, b"\0\0\0\1", 0, ANSWERED)
    two: PolledBlock = ("holding_registers", 1, 2, b"\0\1\0\2", 0, ANSWERED)
    assert [id for id, _ in line.publisher.messages(0, [one, two])] == ["a", "b", "c"]
    assert [id for id, _ in line.publisher.messages(1, [two])] == ["b", "c"]
    assert [id for id, _ in line.publisher.messages(2, [two, one])] == ["b", "c", "a"]
    assert [id for id, _ in line.publisher.messages(3, [one])] == ["a", "b"]


@pytest.mark.parametrize("change", [False, True])
def test_a_first_value_that_a_scan_does_not_bring_is_waited_for(change: bool) -> None:
    line = Line()
    tags = (made("a", 0), made("b", 50), made("c", 99))
    seldom = Group(60_000, change, tags[:2], (0.0, 0.0))
    line.publisher.regroup([Group(1000, False, tags[2:], (0.0,)), seldom], set())
    assert line.at(0, 1) == {"a": 1}
    assert line.at(1, 9) == {}
    assert line.at(2, 2, address=50) == {"b": 2}
    assert line.at(3, 3, address=50) == {}
    assert line.at(60, 4) == {"a": 4}


def test_blocks_that_change_all_the_time_are_not_all_remembered() -> None:
    line = Line()
    line.publisher.regroup([Group(50, False, (made("a", 500),), (0.0,))], set())
    for start in range(300):
        assert line.at(start, *range(501), address=start)["a"] == 500 - start
    assert len(line.publisher._shapes) <= 64


@given(st.binary(min_size=3, max_size=3))
def test_bits_are_taken_from_their_places(data: bytes) -> None:
    tags = [ScannedTag(f"{at}", "coils", at, "bool", "ABCD", frozenset()) for at in range(7, 31)]
    values = decoder(tags, 7, 24)(data)
    assert values == [bool(data[at // 8] >> at % 8 & 1) for at in range(24)]


class Wire:
    """A connection that takes as much as a test wants."""

    def __init__(self) -> None:
        self.is_connected = True
        self.pending_data_size = 0
        self.max_payload = 2**20
        self.sent: list[bytes] = []
        self.stats = {"out_msgs": 0, "out_bytes": 0}

    async def _send_command(self, texts: bytes) -> None:
        self.sent.append(texts)

    async def _flush_pending(self) -> None: ...


async def _run(outbox: Outbox, seconds: float = 0.1) -> None:
    running = asyncio.create_task(outbox.run())
    await asyncio.wait([running], timeout=seconds)
    running.cancel()


def test_a_server_whose_answer_waits_behind_messages_is_not_given_up() -> None:
    async def outstanding() -> int:
        client = SafeClient()
        client._pings_outstanding = 3
        client.transport._io_reader = asyncio.StreamReader()
        client.transport._io_reader.feed_data(b"+OK\r\n")
        await client.transport.read(100)
        return client._pings_outstanding

    assert asyncio.run(outstanding()) == 0


def test_an_error_of_the_server_is_logged_once_and_as_it_is_spelled(
    caplog: pytest.LogCaptureFixture,
) -> None:
    reasons = [f'Permissions Violation for Publish to "$KV.{each}"' for each in "AAbb"]

    async def receive() -> None:
        client = SafeClient()
        broker = NatsConnection(Servers(), {}, lambda _: None, Ping(), name="test")
        broker.client = client

        async def failed(error: Exception) -> None:
            broker._note(client, error)

        client._error_cb = failed
        client.transport._io_reader = asyncio.StreamReader()
        client.transport._io_reader.feed_data(
            b"".join(b"-ERR '%b'\r\n" % r.encode() for r in reasons)
        )
        await client._ps.parse(await client.transport.read(1000))

    asyncio.run(receive())
    assert [each["reason"] for each in logged(caplog, "nats_error")] == [
        f"nats: {each}" for each in reasons[1:3]
    ]


def test_reasons_that_alternate_are_logged_once_each(caplog: pytest.LogCaptureFixture) -> None:
    client = SafeClient()
    client.options = {}
    broker = NatsConnection(Servers(), {}, lambda _: None, Ping(), name="test")
    for reason in ("Connection lost", "Broken pipe") * 5:
        broker._note(client, OSError(reason))
    assert [each["attempts"] for each in logged(caplog, "nats_connect_failed")] == [1, 2]
    for number in range(2 * MAX_LOGGED):
        broker._note(client, OSError(str(number)))
    assert len(broker._logged) == MAX_LOGGED


def test_a_server_that_ends_each_connection_is_asked_less_and_less_often() -> None:
    client = SafeClient()
    client.options = {}
    broker = NatsConnection(Servers(), {}, lambda _: None, Ping(), name="test")

    def pause_after(connection_s: float) -> float:
        broker._note_connected(client)
        broker._connected_at -= connection_s
        broker._note_lost("tested")
        return float(client.options["reconnect_time_wait"])

    assert max(pause_after(0.0) for _ in range(10)) >= 0.75 * MAX_PAUSE_S
    assert pause_after(PROVEN_S) <= FIRST_PAUSE_S, "this one was not ended at once"
    broker._note(client, OSError("refused"))
    assert client.options["reconnect_time_wait"] <= FIRST_PAUSE_S, "the first failure to connect"


def test_messages_flow_in_order_while_they_are_taken() -> None:
    async def flow() -> list[bytes]:
        wire, outbox = Wire(), Outbox()
        outbox.connected(cast("SafeClient", wire))
        outbox.put([("a", b"1"), ("b", b"2"), ("a", b"3")])
        outbox.put([("a", b"4")])
        await _run(outbox)
        return wire.sent

    assert asyncio.run(flow()) == [b"1234"]


def test_each_has_its_turn_while_more_comes_than_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outboxes, "CHECK_INTERVAL_S", 0.001)
    monkeypatch.setattr(outboxes, "MAX_BATCH_BYTES", 20)
    keys = range(100)

    async def flow() -> list[bytes]:
        wire, outbox = Wire(), Outbox()
        outbox.put([(key, b"%02d" % key) for key in keys])
        outbox.connected(cast("SafeClient", wire))
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
    monkeypatch.setattr(outboxes, "CHECK_INTERVAL_S", 0.001)

    async def flow() -> tuple[Outbox, list[bytes]]:
        wire, outbox = Wire(), Outbox(max_kept=3)
        if how == "slow":
            wire.pending_data_size = outboxes.MAX_BACKLOG_BYTES
            outbox.connected(cast("SafeClient", wire))
        for text in (b"a1", b"b1", b"a2", b"c1", b"b2", b"d1"):
            outbox.put([(text[:1], text)])
        await _run(outbox)
        assert wire.sent == []
        wire.pending_data_size = 0
        outbox.connected(cast("SafeClient", wire))
        await _run(outbox)
        outbox.put([("e", b"e1"), ("e", b"e2")])
        await _run(outbox)
        return outbox, wire.sent

    outbox, sent = asyncio.run(flow())
    assert sent == [b"b2c1d1", b"e1e2"]
    assert (outbox.sent, outbox.replaced, outbox.dropped) == (5, 2, 1)


@pytest.mark.parametrize("how", ["connected", "away"])
def test_a_message_that_the_server_does_not_take_is_dropped_and_logged_once(
    how: str, caplog: pytest.LogCaptureFixture
) -> None:
    small, most, large = (batch.text("d.x", b"1" * size) for size in (1, 100, 101))
    leased = batch.leased(small, 12345678)
    assert len(leased) < len(most)

    async def flow() -> list[bytes]:
        wire, outbox = Wire(), Outbox()
        wire.max_payload = 100
        if how == "connected":
            outbox.connected(cast("SafeClient", wire))
        outbox.put([("a", small), ("b", most), ("c", large), ("e", leased)], of="x")
        outbox.put([("c", large), ("d", large)], of="x")
        outbox.connected(cast("SafeClient", wire))
        await _run(outbox)
        return wire.sent

    assert b"".join(asyncio.run(flow())) == small + most + leased
    reason = "found 101 bytes, the server takes 100"
    assert logged(caplog, "message_too_large") == [
        {"subject": "d.x", "tag": tag, "reason": reason} for tag in "cd"
    ]


def test_an_answer_that_the_server_does_not_take_is_an_error() -> None:
    async def answered() -> list[bytes]:
        wire, outbox = Wire(), Outbox()
        wire.max_payload = 100 + len(batch.ANSWER_HEADER)
        outbox.connected(cast("SafeClient", wire))
        responder = Responder(10, outbox)

        async def handle(message: Msg) -> bytes:
            return b"1" * len(message.data)

        for size in (100, 101):
            message = Msg(cast("Client", wire), reply="r", data=b"1" * size)
            await responder.answering("browse", handle)(message)
        await responder.finish(DEADLINE)
        return wire.sent

    error = b'{"success":false,"error":"the answer is too large: 101 bytes, allowed: 100"}'
    texts = [batch.answer("r", b"1" * 100), batch.answer("r", error)]
    assert asyncio.run(answered()) == texts


@pytest.mark.parametrize("reply", ["$KV.holdfast_scanner.modbus.d", "$JS.A"])
def test_a_request_is_not_answered_on_a_subject_of_nats(
    caplog: pytest.LogCaptureFixture, reply: str
) -> None:
    """Its sender may have no right to publish to that subject."""

    async def sent() -> list[bytes]:
        wire, outbox = Wire(), Outbox()
        outbox.connected(cast("SafeClient", wire))
        responder = Responder(10, outbox)

        async def handle(_: Msg) -> bytes:
            return b"1"

        for subject in (reply, "modbus.inbox"):
            message = Msg(cast("Client", wire), "modbus.browse", reply=subject)
            await responder.answering("browse", handle)(message)
        await responder.finish(DEADLINE)
        return wire.sent

    assert asyncio.run(sent()) == [batch.answer("modbus.inbox", b"1")]
    reason = f"no answer to {reply}: a reply subject can't begin with $"
    assert logged(caplog, "message_malformed") == [{"subject": "modbus.browse", "reason": reason}]


def test_all_devices_are_browsed_beside_a_large_report_of_the_service() -> None:
    most, devices = 20_000, {}
    for number in range(40):
        devices[f"d{number:02}"] = found = device(hmi=(1000, "scan", 0.0, "abcdefgh"))
        found.id = f"d{number:02}"
    entry = EntryReport(key="k" * 200, error="e" * 200)
    service = ServiceReport(0, 0, 0, 0, 0, refused_entries=[entry] * 40)
    ids: list[str] = []
    while len(ids) < len(devices):
        answer = browsed(BrowseRequest(offset=len(ids)), devices, {}, service, most)
        assert len(msgspec.json.encode(answer)) <= most
        assert answer.devices
        ids += [each.device_id for each in answer.devices]
        assert answer.next == (len(ids) if len(ids) < len(devices) else None)
    assert ids == sorted(devices)


def test_a_tag_that_does_not_fit_into_a_page_does_not_end_the_pages() -> None:
    """Its subscribers may take more than a message."""
    found = device(**{f"s{number}": (1000, "scan", 0.0, "ab") for number in range(200)})
    service = ServiceReport(0, 0, 0, 0, 0)
    request = BrowseRequest(device_id="plc", tag_offset=0)
    answer = browsed(request, {"plc": found}, {}, service, 8192)
    assert (answer.next_tag, answer.devices[0].tags) == (1, None)


def judged(*polls: Sequence[int]) -> list[tuple[bool, str, int, str | None]]:
    """What becomes of a device whose blocks have these faults, poll by poll."""
    health = Health()
    found: list[tuple[bool, str, int, str | None]] = []
    for faults in polls:
        blocks: list[PolledBlock] = [
            ("coils", at, 1, None if fault else b"\0", fault, ANSWERED)
            for at, fault in enumerate(faults)
        ]
        worth = health.judge(blocks)
        found.append((worth, health.state, health.failures, health.error))
    return found


def test_a_device_is_told_of_when_it_comes_or_goes_or_refuses_something_new() -> None:
    refused = "exception 02 (Illegal Data Address)"
    assert judged([0], [0], [0, 2], [0, 2], [0, 0], [0x8001], [0x8001], [0x8002], [2]) == [
        (True, "online", 0, None),
        (False, "online", 0, None),
        (True, "online", 0, refused),
        (False, "online", 0, refused),
        (True, "online", 0, None),
        (True, "online", 1, "no reply in time"),
        (True, "offline", 2, "no reply in time"),
        (False, "offline", 3, "no connection"),
        (True, "online", 0, refused),
    ]


def test_one_scan_without_an_answer_is_forgiven_unless_there_is_no_connection() -> None:
    gateway = "exception 0B (Gateway Target Device Failed To Respond)"
    assert [found[1:] for found in judged([0], [0x0B], [0], [0x8003], [0], [0x8002], [0])] == [
        ("online", 0, None),
        ("online", 1, gateway),
        ("online", 0, None),
        ("online", 1, "the connection was lost"),
        ("online", 0, None),
        ("offline", 1, "no connection"),
        ("online", 0, None),
    ]
    assert judged([0x8001]) == [(True, "offline", 1, "no reply in time")]


def poll(*blocks: tuple[int, int, float]) -> list[PolledBlock]:
    """Blocks of one register with address, fault and time."""
    return [
        ("holding_registers", at, 1, None if fault else b"\0\0", fault, time)
        for at, fault, time in blocks
    ]


def test_the_last_error_stays_with_its_time_and_so_does_that_of_the_state() -> None:
    health = Health()
    health.judge(poll((0, 0, 10.0)))
    assert (health.since, health.last_error, health.last_error_at) == (10.0, None, None)
    for time in (20.0, 30.0):
        health.judge(poll((0, 0x8002, time)))
    assert (health.since, health.last_error_at) == (20.0, 30.0)
    health.judge(poll((0, 0, 40.0)))
    assert (health.state, health.error, health.since) == ("online", None, 40.0)
    assert (health.last_error, health.last_error_at) == ("no connection", 30.0)
    assert not health.judge([])
    assert health.state == "online"


def test_blocks_that_a_scan_did_not_come_to_stay_as_they_were() -> None:
    health = Health()
    health.judge(poll((0, 0, 1.0), (5, 2, 1.0), (9, 0, 1.0)))
    health.judge(poll((9, 0x8001, 2.0)))
    assert sorted((block[1], block[4]) for block in health.blocks) == [(0, 0), (5, 2), (9, 0x8001)]
    health.judge([("holding_registers", 4, 3, None, 0x8001, 3.0)])
    assert sorted(block[1] for block in health.blocks) == [0, 4, 9]
    health.judge(poll((0, 0, 4.0)))
    assert [block[1] for block in health.blocks] == [0]


def test_a_heartbeat_that_fails_after_the_stop_is_not_logged(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A stop does not wait longer for JetStream than the scanner does."""

    class Jetstream:
        def __init__(self) -> None:
            self.asked, self.answer = asyncio.Event(), asyncio.Event()

        def jetstream(self, **_: object) -> Jetstream:
            return self

        async def key_value(self, _: str) -> object:
            self.asked.set()
            await self.answer.wait()
            raise TimeoutError

    async def beaten(*, stopped: bool) -> list[str]:
        caplog.clear()
        heart = HeartbeatKey("plant", lambda: HeartbeatMetadata(0, 0, "1"), lambda _: None)
        server = Jetstream()
        client = cast("Client", server)
        beating = asyncio.create_task(heart.beat(client))
        await server.asked.wait()
        if stopped:
            await heart.stop(client)
        server.answer.set()
        await beating
        return [record.getMessage() for record in caplog.records]

    assert asyncio.run(beaten(stopped=False)) == ["no_heartbeat"]
    assert asyncio.run(beaten(stopped=True)) == []


def test_a_command_that_was_not_written_is_not_confirmed() -> None:
    class Elsewhere(Placement):
        def takes_writes(self, _device: ScannedDevice, /) -> bool:
            return False

    settings, registry = Settings(), Registry(ScannerLimits())
    registry.devices["plc"] = device(hmi=(1000, "scan", 0.0, "a"))
    unused = cast("Any", None)
    commands = Commands(settings, TENTACLE, registry, unused, Elsewhere(), unused)
    with pytest.raises(Moved, match="not written: this node may not use the device now"):
        asyncio.run(commands.write("plc", "a", "1", lambda: 1.0))


@pytest.mark.parametrize(
    ("limit", "kind", "expected"),
    [
        ("READY_WITHIN_S", "browse", "subscriptions are not read yet: try again"),
        ("READY_WITHIN_S", "command", "not written: subscriptions are not read yet: try again"),
        (
            "MAX_WAITING_BYTES",
            "command",
            "not written: too many requests: 0 bytes of them wait, which is the limit",
        ),
    ],
)
def test_requests_do_not_wait_for_ever_until_the_scanner_is_ready(
    monkeypatch: pytest.MonkeyPatch, limit: str, kind: str, expected: str
) -> None:
    monkeypatch.setattr(responder, limit, 0)

    async def work() -> list[bytes]:
        answers: list[bytes] = []
        has_answered = asyncio.Event()

        class Answers(Outbox):
            async def answer(self, _subject: str, payload: bytes) -> None:
                answers.append(payload)
                has_answered.set()

        async def handle(_: Msg) -> Answer:
            return Answer(success=True)

        waiting = responder.Responder(10, Answers(), asyncio.Event().wait)
        message = Msg(cast("Client", None), "modbus.browse", reply="_INBOX.1", data=b"{}")
        await waiting.answering(kind, handle)(message)
        await has_answered.wait()
        await waiting.end()
        return answers

    [answer] = asyncio.run(work())
    assert json.loads(answer) == {"success": False, "error": expected}


def test_requests_that_wait_until_the_scanner_is_ready_stay_in_order() -> None:
    async def work() -> list[str]:
        handled: list[str] = []
        ready, done = asyncio.Event(), asyncio.Event()

        async def handle(message: Msg) -> Answer:
            handled.append(message.subject)
            if len(handled) == 4:
                done.set()
            return Answer(success=True)

        waiting = responder.Responder(10, cast("Outbox", None), ready.wait)
        begin = waiting.answering("command", handle)
        for name in ("first", "second", "third"):
            await begin(Msg(cast("Client", None), name))
            await asyncio.sleep(0)
        await begin(Msg(cast("Client", None), "new"))
        ready.set()  # The new request begins before those that wait go on.
        await done.wait()
        return handled

    assert asyncio.run(work()) == ["first", "second", "third", "new"]


def test_a_tag_whose_null_is_nan_is_the_same_in_every_request() -> None:
    registry = Registry(ScannerLimits())
    tag = TagRequest("t", 0, "holding", "float32", null=["nan"])
    changes = []
    for subscriber in ("a", "b", "a"):
        request = SubscribeRequest("d", subscriber, [tag], host="127.0.0.1")
        wanted = subscription_of(request, Rules(), Adjustments())
        changes.append(registry.subscribe(wanted, wanted.source.target))
    assert [(change.polling, {*change.new}) for change in changes] == [
        (True, {"t"}),
        (False, {"t"}),
        (False, set()),
    ]

"""Parts of a node, without a server."""

from __future__ import annotations

import asyncio
import re
import time
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import msgspec
import pytest
from nats.errors import TimeoutError as NoAnswer

from holdfast.net.nats import batch
from holdfast.net.nats.connection import Servers
from holdfast.net.nats.outbox import Outbox
from holdfast.replication.leases.bucket import Holding
from holdfast.replication.leases.times import LeaseTimes
from holdfast.scanner.errors import Moved, NotConfirmed, Refused
from holdfast.scanner.fleet import desired_state, nodes, observer, questions
from holdfast.scanner.fleet.agreement import PROTOCOL, Terms, digest
from holdfast.scanner.fleet.command_order import CommandOrder
from holdfast.scanner.fleet.desired_state import DesiredDevice, DesiredState
from holdfast.scanner.fleet.nodes import Executed, OtherNodes
from holdfast.scanner.fleet.observer import FleetObserver, FleetUnavailable
from holdfast.scanner.fleet.placement import FleetPlacement
from holdfast.scanner.messages.types import Announcement, Answer
from holdfast.scanner.settings import FleetSettings, Settings
from holdfast.tags import Tag, TagList
from support.nats_bus import logged

if TYPE_CHECKING:
    from collections.abc import Callable

TERMS = Terms(
    protocol=1,
    partitions=256,
    prefix="modbus",
    allow=[],
    writes="tags",
    strict=False,
    defaults="",
    limits="",
    profiles="",
)


def test_messages_of_another_form_are_another_protocol() -> None:
    """Nodes of two protocols refuse each other; otherwise, each must understand the other."""
    between = (
        *(nodes.Command, nodes.Executed, nodes.ReportQuestion, nodes.NodeReports),
        *(DesiredDevice, Holding),
    )
    forms = [
        (each.encode_name, str(each.type), each.required)
        for kind in between
        for each in msgspec.structs.fields(kind)
    ]
    found = digest(repr(forms).encode())
    assert (PROTOCOL, found) == (2, "1a0b0247b8332a2d"), "must others be refused?"


def test_a_message_with_the_revision_of_its_lease_has_a_header() -> None:
    text = batch.text("modbus.data.boiler", b'{"value":"a\r\nb"}')
    assert batch.leased(text, 42) == (
        b"HPUB modbus.data.boiler 32 48\r\n"
        b"NATS/1.0\r\nHoldfast-Lease: 42\r\n\r\n"
        b'{"value":"a\r\nb"}\r\n'
    )


def test_a_node_that_was_stopped_for_too_long_drops_what_waits() -> None:
    class Connected:
        """As much of a client as is asked for."""

        is_connected = True
        pending_data_size = 0
        max_payload = 2**20

    async def work() -> None:
        lost = asyncio.Event()
        outbox = Outbox(may_send=lambda: False, on_drop=lost.set)
        outbox.connected(Connected())  # type: ignore[arg-type]
        outbox.put([(("d", "t"), b"PUB")])
        running = asyncio.create_task(outbox.run())
        await lost.wait()
        assert (outbox.sent, outbox.dropped) == (0, 1)
        running.cancel()

    asyncio.run(work())


def test_the_first_difference_of_terms_is_named() -> None:
    assert TERMS.difference(TERMS) is None
    other = msgspec.structs.replace(TERMS, strict=True)
    assert TERMS.difference(other) == "strict is False, and True in the fleet"


def test_a_profile_with_other_tags_is_a_difference() -> None:
    def terms(**addresses: int) -> Terms:
        profiles = {
            name: TagList([Tag("power", "holding_registers", address)])
            for name, address in addresses.items()
        }
        fleet = FleetSettings("plant", "a", 16)
        return Terms.of(Settings(Servers(), fleet=fleet, profiles=profiles), fleet)

    own = terms(meter=0, pump=0)
    assert own.difference(terms(pump=0, meter=0)) is None
    found = own.difference(terms(meter=10, pump=0))
    assert found is not None
    assert re.sub("[0-9a-f]{16}", "N", found) == (
        "profiles is meter (tags N), and meter (tags N) in the fleet"
    )
    found = own.difference(terms(meter=0))
    assert found is not None
    assert re.sub("[0-9a-f]{16}", "N", found) == (
        "profiles is pump (tags N), and no others in the fleet"
    )


def test_a_bucket_that_this_node_finds_later_is_its_own() -> None:
    desired = SimpleNamespace(made_at="own")
    settings = SimpleNamespace(name="plant")
    stub = SimpleNamespace(
        desired=desired,
        partition_leases=SimpleNamespace(settings=settings),
        _other_buckets={"found later": time.monotonic() - 1000.0},
    )
    other = Announcement(started_at=1, fleet="plant", bucket="found later")

    def shares_devices() -> bool:
        return FleetPlacement.shares_devices(cast("FleetPlacement", stub), other)

    assert not shares_devices()
    desired.made_at = "found later"
    assert shares_devices()
    desired.made_at = "own"
    assert shares_devices(), "the time to find it begins again"


class Bucket:
    """As much of a `KeyBucket` as is used, in memory."""

    client = None
    TURNS = 20
    """Turns of the event loop that a write takes."""

    def __init__(self) -> None:
        self.number = 0
        """Which bucket of this name it is."""
        self.stored: dict[str, bytes] = {}
        self.under_way = 0
        self.has_failed = False
        self._revision = 0

    def lose(self) -> None:
        """Is another bucket now, without contents. Its first write fails."""
        self.number += 1
        self.stored = {}
        self.has_failed = False

    async def make(self, *_: int, **settings: bool) -> Any:
        state = SimpleNamespace(last_seq=self._revision)
        config = SimpleNamespace(**settings, max_age=0.0)
        return SimpleNamespace(created=self.number, state=state, config=config)

    async def publish(self, key: str, value: bytes, _: int, __: dict[str, str]) -> int:
        if self.number and not self.has_failed and key != desired_state.TERMS:
            self.has_failed = True
            raise NoAnswer
        self.under_way += 1
        for _turn in range(self.TURNS):
            await asyncio.sleep(0)
        self.under_way -= 1
        self.stored[key] = value
        self._revision += 1
        return self._revision

    async def last(self, _: str) -> None:
        return None

    async def follow_keys(self, _: str, __: object, read: Callable[[], None]) -> None:
        read()

    async def unfollow(self) -> None:
        pass


def test_an_attempt_to_restore_ends_before_the_next_one(monkeypatch: pytest.MonkeyPatch) -> None:
    bucket = Bucket()
    monkeypatch.setattr(desired_state, "KeyBucket", lambda *_: bucket)

    async def work() -> None:
        desired = DesiredState("plant", lambda _: None, lambda: None)

        async def opened() -> None:
            await desired.open(None, TERMS, lambda _: True, has_joined=True)  # type: ignore[arg-type]

        await opened()
        for device in "abc":
            await desired.store(device, DesiredDevice(requests=[]), 0)
        before = dict(bucket.stored)
        bucket.lose()
        with pytest.raises(NoAnswer):
            await opened()
        assert bucket.under_way == 0
        await opened()
        assert bucket.stored == before

    asyncio.run(work())


class Move:
    """A node whose commands a device carries out, or that come back; `is_own`: in this process."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, is_own: bool) -> None:
        self.has_node = True
        self.answers: dict[str, asyncio.Future[Executed]] = {}
        """The commands that are on their way, and what will answer them."""
        self.moves = True
        self.written: list[str] = []
        monkeypatch.setattr(nodes, "ask", self._ask)
        other = SimpleNamespace(node="b", process="")
        partition_leases = SimpleNamespace(
            # No command waits for longer than this for a node.
            settings=FleetSettings("plant", "a", 16, LeaseTimes(3e-8, 2e-8, 1e-8)),
            leases=SimpleNamespace(seen={}),
            holder=lambda _: other if self.has_node else None,
            is_other=lambda _: True,
        )
        member: Any = SimpleNamespace(
            partition_leases=partition_leases,
            client=object(),
            known=lambda device: device,
            is_own=lambda _: self.has_node and is_own,
        )
        self._device: Any = SimpleNamespace(
            id="d", partition=0, source=SimpleNamespace(timeout=500)
        )
        self._others = OtherNodes("modbus", member)

    def begin(self, text: str) -> asyncio.Task[None]:
        """Sends a command."""

        async def own(last_moment: Callable[[], float]) -> None:
            for _turn in range(20):  # Its subscriptions are read.
                await asyncio.sleep(0)
            last_moment()
            executed = await self._answer(text)
            if executed.moved:
                raise Moved
            if executed.error is not None:
                raise Refused(executed.error)

        write = self._others.write(self._device, "t", text, own, lambda: 10.0)
        return asyncio.create_task(write)

    async def _ask(
        self,
        _: object,
        __: str,
        question: bytes,
        ___: object,
        ____: float,
        sent: Callable[[], None],
    ) -> Executed:
        for _turn in range(20):  # It subscribes to the answer.
            await asyncio.sleep(0)
        sent()
        return await self._answer(msgspec.json.decode(question)["text"])

    async def _answer(self, text: str) -> Executed:
        executed = CARRIED_OUT
        if self.moves:
            answer = self.answers[text] = asyncio.get_running_loop().create_future()
            executed = await answer
        if executed.success:
            self.written.append(text)
        return executed

    async def until_on_their_way(self, count: int) -> None:
        """Waits for so many commands."""
        async with asyncio.timeout(10):
            while len(self.answers) < count:
                await asyncio.sleep(0)


MOVED = Executed(success=False, moved=True)
CARRIED_OUT = Executed(success=True)


@pytest.mark.parametrize("is_own", [True, False])
def test_commands_that_come_back_are_carried_out_in_order(
    monkeypatch: pytest.MonkeyPatch, *, is_own: bool
) -> None:
    async def work() -> None:
        commands = [move.begin(text) for text in "012345"]
        await move.until_on_their_way(6)
        move.moves = False
        for text in "543210":
            move.answers[text].set_result(MOVED)
            await asyncio.sleep(0)
        await asyncio.gather(*commands, move.begin("6"))

    move = Move(monkeypatch, is_own=is_own)
    asyncio.run(work())
    assert move.written == ["0", "1", "2", "3", "4", "5", "6"]


@pytest.mark.parametrize("is_own", [True, False])
def test_a_command_that_comes_back_is_not_written_after_a_later_one(
    monkeypatch: pytest.MonkeyPatch, *, is_own: bool
) -> None:
    async def work() -> None:
        first, second, third = (move.begin(text) for text in "012")
        await move.until_on_their_way(3)
        move.answers.pop("0").set_result(MOVED)
        for _turn in range(100):
            await asyncio.sleep(0)
        assert move.answers.keys() == {"1", "2"}, "it waits: the later ones may come back, too"
        move.answers["1"].set_result(CARRIED_OUT)
        await second
        with pytest.raises(Refused, match="a later command to d went before it; send it again"):
            await asyncio.wait_for(first, 10)
        move.answers["2"].set_result(CARRIED_OUT)
        await third

    monkeypatch.setattr(nodes, "RETRY_S", 0.0)
    move = Move(monkeypatch, is_own=is_own)
    asyncio.run(work())
    assert move.written == ["1", "2"]


@pytest.mark.parametrize("is_own", [True, False])
def test_a_command_that_comes_back_is_written_although_a_later_one_was_refused(
    monkeypatch: pytest.MonkeyPatch, *, is_own: bool
) -> None:
    async def work() -> None:
        first, second = move.begin("0"), move.begin("1")
        await move.until_on_their_way(2)
        move.answers["1"].set_result(Executed(success=False, error="1 is not a value of t"))
        with pytest.raises(Refused, match="1 is not a value of t"):
            await second
        move.moves = False
        move.answers["0"].set_result(MOVED)
        await first

    monkeypatch.setattr(nodes, "RETRY_S", 0.0)
    move = Move(monkeypatch, is_own=is_own)
    asyncio.run(work())
    assert move.written == ["0"]


def test_the_latest_command_that_was_written_overtakes_whatever_ends_after_it() -> None:
    order = CommandOrder()
    for number in (0, 1, 2):
        order.wait(number)
        assert order.take(number)
        order.release(number)
    order.wait(1)
    order.end(2, may_be_written=True)
    order.end(0, may_be_written=True)
    assert order.is_overtaken(1)


def test_the_next_command_waits_for_the_answer_of_one_that_came_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def work() -> None:
        commands = [move.begin(text) for text in "01"]
        await move.until_on_their_way(2)
        for text in "01":
            move.answers.pop(text).set_result(MOVED)
        await move.until_on_their_way(1)
        for _turn in range(100):
            await asyncio.sleep(0)
        assert move.answers.keys() == {"0"}, "it may come back again"
        move.moves = False
        move.answers["0"].set_result(CARRIED_OUT)
        await asyncio.gather(*commands)

    monkeypatch.setattr(nodes, "RETRY_S", 0.0)
    move = Move(monkeypatch, is_own=False)
    asyncio.run(work())
    assert move.written == ["0", "1"]


def test_commands_that_wait_for_a_node_are_carried_out_in_order(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def work() -> None:
        commands = [move.begin(text) for text in "0123"]
        await asyncio.sleep(0)
        commands.pop(1).cancel()
        move.has_node, move.moves = True, False
        await asyncio.gather(*commands, move.begin("4"))

    move = Move(monkeypatch, is_own=True)
    move.has_node = False
    asyncio.run(work())
    assert move.written == ["0", "2", "3", "4"]


def test_a_burst_of_commands_is_ordered_with_few_comparisons() -> None:
    class Number(int):
        """One whose comparisons are counted."""

        def __lt__(self, other: int) -> bool:
            compared.append(self)
            return int(self) < other

    compared: list[int] = []
    order, numbers = CommandOrder(), [Number(number) for number in range(1000)]
    for number in numbers:
        order.wait(number)
    for number in numbers:
        assert order.take(number)
        order.release(number)
        order.end(number, may_be_written=True)
    assert len(compared) < 100 * len(numbers)


def test_a_command_without_success_is_not_carried_out(monkeypatch: pytest.MonkeyPatch) -> None:
    async def work() -> None:
        command = move.begin("0")
        await move.until_on_their_way(1)
        move.answers["0"].set_result(Executed(success=False))
        with pytest.raises(NotConfirmed, match="node b gives no reason"):
            await command

    move = Move(monkeypatch, is_own=False)
    asyncio.run(work())


def test_what_is_no_answer_is_skipped(caplog: pytest.LogCaptureFixture) -> None:
    done: list[str] = []
    confirmation, malformed = b'{"stream":"recorded","seq":1}', b'{"success":1}'
    received = [confirmation, malformed, b'{"success":true}']

    class Connected:
        """As much of a client as is asked for."""

        def new_inbox(self) -> str:
            return "inbox"

        async def subscribe(self, _: str) -> Connected:
            done.append("subscribed")
            return self

        async def unsubscribe(self) -> None:
            done.append("unsubscribed")

        async def publish(self, *_: object, reply: str) -> None:
            done.append(f"published for {reply}")

        async def next_msg(self, _: None) -> SimpleNamespace:
            done.append("waited")
            return SimpleNamespace(headers=None, data=received.pop(0))

    def sent() -> None:
        done.append("sent")

    client: Any = Connected()
    asking = questions.ask(client, "modbus.fleet.b.drain", b"", Answer, 10.0, sent)
    assert asyncio.run(asking).success
    waited = ["waited"] * 3
    assert done == ["subscribed", "published for inbox", "sent", *waited, "unsubscribed"]
    [fields] = logged(caplog, "message_malformed")
    assert fields["subject"] == "modbus.fleet.b.drain"


def test_a_node_that_refuses_to_leave_does_not_leave(monkeypatch: pytest.MonkeyPatch) -> None:
    async def ask(*_: object) -> Answer:
        return Answer(success=False, error="it is busy")

    monkeypatch.setattr(observer, "ask", ask)
    looker = FleetObserver("plant", Servers())
    looker._client = cast("Any", SimpleNamespace(is_connected=True))
    with pytest.raises(FleetUnavailable, match="node a does not leave: it is busy"):
        asyncio.run(looker.drain("a", "modbus"))

"""The text that publishes many messages at once, with the real server."""

from __future__ import annotations

import asyncio
import json
import math
import socket
from itertools import pairwise
from typing import TYPE_CHECKING, Any, cast
from urllib.parse import urlparse

import pytest
from hypothesis import given
from hypothesis import strategies as st
from nats.errors import Error, FlushTimeoutError, ProtocolError

from holdfast.net.nats import batch, tolerant_client
from holdfast.net.nats.outbox import Outbox
from holdfast.net.nats.tolerant_client import SafeClient
from holdfast.scanner.messages.types import Answer
from support.nats_bus import Caller
from support.wire import DEADLINE
from support.wire import until as wire_until

if TYPE_CHECKING:
    from collections.abc import Iterator

    from support.brokers import NatsServer


def test_texts_are_messages_in_their_order(nats: NatsServer, caller: Caller) -> None:
    inbox = caller.listen("wire.>")
    texts = [
        batch.message(f"wire.{number}", Answer(success=True, count=number)) for number in range(500)
    ]
    texts.append(batch.text("wire.größe", '"größe"'.encode()))
    caller.do(batch.send(caller.client, b"".join(texts), len(texts)))
    found = [inbox.next() for _ in texts]
    assert found[:-1] == [{"success": True, "count": number} for number in range(500)]
    assert found[-1] == "größe"
    assert "error" not in nats.log.lower()


def test_a_text_gets_another_subject_with_and_without_a_lease(
    nats: NatsServer, caller: Caller
) -> None:
    inbox = caller.listen("wire.>")
    text = batch.text("wire.a", b'"PUB wire.a 1"')
    leased = batch.leased(text, 12)
    again = [batch.readdressed(each, "wire.größe") for each in (text, leased)]
    assert again[1] == batch.leased(again[0], 12)
    caller.do(batch.send(caller.client, b"".join((text, leased, *again)), 4))
    assert [inbox.next() for _ in range(4)] == ["PUB wire.a 1"] * 4
    assert "error" not in nats.log.lower()


def test_texts_mix_with_what_the_client_publishes_itself(caller: Caller) -> None:
    inbox = caller.listen("wire.>")

    async def mixed() -> None:
        for number in range(100):
            await batch.send(caller.client, batch.text("wire.a", b"%d" % number) * 2, 2)
            await caller.client.publish("wire.b", b"%d" % number)

    caller.do(mixed())
    expected = [number for number in range(100) for _ in range(3)]
    assert [inbox.next() for _ in expected] == expected


def test_a_batch_larger_than_all_buffers_arrives(caller: Caller) -> None:
    inbox = caller.listen("wire.>")
    payload = b'"%b"' % (b"x" * 1000)
    text = batch.text("wire.a", payload)
    caller.do(batch.send(caller.client, text * 5000, 5000))
    for _ in range(5000):
        assert len(inbox.next()) == 1000


def test_what_waits_when_the_connection_breaks_goes_with_the_next(own_nats: NatsServer) -> None:
    with Caller(own_nats.url) as caller:
        inbox = caller.listen("wire.>")
        own_nats.kill()
        wire_until(lambda: not caller.client.is_connected, "the connection is lost")
        caller.do(batch.send(caller.client, batch.text("wire.a", b"1") * 10, 10))
        own_nats.start()
        assert [inbox.next() for _ in range(10)] == [1] * 10


@pytest.fixture
def sender(nats: NatsServer) -> Iterator[tuple[Caller, SafeClient]]:
    """A client of the product, and its caller."""
    client = SafeClient()
    with Caller(nats.url, client) as caller:
        yield caller, client


def test_what_a_node_may_send_is_sent_before_anything_else_runs(
    sender: tuple[Caller, SafeClient],
) -> None:
    """What waits in a process that is stopped would be sent when it goes on, by a former owner."""
    caller, client = sender
    left: list[int] = []

    async def work() -> None:
        loop = asyncio.get_running_loop()

        def may_send() -> bool:
            loop.call_soon(lambda: left.append(batch.unsent(client)))
            return True

        outbox = Outbox(may_send=may_send, at_once=True)
        outbox.connected(client)
        running = asyncio.create_task(outbox.run())
        for number in range(100):
            outbox.put([("a", batch.text("wire.a", b"%d" % number))])
            while outbox.sent <= number:
                await asyncio.sleep(0)
        running.cancel()

    inbox = caller.listen("wire.>")
    caller.do(work())
    assert [inbox.next() for _ in range(100)] == list(range(100))
    assert left == [0] * 100


def test_a_node_waits_for_what_its_client_has_not_sent(
    sender: tuple[Caller, SafeClient],
) -> None:
    caller, client = sender

    async def work() -> None:
        outbox = Outbox(at_once=True)
        outbox.connected(client)
        running = asyncio.create_task(outbox.run())
        await client.publish("wire.a", b"1")
        outbox.put([("a", batch.text("wire.a", b"2"))])
        while not outbox.sent:
            await asyncio.sleep(0)
        running.cancel()

    inbox = caller.listen("wire.>")
    caller.do(work())
    assert [inbox.next() for _ in range(2)] == [1, 2]


class _Heard(SafeClient):
    """A client that notes what the server sends, and receives what a test puts into `reader`."""

    def __init__(self, *, requires_tls: bool = False) -> None:
        super().__init__(requires_tls=requires_tls)
        self.heard: list[Any] = []
        self.reader = self.transport._io_reader = asyncio.StreamReader()

    async def receive(self, data: bytes) -> None:
        """Does with these bytes what the client does with what it reads."""
        self.reader.feed_data(data)
        await self._ps.parse(await self.transport.read(2 * tolerant_client.MAX_LINE_BYTES))

    async def _process_msg(self, *arguments: Any) -> None:
        self.heard.append(arguments)

    async def _process_ping(self) -> None:
        self.heard.append("ping")

    async def _process_pong(self) -> None:
        self.heard.append("pong")

    async def _process_err(self, err_msg: str) -> None:
        self.heard.append(err_msg)

    async def _process_info(self, info: Any, initial_connection: bool = False) -> None:
        assert not initial_connection
        self.heard.append(info)


LINES = (
    b'PING\r\nMSG a.b 1 2\r\n\r\n\r\nMSG a\x0bb\xff 12\t_I.\x0c  5\r\nMSG 1\r\nINFO {"a": "b"} \r\n'
    b"HMSG c 3 12 13\r\nNATS/1.0\r\n\r\nx\r\n+OK\r\n"
    b"HMSG c 3 r 7 7\r\ngarbage\r\n-ERR 'Some Thing'\r\n-ERR Oh\xff\r\n-ERR\r\n"
    b"PONG\r\nMSG d 4 0\r\n\r\n"
)
MESSAGES = [
    (1, b"a.b", b"", b"\r\n", b""),
    (12, b"a\x0bb\xff", b"_I.\x0c", b"MSG 1", b""),
    (3, b"c", b"", b"x", b"NATS/1.0\r\n\r\n"),
    (3, b"c", b"r", b"", b"garbage"),
    (4, b"d", b"", b"", b""),
]
OTHERS = ["ping", {"a": "b"}, "'some thing'", "'oh\\xff'", "'no reason given'", "pong"]


@given(st.lists(st.integers(0, len(LINES)), max_size=40))
def test_what_the_server_sends_is_taken_apart_wherever_it_is_cut(cuts: list[int]) -> None:
    async def heard() -> list[Any]:
        client = _Heard()
        for start, end in pairwise(sorted({0, *cuts, len(LINES)})):
            await client.receive(LINES[start:end])
        return client.heard

    found = asyncio.run(heard())
    assert [each for each in found if isinstance(each, tuple)] == MESSAGES
    assert [each for each in found if not isinstance(each, tuple)] == OTHERS


@pytest.mark.parametrize(
    "line",
    [
        b"HELLO",
        b"MSG a",
        b"MSG a b 1",
        b"MSG a 1 x",
        b"HMSG a 1 2",
        b"MSG a 1 -1",
        b"MSG a 1 1_0",
        b"MSG a 1_0 1",
        b"MSG a 1 %d" % (tolerant_client.MAX_MESSAGE_BYTES + 1),
        b"HMSG a 1 -1 2",
        b"HMSG a 1 3 2",
        b"HMSG a 1 2 %d" % (tolerant_client.MAX_MESSAGE_BYTES + 1),
        b"INFO " + b"[" * 100_000,
        b"INFO {",
        b"INFO 1",
        b"",
        b"x" * (tolerant_client.MAX_LINE_BYTES + 1),
    ],
)
def test_a_line_that_no_server_sends_ends_the_connection(line: bytes) -> None:
    async def parse() -> None:
        await _Heard().receive(line + b"\r" + b"\n" * (len(line) < tolerant_client.MAX_LINE_BYTES))

    with pytest.raises(ProtocolError):
        asyncio.run(parse())


@pytest.mark.parametrize(
    "line", [b"INFO [1]\r\n", b"INFO", b"220 INFORMATION\r\n", b"hello\r\n", b"INFO {\r\n"]
)
def test_a_first_line_of_something_else_is_an_error_of_nats(line: bytes) -> None:
    async def begin() -> None:
        client = _Heard()
        client.reader.feed_data(line)
        client.reader.feed_eof()
        await client.transport.readline()

    with pytest.raises(Error):
        asyncio.run(begin())


def test_a_flush_waits_until_the_server_has_what_the_client_still_holds(
    sender: tuple[Caller, SafeClient], monkeypatch: pytest.MonkeyPatch
) -> None:
    caller, client = sender

    async def work() -> list[bytes]:
        is_taken = asyncio.Event()
        monkeypatch.setattr(client.transport, "drain", is_taken.wait)
        await client.publish("wire.a", b"0")
        while client._pending:
            await asyncio.sleep(0)
        await client.publish("wire.a", b"1")
        assert client._pending, "the server takes nothing more for now"
        await client.flush()
        held = client._pending
        is_taken.set()
        return held

    inbox = caller.listen("wire.>")
    assert caller.do(work()) == []
    assert [inbox.next() for _ in range(2)] == [0, 1]


def test_an_answer_to_a_flush_that_was_given_up_ends_nothing(own_nats: NatsServer) -> None:
    client = SafeClient()
    with Caller(own_nats.url, client) as caller:
        inbox = caller.listen("wire.>")
        own_nats.freeze()
        with pytest.raises(FlushTimeoutError):
            caller.do(client.flush(timeout=1))
        own_nats.thaw()
        caller.do(client.flush())
        caller.do(client.publish("wire.a", b"1"))
        assert inbox.next() == 1


def test_addresses_of_servers_that_are_none_are_left_out() -> None:
    async def begin() -> bytes:
        client = _Heard()
        client.reader.feed_data(b'INFO {"connect_urls": ["[x", 1, "a:b", "10.0.0.9:4222"]}\r\n')
        return await client.transport.readline()

    assert asyncio.run(begin()) == b'INFO {"connect_urls": ["10.0.0.9:4222"]}\r\n'


def test_the_newest_list_of_a_cluster_counts_up_to_a_limit() -> None:
    async def servers() -> list[set[str]]:
        client, found = SafeClient(), []
        client.transport._io_reader = reader = asyncio.StreamReader()
        client.options = {"dont_randomize": True}
        client._setup_server_pool(["nats://configured:1"])
        client._current_server = client._server_pool[0]
        for name in ("old", "new"):
            urls = [f"{name}-{number}:1" for number in range(1000)]
            reader.feed_data(b"INFO %b\r\n" % json.dumps({"connect_urls": urls}).encode())
            await client._ps.parse(await client.transport.read(2**20))
            found.append({server.uri.netloc for server in client._server_pool})
        return found

    for name, found in zip(("old", "new"), asyncio.run(servers()), strict=True):
        listed = {f"{name}-{number}:1" for number in range(tolerant_client.MAX_CLUSTER_SERVERS)}
        assert found == {"configured:1", *listed}


def test_a_limit_of_the_server_is_a_number() -> None:
    async def limit() -> int:
        client = SafeClient()
        client.transport._io_reader = reader = asyncio.StreamReader()
        client._setup_server_pool(["nats://configured:1"])
        client._current_server = client._server_pool[0]
        for value in (b"512", b"true", b'"2"', b"null"):
            reader.feed_data(b'INFO {"max_payload": %b}\r\n' % value)
        await client._ps.parse(await client.transport.read(2**20))
        return client.max_payload

    assert asyncio.run(limit()) == 512


def test_a_server_that_takes_no_more_bytes_does_not_hold_up_the_end_of_a_connection() -> None:
    async def ends(port: int) -> None:
        transport = SafeClient().transport
        await transport.connect(urlparse(f"nats://127.0.0.1:{port}"), 65_536, 5)
        transport.write(b"x" * 2**26)
        assert transport.unsent > 0
        transport.close()
        async with asyncio.timeout(DEADLINE):
            await transport.wait_closed()
            while transport.unsent:
                await asyncio.sleep(0)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        asyncio.run(ends(listener.getsockname()[1]))


def test_a_first_line_that_is_too_long_is_an_error_of_nats() -> None:
    async def begin() -> None:
        client = _Heard()
        client.reader.feed_data(b"INFO " + b" " * 2**18)
        await client.transport.readline()

    with pytest.raises(Error, match="too long"):
        asyncio.run(begin())


def test_a_message_after_the_answer_to_a_ping_was_sent_after_the_ping() -> None:
    """Also when both arrive together, and though the client knows nothing of the ping."""

    async def ages() -> tuple[_Heard, list[float]]:
        client = _Heard()
        found: list[float] = []

        async def note(*_: Any) -> None:
            found.append(client._build_message(1, b"a", b"", b"", None).sent_after)

        client._process_msg = note  # type: ignore[method-assign]
        client.transport._io_writer = cast("Any", _Sink())
        client.transport.ping()
        client.transport.write(b"PING\r\n")
        message = b"MSG a 1 0\r\n\r\n"
        await client.receive(b"PONG\r\n".join([message] * 3))
        return client, found

    client, [first, second, third] = asyncio.run(ages())
    assert -math.inf == first < second < third == client.transport.pinged
    assert client.heard == ["pong"]


class _Sink:
    def write(self, data: bytes) -> None: ...

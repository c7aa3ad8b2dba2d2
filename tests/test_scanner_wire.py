"""The text that publishes many messages at once, with the real server."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.scanner import wire
from holdfast.scanner.messages import Answer
from nats_bus import Caller
from wire import until as wire_until

if TYPE_CHECKING:
    from nats_bus import NatsServer


def test_texts_are_messages_in_their_order(nats: NatsServer, caller: Caller) -> None:
    inbox = caller.listen("wire.>")
    texts = [
        wire.message(f"wire.{number}", Answer(success=True, count=number)) for number in range(500)
    ]
    texts.append(wire.text("wire.größe", '"größe"'.encode()))
    caller.do(wire.send(caller.client, b"".join(texts), len(texts)))
    found = [inbox.next() for _ in texts]
    assert found[:-1] == [{"success": True, "count": number} for number in range(500)]
    assert found[-1] == "größe"
    assert "error" not in nats.log.lower()


def test_texts_mix_with_what_the_client_publishes_itself(caller: Caller) -> None:
    inbox = caller.listen("wire.>")

    async def mixed() -> None:
        for number in range(100):
            await wire.send(caller.client, wire.text("wire.a", b"%d" % number) * 2, 2)
            await caller.client.publish("wire.b", b"%d" % number)

    caller.do(mixed())
    expected = [number for number in range(100) for _ in range(3)]
    assert [inbox.next() for _ in expected] == expected


def test_a_batch_larger_than_all_buffers_arrives(caller: Caller) -> None:
    inbox = caller.listen("wire.>")
    payload = b'"%b"' % (b"x" * 1000)
    text = wire.text("wire.a", payload)
    caller.do(wire.send(caller.client, text * 5000, 5000))
    for _ in range(5000):
        assert len(inbox.next()) == 1000


def test_what_waits_when_the_connection_breaks_goes_with_the_next(own_nats: NatsServer) -> None:
    with Caller(own_nats.url) as caller:
        inbox = caller.listen("wire.>")
        own_nats.kill()
        wire_until(lambda: not caller.client.is_connected, "the connection is lost")
        caller.do(wire.send(caller.client, wire.text("wire.a", b"1") * 10, 10))
        own_nats.start()
        assert [inbox.next() for _ in range(10)] == [1] * 10

"""Publishing many messages at once.

nats-py publishes one message a call: checks of the subject and the payload, three coroutines, and a
turn of the event loop. That costs more than to read a tag and to make its message. What `publish`
does in the end is to append the text of the protocol

    PUB subject size␍␊payload␍␊

to what the client sends next, and to wake its flusher. Any number of such texts, one behind the
other, can be appended in the same way, so a batch costs what one message costs. This uses private
names of nats-py (docs/dependencies.md), which `tests/scanner/test_wire.py` checks with the server.

The texts must be right: nothing here looks at them. They are made by `publishing` from device ids
that were checked when they were subscribed to.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

import msgspec
from nats.errors import Error

if TYPE_CHECKING:
    from nats.aio.client import Client

_encode = msgspec.json.Encoder().encode


def text(subject: str, payload: bytes) -> bytes:
    """What publishes one message."""
    return b"PUB %b %d\r\n%b\r\n" % (subject.encode(), len(payload), payload)


def message(subject: str, content: msgspec.Struct) -> bytes:
    """What publishes a message as JSON."""
    return text(subject, _encode(content))


async def send(client: Client, texts: bytes, count: int) -> None:
    """Sends the texts of so many messages. What is queued when the connection breaks is sent by
    the next one; what is on its way is lost.
    """
    client.stats["out_msgs"] += count
    client.stats["out_bytes"] += len(texts)
    with contextlib.suppress(OSError, Error):  # The client will notice, and connect again.
        await client._send_command(texts)
        if client._flush_queue is not None and client._flush_queue.empty():
            await client._flush_pending()


def backlog(client: Client) -> int:
    """Bytes that the server has not taken yet, as far as the client knows."""
    return client.pending_data_size

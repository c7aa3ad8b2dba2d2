"""Publishes many messages at once.

nats-py publishes one message per call. A call checks the subject and the payload, and takes three
coroutines and an iteration of the event loop. That costs more than reading a tag and creating its
message. In the end `publish` appends the text

    PUB subject size␍␊payload␍␊

to the client's send buffer, and wakes its flusher. Any number of such texts can be appended
together, so a batch costs as much as one message. `send_at_once` does not leave the batch to the
flusher: a process that is stopped in between would send it when it goes on. This uses private
names of nats-py (see docs/dependencies.md); `tests/scanner/test_batch.py` checks them with the real
server.

The texts are not checked here. `scanner.publish` creates them from device ids that were checked.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

import msgspec
from nats.errors import Error

if TYPE_CHECKING:
    from nats.aio.client import Client

    from holdfast.net.nats.tolerant_client import SafeClient

_encode = msgspec.json.Encoder().encode

LEASE = b"Holdfast-Lease"
"""The header with the revision of the lease of a device, in a fleet."""

ANSWER = b"Holdfast-Answer"
"""The header of every answer of a scanner."""

ANSWER_HEADER = b"NATS/1.0\r\n%b: 1\r\n\r\n" % ANSWER
"""The headers of an answer."""


def text(subject: str, payload: bytes) -> bytes:
    """Returns the text that publishes one message."""
    return b"PUB %b %d\r\n%b\r\n" % (subject.encode(), len(payload), payload)


def answer(subject: str, payload: bytes) -> bytes:
    """Returns the text that publishes an answer."""
    sizes = (len(ANSWER_HEADER), len(ANSWER_HEADER) + len(payload))
    return b"HPUB %b %d %d\r\n%b%b\r\n" % (subject.encode(), *sizes, ANSWER_HEADER, payload)


def message(subject: str, content: msgspec.Struct) -> bytes:
    """Returns the text that publishes a message as JSON."""
    return text(subject, _encode(content))


def readdressed(text: bytes, subject: str) -> bytes:
    """Returns the text of a message, with or without headers, with another subject."""
    verb, _, rest = text.split(b" ", 2)
    return b"%b %b %b" % (verb, subject.encode(), rest)


def subject_and_size(text: bytes) -> tuple[str, int]:
    """Returns the subject of the text of a message, and the bytes of its headers and payload."""
    head, _, _ = text.partition(b"\r\n")
    _, subject, *sizes = head.split(b" ")
    return subject.decode(), int(sizes[-1])


def lease_header(epoch: int) -> bytes:
    """Returns the headers of a message with the revision of a lease."""
    return b"NATS/1.0\r\n%b: %d\r\n\r\n" % (LEASE, epoch)


def leased(text: bytes, epoch: int) -> bytes:
    """Returns the text of a message with the revision of the lease under which it is published."""
    head, _, payload = text.partition(b"\r\n")
    _, subject, size = head.split(b" ")
    header = lease_header(epoch)
    sizes = (len(header), len(header) + int(size))
    return b"HPUB %b %d %d\r\n%b%b" % (subject, *sizes, header, payload)


async def send(client: Client, texts: bytes, count: int) -> None:
    """Sends the texts of `count` messages.

    When the connection breaks, buffered messages are sent after the reconnect. Messages in flight
    are lost.
    """
    client.stats["out_msgs"] += count
    client.stats["out_bytes"] += len(texts)
    with contextlib.suppress(OSError, Error):  # The client notices the error and reconnects.
        is_first = backlog(client) == 0  # Otherwise its flusher is already awake.
        await client._send_command(texts)
        if is_first:
            await client._flush_pending()


def send_at_once(client: SafeClient, texts: bytes, count: int) -> None:
    """Hands the texts of `count` messages to the system, before the event loop runs anything else.

    Only if `unsent` is 0, else they wait. They are lost if the connection breaks.
    """
    client.stats["out_msgs"] += count
    client.stats["out_bytes"] += len(texts)
    client.transport.write(texts)


def backlog(client: Client) -> int:
    """Returns the number of bytes in the client's send buffer."""
    return client.pending_data_size


def unsent(client: SafeClient) -> int:
    """Returns the number of bytes that this process has not handed to the system."""
    return client.pending_data_size + client.transport.unsent

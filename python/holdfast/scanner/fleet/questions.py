"""How a node of a fleet is asked, by another node or from outside."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, TypeVar

import msgspec
from nats.aio.client import NO_RESPONDERS_STATUS
from nats.errors import Error, NoRespondersError
from nats.errors import TimeoutError as NoAnswer
from nats.js.api import Header

from holdfast.events import log_lines
from holdfast.runtime.malformed_json import MALFORMED_JSON, malformed_text
from holdfast.scanner.messages.types import Answer

if TYPE_CHECKING:
    from collections.abc import Callable

    from nats.aio.client import Client

Reply = TypeVar("Reply", bound=Answer)


def subject(prefix: str, node: str, what: str, process: str = "") -> str:
    """Where a node is asked; with `process`, only that one: two may have the same name."""
    return ".".join((prefix, "fleet", node, *([process] if process else []), what))


class _Confirmation(msgspec.Struct):
    """What a stream of JetStream sends that records a subject."""

    stream: str


async def ask(
    client: Client,
    where: str,
    question: bytes,
    kind: type[Reply],
    seconds: float,
    sent: Callable[[], None] = lambda: None,
) -> Reply:
    """Returns the answer of a node. Raises errors of nats-py. `sent` is called before the answer.

    `Client.request` returns the first message that comes. If a stream of JetStream records the
    subject, that is the confirmation of the stream, also when there is no such node. So whatever
    is not an answer is skipped.
    """
    inbox = client.new_inbox()
    messages = await client.subscribe(inbox)
    try:
        async with asyncio.timeout(seconds):
            await client.publish(where, question, reply=inbox)
            sent()
            while True:
                message = await messages.next_msg(None)
                if (message.headers or {}).get(Header.STATUS) == NO_RESPONDERS_STATUS:
                    raise NoRespondersError
                try:
                    return msgspec.json.decode(message.data, type=kind)
                except MALFORMED_JSON as error:
                    _note(where, message.data, malformed_text(error, message.data))
    except TimeoutError:
        raise NoAnswer from None
    finally:
        with contextlib.suppress(Error):  # The connection was closed.
            await messages.unsubscribe()


def _note(where: str, answer: bytes, reason: str) -> None:
    """Logs what is not an answer, unless it is the confirmation of a stream."""
    try:
        msgspec.json.decode(answer, type=_Confirmation)
    except MALFORMED_JSON:
        log_lines.refused("message_malformed", kind="answer", subject=where, reason=reason)

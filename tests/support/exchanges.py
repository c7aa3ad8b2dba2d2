"""Requests as bytes on a connection of their own, as `tests/importing/mma_run.json` has them."""

from __future__ import annotations

import json
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, TypeAlias

from support import wire

if TYPE_CHECKING:
    from collections.abc import Mapping

    Exchange: TypeAlias = Mapping[str, Any]
    Answer: TypeAlias = str | list[Any]


def play(exchange: Exchange, addresses: Mapping[str, tuple[str, int]]) -> Answer:
    """Sends a request on a connection of its own. Returns everything that is received."""
    at = exchange["at"]
    source = exchange.get("source", "127.0.0.1")
    with ExitStack() as opened:
        for _ in range(exchange.get("idle", 0)):
            opened.enter_context(wire.Connection(addresses[at], source=source))
        connection = opened.enter_context(wire.Connection(addresses[at], source=source))
        if at == "rest":
            connection.send(exchange["send"].encode())
            return http(connection.rest())
        try:
            connection.send(bytes.fromhex(exchange["send"]))
            connection.finish()
        except OSError:  # It was closed at once.
            pass
        return connection.rest().hex()


def http(received: bytes) -> Answer:
    """Returns the status and the body: text, or JSON without what changes from run to run."""
    top, _, body = received.partition(b"\r\n\r\n")
    status, text = int(top.split()[1]), body.decode()
    if b"application/json" not in top:
        return [status, text]
    found = json.loads(text)
    if "uptime" in found:
        return [status, sorted(found)]
    return [status, found]

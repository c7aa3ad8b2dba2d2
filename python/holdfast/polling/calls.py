"""Calls of an event loop to devices, over the connections of a poller."""

from __future__ import annotations

import asyncio
import socket
from typing import Any

from holdfast._core import Caller


class Calls(asyncio.Protocol):
    """The calls of an event loop. Receives a byte when results are ready."""

    def __init__(self, caller: Caller) -> None:
        self.caller = caller
        self._loop = asyncio.get_running_loop()
        self._futures: dict[int, asyncio.Future[tuple[bool, Any]]] = {}
        self._transport: asyncio.BaseTransport | None = None

    @staticmethod
    async def opened() -> Calls:
        """Returns the calls of the running event loop. Raises `OSError` without a free socket."""
        caller = Caller()
        calls = Calls(caller)
        wakes = socket.socket(fileno=caller.detach())
        await calls._loop.create_connection(lambda: calls, sock=wakes)
        return calls

    def result(self, ticket: int) -> asyncio.Future[tuple[bool, Any]]:
        """The end of a call: whether it was sent, and a result or an error.

        A `ModbusError`, or a `PermissionError` if the connection leads to none of the peers.
        """
        future: asyncio.Future[tuple[bool, Any]] = self._loop.create_future()
        self._futures[ticket] = future
        future.add_done_callback(lambda _: self._futures.pop(ticket))
        return future

    def give_up(self, ticket: int, result: asyncio.Future[tuple[bool, Any]]) -> bool:
        """Gives a call up whose caller was cancelled. Returns whether it may have been sent."""
        # It may have ended just before.
        return self.caller.withdraw(ticket) if result.cancelled() else result.result()[0]

    def withdraw(self, ticket: int) -> None:
        """Gives a call up that was not sent yet. It ends with the result `None`, not sent."""
        future = self._futures.get(ticket)
        if not self.caller.withdraw(ticket) and future is not None and not future.done():
            future.set_result((False, None))

    def close(self) -> None:
        """Ends the wake-ups."""
        if self._transport is not None:
            self._transport.close()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """The socket is open."""
        self._transport = transport

    def data_received(self, _data: bytes) -> None:
        """Takes the calls that have ended."""
        for ticket, sent, result in self.caller.take():
            future = self._futures.get(ticket)
            if future is not None and not future.done():
                future.set_result((sent, result))

"""Sends a packet and receives the reply, over plain TCP or TLS.

The reply is awaited from the start: a receiver can refuse a packet by its header, or the
certificate of the sender. The rest of the packet does not matter then.
"""

from __future__ import annotations

import asyncio
import contextlib
import selectors
from typing import TYPE_CHECKING, cast

from holdfast.client.tcp_connect import remaining_s
from holdfast.raw_ingest.outcome import TlsLost

if TYPE_CHECKING:
    import socket

    from holdfast._core import TlsChannel
    from holdfast.raw_ingest.outcome import Attempt

CHUNK_BYTES = 4096


async def exchange(attempt: Attempt, connection: socket.socket, packet: bytes) -> bytes:
    """Sends the packet and returns the reply, empty without one."""
    loop = asyncio.get_running_loop()
    attempt.connected = True
    sending = asyncio.create_task(loop.sock_sendall(connection, packet))
    try:
        return await loop.sock_recv(connection, 1)
    finally:
        sending.cancel()
        await asyncio.wait([sending])
        attempt.sent = not sending.cancelled() and sending.exception() is None


def exchange_sync(
    attempt: Attempt, connection: socket.socket, packet: bytes, deadline: float
) -> bytes:
    """Like `exchange`, without an event loop."""
    attempt.connected = True
    unsent = memoryview(packet)
    with selectors.DefaultSelector() as selector:
        selector.register(connection, selectors.EVENT_READ | selectors.EVENT_WRITE)
        while True:
            for _, ready in selector.select(remaining_s(deadline)):
                try:
                    if ready & selectors.EVENT_READ:
                        return connection.recv(1)
                    unsent = unsent[connection.send(unsent) :]
                    attempt.sent = not unsent
                except BlockingIOError:
                    continue
                except OSError:
                    if ready & selectors.EVENT_READ:
                        raise
                    selector.modify(connection, selectors.EVENT_READ)
                if attempt.sent:
                    selector.modify(connection, selectors.EVENT_READ)


async def secure_exchange(
    attempt: Attempt, connection: socket.socket, channel: TlsChannel, packet: bytes
) -> bytes:
    """Sends the packet and returns the reply, empty without one. Raises `OSError`."""
    channel.send(packet)
    loop = asyncio.get_running_loop()
    transport, exchange = await loop.create_connection(
        lambda: _Exchange(attempt, channel), sock=connection
    )
    try:
        return await exchange.reply
    finally:
        transport.abort()


class _Exchange(asyncio.Protocol):
    """One packet and its reply."""

    def __init__(self, attempt: Attempt, channel: TlsChannel) -> None:
        self._attempt = attempt
        self._channel = channel
        self._transport: asyncio.Transport | None = None
        self._is_sending = False
        self.reply: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        # Those of uvloop have no such base.
        self._transport = transport = cast("asyncio.Transport", transport)
        # Sending is paused whenever something is not sent.
        transport.set_write_buffer_limits(high=0)
        self._send()

    def pause_writing(self) -> None:
        self._is_sending = True

    def resume_writing(self) -> None:
        self._is_sending = False
        self._note()

    def data_received(self, data: bytes) -> None:
        try:
            reply = _received(self._channel, data)
        except TlsLost as error:
            self._send()
            self._settle(error)
            return
        if reply:
            self._channel.end()
        self._send()
        if reply is not None:
            self._settle(reply)

    def connection_lost(self, exc: Exception | None) -> None:
        self._settle(_lost(self._channel, exc))

    def _send(self) -> None:
        outgoing = self._channel.outgoing()
        if outgoing and self._transport is not None:
            self._transport.write(outgoing)
        self._note()

    def _note(self) -> None:
        self._attempt.connected = self._channel.is_ready
        self._attempt.sent = self._channel.is_ready and not self._is_sending

    def _settle(self, outcome: bytes | Exception) -> None:
        if self.reply.done():
            return
        if isinstance(outcome, Exception):
            self.reply.set_exception(outcome)
        else:
            self.reply.set_result(outcome)


def secure_exchange_sync(
    attempt: Attempt,
    connection: socket.socket,
    channel: TlsChannel,
    packet: bytes,
    deadline: float,
) -> bytes:
    """Like `secure_exchange`, without an event loop."""
    channel.send(packet)
    unsent = channel.outgoing()
    broken: OSError | None = None
    with selectors.DefaultSelector() as selector:
        selector.register(connection, selectors.EVENT_READ | selectors.EVENT_WRITE)
        while True:
            ready = sum(ready for _, ready in selector.select(remaining_s(deadline)))
            try:
                if ready & selectors.EVENT_READ:
                    data = connection.recv(CHUNK_BYTES)
                    if not data:
                        return _outcome(_lost(channel, broken))
                    reply = _received(channel, data)
                    if reply is not None:
                        _end(connection, channel)
                        return reply
                    unsent += channel.outgoing()
                elif ready and broken is None:
                    unsent = unsent[connection.send(unsent) :]
            except BlockingIOError:
                continue
            except TlsLost:
                _end(connection, channel)
                raise
            except OSError as error:
                if ready & selectors.EVENT_READ:
                    return _outcome(_lost(channel, error))
                # A receiver that refuses the certificate closes the connection. Its alert says why.
                broken, unsent = error, b""
            attempt.connected = channel.is_ready
            attempt.sent = attempt.sent or (channel.is_ready and not unsent and broken is None)
            writes = selectors.EVENT_WRITE if unsent else 0
            selector.modify(connection, selectors.EVENT_READ | writes)


def _end(connection: socket.socket, channel: TlsChannel) -> None:
    """Announces the end, or says why, without waiting."""
    channel.end()
    with contextlib.suppress(OSError):
        connection.send(channel.outgoing())


def _outcome(outcome: bytes | Exception) -> bytes:
    if isinstance(outcome, Exception):
        raise outcome
    return outcome


def _received(channel: TlsChannel, data: bytes) -> bytes | None:
    """The reply, empty if the peer has ended TLS without one; `None` before. Raises `TlsLost`."""
    reply, failure = channel.receive(data)
    if reply:
        return reply[:1]
    if failure is not None:
        raise TlsLost(*failure)
    return b"" if channel.has_ended else None


def _lost(channel: TlsChannel, error: Exception | None) -> bytes | Exception:
    """The outcome when the connection has ended without a reply."""
    failure = channel.lost(error is not None)
    return TlsLost(*failure) if failure is not None else error or b""

"""Sends a packet over TLS and receives the reply.

The reply is awaited from the start: a receiver can refuse a packet by its header, or the
certificate of the sender.
"""

from __future__ import annotations

import asyncio
import contextlib
import selectors
from typing import TYPE_CHECKING, cast

from holdfast.client.connecting import left
from holdfast.raw_ingest.outcome import TlsLost

if TYPE_CHECKING:
    import socket

    from holdfast._core import TlsChannel
    from holdfast.raw_ingest.outcome import Attempt

CHUNK = 4096


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
            ready = sum(ready for _, ready in selector.select(left(deadline)))
            try:
                if ready & selectors.EVENT_READ:
                    data = connection.recv(CHUNK)
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

"""Sends packets: one connection each, nothing is retried."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

from holdfast._core import TlsChannel
from holdfast.client.endpoint import receiver_endpoint
from holdfast.client.tcp_connect import addresses, connected, connected_sync
from holdfast.client.url import RECEIVER_TIMEOUT_S, Receiver
from holdfast.raw_ingest.encoding import encode
from holdfast.raw_ingest.exchange import (
    exchange,
    exchange_sync,
    secure_exchange,
    secure_exchange_sync,
)
from holdfast.raw_ingest.outcome import Attempt

if TYPE_CHECKING:
    from collections.abc import Iterable
    from typing import Unpack

    from holdfast.net.tls import Tls
    from holdfast.raw_ingest.encoding import Options
    from holdfast.types import Area

TIMEOUT_S = RECEIVER_TIMEOUT_S


async def send(
    host: str,
    port: int,
    area: Area,
    address: int,
    values: Iterable[int] | None = None,
    *,
    timeout: float = TIMEOUT_S,
    tls: Tls | None = None,
    **options: Unpack[Options],
) -> None:
    """Encodes and sends one packet. Returns when the receiver has written it.

    Raises the errors of `encode` before it connects, and the errors of `send_packet`.
    """
    packet = encode(area, address, values, **options)
    await send_packet(host, port, packet, timeout=timeout, tls=tls)


def send_sync(
    host: str,
    port: int,
    area: Area,
    address: int,
    values: Iterable[int] | None = None,
    *,
    timeout: float = TIMEOUT_S,
    tls: Tls | None = None,
    **options: Unpack[Options],
) -> None:
    """Like `send`, without an event loop."""
    send_packet_sync(host, port, encode(area, address, values, **options), timeout=timeout, tls=tls)


async def send_packet(
    host: str, port: int, packet: bytes, *, timeout: float = TIMEOUT_S, tls: Tls | None = None
) -> None:
    """Sends an encoded packet. Returns when the receiver has written it.

    `timeout`, in seconds, covers name resolution, connection, packet and reply together. `tls` has
    the files for TLS, which are read at each call. Raises `ValueError` for an invalid argument, and
    `ValueError` or `OSError` for files that can't be used.

    Raises `RawRefused`, `RawTimeout`, `RawTlsFailed`, or `RawError` for all other failures; all are
    `RawError`, and `maybe_written` is true if the packet may have been written. Always closes the
    connection, also when the task is cancelled.
    """
    attempt = Attempt(host, port, timeout)
    channel = None if tls is None else await asyncio.to_thread(_channel, host, attempt.port, tls)
    deadline = asyncio.get_running_loop().time() + attempt.timeout
    try:
        async with asyncio.timeout_at(deadline):
            connection = await connected(await addresses(host, attempt.port), deadline)
            with connection:
                if channel is None:
                    reply = await exchange(attempt, connection, packet)
                else:
                    reply = await secure_exchange(attempt, connection, channel, packet)
    except OSError as error:
        raise attempt.failed(error) from error
    attempt.conclude(reply)


def send_packet_sync(
    host: str, port: int, packet: bytes, *, timeout: float = TIMEOUT_S, tls: Tls | None = None
) -> None:
    """Like `send_packet`, without an event loop."""
    attempt = Attempt(host, port, timeout)
    channel = None if tls is None else _channel(host, attempt.port, tls)
    deadline = time.monotonic() + attempt.timeout
    try:
        with connected_sync(host, attempt.port, deadline) as connection:
            if channel is None:
                reply = exchange_sync(attempt, connection, packet, deadline)
            else:
                reply = secure_exchange_sync(attempt, connection, channel, packet, deadline)
    except OSError as error:
        raise attempt.failed(error) from error
    attempt.conclude(reply)


def _channel(host: str, port: int, tls: Tls) -> TlsChannel:
    return TlsChannel(receiver_endpoint(Receiver(host, port, tls)))

"""Targets as the native core has them; the files that TLS needs are read here."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast._core import BlockingClient, Endpoint
from holdfast.client import tls as asyncio_tls
from holdfast.client.target import TLS_PORT, NetworkTarget, SerialTarget

if TYPE_CHECKING:
    from ssl import SSLContext

    from holdfast.client.target import Target, Tls


def blocking(target: Target) -> BlockingClient:
    """The native client of a target; it connects when it is first used."""
    return BlockingClient(endpoint(target))


def endpoint(target: Target) -> Endpoint:
    """A target as the native core has it."""
    if isinstance(target, SerialTarget):
        return Endpoint.serial(
            target.device,
            mode=target.mode,
            baud=target.baud,
            parity=target.parity,
            stop_bits=target.stop_bits,
            data_bits=target.data_bits,
            silence=target.silence,
            echo=target.echo,
        )
    if target.transport == "tls":
        of = target.tls
        return Endpoint.tls(target.host, target.port, of.ca, of.cert, of.key, of.name)
    return Endpoint.network(target.transport, target.host, target.port)


def context(target: NetworkTarget) -> SSLContext | None:
    """What asyncio needs to know of TLS, if the target has it."""
    if target.transport != "tls":
        return None
    endpoint(target)  # It says what is wrong with files and names, as in the other client.
    return asyncio_tls.context(target.tls)


def check_files(tls: Tls) -> None:
    """Raises `OSError` and `ValueError` for files that can't be used."""
    context(NetworkTarget("tls", "localhost", TLS_PORT, tls))

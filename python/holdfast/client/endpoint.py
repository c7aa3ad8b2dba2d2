"""Converts targets to native endpoints, and reads TLS files."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

from holdfast._core import Endpoint
from holdfast.client.serial_settings import SerialTarget
from holdfast.client.tolerance import STRICT
from holdfast.client.url import NetworkTarget
from holdfast.protocol import TLS_PORT
from holdfast.runtime.bounded_files import require_stored

if TYPE_CHECKING:
    from holdfast.client.url import Receiver, Target, Tls


def endpoint(target: Target) -> Endpoint:
    """A target as the native core has it."""
    place = _place(target)
    if target.tolerance == STRICT:
        return place
    return place.tolerating(**asdict(target.tolerance))


def _place(target: Target) -> Endpoint:
    if isinstance(target, SerialTarget):
        return Endpoint.serial(target.device, **target.settings)
    if target.transport == "tls":
        return _secure(target.host, target.port, target.tls)
    return Endpoint.network(target.transport, target.host, target.port)


def receiver_endpoint(receiver: Receiver) -> Endpoint:
    """A receiver of Raw Ingest packets as the native core has it."""
    if receiver.tls is None:
        return Endpoint.network("tcp", receiver.host, receiver.port)
    return _secure(receiver.host, receiver.port, receiver.tls)


def _secure(host: str, port: int, of: Tls) -> Endpoint:
    decrypted_key: bytes | None = None
    if of.key is not None and of.key_passphrase_file is not None:
        from holdfast.net.certificates import own

        decrypted_key = own.unlocked(of.key, of.key_passphrase_file)
    require_stored(of.ca, of.cert, of.key)
    return Endpoint.tls(host, port, of.ca, of.cert, of.key, of.name, decrypted_key)


def check_files(tls: Tls) -> None:
    """Checks TLS files. Raises `OSError` and `ValueError` for files that can't be used."""
    endpoint(NetworkTarget("tls", "localhost", TLS_PORT, tls))

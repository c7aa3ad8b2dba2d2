"""Whom the scanner trusts among devices, and what it shows them.

That is for whoever runs the scanner to say, never for its callers: they name devices, and at most
the name that a device's certificate has.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from holdfast.client.endpoint import check_files, endpoint
from holdfast.client.target import NetworkTarget
from holdfast.net.tls import NO_FILES
from holdfast.scanner.errors import Refused

if TYPE_CHECKING:
    from holdfast._core import Endpoint
    from holdfast.client.target import Target
    from holdfast.net.tls import Tls


def check(tls: Tls) -> None:
    """Raises `OSError` if the files can't be used."""
    if tls == NO_FILES:
        return
    try:
        check_files(tls)
    except ValueError as error:
        raise OSError(f"TLS of devices: {error}") from None


def endpoint_of(address: Target, tls: Tls) -> Endpoint:
    """Where a device is connected to. The files are read when a device is first subscribed to, or
    has moved. Raises `Refused`.
    """
    if isinstance(address, NetworkTarget) and address.transport == "tls":
        address = replace(address, tls=replace(tls, name=address.tls.name))
    try:
        return endpoint(address)
    except (OSError, ValueError) as error:
        raise Refused(f"{address}: {error}") from None

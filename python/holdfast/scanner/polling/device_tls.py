"""The TLS files for connections to devices.

They are settings of the scanner. A request can't choose files, only the name in a device's
certificate.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from holdfast.client.endpoint import check_files, endpoint
from holdfast.client.url import NetworkTarget
from holdfast.net.tls import NO_FILES
from holdfast.scanner.errors import Refused

if TYPE_CHECKING:
    from holdfast._core import Endpoint
    from holdfast.client.url import Target
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
    """Returns the endpoint of a device. Reads the TLS files. Raises `Refused`.

    Called at the first subscription to a device, and when its address has changed.
    """
    if isinstance(address, NetworkTarget) and address.transport == "tls":
        address = replace(address, tls=replace(tls, name=address.tls.name))
    try:
        return endpoint(address)
    except (OSError, ValueError) as error:
        raise Refused(f"{address}: {error}") from None

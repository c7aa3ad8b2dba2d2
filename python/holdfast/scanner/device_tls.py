"""Whom the scanner trusts among devices, and what it shows them.

That is for whoever runs the scanner to say, never for its callers: they name devices, and at most
the name that a device's certificate has.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from holdfast.client import endpoint
from holdfast.scanner.errors import Refused
from holdfast.target import TLS_PORT, NetworkTarget, Tls

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast._core import Endpoint
    from holdfast.target import Target


@dataclass(frozen=True)
class DeviceTls:
    """Files in PEM. They are read when a device is first subscribed to, or has moved."""

    ca_file: Path | None = None
    """Certificates that are trusted; `None` for the system's."""
    cert_file: Path | None = None
    key_file: Path | None = None

    def check(self) -> None:
        """Raises `OSError` if the files can't be used."""
        if self == DeviceTls():
            return
        try:
            self._endpoint(NetworkTarget("tls", "localhost", TLS_PORT))
        except ValueError as error:
            raise OSError(f"TLS of devices: {error}") from None

    def endpoint(self, address: Target) -> Endpoint:
        """Where a device is connected to. Raises `Refused`."""
        try:
            return self._endpoint(address)
        except (OSError, ValueError) as error:
            raise Refused(f"{address}: {error}") from None

    def _endpoint(self, address: Target) -> Endpoint:
        if isinstance(address, NetworkTarget) and address.transport == "tls":
            files = (self.ca_file, self.cert_file, self.key_file)
            ca, cert, key = (None if file is None else str(file) for file in files)
            address = replace(address, tls=Tls(ca, cert, key, address.tls.name))
        return endpoint(address)

"""Whom the scanner trusts among devices, and what it shows them.

That is for whoever runs the scanner to say, never for its callers: they name devices, and at most
the name that a device's certificate has.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from holdfast.client.endpoint import check_files, endpoint
from holdfast.client.target import NetworkTarget, Tls
from holdfast.scanner.errors import Refused

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast._core import Endpoint
    from holdfast.client.target import Target


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
            check_files(self._files())
        except ValueError as error:
            raise OSError(f"TLS of devices: {error}") from None

    def endpoint(self, address: Target) -> Endpoint:
        """Where a device is connected to. Raises `Refused`."""
        if isinstance(address, NetworkTarget) and address.transport == "tls":
            address = replace(address, tls=self._files(address.tls.name))
        try:
            return endpoint(address)
        except (OSError, ValueError) as error:
            raise Refused(f"{address}: {error}") from None

    def _files(self, name: str | None = None) -> Tls:
        files = (self.ca_file, self.cert_file, self.key_file)
        ca, cert, key = (None if file is None else str(file) for file in files)
        return Tls(ca, cert, key, name)

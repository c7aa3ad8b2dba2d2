"""The TLS files of outgoing connections: trusted certificates, and the client's own.

Devices and brokers share this form. A URL, a configuration or a command line names the files.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING
from urllib.parse import quote

from holdfast.runtime.bounded_files import require_stored

if TYPE_CHECKING:
    import ssl
    from collections.abc import Iterator
    from os import PathLike
    from pathlib import Path


def alone(*, cert: bool, key: bool) -> tuple[str, str] | None:
    """Returns the given and the missing key when only one of `cert` and `key` is given."""
    if cert == key:
        return None
    return ("cert", "key") if cert else ("key", "cert")


@dataclass(frozen=True)
class Tls:
    """The TLS files of a connection, in PEM.

    Raises `ValueError` for `cert` without `key`, `key` without `cert`, or a passphrase without key.
    """

    ca: str | None = None
    """Trusted CA certificates, or the device's own certificate; `None` for the system's CAs."""
    cert: str | None = None
    key: str | None = None
    name: str | None = None
    """The expected name in the device's certificate; `None` for the host."""
    key_passphrase_file: str | None = None
    """A file that contains the passphrase of the key."""

    def __post_init__(self) -> None:
        lonely = alone(cert=self.cert is not None, key=self.key is not None)
        if lonely is not None:
            raise ValueError(f"{lonely[0]} without {lonely[1]}: give both, or neither")
        if self.key_passphrase_file is not None and self.key is None:
            raise ValueError("key_passphrase_file without key: give both, or key alone")

    @staticmethod
    def of(
        ca: str | PathLike[str] | None,
        cert: str | PathLike[str] | None = None,
        key: str | PathLike[str] | None = None,
    ) -> Tls:
        """Creates it from paths; each is optional."""
        return Tls(*(None if file is None else str(file) for file in (ca, cert, key)))

    @property
    def query(self) -> str:
        """The query of a URL, without the question mark."""
        paths = {key: value for key, value in asdict(self).items() if value is not None}
        return "&".join(f"{key}={quote(value)}" for key, value in paths.items())

    def files(self) -> Iterator[tuple[str, str]]:
        """Yields the key and the path of each given file."""
        for key in ("ca", "cert", "key", "key_passphrase_file"):
            file: str | None = getattr(self, key)
            if file is not None:
                yield key, file

    def in_folder(self, folder: Path) -> Tls:
        """Returns a copy with paths relative to `folder` resolved."""
        return replace(self, **{key: str(folder / file) for key, file in self.files()})


NO_FILES = Tls()
"""Trusts the system's CAs and presents no certificate."""


def https_context(tls: Tls) -> ssl.SSLContext:
    """Returns a context that checks the certificate and the host name of an HTTP server.

    The files are read at each call, so renewed certificates need no restart. Raises `OSError` for
    an unusable file.
    """
    # Modbus needs only the names of the files: the core does its TLS.
    import ssl

    require_stored(tls.ca, tls.cert, tls.key)
    made = ssl.create_default_context(cafile=tls.ca)
    made.minimum_version = ssl.TLSVersion.TLSv1_2
    if tls.cert is not None:
        # Without a password, OpenSSL would ask for one on the terminal.
        made.load_cert_chain(tls.cert, tls.key, password="")
    return made

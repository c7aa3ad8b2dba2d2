"""The certificates of an HTTPS host, which the core reads and judges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from holdfast import _core
from holdfast.net.certificates.own import REVIEW_S, key_for_core
from holdfast.net.certificates.pem import UnusableFile

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path


@dataclass(frozen=True)
class HttpsFiles:
    """The PEM files of an HTTPS host."""

    cert_file: Path
    """The certificate of the host, followed by its intermediate certificates."""
    key_file: Path
    key_passphrase_file: Path | None = None
    client_ca_file: Path | None = None
    """If given, clients need a certificate that these certificates vouch for."""
    crl_file: Path | None = None
    """If given, every authority above a client requires a list."""
    review: float = REVIEW_S
    """Seconds after which the certificates of open connections are judged again; 0: never."""
    roles: Sequence[str] | None = None
    """The allowed roles of clients, "" is a certificate without a role; `None` is any role."""


class Https:
    """The TLS settings of a host, which can be reloaded while it serves."""

    def __init__(self, files: HttpsFiles) -> None:
        """Loads the files. Raises `UnusableFile`."""
        self._files = files
        self.core = _loaded(files)
        """The settings for new connections. Open connections keep theirs."""
        self.review = files.review
        """Seconds after which the certificates of open connections are judged again; 0: never."""
        self._use: Callable[[_core.ServerTls], None] | None = None

    def follow(self, use: Callable[[_core.ServerTls], None]) -> None:
        """Calls `use` with the settings, now and when they change, instead of the one before."""
        self._use = use
        use(self.core)

    def reload(self) -> None:
        """Loads the files again, for new connections. Thread-safe.

        Raises `UnusableFile` and changes nothing if a file can't be used.
        """
        self.adopt(Https(self._files))

    def adopt(self, other: Https) -> None:
        """Uses the files and certificates of another one for new connections. Thread-safe."""
        self.core, self.review, self._files = other.core, other.review, other._files
        if self._use is not None:
            self._use(self.core)


def _loaded(files: HttpsFiles) -> _core.ServerTls:
    """Loads the files. Raises `UnusableFile`."""
    others = (files.cert_file, files.client_ca_file, files.crl_file)
    decrypted_key = key_for_core(files.key_file, files.key_passphrase_file, *others)
    try:
        return _core.https_server_tls(
            cert_file=files.cert_file,
            key_file=files.key_file,
            client_ca_file=files.client_ca_file,
            crl_file=files.crl_file,
            roles=files.roles,
            decrypted_key=decrypted_key,
        )
    except ValueError as error:
        raise UnusableFile.of(error) from error

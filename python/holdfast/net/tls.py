"""TLS with those that are connected to: which files say who is trusted, and what is shown.

One form for devices and brokers, whether a URL, a configuration or a command line names the files.
"""

from __future__ import annotations

import ssl
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING
from urllib.parse import quote

if TYPE_CHECKING:
    from collections.abc import Iterator
    from os import PathLike
    from pathlib import Path


def alone(*, cert: bool, key: bool) -> tuple[str, str] | None:
    """Which of certificate and key is given without the other, and that other: they go together."""
    if cert == key:
        return None
    return ("cert", "key") if cert else ("key", "cert")


@dataclass(frozen=True)
class Tls:
    """Who is trusted, and what is shown; the files are in PEM.

    Raises `ValueError` for a certificate without its key, and the other way round.
    """

    ca: str | None = None
    """Certificates of authorities, or of the device itself; `None` for the system's."""
    cert: str | None = None
    key: str | None = None
    name: str | None = None
    """The name that the device's certificate has, if that is not its host."""

    def __post_init__(self) -> None:
        lonely = alone(cert=self.cert is not None, key=self.key is not None)
        if lonely is not None:
            raise ValueError(f"{lonely[0]} is alone, allowed are cert and key, or none of both")

    @staticmethod
    def of(
        ca: str | PathLike[str] | None,
        cert: str | PathLike[str] | None = None,
        key: str | PathLike[str] | None = None,
    ) -> Tls:
        """That of files, each of which may be left out."""
        return Tls(*(None if file is None else str(file) for file in (ca, cert, key)))

    @property
    def query(self) -> str:
        """It in a URL, behind the question mark."""
        given = {key: value for key, value in asdict(self).items() if value is not None}
        return "&".join(f"{key}={quote(value)}" for key, value in given.items())

    def files(self) -> Iterator[tuple[str, str]]:
        """The files that are given, with their keys."""
        for key in ("ca", "cert", "key"):
            file: str | None = getattr(self, key)
            if file is not None:
                yield key, file

    def in_folder(self, folder: Path) -> Tls:
        """The same with files that are relative to this folder made absolute."""
        return replace(self, **{key: str(folder / file) for key, file in self.files()})


NO_FILES = Tls()
"""The system's authorities are trusted, and nothing is shown."""


def broker_context(tls: Tls) -> ssl.SSLContext:
    """Checks certificate and host name of a broker; the files are read now, so a renewed one is
    taken.

    Raises `OSError` for a file that can't be used.
    """
    made = ssl.create_default_context(cafile=tls.ca)
    made.minimum_version = ssl.TLSVersion.TLSv1_2
    if tls.cert is not None:
        # A password is given lest OpenSSL ask for one on the terminal.
        made.load_cert_chain(tls.cert, tls.key, password="")
    return made

"""Models of the certificates of TLS servers: of listeners, and of HTTP services."""

from __future__ import annotations

from typing import Annotated

from holdfast.config.models.base import Model
from holdfast.config.values.scalars import DurationOrZero, FilePath, NotNull, Roles
from holdfast.net.certificates.own import REVIEW_S


class _ServerFiles(Model):
    """PEM files of a TLS server; they are read at the start and at a reload."""

    cert_file: FilePath
    """The server's certificate, followed by its intermediate certificates."""
    key_file: FilePath
    """The key of that certificate."""
    key_passphrase_file: Annotated[FilePath | None, NotNull()] = None
    """A file that contains the passphrase of the key."""


class ServerTlsConfig(_ServerFiles):
    """PEM files of a TLS server; they are read at the start and at a reload."""

    ca_file: FilePath
    """Authorities of client certificates, and clients' own certificates."""
    crl_file: Annotated[FilePath | None, NotNull()] = None
    """Certificate revocation lists: one of each authority in the chain of a client."""
    review: DurationOrZero = REVIEW_S
    """At most so many seconds pass until the certificates of open connections are judged again; 0:
    only at a reload."""


class HttpsConfig(_ServerFiles):
    """PEM files of an HTTPS server; they are read at the start and at a reload."""

    client_ca_file: Annotated[FilePath | None, NotNull()] = None
    """Authorities of client certificates, and clients' own certificates. Default: clients
    need no certificate."""
    crl_file: Annotated[FilePath | None, NotNull()] = None
    """Certificate revocation lists: one of each authority in the chain of a client; requires
    client_ca_file."""
    review: DurationOrZero = REVIEW_S
    """At most so many seconds pass until the certificates of open connections are judged again; 0:
    only at a reload."""
    roles: Roles = None
    """Roles of client certificates; "" is a certificate without a role; requires client_ca_file.
    Default: any role."""

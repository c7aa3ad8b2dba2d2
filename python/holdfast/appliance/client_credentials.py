"""The credentials of clients: for the NATS servers of a configuration, and certificates."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.net.tls import NO_FILES

if TYPE_CHECKING:
    from holdfast.config.models.services import ClientTlsConfig, NatsServersConfig
    from holdfast.net.nats.connection import Servers
    from holdfast.net.tls import Tls


def nats_servers(settings: NatsServersConfig) -> Servers:
    """Returns NATS servers and credentials. Only those who use NATS load its client."""
    from holdfast.net.nats.connection import Servers

    return Servers(
        settings.servers,
        settings.username,
        settings.password_file,
        settings.token_file,
        settings.credentials_file,
        tls_files(settings.tls),
    )


def tls_files(settings: ClientTlsConfig | None) -> Tls:
    """The certificates of a client. Without settings, there are none."""
    return NO_FILES if settings is None else settings.files

"""The NATS server that a log has of its own, as its configuration describes it."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

from holdfast.config.scanning import parse_server
from holdfast.nats_server import Access, InUse, NatsServer

if TYPE_CHECKING:
    from collections.abc import Iterator

    from holdfast.config.logs import SharedLogConfig


def server(name: str, settings: SharedLogConfig) -> NatsServer | None:
    """The server of the log `name`, not started; `None` if others run its servers."""
    if settings.embedded is None:
        return None
    at = parse_server(settings.servers[0])
    secrets = settings.username, settings.password_file, settings.token_file
    return NatsServer(name, settings.embedded, Access(at.host, at.port, *secrets))


@contextmanager
def running(name: str, settings: SharedLogConfig) -> Iterator[None]:
    """Starts the server of the log while its appliance does not run. Raises `ServerUnusable`."""
    own = server(name, settings)
    if own is not None:
        try:
            own.start()
        except InUse:
            own = None  # The appliance runs it.
    try:
        yield
    finally:
        if own is not None:
            own.stop()

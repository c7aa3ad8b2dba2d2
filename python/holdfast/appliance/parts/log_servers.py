"""The NATS servers of a log.

A log can have a server of its own. Others are asked whether a power cut may cost what they have
confirmed: only the monitoring of a server tells, ordinary clients can't ask.
"""

from __future__ import annotations

import http.client
import json
import logging
import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING

from holdfast.appliance.client_credentials import tls_files
from holdfast.config.values.scanner_settings import parse_server
from holdfast.config.values.urls import parse_http
from holdfast.events import log_lines
from holdfast.net.nats_server import Access, InUse, NatsServer
from holdfast.net.tls import https_context

if TYPE_CHECKING:
    from collections.abc import Iterator

    from holdfast.config.models.logs import SharedLogConfig

ANSWER_TIMEOUT_S = 5.0
"""Seconds to wait for a server, for each step."""

MAX_ANSWER_BYTES = 65536
"""Bytes; the answer of nats-server has about 1000."""

NANOSECONDS_PER_S = 1e9


def embedded(name: str, settings: SharedLogConfig) -> NatsServer | None:
    """The server of the log `name`, not started; `None` if others run its servers."""
    if settings.embedded is None:
        return None
    at = parse_server(settings.servers[0])
    secrets = settings.username, settings.password_file, settings.token_file
    return NatsServer(name, settings.embedded, Access(at.host, at.port, *secrets))


@contextmanager
def running(name: str, settings: SharedLogConfig) -> Iterator[None]:
    """Starts the server of the log while its appliance does not run. Raises `ServerUnusable`."""
    own = embedded(name, settings)
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


def begin(name: str, settings: SharedLogConfig) -> None:
    """Asks all servers with an address in `monitoring`, and logs what may be lost.

    It does not wait for them: they delay no start.
    """
    if settings.monitoring:
        thread = threading.Thread(
            target=_check, args=(name, settings), name=f"holdfast-monitoring-{name}", daemon=True
        )
        thread.start()


def _check(name: str, settings: SharedLogConfig) -> None:
    for url in settings.monitoring:
        found: dict[str, object]
        try:
            event, interval = "log_server_syncs_late", sync_interval(url, settings)
            found = {
                "seconds": interval,
                "lost": "a power cut may cost confirmed writes of that time",
                "allowed": "sync_interval: always",
            }
        except (OSError, http.client.HTTPException, ValueError) as error:
            event, interval = "log_server_not_checked", 0.0
            found = {"error": str(error) or type(error).__name__}
        if interval is not None:
            log_lines.write(logging.WARNING, event, log=name, server=url, **found)


def sync_interval(url: str, settings: SharedLogConfig) -> float | None:
    """Seconds that what a server has confirmed may not be on its disk; `None` with `always`.

    Raises `OSError`, `HTTPException`, and `ValueError` for an answer of another program.
    """
    host, port, secure, path = parse_http(url)
    connection = http.client.HTTPConnection(host, port, timeout=ANSWER_TIMEOUT_S)
    if secure:
        context = https_context(tls_files(settings.tls))
        connection = http.client.HTTPSConnection(
            host, port, timeout=ANSWER_TIMEOUT_S, context=context
        )
    try:
        connection.request("GET", f"{path.rstrip('/')}/jsz")
        answer = connection.getresponse()
        if answer.status != http.client.OK:
            raise ValueError(f"HTTP status {answer.status}")
        found = json.loads(answer.read(MAX_ANSWER_BYTES))
    finally:
        connection.close()
    jetstream = found.get("config") if isinstance(found, dict) else None
    if not isinstance(jetstream, dict):
        raise ValueError("the answer is not that of nats-server")
    if found.get("disabled"):
        raise ValueError("the server has no JetStream")
    if jetstream.get("sync_always") is True:
        return None
    interval = jetstream.get("sync_interval")
    if not isinstance(interval, int | float):
        raise ValueError("the answer has no sync_interval")
    return interval / NANOSECONDS_PER_S

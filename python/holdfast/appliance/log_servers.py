"""Asks the NATS servers of a log whether a power cut may cost what they have confirmed.

Only the monitoring of a server tells: ordinary clients can't ask.
"""

from __future__ import annotations

import http.client
import json
import logging
import threading
from typing import TYPE_CHECKING

from holdfast import logs
from holdfast.config.http_url import parse_http
from holdfast.net.tls import NO_FILES, https_context

if TYPE_CHECKING:
    from holdfast.config.logs import SharedLogConfig

ANSWER_S = 5.0
"""Seconds to wait for a server, for each step."""

MAX_ANSWER = 65536
"""Bytes; the answer of nats-server has about 1000."""

NANOSECONDS = 1e9


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
        try:
            interval = sync_interval(url, settings)
        except (OSError, http.client.HTTPException, ValueError) as error:
            logs.write(
                logging.WARNING,
                "log_server_not_checked",
                log=name,
                server=url,
                error=str(error) or type(error).__name__,
            )
            continue
        if interval is not None:
            logs.write(
                logging.WARNING,
                "log_server_syncs_late",
                log=name,
                server=url,
                seconds=interval,
                lost="a power cut may cost confirmed writes of that time",
                allowed="sync_interval: always",
            )


def sync_interval(url: str, settings: SharedLogConfig) -> float | None:
    """Seconds that what a server has confirmed may not be on its disk; `None` with `always`.

    Raises `OSError`, `HTTPException`, and `ValueError` for an answer of another program.
    """
    host, port, secure, path = parse_http(url)
    connection = http.client.HTTPConnection(host, port, timeout=ANSWER_S)
    if secure:
        tls = NO_FILES if settings.tls is None else settings.tls.files
        context = https_context(tls)
        connection = http.client.HTTPSConnection(host, port, timeout=ANSWER_S, context=context)
    try:
        connection.request("GET", f"{path.rstrip('/')}/jsz")
        answer = connection.getresponse()
        if answer.status != http.client.OK:
            raise ValueError(f"HTTP status {answer.status}")
        found = json.loads(answer.read(MAX_ANSWER))
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
    return interval / NANOSECONDS

"""The security events of the log, in the terms of the Elastic Common Schema (ECS).

The names, categories, types and outcomes are stable, see docs/security-events.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias

from holdfast.errors import UNCERTAIN

if TYPE_CHECKING:
    from collections.abc import Mapping

Outcome: TypeAlias = Literal["success", "failure", "unknown"]


class Meaning(NamedTuple):
    """What an event is: `event.category`, `event.type` and `event.outcome`."""

    category: tuple[str, ...]
    type: tuple[str, ...]
    outcome: Outcome


_OPENED = Meaning(("network",), ("connection", "start"), "success")
_CLOSED = Meaning(("network",), ("connection", "end"), "success")
_BROKEN = Meaning(("network",), ("connection", "end"), "failure")
_UNUSABLE = Meaning(("network",), ("connection", "info"), "failure")
_NOT_ADMITTED = Meaning(("network",), ("connection", "denied"), "failure")
_REQUEST_DENIED = Meaning(("network",), ("protocol", "denied"), "failure")
_COMMAND_DENIED = Meaning(("api",), ("denied",), "failure")
_NOT_AUTHENTICATED = Meaning(("authentication", "api"), ("start", "denied"), "failure")
_SESSION_ENDED = Meaning(("session",), ("end",), "success")
_WRITTEN = Meaning(("api",), ("change",), "success")
_CHANGED = Meaning(("configuration",), ("change",), "success")
_NOT_CHANGED = Meaning(("configuration",), ("change",), "failure")
_STORED = Meaning(("file",), ("change",), "success")
_NOT_STORED = Meaning(("file",), ("change",), "failure")
_HEALTHY = Meaning(("process",), ("info",), "success")
_UNHEALTHY = Meaning(("process",), ("info",), "failure")

EVENTS: Mapping[str, Meaning] = {
    # Connections
    "listening": Meaning(("network",), ("start",), "success"),
    "opened": _OPENED,
    "closed": _CLOSED,
    "idle": _CLOSED,
    "ended": _CLOSED,
    "refused_source": _NOT_ADMITTED,
    "refused_full": _NOT_ADMITTED,
    "evicted": _CLOSED,
    "request_timeout": _BROKEN,
    "slow_reader": _BROKEN,
    "broken_frame": _BROKEN,
    "unrequested_data": _UNUSABLE,
    "accept_error": _UNUSABLE,
    "listener_fault": _UNUSABLE,
    "line_lost": _BROKEN,
    "line_back": _OPENED,
    # Authentication and sessions
    "secured": Meaning(("authentication", "network"), ("start", "allowed"), "success"),
    "tls_failed": Meaning(("authentication", "network"), ("start", "denied"), "failure"),
    "refused_role": Meaning(("session",), ("start",), "failure"),
    "rights_revoked": _SESSION_ENDED,
    "session_ended": _SESSION_ENDED,
    # Requests
    "refused_function": _REQUEST_DENIED,
    "refused_unit": _REQUEST_DENIED,
    "refused_address": _REQUEST_DENIED,
    "refused_sealed": _REQUEST_DENIED,
    "refused_listen_only": _REQUEST_DENIED,
    "packet_refused": _REQUEST_DENIED,
    "surplus_bytes": _REQUEST_DENIED,
    "bytes_dropped": _REQUEST_DENIED,
    "broken_request": _REQUEST_DENIED,
    "message_malformed": _REQUEST_DENIED,
    "ingest_refused": _COMMAND_DENIED,
    "gateway_refused": _COMMAND_DENIED,
    "request_refused": _COMMAND_DENIED,
    "gateway_write": _WRITTEN,
    "tag_written": _WRITTEN,
    # Brokers
    "mqtt_connected": _OPENED,
    "mqtt_disconnected": _CLOSED,
    "mqtt_connect_failed": _UNUSABLE,
    "mqtt_subscription_refused": Meaning(("network",), ("denied",), "failure"),
    "nats_connected": _OPENED,
    "nats_disconnected": _CLOSED,
    "nats_connect_failed": _UNUSABLE,
    # Configuration
    "reloaded": _CHANGED,
    "reload_refused": _NOT_CHANGED,
    "reload_incomplete": _NOT_CHANGED,
    "seal": _CHANGED,
    "scanner_enabled": _CHANGED,
    "scanner_disabled": _CHANGED,
    "certificate_expires": Meaning(("file",), ("info",), "unknown"),
    "certificate_expired": Meaning(("file",), ("info",), "failure"),
    "tls_unusable": Meaning(("file",), ("access",), "failure"),
    # Start, stop and health
    "started": Meaning(("process",), ("start",), "success"),
    "stopped": Meaning(("process",), ("end",), "success"),
    "shutdown_asked": Meaning(("process",), ("end",), "success"),
    "memory_file_failing": _NOT_STORED,
    "memory_file_back": _STORED,
    "log_contents_dropped": _UNHEALTHY,
    "log_failed": _UNHEALTHY,
    "log_digests_differ": _UNHEALTHY,
    "thread_stalled": _UNHEALTHY,
    "thread_back": _HEALTHY,
    "clock_stepped": Meaning(("host",), ("change",), "unknown"),
    # The logs themselves
    "audit_failed": _NOT_STORED,
    "audit_back": _STORED,
    "audit_lost": _NOT_STORED,
    "audit_not_rotated": _NOT_STORED,
    "audit_copy_failed": _NOT_STORED,
    "audit_copies_back": _STORED,
    "audit_copies_lost": _NOT_STORED,
    "events_lost": _UNHEALTHY,
    "log_dropped": _UNHEALTHY,
    "held_back": Meaning(("process",), ("info",), "unknown"),
}

BY_REASON: Mapping[tuple[str, str], Meaning] = {
    ("ingest_refused", "unauthorized"): _NOT_AUTHENTICATED,
    ("gateway_refused", "unauthorized"): _NOT_AUTHENTICATED,
}
"""Events that are something else for one reason."""

OUTCOMES: Mapping[tuple[str, str], Outcome] = {
    ("gateway_write", "failed"): "unknown",
    ("gateway_write", "not sent"): "failure",
    ("gateway_write", "refused"): "failure",
    **{("gateway_write", f"exception {code:02X}"): "unknown" for code in UNCERTAIN},
}
"""Outcomes by the field `outcome` of an event. Other Modbus exceptions are failures."""


def meaning(event: str, fields: Mapping[str, object]) -> Meaning | None:
    """Returns what an event is; `None` if it is not a security event."""
    found = BY_REASON.get((event, str(fields.get("reason")))) or EVENTS.get(event)
    given = fields.get("outcome")
    if found is None or not isinstance(given, str):
        return found
    usual: Outcome = "failure" if given.startswith("exception") else found.outcome
    return found._replace(outcome=OUTCOMES.get((event, given), usual))

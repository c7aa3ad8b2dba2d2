"""The security events of the log, with their category, type and outcome in the terms of ECS.

The names, categories, types and outcomes are stable, see docs/security-events.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias

from holdfast.errors import NOT_EXECUTED

if TYPE_CHECKING:
    from collections.abc import Mapping

Outcome: TypeAlias = Literal["success", "failure", "unknown"]


class Meaning(NamedTuple):
    """What an event is: `event.category`, `event.type` and `event.outcome`."""

    category: tuple[str, ...]
    type: tuple[str, ...]
    outcome: Outcome


_MEANINGS: Mapping[tuple[str, str, Outcome], str] = {
    # Connections, also those to brokers
    ("network", "start", "success"): "listening",
    ("network", "connection start", "success"): "opened line_back mqtt_connected nats_connected",
    ("network", "connection end", "success"): """
        closed idle ended evicted mqtt_disconnected nats_disconnected""",
    ("network", "connection end", "failure"): "request_timeout slow_reader broken_frame line_lost",
    ("network", "connection denied", "failure"): "refused_source refused_full",
    ("network", "connection info", "failure"): """
        unrequested_data accept_error listener_fault mqtt_connect_failed nats_connect_failed""",
    ("network", "denied", "failure"): "mqtt_subscription_refused",
    # Authentication and sessions
    ("authentication network", "start allowed", "success"): "secured",
    ("authentication network", "start denied", "failure"): "tls_failed",
    ("session", "start", "failure"): "refused_role",
    ("session", "end", "success"): "rights_revoked session_ended",
    # Requests
    ("network", "protocol allowed", "success"): "unit_silenced unit_back",
    ("network", "protocol denied", "failure"): """
        refused_function refused_unit refused_address refused_sealed refused_listen_only
        packet_refused surplus_bytes bytes_dropped broken_request message_malformed""",
    ("api", "denied", "failure"): "ingest_refused gateway_refused request_refused",
    ("api", "change", "success"): "gateway_write tag_written",
    # Configuration
    ("configuration", "change", "success"): "reloaded seal scanner_enabled scanner_disabled",
    ("configuration", "change", "failure"): "reload_refused reload_incomplete",
    ("file", "info", "unknown"): "certificate_expires",
    ("file", "info", "failure"): "certificate_expired",
    ("file", "access", "failure"): "tls_unusable",
    # Start, stop and health, also of the logs
    ("process", "start", "success"): "started",
    ("process", "end", "success"): "stopped shutdown_asked",
    ("process", "info", "success"): "thread_back",
    ("process", "info", "failure"): """
        thread_stalled log_contents_dropped log_failed log_digests_differ log_dropped
        events_lost""",
    ("process", "info", "unknown"): "held_back",
    ("file", "change", "success"): """
        memory_file_back memory_file_recreated audit_back audit_copies_back""",
    ("file", "change", "failure"): """
        memory_file_failing memory_file_lost audit_failed audit_lost audit_not_rotated
        audit_copy_failed audit_copies_lost""",
    ("host", "change", "unknown"): "clock_stepped",
}
"""The events by category, type and outcome."""

EVENTS: Mapping[str, Meaning] = {
    event: Meaning(tuple(category.split()), tuple(kind.split()), outcome)
    for (category, kind, outcome), events in _MEANINGS.items()
    for event in events.split()
}

_NOT_AUTHENTICATED = Meaning(("authentication", "api"), ("start", "denied"), "failure")
_NOT_CONFIRMED = Meaning(("api",), ("change",), "unknown")

BY_REASON: Mapping[tuple[str, str], Meaning] = {
    ("ingest_refused", "unauthorized"): _NOT_AUTHENTICATED,
    ("gateway_refused", "unauthorized"): _NOT_AUTHENTICATED,
    ("ingest_refused", "not_confirmed"): _NOT_CONFIRMED,
    ("ingest_refused", "internal_error"): _NOT_CONFIRMED,
}
"""Events that are something else for one reason."""

OUTCOMES: Mapping[str, Outcome] = {
    "failed": "unknown",
    "not_confirmed": "unknown",
    "not sent": "failure",
    "refused": "failure",
    **{f"exception {code:02X}": "failure" for code in NOT_EXECUTED},
}
"""Outcomes by the field `outcome` of an event. After other Modbus exceptions, it is unknown."""


def meaning(event: str, fields: Mapping[str, object]) -> Meaning | None:
    """Returns what an event is; `None` if it is not a security event."""
    found = BY_REASON.get((event, str(fields.get("reason")))) or EVENTS.get(event)
    given = fields.get("outcome")
    if found is None or not isinstance(given, str):
        return found
    usual: Outcome = "unknown" if given.startswith("exception") else found.outcome
    outcome = OUTCOMES.get(given, usual)
    # What may have been carried out was not denied.
    kind = found.type if outcome != "unknown" else ("change",)
    return found._replace(type=kind, outcome=outcome)

"""Log lines as documents of the Elastic Common Schema (ECS), for a SIEM.

The names are stable, see docs/security-events.md. Category, type and outcome of an event:
`holdfast.events.ecs_categories`.
"""

from __future__ import annotations

import ipaddress
import os
import socket
from typing import TYPE_CHECKING, Any

from holdfast._core import __version__
from holdfast.events import ecs_categories

if TYPE_CHECKING:
    from collections.abc import Mapping

ECS_VERSION = "8.17.0"
DATASET = "holdfast.log"
SECURITY_DATASET = "holdfast.security"

FIELDS = {
    "error": "error.message",
    "expires": "file.x509.not_after",
    "file": "file.path",
    "path": "url.path",
    "problem": "event.reason",
    "reason": "event.reason",
    "serial": "tls.client.x509.serial_number",
    "session": "holdfast.session.id",
    "session_peer": "holdfast.session.peer",
    "session_role": "holdfast.session.role",
    "session_serial": "holdfast.session.x509.serial_number",
    "session_subject": "holdfast.session.subject",
    "sha256": "file.hash.sha256",
    "source": "user.name",
    "subject": "tls.client.subject",
    "thread": "process.thread.name",
    "who": "user.name",
}
"""Where fields of the log are in a document. All others are below `holdfast`."""

MESSAGES = ("request_refused", "message_malformed", "message_too_large")
"""Events whose `subject` is that of a NATS message, not of a certificate."""

NUMBERS = (
    "attempts",
    "bytes",
    "closed",
    "count",
    "failures",
    "function",
    "held_back",
    "heartbeat_age",
    "lost",
    "opened",
    "retry_in",
    "scan_rate",
    "step",
    "unit",
)
"""Fields that are numbers. All others are text: a field must have one type in all documents."""

UNKNOWN = "-"
"""What a field of the log has if nothing is known."""


_ports: dict[str, int] = {}


def note_port(listener: str, port: int) -> None:
    """Has later documents of a listener tell its port."""
    _ports[listener] = port


def document(
    time: str, level: str, event: str, fields: Mapping[str, object], message: str
) -> dict[str, object]:
    """Returns the document of a log line. `message` is the line for people."""
    meaning = ecs_categories.meaning(event, fields)
    about: dict[str, object] = {
        "kind": "event",
        "module": "holdfast",
        "dataset": DATASET if meaning is None else SECURITY_DATASET,
        "action": event,
    }
    if meaning is not None:
        about |= {
            "category": list(meaning.category),
            "type": list(meaning.type),
            "outcome": meaning.outcome,
        }
    made: dict[str, object] = {
        "@timestamp": time,
        "log.level": level,
        "message": message,
        "ecs": {"version": ECS_VERSION},
        "event": about,
        "service": {"name": "holdfast", "type": "holdfast", "version": __version__},
        "observer": {
            "hostname": socket.gethostname(),
            "product": "Holdfast",
            "type": "server",
            "version": __version__,
        },
        "process": {"pid": os.getpid()},
    }
    for key, value in fields.items():
        if value in (UNKNOWN, "", None):
            continue
        if key == "peer":
            made |= _peer(str(value))
        elif key == "role":
            _put(made, "user.roles", [value])
        elif key == "subject" and event in MESSAGES:
            _put(made, "holdfast.subject", value)
        else:
            typed = value if key in NUMBERS else str(value)
            _put(made, FIELDS.get(key, f"holdfast.{key}"), typed)
    port = _ports.get(str(fields.get("listener", fields.get("adapter"))))
    if port is not None:
        made["destination"] = {"port": port}
    return made


def _peer(peer: str) -> dict[str, object]:
    """The fields of a peer: `10.0.0.9:51200`, `[fd00::9]:51200`, `10.0.0.9`, or any other name."""
    try:
        alone = str(ipaddress.ip_address(peer))
        return {"source": {"address": alone, "ip": alone}, "related": {"ip": [alone]}}
    except ValueError:
        host, _, port = peer.rpartition(":")
    try:
        address, number = str(ipaddress.ip_address(host.strip("[]"))), int(port)
    except ValueError:
        return {"source": {"address": peer}}
    return {
        "source": {"address": address, "ip": address, "port": number},
        "related": {"ip": [address]},
    }


def _put(document: dict[str, Any], path: str, value: object) -> None:
    *folders, name = path.split(".")
    for folder in folders:
        document = document.setdefault(folder, {})
    document[name] = value

"""What a configuration can be expected to hold one day, but not in this version.

It is refused by name, so that nobody takes it for served.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.config.tolerance import mapping

if TYPE_CHECKING:
    from holdfast.config.problems import Report
    from holdfast.config.source import KeyPath

SECTIONS = ("rest", "mqtt", "metrics", "devices", "nats", "audit", "gateway")
LISTENER_TYPES = (
    "modbus-tls",
    "modbus-udp",
    "modbus-rtu-over-tcp",
    "modbus-rtu",
    "modbus-ascii",
    "raw-ingest",
)


def refuse_unavailable(data: object, report: Report) -> list[KeyPath]:
    """Reports what is not available; returns where it is, for nobody else to look at it."""
    refused: list[KeyPath] = []
    for name in SECTIONS:
        if name in mapping(data):
            report.add((name,), "this section is not available in this version", of_key=True)
            refused.append((name,))
    for name, listener in mapping(mapping(data).get("listeners")).items():
        kind = mapping(listener).get("type")
        if isinstance(kind, str) and kind in LISTENER_TYPES:
            message = f"{kind!r} is not available in this version, allowed: modbus-tcp"
            report.add(("listeners", name, "type"), message)
            refused.append(("listeners", name))
    return refused

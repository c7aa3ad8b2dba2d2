"""The reasons of refusals of REST, and their status codes."""

from __future__ import annotations

from holdfast.net.http.refusals import COMMON, Refusal, Refusals

REFUSALS = Refusals(
    *COMMON,
    Refusal(
        400,
        ("invalid_value", "malformed", "invalid_area", "out_of_range", "not_one_step"),
        "The JSON, a parameter, an area, an address or a value is invalid, or the memories of a "
        "batch are not kept together",
        "values[2] is 70000, outside 0..65535",
    ),
    Refusal(
        403,
        ("not_granted", "foreign_page"),
        "The token does not grant this memory or area, writes, or the management of sessions; or "
        "the request is from a page of another site",
        "area coils is not granted to edge-gateway",
    ),
    Refusal(
        404,
        ("unknown_memory", "unknown_session", "not_found", "not_configured"),
        "The resource, the memory or the session does not exist",
        'no memory "plant_z"',
    ),
    Refusal(
        409,
        ("mirrored",),
        "The range mirrors a device, and only its poller writes it",
        "1 from address 40 of holding_registers overlap a range that mirrors a device",
    ),
    Refusal(
        502,
        ("device_refused",),
        "The range is written through to a device, which refused the write or did not answer",
        "drive_7 did not take the write: exception 02 (Illegal Data Address)",
    ),
    Refusal(
        503,
        ("unrecorded", "not_stored", "log_unavailable", "stale", "busy", "withdrawn"),
        "The audit log, the file or the log of the memory can't be written, and nothing has "
        "changed; the range mirrors a device whose values are too old; too many change streams "
        "are open, or too many writes wait for a device, the file or the log; or a write was not "
        "sent to its device, because its client has gone or the service ends",
        "the audit log can't be written, and no write is carried out without a record",
    ),
    Refusal(
        504,
        ("not_confirmed",),
        "The log of the memory did not confirm the write in time; it may still be carried out",
        "the log did not confirm the write in time; it may still be carried out",
    ),
    Refusal(
        415,
        ("not_json",),
        "The body is not `application/json`, or is compressed",
        'Content-Type is "text/plain", allowed: application/json',
    ),
)

MEMORY = ("unknown_memory", "not_granted", "invalid_area", "out_of_range")
"""Refusals of a range by the memory access."""

VALUES = (
    "invalid_value",
    "too_large",
    "mirrored",
    "device_refused",
    "busy",
    "withdrawn",
    "unrecorded",
    "not_one_step",
    "not_stored",
    "log_unavailable",
    "stale",
    "not_confirmed",
)

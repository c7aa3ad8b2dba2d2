"""The reasons of refusals and failures of the gateway, and their status codes."""

from __future__ import annotations

from holdfast.net.http.refusals import COMMON, Refusal, Refusals

EXCEPTION_STATUS = 200
"""The status of an exception of the device: the request itself succeeded."""

REFUSALS = Refusals(
    *COMMON,
    Refusal(
        400,
        ("malformed",),
        "The request is malformed",
        "port is 0, allowed: an integer 1 to 65535",
    ),
    Refusal(
        403,
        ("refused_target", "writes_off", "foreign_page"),
        "The target is not in the egress list, writes are disabled, or the request is from a page "
        "of another site",
        "192.168.7.7, port 502, is not in the egress list of this gateway",
    ),
    Refusal(404, ("not_found",), "The resource does not exist", 'no resource at "/api"'),
    Refusal(
        409,
        ("repeated",),
        "The write was sent before, by its `Idempotency-Key`, and its outcome is unknown",
        "Idempotency-Key is known, but not what the device has replied: the write may have been "
        "carried out before",
    ),
    Refusal(
        415,
        ("not_json",),
        "The body is not `application/json` or `application/x-www-form-urlencoded`, or is "
        "compressed",
        'Content-Type is "text/plain", allowed: application/json',
    ),
    Refusal(
        503,
        ("busy", "stopping"),
        "Too many requests at once, or the gateway is stopping",
        "too many requests: 128 are active, which is the limit",
    ),
)

FAILURE = Refusal(
    500,
    (
        "no_such_name",
        "no_connection",
        "tls_failed",
        "connection_lost",
        "timeout",
        "invalid_reply",
        "internal_error",
    ),
    "No connection, a failed TLS handshake, or no response in time",
    "Connection timeout",
)
"""A failure: no connection or no valid response."""

DEVICE = ("refused_target", "busy", "stopping")
"""Reasons of all operations on devices, beside those of `FAILURE`."""

WRITE = ("writes_off", "repeated")
"""Further reasons of operations that may write."""

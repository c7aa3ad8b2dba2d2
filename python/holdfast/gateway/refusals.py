"""What the gateway refuses, and what fails: each reason and its status."""

from __future__ import annotations

from holdfast.web.refusals import Refusal, Refusals

REFUSALS = Refusals(
    Refusal(
        400,
        ("malformed",),
        "Not what is asked for",
        "port is 0, allowed is an integer 1 to 65535",
    ),
    Refusal(
        401,
        ("unauthorized",),
        "No token, or one that is not known",
        "the token is not known",
    ),
    Refusal(
        403,
        ("refused_target", "writes_off", "foreign_page"),
        "The target is not in the egress list, writes are off, or a page of another site asks",
        "192.168.7.7, port 502, is not in the egress list of this gateway",
    ),
    Refusal(404, ("not_found",), "There is nothing at this path", 'there is nothing at "/api"'),
    Refusal(
        405,
        ("method_not_allowed",),
        "Not with this method",
        "Method not allowed: allowed are POST, OPTIONS",
    ),
    Refusal(
        408,
        ("timeout",),
        "The body did not arrive in time; the connection is closed",
        "1024 bytes came in time, more were announced",
    ),
    Refusal(
        413,
        ("too_large",),
        "The body is too large; the connection is closed",
        "the body has more than 65536 bytes",
    ),
    Refusal(
        415,
        ("not_json",),
        "Neither `application/json` nor what curl says instead, or compressed",
        'Content-Type is "text/plain", allowed is application/json',
    ),
    Refusal(
        503,
        ("busy", "stopping"),
        "Too much at once, or the gateway stops",
        "128 requests are under way, which is the limit",
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
    "No connection, TLS not agreed on, or no reply in time",
    "Connection timeout",
)
"""There was no connection or no reply: a refusal of nobody's, whose reasons are told apart."""

EVERYWHERE = ("method_not_allowed",)
ASKING = ("foreign_page",)
"""Of everything that not everybody may ask for; with tokens also `unauthorized`."""

BODY = ("malformed", "timeout", "too_large", "not_json")
QUERY = ("malformed",)
DEVICE = ("refused_target", "busy", "stopping")
"""Of everything that is asked of a device; it may fail, too."""

WRITE = ("writes_off",)

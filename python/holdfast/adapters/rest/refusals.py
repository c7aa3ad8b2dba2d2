"""What REST refuses: each reason and its status."""

from __future__ import annotations

from holdfast.web.refusals import Refusal, Refusals

REFUSALS = Refusals(
    Refusal(
        400,
        ("invalid_value", "malformed", "invalid_area", "out_of_range"),
        "Not what is asked for: the text, a parameter, an area, an address or a value",
        "values[2] is 70000, outside 0..65535",
    ),
    Refusal(
        401,
        ("unauthorized",),
        "No token, or one that is not known",
        "the token is not known",
    ),
    Refusal(
        403,
        ("not_granted",),
        "The token does not reach this memory or area, or may not write",
        "area coils is not granted to edge-gateway",
    ),
    Refusal(
        404,
        ("unknown_memory", "not_found", "not_configured"),
        "There is no such thing",
        'no memory "plant_z"',
    ),
    Refusal(
        405,
        ("method_not_allowed",),
        "Not with this method",
        "allowed are POST, OPTIONS",
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
        "the body has more than 8388608 bytes",
    ),
    Refusal(
        415,
        ("not_json",),
        "Not `application/json`, or compressed",
        'Content-Type is "text/plain", allowed is application/json',
    ),
)

EVERYWHERE = ("method_not_allowed",)
BODY = ("malformed", "timeout", "too_large", "not_json")
QUERY = ("malformed",)
MEMORY = ("unknown_memory", "not_granted", "invalid_area", "out_of_range")
"""What the memory access says of a range."""

VALUES = ("invalid_value",)

"""The routes of REST: parameters, responses and refusals of each.

The application serves exactly these, and the OpenAPI document is generated from them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from holdfast.adapters.rest.refusals import BODY, MEMORY, QUERY, STREAM, VALUES
from holdfast.adapters.rest.schemas import ADDRESS, TEXT
from holdfast.protocol import ADDRESSES
from holdfast.web.openapi import (
    DOCUMENT,
    PAGE,
    Schema,
    html_answer,
    integer,
    json_answer,
    ref,
    stream_answer,
)
from holdfast.web.requests import BadRequest, shown

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

MAX_RANGES = 16
"""The most ranges of a change stream."""

_NUMBERS: dict[str, tuple[Callable[[str], float], str]] = {
    "integer": (int, "[0-9]{1,10}"),
    "number": (float, "[0-9]{1,10}(\\.[0-9]{1,10})?"),
}


@dataclass(frozen=True)
class Parameter:
    """A query parameter. It is required unless it has a default."""

    name: str
    text: str
    schema: Schema
    example: object
    default: object = None
    repeats: bool = False
    """Whether it may be given up to `MAX_RANGES` times. Then it is parsed as a list."""

    @property
    def most(self) -> int:
        """How often it may be given."""
        return MAX_RANGES if self.repeats else 1

    def parse(self, given: Sequence[str] | None) -> Any:
        """Parses what was given, as in the schema. Raises `BadRequest`."""
        if given is None:
            return self.default
        values = [self._one(value) for value in given]
        return values if self.repeats else values[0]

    def _one(self, given: str) -> Any:
        kind = self.schema.get("type")
        if kind not in _NUMBERS:
            return given
        convert, form = _NUMBERS[kind]
        least, most = self.schema["minimum"], self.schema["maximum"]
        if re.fullmatch(form, given) and least <= convert(given) <= most:
            return convert(given)
        named = "an integer" if kind == "integer" else "a number"
        allowed = f"allowed: {named} from {least} to {most}"
        raise BadRequest("malformed", f"{self.name} is {shown(given)}, {allowed}")

    def described(self) -> Schema:
        """The schema of everything that is given."""
        if self.repeats:
            return {"type": "array", "minItems": 1, "items": self.schema}
        return self.schema


@dataclass(frozen=True)
class Body:
    """A required JSON body. The examples have a key, a title and a value."""

    schema: Schema
    examples: dict[str, tuple[str, Any]]


@dataclass(frozen=True)
class Route:
    """A path and its method. GET includes HEAD."""

    path: str
    method: Literal["GET", "POST"]
    name: str
    """The `operationId`, and the key of the application's handler."""
    summary: str
    answer: dict[str, Any]
    """The OpenAPI response of status 200."""
    refusals: tuple[str, ...] = ()
    """The reasons of refusals that only this route has."""
    is_open: bool = False
    """Whether the route never requires a token."""
    description: str | None = None
    parameters: tuple[Parameter, ...] = ()
    body: Body | None = None


def _command(area: str, address: int, values: list[int]) -> dict[str, object]:
    return {"memory": "plant_a", "area": area, "address": address, "values": values}


INGEST = Route(
    "/api/v1/ingest",
    "POST",
    "ingest",
    "Write one command, or a batch of commands atomically",
    json_answer(
        "All values were written",
        {"oneOf": [ref("Accepted"), ref("BatchAccepted")]},
        {"status": "accepted", "memory": "plant_a", "written": 3},
    ),
    (*BODY, *MEMORY, *VALUES),
    description="In a refusal, `command` is the index of the command in the batch and `index` the "
    "index of the value in the command, both from 0. Where ranges of a batch overlap, the later "
    "command wins.",
    body=Body(
        {"oneOf": [ref("Command"), ref("Batch")]},
        {
            "registers": ("Three registers", _command("holding_registers", 0, [100, 200, 300])),
            "bits": ("Two bits", _command("coils", 8, [True, 0])),
            "batch": (
                "Two commands, written atomically",
                [_command("input_registers", 0, [7]), _command("discrete_inputs", 3, [1])],
            ),
        },
    ),
)

READ = Route(
    "/api/v1/memory/read",
    "GET",
    "read",
    "Read a range atomically",
    json_answer("The values; bits are 0 or 1", ref("Values"), {"values": [100, 200, 300]}),
    (*QUERY, *MEMORY, "log_unavailable", "stale"),
    parameters=(
        Parameter("memory", "The name of the memory", TEXT, "plant_a"),
        Parameter("area", "The area", ref("Area"), "holding_registers"),
        Parameter("address", "The first address", ADDRESS, 0),
        Parameter("count", "The number of bits or registers", integer(1, ADDRESSES), 3),
    ),
)

CHANGES = Route(
    "/api/v1/memory/changes",
    "GET",
    "changes",
    "Follow ranges: a stream of their values and changes",
    stream_answer(values="Change", unavailable="Unavailable"),
    (*QUERY, *MEMORY, *STREAM),
    description="Server-sent events. The first event of each range has its current values; later "
    "events have the shortest part of a range that contains all changes. The `id` of an event is "
    "the number of writes to the memory; events with the same `id` are of the same moment. A "
    "client that reads slowly receives the newest values. `area`, `address` and `count` can be "
    f"repeated together, for up to {MAX_RANGES} ranges. After a reconnect, with or without "
    "`Last-Event-ID`, the stream begins with the current values. `unavailable` means that a "
    "replicated memory can't be read at present, or that a range mirrors a device that does not "
    "answer; once all ranges can be read, they follow as a whole.",
    parameters=(
        Parameter("memory", "The name of the memory", TEXT, "plant_a"),
        Parameter("area", "The area", ref("Area"), ["holding_registers"], repeats=True),
        Parameter("address", "The first address", ADDRESS, [0], repeats=True),
        Parameter(
            "count", "The number of bits or registers", integer(1, ADDRESSES), [3], repeats=True
        ),
        Parameter(
            "min_interval",
            "The shortest time in seconds between two events of a range",
            {"type": "number", "minimum": 0.05, "maximum": 3600},
            0.5,
            default=0.1,
        ),
    ),
)

ROUTES = (
    INGEST,
    READ,
    CHANGES,
    Route(
        "/api/v1/health",
        "GET",
        "health",
        "Check that the server is running",
        json_answer("The server is running", ref("Health"), {"status": "ok"}),
        is_open=True,
    ),
    Route(
        "/api/v1/diagnostics/memory",
        "GET",
        "memories",
        "List the memories that the token grants",
        json_answer(
            "The areas and the seal of each memory",
            ref("Memories"),
            {
                "memories": {
                    "plant_a": {
                        "areas": {
                            "coils": {"start": 0, "size": 1024},
                            "holding_registers": {"start": 0, "size": 4096},
                        },
                        "sealed": False,
                        "opened": 1,
                        "closed": 0,
                    }
                }
            },
        ),
    ),
    Route(
        "/api/v1/diagnostics/stats",
        "GET",
        "stats",
        "Get all counters since the start",
        json_answer(
            "Counters of listeners, devices, adapters, logs and files of memories; threads",
            ref("Stats"),
            {
                "uptime": 3600.25,
                "listeners": {
                    "scada": {
                        "requests": {"3": 7200},
                        "exceptions": {"2": 1},
                        "unanswered": 0,
                        "connections": {"accepted": 2, "open": 1},
                    }
                },
                "devices": {
                    "meter": {
                        "health": "ok",
                        "age": 0.4,
                        "requests": 7200,
                        "valid": 7199,
                        "timeouts": 1,
                    }
                },
                "links": {
                    "bus_1": {
                        "requests": 5000,
                        "replies": 4100,
                        "exceptions": 3,
                        "timeouts": 2,
                        "failures": 0,
                        "refused_full": 0,
                        "refused_down": 1,
                        "coalesced": 896,
                        "cached": 0,
                        "withdrawn": 0,
                        "waiting": 1,
                        "unexpected_replies": 0,
                        "stray_bytes": 0,
                        "late_replies": 1,
                        "raised_timeouts": 0,
                        "floods": 0,
                    }
                },
                "adapters": {
                    "rest": {
                        "state": "running",
                        "restarts": 0,
                        "last_error": None,
                        "accepted": 120,
                        "values": 360,
                        "reads": 4,
                        "refused": {"invalid_value": 1},
                    }
                },
                "events_lost": 0,
                "log_dropped": 0,
                "memory_files": {
                    "/var/lib/holdfast/setpoints.redb": {
                        "failing": None,
                        "stored_at": 1893456000.0,
                        "commits": 12,
                        "pending": 0,
                        "refused": 0,
                        "last_commit_seconds": 0.004,
                        "bytes": 73728,
                    }
                },
                "logs": {
                    "site": {
                        "phase": "running",
                        "connected": True,
                        "contact_age": 0.2,
                        "sequence": 5000,
                        "lag": 0,
                        "steps": 1200,
                        "unavailable": 0,
                        "not_confirmed": 0,
                        "refused": 0,
                        "ignored": 0,
                        "nodes": [
                            {
                                "name": "scada-a",
                                "sequence": 5000,
                                "time_ns": 1893456000000000000,
                                "digest": None,
                            }
                        ],
                    }
                },
                "audit": None,
                "threads": {"holdfast-io-0": {"heartbeat_age": 0.4, "cpu": 12.5}},
                "certificates": {"/etc/holdfast/server.pem": 1893456000.0},
                "revocation_lists": {},
            },
        ),
    ),
    Route(
        "/api/v1/diagnostics/mqtt",
        "GET",
        "mqtt",
        "Get the state of the MQTT connection",
        json_answer(
            "The state of the connection to the broker",
            ref("Mqtt"),
            {
                "connected": True,
                "broker": "mqtts://broker.example:8883",
                "topics": ["plant/ingest"],
                "last_error": None,
            },
        ),
        ("not_configured",),
    ),
    Route(
        "/api/v1/sessions",
        "GET",
        "sessions",
        "List the open connections of listeners",
        json_answer(
            "The open connections, with the certificate of TLS peers",
            ref("Sessions"),
            {
                "sessions": [
                    {
                        "listener": "scada",
                        "id": 17,
                        "peer": "10.0.0.7:51200",
                        "opened": 1893456000.0,
                        "idle": 0.4,
                    }
                ]
            },
        ),
        ("not_granted",),
        description="Requires a token with `manage: true`.",
    ),
    Route(
        "/api/v1/sessions/end",
        "POST",
        "end_session",
        "End an open connection",
        json_answer(
            "The connection was ended",
            ref("EndedSession"),
            {"status": "ended", "id": "scada/17"},
        ),
        (*BODY, "not_granted", "unknown_session"),
        description="Requires a token with `manage: true`. The peer can connect again, unless a "
        "rule forbids it.",
        body=Body(ref("EndSession"), {"session": ("One session", {"id": "scada/17"})}),
    ),
    Route(
        DOCUMENT,
        "GET",
        "openapi",
        "Get this document",
        json_answer("The OpenAPI 3.1 document", {"type": "object"}),
        is_open=True,
    ),
    Route(PAGE, "GET", "docs", "Get this document as a web page", html_answer(), is_open=True),
)

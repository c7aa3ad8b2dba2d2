"""The operations of REST, which tokens they need, and its OpenAPI document."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Any

from holdfast.adapters.rest.app import INGEST, App
from holdfast.adapters.rest.changes import (
    DEFAULT_INTERVAL_S,
    MAX_INTERVAL_S,
    MAX_RANGES,
    MIN_INTERVAL_S,
)
from holdfast.adapters.rest.refusals import MEMORY, REFUSALS, VALUES
from holdfast.adapters.rest.schemas import ADDRESS, SCHEMAS
from holdfast.net.http import openapi
from holdfast.net.http.application import DOCUMENTS
from holdfast.net.http.fields import Field, malformed
from holdfast.net.http.openapi import Api, json_answer, stream_answer
from holdfast.net.http.operations import Body, Operation
from holdfast.net.http.requests import shown
from holdfast.net.http.schemas import TEXT, integer, ref
from holdfast.protocol import ADDRESSES

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from holdfast.net.http.refusals import Refusal
    from holdfast.net.http.schemas import Schema

_NUMBERS: dict[str, tuple[Callable[[str], float], str, str]] = {
    "integer": (int, "[0-9]{1,10}", "an integer"),
    "number": (float, "[0-9]{1,10}(\\.[0-9]{1,10})?", "a number"),
}


class Parameter(Field):
    """A query parameter. The memory access checks names, so that all adapters refuse them alike."""

    def read(self, text: str) -> Any:
        """Parses a number; returns a name as it is. Raises `BadRequest`."""
        kind = self.schema.get("type")
        if kind not in _NUMBERS:
            return text
        convert, form, named = _NUMBERS[kind]
        least, most = self.schema["minimum"], self.schema["maximum"]
        if re.fullmatch(form, text) and least <= convert(text) <= most:
            return convert(text)
        allowed = f"allowed: {named} from {least} to {most}"
        raise malformed(f"{self.name} is {shown(text)}, {allowed}")

    @staticmethod
    def missing(missing: Sequence[str], required: Sequence[str]) -> str:
        """Returns the error message for required parameters that are missing."""
        return f"{missing[0]} is missing, required: {', '.join(required)}"


def _range(most: int = 1) -> tuple[Parameter, ...]:
    """The parameters that name a range, or up to `most` of them."""

    def one(name: str, text: str, schema: Schema, example: object) -> Parameter:
        examples = example if most == 1 else [example]
        return Parameter(name, schema, text, example=examples, most=most)

    return (
        Parameter("memory", TEXT, "The name of the memory", example="plant_a"),
        one("area", "The area", ref("Area"), "holding_registers"),
        one("address", "The first address", ADDRESS, 0),
        one("count", "The number of bits or registers", integer(1, ADDRESSES), 3),
    )


def _command(area: str, address: int, values: list[int]) -> dict[str, object]:
    return {"memory": "plant_a", "area": area, "address": address, "values": values}


_MEMORIES = {
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
}
_MQTT = {
    "connected": True,
    "broker": "mqtts://broker.example:8883",
    "topics": ["plant/ingest"],
    "last_error": None,
}
_SESSION = {
    "listener": "scada",
    "id": 17,
    "peer": "10.0.0.7:51200",
    "opened": 1893456000.0,
    "idle": 0.4,
}
_STATS = json.loads(
    """
    {"uptime": 3600.25,
     "listeners": {"scada": {"requests": {"3": 7200}, "exceptions": {"2": 1}, "unanswered": 0,
        "connections": {"accepted": 2, "open": 1}}},
     "devices": {"meter": {"health": "ok", "age": 0.4, "requests": 7200, "valid": 7199,
        "timeouts": 1}},
     "links": {"bus_1": {"requests": 5000, "replies": 4100, "exceptions": 3, "timeouts": 2,
        "failures": 0, "refused_full": 0, "refused_down": 1, "coalesced": 896, "cached": 0,
        "withdrawn": 0, "waiting": 1, "unexpected_replies": 0, "stray_bytes": 0,
        "late_replies": 1, "raised_timeouts": 0, "floods": 0, "error": null}},
     "adapters": {"rest": {"state": "running", "restarts": 0, "last_error": null, "accepted": 120,
        "values": 360, "reads": 4, "refused": {"invalid_value": 1}}},
     "events_lost": 0, "log_dropped": 0, "tag_polls_dropped": 0,
     "reload": {"failed": false, "succeeded_at": 1893456000.0},
     "memory_files": {"/var/lib/holdfast/setpoints.redb": {"failing": null,
        "stored_at": 1893456000.0, "commits": 12, "pending": 0, "refused": 0, "busy": 0,
        "last_commit_seconds": 0.004, "bytes": 73728, "recreated": 0}},
     "logs": {"site": {"phase": "running", "connected": true, "contact_age": 0.2, "sequence": 5000,
        "lag": 0, "steps": 1200, "unavailable": 0, "not_confirmed": 0, "refused": 0, "ignored": 0,
        "nodes": [{"name": "scada-a", "sequence": 5000, "time_ns": 1893456000000000000,
            "digest": null}]}},
     "audit": null,
     "threads": {"holdfast-io-0": {"heartbeat_age": 0.4, "cpu": 12.5}},
     "certificates": {"/etc/holdfast/server.pem": 1893456000.0}, "revocation_lists": {}}
    """
)

OPERATIONS: tuple[Operation[App], ...] = (
    Operation(
        "POST",
        INGEST,
        "ingest",
        "Write one command, or a batch of commands atomically",
        App.ingest,
        json_answer(
            "All values were written",
            {"oneOf": [ref("Accepted"), ref("BatchAccepted")]},
            {"status": "accepted", "memory": "plant_a", "written": 3},
        ),
        (*MEMORY, *VALUES),
        "In a refusal, `command` is the index of the command in the batch and `index` the index of "
        "the value in the command, both from 0. Where ranges of a batch overlap, the later command "
        "wins.",
        body=Body(
            {"oneOf": [ref("Command"), ref("Batch")]},
            {
                "Three registers": _command("holding_registers", 0, [100, 200, 300]),
                "Two bits": _command("coils", 8, [True, 0]),
                "Two commands, written atomically": [
                    _command("input_registers", 0, [7]),
                    _command("discrete_inputs", 3, [1]),
                ],
            },
        ),
        check=App.check_writer,
    ),
    Operation(
        "GET",
        "/api/v1/memory/read",
        "read",
        "Read a range atomically",
        App.read,
        json_answer("The values; bits are 0 or 1", ref("Values"), {"values": [100, 200, 300]}),
        (*MEMORY, "log_unavailable", "stale"),
        parameters=_range(),
    ),
    Operation(
        "GET",
        "/api/v1/memory/changes",
        "changes",
        "Follow ranges: a stream of their values and changes",
        App.changes,
        stream_answer(values="Change", unavailable="Unavailable"),
        (*MEMORY, "busy"),
        "Server-sent events. The first event of each range has its current values; later events "
        "have the shortest part of a range that contains all changes. The `id` of an event is the "
        "number of writes to the memory; events with the same `id` are of the same moment. A "
        "client that reads slowly receives the newest values. `area`, `address` and `count` can be "
        f"repeated together, for up to {MAX_RANGES} ranges. After a reconnect, with or without "
        "`Last-Event-ID`, the stream begins with the current values. `unavailable` means that a "
        "replicated memory can't be read at present, or that a range mirrors a device that does "
        "not answer; once all ranges can be read, they follow as a whole.",
        (
            *_range(MAX_RANGES),
            Parameter(
                "min_interval",
                {"type": "number", "minimum": MIN_INTERVAL_S, "maximum": MAX_INTERVAL_S},
                "The shortest time in seconds between two events of a range",
                DEFAULT_INTERVAL_S,
                example=0.5,
            ),
        ),
    ),
    Operation(
        "GET",
        "/api/v1/health",
        "health",
        "Check that the server is running",
        App.health,
        json_answer("The server is running", ref("Health"), {"status": "ok"}),
        is_public=True,
    ),
    Operation(
        "GET",
        "/api/v1/diagnostics/memory",
        "memories",
        "List the memories that the token grants",
        App.memories,
        json_answer("The areas and the seal of each memory", ref("Memories"), _MEMORIES),
    ),
    Operation(
        "GET",
        "/api/v1/diagnostics/stats",
        "stats",
        "Get all counters since the start",
        App.stats,
        json_answer(
            "Counters of listeners, devices, adapters, logs and files of memories; threads",
            ref("Stats"),
            _STATS,
        ),
    ),
    Operation(
        "GET",
        "/api/v1/diagnostics/mqtt",
        "mqtt",
        "Get the state of the MQTT connection",
        App.mqtt,
        json_answer("The state of the connection to the broker", ref("Mqtt"), _MQTT),
        ("not_configured",),
    ),
    Operation(
        "GET",
        "/api/v1/sessions",
        "sessions",
        "List the open connections of listeners",
        App.sessions,
        json_answer(
            "The open connections, with the certificate of TLS peers",
            ref("Sessions"),
            {"sessions": [_SESSION]},
        ),
        ("not_granted",),
        "Requires a token with `manage: true`.",
        check=App.check_manager,
    ),
    Operation(
        "POST",
        "/api/v1/sessions/end",
        "end_session",
        "End an open connection",
        App.end_session,
        json_answer(
            "The connection was ended",
            ref("EndedSession"),
            {"status": "ended", "id": "scada/17"},
        ),
        ("not_granted", "unknown_session"),
        "Requires a token with `manage: true`. The peer can connect again, unless a rule forbids "
        "it.",
        body=Body(ref("EndSession"), {"One session": {"id": "scada/17"}}),
        check=App.check_manager,
    ),
    *DOCUMENTS,
)


def document(version: str, max_body: int, *, secured: bool) -> dict[str, Any]:
    """Returns the document of a server with this limit in bytes. `secured`: tokens are required."""
    api = Api(
        "Holdfast REST",
        "Reads and writes Modbus memories.",
        "A write is atomic, even a batch that writes to several memories: either all of it is "
        "carried out or nothing, and no reader sees only a part of it. Values are never converted, "
        "truncated or wrapped. An integer has no fraction and no exponent: `1.0` and `1e2` are "
        f"refused. A body has at most {max_body} bytes.",
        SCHEMAS,
        REFUSALS,
        _refused,
    )
    return openapi.document(api, version, OPERATIONS, secured=secured)


def _refused(row: Refusal) -> dict[str, Any]:
    where = {"index": 2} if row.status == 400 else {}
    example = {"status": "rejected", "reason": row.reasons[0], **where, "detail": row.example}
    return json_answer(row.means, ref("Refusal"), example)

"""The JSON schemas of commands, answers and diagnostics of REST."""

from __future__ import annotations

from holdfast.adapters.diagnostics import HEALTH
from holdfast.adapters.rest.refusals import REFUSALS
from holdfast.net.http.schemas import (
    BOOLEAN,
    COUNT,
    NUMBER,
    NUMBER_OR_NULL,
    TEXT,
    TEXT_OR_NULL,
    Schema,
    array_of,
    count,
    integer,
    map_of,
    object_of,
    ref,
)
from holdfast.protocol import LAST_ADDRESS, MAX_WORD
from holdfast.types import AREAS, BIT_AREAS, REGISTER_AREAS

AT_LEAST_ONE: Schema = {"type": "integer", "minimum": 1}
REGISTER = integer(0, MAX_WORD)
ADDRESS = integer(0, LAST_ADDRESS)

SESSION_ID: Schema = {
    "type": "string",
    "description": "The listener and the id of a session, as in `scada/17`",
}


def _values(items: Schema) -> Schema:
    return {"type": "array", "minItems": 1, "items": items}


def _command(areas: tuple[str, ...], key: str, item: Schema) -> Schema:
    return object_of(
        {"memory": TEXT, "area": {"enum": list(areas)}, "address": ADDRESS, key: _values(item)}
    )


_COMMANDS: dict[str, Schema] = {
    "Area": {"type": "string", "enum": list(AREAS)},
    "Command": {"oneOf": [ref("RegisterCommand"), ref("BitCommand"), ref("BoolsCommand")]},
    "Batch": _values(ref("Command")),
    "RegisterCommand": _command(REGISTER_AREAS, "values", REGISTER),
    "BitCommand": _command(BIT_AREAS, "values", ref("Bit")),
    "BoolsCommand": _command(BIT_AREAS, "bools", ref("Bit")),
    "Bit": {"enum": [0, 1, False, True]},
    "EndSession": object_of({"id": SESSION_ID}),
}

_ANSWERS: dict[str, Schema] = {
    "Accepted": object_of(
        {"status": {"const": "accepted"}, "memory": TEXT, "written": AT_LEAST_ONE}
    ),
    "BatchAccepted": object_of(
        {"status": {"const": "accepted"}, "commands": AT_LEAST_ONE, "written": AT_LEAST_ONE}
    ),
    "Values": object_of({"values": _values(REGISTER)}),
    "Change": object_of(
        {"memory": TEXT, "area": ref("Area"), "address": ADDRESS, "values": _values(REGISTER)}
    ),
    "Unavailable": object_of(
        {
            "memory": TEXT,
            "reason": {"enum": ["log_unavailable", "stale"]},
            "detail": TEXT | {"description": "A message for people"},
        }
    ),
    "EndedSession": object_of({"status": {"const": "ended"}, "id": SESSION_ID}),
    "Health": object_of({"status": {"const": "ok"}}),
    "Refusal": object_of(
        {
            "status": {"const": "rejected"},
            "reason": {"enum": list(REFUSALS.reasons)},
            "command": count("The index of the command in the batch"),
            "index": count("The index of the value in the command"),
            "detail": TEXT | {"description": "A message for people"},
        },
        optional=("command", "index"),
    ),
}

_LINK = object_of(
    {
        "requests": COUNT,
        "replies": count("With the exceptions of devices"),
        "exceptions": COUNT,
        "timeouts": count("With connections that took too long"),
        "failures": count("No connection, a lost connection, or an invalid reply"),
        "refused_full": COUNT,
        "refused_down": COUNT,
        "coalesced": count("Ended with an identical read, answered or not"),
        "cached": count("Answered by an earlier reply"),
        "withdrawn": count("Not sent: the client or the device had gone, or after a standstill"),
        "waiting": COUNT,
        "unexpected_replies": count("Without a request"),
        "stray_bytes": count("Not part of an expected reply"),
        "late_replies": COUNT,
        "raised_timeouts": count("Requests with more than their timeout"),
        "floods": count("Pauses because of stray bytes"),
        "error": TEXT_OR_NULL,
    }
)
_ADAPTER = object_of(
    {
        "state": {"enum": ["running", "failed", "stopped"]},
        "restarts": COUNT,
        "last_error": TEXT_OR_NULL,
    },
    is_open=True,
)
_MEMORY_FILE = object_of(
    {
        "failing": TEXT_OR_NULL | {"description": "Why the file can't be written at present"},
        "stored_at": NUMBER_OR_NULL | {"description": "Unix time of the last step on the disk"},
        "commits": COUNT,
        "pending": count("Writes that are not on the disk"),
        "refused": count("Writes refused by the disk"),
        "busy": count("Writes refused because too many waited for the disk"),
        "last_commit_seconds": NUMBER,
        "bytes": count("Size of the file"),
        "recreated": count("How often the file was gone, and was written anew"),
    }
)
_LOG = object_of(
    {
        "phase": {"enum": ["starting", "running", "returning", "failed", "stopped"]},
        "connected": BOOLEAN,
        "obstacle": TEXT_OR_NULL | {"description": "Why it is not caught up"},
        "contact_age": NUMBER_OR_NULL
        | {"description": "Seconds since the contents were current for sure"},
        "sequence": count("Of the last message applied"),
        "lag": count("Messages that are not applied yet"),
        "steps": count("Writes of this node"),
        "unavailable": count("Writes that were not sent"),
        "not_confirmed": COUNT,
        "refused": COUNT,
        "ignored": count("Messages that no node has sent"),
        "nodes": {"type": "array"},
    },
    optional=("obstacle", "contact_age", "unavailable", "not_confirmed", "refused", "ignored"),
    is_open=True,
)
_COPIES = object_of(
    {"sent": COUNT, "failed": count("Failed attempts"), "dropped": COUNT, "waiting": COUNT},
    is_open=True,
)
_AUDIT = object_of(
    {
        "lines": count("Lines written"),
        "failed": count("Lines that are missing in the file"),
        "waiting": count("With fail: closed, lines that wait"),
        "failing": BOOLEAN | {"description": "Whether the file could not be written last time"},
        "copies": map_of(_COPIES, "By name of the receiver: syslog, journald"),
    },
    is_open=True,
) | {"type": ["object", "null"]}
_THREAD = object_of(
    {
        "heartbeat_age": NUMBER | {"description": "Seconds since the last heartbeat"},
        "cpu": NUMBER_OR_NULL
        | {"description": "Processor time in seconds, if the system provides it"},
    }
)
_DIAGNOSTICS: dict[str, Schema] = {
    "Sessions": object_of({"sessions": array_of(ref("Session"))}),
    "Session": object_of(
        {
            "listener": TEXT,
            "id": COUNT,
            "peer": TEXT,
            "opened": NUMBER | {"description": "Unix time"},
            "idle": NUMBER | {"description": "Seconds since the last request"},
            "role": TEXT | {"description": "The role in the certificate of a TLS peer"},
            "subject": TEXT | {"description": "The subject of that certificate"},
            "serial": TEXT | {"description": "The serial number of that certificate"},
        },
        optional=("role", "subject", "serial"),
    ),
    "Memories": object_of({"memories": map_of(ref("Memory"))}),
    "Memory": object_of(
        {
            "areas": map_of(object_of({"start": COUNT, "size": AT_LEAST_ONE}))
            | {"propertyNames": ref("Area")},
            "sealed": BOOLEAN | {"description": "Whether the memory refuses Modbus clients"},
            "opened": count("How many times the seal opened"),
            "closed": count("How many times it closed again"),
        }
    ),
    "Stats": object_of(
        {
            "uptime": NUMBER | {"description": "Seconds"},
            "listeners": map_of(
                {"type": "object"},
                "By name of the listener: requests by function code, exceptions by code, "
                "connections, frames",
            ),
            "devices": map_of(
                object_of({"health": {"enum": list(HEALTH)}}, is_open=True),
                "By name of the device: health, seconds since the last valid response, requests "
                "by outcome, polls, reads, packets forwarded",
            ),
            "links": map_of(
                _LINK,
                "By name of the link, or of the first device behind it: requests of listeners by "
                "outcome, and how many wait for a reply",
            ),
            "adapters": map_of(
                _ADAPTER,
                "By name of the adapter: messages accepted, values written, reads, refusals by "
                "reason, and its own status",
            ),
            "events_lost": COUNT,
            "log_dropped": COUNT,
            "tag_polls_dropped": COUNT,
            "reload": object_of(
                {
                    "failed": BOOLEAN | {"description": "Whether the last reload was refused"},
                    "succeeded_at": NUMBER
                    | {"description": "Unix time of the last one that was not, or of the start"},
                }
            ),
            "memory_files": map_of(_MEMORY_FILE, "By path: the files that keep memories"),
            "logs": map_of(_LOG, "By name: the logs that memories are replicated through"),
            "audit": _AUDIT,
            "threads": map_of(_THREAD, "By name of the thread"),
            "certificates": map_of(
                NUMBER, "For each configured file, when its first certificate expires, in Unix time"
            ),
            "revocation_lists": map_of(
                NUMBER, "For each configured file, the first nextUpdate, in Unix time"
            ),
        }
    ),
    "Mqtt": object_of(
        {
            "connected": BOOLEAN,
            "broker": TEXT_OR_NULL,
            "topics": {"type": "array"},
            "last_error": TEXT_OR_NULL,
        },
        is_open=True,
    ),
}

SCHEMAS = _COMMANDS | _ANSWERS | _DIAGNOSTICS

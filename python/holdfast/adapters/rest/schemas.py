"""The JSON schemas of commands, answers and diagnostics of REST."""

from __future__ import annotations

from holdfast.adapters.rest.refusals import REFUSALS
from holdfast.protocol import LAST_ADDRESS, MAX_WORD
from holdfast.types import AREAS, BIT_AREAS, REGISTER_AREAS
from holdfast.web.openapi import Schema, array_of, integer, object_of, ref

COUNTER: Schema = {"type": "integer", "minimum": 0}
AT_LEAST_ONE: Schema = {"type": "integer", "minimum": 1}
TEXT: Schema = {"type": "string"}
TEXT_OR_NULL: Schema = {"type": ["string", "null"]}
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


COMMANDS: dict[str, Schema] = {
    "Area": {"type": "string", "enum": list(AREAS)},
    "Command": {"oneOf": [ref("RegisterCommand"), ref("BitCommand"), ref("BoolsCommand")]},
    "Batch": _values(ref("Command")),
    "RegisterCommand": _command(REGISTER_AREAS, "values", REGISTER),
    "BitCommand": _command(BIT_AREAS, "values", ref("Bit")),
    "BoolsCommand": _command(BIT_AREAS, "bools", ref("Bit")),
    "Bit": {"enum": [0, 1, False, True]},
    "EndSession": object_of({"id": SESSION_ID}),
}

ANSWERS: dict[str, Schema] = {
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
    "Refusal": {
        "type": "object",
        "required": ["status", "reason", "detail"],
        "properties": {
            "status": {"const": "rejected"},
            "reason": {"enum": list(REFUSALS.reasons)},
            "command": COUNTER | {"description": "The index of the command in the batch"},
            "index": COUNTER | {"description": "The index of the value in the command"},
            "detail": TEXT | {"description": "A message for people"},
        },
        "additionalProperties": False,
    },
}

DIAGNOSTICS: dict[str, Schema] = {
    "Sessions": object_of({"sessions": array_of(ref("Session"))}),
    "Session": object_of(
        {
            "listener": TEXT,
            "id": COUNTER,
            "peer": TEXT,
            "opened": {"type": "number", "description": "Unix time"},
            "idle": {"type": "number", "description": "Seconds since the last request"},
            "role": TEXT | {"description": "The role in the certificate of a TLS peer"},
            "subject": TEXT | {"description": "The subject of that certificate"},
            "serial": TEXT | {"description": "The serial number of that certificate"},
        },
        optional=("role", "subject", "serial"),
    ),
    "Memories": object_of({"memories": {"type": "object", "additionalProperties": ref("Memory")}}),
    "Memory": object_of(
        {
            "areas": {
                "type": "object",
                "propertyNames": ref("Area"),
                "additionalProperties": object_of({"start": COUNTER, "size": AT_LEAST_ONE}),
            },
            "sealed": {
                "type": "boolean",
                "description": "Whether the memory refuses Modbus clients",
            },
            "opened": COUNTER | {"description": "How many times the seal opened"},
            "closed": COUNTER | {"description": "How many times it closed again"},
        }
    ),
    "Stats": object_of(
        {
            "uptime": {"type": "number", "description": "Seconds"},
            "listeners": {
                "type": "object",
                "description": "By name of the listener: requests by function code, "
                "exceptions by code, connections, frames",
                "additionalProperties": {"type": "object"},
            },
            "devices": {
                "type": "object",
                "description": "By name of the device: health, seconds since the last "
                "valid response, requests by outcome, polls, reads, packets forwarded",
                "additionalProperties": {
                    "type": "object",
                    "required": ["health"],
                    "properties": {
                        "health": {
                            "enum": ["unknown", "ok", "error", "stale", "disabled", "standby"]
                        },
                    },
                },
            },
            "links": {
                "type": "object",
                "description": "By name of the link, or of the first device behind it: requests of "
                "listeners by outcome, and how many wait for a reply",
                "additionalProperties": object_of(
                    {
                        "requests": COUNTER,
                        "replies": COUNTER | {"description": "With the exceptions of devices"},
                        "exceptions": COUNTER,
                        "timeouts": COUNTER,
                        "failures": COUNTER | {"description": "Invalid replies, lost connections"},
                        "refused_full": COUNTER,
                        "refused_down": COUNTER,
                        "coalesced": COUNTER | {"description": "Answered by an equal read"},
                        "cached": COUNTER | {"description": "Answered by an earlier reply"},
                        "withdrawn": COUNTER | {"description": "Not sent: the client had gone"},
                        "waiting": COUNTER,
                        "unexpected_replies": COUNTER | {"description": "Without a request"},
                        "stray_bytes": COUNTER | {"description": "Not part of an expected reply"},
                        "late_replies": COUNTER,
                        "raised_timeouts": COUNTER
                        | {"description": "Requests with more than their timeout"},
                        "floods": COUNTER | {"description": "Pauses because of stray bytes"},
                    }
                ),
            },
            "adapters": {
                "type": "object",
                "description": "By name of the adapter: messages accepted, values written, "
                "reads, refusals by reason, and its own status",
                "additionalProperties": {
                    "type": "object",
                    "required": ["state", "restarts", "last_error"],
                    "properties": {
                        "state": {"enum": ["running", "failed", "stopped"]},
                        "restarts": COUNTER,
                        "last_error": TEXT_OR_NULL,
                    },
                },
            },
            "events_lost": COUNTER,
            "log_dropped": COUNTER,
            "memory_files": {
                "type": "object",
                "description": "By path: the files that keep memories",
                "additionalProperties": {
                    "type": "object",
                    "required": [
                        "failing",
                        "stored_at",
                        "commits",
                        "pending",
                        "refused",
                        "last_commit_seconds",
                        "bytes",
                    ],
                    "properties": {
                        "failing": TEXT_OR_NULL
                        | {"description": "Why the file can't be written at present"},
                        "stored_at": {
                            "type": ["number", "null"],
                            "description": "Unix time of the last step on the disk",
                        },
                        "commits": COUNTER,
                        "pending": COUNTER | {"description": "Writes that are not on the disk"},
                        "refused": COUNTER | {"description": "Writes refused by the disk"},
                        "last_commit_seconds": {"type": "number"},
                        "bytes": COUNTER | {"description": "Size of the file"},
                    },
                    "additionalProperties": False,
                },
            },
            "logs": {
                "type": "object",
                "description": "By name: the logs that memories are replicated through",
                "additionalProperties": {
                    "type": "object",
                    "required": ["phase", "connected", "sequence", "lag", "steps", "nodes"],
                    "properties": {
                        "phase": {
                            "enum": ["starting", "running", "returning", "failed", "stopped"]
                        },
                        "connected": {"type": "boolean"},
                        "contact_age": {
                            "type": ["number", "null"],
                            "description": "Seconds since the contents were current for sure",
                        },
                        "sequence": COUNTER | {"description": "Of the last message applied"},
                        "lag": COUNTER | {"description": "Messages that are not applied yet"},
                        "steps": COUNTER | {"description": "Writes of this node"},
                        "unavailable": COUNTER | {"description": "Writes that were not sent"},
                        "not_confirmed": COUNTER,
                        "refused": COUNTER,
                        "ignored": COUNTER | {"description": "Messages that no node has sent"},
                    },
                },
            },
            "audit": {
                "type": ["object", "null"],
                "required": ["lines", "failed", "waiting", "failing", "copies"],
                "properties": {
                    "lines": COUNTER | {"description": "Lines written"},
                    "failed": COUNTER | {"description": "Lines that are missing in the file"},
                    "waiting": COUNTER | {"description": "With fail: closed, lines that wait"},
                    "failing": {
                        "type": "boolean",
                        "description": "Whether the file could not be written last time",
                    },
                    "copies": {
                        "type": "object",
                        "description": "By name of the receiver: syslog, journald",
                        "additionalProperties": {
                            "type": "object",
                            "required": ["sent", "failed", "dropped", "waiting"],
                            "properties": {
                                "sent": COUNTER,
                                "failed": COUNTER | {"description": "Failed attempts"},
                                "dropped": COUNTER,
                                "waiting": COUNTER,
                            },
                        },
                    },
                },
            },
            "threads": {
                "type": "object",
                "description": "By name of the thread",
                "additionalProperties": object_of(
                    {
                        "heartbeat_age": {
                            "type": "number",
                            "description": "Seconds since the last heartbeat",
                        },
                        "cpu": {
                            "type": ["number", "null"],
                            "description": "Processor time in seconds, if the system provides it",
                        },
                    }
                ),
            },
            "certificates": {
                "type": "object",
                "description": "For each configured file, when its first certificate expires, in "
                "Unix time",
                "additionalProperties": {"type": "number"},
            },
            "revocation_lists": {
                "type": "object",
                "description": "For each configured file, the first nextUpdate, in Unix time",
                "additionalProperties": {"type": "number"},
            },
        }
    ),
    "Mqtt": {
        "type": "object",
        "required": ["connected", "broker", "topics", "last_error"],
        "properties": {
            "connected": {"type": "boolean"},
            "broker": TEXT_OR_NULL,
            "topics": {"type": "array"},
            "last_error": TEXT_OR_NULL,
        },
    },
}

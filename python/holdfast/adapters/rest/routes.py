"""The routes: what each takes, what it answers, and why it may refuse.

The application serves these and nothing else, and the OpenAPI document is made of them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, Literal

from holdfast.adapters.rest.refusals import BODY, MEMORY, QUERY, VALUES
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
)
from holdfast.web.requests import BadRequest, shown


@dataclass(frozen=True)
class Parameter:
    """A parameter of a query, which is needed."""

    name: str
    text: str
    schema: Schema
    example: object

    def read(self, given: str) -> Any:
        """Its value: a number where the schema says so. Raises `BadRequest`."""
        if self.schema.get("type") != "integer":
            return given
        least, most = self.schema["minimum"], self.schema["maximum"]
        if re.fullmatch("[0-9]{1,10}", given) and least <= int(given) <= most:
            return int(given)
        allowed = f"allowed is a number from {least} to {most}"
        raise BadRequest("malformed", f"{self.name} is {shown(given)}, {allowed}")


@dataclass(frozen=True)
class Body:
    """JSON that is needed, with examples by a word, each with a title."""

    schema: Schema
    examples: dict[str, tuple[str, Any]]


@dataclass(frozen=True)
class Route:
    """One path, with its one method; GET stands for HEAD too."""

    path: str
    method: Literal["GET", "POST"]
    name: str
    """What the document and the application know it by."""
    summary: str
    answer: dict[str, Any]
    """The answer of status 200, as the document has it."""
    refusals: tuple[str, ...] = ()
    """Its own reasons to refuse, beside those of every route and of tokens."""
    is_open: bool = False
    """Whether everybody may ask, also where there are tokens."""
    description: str | None = None
    parameters: tuple[Parameter, ...] = ()
    body: Body | None = None


def _command(area: str, address: int, values: list[int]) -> dict[str, object]:
    return {"memory": "plant_a", "area": area, "address": address, "values": values}


INGEST = Route(
    "/api/v1/ingest",
    "POST",
    "ingest",
    "Write one command, or several as one step",
    json_answer(
        "Written",
        {"oneOf": [ref("Accepted"), ref("BatchAccepted")]},
        {"status": "accepted", "memory": "plant_a", "written": 3},
    ),
    (*BODY, *MEMORY, *VALUES),
    description="In a refusal, `command` is the place of the command in the batch and `index` the "
    "place of the value in the command, both from 0. Where ranges of a batch overlap, the later "
    "command wins.",
    body=Body(
        {"oneOf": [ref("Command"), ref("Batch")]},
        {
            "registers": ("Three registers", _command("holding_registers", 0, [100, 200, 300])),
            "bits": ("Two bits", _command("coils", 8, [True, 0])),
            "batch": (
                "Two commands as one step",
                [_command("input_registers", 0, [7]), _command("discrete_inputs", 3, [1])],
            ),
        },
    ),
)

READ = Route(
    "/api/v1/memory/read",
    "GET",
    "read",
    "Read a range, all of one moment",
    json_answer("The values, bits as 0 and 1", ref("Values"), {"values": [100, 200, 300]}),
    (*QUERY, *MEMORY),
    parameters=(
        Parameter("memory", "The memory", TEXT, "plant_a"),
        Parameter("area", "The area", ref("Area"), "holding_registers"),
        Parameter("address", "The first address", ADDRESS, 0),
        Parameter("count", "How many bits or registers", integer(1, ADDRESSES), 3),
    ),
)

ROUTES = (
    INGEST,
    READ,
    Route(
        "/api/v1/health",
        "GET",
        "health",
        "Whether the server answers",
        json_answer("It does", ref("Health"), {"status": "ok"}),
        is_open=True,
    ),
    Route(
        "/api/v1/diagnostics/memory",
        "GET",
        "memories",
        "The memories that the token reaches",
        json_answer(
            "Their areas, and their seals",
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
        "Every counter since the start",
        json_answer(
            "Listeners, devices, adapters, log and audit",
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
                "audit": None,
            },
        ),
    ),
    Route(
        "/api/v1/diagnostics/mqtt",
        "GET",
        "mqtt",
        "The connection to the MQTT broker",
        json_answer(
            "How it is",
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
        DOCUMENT,
        "GET",
        "openapi",
        "This document",
        json_answer("OpenAPI 3.1", {"type": "object"}),
        is_open=True,
    ),
    Route(PAGE, "GET", "docs", "This document as a page", html_answer(), is_open=True),
)

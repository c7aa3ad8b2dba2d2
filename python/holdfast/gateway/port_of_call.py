"""Requests and errors of four endpoints in the form of Port of Call: `compat: port-of-call`.

This changes which bodies are accepted, and how a refusal looks. It never changes what is sent to a
device: a value that Port of Call truncates, or takes for another one, is refused.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import msgspec

from holdfast.events import log_lines
from holdfast.gateway.endpoints.read import AREAS_READ, not_a_read_function
from holdfast.net.addresses import LAST_PORT
from holdfast.net.http.fields import NotJson, decoded, filled, object_with
from holdfast.net.http.host_and_origin import is_from_page
from holdfast.net.http.operations import Body
from holdfast.net.http.requests import BadRequest, shown
from holdfast.protocol import LAST_ADDRESS, MAX_WORD, READ_LIMITS, WRITE_REGISTERS

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from holdfast.gateway.endpoint import Given
    from holdfast.net.http.fields import Field
    from holdfast.net.http.requests import Request

MAX_IGNORED = 4
"""The most ignored keys of a request in the log."""

METHOD_NOT_ALLOWED = "Method not allowed"
EMPTY = "Unexpected end of JSON input"
_BOM = b"\xef\xbb\xbf"


class Rejected(BadRequest):
    """A request that is refused with the status and body of Port of Call."""

    def __init__(self, detail: str, *, status: int = 400, bare: bool = False) -> None:
        """`bare`: the body has no `success`."""
        super().__init__("malformed", detail)
        self.status = status
        said = {"error": detail}
        self.body = msgspec.json.encode(said if bare else {"success": False, **said})


@dataclass(frozen=True)
class _Rule:
    """A rule for the fields of a request, and the error if they break it."""

    is_broken: Callable[[Given], bool]
    error: Callable[[Given], str]
    bare: bool = True


def _is_integer(value: Any, first: int, last: int) -> bool:
    return type(value) is int and first <= value <= last


def _is_number(value: Any, first: int, last: int) -> bool:
    return type(value) in (int, float) and first <= value <= last


def _most(given: Given) -> int:
    """The largest quantity of a read."""
    return READ_LIMITS[AREAS_READ[given["functionCode"]]]


def _missing(*names: str) -> _Rule:
    text = f"Missing required parameters: {' and '.join(names)}"
    return _Rule(lambda given: any(name not in given for name in names), lambda _: text)


_HOST = _Rule(lambda given: not given.get("host"), lambda _: "Missing required parameter: host")
_PORT = _Rule(
    lambda given: not _is_number(given.get("port", 1), 1, LAST_PORT),
    lambda _: f"Port must be between 1 and {LAST_PORT}",
    bare=False,
)
_FUNCTION = _Rule(
    lambda given: not _is_integer(given["functionCode"], min(AREAS_READ), max(AREAS_READ)),
    lambda given: not_a_read_function(given["functionCode"]),
)
_QUANTITY = _Rule(
    lambda given: not _is_number(given.get("quantity", 1), 1, _most(given)),
    lambda given: f"Quantity must be between 1 and {_most(given)}",
)
_ADDRESS = _Rule(
    lambda given: not _is_integer(given["address"], 0, LAST_ADDRESS),
    lambda _: f"Address must be an integer 0-{LAST_ADDRESS}",
    bare=False,
)
_NO_VALUES = _Rule(
    lambda given: (
        "address" not in given or not isinstance(given.get("values"), list) or not given["values"]
    ),
    lambda _: "Missing required parameters: address and values (non-empty array)",
)
_TOO_MANY_VALUES = _Rule(
    lambda given: len(given["values"]) > WRITE_REGISTERS,
    lambda _: f"values array too large: maximum {WRITE_REGISTERS} registers per request",
)
_VALUES = _Rule(
    lambda given: (
        "datatype" not in given
        and any(not _is_integer(value, 0, MAX_WORD) for value in given["values"])
    ),
    lambda _: f"All register values must be integers 0-{MAX_WORD}",
    bare=False,
)

_RULES: dict[str, tuple[_Rule, ...]] = {
    "/api/modbus/connect": (_HOST, _PORT),
    "/api/modbus/read": (_HOST, _missing("functionCode", "address"), _FUNCTION, _QUANTITY, _PORT),
    "/api/modbus/write/coil": (_HOST, _missing("address", "value"), _ADDRESS, _PORT),
    "/api/modbus/write/registers": (
        _HOST,
        _NO_VALUES,
        _TOO_MANY_VALUES,
        _ADDRESS,
        _VALUES,
        _PORT,
    ),
}
"""The rules of each endpoint, in the order in which Port of Call applies them."""

PATHS = frozenset(_RULES)
"""The endpoints of Port of Call."""


def body(path: str, fields: Sequence[Field], examples: Mapping[str, Any]) -> Body:
    """Returns the body of a request for one of `PATHS`. Keys that are ignored are logged."""

    def parse(request: Request, body: bytes) -> dict[str, Any]:
        given, ignored = parsed(path, body, fields)
        if ignored:
            log_lines.refused(
                "keys_ignored",
                kind="gateway",
                listener="gateway",
                peer=request.peer,
                who=request.who,
                path=path,
                found=", ".join(map(shown, ignored[:MAX_IGNORED])),
            )
        return given

    return Body(object_with(fields), examples, parse)


def check_type(request: Request) -> None:
    """Raises `BadRequest` unless the body is JSON by its type, or the request is of a program.

    Pages of other sites can send `text/plain` without permission, so a page can't send it here.
    """
    request.check_uncompressed()
    if is_from_page(request):
        request.check_json(parameters=True)


def parsed(path: str, body: bytes, fields: Sequence[Field]) -> tuple[dict[str, Any], list[str]]:
    """Returns the fields of a request with defaults, and the keys that are ignored.

    Raises `BadRequest`.
    """
    given = _object(body)
    for rule in _RULES[path]:
        if rule.is_broken(given):
            raise Rejected(rule.error(given), bare=rule.bare)
    known = {field.name for field in fields}
    ignored = [name for name in given if name not in known]
    return filled({name: given[name] for name in given if name in known}, fields), ignored


def _object(body: bytes) -> dict[str, Any]:
    """Parses a body. Anything but an object is one without fields."""
    try:
        value = decoded(body.removeprefix(_BOM))
    except NotJson as error:
        raise Rejected(error.detail if body.strip() else EMPTY, status=500) from None
    if value is None:
        raise Rejected("the body is null", status=500)
    return _integral(value) if isinstance(value, dict) else {}


def _integral(given: dict[str, Any]) -> dict[str, Any]:
    """Returns the fields with `3` for `3.0`, as in JavaScript, except for values of a type."""
    made = {name: _integer(value) for name, value in given.items()}
    if isinstance(made.get("values"), list) and "datatype" not in made:
        made["values"] = [_integer(value) for value in made["values"]]
    return made


def _integer(value: Any) -> Any:
    return int(value) if isinstance(value, float) and value.is_integer() else value


def describe(document: dict[str, Any]) -> None:
    """Changes the OpenAPI document of a gateway to what these endpoints accept and return."""
    for path in PATHS:
        [operation] = document["paths"][path].values()
        content = operation["requestBody"]["content"]
        content["application/json"]["schema"]["additionalProperties"] = True
        content["*/*"] = {"schema": content["application/json"]["schema"]}
    components = document["components"]
    components["schemas"]["Error"]["required"] = ["error"]
    reason = components["responses"]["Refused500"]["headers"]["Holdfast-Reason"]
    reason["schema"]["enum"].append("malformed")

"""The operations of the gateway, and its OpenAPI document."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

from holdfast.gateway import assets, port_of_call, write_outcome
from holdfast.gateway.app import App
from holdfast.gateway.endpoint import EXAMPLE, TARGET_FIELDS, never
from holdfast.gateway.endpoints import (
    address_map,
    diagnostics,
    files,
    identify,
    read,
    tag_lists,
    write,
)
from holdfast.gateway.fields import timeout
from holdfast.gateway.refusals import DEVICE, FAILURE, REFUSALS, WRITE
from holdfast.gateway.repeated_writes import KEY
from holdfast.gateway.schemas import SCHEMAS, TARGET_SCHEMAS
from holdfast.gateway.streams import views, watch
from holdfast.net.http import health, openapi
from holdfast.net.http.application import DOCUMENTS
from holdfast.net.http.openapi import Api, html_answer, json_answer, stream_answer
from holdfast.net.http.operations import Operation, body_of
from holdfast.net.http.schemas import BOOLEAN, COUNT, TEXT, object_of, ref
from holdfast.types import AREAS

if TYPE_CHECKING:
    from holdfast.gateway.endpoint import Endpoint
    from holdfast.gateway.settings import GatewayLimits, Settings
    from holdfast.net.http.refusals import Refusal

ENDPOINTS: tuple[Endpoint, ...] = (
    *read.ENDPOINTS,
    *write.ENDPOINTS,
    *files.ENDPOINTS,
    *diagnostics.ENDPOINTS,
    *identify.ENDPOINTS,
)


def operations(settings: Settings) -> tuple[Operation[App], ...]:
    """Returns all operations of a gateway with these settings."""
    return (
        *(_of_device(each, settings) for each in ENDPOINTS),
        *_streams(settings.limits),
        _STATUS,
        *tag_lists.OPERATIONS,
        *DOCUMENTS,
        *(_asset(path) for path in assets.FILES),
        *(Operation("GET", path, "health", "", App.probe, is_public=True) for path in health.PATHS),
    )


def _of_device(endpoint: Endpoint, settings: Settings) -> Operation[App]:
    longest = round(1000 * settings.limits.timeout)
    fields = (*TARGET_FIELDS, *endpoint.fields, timeout(min(endpoint.timeout_ms, longest), longest))
    answer = {"success": {"const": True}, **TARGET_SCHEMAS, **endpoint.properties}
    example = {"success": True, **EXAMPLE, **endpoint.answer}
    if endpoint.has_rtt:
        answer["rtt"], example["rtt"] = COUNT, 12
    if endpoint.broadcast:
        answer["note"] = TEXT | {"description": "Only for a broadcast"}
    whole = object_of(answer, optional=(*endpoint.optional, "note"))
    lenient = settings.compat == "port-of-call" and endpoint.path in port_of_call.PATHS
    body = partial(port_of_call.body, endpoint.path) if lenient else body_of
    return Operation(
        "POST",
        endpoint.path,
        endpoint.name,
        endpoint.summary,
        lambda app, request, given: app.handle_device_request(request, endpoint, given),
        json_answer("The device responded", {"oneOf": [whole, ref("ModbusException")]}, example),
        DEVICE if endpoint.writes is never else (*DEVICE, *WRITE),
        endpoint.description,
        headers=() if endpoint.writes is never else (KEY,),
        body=body(fields, endpoint.examples),
        failures=(FAILURE,),
    )


def _streams(limits: GatewayLimits) -> tuple[Operation[App], ...]:
    return (
        Operation(
            "POST",
            address_map.PATH,
            "map",
            "Find the valid addresses of a device",
            App.map,
            stream_answer(progress="Progress", result="Map"),
            DEVICE,
            "Reads samples, and follows each range to both ends; with `exact` it reads every "
            "address. Nothing is written. Events: `progress` repeatedly, then `result`.",
            body=body_of(
                address_map.fields(limits),
                {"Registers below 1000": {**EXAMPLE, "areas": list(AREAS[2:]), "last": 999}},
            ),
            failures=(FAILURE,),
        ),
        Operation(
            "POST",
            views.PATH,
            "view",
            "Poll several ranges and tag lists in one stream",
            App.view,
            stream_answer(view="View", change="ViewChange"),
            DEVICE,
            "Events: `view` with all values, then `change` for each poll with the changed values, "
            "as pairs of index and value. A part that can't be read has an `error` until it can. "
            "Comments are heartbeats.",
            body=body_of(views.fields(limits), {"A range and tags": {**EXAMPLE, "parts": _PARTS}}),
            failures=(FAILURE,),
        ),
        Operation(
            "GET",
            watch.PATH,
            "watch",
            "Poll a range and stream changes",
            App.watch,
            stream_answer(values="Values", change="Change", problem="Problem"),
            DEVICE,
            "Events: `values` with all values, `change` with the changed values, `problem` for a "
            "Modbus exception or no response. Comments are heartbeats.",
            watch.fields(limits),
            has_head=False,
            failures=(FAILURE,),
        ),
    )


_PARTS: list[dict[str, Any]] = [
    {"functionCode": 3, "address": 0, "quantity": 10, "datatype": "float32"},
    {"tags": "tags:\n  level: {area: input_registers, address: 8, type: int16, unit: mm}\n"},
]

_STATUS: Operation[App] = Operation(
    "GET",
    "/api/gateway",
    "status",
    "Get the settings of this gateway",
    App.status,
    json_answer(
        "The version, settings and limits",
        ref("Status"),
        {
            "version": "0.1.0",
            "writes": False,
            "tokens": False,
            "allow": ["10.0.0.0/8:502"],
            "limits": {"timeout": 60000, "interval": 100},
            "connections": 2,
            "keyPrefix": "5f0c9a3e/",
        },
    ),
)


def _asset(path: str) -> Operation[App]:
    answer = html_answer() if path == "/" else None
    summary = "Open the console in a browser"
    return Operation("GET", path, "console", summary, App.asset, answer, is_public=True)


def document(version: str, settings: Settings) -> dict[str, Any]:
    """Returns the document of a gateway with these settings."""
    api = Api(
        "Holdfast gateway",
        "Access to Modbus devices over HTTP.",
        "Every response of a device has status 200; a Modbus exception has `success` false. A "
        "failed connection or a timeout has status 500. The header `Holdfast-Reason` has the "
        "reason of an error as a word, and `Holdfast-Exception` the code of a Modbus exception. "
        f"`{write_outcome.HEADER}` says of a write that failed whether the device may have carried "
        "it out. Addresses count from 0. `timeout` covers connecting, "
        f"sending and receiving. A body has at most {settings.limits.body} bytes.",
        SCHEMAS,
        REFUSALS,
        _openapi_refusal,
    )
    made = openapi.document(api, version, operations(settings), secured=bool(settings.tokens))
    if settings.compat == "port-of-call":
        port_of_call.describe(made)
    return made


def _openapi_refusal(row: Refusal) -> dict[str, Any]:
    """The response to a refused or failed request."""
    said = json_answer(row.means, ref("Error"), {"success": False, "error": row.example})
    reason = {"schema": {"enum": list(row.reasons)}, "description": "The reason as a word"}
    written = {"schema": BOOLEAN, "description": "Of a write that a device was to carry out"}
    return {**said, "headers": {"Holdfast-Reason": reason, write_outcome.HEADER: written}}

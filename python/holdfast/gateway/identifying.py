"""The endpoints for diagnostics, server id and device identification."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.client.requests import OBJECT_NAMES
from holdfast.gateway.endpoint import EXAMPLE, MILLISECONDS, REGISTERS, TARGET, Endpoint
from holdfast.gateway.fields import REGISTER
from holdfast.protocol import HARMLESS_DIAGNOSTICS, MAX_PDU
from holdfast.web.fields import Field
from holdfast.web.schemas import array, integer

if TYPE_CHECKING:
    from holdfast.gateway.device import RequestedDevice
    from holdfast.gateway.endpoint import Answer, Given

MAX_WORDS = (MAX_PDU - 3) // 2
"""The most data words in a request, after function code and sub-function."""

_NAMES = {
    name: "".join(word if at == 0 else word.title() for at, word in enumerate(name.split("_")))
    for name in OBJECT_NAMES
}
_TEXT_OR_NULL = {"type": ["string", "null"]}
_HEX = {"type": "string", "pattern": "^([0-9a-f]{2})*$"}


async def _diagnostics(given: Given, device: RequestedDevice) -> Answer:
    number, words = given["subFunction"], given["data"]
    found = await device.ask(lambda client: client.diagnostics(number, words, unit=device.unit))
    return {
        "success": True,
        **device.told,
        "subFunction": number,
        "data": found,
        "rtt": device.rtt,
    }


async def _server_id(_: Given, device: RequestedDevice) -> Answer:
    found = await device.ask(lambda client: client.report_server_id(unit=device.unit))
    return {
        "success": True,
        **device.told,
        "serverId": found.server_id,
        "running": found.running,
        "additional": found.additional.hex(),
        "data": found.data.hex(),
        "rtt": device.rtt,
    }


async def _identify(_: Given, device: RequestedDevice) -> Answer:
    found = await device.ask(lambda client: client.identify(unit=device.unit))
    names = {told: getattr(found, name) for name, told in _NAMES.items()}
    objects = {str(number): data.hex() for number, data in sorted(found.objects.items())}
    return {
        "success": True,
        **device.told,
        **names,
        "conformityLevel": found.conformity_level,
        "objects": objects,
        "rtt": device.rtt,
    }


ENDPOINTS = (
    Endpoint(
        "/api/modbus/diagnostics",
        "diagnostics",
        "Run diagnostics of a device on a serial line",
        (
            *TARGET,
            Field(
                "subFunction", REGISTER, "0 echo, 2 diagnostic register, 11 to 18 counters, …", 0
            ),
            Field("data", array(REGISTER, MAX_WORDS), "Data words of the request", [0]),
        ),
        _diagnostics,
        {"subFunction": REGISTER, "data": REGISTERS, "rtt": MILLISECONDS},
        {"The echo": {**EXAMPLE, "subFunction": 0, "data": [0xA537]}},
        {**EXAMPLE, "subFunction": 0, "data": [0xA537], "rtt": 12},
        "Function 8. Sub-functions other than 0, 2 and 11 to 18 change the device, so they require "
        "that writes are enabled. Sub-function 4, Force Listen Only Mode, has no response.",
        writes=lambda given: given["subFunction"] not in HARMLESS_DIAGNOSTICS,
    ),
    Endpoint(
        "/api/modbus/server-id",
        "serverId",
        "Read the server id of a device",
        TARGET,
        _server_id,
        {
            "serverId": {"type": ["integer", "null"]},
            "running": {"type": ["boolean", "null"]},
            "additional": _HEX,
            "data": _HEX,
            "rtt": MILLISECONDS,
        },
        {"A device": EXAMPLE},
        {
            **EXAMPLE,
            "serverId": 17,
            "running": True,
            "additional": "",
            "data": "11ff",
            "rtt": 12,
        },
        "Function 17. The layout depends on the device: `data` is the whole response, in hex.",
    ),
    Endpoint(
        "/api/modbus/identify",
        "identify",
        "Read vendor, product and revision of a device",
        TARGET,
        _identify,
        {
            **dict.fromkeys(_NAMES.values(), _TEXT_OR_NULL),
            "conformityLevel": integer(0, 255),
            "objects": {
                "type": "object",
                "additionalProperties": _HEX,
                "description": "All objects by id, in hex",
            },
            "rtt": MILLISECONDS,
        },
        {"A device": EXAMPLE},
        {
            **EXAMPLE,
            **dict.fromkeys(_NAMES.values()),
            "vendorName": "Acme",
            "productCode": "F7",
            "revision": "2.1",
            "conformityLevel": 1,
            "objects": {"0": "41636d65", "1": "4637", "2": "322e31"},
            "rtt": 12,
        },
        "Function 43/14. It takes several requests if the device splits its objects.",
    ),
)

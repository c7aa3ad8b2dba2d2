"""The endpoints for server id and device identification."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.client.identification import OBJECT_NAMES
from holdfast.gateway.endpoint import EXAMPLE, Endpoint
from holdfast.net.http.schemas import TEXT_OR_NULL, integer, map_of

if TYPE_CHECKING:
    from holdfast.gateway.device import RequestedDevice
    from holdfast.gateway.endpoint import Answer, Given

_NAMES = {
    name: "".join(word if at == 0 else word.title() for at, word in enumerate(name.split("_")))
    for name in OBJECT_NAMES
}
_HEX = {"type": "string", "pattern": "^([0-9a-f]{2})*$"}


async def _server_id(_: Given, device: RequestedDevice) -> Answer:
    found = await device.ask(lambda client: client.report_server_id())
    return {
        "serverId": found.server_id,
        "running": found.running,
        "additional": found.additional.hex(),
        "data": found.data.hex(),
    }


async def _identify(_: Given, device: RequestedDevice) -> Answer:
    found = await device.ask(lambda client: client.identify())
    names = {key: getattr(found, name) for name, key in _NAMES.items()}
    objects = {str(number): data.hex() for number, data in sorted(found.objects.items())}
    return {**names, "conformityLevel": found.conformity_level, "objects": objects}


ENDPOINTS = (
    Endpoint(
        path="/api/modbus/server-id",
        name="serverId",
        summary="Read the server id of a device",
        description=(
            "Function 17. The layout depends on the device: `data` is the whole response, in hex."
        ),
        execute=_server_id,
        properties={
            "serverId": {"type": ["integer", "null"]},
            "running": {"type": ["boolean", "null"]},
            "additional": _HEX,
            "data": _HEX,
        },
        examples={"A device": EXAMPLE},
        answer={"serverId": 17, "running": True, "additional": "", "data": "11ff"},
    ),
    Endpoint(
        path="/api/modbus/identify",
        name="identify",
        summary="Read vendor, product and revision of a device",
        description="Function 43/14. It takes several requests if the device splits its objects.",
        execute=_identify,
        properties={
            **dict.fromkeys(_NAMES.values(), TEXT_OR_NULL),
            "conformityLevel": integer(0, 255),
            "objects": map_of(_HEX, "All objects by id, in hex"),
        },
        examples={"A device": EXAMPLE},
        answer={
            **dict.fromkeys(_NAMES.values()),
            "vendorName": "Acme",
            "productCode": "F7",
            "revision": "2.1",
            "conformityLevel": 1,
            "objects": {"0": "41636d65", "1": "4637", "2": "322e31"},
        },
    ),
)

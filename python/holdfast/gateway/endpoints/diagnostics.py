"""The endpoint for diagnostics."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.gateway.endpoint import EXAMPLE, REGISTERS, Endpoint
from holdfast.gateway.fields import REGISTER
from holdfast.net.http.fields import Field
from holdfast.net.http.schemas import array
from holdfast.protocol import HARMLESS_DIAGNOSTICS, MAX_PDU

if TYPE_CHECKING:
    from holdfast.gateway.device import RequestedDevice
    from holdfast.gateway.endpoint import Answer, Given

MAX_WORDS = (MAX_PDU - 3) // 2
"""The most data words in a request, after function code and sub-function."""


async def _diagnostics(given: Given, device: RequestedDevice) -> Answer:
    number, words = given["subFunction"], given["data"]
    found = await device.ask(lambda client: client.diagnostics(number, words))
    return {"subFunction": number, "data": found}


ENDPOINTS = (
    Endpoint(
        path="/api/modbus/diagnostics",
        name="diagnostics",
        summary="Run diagnostics of a device on a serial line",
        description=(
            "Function 8. Sub-functions other than 0, 2 and 11 to 18 change the device, so they "
            "require that writes are enabled. Sub-function 4, Force Listen Only Mode, has no "
            "response."
        ),
        fields=(
            Field(
                "subFunction", REGISTER, "0 echo, 2 diagnostic register, 11 to 18 counters, …", 0
            ),
            Field("data", array(REGISTER, MAX_WORDS), "Data words of the request", [0]),
        ),
        execute=_diagnostics,
        properties={"subFunction": REGISTER, "data": REGISTERS},
        examples={"The echo": {**EXAMPLE, "subFunction": 0, "data": [0xA537]}},
        answer={"subFunction": 0, "data": [0xA537]},
        writes=lambda given: given["subFunction"] not in HARMLESS_DIAGNOSTICS,
    ),
)

"""The messages of the programs around tentacle-modbus, as their published versions send them.

The keys, their order and the texts are those of JavaScript's `JSON.stringify` and `String`.
"""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import holdfast


def text(message: object) -> str:
    """Returns a message as `JSON.stringify` writes it."""
    return json.dumps(message, separators=(",", ":"), ensure_ascii=False)


def subject_part(device: str) -> str:
    """Returns what tentacle-plc listens to for a device."""
    return re.sub(r"[ .*>]", "_", device)


def plc_tag(
    id: str,
    address: int,
    datatype: str = "uint16",
    *,
    function: str = "holding",
    order: str = "ABCD",
) -> dict[str, Any]:
    """Builds a tag as tentacle-plc sends it: without `writable`."""
    return {
        "id": id,
        "address": address,
        "functionCode": function,
        "datatype": datatype,
        "byteOrder": order,
    }


def plc_subscribe(
    server: holdfast.Server,
    *tags: dict[str, Any],
    device: str = "pump-skid",
    project: str = "my-project",
    order: str = "ABCD",
    rate: int = 1000,
) -> str:
    """Builds the request of tentacle-plc. It never has `writable`, `timeout` or `publish`."""
    host, port = server.address
    return text(
        {
            "deviceId": device,
            "host": host,
            "port": port,
            "unitId": 1,
            "byteOrder": order,
            "scanRate": rate,
            "tags": list(tags),
            "subscriberId": project,
        }
    )


def plc_unsubscribe(*tags: str, device: str = "pump-skid", project: str = "my-project") -> str:
    """Builds the request that tentacle-plc sends when it stops."""
    return text({"deviceId": device, "tagIds": list(tags), "subscriberId": project})


def gateway_tag(id: str, address: int = 0, *, function: int = 3) -> dict[str, Any]:
    """Builds a tag of a variable of tentacle-gateway without a Modbus datatype and byte order.

    It then sends `uint16` and `big`, also for coils.
    """
    functions = {1: "coil", 2: "discrete", 3: "holding", 4: "input"}
    return plc_tag(id, address, "uint16", function=functions[function], order="big")


def scanner_tag(id: str, address: int, **more: Any) -> dict[str, Any]:
    """Builds a tag with all keys of the published type of tentacle-modbus."""
    return {
        "id": id,
        "description": f"tag {id}",
        "address": address,
        "functionCode": "holding",
        "datatype": "int16",
        "byteOrder": "ABCD",
        "writable": True,
        **more,
    }

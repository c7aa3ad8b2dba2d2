"""The messages of the programs of tentacle-next, as their published versions send them.

The keys and their order are those of the JSON of Go's structures. Empty optional keys are left out.
"""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import holdfast

BUCKET = "scanner_config_modbus"
ENABLED = "service_enabled"
CONFIGURATION = "gateway_config"
"""The buckets of subscriptions, of enabled services, and of the configuration of its gateway."""


def text(message: object) -> str:
    """Returns a message as Go's `json.Marshal` writes it."""
    return json.dumps(message, separators=(",", ":"), ensure_ascii=False)


def subject_part(id: str) -> str:
    """Returns what its programs make of a device or tag in a subject."""
    return re.sub(r"[ .:*>;=]", "_", id)


def key(device: str = "plc1", gateway: str = "gateway") -> str:
    """Returns the key that its gateway writes for a device."""
    return f"gateway-{gateway}.{device}"


def gateway_tag(
    id: str, address: int, datatype: str = "uint16", *, function: str = "holding", order: str = ""
) -> dict[str, Any]:
    """Builds a tag as its gateway writes it: never with `writable` or `description`.

    Without a Modbus datatype, it writes `uint16`, also for coils.
    """
    tag = {"id": id, "address": address, "functionCode": function, "datatype": datatype}
    return tag | ({"byteOrder": order} if order else {})


def gateway_entry(
    server: holdfast.Server,
    *tags: dict[str, Any],
    device: str = "plc1",
    gateway: str = "gateway",
    order: str = "",
    rate: int = 1000,
) -> str:
    """Builds the value that its gateway writes for a device."""
    host, port = server.address
    return text(
        {
            "subscriberId": f"gateway-{gateway}",
            "deviceId": device,
            "host": host,
            "port": port,
            "unitId": 1,
            **({"byteOrder": order} if order else {}),
            "scanRate": rate,
            "tags": list(tags),
        }
    )


def library_subscribe(
    server: holdfast.Server, *registers: dict[str, Any], device: str = "plc1", rate: int = 1000
) -> str:
    """Builds the request of a program that uses its PLC library: `registers` instead of `tags`."""
    host, port = server.address
    return text(
        {
            "subscriberId": "plc-skid",
            "deviceId": device,
            "host": host,
            "port": port,
            "unitId": 1,
            "registers": list(registers),
            "scanRate": rate,
        }
    )


def library_register(
    tag: str, address: int, datatype: str = "uint16", *, function: int = 3, order: str = ""
) -> dict[str, Any]:
    """Builds a register of this request."""
    register = {
        "tag": tag,
        "address": address,
        "functionCode": function,
        "modbusDatatype": datatype,
    }
    return register | ({"byteOrder": order} if order else {})


def library_command(tag: str, value: object) -> tuple[str, str]:
    """Returns the subject and the message of a command of its PLC library."""
    # Go sorts the keys of maps.
    return f"modbus.module.command.{subject_part(tag)}", text({"tag": tag, "value": value})


def command(value: object) -> str:
    """Returns a command, as its API sends it, and its gateway passes it on."""
    return text({"value": value})


def enabled(is_enabled: bool) -> str:
    """Returns the value that its API writes to enable or disable the scanner."""
    return text({"moduleId": "modbus", "enabled": is_enabled, "updatedAt": 1795254285863})


def gateway_configuration(
    server: holdfast.Server, *variables: dict[str, Any], device: str = "plc1", rate: int = 100
) -> str:
    """Builds the configuration of its gateway, as its API stores it."""
    host, port = server.address
    return text(
        {
            "gatewayId": "gateway",
            "devices": {
                device: {
                    "protocol": "modbus",
                    "host": host,
                    "port": port,
                    "unitId": 1,
                    "scanRate": rate,
                }
            },
            "variables": {variable["id"]: variable for variable in variables},
            "updatedAt": 1795254285863,
        }
    )


def gateway_variable(
    id: str,
    tag: str,
    address: int,
    datatype: str = "",
    *,
    function: int = 3,
    device: str = "plc1",
    writable: bool = False,
) -> dict[str, Any]:
    """Builds a variable of this configuration."""
    is_boolean = function in (1, 2)
    return {
        "id": id,
        "datatype": "boolean" if is_boolean else "number",
        "default": False if is_boolean else 0,
        "deviceId": device,
        "tag": tag,
        **({"bidirectional": True} if writable else {}),
        "functionCode": function,
        **({"modbusDatatype": datatype} if datatype else {}),
        "address": address,
    }

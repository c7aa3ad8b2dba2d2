"""The Modbus endpoints of Port of Call's worker (TypeScript): `HOLDFAST_ORIGINAL_PORT_OF_CALL`.

The command gets the port at which it serves HTTP on 127.0.0.1 in the environment variable `PORT`.
It runs the worker with its own tool, or the file `src/worker/modbus.ts` with another program that
has `cloudflare:sockets`. It asks nobody whether an address belongs to Cloudflare, so it needs no
network.
"""

from __future__ import annotations

import http.client
import json
import socket
import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import holdfast
from peers.originals.comparison import Command, Difference, Original, Reason, closed_port

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from peers.originals.comparison import Answers, Launch

PAGE = "moving-from-port-of-call.md"
JSON = {"Content-Type": "application/json"}
TEXT = {"Content-Type": "text/plain"}
UNIT = 1
VOLATILE = ("rtt", "port")
"""Keys of an answer that change from run to run."""
WORDED = {f"{at}: no JSON" for at in ("connect", "read", "write/coil", "write/registers")}
WORDED |= {"connect to a closed port"}
"""Inputs whose error is in the words of a platform or of its JavaScript engine."""


def inputs() -> Iterator[tuple[str, str, str, dict[str, str], object]]:
    """Returns name, method, endpoint, headers and body, still without the address of the device."""
    for name, endpoint, body in (*reads(), *writes(), *connects()):
        yield name, "POST", endpoint, JSON, body
    for endpoint in ("connect", "read", "write/coil", "write/registers"):
        yield f"{endpoint}: GET", "GET", endpoint, {}, None
        yield f"{endpoint}: PUT", "PUT", endpoint, JSON, {}
        yield f"{endpoint}: no body", "POST", endpoint, JSON, None
        yield f"{endpoint}: no JSON", "POST", endpoint, JSON, "{nothing"
        yield f"{endpoint}: no host", "POST", endpoint, JSON, {"host": None}
        yield f"{endpoint}: port 0", "POST", endpoint, JSON, {"port": 0, **VALID[endpoint]}
        yield f"{endpoint}: as text", "POST", endpoint, TEXT, VALID[endpoint]
        yield f"{endpoint}: an unknown key", "POST", endpoint, JSON, {"x": 1, **VALID[endpoint]}


VALID: dict[str, dict[str, Any]] = {
    "connect": {},
    "read": {"functionCode": 3, "address": 0},
    "write/coil": {"address": 40, "value": True},
    "write/registers": {"address": 40, "values": [1]},
}


def reads() -> Iterator[tuple[str, str, object]]:
    for function in range(1, 5):
        for quantity in (1, 3, 9):
            body = {"functionCode": function, "address": 2, "quantity": quantity}
            yield f"read {quantity} by function {function}", "read", body
        limit = 2000 if function < 3 else 125
        for quantity in (0, -1, limit, limit + 1):
            body = {"functionCode": function, "address": 0, "quantity": quantity}
            yield f"read {quantity} by function {function}", "read", body
    for function in (0, 5, 16, 23, 255):
        yield f"read by function {function}", "read", {"functionCode": function, "address": 0}
    yield "read, the default quantity", "read", {"functionCode": 4, "address": 3}
    yield "read beyond the area", "read", {"functionCode": 3, "address": 2999, "quantity": 2}
    yield "read without an address", "read", {"functionCode": 3}
    yield "read without a function", "read", {"address": 3}
    yield "read at address -1", "read", {"functionCode": 3, "address": -1}
    yield "read at address 65536", "read", {"functionCode": 3, "address": 65536}
    yield "read at the end of all addresses", "read", _range(65535, 2)
    yield "read from a unit without memory", "read", {**_range(0, 1), "unitId": 9}
    yield "read from unit 257", "read", {**_range(0, 1), "unitId": 257}
    yield "read a quantity as text", "read", {**_range(0, 1), "quantity": "3"}
    yield "read a quantity as 3.0", "read", '{"functionCode":3,"address":0,"quantity":3.0,DEVICE}'
    yield "read a timeout of 2000", "read", {**_range(0, 1), "timeout": 2000}
    yield "read a timeout above 60000", "read", {**_range(0, 1), "timeout": 60001}


def _range(address: int, quantity: int) -> dict[str, Any]:
    return {"functionCode": 3, "address": address, "quantity": quantity}


def writes() -> Iterator[tuple[str, str, object]]:
    body: dict[str, object]
    for value in (True, False, 1, 0, 2, "true", None):
        body = {"address": 7, "value": value}
        yield f"write coil {json.dumps(value)}", "write/coil", body
        back = {"functionCode": 1, "address": 7}
        yield f"write coil {json.dumps(value)}, read back", "read", back
    yield "write coil without a value", "write/coil", {"address": 7}
    yield "write coil without an address", "write/coil", {"value": True}
    yield "write coil at 65536", "write/coil", {"address": 65536, "value": True}
    yield "write coil beyond the area", "write/coil", {"address": 3000, "value": True}
    for values in ([100, 200, 300], [65535], [], [65536], [-1], [1.5], [None], ["1"], [1] * 123):
        body = {"address": 100, "values": values}
        yield f"write registers {_short(values)}", "write/registers", body
        yield f"write registers {_short(values)}, read back", "read", _range(100, 3)
    yield "write 124 registers", "write/registers", {"address": 100, "values": [1] * 124}
    yield "write registers without values", "write/registers", {"address": 100}
    yield "write registers, not a list", "write/registers", {"address": 100, "values": 5}
    yield "write registers at -1", "write/registers", {"address": -1, "values": [1]}
    yield "write registers beyond the area", "write/registers", {"address": 2999, "values": [1, 2]}


def _short(values: list[Any]) -> str:
    return json.dumps(values) if len(values) < 10 else f"{len(values)} values"


def connects() -> Iterator[tuple[str, str, object]]:
    yield "connect", "connect", {}
    yield "connect to a unit without memory", "connect", {"unitId": 9}
    yield "connect to a unit that is a text", "connect", {"unitId": "1"}
    yield "connect to a closed port", "connect", {"port": CLOSED}
    yield "connect to a silent device", "connect", {"port": SILENT, "timeout": 100}


CLOSED, SILENT = "closed", "silent"
"""What stands for a port where nothing listens, and for one where nobody answers."""


def body_of(body: object, ports: Mapping[str, int]) -> bytes | None:
    """Returns a body with the address of the device, where it does not have another one."""
    port = ports["device"]
    if body is None:
        return None
    if isinstance(body, str):
        return body.replace("DEVICE", f'"host":"127.0.0.1","port":{port}').encode()
    assert isinstance(body, dict)
    whole = {"host": "127.0.0.1", "port": port} | body
    whole["port"] = ports.get(str(whole["port"]), whole["port"])
    return json.dumps(
        {key: value for key, value in whole.items() if key != "host" or value}
    ).encode()


def answers(address: tuple[str, int], device: holdfast.Server) -> Answers:
    with socket.create_server(("127.0.0.1", 0)) as silent, closed_port() as closed:
        ports = {"device": device.address[1], SILENT: silent.getsockname()[1], CLOSED: closed}
        return _answers(address, ports)


def _answers(address: tuple[str, int], ports: Mapping[str, int]) -> Answers:
    found: Answers = {}
    for name, method, endpoint, headers, body in inputs():
        connection = http.client.HTTPConnection(*address, timeout=30)
        sent = body_of(body, ports)
        connection.request(method, f"/api/modbus/{endpoint}", sent, headers)
        response = connection.getresponse()
        found[name] = [response.status, _content(response.read(), name in WORDED)]
        connection.close()
    return found


def _content(received: bytes, is_worded: bool) -> list[list[object]]:
    content = json.loads(received) | ({"error": "words"} if is_worded else {})
    return [[key, value] for key, value in content.items() if key not in VOLATILE]


@contextmanager
def device() -> Iterator[holdfast.Server]:
    """A device whose areas hold what tells addresses apart."""
    memory = holdfast.Memory(
        coils=3000, discrete_inputs=3000, holding_registers=3000, input_registers=3000
    )
    memory.write("coils", 0, [at % 3 == 0 for at in range(200)])
    memory.write("discrete_inputs", 0, [at % 5 == 0 for at in range(200)])
    memory.write("holding_registers", 0, [1000 + at for at in range(100)])
    memory.write("input_registers", 0, [65535 - at for at in range(100)])
    with holdfast.Server({UNIT: memory}, bind="127.0.0.1:0", access="read-write") as server:
        yield server


def theirs(command: Command, folder: Path) -> Answers:
    def configure(ports: Sequence[int]) -> Launch:
        return [], {"PORT": str(ports[0])}

    with device() as server, command.serving(folder, 1, configure) as [port]:
        return answers(("127.0.0.1", port), server)


def ours(folder: Path) -> Answers:
    command = Command([sys.executable, "-m", "holdfast", "gateway"])
    with device() as server:

        def configure(ports: Sequence[int]) -> Launch:
            options = ["--allow", "127.0.0.1:*", "--access", "read-write"]
            return [*options, "--bind", f"127.0.0.1:{ports[0]}", "--compat", "port-of-call"], {}

        with command.serving(folder, 1, configure) as [port]:
            return answers(("127.0.0.1", port), server)


NUMBERS = Reason(
    "a request that means another address or unit than it says is refused",
    PAGE,
    "A read at address 65536 reads address 0, `unitId` 257 is unit 1, text such as "
    '`"3"` is a number.',
)
END = Reason(
    "the request is invalid",
    PAGE,
    "A range that ends after address 65535 is sent; the device refuses it.",
)
TIMEOUT = Reason("a request occupies a place until it ends", PAGE, "`timeout` may be any number.")
COIL = Reason(
    "a wrong value must not reach a device",
    PAGE,
    "A coil is switched off by any `value` other than `true` and `1`.",
)
NAMES = Reason(
    "exceptions have their names",
    PAGE,
    "Exceptions other than 1 to 6 are `Unknown exception: 0xb`, for example.",
)
UNREACHED = "Gateway Target Device Failed To Respond"


def _read(address: int = 0, quantity: object = 1, *values: int, unit: int = UNIT) -> list[object]:
    """Returns the answer of a read of holding registers."""
    return [
        200,
        [
            *(["success", True], ["host", "127.0.0.1"], ["unitId", unit], ["functionCode", 3]),
            *(["functionName", "READ_HOLDING_REGISTERS"], ["address", address]),
            *(["quantity", quantity], ["format", "registers"], ["values", list(values)]),
        ],
    ]


def _exception(text: str, address: int = 0, quantity: int = 1) -> list[object]:
    asked = [["functionCode", 3], ["address", address], ["quantity", quantity]]
    return [200, [["success", False], ["error", f"Modbus exception: {text}"], *asked]]


def _off() -> list[object]:
    written = [["address", 7], ["coilValue", 0], ["written", False]]
    return [200, [["success", True], ["host", "127.0.0.1"], ["unitId", UNIT], *written]]


def _connected(unit: object, *more: list[object], message: str = "") -> list[object]:
    reached = f"Modbus server reachable{message}"
    top = [["success", True], ["message", reached], ["host", "127.0.0.1"], ["unitId", unit]]
    return [200, [*top, *more]]


def _refused(error: str) -> list[object]:
    return [400, [["success", False], ["error", error]]]


def differences() -> Iterator[Difference]:
    beyond = _exception("Illegal Data Address (code 0x2)", -1)
    yield Difference(
        "read at address -1",
        beyond,
        _refused("address is -1, allowed: an integer 0 to 65535"),
        NUMBERS,
    )
    yield Difference(
        "read at address 65536",
        _read(65536, 1, 1000),
        _refused("address is 65536, allowed: an integer 0 to 65535"),
        NUMBERS,
    )
    yield Difference(
        "read from unit 257",
        _read(0, 1, 1000, unit=257),
        _refused("unitId is 257, allowed: an integer 0 to 255"),
        NUMBERS,
    )
    yield Difference(
        "read a quantity as text",
        _read(0, "3", 1000, 1001, 1002),
        [400, [["error", "Quantity must be between 1 and 125"]]],
        NUMBERS,
    )
    yield Difference(
        "connect to a unit that is a text",
        _connected("1", ["testRegister", 1000]),
        _refused('unitId is "1", allowed: an integer 0 to 255'),
        NUMBERS,
    )
    yield Difference(
        "read at the end of all addresses",
        _exception("Illegal Data Address (code 0x2)", 65535, 2),
        _refused("2 from address 65535: the last address is 65535"),
        END,
    )
    yield Difference(
        "read a timeout above 60000",
        _read(0, 1, 1000),
        _refused("timeout is 60001, allowed: an integer 1 to 60000"),
        TIMEOUT,
    )
    for value in ("2", '"true"', "null"):
        refused = _refused(f"value is {value}, allowed: false, true, 0, 1")
        yield Difference(f"write coil {value}", _off(), refused, COIL)
    yield Difference(
        "read from a unit without memory",
        _exception("Unknown exception: 0xb (code 0xb)"),
        _exception(f"{UNREACHED} (code 0xb)"),
        NAMES,
    )
    exception = " (responded with exception)"
    yield Difference(
        "connect to a unit without memory",
        _connected(9, ["exception", "Unknown exception: 0xb"], message=exception),
        _connected(9, ["exception", UNREACHED], message=exception),
        NAMES,
    )


ORIGINAL = Original(
    name="Port of Call",
    variable="HOLDFAST_ORIGINAL_PORT_OF_CALL",
    differences=tuple(differences()),
    theirs=theirs,
    ours=ours,
)

"""The modbus module of tentacle-next (Go): `HOLDFAST_ORIGINAL_TENTACLE_NEXT`.

The command gets the URL of a NATS server in the environment variable `NATS_URL`. It is the
program of `cmd/tentacle-modbus`. No package registry has it under the path of its module.

The inputs are the entries that its gateway writes, with `writable` where a command follows,
because the module refuses commands to the tags of its own gateway.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

from peers.originals.comparison import Command, Difference, Original, Reason
from peers.originals.scanning import MARK, WORDS, Bench, bench
from support import wire
from support.tentacle_next import BUCKET, command, gateway_entry, gateway_tag, key

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from peers.originals.comparison import Answers

PAGE = "moving-from-tentacle.md"
TYPES = ("int16", "uint16", "int32", "uint32", "float32", "float64", "boolean")
ORDERS = ("ABCD", "DCBA", "BADC", "CDAB")
SCRATCH = 100
"""The registers that commands write."""
SCAN = [sys.executable, "-m", "holdfast", "scan", "--dialect", "tentacle-next"]
SCANNER = Command([*SCAN, "--publish", "change"])


def read_tags() -> list[dict[str, Any]]:
    tags = [
        gateway_tag(f"{function}_{datatype}_{order}", 0, datatype, function=function, order=order)
        for function in ("holding", "input")
        for datatype in TYPES
        for order in ORDERS
    ]
    bits = [
        gateway_tag(f"{function}_{at}", at, function=function)
        for function in ("coil", "discrete")
        for at in range(3)
    ]
    return [*tags, *bits, gateway_tag("a name: with . signs", 1), gateway_tag("far", 400)]


def written_tags() -> list[dict[str, Any]]:
    tags = [
        gateway_tag(f"write_{datatype}_{order}", SCRATCH, datatype, order=order)
        for datatype in TYPES
        for order in ORDERS
    ]
    coil = gateway_tag("write_coil", SCRATCH, function="coil")
    return [each | {"writable": True} for each in (*tags, coil, gateway_tag("mark", MARK))]


COMMANDS: dict[str, tuple[object, ...]] = {
    "int16": (0, 5, -5, 12.7, 40000, -40000, True, "5", None),
    "uint16": (5, 65535, 65536, -1, 12.0),
    "int32": (5, -5, 2147483647, 2147483648, 1.5),
    "uint32": (5, 4294967295, 4294967296, -1),
    "float32": (1.5, -0.1, 1e30, 1e39),
    "float64": (1.5, -0.1, 1e300),
    "boolean": (True, False, 1, 0, 2),
}
SOME: dict[str, float] = {"int16": 258, "uint16": 258, "int32": 16909060, "uint32": 16909060}
SOME |= {"float32": 1.5, "float64": 1.5, "boolean": True}


def commands() -> Iterator[tuple[str, object]]:
    for datatype, values in COMMANDS.items():
        for value in values:
            yield f"write_{datatype}_ABCD", value
    for datatype in TYPES:
        for order in ORDERS[1:]:
            yield f"write_{datatype}_{order}", SOME[datatype]
    for value in (True, False, 1, 0, 2, "true", None):
        yield "write_coil", value
    yield "nothing", 5


def answers(run: Bench) -> Answers:
    found: Answers = {}
    tags = read_tags()
    wire.until(lambda: run.has_bucket(BUCKET), "the scanner has made its bucket")
    run.caller.put(BUCKET, key("plc1"), gateway_entry(run.device, *tags, order="CDAB", rate=50))
    ids = [each["id"] for each in tags]
    found |= {f"read {name}": value for name, value in run.values(*ids).items()}
    run.memory.write("holding_registers", 400, [1])
    found["one change"] = run.values("far")
    entry = gateway_entry(run.device, *written_tags(), device="plc2", rate=50)
    run.caller.put(BUCKET, key("plc2"), entry)
    run.values("mark")
    for number, (id, value) in enumerate(commands(), 1):
        run.memory.write("holding_registers", SCRATCH, [7] * 8)
        run.memory.write("coils", SCRATCH, [id == "write_coil" and value in (False, 0, None)])
        run.caller.publish(f"modbus.command.{id}", command(value))
        _mark(run, number)
        coil = int(run.memory.read("coils", SCRATCH, 1)[0])
        found[f"command {id} {value!r}"] = [run.registers(SCRATCH, 4), coil]
    return found | _entries(run)


def _mark(run: Bench, number: int) -> None:
    """Waits until the device has the mark, which is written after everything before it."""
    run.caller.publish("modbus.command.mark", command(number))
    wire.until(lambda: run.registers(MARK, 1) == [number], f"command {number} is carried out")


ODD = {
    "no datatype": gateway_tag("odd", 0, ""),
    "no functionCode": gateway_tag("odd", 0, function=""),
    "an unknown datatype": gateway_tag("odd", 0, "word"),
    "an unknown functionCode": gateway_tag("odd", 0, function="register"),
    "an unknown byteOrder": gateway_tag("odd", 0, "int32", order="ACBD"),
}
"""Tags that leave something out, or that name what is not there."""


def _entries(run: Bench) -> Answers:
    """Returns what is published for entries with such a tag: None if they are refused."""
    for number, tag in enumerate(ODD.values()):
        device = f"odd{number}"
        run.caller.put(BUCKET, key(device), gateway_entry(run.device, tag, device=device))
    variables = run.variables("odd", len(ODD))
    return {f"an entry with {name}": variables.get(f"odd{at}") for at, name in enumerate(ODD)}


RANGE = Reason(
    "a wrong value must not reach a device",
    PAGE,
    "A value outside the range of the type is truncated, `12.7` becomes 12, every number except 0 "
    "switches a coil on.",
)
BIT = Reason(
    "the value is a boolean",
    PAGE,
    "a coil or discrete input with a numeric `datatype` | a boolean",
)
TEXT = Reason(
    "its meaning is certain",
    PAGE,
    'A value as text, such as `{"value": "5"}`, is ignored.',
)
BOOLEAN = Reason(
    "a boolean has no bytes to swap",
    PAGE,
    "`true` in a register with `BADC` or `DCBA` is written as 256.",
)
UNKNOWN = Reason(
    "a value of another type is wrong",
    PAGE,
    "An unknown `datatype` is read as `uint16`, an unknown `functionCode` as `holding`, an unknown "
    "`byteOrder` as `ABCD`.",
)
REFUSED = [7, 7, 7, 7]
"""The registers of a command that is refused."""
TRUNCATED: dict[str, dict[float, list[int]]] = {
    "int16": {12.7: [12], 40000: [40000], -40000: [25536]},
    "uint16": {65536: [0], -1: [65535]},
    "int32": {2147483648: [32768, 0], 1.5: [0, 1]},
    "uint32": {4294967296: [0, 0], -1: [65535, 65535]},
    "float32": {1e39: [32640, 0]},
    "boolean": {2: [1]},
}


def differences() -> Iterator[Difference]:
    for at, values in {"coil": (True, False, True), "discrete": (False, True, False)}.items():
        for number, bit in enumerate(values):
            yield Difference(f"read {at}_{number}", [bit, "number"], [bit, "boolean"], BIT)
    for datatype, written in TRUNCATED.items():
        for value, words in written.items():
            yield _written(f"{datatype}_ABCD", value, words, [], RANGE)
    yield _written("int16_ABCD", "5", [], [5], TEXT)
    for order in ("DCBA", "BADC"):
        yield _written(f"boolean_{order}", True, [256], [1], BOOLEAN)
    yield Difference("command write_coil 2", [REFUSED, 1], [REFUSED, 0], RANGE)
    yield Difference("command write_coil 'true'", [REFUSED, 0], [REFUSED, 1], TEXT)
    yield Difference("an entry with an unknown datatype", WORDS[0], None, UNKNOWN)
    yield Difference("an entry with an unknown functionCode", WORDS[0], None, UNKNOWN)
    number = WORDS[0] << 16 | WORDS[1]
    yield Difference("an entry with an unknown byteOrder", number, None, UNKNOWN)


def _written(
    tag: str, value: object, theirs: list[int], ours: list[int], reason: Reason
) -> Difference:
    """Returns the row of a command, with the registers that each side wrote."""
    return Difference(
        f"command write_{tag} {value!r}",
        [[*theirs, *REFUSED[len(theirs) :]], 0],
        [[*ours, *REFUSED[len(ours) :]], 0],
        reason,
    )


def theirs(command: Command, folder: Path) -> Answers:
    with bench(command, folder, NATS_URL="NATS") as run:
        return answers(run)


def ours(folder: Path) -> Answers:
    with bench(SCANNER, folder, NATS_SERVERS="NATS") as run:
        return answers(run)


ORIGINAL = Original(
    name="tentacle-next",
    variable="HOLDFAST_ORIGINAL_TENTACLE_NEXT",
    differences=tuple(differences()),
    theirs=theirs,
    ours=ours,
)

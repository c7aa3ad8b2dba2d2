"""tentacle-modbus (TypeScript, for Deno): `HOLDFAST_ORIGINAL_TENTACLE_MODBUS`.

The command gets the URL of a NATS server in the environment variable `NATS_SERVERS`. No package
registry has the program.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from peers.originals.comparison import Difference, Original, Reason
from peers.originals.scanning import MARK, SCANNER, WORDS, Bench, bench
from support import wire
from support.nats_bus import leaving, subscription, tag

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from peers.originals.comparison import Answers, Command

PAGE = "moving-from-tentacle.md"
TYPES = ("int16", "uint16", "int32", "uint32", "float32", "float64", "boolean")
ORDERS = ("ABCD", "DCBA", "BADC", "CDAB")
SCRATCH = 100
"""The registers that commands write."""


def read_tags() -> list[dict[str, Any]]:
    """Returns tags of every type and order, at the registers of `WORDS`."""
    tags = [
        tag(f"{function}_{datatype}_{order}", 0, datatype, functionCode=function, byteOrder=order)
        for function in ("holding", "input")
        for datatype in TYPES
        for order in ORDERS
    ]
    bits = [
        tag(f"{function}_{at}", at, "boolean", functionCode=function)
        for function in ("coil", "discrete")
        for at in range(3)
    ]
    return [*tags, *bits, tag("device_order", 2, "int32"), tag("far", 400, byteOrder="ABCD")]


def written_tags() -> list[dict[str, Any]]:
    """Returns tags for commands: a block of eight registers is enough for each."""
    tags = [
        tag(f"write_{datatype}_{order}", SCRATCH, datatype, byteOrder=order)
        for datatype in TYPES
        for order in ORDERS
    ]
    coil = tag("write_coil", SCRATCH, "boolean", functionCode="coil")
    closed = tag("write_input", SCRATCH, "uint16", functionCode="input")
    return [*tags, coil, closed, tag("mark", MARK)]


COMMANDS = {
    "int16": (
        "0",
        "5",
        "-5",
        "+5",
        "12.7",
        "40000",
        "-40000",
        "1e2",
        " 7",
        "7 ",
        "0x10",
        "5 bar",
        "abc",
        "",
    ),
    "uint16": ("5", "65535", "65536", "-1", "12.0", "5."),
    "int32": ("5", "-5", "2147483647", "2147483648", "1.5", "123456789"),
    "uint32": ("5", "4294967295", "4294967296", "-1"),
    "float32": ("1.5", "-0.1", "1e30", "1e39", "NaN", "Infinity", ".5"),
    "float64": ("1.5", "-0.1", "1e300"),
    "boolean": ("true", "false", "1", "0", "True", "yes", "2"),
}
SOME = {"int16": "258", "uint16": "258", "int32": "16909060", "uint32": "16909060"}
SOME |= {"float32": "1.5", "float64": "1.5", "boolean": "true"}


def commands() -> Iterator[tuple[str, str]]:
    """Returns a tag and a text for each command."""
    for datatype, texts in COMMANDS.items():
        for text in texts:
            yield f"write_{datatype}_ABCD", text
    for datatype in TYPES:
        for order in ORDERS[1:]:
            yield f"write_{datatype}_{order}", SOME[datatype]
    for text in ("true", "false", "1", "0", "True", "on", "2"):
        yield "write_coil", text
    yield "write_input", "5"
    yield "nothing", "5"


def answers(run: Bench) -> Answers:
    found: Answers = {}
    request = subscription(run.device, *read_tags(), byteOrder="CDAB")
    found["subscribe"] = run.reply("modbus.subscribe", request)
    ids = [each["id"] for each in read_tags()]
    found |= {f"read {name}": value for name, value in run.values(*ids).items()}
    found |= changes(run)
    request = subscription(run.device, *written_tags(), subscriberId="panel", deviceId="plc2")
    found["subscribe for commands"] = run.reply("modbus.subscribe", request)
    run.values("mark")
    for number, (id, text) in enumerate(commands(), 1):
        run.memory.write("holding_registers", SCRATCH, [7] * 8)
        run.memory.write("coils", SCRATCH, [id == "write_coil" and text not in ON])
        run.caller.publish(f"modbus.command.{id}", text)
        _mark(run, number)
        coil = int(run.memory.read("coils", SCRATCH, 1)[0])
        found[f"command {id} {text!r}"] = [run.registers(SCRATCH, 4), coil]
    return found | several(run) | refusal(run) | requests(run)


ON = ("true", "1")
"""Texts that switch a coil on: before, it is off."""


def _mark(run: Bench, number: int) -> None:
    """Waits until the device has the mark, which is written after everything before it."""
    run.caller.publish("modbus.command.mark", str(number))
    wire.until(lambda: run.registers(MARK, 1) == [number], f"command {number} is carried out")


def several(run: Bench) -> Answers:
    """Returns what a command writes whose tag two devices have, each at its own address."""
    for at, device in enumerate(("plc5", "plc6")):
        twice = tag("twice", SCRATCH + at)
        request = subscription(run.device, twice, tag(f"after_{device}", 0), deviceId=device)
        run.reply("modbus.subscribe", request)
        run.values(f"after_{device}")
    run.memory.write("holding_registers", SCRATCH, [7] * 8)
    run.caller.publish("modbus.command.twice", "5")
    _mark(run, 999)
    return {"command of a tag of two devices": run.registers(SCRATCH, 2)}


def refusal(run: Bench) -> Answers:
    """Returns whether a tag is published whose block has an address that the device refuses."""
    tags = (tag("last", 999), tag("beyond", 1005), tag("bit", 0, "boolean", functionCode="coil"))
    run.reply("modbus.subscribe", subscription(run.device, *tags, deviceId="plc7"))
    found: dict[str, object] = {}
    for value in (False, True, False, True):
        # The bit is in a block of its own: what it shows comes with a scan of all blocks.
        found |= run.values("bit")
        run.memory.write("coils", 0, [value])
    return {f"a block with a refused address: {id}": found.get(id) for id in ("last", "beyond")}


def changes(run: Bench) -> Answers:
    """Returns which tags are published when one of them changes, and after a repeated request."""
    found: Answers = {}
    run.memory.write("holding_registers", 400, [1])
    found["one change"] = run.values("far")
    again = subscription(run.device, *read_tags(), byteOrder="CDAB")
    found["subscribe again"] = run.reply("modbus.subscribe", again)
    run.memory.write("holding_registers", 400, [2])
    found["one change after subscribing again"] = run.values("far")
    return found


def requests(run: Bench) -> Answers:
    """Returns the replies to requests that end subscriptions, and to faulty ones."""
    some = subscription(run.device, tag("a", 0), tag("b", 1), deviceId="plc3")
    odd = {"unknown byteOrder": "ACBD", "byteOrder big": "big"}
    found: Answers = {
        "subscribe to another device": run.reply("modbus.subscribe", some),
        "unsubscribe a tag": run.reply("modbus.unsubscribe", leaving("a", deviceId="plc3")),
        "unsubscribe an unknown tag": run.reply(
            "modbus.unsubscribe", leaving("z", deviceId="plc3")
        ),
        "unsubscribe without tagIds": run.reply(
            "modbus.unsubscribe", {"deviceId": "plc3", "subscriberId": "hmi"}
        ),
        "unsubscribe the last tag": run.reply("modbus.unsubscribe", leaving("b", deviceId="plc3")),
        "unsubscribe an unknown device": run.reply(
            "modbus.unsubscribe", leaving("b", deviceId="x")
        ),
        "subscribe without tags": run.reply("modbus.subscribe", {"deviceId": "x"}),
        "subscribe, no JSON": run.reply("modbus.subscribe", "{"),
        "unsubscribe, no JSON": run.reply("modbus.unsubscribe", "{"),
    }
    for number, (name, order) in enumerate(odd.items()):
        request = subscription(run.device, tag("a", 0, "int32"), deviceId=f"odd{number}")
        found[f"subscribe, {name}"] = run.reply("modbus.subscribe", request | {"byteOrder": order})
    return found


def theirs(command: Command, folder: Path) -> Answers:
    with bench(command, folder, NATS_SERVERS="NATS") as run:
        return answers(run)


def ours(folder: Path) -> Answers:
    with bench(SCANNER, folder, NATS_SERVERS="NATS") as run:
        return answers(run)


RANGE = Reason(
    "a wrong value must not reach a device",
    PAGE,
    "A value outside the range of the type is truncated, `12.7` becomes 12.",
)
PREFIX = Reason(
    "a wrong value must not reach a device",
    PAGE,
    "A text that begins with a number is that number: `0x10` is 0, `5 bar` is 5.",
)
BOOLEAN = Reason(
    "a wrong value must not reach a device",
    PAGE,
    "A boolean is `true` or `1`; any other text is false.",
)
SWAPPED = Reason(
    "what is written is read back",
    PAGE,
    "`BADC` and `DCBA` of an `int16` or `uint16` swap its bytes in reads, but not in writes.",
)
ONE_WORD = Reason(
    "one register has no words to swap",
    PAGE,
    "`CDAB` of an `int16` or `uint16` is always read as 0.",
)
SEVERAL = Reason(
    "a wrong value must not reach a device",
    PAGE,
    "A command writes the first tag with this id, of any device.",
)
BLOCK = Reason(
    "other tags keep their values",
    PAGE,
    "A failed block is left out. | Only the refused addresses are left out",
)
ORDER = Reason(
    "the error is visible",
    PAGE,
    "Any other unknown `byteOrder` is accepted, and the block is not read.",
)
REFUSED = ([7, 7, 7, 7], 0)
"""What the device holds after a command that is refused."""
TRUNCATED: dict[str, dict[str, list[int]]] = {
    "int16": {"12.7": [12], "40000": [40000], "-40000": [25536]},
    "uint16": {"65536": [0], "-1": [65535]},
    "int32": {"2147483648": [32768, 0], "1.5": [0, 1]},
    "uint32": {"4294967296": [0, 0], "-1": [65535, 65535]},
    "float32": {"1e39": [32640, 0], "Infinity": [32640, 0]},
}


def differences() -> Iterator[Difference]:
    for datatype, texts in TRUNCATED.items():
        for text, words in texts.items():
            yield _written(f"{datatype}_ABCD", text, words, [], RANGE)
    yield _written("int16_ABCD", "0x10", [0], [], PREFIX)
    yield _written("int16_ABCD", "5 bar", [5], [], PREFIX)
    for text in ("True", "yes", "2"):
        yield _written("boolean_ABCD", text, [0], [], BOOLEAN)
    for text in ("True", "on", "2"):
        registers = REFUSED[0]
        yield Difference(f"command write_coil {text!r}", [registers, 0], [registers, 1], BOOLEAN)
    for datatype in ("int16", "uint16"):
        for order in ("DCBA", "BADC"):
            yield _written(f"{datatype}_{order}", "258", [0x0102], [0x0201], SWAPPED)
        for function in ("holding", "input"):
            read = f"read {function}_{datatype}_CDAB"
            yield Difference(read, [0, "number"], [WORDS[0], "number"], ONE_WORD)
    accepted, refused = {"success": True, "count": 1}, {"success": False}
    yield Difference("subscribe, unknown byteOrder", accepted, refused, ORDER)

    registers = [7, 7]
    yield Difference("command of a tag of two devices", [5, 7], registers, SEVERAL)
    yield Difference("a block with a refused address: last", None, [0, "number"], BLOCK)


def _written(tag: str, text: str, theirs: list[int], ours: list[int], reason: Reason) -> Difference:
    """Returns the row of a command, with the registers that each side wrote."""
    registers, coil = REFUSED
    return Difference(
        f"command write_{tag} {text!r}",
        [[*theirs, *registers[len(theirs) :]], coil],
        [[*ours, *registers[len(ours) :]], coil],
        reason,
    )


ORIGINAL = Original(
    name="tentacle-modbus",
    variable="HOLDFAST_ORIGINAL_TENTACLE_MODBUS",
    differences=tuple(differences()),
    theirs=theirs,
    ours=ours,
)

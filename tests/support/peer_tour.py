"""The tour of functions that every client of others runs against a listener.

Each peer has a driver in `tests/peers/drivers`, a program that executes operations and judges
nothing. This file has the operations, what each must return, and what must be in memory afterwards.
Where a peer differs from the others, its entry in `tests/peers/test_client_tour.py` says how.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    import holdfast
    from holdfast.types import Area

UNIT = 7

SIZES = {
    "coils": 65536,
    "holding_registers": 65536,
    "discrete_inputs": 3000,
    "input_registers": 1000,
}
"""Coils and holding registers have every address, the inputs end earlier."""

IDENTITY = {"vendor_name": "Acme", "product_code": "P-1", "revision": "1.2"}

Operation = dict[str, Any]


@dataclass(frozen=True)
class Values:
    """The reply has these values; none for a write."""

    values: Any = None

    def differs(self, result: Mapping[str, Any]) -> bool:
        return dict(result) != {"value": self.values}


@dataclass(frozen=True)
class Refusal:
    """The server answers with an exception code."""

    code: int

    def differs(self, result: Mapping[str, Any]) -> bool:
        return dict(result) != {"exception": self.code}


@dataclass(frozen=True)
class Error:
    """The peer reports an error of its own, for instance because it checks the quantity itself."""

    pattern: str

    def differs(self, result: Mapping[str, Any]) -> bool:
        return set(result) != {"error"} or not re.search(self.pattern, str(result["error"]))


@dataclass(frozen=True)
class LeftOut:
    """The step is left out, because the peer would wait for its timeout."""

    reason: str

    def differs(self, result: Mapping[str, Any]) -> bool:
        raise AssertionError(f"a step that is left out was taken: {dict(result)}")


Outcome = Values | Refusal | Error | LeftOut


@dataclass(frozen=True)
class Step:
    """One operation of the tour."""

    name: str
    operation: Operation
    expected: Outcome = field(default_factory=Values)
    needs: str | None = None
    """A call without which the step has another outcome."""

    def suits(self, calls: Collection[str]) -> bool:
        """Whether a client with these calls can take the step."""
        return {self.operation["call"], self.needs or self.operation["call"]} <= set(calls)


def reading(call: str, address: int, count: int) -> Operation:
    return {"call": call, "address": address, "count": count}


def writing(call: str, address: int, value: Any) -> Operation:
    key = "values" if isinstance(value, list) else "value"
    return {"call": call, "address": address, key: value}


def mask(address: int, and_mask: int, or_mask: int) -> Operation:
    return {"call": "mask_write", "address": address, "and": and_mask, "or": or_mask}


def both(read: int, count: int, address: int, values: list[int]) -> Operation:
    return {
        "call": "read_write",
        "read_address": read,
        "count": count,
        "address": address,
        "values": values,
    }


COILS, DISCRETE = "read_coils", "read_discrete_inputs"
HOLDING, INPUT = "read_holding_registers", "read_input_registers"
COIL, REGISTER = "write_coil", "write_register"
ALL_COILS, REGISTERS = "write_coils", "write_registers"
MASK, BOTH, IDENTIFY, ECHO = "mask_write", "read_write", "identify", "echo"

BASIC = frozenset({COILS, DISCRETE, HOLDING, INPUT, COIL, REGISTER, ALL_COILS, REGISTERS})
"""Functions 1-6, 15 and 16: every peer has them."""
EVERY = BASIC | {MASK, BOTH, IDENTIFY, ECHO}

BITS = [1, 0, 1, 1, 0, 0, 1, 1, 1, 0, 1]
WORDS = [0, 1, 255, 256, 32767, 32768, 65535]


def third(address: int, count: int) -> list[int]:
    """What the discrete inputs hold: every third is 1."""
    return [int(at % 3 == 0) for at in range(address, address + count)]


READS = [
    Step("1 coil", reading(COILS, 0, 1), Values([0])),
    Step("10 discrete inputs", reading(DISCRETE, 3, 10), Values(third(3, 10))),
    Step("2000 discrete inputs", reading(DISCRETE, 0, 2000), Values(third(0, 2000))),
    Step("the last discrete inputs", reading(DISCRETE, 2993, 7), Values(third(2993, 7))),
    Step("1 input register", reading(INPUT, 999, 1), Values([999])),
    Step("125 input registers", reading(INPUT, 0, 125), Values(list(range(125)))),
    Step("holding registers", reading(HOLDING, 65526, 10), Values([0] * 10)),
]

WRITES = [
    Step("coil 0 on", writing(COIL, 0, 1)),
    Step("coil 65535 on", writing(COIL, 65535, 1)),
    Step("coil 65535", reading(COILS, 65535, 1), Values([1])),
    Step("coil 0 off", writing(COIL, 0, 0)),
    Step("coil 0", reading(COILS, 0, 1), Values([0])),
    Step("write 11 coils", writing(ALL_COILS, 3, BITS)),
    Step("read 11 coils", reading(COILS, 2, 13), Values([0, *BITS, 0])),
    Step("write 1968 coils", writing(ALL_COILS, 100, third(0, 1968))),
    Step("read 2000 coils", reading(COILS, 100, 2000), Values(third(0, 1968) + [0] * 32)),
    Step("write register 0", writing(REGISTER, 0, 4711)),
    Step("write register 65535", writing(REGISTER, 65535, 65535)),
    Step("register 65535", reading(HOLDING, 65535, 1), Values([65535])),
    Step("write 7 registers", writing(REGISTERS, 10, WORDS)),
    Step("read 7 registers", reading(HOLDING, 9, 9), Values([0, *WORDS, 0])),
    Step("write 123 registers", writing(REGISTERS, 65400, list(range(1000, 1123)))),
    Step("read 125 registers", reading(HOLDING, 65399, 125), Values([0, *range(1000, 1123), 0])),
]

MORE = [
    Step("a register to mask", writing(REGISTER, 200, 0x12)),
    Step("mask write", mask(200, 0xF2, 0x25)),
    Step("the masked register", reading(HOLDING, 200, 1), Values([0x17]), needs=MASK),
    Step("mask register 65535", mask(65535, 0x00FF, 0)),
    Step("read and write", both(10, 4, 11, [70, 80]), Values([0, 70, 80, 256])),
    Step(
        "read 125 and write 121 registers",
        both(300, 125, 302, list(range(121))),
        Values([0, 0, *range(121), 0, 0]),
    ),
    Step(
        "basic identification",
        {"call": IDENTIFY, "code": 1, "object": 0},
        Values({"0": "Acme", "1": "P-1", "2": "1.2"}),
    ),
    Step(
        "one object of the identification",
        {"call": IDENTIFY, "code": 4, "object": 1},
        Values({"1": "P-1"}),
    ),
    Step("query data", {"call": ECHO, "values": [0x1234]}, Values([0x1234])),
]

EXCEPTIONS = [
    Step("past the last input register", reading(INPUT, 1000, 1), Refusal(2)),
    Step("input registers past the last", reading(INPUT, 990, 11), Refusal(2)),
    Step("past the last discrete input", reading(DISCRETE, 65535, 1), Refusal(2)),
    Step("coils past 65535", reading(COILS, 65535, 2), Refusal(2)),
    Step("write coils past 65535", writing(ALL_COILS, 65535, [1, 0]), Refusal(2)),
    Step("write registers past 65535", writing(REGISTERS, 65535, [1, 2]), Refusal(2)),
    Step("0 holding registers", reading(HOLDING, 0, 0), Refusal(3)),
    Step("126 holding registers", reading(HOLDING, 0, 126), Refusal(3)),
    Step("2001 coils", reading(COILS, 0, 2001), Refusal(3)),
    Step("write 1969 coils", writing(ALL_COILS, 0, [1] * 1969), Refusal(3)),
    Step("after the exceptions", reading(INPUT, 5, 2), Values([5, 6])),
]

TOUR = [*READS, *WRITES, *MORE, *EXCEPTIONS]

READ_ONLY = [
    Step("read", reading(INPUT, 5, 2), Values([5, 6])),
    Step("refused write coil", writing(COIL, 0, 1), Refusal(1)),
    Step("refused write register", writing(REGISTER, 0, 1), Refusal(1)),
    Step("refused write coils", writing(ALL_COILS, 0, [1, 1]), Refusal(1)),
    Step("refused write registers", writing(REGISTERS, 0, [1, 2]), Refusal(1)),
    Step("refused mask write", mask(0, 0, 0), Refusal(1)),
    Step("refused read and write", both(0, 1, 0, [1]), Refusal(1)),
    Step("read again", reading(HOLDING, 0, 2), Values([0, 0])),
]
"""What a client gets from a listener with read-only access."""


ELSEWHERE = [Step("a unit that is not there", reading(HOLDING, 0, 1), Refusal(11))]
"""What a client gets for a unit id that is not mapped."""


def filled(memory: holdfast.Memory) -> None:
    """Fills the inputs."""
    memory.write("discrete_inputs", 0, third(0, SIZES["discrete_inputs"]))
    memory.write("input_registers", 0, range(SIZES["input_registers"]))


def written(calls: Collection[str], differences: Mapping[str, Outcome]) -> dict[Area, list[int]]:
    """What the coils and holding registers hold after the tour of a client."""

    def done(name: str) -> bool:
        return not isinstance(differences.get(name), Refusal)

    coils, registers = [0] * 65536, [0] * 65536
    coils[65535] = 1
    if done("write 11 coils"):
        coils[3:14] = BITS
    if done("write 1968 coils"):
        coils[100:2068] = third(0, 1968)
    registers[0], registers[65535] = 4711, 65535
    registers[10:17] = WORDS
    if done("write 123 registers"):
        registers[65400:65523] = range(1000, 1123)
    registers[200] = 0x12
    if MASK in calls:
        registers[200], registers[65535] = 0x17, 0x00FF
    if BOTH in calls:
        registers[11:13] = 70, 80
        registers[302:423] = range(121)
    return {"coils": coils, "holding_registers": registers}


def steps_of(
    steps: list[Step], calls: Collection[str], differences: Mapping[str, Outcome]
) -> list[Step]:
    """The steps that a client with these calls takes."""
    taken = [step for step in steps if step.suits(calls)]
    return [step for step in taken if not isinstance(differences.get(step.name), LeftOut)]


def judged(
    steps: list[Step], results: Sequence[Mapping[str, Any]], differences: Mapping[str, Outcome]
) -> dict[str, tuple[Mapping[str, Any], Outcome]]:
    """The steps whose result is not the expected one: what came, and what was expected."""
    assert len(results) == len(steps), f"{len(results)} results of {len(steps)} operations"
    expected = [differences.get(step.name, step.expected) for step in steps]
    return {
        step.name: (result, outcome)
        for step, result, outcome in zip(steps, results, expected, strict=True)
        if outcome.differs(result)
    }

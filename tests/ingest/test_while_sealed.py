"""Rights that hold while a memory is sealed: how it is restored before its gate opens."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, cast

import msgspec
import pytest

import holdfast
from holdfast.ingest import Grant, MemoryAccess, Refused

if TYPE_CHECKING:
    from holdfast.events.audit import Audit

PEER = "10.0.0.7:50000"
RESTORED = ("coils", "holding_registers")
GRANT = Grant(
    "edge",
    ("plant", "other", "open"),
    ("discrete_inputs", "input_registers"),
    while_sealed=RESTORED,
)


def memory(mode: Any = "once") -> holdfast.Memory:
    areas: dict[str, Any] = dict.fromkeys(
        ("coils", "discrete_inputs", "holding_registers", "input_registers"), 8
    )
    return holdfast.Memory(**areas, seal=("discrete_inputs", 7, mode))


@pytest.fixture
def plant() -> holdfast.Memory:
    return memory()


@pytest.fixture
def open_memory() -> holdfast.Memory:
    return holdfast.Memory(input_registers=8, holding_registers=8)


@pytest.fixture
def memory_access(plant: holdfast.Memory, open_memory: holdfast.Memory) -> MemoryAccess:
    return MemoryAccess("mqtt", {"plant": plant, "other": memory(), "open": open_memory})


def command(area: str, values: list[int], address: int = 0, memory: str = "plant") -> Any:
    return {"memory": memory, "area": area, "address": address, "values": values}


OPEN = command("discrete_inputs", [1], 7)
REGISTERS = command("holding_registers", [7, 8])


def refused(memory_access: MemoryAccess, *batch: Any, grant: Grant = GRANT) -> Refused:
    with pytest.raises(Refused) as caught:
        memory_access.write(batch, grant, PEER)
    return caught.value


def test_other_areas_are_written_only_while_the_memory_is_sealed(
    memory_access: MemoryAccess, plant: holdfast.Memory
) -> None:
    memory_access.write([REGISTERS], GRANT, PEER)
    memory_access.write([command("coils", [1, 0, 1])], GRANT, PEER)
    memory_access.write([OPEN], GRANT, PEER)
    error = refused(memory_access, command("holding_registers", [1, 2]))
    assert (error.reason, error.detail) == (
        "not_granted",
        "commands[0]: area holding_registers is granted to edge only while plant is sealed",
    )
    memory_access.write([command("input_registers", [9])], GRANT, PEER)
    assert plant.read("holding_registers", 0, 3) == [7, 8, 0]
    assert plant.read("coils", 0, 3) == [1, 0, 1]
    assert plant.read("input_registers", 0, 1) == [9]
    assert cast("Any", memory_access.counts())["refused"] == {"not_granted": 1}


def test_in_level_mode_the_rights_end_and_begin_with_the_seal() -> None:
    level = MemoryAccess("mqtt", {"plant": memory("level")})
    for bit in (1, 0, 1):
        level.write([{**OPEN, "values": [bit]}], GRANT, PEER)
        if bit:
            assert refused(level, REGISTERS).reason == "not_granted"
        else:
            level.write([REGISTERS], GRANT, PEER)


def test_a_batch_restores_and_opens_a_memory_in_one_step(
    memory_access: MemoryAccess, plant: holdfast.Memory
) -> None:
    memory_access.write([OPEN, REGISTERS], GRANT, PEER)
    assert not plant.sealed
    assert plant.read("holding_registers", 0, 2) == [7, 8]
    error = refused(memory_access, command("input_registers", [5]), REGISTERS)
    assert (error.reason, error.where["command"]) == ("not_granted", 0)
    assert "another command of the batch requires" in error.detail
    assert plant.read("input_registers", 0, 1) == [0]


def test_a_batch_that_restores_is_refused_where_one_memory_is_not_sealed(
    memory_access: MemoryAccess, plant: holdfast.Memory
) -> None:
    inputs = command("input_registers", [5], memory="open")
    error = refused(memory_access, REGISTERS, inputs)
    assert (error.reason, error.where["command"]) == ("not_granted", 1)
    assert plant.read("holding_registers", 0, 2) == [0, 0]
    memory_access.write([REGISTERS, command("coils", [1], memory="other")], GRANT, PEER)
    assert plant.read("holding_registers", 0, 2) == [7, 8]


def test_a_memory_without_a_seal_is_never_restored(memory_access: MemoryAccess) -> None:
    error = refused(memory_access, command("holding_registers", [1], memory="open"))
    assert error.reason == "not_granted"


@pytest.mark.parametrize(
    "grant",
    [
        Grant("edge", ("other",), (), while_sealed=RESTORED),
        Grant("edge", ("plant",), ("coils",)),
        Grant("edge", ("plant",), (), writes=False, while_sealed=RESTORED),
    ],
    ids=["another memory", "no such right", "reads only"],
)
def test_who_has_no_such_right_is_refused_while_the_memory_is_sealed(
    memory_access: MemoryAccess, plant: holdfast.Memory, grant: Grant
) -> None:
    assert refused(memory_access, REGISTERS, grant=grant).reason == "not_granted"
    assert plant.read("holding_registers", 0, 2) == [0, 0]


def test_a_right_to_restore_is_none_to_read(memory_access: MemoryAccess) -> None:
    with pytest.raises(Refused, match="area coils is not granted to edge"):
        memory_access.read("plant", "coils", 0, 1, GRANT, PEER)
    with pytest.raises(Refused, match="area coils is not granted to edge"):
        memory_access.follow("plant", [("coils", 0, 1)], GRANT, PEER)


@pytest.mark.parametrize("is_open", [False, True])
def test_a_range_that_mirrors_a_device_is_not_passed_on_to_it(
    plant: holdfast.Memory, is_open: bool
) -> None:
    """The device is not under the lock of the seal, so the gate could open meanwhile."""

    class Passage:
        def device_of(self, *_: object) -> str:
            return "drive"

        def write(self, *_: object) -> int:
            raise AssertionError("it is passed on")

    plant.mirror([("holding_registers", 0, 8)])
    plant.write("discrete_inputs", 7, [is_open])
    passages = cast("Any", {"plant": Passage()})
    memory_access = MemoryAccess("mqtt", {"plant": plant}, passages=passages)
    with pytest.raises(Refused) as caught:
        memory_access.ingest(json.dumps(REGISTERS).encode(), GRANT, PEER)
    assert (caught.value.reason, caught.value.detail) == (
        "not_granted",
        "area holding_registers is granted to edge only while plant is sealed; "
        "this write would go to drive",
    )


class OpeningAudit:
    """An audit log that opens a memory after the checks of a write, and before the write."""

    def __init__(self, memory: holdfast.Memory) -> None:
        self.memory = memory
        self.outcomes: list[object] = []

    def require(self) -> None:
        self.memory.write("discrete_inputs", 7, [1])

    def write_refused(self, **line: object) -> None:
        self.outcomes.append(line["outcome"])

    def queue(self, lines: Any) -> list[Any]:
        return list(lines)

    def write_group(self, group: list[Any]) -> None:
        self.require()
        self.write_all(group)

    def write_all(self, lines: Any, *, done: bool = False) -> None:  # noqa: ARG002
        self.outcomes += [msgspec.json.decode(line)["outcome"] for line in lines]


def test_a_write_that_was_checked_before_the_gate_opened_is_refused_after_it(
    plant: holdfast.Memory,
) -> None:
    audit = OpeningAudit(plant)
    memory_access = MemoryAccess("mqtt", {"plant": plant}, cast("Audit", audit))
    assert refused(memory_access, REGISTERS).reason == "not_granted"
    assert plant.read("holding_registers", 0, 2) == [0, 0]
    assert audit.outcomes == ["not_granted"]


def test_a_write_while_the_memory_is_sealed_is_recorded_once(plant: holdfast.Memory) -> None:
    audit = OpeningAudit(holdfast.Memory(discrete_inputs=8))
    memory_access = MemoryAccess("mqtt", {"plant": plant}, cast("Audit", audit))
    memory_access.write([REGISTERS], GRANT, PEER)
    assert audit.outcomes == ["done"]

"""The checker finds what is wrong in a history, and nothing in histories of a correct memory."""

from __future__ import annotations

import dataclasses
import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from oracle.checker import check
from oracle.history import History, Ids, Operation, Outcome, Reading, Write
from oracle.layout import Block, Kind, Layout, Range
from oracle.simulated_memory import MEMORY, SimulatedMemory, is_linearizable, layout

X = Block("x", MEMORY, "holding_registers", 0, 2)
Y = Block("y", MEMORY, "holding_registers", 2, 3)
TWO = Layout([X, Y])


def write(begin: float, end: float, *writes: Write, outcome: Outcome = Outcome.DONE) -> Operation:
    return Operation("a", "write", begin, end, outcome, writes)


def read(begin: float, end: float, **ids: int) -> Operation:
    """A read of the blocks x and y, or of one of them."""
    values = [value for block in (X, Y) for value in block.encode(ids.get(block.name, 0))]
    start, count = {"x": (0, 2), "y": (2, 3)}.get("".join(ids), (0, 5))
    of = Range(MEMORY, "holding_registers", start, count)
    seen = Reading(of, tuple(values[start : start + count]))
    return Operation("b", "read", begin, end, Outcome.DONE, (), (seen,))


def found(*operations: Operation) -> list[str]:
    return [violation.kind for violation in check(History(TWO, list(operations)))]


@given(seed=st.integers(0, 2**32), clients=st.integers(1, 12), count=st.integers(1, 40))
def test_no_violation_is_found_in_histories_of_a_correct_memory(
    seed: int, clients: int, count: int
) -> None:
    assert check(SimulatedMemory(seed, clients, count).history) == []


@st.composite
def small_histories(draw: st.DrawFn, blocks: tuple[Block, ...]) -> History:
    """Up to seven operations with any times, which may have read anything that is written."""
    operations: list[Operation] = []
    ids = Ids(blocks)
    count = draw(st.integers(2, 7))
    times = draw(st.permutations(range(2 * count)))
    written = {block: [0] for block in blocks}
    for at in range(count):
        begin, end = sorted(times[2 * at : 2 * at + 2])
        if draw(st.booleans()):
            of = draw(st.lists(st.sampled_from(blocks), min_size=1, unique=True))
            writes = [Write(block, ids.draw(block)) for block in of]
            for block, write_id in writes:
                written[block].append(write_id)
            is_known = draw(st.integers(0, 4)) > 0
            outcome = Outcome.DONE if is_known else Outcome.UNKNOWN
            operations.append(write(begin, end if is_known else math.inf, *writes, outcome=outcome))
        else:
            operations.append(Operation("b", "read", begin, end, Outcome.DONE))
    for at, operation in enumerate(operations):
        if operation.name == "read":
            of = draw(st.lists(st.sampled_from(blocks), min_size=1, unique=True))
            ids_seen = {block.name: draw(st.sampled_from(written[block])) for block in of}
            operations[at] = read(operation.begin, operation.end, **ids_seen)
    return History(Layout(blocks), operations)


@given(small_histories((X,)))
def test_one_block_is_judged_exactly(history: History) -> None:
    assert (check(history) == []) == is_linearizable(history)


@given(small_histories((X, Y)))
def test_nothing_is_found_in_several_blocks_that_an_order_explains(history: History) -> None:
    if is_linearizable(history):
        assert check(history) == []


def test_reads_may_see_a_write_before_it_ends() -> None:
    assert found(write(0, 10, Write(X, 1)), read(1, 2, x=0), read(3, 4, x=1)) == []


def test_a_read_that_goes_back_is_found() -> None:
    assert found(write(0, 10, Write(X, 1)), read(1, 2, x=1), read(3, 4, x=0)) == ["stale"]


def test_a_read_of_a_value_that_was_replaced_is_found() -> None:
    writes = [write(0, 1, Write(X, 1)), write(2, 3, Write(X, 2))]
    assert found(*writes, read(4, 5, x=1)) == ["stale"]
    assert found(*writes, read(2, 5, x=1)) == []


def test_a_write_without_a_reply_may_have_happened_at_any_later_time_or_never() -> None:
    lost = write(0, math.inf, Write(X, 1), outcome=Outcome.UNKNOWN)
    assert found(lost, read(1, 2, x=0), read(8, 9, x=1)) == []
    assert found(lost, read(1, 2, x=0), read(8, 9, x=0)) == []
    assert found(lost, read(1, 2, x=1), read(8, 9, x=0)) == ["stale"]


def test_a_write_without_a_reply_happens_in_all_its_blocks_at_once() -> None:
    lost = write(0, math.inf, Write(X, 1), Write(Y, 1), outcome=Outcome.UNKNOWN)
    assert found(lost, read(1, 2, x=1, y=1)) == []
    assert found(lost, read(1, 2, x=1, y=0)) == ["order"]


def test_two_readers_who_saw_two_writes_in_different_orders_are_found() -> None:
    writes = [write(0, 9, Write(X, 1)), write(0, 9, Write(Y, 1))]
    both = [read(0, 9, x=1, y=0), read(0, 9, x=0, y=1)]
    assert found(*writes, both[0]) == found(*writes, both[1]) == []
    assert found(*writes, *both) == ["order"]


def test_a_reader_of_a_half_of_a_write_is_found() -> None:
    whole = write(0, 9, Write(X, 1), Write(Y, 1))
    assert found(whole, read(0, 9, x=0, y=0), read(0, 9, x=1, y=1)) == []
    assert found(whole, read(0, 9, x=0, y=1)) == ["order"]


def test_every_mixture_of_two_writes_is_torn_or_of_a_write_that_nobody_did() -> None:
    chance = random.Random(3)
    for block in layout().blocks:
        if block.kind is not Kind.SHARED or block.count == 1:
            continue
        for first in (0, 1, 0xFFFF, 0x12345):
            one, other = block.encode(first), block.encode(first + 1)
            assert block.decode(tuple(one)) == first
            for _ in range(50):
                mixed = [chance.choice(pair) for pair in zip(one, other, strict=True)]
                if mixed not in (one, other):
                    assert block.decode(tuple(mixed)) not in range(max(first - 1, 0), first + 3)


def test_ids_begin_again_when_all_are_used_up_and_leave_out_what_may_still_come() -> None:
    ids = Ids([dataclasses.replace(X, count=1)])
    [block] = ids._next
    ids.taken.add((block, 2))
    drawn = [ids.draw(block) for _ in range(0xFFFF)]
    assert drawn[:2] == [1, 3]
    assert drawn[-2:] == [0xFFFF, 1]


@pytest.mark.parametrize("seed", range(3))
def test_histories_of_the_simulated_memory_have_every_kind_of_operation(seed: int) -> None:
    operations = SimulatedMemory(seed, 12, 60).history.operations
    names = {operation.name for operation in operations}
    expected = "own ingest pass modbus read cut_before cut_after exchange write"
    assert names == {name.replace("_", " ") for name in expected.split()}
    assert {operation.is_open for operation in operations} == {None, True, False}

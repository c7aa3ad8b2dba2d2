"""REST and readers at once: a batch is seen as a whole or not at all, also over two memories."""

from __future__ import annotations

import contextlib
import itertools
import json
import struct
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import holdfast
from support import web, wire
from support.cases import examples
from support.wire import rounds

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from support.running import Serve

SIZE = 40
BITS, REGISTERS = web.AREAS[:2], web.AREAS[2:]


@pytest.fixture
def memories() -> dict[str, holdfast.Memory]:
    return {
        name: holdfast.Memory(
            coils=SIZE, discrete_inputs=SIZE, holding_registers=SIZE, input_registers=SIZE
        )
        for name in ("plant_a", "plant_b")
    }


@pytest.fixture
def service(memories: dict[str, holdfast.Memory]) -> Iterator[web.Service]:
    made = web.Service(memories)
    with web.supervised(made.supervisor, made.listener):
        yield made


@pytest.fixture
def client(service: web.Service) -> Iterator[web.Client]:
    with contextlib.closing(web.Client(service.address)) as connected:
        yield connected


def content(memories: dict[str, holdfast.Memory]) -> dict[str, dict[str, list[int]]]:
    return {
        name: {area: memory.read(area, 0, SIZE) for area in memory.areas}
        for name, memory in memories.items()
    }


@st.composite
def commands(draw: st.DrawFn) -> dict[str, Any]:
    """A command that can be carried out."""
    area = draw(st.sampled_from(web.AREAS))
    item = st.integers(0, 65535) if area in REGISTERS else st.sampled_from([0, 1, True, False])
    values = draw(st.lists(item, min_size=1, max_size=12))
    address = draw(st.integers(0, SIZE - len(values)))
    return web.command(area, address, values, draw(st.sampled_from(["plant_a", "plant_b"])))


WRONG: list[Callable[[dict[str, Any]], dict[str, Any]]] = [
    lambda good: good | {"memory": "plant_z"},
    lambda good: good | {"memory": None},
    lambda good: good | {"area": "registers"},
    lambda good: good | {"address": SIZE},
    lambda good: good | {"address": -1},
    lambda good: good | {"address": 1.0},
    lambda good: good | {"address": SIZE - 1, "values": [1, 1]},
    lambda good: good | {"values": []},
    lambda good: good | {"values": None},
    lambda good: good | {"more": 1},
    lambda good: {key: value for key, value in good.items() if key != "address"},
]
BAD_VALUES = [65536, -1, 1.0, "1", None, [1], {}, 10**30]


@st.composite
def bad_batches(draw: st.DrawFn) -> tuple[list[dict[str, Any]], int]:
    """A batch with one command that can't be carried out, and its place."""
    batch = draw(st.lists(commands(), min_size=1, max_size=8))
    place = draw(st.integers(0, len(batch) - 1))
    good = batch[place]
    if draw(st.booleans()):
        values = list(good["values"])
        values[draw(st.integers(0, len(values) - 1))] = draw(st.sampled_from(BAD_VALUES))
        batch[place] = good | {"values": values}
    else:
        batch[place] = draw(st.sampled_from(WRONG))(good)
    return batch, place


random_requests = settings(
    max_examples=examples(150),
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)


@random_requests
@given(batch=st.lists(commands(), min_size=1, max_size=8), bad=bad_batches())
def test_a_refused_batch_changes_nothing(
    client: web.Client,
    memories: dict[str, holdfast.Memory],
    batch: list[dict[str, Any]],
    bad: tuple[list[dict[str, Any]], int],
) -> None:
    assert client.ingest(batch).status == 200
    before = content(memories)
    answer = client.ingest(bad[0])
    assert 400 <= answer.status < 500
    assert answer.json["status"] == "rejected"
    assert answer.json["command"] == bad[1]
    assert content(memories) == before


@random_requests
@given(batch=st.lists(commands(), min_size=1, max_size=8))
def test_an_accepted_batch_is_what_its_commands_are_one_by_one(
    client: web.Client, memories: dict[str, holdfast.Memory], batch: list[dict[str, Any]]
) -> None:
    expected = content(memories)
    for command in batch:
        begin, values = command["address"], [int(value) for value in command["values"]]
        expected[command["memory"]][command["area"]][begin : begin + len(values)] = values
    answer = client.ingest(batch)
    written = sum(len(command["values"]) for command in batch)
    assert answer.json == {"status": "accepted", "commands": len(batch), "written": written}
    assert content(memories) == expected


def whole_batch(value: int) -> list[dict[str, Any]]:
    """Every area of both memories, all values the same."""
    return [
        web.command(area, 0, [value if area in REGISTERS else value & 1] * SIZE, memory)
        for memory in ("plant_a", "plant_b")
        for area in web.AREAS
    ]


ALL: list[tuple[Any, int, int]] = [(area, 0, SIZE) for area in web.AREAS]


def seen_in(memory: holdfast.Memory) -> int:
    """The value that all of a memory has, and has to have."""
    parts = memory.read_many(ALL)
    registers = {value for part in parts[2:] for value in part}
    bits = {value for part in parts[:2] for value in part}
    assert len(registers) == 1
    assert bits == {value & 1 for value in registers}
    return registers.pop()


def test_readers_of_memory_never_see_a_part_of_a_batch(
    client: web.Client, memories: dict[str, holdfast.Memory]
) -> None:
    enough, over = threading.Event(), threading.Event()

    def watch(first: str, second: str) -> None:
        """What is seen in the first memory must be in the second already."""
        seen: set[int] = set()
        while not over.is_set():
            before = seen_in(memories[first])
            assert seen_in(memories[second]) >= before
            seen.add(before)
            if len(seen) >= 20:
                enough.set()

    with ThreadPoolExecutor(2) as threads:
        watching = [
            threads.submit(watch, "plant_a", "plant_b"),
            threads.submit(watch, "plant_b", "plant_a"),
        ]
        try:
            for number in rounds(enough, 200):
                assert client.ingest(whole_batch(number)).status == 200
                bad = whole_batch(number + 30_000)
                bad[-1]["values"] = [*bad[-1]["values"][:-1], 65536]
                assert client.ingest(bad).status == 400
        finally:
            over.set()
        for watcher in watching:
            watcher.result()


def test_clients_of_modbus_and_rest_never_see_a_part_of_a_batch(
    service: web.Service, memories: dict[str, holdfast.Memory], serve: Serve
) -> None:
    server = serve({1: memories["plant_a"]}, workers=2)
    enough, over = threading.Event(), threading.Event()
    read = struct.pack(">BHH", 3, 0, SIZE)
    query = f"{web.READ}?memory=plant_a&area=holding_registers&address=0&count={SIZE}"

    def write(offset: int) -> None:
        with contextlib.closing(web.Client(service.address)) as writer:
            for number in itertools.count():
                if over.is_set():
                    return
                assert writer.ingest(whole_batch(2 * number + offset & 0xFFFF)).status == 200

    with ThreadPoolExecutor(2) as threads:
        writing = [threads.submit(write, offset) for offset in (0, 1)]
        try:
            with (
                wire.Connection(server.address) as modbus,
                contextlib.closing(web.Client(service.address)) as rest,
            ):
                seen: set[int] = set()
                for _ in rounds(enough, 200):
                    values = struct.unpack(f">{SIZE}H", modbus.ask(read)[2:])
                    others = rest.get(query).json["values"]
                    assert len(set(values)) == len(set(others)) == 1
                    seen |= {values[0], others[0]}
                    if len(seen) >= 20:
                        enough.set()
        finally:
            over.set()
        for writer in writing:
            writer.result()


def test_writers_at_once_are_one_behind_the_other(
    service: web.Service, memories: dict[str, holdfast.Memory]
) -> None:
    def write(value: int) -> None:
        with contextlib.closing(web.Client(service.address)) as writer:
            for _ in range(50):
                assert writer.ingest(whole_batch(value)).status == 200

    with ThreadPoolExecutor(4) as threads:
        for done in [threads.submit(write, value) for value in (10, 11, 12, 13)]:
            done.result()
    assert seen_in(memories["plant_a"]) == seen_in(memories["plant_b"])
    counts = service.memory_access.counts()
    assert (counts["accepted"], counts["values"]) == (200, 200 * 8 * SIZE)


def test_a_client_that_goes_away_in_a_batch_leaves_nothing_of_it(
    service: web.Service, memories: dict[str, holdfast.Memory]
) -> None:
    body = json.dumps(whole_batch(7)).encode()
    before = content(memories)
    for length in range(1, len(body), 97):
        with wire.Connection(service.address) as connection:
            connection.send(web.post(body)[: -len(body) + length])
    wire.until(lambda: service.connections()["open"] == 0, "all connections closed")
    assert content(memories) == before

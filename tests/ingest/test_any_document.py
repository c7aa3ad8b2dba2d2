"""Whatever JSON or bytes a writer sends: all of it is written, or a refusal and nothing."""

from __future__ import annotations

import contextlib
import json
from typing import Any

from hypothesis import example, given, settings
from hypothesis import strategies as st

import holdfast
from holdfast.ingest import Grant, MemoryAccess, Refused, Written
from holdfast.types import AREAS
from support.cases import examples

GRANT = Grant("edge", ("plant", "other"), AREAS)
GOOD = {"memory": "plant", "area": "holding_registers", "address": 20, "values": [7]}

scalars = (
    st.none()
    | st.booleans()
    | st.integers(-2, 70000)
    | st.integers()
    | st.floats(allow_nan=False)
    | st.text(max_size=5)
    | st.sampled_from(["plant", "other", "hidden", *AREAS])
)
anything = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner),
    max_leaves=8,
)
values = st.lists(st.integers(0, 1) | st.integers(0, 65535) | scalars, max_size=6)
commands = st.fixed_dictionaries(
    {
        "memory": st.sampled_from(["plant", "other"]) | scalars,
        "area": st.sampled_from(AREAS) | scalars,
        "address": st.integers(0, 30) | scalars,
        "values": values | anything,
    },
    optional={"unit": anything},
) | st.just(GOOD)
documents = commands | st.lists(commands, max_size=4) | anything
bodies = documents.map(lambda document: json.dumps(document).encode()) | st.binary(max_size=60)


def content(memory: holdfast.Memory) -> dict[str, list[Any]]:
    return {area: list(memory.read(area, 10, 20)) for area in AREAS}


@settings(max_examples=examples(150))
@example(b"[" * 100_000)
@example(b'{"memory":' * 100_000)
@given(bodies)
def test_all_of_a_document_is_written_or_nothing(body: bytes) -> None:
    memories = {
        name: holdfast.Memory(
            coils=(10, 20),
            discrete_inputs=(10, 20),
            holding_registers=(10, 20),
            input_registers=(10, 20),
        )
        for name in ("plant", "other")
    }
    access = MemoryAccess("rest", memories)
    before = {name: content(memory) for name, memory in memories.items()}
    written: Written | None = None
    with contextlib.suppress(Refused):
        written = access.ingest(body, GRANT, "10.0.0.7:50000")
    if written is None:
        assert {name: content(memory) for name, memory in memories.items()} == before
        return
    document = json.loads(body)
    batch = document if type(document) is list else [document]
    assert written.values == sum(len(command["values"]) for command in batch)
    for command in batch:
        for place, value in enumerate(command["values"], command["address"]):
            before[command["memory"]][command["area"]][place - 10] = value
    assert {name: content(memory) for name, memory in memories.items()} == before

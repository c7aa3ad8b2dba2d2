"""The shared vectors over a real socket: each PDU is answered as they say, and memory holds after
it what they say and nothing else.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
import wire
from conftest import AREAS

if TYPE_CHECKING:
    from conftest import Connect, Serve
    from holdfast.types import Area

VECTORS = Path(__file__).parent / "vectors"


def cases(name: str) -> list[dict[str, Any]]:
    loaded: list[dict[str, Any]] = json.loads((VECTORS / name).read_text())["cases"]
    assert loaded
    return loaded


# This vector reads the most coils that a request can, more than the size the others have.
LARGER_SIZES = {"FC01 full request": 2000}


def overlay(areas: dict[Area, list[int]], changes: dict[Area, dict[str, list[int]]]) -> None:
    for area, runs in changes.items():
        for address, values in runs.items():
            start = int(address)
            areas[area][start : start + len(values)] = values


@pytest.mark.parametrize("case", cases("pdu.json"), ids=lambda case: case["name"])
def test_a_pdu_is_answered_and_leaves_memory_as_its_vector_says(
    case: dict[str, Any], serve: Serve, connect: Connect
) -> None:
    size = LARGER_SIZES.get(case["name"], 1000)
    memory = holdfast.Memory(
        coils=size, discrete_inputs=size, holding_registers=size, input_registers=size
    )
    client = connect(serve({1: memory}))
    expected = {area: [0] * size for area in AREAS}
    overlay(expected, case["setup"])
    for area in AREAS:
        memory.write(area, 0, expected[area])

    reply = client.ask(bytes.fromhex(case["request"]))

    assert reply.hex() == case["response"]
    overlay(expected, case["after"])
    assert {area: memory.read(area, 0, size) for area in AREAS} == expected


@pytest.mark.parametrize("case", cases("frames.json"), ids=lambda case: case["pdu"])
def test_the_header_of_a_vector_comes_back_with_the_reply(
    case: dict[str, Any], memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    request = bytes.fromhex(case["mbap"])
    function = bytes.fromhex(case["pdu"])[0]
    connection = connect(serve({case["unit"]: memory}))

    connection.send(request)
    reply = connection.receive()

    assert (reply.transaction, reply.unit) == (0x1A2B, case["unit"])
    assert reply.pdu[0] & 0x7F == function & 0x7F


@pytest.mark.parametrize("case", cases("frames.json"), ids=lambda case: case["pdu"])
def test_the_test_client_frames_as_the_vectors_do(case: dict[str, Any]) -> None:
    framed = wire.frame(bytes.fromhex(case["pdu"]), case["unit"], 0x1A2B)

    assert framed.hex() == case["mbap"]

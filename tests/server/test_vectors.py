"""The shared vectors over a real socket: each PDU is answered as they say, and memory holds after
it what they say and nothing else.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast.types import AREAS
from support import wire
from support.vectors import cases, overlay

if TYPE_CHECKING:
    from support.running import Connect, Serve


@pytest.mark.parametrize("case", cases("pdu.json"), ids=lambda case: case["name"])
def test_a_pdu_is_answered_and_leaves_memory_as_its_vector_says(
    case: dict[str, Any], serve: Serve, connect: Connect
) -> None:
    size = 1000
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

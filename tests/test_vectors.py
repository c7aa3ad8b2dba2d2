"""The shared vectors over a real socket: each PDU is answered as they say, and memory holds after
it what they say and nothing else.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import wire
from conftest import AREAS, content

if TYPE_CHECKING:
    import holdfast

VECTORS = Path(__file__).parent / "vectors"


def cases(name: str) -> list[dict[str, Any]]:
    loaded: list[dict[str, Any]] = json.loads((VECTORS / name).read_text())["cases"]
    assert loaded
    return loaded


def overlay(areas: dict[str, list[int]], changes: dict[str, dict[str, list[int]]]) -> None:
    for area, runs in changes.items():
        for address, values in runs.items():
            start = int(address)
            areas[area][start : start + len(values)] = values


@pytest.mark.parametrize("case", cases("pdu.json"), ids=lambda case: case["name"])
def test_a_pdu_is_answered_and_leaves_memory_as_its_vector_says(
    case: dict[str, Any], memory: holdfast.Memory, client: wire.Connection
) -> None:
    expected = {area: [0] * 1000 for area in AREAS}
    overlay(expected, case["setup"])
    for area, values in expected.items():
        memory.write(area, 0, values)

    reply = client.ask(bytes.fromhex(case["request"]))

    assert reply.hex() == case["response"]
    overlay(expected, case["after"])
    assert content(memory) == expected


@pytest.mark.parametrize("case", cases("frames.json"), ids=lambda case: case["pdu"])
def test_the_header_of_a_vector_comes_back_with_the_reply(
    case: dict[str, Any], memory: holdfast.Memory, serve: Any, connect: Any
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

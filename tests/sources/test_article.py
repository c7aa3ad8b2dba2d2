"""The PHP of the article about Modbus, as the bytes that it makes and the integers that it returns.

`pack` and the functions on arrays are written out here, statement by statement. The usage in the
article passes the length as a further argument; its constructor computes it.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Literal

import pytest

from holdfast.values import decode

if TYPE_CHECKING:
    import holdfast
    from support.running import Connect

WordOrder = Literal["normal", "reversed"]


def build_request(
    transaction_id: int, unit_id: int, function_code: int, start_address: int, quantity: int
) -> bytes:
    """`ModbusRequest::buildRequest`."""
    packet = struct.pack(">H", transaction_id)
    packet += struct.pack(">H", 0)
    length = 1 + 1 + 2 + 2
    packet += struct.pack(">H", length)
    packet += struct.pack("B", unit_id)
    packet += struct.pack("B", function_code)
    packet += struct.pack(">H", start_address)
    packet += struct.pack(">H", quantity)
    return packet


def fit(values: list[int], size: int) -> list[int]:
    """`array_pad($bytes, -size, 0)`, or `array_slice` of the last ones."""
    if len(values) < size:
        return [0] * (size - len(values)) + values
    return values[len(values) - size :]


def bytes_to_16_unsigned_integer(values: list[int]) -> int:
    values = fit(values, 2)
    return values[0] << 8 | values[1]


def bytes_to_32_unsigned_integer(values: list[int], word_order: WordOrder = "normal") -> int:
    values = fit(values, 4)
    if word_order == "reversed":
        values = [*values[2:], *values[:2]]
    return values[0] << 24 | values[1] << 16 | values[2] << 8 | values[3]


def test_the_request_is_answered(
    server: holdfast.Server, memory: holdfast.Memory, connect: Connect
) -> None:
    memory.write("holding_registers", 0, range(100, 110))
    request = build_request(1, 1, 3, 0, 10)
    assert request == bytes.fromhex("0001 0000 0006 01 03 0000 000A")
    client = connect(server)
    client.send(request)
    reply = client.receive()
    assert (reply.transaction, reply.unit) == (1, 1)
    assert reply.pdu[:2] == bytes([3, 20])
    data = list(reply.pdu[2:])
    pairs = [data[at : at + 2] for at in range(0, len(data), 2)]
    assert [bytes_to_16_unsigned_integer(pair) for pair in pairs] == list(range(100, 110))
    assert decode(bytes(data), "uint16[10]") == list(range(100, 110))


@pytest.mark.parametrize(
    ("given", "expected"), [([0x12, 0x34], 0x1234), ([0xFF, 0xFE], 0xFFFE), ([0, 0], 0)]
)
def test_two_bytes_are_the_same_integer(given: list[int], expected: int) -> None:
    assert bytes_to_16_unsigned_integer(given) == expected
    assert decode(bytes(given), "uint16") == expected


@pytest.mark.parametrize(
    ("word_order", "order", "expected"),
    [("normal", "ABCD", 0x01020304), ("reversed", "CDAB", 0x03040102)],
)
def test_four_bytes_are_the_same_integer_in_both_orders_of_words(
    word_order: WordOrder, order: Literal["ABCD", "CDAB"], expected: int
) -> None:
    given = [1, 2, 3, 4]
    assert bytes_to_32_unsigned_integer(given, word_order) == expected
    assert decode(bytes(given), "uint32", order) == expected


@pytest.mark.parametrize("length", [0, 1, 3, 5, 6])
def test_other_lengths_are_refused_unless_the_caller_pads_or_cuts_them(length: int) -> None:
    """`values.decode` never guesses; the expression of its page does what the article does."""
    given = bytes(range(1, length + 1))
    with pytest.raises(ValueError, match=str(length)):
        decode(given, "uint16")
    assert decode(given[-2:].rjust(2, b"\0"), "uint16") == bytes_to_16_unsigned_integer([*given])
    assert decode(given[-4:].rjust(4, b"\0"), "uint32") == bytes_to_32_unsigned_integer([*given])

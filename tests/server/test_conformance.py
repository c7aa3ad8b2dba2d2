"""The protocol as the standard draws it: limits, order of checks, exceptions, header.

One table holds the functions that take an address and a quantity; each line of the conformance
list is one test over that table. Every refusal is also checked to have changed nothing.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING

import pytest

import holdfast
from holdfast.types import AREAS
from support import wire
from support.server_model import pack_bits, pack_registers, unpack_bits, unpack_registers

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from typing import Literal, TypeAlias

    from holdfast.types import Area
    from support.running import Connect, Serve

    Refused: TypeAlias = Callable[[bytes], tuple[int, int]]

SIZE = 3000
FUNCTIONS = (1, 2, 3, 4, 5, 6, 8, 11, 15, 16, 17, 22, 23, 43)
UNKNOWN = [code for code in range(256) if code not in FUNCTIONS]
WRITES = (5, 6, 15, 16, 22, 23)

VALID = {
    1: "0100000001",
    2: "0200000001",
    3: "0300000001",
    4: "0400000001",
    5: "050000ff00",
    6: "060000abcd",
    8: "080000a537",
    11: "0b",
    15: "0f0000000a02ff03",
    16: "100000000204000a0102",
    17: "11",
    22: "16000000f20025",
    23: "170000000200000001020007",
    43: "2b0e0100",
}


def read(code: int) -> Callable[[int, int], bytes]:
    return lambda address, quantity: struct.pack(">BHH", code, address, quantity)


def write_coils(address: int, quantity: int) -> bytes:
    data = (b"\xa5\x5a\x3c" * 90)[: min((quantity + 7) // 8, 247)]
    return struct.pack(">BHHB", 15, address, quantity, (quantity + 7) // 8 & 0xFF) + data


def write_registers(address: int, quantity: int) -> bytes:
    data = bytes(range(1, 248))[: min(quantity * 2, 247)]
    return struct.pack(">BHHB", 16, address, quantity, quantity * 2 & 0xFF) + data


def read_of_23(address: int, quantity: int) -> bytes:
    return struct.pack(">BHHHHBH", 23, address, quantity, 0, 1, 2, 0xBEEF)


def write_of_23(address: int, quantity: int) -> bytes:
    data = bytes(range(1, 244))[: min(quantity * 2, 243)]
    return struct.pack(">BHHHHB", 23, 0, 1, address, quantity, quantity * 2 & 0xFF) + data


@dataclass(frozen=True)
class Ranged:
    """A function, or one half of function 23, that takes an address and a quantity."""

    name: str
    area: Area
    most: int
    request: Callable[[int, int], bytes]
    writes: bool = False

    @property
    def bits(self) -> bool:
        return self.area in ("coils", "discrete_inputs")

    def __str__(self) -> str:
        return self.name


READS = [
    Ranged("FC01", "coils", 2000, read(1)),
    Ranged("FC02", "discrete_inputs", 2000, read(2)),
    Ranged("FC03", "holding_registers", 125, read(3)),
    Ranged("FC04", "input_registers", 125, read(4)),
    Ranged("FC23 read", "holding_registers", 125, read_of_23),
]
RANGED = [
    *READS,
    Ranged("FC15", "coils", 1968, write_coils, writes=True),
    Ranged("FC16", "holding_registers", 123, write_registers, writes=True),
    Ranged("FC23 write", "holding_registers", 121, write_of_23, writes=True),
]
SINGLE = {
    "FC05": ("coils", lambda address: struct.pack(">BHH", 5, address, 0xFF00)),
    "FC06": ("holding_registers", lambda address: struct.pack(">BHH", 6, address, 0xABCD)),
    "FC22": ("holding_registers", lambda address: struct.pack(">BHHH", 22, address, 0, 0xABCD)),
}

each_ranged = pytest.mark.parametrize("function", RANGED, ids=str)
each_single = pytest.mark.parametrize(
    ("area", "request_for"), list(SINGLE.values()), ids=list(SINGLE)
)
each_valid = pytest.mark.parametrize(
    "valid",
    [bytes.fromhex(text) for text in VALID.values()],
    ids=[f"FC{code:02}" for code in VALID],
)


def patterned(size: int) -> holdfast.Memory:
    """A memory in which neighbours differ, so that a value from a wrong address is seen."""
    memory = holdfast.Memory(
        coils=size, discrete_inputs=size, holding_registers=size, input_registers=size
    )
    memory.write("coils", 0, [address * address // 3 & 1 for address in range(size)])
    memory.write("discrete_inputs", 0, [address * address // 5 & 1 for address in range(size)])
    memory.write("holding_registers", 0, [address * 31 + 7 & 0xFFFF for address in range(size)])
    memory.write("input_registers", 0, [address * 37 + 5 & 0xFFFF for address in range(size)])
    return memory


def everything(memory: holdfast.Memory) -> list[list[int]]:
    return memory.read_many([(area, 0, len(memory.areas[area])) for area in AREAS])


@pytest.fixture
def memory() -> holdfast.Memory:
    return patterned(SIZE)


@pytest.fixture
def refused(memory: holdfast.Memory, client: wire.Connection) -> Iterator[Refused]:
    """Asks what must be refused: function and exception code; nothing may have changed."""
    before = everything(memory)

    def ask(pdu: bytes) -> tuple[int, int]:
        reply = client.ask(pdu)
        assert len(reply) == 2, f"{pdu.hex()} was answered {reply.hex()}"
        return reply[0], reply[1]

    yield ask
    assert everything(memory) == before


def assert_served(
    function: Ranged, address: int, quantity: int, memory: holdfast.Memory, client: wire.Connection
) -> None:
    """The request is answered as it must be, and a write has done exactly what it says."""
    pdu = function.request(address, quantity)
    before = everything(memory)
    reply = client.ask(pdu)
    after = everything(memory)
    expected = [list(area) for area in before]
    written = expected[AREAS.index(function.area)]
    if function.name == "FC23 read":
        written[0] = 0xBEEF
    elif function.bits and function.writes:
        written[address : address + quantity] = unpack_bits(pdu[6:], quantity)
    elif function.writes:
        head = 6 if function.name == "FC16" else 10
        written[address : address + quantity] = unpack_registers(pdu[head:])
    assert after == expected
    if function.name == "FC23 write":
        assert reply == b"\x17\x02" + pack_registers(written[:1])
    elif function.writes:
        assert reply == pdu[:5]
    else:
        values = written[address : address + quantity]
        data = pack_bits(values) if function.bits else pack_registers(values)
        assert reply == bytes([pdu[0], len(data)]) + data


# Quantities


@each_ranged
def test_the_smallest_quantity_is_served(
    function: Ranged, memory: holdfast.Memory, client: wire.Connection
) -> None:
    assert_served(function, 11, 1, memory, client)


@each_ranged
def test_the_largest_quantity_is_served(
    function: Ranged, memory: holdfast.Memory, client: wire.Connection
) -> None:
    assert_served(function, 11, function.most, memory, client)


@each_ranged
@pytest.mark.parametrize("quantity", [7, 8, 9, 15, 16, 17, 120])
def test_quantities_around_whole_bytes_are_served(
    function: Ranged, quantity: int, memory: holdfast.Memory, client: wire.Connection
) -> None:
    assert_served(function, 13, quantity, memory, client)


@each_ranged
def test_quantity_0_is_an_illegal_value(function: Ranged, refused: Refused) -> None:
    pdu = function.request(0, 0)

    assert refused(pdu) == (pdu[0] | 0x80, 3)


@each_ranged
def test_one_more_than_the_largest_quantity_is_an_illegal_value(
    function: Ranged, refused: Refused
) -> None:
    pdu = function.request(0, function.most + 1)

    assert refused(pdu) == (pdu[0] | 0x80, 3)


@each_ranged
def test_quantity_65535_is_an_illegal_value(function: Ranged, refused: Refused) -> None:
    pdu = function.request(0, 65535)

    assert refused(pdu) == (pdu[0] | 0x80, 3)


@pytest.mark.parametrize("value", [0x0001, 0x00FF, 0xFF01, 0xFFFF, 0x1234])
def test_a_coil_takes_no_value_but_ff00_and_0000(value: int, refused: Refused) -> None:
    assert refused(struct.pack(">BHH", 5, 0, value)) == (0x85, 3)


# Addresses


@each_ranged
def test_address_0_is_served(
    function: Ranged, memory: holdfast.Memory, client: wire.Connection
) -> None:
    assert_served(function, 0, 10, memory, client)


@each_ranged
def test_the_last_address_is_served(
    function: Ranged, memory: holdfast.Memory, client: wire.Connection
) -> None:
    assert_served(function, SIZE - 1, 1, memory, client)


@each_ranged
def test_the_largest_quantity_that_ends_at_the_last_address_is_served(
    function: Ranged, memory: holdfast.Memory, client: wire.Connection
) -> None:
    assert_served(function, SIZE - function.most, function.most, memory, client)


@each_ranged
@pytest.mark.parametrize(
    ("address", "quantity"),
    [(SIZE, 1), (SIZE - 1, 2), (65535, 1), (65535, 2), (65534, 2)],
    ids=["behind the last", "last and one more", "65535", "65535 with 2", "65534 with 2"],
)
def test_an_address_outside_the_area_is_an_illegal_address(
    function: Ranged,
    address: int,
    quantity: int,
    refused: Refused,
) -> None:
    pdu = function.request(address, quantity)

    assert refused(pdu) == (pdu[0] | 0x80, 2)


@each_ranged
def test_the_largest_quantity_with_one_item_outside_is_an_illegal_address(
    function: Ranged, refused: Refused
) -> None:
    pdu = function.request(SIZE - function.most + 1, function.most)

    assert refused(pdu) == (pdu[0] | 0x80, 2)


@each_single
@pytest.mark.parametrize("address", [0, SIZE - 1])
def test_one_item_is_written_at_the_first_and_the_last_address(
    area: str,
    request_for: Callable[[int], bytes],
    address: int,
    memory: holdfast.Memory,
    client: wire.Connection,
) -> None:
    expected = everything(memory)
    expected[AREAS.index(area)][address] = 1 if area == "coils" else 0xABCD

    assert client.ask(request_for(address)) == request_for(address)
    assert everything(memory) == expected


@each_single
@pytest.mark.parametrize("address", [SIZE, 65535])
def test_one_item_outside_the_area_is_an_illegal_address(
    area: str,
    request_for: Callable[[int], bytes],
    address: int,
    refused: Refused,
) -> None:
    pdu = request_for(address)

    assert area in AREAS
    assert refused(pdu) == (pdu[0] | 0x80, 2)


@each_ranged
def test_start_and_quantity_may_make_65536_exactly(
    function: Ranged, serve: Serve, connect: Connect
) -> None:
    memory = patterned(65536)
    client = connect(serve({1: memory}))

    assert_served(function, 65536 - function.most, function.most, memory, client)
    assert_served(function, 65535, 1, memory, client)


@each_ranged
def test_start_and_quantity_beyond_65536_are_an_illegal_address_and_do_not_wrap(
    function: Ranged, serve: Serve, connect: Connect
) -> None:
    memory = patterned(65536)
    before = everything(memory)
    client = connect(serve({1: memory}))
    pdu = function.request(65535, 2)

    assert client.ask(pdu) == bytes([pdu[0] | 0x80, 2])
    assert everything(memory) == before


@each_ranged
def test_an_area_that_starts_elsewhere_has_its_own_first_and_last_address(
    function: Ranged, serve: Serve, connect: Connect
) -> None:
    memory = holdfast.Memory(
        coils=(100, 20),
        discrete_inputs=(100, 20),
        holding_registers=(100, 20),
        input_registers=(100, 20),
    )
    client = connect(serve({1: memory}))
    # The other half of function 23 stands at address 0, which is outside: the whole is refused.
    inside = 2 if function.name.startswith("FC23") else None
    codes = [
        reply[1] if reply[0] & 0x80 else None
        for reply in client.ask_many(
            [
                function.request(99, 1),
                function.request(100, 1),
                function.request(100, 20),
                function.request(119, 1),
                function.request(119, 2),
                function.request(120, 1),
            ]
        )
    ]

    assert codes == [2, inside, inside, inside, 2, 2]


@each_ranged
def test_an_area_that_does_not_exist_has_no_address(
    function: Ranged, serve: Serve, connect: Connect
) -> None:
    size = {area: None if area == function.area else 10 for area in AREAS}
    memory = holdfast.Memory(
        coils=size["coils"],
        discrete_inputs=size["discrete_inputs"],
        holding_registers=size["holding_registers"],
        input_registers=size["input_registers"],
    )
    pdu = function.request(0, 1)

    reply = connect(serve({1: memory})).ask(pdu)

    assert reply == bytes([pdu[0] | 0x80, 2])


# Order of checks


@each_ranged
@pytest.mark.parametrize("excess", ["none", "one more", "65535"])
def test_the_quantity_is_checked_before_the_address(
    function: Ranged, excess: str, refused: Refused
) -> None:
    quantity = {"none": 0, "one more": function.most + 1, "65535": 65535}[excess]
    pdu = function.request(65535, quantity)

    assert refused(pdu) == (pdu[0] | 0x80, 3)


def test_the_value_of_a_coil_is_checked_before_its_address(
    refused: Refused,
) -> None:
    assert refused(bytes.fromhex("05ffff1234")) == (0x85, 3)


def test_the_byte_count_is_checked_before_the_address(
    refused: Refused,
) -> None:
    assert refused(bytes.fromhex("10ffff000203000a01")) == (0x90, 3)


def test_the_form_is_checked_after_the_unit(client: wire.Connection) -> None:
    assert client.ask(bytes.fromhex("0300000000"), unit=2) == b"\x83\x0b"


def test_the_function_is_checked_before_the_unit(client: wire.Connection) -> None:
    assert client.ask(b"\x64", unit=2) == b"\xe4\x01"


def test_a_sub_function_is_checked_before_the_unit(client: wire.Connection) -> None:
    assert client.ask(bytes.fromhex("0800990000"), unit=2) == b"\x88\x01"


def test_a_mei_type_is_checked_before_the_unit(client: wire.Connection) -> None:
    assert client.ask(bytes.fromhex("2b0d0100"), unit=2) == b"\xab\x01"


@each_valid
def test_a_denied_function_is_answered_before_the_unit_is_looked_up(
    valid: bytes, memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    client = connect(serve({1: memory}, deny=[valid[0]]))
    refusal = bytes([valid[0] | 0x80, 1])

    assert client.ask(valid, unit=1) == refusal
    assert client.ask(valid, unit=2) == refusal


@each_valid
def test_a_function_that_is_not_on_the_list_is_denied(
    valid: bytes, memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    others = [code for code in FUNCTIONS if code != valid[0]]
    client = connect(serve({1: memory}, functions=others))

    assert client.ask(valid) == bytes([valid[0] | 0x80, 1])


@each_valid
def test_a_function_that_is_the_only_one_on_the_list_is_served(
    valid: bytes, memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    client = connect(serve({1: memory}, functions=[valid[0]]))

    assert client.ask(valid)[0] == valid[0]


@pytest.mark.parametrize("code", WRITES)
def test_a_write_to_a_read_only_unit_is_an_illegal_function(
    code: int, memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    before = everything(memory)
    client = connect(serve({1: memory}, access="read-only"))

    assert client.ask(bytes.fromhex(VALID[code])) == bytes([code | 0x80, 1])
    assert everything(memory) == before


@pytest.mark.parametrize("code", WRITES)
def test_a_malformed_write_to_a_read_only_unit_is_an_illegal_function(
    code: int, memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    client = connect(serve({1: memory}, access="read-only"))

    assert client.ask(bytes([code])) == bytes([code | 0x80, 1])


@pytest.mark.parametrize("code", [code for code in FUNCTIONS if code not in WRITES])
def test_all_that_is_no_write_is_served_by_a_read_only_unit(
    code: int, memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    client = connect(serve({1: memory}, access="read-only"))

    assert client.ask(bytes.fromhex(VALID[code]))[0] == code


# The seal


@each_valid
def test_a_sealed_unit_answers_every_function_with_busy(
    valid: bytes, serve: Serve, connect: Connect
) -> None:
    memory = holdfast.Memory(
        coils=10,
        discrete_inputs=10,
        holding_registers=10,
        input_registers=10,
        seal=("discrete_inputs", 5),
    )
    before = everything(memory)
    client = connect(serve({1: memory}))

    assert client.ask(valid) == bytes([valid[0] | 0x80, 6])
    assert everything(memory) == before


def gated(mode: Literal["once", "level"]) -> holdfast.Memory:
    """A sealed memory whose gate bit is coil 0."""
    return holdfast.Memory(
        coils=10,
        discrete_inputs=10,
        holding_registers=10,
        input_registers=10,
        seal=("coils", 0, mode),
    )


@pytest.fixture
def sealed(serve: Serve, connect: Connect) -> wire.Connection:
    """A connection to a unit that is sealed."""
    return connect(serve({1: gated("once")}))


@each_ranged
def test_the_quantity_is_checked_before_the_seal(function: Ranged, sealed: wire.Connection) -> None:
    pdu = function.request(0, 0)

    assert sealed.ask(pdu) == bytes([pdu[0] | 0x80, 3])


@each_ranged
def test_the_seal_is_checked_before_the_address(function: Ranged, sealed: wire.Connection) -> None:
    pdu = function.request(65535, 1)

    assert sealed.ask(pdu) == bytes([pdu[0] | 0x80, 6])


@each_single
def test_the_seal_is_checked_before_the_address_of_one_item(
    area: str, request_for: Callable[[int], bytes], sealed: wire.Connection
) -> None:
    pdu = request_for(65535)

    assert area in AREAS
    assert sealed.ask(pdu) == bytes([pdu[0] | 0x80, 6])


def test_the_function_is_checked_before_the_seal(sealed: wire.Connection) -> None:
    assert sealed.ask(b"\x63") == b"\xe3\x01"


@pytest.mark.parametrize("text", ["050000ff00", "0f0000000a02ff03"], ids=["single", "among others"])
def test_the_gate_bit_is_an_illegal_address_for_a_write(
    text: str, serve: Serve, connect: Connect
) -> None:
    memory = gated("once")
    memory.write("coils", 0, [1])
    before = everything(memory)
    pdu = bytes.fromhex(text)

    assert connect(serve({1: memory})).ask(pdu) == bytes([pdu[0] | 0x80, 2])
    assert everything(memory) == before


def test_a_neighbour_of_the_gate_bit_is_written(serve: Serve, connect: Connect) -> None:
    memory = gated("once")
    memory.write("coils", 0, [1])

    assert connect(serve({1: memory})).ask(bytes.fromhex("050001ff00"))[0] == 5
    assert memory.read("coils", 0, 3) == [1, 1, 0]


def test_a_gate_that_follows_the_level_seals_again_for_clients(
    serve: Serve, connect: Connect
) -> None:
    memory = gated("level")
    client = connect(serve({1: memory}))
    replies = []
    for bit in (0, 1, 0):
        memory.write("coils", 0, [bit])
        replies.append(client.ask(bytes.fromhex("0300000001")).hex())

    assert replies == ["8306", "03020000", "8306"]


# Byte counts


COUNTED = {
    "FC15": (5, write_coils(3, 10)),
    "FC15 whole byte": (5, write_coils(3, 16)),
    "FC16": (5, write_registers(3, 2)),
    "FC23": (9, write_of_23(3, 2)),
}
each_counted = pytest.mark.parametrize(("place", "pdu"), COUNTED.values(), ids=COUNTED)


@each_counted
@pytest.mark.parametrize("difference", [1, -1, "to 0", "to 255"])
def test_a_byte_count_that_lies_is_an_illegal_value(
    place: int,
    pdu: bytes,
    difference: int | str,
    refused: Refused,
) -> None:
    told = {"to 0": 0, "to 255": 255}.get(str(difference))
    count = told if told is not None else pdu[place] + int(difference)
    lie = pdu[:place] + bytes([count]) + pdu[place + 1 :]

    assert refused(lie) == (pdu[0] | 0x80, 3)


@each_counted
@pytest.mark.parametrize("difference", [1, -1, 2, -2])
def test_a_byte_count_that_fits_the_data_but_not_the_quantity_is_an_illegal_value(
    place: int, pdu: bytes, difference: int, refused: Refused
) -> None:
    data = (pdu[place + 1 :] + bytes(2))[: pdu[place] + difference]
    wrong = pdu[:place] + bytes([len(data)]) + data

    assert refused(wrong) == (pdu[0] | 0x80, 3)


@each_counted
def test_no_data_at_all_is_an_illegal_value(place: int, pdu: bytes, refused: Refused) -> None:
    assert refused(pdu[:place] + b"\x00") == (pdu[0] | 0x80, 3)


def test_bits_behind_the_last_coil_of_a_write_are_ignored(
    memory: holdfast.Memory, client: wire.Connection
) -> None:
    memory.write("coils", 0, [0] * 16)

    assert client.ask(bytes.fromhex("0f0000000301ff")) == bytes.fromhex("0f00000003")
    assert memory.read("coils", 0, 16) == [1, 1, 1] + [0] * 13


# Length of the PDU


@each_valid
def test_every_short_pdu_is_an_illegal_value(valid: bytes, refused: Refused) -> None:
    shorter = [valid[:end] for end in range(1, len(valid))]

    assert [refused(pdu) for pdu in shorter] == [(valid[0] | 0x80, 3)] * len(shorter)


@each_valid
@pytest.mark.parametrize("more", [1, 3, 101])
def test_every_long_pdu_is_an_illegal_value(valid: bytes, more: int, refused: Refused) -> None:
    assert refused(valid + bytes(more)) == (valid[0] | 0x80, 3)


@each_valid
def test_a_pdu_of_the_largest_size_is_an_illegal_value(valid: bytes, refused: Refused) -> None:
    odd_data = valid[0] == 8  # 250 bytes of data are whole words, which are echoed
    longest = (valid + bytes(253))[: 252 if odd_data else 253]

    assert refused(longest) == (valid[0] | 0x80, 3)


def test_the_longest_query_data_comes_back(client: wire.Connection) -> None:
    longest = b"\x08\x00\x00" + bytes(range(250))

    assert client.ask(longest) == longest


# Unknown functions


@pytest.mark.parametrize("code", UNKNOWN, ids=lambda code: f"{code:#04x}")
@pytest.mark.parametrize("data", [b"", bytes(4)], ids=["alone", "with data"])
def test_an_unknown_function_is_an_illegal_function(
    code: int, data: bytes, refused: Refused
) -> None:
    assert refused(bytes([code]) + data) == (code | 0x80, 1)


@pytest.mark.parametrize("sub_function", [5, 9, 0x13, 0x15, 0xFF, 0x100, 0xFFFF])
def test_an_unknown_sub_function_is_an_illegal_function(
    sub_function: int, refused: Refused
) -> None:
    assert refused(struct.pack(">BHH", 8, sub_function, 0)) == (0x88, 1)


@pytest.mark.parametrize("mei_type", [0, 0x0D, 0x0F, 0xFF])
def test_an_unknown_mei_type_is_an_illegal_function(mei_type: int, refused: Refused) -> None:
    assert refused(bytes([0x2B, mei_type, 1, 0])) == (0xAB, 1)


# Units


@pytest.mark.parametrize("unit", [0, 1, 17, 247, 255])
def test_a_mapped_unit_is_served_whatever_its_number(
    unit: int, memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    memory.write("holding_registers", 0, [0x1234])
    client = connect(serve({unit: memory}))

    assert client.ask(bytes.fromhex("0300000001"), unit=unit) == bytes.fromhex("03021234")


@pytest.mark.parametrize("unit", [0, 2, 247, 248, 255])
@each_valid
def test_an_unmapped_unit_fails_to_respond(
    unit: int, valid: bytes, client: wire.Connection, memory: holdfast.Memory
) -> None:
    before = everything(memory)

    assert client.ask(valid, unit=unit) == bytes([valid[0] | 0x80, 0x0B])
    assert everything(memory) == before


def test_each_unit_has_its_own_memory(serve: Serve, connect: Connect) -> None:
    memories = {unit: holdfast.Memory(holding_registers=1) for unit in range(256)}
    for unit, memory in memories.items():
        memory.write("holding_registers", 0, [unit * 3])
    client = connect(serve(memories))

    replies = [client.ask(bytes.fromhex("0300000001"), unit=unit) for unit in range(256)]

    assert replies == [struct.pack(">BBH", 3, 2, unit * 3) for unit in range(256)]


def test_two_units_may_share_one_memory(serve: Serve, connect: Connect) -> None:
    memory = holdfast.Memory(holding_registers=1)
    client = connect(serve({1: memory, 2: memory}))

    client.ask(bytes.fromhex("0600001234"), unit=1)

    assert client.ask(bytes.fromhex("0300000001"), unit=2) == bytes.fromhex("03021234")


# The header


@pytest.mark.parametrize("transaction", [0, 1, 0x00FF, 0x1A2B, 0xFFFF])
def test_the_transaction_id_comes_back(transaction: int, client: wire.Connection) -> None:
    client.send(wire.frame(bytes.fromhex("0300000001"), 1, transaction))

    assert client.receive().transaction == transaction


@pytest.mark.parametrize("protocol", [1, 0x0100, 0xFFFF])
def test_a_foreign_protocol_is_discarded_and_the_next_frame_is_served(
    protocol: int, memory: holdfast.Memory, client: wire.Connection
) -> None:
    before = everything(memory)
    foreign = wire.frame(bytes.fromhex("0600001234"), 1, 7, protocol=protocol)
    client.send(foreign + wire.frame(bytes.fromhex("0300000001"), 1, 8))

    assert client.receive().transaction == 8
    assert everything(memory) == before


@pytest.mark.parametrize("length", [0, 1, 255, 300, 65535])
def test_a_length_that_no_frame_has_ends_the_connection_without_a_reply(
    length: int, memory: holdfast.Memory, client: wire.Connection
) -> None:
    before = everything(memory)
    client.send(wire.frame(bytes.fromhex("0600001234"), length=length))

    assert client.rest() == b""
    assert everything(memory) == before


@pytest.mark.parametrize("length", [0, 1, 255, 65535])
def test_an_impossible_length_ends_the_connection_under_a_foreign_protocol_too(
    length: int, client: wire.Connection
) -> None:
    client.send(wire.frame(b"\x03", protocol=1, length=length))

    assert client.rest() == b""


def test_frames_before_an_impossible_length_are_answered(client: wire.Connection) -> None:
    good = wire.frame(bytes.fromhex("0300000001"), 1, 5)
    client.send(good + bytes.fromhex("000600000000"))

    frames, left = wire.split(client.rest())

    assert [frame.transaction for frame in frames] == [5]
    assert left == b""


def test_frames_behind_an_impossible_length_are_not_carried_out(
    memory: holdfast.Memory, client: wire.Connection
) -> None:
    before = everything(memory)
    client.send(bytes.fromhex("000600000000") + wire.frame(bytes.fromhex("0600001234")))

    assert client.rest() == b""
    assert everything(memory) == before


def test_the_shortest_frame_is_one_function_code(client: wire.Connection) -> None:
    client.send(wire.frame(b"\x0b", length=2))

    assert client.receive().pdu[0] == 0x0B


# Bits


@pytest.mark.parametrize("function", [read for read in READS if read.bits], ids=str)
@pytest.mark.parametrize("quantity", range(1, 18))
def test_unused_bits_of_the_last_byte_are_zero(
    function: Ranged, quantity: int, serve: Serve, connect: Connect
) -> None:
    memory = holdfast.Memory(coils=40, discrete_inputs=40)
    memory.write(function.area, 0, [1] * 40)
    client = connect(serve({1: memory}))

    for address in range(9):
        data = client.ask(function.request(address, quantity))[2:]
        assert int.from_bytes(data, "little") == (1 << quantity) - 1


# Effects of single functions


@pytest.mark.parametrize(
    ("now", "and_mask", "or_mask"),
    [
        (0x0012, 0x00F2, 0x0025),
        (0xFFFF, 0x0000, 0x0000),
        (0x1234, 0xFFFF, 0xFFFF),
        (0x1234, 0x0000, 0xABCD),
        (0x5A5A, 0xFF00, 0x0FF0),
    ],
)
def test_a_mask_write_takes_from_now_where_the_mask_is_1_and_from_or_where_it_is_0(
    now: int, and_mask: int, or_mask: int, memory: holdfast.Memory, client: wire.Connection
) -> None:
    memory.write("holding_registers", 4, [now])
    pdu = struct.pack(">BHHH", 22, 4, and_mask, or_mask)
    bits = [(now if and_mask >> bit & 1 else or_mask) >> bit & 1 for bit in range(16)]

    assert client.ask(pdu) == pdu
    assert memory.read("holding_registers", 4, 1) == [sum(bit << n for n, bit in enumerate(bits))]


def test_a_read_write_writes_before_it_reads(
    memory: holdfast.Memory, client: wire.Connection
) -> None:
    memory.write("holding_registers", 0, [1, 2, 3, 4])

    reply = client.ask(bytes.fromhex("1700000004000100020477778888"))

    assert reply == bytes.fromhex("17080001777788880004")


def test_a_read_write_whose_read_is_outside_writes_nothing(
    refused: Refused,
) -> None:
    assert refused(struct.pack(">BHHHHBH", 23, SIZE, 1, 0, 1, 2, 0xBEEF)) == (0x97, 2)


def test_a_read_write_whose_write_is_outside_reads_nothing(
    refused: Refused,
) -> None:
    assert refused(struct.pack(">BHHHHBH", 23, 0, 1, SIZE, 1, 2, 0xBEEF)) == (0x97, 2)


def test_the_longest_read_and_the_longest_write_fit_one_read_write(
    client: wire.Connection,
) -> None:
    values = [0xF000 + index for index in range(121)]
    head = struct.pack(">BHHHHB", 23, 0, 125, 2, 121, 242)

    reply = client.ask(head + pack_registers(values))

    assert len(reply) == 252
    assert unpack_registers(reply[2:])[2:123] == values

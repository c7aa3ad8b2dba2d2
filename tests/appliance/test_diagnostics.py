"""What a server says of itself: diagnostics (function 8), the event counter (11), its id (17) and
its identification (43/14).
"""

from __future__ import annotations

import re
import struct
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast.server import Identity

if TYPE_CHECKING:
    from support import wire
    from support.running import Connect, Serve

READ = bytes.fromhex("0300000001")
OUTSIDE = bytes.fromhex("0300ff0100")
MISSING_ADDRESS = bytes.fromhex("03ffff0001")
RESTART = bytes.fromhex("0800010000")
LISTEN_ONLY = bytes.fromhex("0800040000")
CLEAR = bytes.fromhex("08000a0000")


def count(client: wire.Connection, sub_function: int, unit: int = 1) -> int:
    """A counter of function 8."""
    reply = client.ask(struct.pack(">BHH", 8, sub_function, 0), unit)
    code, echoed, counted = struct.unpack(">BHH", reply)
    assert (code, echoed) == (8, sub_function)
    return int(counted)


def events(client: wire.Connection) -> tuple[int, int]:
    """Status and event count of function 11."""
    code, status, counted = struct.unpack(">BHH", client.ask(b"\x0b"))
    assert code == 11
    return status, counted


def framed(pdu: bytes, unit: int = 1) -> bytes:
    return struct.pack(">HHHB", 0, 0, len(pdu) + 1, unit) + pdu


def listen_only(unit: int = 1) -> bytes:
    return framed(LISTEN_ONLY, unit)


# Function 8


@pytest.mark.parametrize("words", [1, 2, 3, 124, 125])
def test_query_data_comes_back_as_it_was(words: int, client: wire.Connection) -> None:
    pdu = b"\x08\x00\x00" + bytes(range(words * 2))

    assert client.ask(pdu) == pdu


@pytest.mark.parametrize("length", [0, 1, 3, 249])
def test_query_data_of_no_whole_words_is_an_illegal_value(
    length: int, client: wire.Connection
) -> None:
    assert client.ask(b"\x08\x00\x00" + bytes(length)) == b"\x88\x03"


@pytest.mark.parametrize("text", ["0800010000", "080001ff00"])
def test_a_restart_is_answered_with_itself(text: str, client: wire.Connection) -> None:
    assert client.ask(bytes.fromhex(text)).hex() == text


@pytest.mark.parametrize("data", ["0001", "ff01", "00ff", "ffff", "0100"])
def test_a_restart_with_other_data_is_an_illegal_value(data: str, client: wire.Connection) -> None:
    assert client.ask(bytes.fromhex("080001" + data)) == b"\x88\x03"


@pytest.mark.parametrize("sub_function", [2, *range(0x0A, 0x13), 0x14])
@pytest.mark.parametrize("data", ["0001", "ff00", "", "00", "000000", "00000000"])
def test_other_sub_functions_take_0000_only(
    sub_function: int, data: str, client: wire.Connection
) -> None:
    pdu = struct.pack(">BH", 8, sub_function) + bytes.fromhex(data)

    assert client.ask(pdu) == b"\x88\x03"


def test_the_diagnostic_register_is_told(client: wire.Connection) -> None:
    assert count(client, 0x02) == 0


@pytest.mark.parametrize("sub_function", [0x0A, 0x14])
def test_a_clear_is_answered_with_itself(sub_function: int, client: wire.Connection) -> None:
    pdu = struct.pack(">BHH", 8, sub_function, 0)

    assert client.ask(pdu) == pdu


@pytest.mark.parametrize("sub_function", [0x0B, 0x0E], ids=["bus", "server"])
def test_every_request_is_a_message(sub_function: int, client: wire.Connection) -> None:
    before = count(client, sub_function)
    client.ask_many([READ] * 5)

    assert count(client, sub_function) == before + 6


def test_every_exception_is_counted(client: wire.Connection) -> None:
    before = count(client, 0x0D)
    client.ask_many([OUTSIDE, MISSING_ADDRESS, READ, b"\x63"])

    assert count(client, 0x0D) == before + 3


def test_a_frame_of_a_foreign_protocol_is_a_communication_error(client: wire.Connection) -> None:
    before = count(client, 0x0C)
    client.send(bytes.fromhex("0001000100060103000000010000"[:24]))

    assert count(client, 0x0C) == before + 1


def test_a_busy_reply_is_counted(serve: Serve, connect: Connect) -> None:
    memory = holdfast.Memory(coils=1, holding_registers=1, seal=("coils", 0))
    client = connect(serve({1: memory}))
    for _ in range(3):
        assert client.ask(READ) == b"\x83\x06"
    memory.write("coils", 0, [1])

    assert count(client, 0x11) == 3


def test_requests_without_a_reply_are_counted(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    client = connect(serve({1: memory, 2: memory}, listen_only=True))
    client.send(listen_only(1) + framed(READ, 1) * 3)

    # Three reads, and the request that silenced the unit.
    assert count(client, 0x0F, unit=2) == 4


@pytest.mark.parametrize("sub_function", [0x10, 0x12], ids=["NAK", "overrun"])
def test_what_does_not_happen_over_tcp_is_counted_0(
    sub_function: int, client: wire.Connection
) -> None:
    client.ask_many([OUTSIDE] * 3)

    assert count(client, sub_function) == 0


@pytest.mark.parametrize("reset", [CLEAR, RESTART], ids=["clear", "restart"])
def test_the_counters_start_again_at_0(reset: bytes, client: wire.Connection) -> None:
    client.ask_many([READ, OUTSIDE, READ, OUTSIDE])
    assert client.ask(reset) == reset

    # At most the reset itself and the request that asks are counted.
    assert count(client, 0x0D) == 0
    assert count(client, 0x0B) <= 3
    assert events(client)[1] <= 4


def test_the_counters_are_those_of_the_listener(server: holdfast.Server, connect: Connect) -> None:
    one, other = connect(server), connect(server)
    before = count(one, 0x0E)
    other.ask_many([READ] * 7)

    assert count(one, 0x0E) == before + 8


def test_a_clear_leaves_the_counters_of_python_alone(
    server: holdfast.Server, client: wire.Connection
) -> None:
    client.ask_many([READ, READ, OUTSIDE, CLEAR])

    counters = server.counters()
    assert counters["requests"] == {3: 3, 8: 1}
    assert counters["exceptions"] == {3: 1}


@pytest.mark.parametrize("sub_function", [1, 4, 0x0A, 0x14])
def test_a_read_only_peer_changes_no_state(
    sub_function: int, memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    client = connect(serve({1: memory}, access="read-only"))

    assert client.ask(struct.pack(">BHH", 8, sub_function, 0)) == b"\x88\x01"


@pytest.mark.parametrize("sub_function", [1, 4, 0x0A, 0x14])
def test_a_read_only_peer_is_denied_before_the_form_is_judged(
    sub_function: int, memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    client = connect(serve({1: memory}, access="read-only"))

    assert client.ask(struct.pack(">BHH", 8, sub_function, 0xFFFF)) == b"\x88\x01"


# Listen only mode


@pytest.fixture
def two_units(memory: holdfast.Memory, serve: Serve) -> holdfast.Server:
    return serve({1: memory, 2: memory}, listen_only=True)


@pytest.mark.parametrize("data", ["0000", "0001", "", "000000"])
@pytest.mark.parametrize("unit", [1, 9])
def test_listen_only_mode_is_an_illegal_function_by_default(
    data: str, unit: int, server: holdfast.Server, client: wire.Connection
) -> None:
    assert client.ask(bytes.fromhex("080004" + data), unit) == b"\x88\x01"

    assert client.ask(READ) == bytes.fromhex("03020000")
    assert client.ask(RESTART) == RESTART
    assert server.counters()["connections"]["refused_listen_only"] == 1
    assert server.counters()["exceptions"] == {1: 1}


@pytest.mark.parametrize("data", ["0001", "ff00", "", "00", "000000", "00000000"])
def test_listen_only_mode_takes_0000_only(
    data: str, two_units: holdfast.Server, connect: Connect
) -> None:
    assert connect(two_units).ask(bytes.fromhex("080004" + data)) == b"\x88\x03"


def test_listen_only_mode_is_entered_without_a_reply(
    two_units: holdfast.Server, connect: Connect
) -> None:
    client = connect(two_units)
    client.send(listen_only(1))

    # The first reply is that to the next request, from the other unit.
    assert client.ask(READ, unit=2) == bytes.fromhex("03020000")


@pytest.mark.parametrize(
    "text",
    [
        "0300000001",
        "0600001234",
        "0300000000",
        "03ffff0001",
        "080000a537",
        "0800040000",
        "08000a0000",
        "0b",
        "11",
        "2b0e0100",
        # Refused before the unit id is looked at.
        "63",
        "0800050000",
        "2b0d0100",
    ],
)
def test_a_unit_in_listen_only_mode_is_silent_and_changes_nothing(
    text: str, memory: holdfast.Memory, two_units: holdfast.Server, connect: Connect
) -> None:
    client = connect(two_units)
    client.send(listen_only(1) + framed(bytes.fromhex(text), 1))

    assert client.ask(READ, unit=2) == bytes.fromhex("03020000")
    assert memory.read("holding_registers", 0, 1) == [0]


def test_listen_only_mode_holds_for_every_connection_of_the_listener(
    two_units: holdfast.Server, connect: Connect
) -> None:
    one, other = connect(two_units), connect(two_units)
    one.send(listen_only(1))
    one.ask(READ, unit=2)
    other.send(framed(READ, 1))

    assert other.ask(READ, unit=2) == bytes.fromhex("03020000")


def test_a_restart_ends_listen_only_mode_without_a_reply(
    two_units: holdfast.Server, connect: Connect
) -> None:
    client = connect(two_units)
    client.send(listen_only(1) + framed(RESTART, 1))

    assert client.ask(READ, unit=1) == bytes.fromhex("03020000")


def test_a_restart_of_another_unit_does_not_end_listen_only_mode(
    two_units: holdfast.Server, connect: Connect
) -> None:
    client = connect(two_units)
    client.send(listen_only(1))
    assert client.ask(RESTART, unit=2) == RESTART
    client.send(framed(READ, 1))

    assert client.ask(READ, unit=2) == bytes.fromhex("03020000")


def test_listen_only_mode_ends_with_its_listener(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    silenced, other = (serve({1: memory}, listen_only=True) for _ in range(2))
    connect(silenced).send(listen_only(1))

    assert connect(other).ask(READ) == bytes.fromhex("03020000")


# Function 11


def test_the_event_counter_is_ready(client: wire.Connection) -> None:
    status, _ = events(client)

    assert status == 0


def test_each_request_that_was_carried_out_is_an_event(client: wire.Connection) -> None:
    _, before = events(client)
    client.ask_many([READ] * 3 + [bytes.fromhex("0600001234")])

    assert events(client)[1] == before + 4


def test_exceptions_and_the_event_counter_itself_are_no_events(client: wire.Connection) -> None:
    _, before = events(client)
    client.ask_many([OUTSIDE, MISSING_ADDRESS, b"\x63", b"\x0b", b"\x0b"])

    assert events(client)[1] == before


# Function 17


def test_the_server_id_is_counted_and_says_that_it_runs(client: wire.Connection) -> None:
    reply = client.ask(b"\x11")

    assert reply[0] == 0x11
    assert reply[1] == len(reply) - 2
    assert reply[3] == 0xFF


def test_the_server_id_carries_a_text(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    identity = Identity(vendor_name="Acme", product_code="P1", unit_names={2: "Boiler"})
    client = connect(serve({1: memory, 2: memory}, identity=identity))

    assert b"Acme" in client.ask(b"\x11", unit=1)[4:]
    assert client.ask(b"\x11", unit=2)[4:] == b"Boiler"


def test_the_longest_texts_fit_a_server_id(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    identity = Identity(vendor_name="V" * 244, product_code="P" * 244, revision="R" * 244)
    reply = connect(serve({1: memory}, identity=identity)).ask(b"\x11")

    assert len(reply) <= 253
    assert reply[1] == len(reply) - 2


# Function 43/14


IDENTITY = Identity(
    vendor_name="Acme",
    product_code="P1",
    revision="1.2",
    vendor_url="https://acme.example",
    product_name="Pump",
    model_name="Model 3",
    user_application_name="Hall 4",
    private_objects={0x80: "eighty", 0xFF: "last"},
)
BASIC = [(0, b"Acme"), (1, b"P1"), (2, b"1.2")]
REGULAR = [
    *BASIC,
    (3, b"https://acme.example"),
    (4, b"Pump"),
    (5, b"Model 3"),
    (6, b"Hall 4"),
]
EXTENDED = [*REGULAR, (0x80, b"eighty"), (0xFF, b"last")]


@pytest.fixture
def named(memory: holdfast.Memory, serve: Serve, connect: Connect) -> wire.Connection:
    return connect(serve({1: memory}, identity=IDENTITY))


def identification(
    client: wire.Connection, read_code: int, object_id: int, unit: int = 1
) -> tuple[tuple[int, int], list[tuple[int, bytes]]]:
    """More follows and next object id, and the objects."""
    reply = client.ask(bytes([0x2B, 0x0E, read_code, object_id]), unit)
    assert reply[:4] == bytes([0x2B, 0x0E, read_code, 0x83]), reply.hex()
    more, following, number = reply[4:7]
    objects, at = [], 7
    for _ in range(number):
        object_id, length = reply[at : at + 2]
        objects.append((object_id, reply[at + 2 : at + 2 + length]))
        at += 2 + length
    assert at == len(reply), "objects and length of the reply do not agree"
    return (more, following), objects


@pytest.mark.parametrize(
    ("read_code", "objects"),
    [(1, BASIC), (2, REGULAR), (3, EXTENDED)],
    ids=["basic", "regular", "extended"],
)
def test_a_stream_holds_the_objects_of_its_category(
    read_code: int, objects: list[tuple[int, bytes]], named: wire.Connection
) -> None:
    assert identification(named, read_code, 0) == ((0, 0), objects)


@pytest.mark.parametrize(
    ("read_code", "start", "objects"),
    [(1, 1, BASIC[1:]), (2, 5, REGULAR[5:]), (3, 0x80, EXTENDED[7:]), (3, 0xFF, EXTENDED[8:])],
)
def test_a_stream_starts_at_the_object_that_is_named(
    read_code: int, start: int, objects: list[tuple[int, bytes]], named: wire.Connection
) -> None:
    assert identification(named, read_code, start) == ((0, 0), objects)


@pytest.mark.parametrize(
    ("read_code", "start", "objects"),
    [
        (1, 3, BASIC),
        (1, 0x7F, BASIC),
        (2, 7, REGULAR),
        (2, 0x80, REGULAR),
        (3, 0x81, EXTENDED),
        (3, 0x7F, EXTENDED),
    ],
)
def test_a_stream_from_an_unknown_object_starts_at_the_first(
    read_code: int, start: int, objects: list[tuple[int, bytes]], named: wire.Connection
) -> None:
    assert identification(named, read_code, start) == ((0, 0), objects)


@pytest.mark.parametrize(("object_id", "value"), EXTENDED)
def test_a_single_object_is_read_by_its_id(
    object_id: int, value: bytes, named: wire.Connection
) -> None:
    assert identification(named, 4, object_id) == ((0, 0), [(object_id, value)])


@pytest.mark.parametrize("object_id", [7, 0x7F, 0x81, 0xFE])
def test_a_single_object_that_is_missing_is_an_illegal_address(
    object_id: int, named: wire.Connection
) -> None:
    assert named.ask(bytes([0x2B, 0x0E, 4, object_id])) == b"\xab\x02"


@pytest.mark.parametrize("read_code", [0, 5, 6, 0x80, 0xFF])
def test_an_unknown_read_code_is_an_illegal_value(read_code: int, named: wire.Connection) -> None:
    assert named.ask(bytes([0x2B, 0x0E, read_code, 0])) == b"\xab\x03"


def test_objects_that_do_not_fit_one_reply_follow_in_the_next(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    private = {0x80 + index: f"{index:02}" * 50 for index in range(20)}
    identity = Identity(
        vendor_name="Acme", product_code="P1", revision="1", private_objects=private
    )
    client = connect(serve({1: memory}, identity=identity))
    gathered: list[tuple[int, bytes]] = []
    more, following, replies = 0xFF, 0, 0
    while more == 0xFF:
        (more, following), objects = identification(client, 3, following)
        assert objects, "a reply without an object never ends"
        gathered += objects
        replies += 1

    assert gathered[:2] == [(0, b"Acme"), (1, b"P1")]
    assert dict(gathered[3:]) == {key: text.encode() for key, text in private.items()}
    assert len(gathered) == 23
    assert replies > 1
    assert (more, following) == (0, 0)


@pytest.mark.parametrize("length", [0, 1, 243, 244])
def test_a_value_may_fill_a_reply_of_its_own(
    length: int, memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    text = "x" * length
    client = connect(serve({1: memory}, identity=Identity(vendor_name=text)))

    assert identification(client, 4, 0) == ((0, 0), [(0, text.encode())])


def test_a_value_too_long_for_a_reply_is_refused_at_the_start(memory: holdfast.Memory) -> None:
    identity = Identity(vendor_name="x" * 245)
    server = holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-only", identity=identity)
    with pytest.raises(ValueError, match="245"):
        server.start()


@pytest.mark.parametrize("number", [-1, 0, 5, 7, 127, 256, 128.0, "128"])
def test_a_private_object_has_an_id_of_those(number: Any) -> None:
    message = re.escape(f"private_objects has the object id {number!r}, allowed: 128 to 255")
    with pytest.raises(ValueError, match=message):
        Identity(private_objects={number: "x"})


def test_a_unit_has_its_own_name(memory: holdfast.Memory, serve: Serve, connect: Connect) -> None:
    identity = Identity(user_application_name="All", unit_names={2: "Boiler"})
    client = connect(serve({1: memory, 2: memory}, identity=identity))

    assert identification(client, 4, 6, unit=1)[1] == [(6, b"All")]
    assert identification(client, 4, 6, unit=2)[1] == [(6, b"Boiler")]


def test_identification_needs_no_area(serve: Serve, connect: Connect) -> None:
    client = connect(serve({1: holdfast.Memory()}, identity=IDENTITY))

    assert identification(client, 1, 0) == ((0, 0), BASIC)


# Counters in Python


def test_requests_are_counted_by_function_and_exceptions_by_code(
    server: holdfast.Server, client: wire.Connection
) -> None:
    client.ask_many([READ, READ, OUTSIDE, MISSING_ADDRESS, b"\x63", b"\x11"])
    client.ask(READ, unit=9)

    counters = server.counters()
    assert counters["requests"] == {3: 5, 0x11: 1, 0x63: 1}
    assert counters["exceptions"] == {1: 1, 2: 1, 3: 1, 11: 1}


def test_frames_that_are_no_requests_are_counted(
    server: holdfast.Server, client: wire.Connection
) -> None:
    client.send(bytes.fromhex("000100010002010b") * 3 + bytes.fromhex("000100000000"))

    assert client.rest() == b""
    frames = server.counters()["frames"]
    assert frames == {"foreign": 3, "broken": 1, "damaged": 0, "other_unit": 0}
    assert server.counters()["requests"] == {}


def test_requests_without_a_reply_are_counted_in_python_too(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    server = serve({1: memory, 2: memory}, listen_only=True)
    client = connect(server)
    client.send(listen_only(1) + framed(READ, 1))
    client.ask(READ, unit=2)

    assert server.counters()["unanswered"] == 2


def test_connections_are_counted(server: holdfast.Server, connect: Connect) -> None:
    clients = [connect(server) for _ in range(3)]
    for client in clients:
        client.ask(READ)

    assert server.counters()["connections"]["accepted"] == 3
    assert server.counters()["connections"]["open"] == 3


def test_counters_of_a_server_that_is_stopped_are_a_runtime_error(
    memory: holdfast.Memory,
) -> None:
    server = holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-only")

    with pytest.raises(RuntimeError, match="run"):
        server.counters()

"""A TCP stream as peers really send it: in pieces, joined, cut, late, foreign, endless, garbage.

Random tests are replayed by their seed, which is written here. What random requests must be
answered says the model, or, for the long run, rules that need none.
"""

from __future__ import annotations

import os
import random
import select
import struct
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import holdfast
from holdfast.types import AREAS
from support import wire
from support.cases import examples
from support.machine import resident
from support.running import content
from support.server_model import COUNTERS, ServerModel

if TYPE_CHECKING:
    from collections.abc import Iterator

    from holdfast.types import Access, Area
    from support.running import Connect, Process, Serve

SEED = 20251121
READ = bytes.fromhex("0300000002")
WRITE = bytes.fromhex("1000030002041234abcd")
WRITTEN = bytes.fromhex("1000030002")
TCP_TABLE = Path("/proc/net/tcp")
KEEPALIVE_TIMER = 2
MAX_READ = struct.pack(">BHH", 3, 0, 125)


# Pieces


def test_a_request_may_arrive_byte_by_byte(
    memory: holdfast.Memory, client: wire.Connection
) -> None:
    for byte in wire.frame(WRITE, 1, 9):
        client.send(bytes([byte]))

    assert client.receive() == wire.Frame(9, 1, WRITTEN)
    assert memory.read("holding_registers", 3, 2) == [0x1234, 0xABCD]


@pytest.mark.parametrize("place", range(1, len(wire.frame(WRITE))))
def test_a_request_may_be_split_at_every_byte(
    place: int, server: holdfast.Server, memory: holdfast.Memory, client: wire.Connection
) -> None:
    request = wire.frame(WRITE, 1, 9)
    client.send(request[:place])
    # Another connection is served in between, so the first piece has arrived alone.
    with wire.Connection(server.address) as other:
        other.ask(READ)
    assert memory.read("holding_registers", 3, 2) == [0, 0]
    client.send(request[place:])

    assert client.receive() == wire.Frame(9, 1, WRITTEN)
    assert memory.read("holding_registers", 3, 2) == [0x1234, 0xABCD]


def test_two_requests_may_be_split_at_every_byte(client: wire.Connection) -> None:
    request = wire.frames([READ, WRITE])
    for place in range(1, len(request)):
        client.send(request[:place])
        client.send(request[place:])

        assert [reply.transaction for reply in client.receive_many(2)] == [0, 1]


def test_the_longest_request_may_arrive_in_any_pieces(client: wire.Connection) -> None:
    pdu = b"\x08\x00\x00" + bytes(range(250))
    chance = random.Random(SEED)
    for _ in range(200):
        request = wire.frame(pdu, 1, 5)
        while request:
            size = chance.randrange(1, 120)
            client.send(request[:size])
            request = request[size:]

        assert client.receive().pdu == pdu


# Joined


@pytest.mark.parametrize("number", [2, 16, 100, 1000])
def test_requests_joined_in_one_packet_are_answered_in_order(
    number: int, memory: holdfast.Memory, client: wire.Connection
) -> None:
    memory.write("holding_registers", 0, list(range(1000)))
    requests = [struct.pack(">BHH", 3, address % 1000, 1) for address in range(number)]

    replies = client.ask_many(requests)

    assert replies == [struct.pack(">BBH", 3, 2, address % 1000) for address in range(number)]


def test_requests_with_the_longest_replies_are_answered_in_order(
    memory: holdfast.Memory, client: wire.Connection
) -> None:
    memory.write("holding_registers", 0, list(range(1000)))
    requests = [struct.pack(">BHH", 3, index % 800, 125) for index in range(3000)]

    for index, reply in enumerate(client.ask_many(requests)):
        assert reply == struct.pack(">BB125H", 3, 250, *range(index % 800, index % 800 + 125))


def test_a_read_behind_a_write_sees_it(client: wire.Connection) -> None:
    requests = []
    for value in range(500):
        requests += [struct.pack(">BHH", 6, 7, value), struct.pack(">BHH", 3, 7, 1)]

    reads = client.ask_many(requests)[1::2]

    assert reads == [struct.pack(">BBH", 3, 2, value) for value in range(500)]


def test_one_transaction_id_may_be_used_again_and_again(client: wire.Connection) -> None:
    replies = client.converse(wire.frame(READ, 1, 7) * 50, 50)

    assert replies == [wire.Frame(7, 1, bytes.fromhex("030400000000"))] * 50


@pytest.mark.parametrize("number", [1, 100, 5000])
def test_requests_sent_before_the_end_of_the_stream_are_answered(
    number: int, client: wire.Connection
) -> None:
    client.send(wire.frames([MAX_READ] * number))
    client.finish()

    whole, left = wire.split(client.rest())
    assert [reply.transaction for reply in whole] == list(range(number))
    assert left == b""


@pytest.mark.parametrize("protocol", [1, 0xFFFF])
def test_foreign_frames_among_requests_are_passed_over(
    protocol: int, server: holdfast.Server, client: wire.Connection
) -> None:
    data = b"".join(
        wire.frame(bytes(index % 253 + 1), 1, index, protocol=protocol if index % 3 else 0)
        for index in range(300)
    )
    replies = client.converse(data, 100)

    assert [reply.transaction for reply in replies] == list(range(0, 300, 3))
    assert server.counters()["frames"]["foreign"] == 200


# Ends


@pytest.mark.parametrize("place", range(1, len(wire.frame(WRITE))))
def test_half_a_request_and_the_end_changes_nothing(
    place: int, memory: holdfast.Memory, client: wire.Connection
) -> None:
    client.send(wire.frame(WRITE)[:place])
    client.finish()

    assert client.rest() == b""
    assert memory.read("holding_registers", 0, 10) == [0] * 10


def test_a_reset_in_the_middle_of_a_request_leaves_the_server_well(
    server: holdfast.Server, memory: holdfast.Memory, connect: Connect
) -> None:
    for place in range(1, len(wire.frame(WRITE))):
        torn = wire.Connection(server.address)
        torn.send(wire.frame(WRITE)[:place])
        torn.reset()

    assert connect(server).ask(READ) == bytes.fromhex("030400000000")
    assert memory.read("holding_registers", 0, 10) == [0] * 10
    wire.until(lambda: server.counters()["connections"]["open"] == 1, "the torn ones are gone")


def test_a_reset_with_replies_on_their_way_leaves_the_server_well(
    server: holdfast.Server, connect: Connect
) -> None:
    for _ in range(50):
        torn = wire.Connection(server.address, receive_buffer=4096)
        torn.send(wire.frames([MAX_READ] * 200))
        torn.reset()

    assert connect(server).ask(READ) == bytes.fromhex("030400000000")
    wire.until(lambda: server.counters()["connections"]["open"] == 1, "the torn ones are gone")


# Deadlines


def test_half_a_request_ends_the_connection_after_the_request_timeout(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    server = serve({1: memory}, request_timeout=0.3)
    client = connect(server)
    began = time.monotonic()
    client.send(wire.frame(READ)[:-1])

    assert client.rest() == b""
    assert 0.25 <= time.monotonic() - began < 10, "the default is 10 s"
    wire.until(lambda: server.counters()["connections"]["request_timeout"] == 1, "it is counted")


def test_a_drip_of_bytes_does_not_put_off_the_request_timeout(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    server = serve({1: memory}, request_timeout=0.4)
    client = connect(server)
    for byte in wire.frame(b"\x08\x00\x00" + bytes(250)):
        client.send(bytes([byte]))
        ended, _, _ = select.select([client.socket], [], [], 0.02)
        if ended:
            break

    assert client.rest() == b"", "the whole request would be answered"
    wire.until(lambda: server.counters()["connections"]["request_timeout"] == 1, "it is counted")


def test_a_request_behind_served_ones_has_a_deadline_too(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    client = connect(serve({1: memory}, request_timeout=0.3))
    client.send(wire.frames([READ] * 10) + wire.frame(READ)[:5])

    whole, left = wire.split(client.rest())
    assert (len(whole), left) == (10, b"")


def test_a_connection_without_a_request_ends_after_the_idle_timeout(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    server = serve({1: memory}, idle_timeout=0.3)
    began = time.monotonic()
    client = connect(server)

    assert client.rest() == b""
    assert time.monotonic() - began >= 0.25
    wire.until(lambda: server.counters()["connections"]["idle"] == 1, "it is counted")


@pytest.mark.skipif(not TCP_TABLE.exists(), reason="only Linux shows the timers of connections")
@pytest.mark.parametrize(("keepalive", "shortest"), [(30, 0), (3000, 30)])
def test_a_silent_peer_is_probed_after_the_keepalive_time(
    keepalive: int, shortest: int, memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    server = serve({1: memory}, keepalive=keepalive)
    client = connect(server)
    client.ask(READ)

    wire.until(lambda: _seconds_to_probe(server, client) is not None, "its timer runs")
    remaining = _seconds_to_probe(server, client)
    assert remaining is not None
    assert shortest < remaining <= keepalive


def _seconds_to_probe(server: holdfast.Server, client: wire.Connection) -> float | None:
    """How long until the server's system probes the client; `None` while another timer runs."""
    ends = [f"{end[1]:04X}" for end in (server.address, client.socket.getsockname())]
    rows = [line.split() for line in TCP_TABLE.read_text().splitlines()[1:]]
    [timer] = [row[5] for row in rows if [row[1].split(":")[1], row[2].split(":")[1]] == ends]
    kind, ticks = (int(number, 16) for number in timer.split(":"))
    return ticks / os.sysconf("SC_CLK_TCK") if kind == KEEPALIVE_TIMER else None


def test_the_idle_timeout_begins_again_with_each_request(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    server = serve({1: memory}, idle_timeout=0.5)

    def lives_as_long_as_it_asks() -> bool:
        """Asks for more than twice the timeout. The connection must not end sooner after a request.

        A test that is held up may ask too late, and begins again.
        """
        began = last = time.monotonic()
        client = connect(server)
        while is_open := last - began < 1.1:
            asking = time.monotonic()
            try:
                client.ask(READ)
            except OSError:
                break
            last = asking
            if select.select([client.socket], [], [], 0.1)[0]:
                break
        assert client.rest() == b""
        assert time.monotonic() - last >= 0.3
        return not is_open

    wire.until(lives_as_long_as_it_asks, "the requests were close together")


def test_foreign_frames_do_not_put_off_the_idle_timeout(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    client = connect(serve({1: memory}, idle_timeout=0.4))

    def ends_though_it_sends() -> bool:
        client.send(wire.frame(READ, protocol=1))
        return bool(select.select([client.socket], [], [], 0.05)[0])

    wire.until(ends_though_it_sends, "the connection has ended")
    assert client.rest() == b""


def test_an_idle_timeout_of_0_keeps_a_connection(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    silent = connect(serve({1: memory}, idle_timeout=0))
    other = connect(serve({1: memory}, idle_timeout=0.3))

    assert other.rest() == b""
    assert silent.ask(READ) == bytes.fromhex("030400000000")


# Slow readers


def send_until_blocked(
    client: wire.Connection, data: bytes, most: int, patience: float = 0.2
) -> int:
    """Sends without reading until the server takes no more; how many bytes it took."""
    sent = 0
    client.socket.setblocking(False)
    while select.select([], [client.socket], [], patience)[1]:
        sent += client.socket.send(data[sent % len(data) :])
        assert sent < most, "the server reads on though nobody takes its replies"
    return sent


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc")
def test_peers_that_do_not_read_hold_up_nobody_and_cost_little_memory(
    server_process: Process, connect: Connect
) -> None:
    process = server_process(request_timeout=10 * wire.DEADLINE)
    good = connect(process.address)
    good.ask(MAX_READ)
    before = resident(process.pid)
    requests = wire.frames([MAX_READ] * 5000)

    slow = [connect(process.address, receive_buffer=4096) for _ in range(20)]
    with ThreadPoolExecutor(len(slow)) as threads:
        for sent in threads.map(
            lambda client: send_until_blocked(client, requests, 32_000_000), slow
        ):
            assert sent > 5000
            assert len(good.ask(MAX_READ)) == 252

    assert resident(process.pid) - before < 20 * 512 * 1024


def test_a_slow_reader_gets_every_reply_when_it_reads_at_last(
    server: holdfast.Server, connect: Connect
) -> None:
    client = connect(server, receive_buffer=4096)
    requests = wire.frames([MAX_READ] * 1000)
    sent = send_until_blocked(client, requests, 64_000_000)
    size = len(requests) // 1000
    number = -(-sent // size)

    replies = client.converse(requests[sent % len(requests) :][: number * size - sent], number)

    assert number > 1000
    assert [reply.transaction for reply in replies] == [index % 1000 for index in range(number)]


def test_a_peer_that_takes_no_replies_is_closed_after_the_request_timeout(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    server = serve({1: memory}, request_timeout=0.5)
    client = connect(server, receive_buffer=4096)
    requests = wire.frames([MAX_READ] * 500)

    with pytest.raises((ConnectionResetError, BrokenPipeError)):
        send_until_blocked(client, requests, 200_000_000, patience=wire.DEADLINE)
    wire.until(lambda: server.counters()["connections"]["slow_reader"] == 1, "it is counted")


# Garbage


def test_garbage_on_many_connections_leaves_the_server_well(
    server: holdfast.Server, client: wire.Connection
) -> None:
    chance = random.Random(SEED)
    for _ in range(300):
        with wire.Connection(server.address) as noisy:
            try:
                noisy.send(chance.randbytes(chance.randrange(1, 3000)))
                noisy.finish()
            except OSError:
                continue
            noisy.rest()

    assert client.ask(READ)[0] == 3
    wire.until(lambda: server.counters()["connections"]["open"] == 1, "the noisy ones are gone")


def test_garbage_behind_a_good_header_is_answered_or_closed(
    server: holdfast.Server, client: wire.Connection
) -> None:
    chance = random.Random(SEED + 1)
    for _ in range(300):
        with wire.Connection(server.address) as noisy:
            good = wire.frames([READ] * 3)
            noisy.send(good + b"\x00\x00\x00\x00\xff" + chance.randbytes(200))
            try:
                whole, left = wire.split(noisy.rest())
            except AssertionError:
                pytest.fail("neither answered nor closed")
            assert left == b""
            assert all(reply.pdu == bytes.fromhex("030400000000") for reply in whole)

    assert client.ask(READ)[0] == 3


# Random requests against the model

EXTENTS = {
    "coils": (3, 60),
    "discrete_inputs": (0, 50),
    "holding_registers": (65500, 36),
    "input_registers": (10, 200),
}
EDGES = sorted(
    {
        min(65535, max(0, start + offset + delta))
        for start, size in EXTENTS.values()
        for offset in (0, size)
        for delta in (-2, -1, 0, 1)
    }
    | {0, 65535}
)
addresses = st.one_of(
    *[st.integers(start, start + size - 1) for start, size in EXTENTS.values()],
    st.sampled_from(EDGES),
)
words = st.integers(0, 0xFFFF)


def quantities(most: int) -> st.SearchStrategy[int]:
    edges = st.sampled_from([0, 1, most - 1, most, most + 1, 0xFFFF])
    return st.one_of(st.integers(1, 12), st.integers(1, most), edges)


@st.composite
def counted_requests(draw: st.DrawFn) -> bytes:
    """Functions 15, 16 and 23, most of them with a byte count that fits."""
    code, most = draw(st.sampled_from([(15, 1968), (16, 123), (23, 121)]))
    quantity = draw(st.one_of(st.integers(1, 30), quantities(most)))
    size = (quantity + 7) // 8 if code == 15 else quantity * 2
    size = min(size + draw(st.sampled_from([0] * 8 + [-1, 1])), 243)
    data = draw(st.binary(min_size=max(0, size), max_size=max(0, size)))
    byte_count = draw(st.sampled_from([len(data)] * 8 + [0, 255]))
    head = struct.pack(">HHB", draw(addresses), quantity, byte_count)
    if code == 23:
        head = struct.pack(">HH", draw(addresses), draw(quantities(125))) + head
    return bytes([code]) + head + data


def fixed(code: int, *fields: st.SearchStrategy[int]) -> st.SearchStrategy[bytes]:
    def packed(values: tuple[int, ...]) -> bytes:
        return struct.pack(f">B{len(values)}H", code, *values)

    return st.tuples(*fields).map(packed)


diagnostics = st.one_of(
    fixed(8, st.sampled_from([0, 1, 2, 3, 4, 0x0A, 0x14, 5, 9, 0x15, 0xFF00]), st.just(0)),
    fixed(8, st.sampled_from([0, 1, 2, 3, 4]), st.sampled_from([0, 1, 0xFF00, 0x0A00, 0xFFFF])),
    st.binary(max_size=20).map(lambda data: b"\x08\x00\x00" + data),
)
well_formed = st.one_of(
    fixed(1, addresses, quantities(2000)),
    fixed(2, addresses, quantities(2000)),
    fixed(3, addresses, quantities(125)),
    fixed(4, addresses, quantities(125)),
    fixed(5, addresses, st.sampled_from([0, 0xFF00, 0xFF00, 0x00FF, 1])),
    fixed(6, addresses, words),
    fixed(22, addresses, words, words),
    counted_requests(),
    counted_requests(),
    diagnostics,
)


@st.composite
def malformed(draw: st.DrawFn) -> bytes:
    pdu = draw(well_formed)
    return draw(
        st.one_of(
            st.integers(1, len(pdu)).map(lambda end: pdu[:end]),
            st.binary(min_size=1, max_size=4).map(lambda more: (pdu + more)[:253]),
            st.binary(min_size=1, max_size=253),
        )
    )


def is_modelled(pdu: bytes) -> bool:
    """Counters and identification are not in the model."""
    counter = pdu[0] == 8 and len(pdu) >= 3 and int.from_bytes(pdu[1:3], "big") in COUNTERS
    return pdu[0] not in (11, 17, 43) and not counter


requests = st.one_of(*[well_formed] * 4, malformed()).filter(is_modelled)
units = st.sampled_from([1] * 12 + [0, 2, 255])


@pytest.mark.parametrize("access", ["read-write", "read-only"])
@settings(
    max_examples=examples(150),
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
@given(asked=st.lists(st.tuples(units, requests), min_size=1, max_size=60), seed=st.integers(0, 99))
def test_pipelined_requests_are_answered_as_the_model_says(
    access: Access, asked: list[tuple[int, bytes]], seed: int
) -> None:
    chance = random.Random(seed)
    memory = holdfast.Memory(
        coils=EXTENTS["coils"],
        discrete_inputs=EXTENTS["discrete_inputs"],
        holding_registers=EXTENTS["holding_registers"],
        input_registers=EXTENTS["input_registers"],
    )
    model = ServerModel(EXTENTS, read_only=access == "read-only")
    for area, (start, size) in EXTENTS.items():
        top = 1 if area in ("coils", "discrete_inputs") else 0xFFFF
        values = [chance.randint(0, top) for _ in range(size)]
        memory.write(named(area), start, values)
        model.values[area].update(enumerate(values, start))
    expected = [
        wire.Frame(index, unit, reply)
        for index, (unit, pdu) in enumerate(asked)
        if (reply := model.answer(unit, pdu)) is not None
    ]
    stream = b"".join(wire.frame(pdu, unit, at) for at, (unit, pdu) in enumerate(asked))
    with (
        holdfast.Server({1: memory}, bind="127.0.0.1:0", access=access, listen_only=True) as server,
        wire.Connection(server.address) as client,
    ):
        client.send(stream)
        client.finish()
        replies, left = wire.split(client.rest())

    assert replies == expected
    assert left == b""
    for area, (start, size) in EXTENTS.items():
        assert memory.read(named(area), start, size) == list(model.values[area].values())


def named(area: str) -> Area:
    [found] = [known for known in AREAS if known == area]
    return found


# Random frames

BATCH = 2000
BATCHES = examples(100)
CODES = bytes([1, 2, 3, 4, 5, 6, 8, 11, 15, 16, 17, 22, 23, 43] * 12) + bytes(range(88))
ALLOWED = frozenset(bytes([code | 0x80, reason]) for code in range(256) for reason in (1, 2, 3, 11))
ECHOED = {5: 5, 6: 5, 11: 5, 15: 5, 16: 5, 22: 7}
COUNTED = frozenset((1, 2, 3, 4, 17, 23))


def random_pdus(chance: random.Random) -> Iterator[bytes]:
    """PDUs whose function code is mostly known and whose fields are mostly small."""
    soup = chance.randbytes(BATCH * 16)
    codes = chance.choices(CODES, k=BATCH)
    sizes = chance.choices((0, 1, 2, 3, *[4] * 16, 5, 6, 8, 11, 15), k=BATCH)
    masks = chance.choices((0xFFFFFFFF, 0x03FF007F, 0x01FF001F, 0x01FF007F), k=BATCH)
    for index, code in enumerate(codes):
        at = index * 16
        if sizes[index] == 4:
            fields = int.from_bytes(soup[at : at + 4], "big") & masks[index]
            pdu = bytes((code,)) + fields.to_bytes(4, "big")
        elif code in (15, 16) and sizes[index] > 5:
            items = soup[at] % 4 + 1
            size = 1 if code == 15 else items * 2
            head = (code, soup[at + 1] & 3, soup[at + 2], 0, items, size)
            pdu = bytes(head) + soup[at + 3 : at + 3 + size]
        else:
            pdu = bytes((code,)) + soup[at : at + sizes[index]]
        yield b"\x08\x00\x00" if pdu[:3] == b"\x08\x00\x04" else pdu


def fits(request: bytes, reply: bytes) -> bool:
    """Whether a reply can be one to a request: function, exception code, and length."""
    code = request[0]
    if reply in ALLOWED:
        return reply[0] == code | 0x80
    if reply[0] != code:
        return False
    if code in COUNTED:
        return len(reply) == 2 + reply[1]
    if code in ECHOED:
        return len(reply) == ECHOED[code] and (code == 11 or request.startswith(reply[:5]))
    if code == 8:
        return len(reply) == len(request) and reply[:3] == request[:3]
    return code == 43 and len(reply) > 7


def test_random_frames_are_all_answered(server: holdfast.Server, connect: Connect) -> None:
    chance = random.Random(SEED)
    client = connect(server)
    numbers = [struct.pack(">HH", index, 0) for index in range(BATCH)]
    tails = [struct.pack(">HB", size + 1, 1) for size in range(17)]
    good = 0
    for _ in range(BATCHES):
        asked = list(random_pdus(chance))
        stream = b"".join(
            [number + tails[len(pdu)] + pdu for number, pdu in zip(numbers, asked, strict=True)]
        )
        replies = client.converse(stream, BATCH)
        for index, (request, reply) in enumerate(zip(asked, replies, strict=True)):
            assert reply[0] == index
            assert fits(request, reply[2]), f"{request.hex()} was answered {reply[2].hex()}"
            good += reply[2][0] < 0x80

    assert sum(server.counters()["requests"].values()) == BATCHES * BATCH
    assert 0.1 < good / (BATCHES * BATCH) < 0.9, "the frames are not a fair mixture"


def test_random_frames_to_a_read_only_unit_change_nothing(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    chance = random.Random(SEED + 2)
    client = connect(serve({1: memory}, access="read-only"))
    before = content(memory)
    for _ in range(10):
        client.ask_many(random_pdus(chance))

    assert content(memory) == before

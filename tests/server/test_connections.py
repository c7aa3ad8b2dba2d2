"""Connections: how many, from where, which one gives way, and what start and stop leave behind."""

from __future__ import annotations

import contextlib
import gc
import re
import subprocess
import sys
import threading
import weakref
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from support import wire
from support.machine import needs_127_0_0_2, needs_proc, resident
from support.running import endpoint

if TYPE_CHECKING:
    from support.running import Connect, Process, Run, Serve

READ = bytes.fromhex("0300000001")
ZERO = bytes.fromhex("03020000")


def is_refused(address: tuple[str, int], source: str | None = None) -> bool:
    """Whether a new connection is closed without a byte."""
    with wire.Connection(address, source=source) as client:
        with contextlib.suppress(ConnectionResetError, BrokenPipeError):
            client.send(wire.frame(READ))
        return client.rest() == b""


def is_open(client: wire.Connection) -> bool:
    return client.ask(READ) == ZERO


def held() -> tuple[int, int]:
    """How many threads and files this process has."""
    own = Path("/proc/self")
    return len(list((own / "task").iterdir())), len(list((own / "fd").iterdir()))


# Many


@pytest.mark.usefixtures("many_files")
def test_2000_connections_are_held_and_served_at_once(
    server_process: Process, connect: Connect
) -> None:
    process = server_process(max_connections=2000)
    clients = [connect(process.address) for _ in range(2000)]
    for index, client in enumerate(clients):
        client.send(wire.frame(READ, 1, index))

    assert [client.receive() for client in clients] == [
        wire.Frame(index, 1, ZERO) for index in range(2000)
    ]
    assert is_refused(process.address)
    assert all(is_open(client) for client in clients)


@needs_proc
@pytest.mark.usefixtures("many_files")
def test_an_idle_connection_costs_little_memory(server_process: Process, connect: Connect) -> None:
    process = server_process(max_connections=800)
    assert all(is_open(connect(process.address)) for _ in range(200))
    before = resident(process.pid)
    assert all(is_open(connect(process.address)) for _ in range(600))
    assert resident(process.pid) - before < 600 * 7 * 1024


@pytest.mark.usefixtures("many_files")
@pytest.mark.parametrize("workers", [1, 2, 4])
def test_connections_are_served_whatever_the_number_of_workers(
    workers: int, memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    server = serve({1: memory}, workers=workers)
    clients = [connect(server) for _ in range(100)]
    for _ in range(3):
        assert all(is_open(client) for client in clients)


# Limits


def test_a_full_server_refuses_a_new_connection(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    server = serve({1: memory}, max_connections=2)
    held = [connect(server), connect(server)]
    assert all(is_open(client) for client in held)

    assert is_refused(server.address)
    assert all(is_open(client) for client in held)
    assert server.counters()["connections"]["refused_full"] == 1


def test_a_place_is_free_again_when_its_connection_has_ended(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    server = serve({1: memory}, max_connections=2)
    first, second = connect(server), connect(server)
    assert is_open(first)
    assert is_open(second)
    first.close()
    wire.until(lambda: server.counters()["connections"]["open"] == 1, "the place is free")

    assert is_open(connect(server))
    assert is_open(second)


def test_a_full_server_closes_the_connection_that_is_idle_longest(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    server = serve({1: memory}, max_connections=3, when_full="evict")
    first, second, third = (connect(server) for _ in range(3))
    for client in (first, second, third, first):
        assert is_open(client)

    newcomer = connect(server)

    assert is_open(newcomer)
    assert second.rest() == b""
    assert is_open(first)
    assert is_open(third)
    assert server.counters()["connections"]["evicted"] == 1


def test_silent_connections_displace_each_other_and_hardly_anyone_else(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    server = serve({1: memory}, max_connections=10, when_full="evict")
    clients = [connect(server) for _ in range(9)]
    assert all(is_open(client) for client in clients)

    silent = [connect(server) for _ in range(25)]

    assert [each.rest() for each in silent[:-1]] == [b""] * 24
    assert all(is_open(client) for client in clients)
    assert is_open(silent[-1])


def test_one_newcomer_after_another_takes_the_place_of_the_idle(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    server = serve({1: memory}, max_connections=3, when_full="evict")
    clients = []
    for _ in range(20):
        clients.append(connect(server))
        assert is_open(clients[-1])

    assert all(client.rest() == b"" for client in clients[:-3])
    assert all(is_open(client) for client in clients[-3:])
    assert server.counters()["connections"]["open"] == 3


@needs_127_0_0_2
def test_each_source_has_its_own_number_of_places(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    server = serve({1: memory}, max_connections_per_source=2)
    held = [connect(server, source=f"127.0.0.{last}") for last in (1, 1, 2)]
    assert all(is_open(client) for client in held)

    assert is_refused(server.address, source="127.0.0.1")
    assert is_open(connect(server, source="127.0.0.2"))
    assert is_refused(server.address, source="127.0.0.2")
    assert is_open(connect(server, source="127.0.0.3"))
    assert all(is_open(client) for client in held)


@needs_127_0_0_2
def test_a_source_that_is_full_gives_up_only_its_own_connections(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    server = serve({1: memory}, max_connections_per_source=2, when_full="evict")
    other = connect(server, source="127.0.0.2")
    assert is_open(other)
    first, second = (connect(server, source="127.0.0.1") for _ in range(2))
    assert is_open(first)
    assert is_open(second)

    assert is_open(connect(server, source="127.0.0.1"))
    assert first.rest() == b""
    assert is_open(second)
    assert is_open(other)


@needs_127_0_0_2
def test_a_place_of_a_source_is_free_again_when_its_connection_has_ended(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    server = serve({1: memory}, max_connections_per_source=1)
    for _ in range(20):
        client = connect(server, source="127.0.0.2")
        assert is_open(client)
        client.close()
        wire.until(lambda: server.counters()["connections"]["open"] == 0, "the place is free")


# Sources


@needs_127_0_0_2
def test_a_source_that_no_rule_names_is_closed_without_a_byte(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    server = serve({1: memory}, sources=("127.0.0.2/32",))

    with wire.Connection(server.address) as stranger:
        assert stranger.rest() == b""
    assert is_open(connect(server, source="127.0.0.2"))
    assert server.counters()["connections"]["refused_source"] == 1


@needs_127_0_0_2
def test_a_stranger_takes_no_place(memory: holdfast.Memory, serve: Serve, connect: Connect) -> None:
    server = serve({1: memory}, sources=("127.0.0.2/32",), max_connections=1)
    strangers = [connect(server) for _ in range(5)]
    assert all(stranger.rest() == b"" for stranger in strangers)

    assert is_open(connect(server, source="127.0.0.2"))


@needs_127_0_0_2
def test_the_first_rule_that_names_a_source_holds(connect: Connect) -> None:
    one, other = holdfast.Memory(holding_registers=1), holdfast.Memory(holding_registers=1)
    other.write("holding_registers", 0, [7])
    rules = [
        holdfast.Rule({1: one}, sources=["127.0.0.2"], access="read-write"),
        holdfast.Rule({1: other}, sources=["127.0.0.0/30"], access="read-only"),
    ]
    write = bytes.fromhex("0600001234")
    with holdfast.Server(bind="127.0.0.1:0", rules=rules) as server:
        trusted = connect(server, source="127.0.0.2")
        guest = connect(server, source="127.0.0.3")

        assert trusted.ask(write) == write
        assert guest.ask(write) == b"\x86\x01"
        assert guest.ask(READ) == bytes.fromhex("03020007")
        assert is_refused(server.address, source="127.0.0.4")
    assert one.read("holding_registers", 0, 1) == [0x1234]


def test_a_denied_source_is_closed_even_if_it_has_sent_a_request(
    memory: holdfast.Memory, serve: Serve
) -> None:
    server = serve({1: memory}, sources=("192.0.2.0/24",))

    assert is_refused(server.address)


# Addresses


@pytest.mark.usefixtures("ipv6")
def test_an_ipv6_address_is_served(memory: holdfast.Memory, serve: Serve, connect: Connect) -> None:
    server = serve({1: memory}, bind="[::1]:0")

    assert server.address[0] == "::1"
    assert is_open(connect(server))


@pytest.mark.usefixtures("ipv6")
def test_a_listener_on_every_address_knows_an_ipv4_peer_by_its_ipv4_address(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    server = serve({1: memory}, bind="[::]:0", sources=("127.0.0.1/32",))
    port = server.address[1]

    assert is_open(connect(("127.0.0.1", port)))
    assert is_refused(("::1", port))


@pytest.mark.usefixtures("ipv6")
@needs_127_0_0_2
def test_a_listener_on_every_address_counts_an_ipv4_peer_by_its_ipv4_address(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    server = serve({1: memory}, bind="[::]:0", max_connections_per_source=1)
    port = server.address[1]

    assert is_open(connect(("127.0.0.1", port)))
    assert is_open(connect(("::1", port)))
    assert is_open(connect(("127.0.0.1", port), source="127.0.0.2"))
    assert is_refused(("127.0.0.1", port))
    assert is_refused(("::1", port))


def test_the_address_tells_the_port_that_the_system_picked(server: holdfast.Server) -> None:
    host, port = server.address

    assert host == "127.0.0.1"
    assert 0 < port < 65536


def test_a_port_that_is_taken_is_an_os_error_that_names_it(
    server: holdfast.Server, memory: holdfast.Memory
) -> None:
    taken = f"127.0.0.1:{server.address[1]}"
    second = holdfast.Server({1: memory}, bind=taken, access="read-only")

    with pytest.raises(OSError, match=taken):
        second.start()


def test_a_server_whose_port_was_taken_starts_when_it_is_free(
    memory: holdfast.Memory, connect: Connect
) -> None:
    with holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-only") as first:
        taken = f"127.0.0.1:{first.address[1]}"
        second = holdfast.Server({1: memory}, bind=taken, access="read-only")
        with pytest.raises(OSError, match=taken):
            second.start()
    with second:
        assert is_open(connect(second))


@pytest.mark.parametrize(
    "bind", ["", "localhost", "127.0.0.1", "127.0.0.1:", "127.0.0.1:65536", "::1:502", "[::1]"]
)
def test_a_bind_that_is_no_address_and_port_is_a_value_error(
    bind: str, memory: holdfast.Memory
) -> None:
    with pytest.raises(ValueError, match=r"bind|address"):
        holdfast.Server({1: memory}, bind=bind, access="read-only")


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="needs /proc/net/tcp")
def test_the_server_asks_silent_peers_whether_they_are_there(
    server: holdfast.Server, client: wire.Connection
) -> None:
    assert is_open(client)
    ends = f"{server.address[1]:04X}", f"{client.socket.getsockname()[1]:04X}"

    def timer() -> str:
        """The kind of timer that runs for the server's end of the connection."""
        for line in Path("/proc/net/tcp").read_text().splitlines()[1:]:
            fields = line.split()
            if (fields[1][-4:], fields[2][-4:]) == ends:
                return fields[5].split(":")[0]
        return "none"

    keepalive = "02"
    wire.until(lambda: timer() == keepalive, "the keepalive timer runs")


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"units": [256]}, "256"),
        ({"units": [-1]}, "-1"),
        ({"functions": [256]}, "256"),
        ({"deny": [-1]}, "-1"),
        ({"functions": [3], "deny": [4]}, "functions.*deny"),
        ({"access": "write"}, "write"),
        ({"sources": ["10.0.0.0/33"]}, "10.0.0.0/33"),
        ({"max_connections": 0}, "connections"),
        ({"max_connections": -1}, "connections"),
        ({"max_connections_per_source": 0}, "connections"),
        ({"when_full": "drop"}, "drop.*refuse, evict"),
        ({"idle_timeout": -1}, "idle_timeout"),
        ({"idle_timeout": float("nan")}, "idle_timeout"),
        ({"request_timeout": 0}, "request_timeout"),
        ({"workers": -1}, "workers"),
        ({"workers": 65}, "workers"),
    ],
    ids=str,
)
def test_an_argument_that_can_not_be_is_a_value_error(
    wrong: dict[str, Any], text: str, memory: holdfast.Memory
) -> None:
    valid: dict[str, Any] = {"units": [1], "bind": "127.0.0.1:0", "access": "read-only"}
    options = valid | wrong
    options["units"] = dict.fromkeys(options["units"], memory)

    with pytest.raises(ValueError, match=text):
        holdfast.Server(**options)


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"units": 7}, "units is 7, allowed: a memory for each unit id, as in {1: memory}"),
        ({"units": {"1": 7}}, "found the unit id '1', allowed: 0 to 255, as in {1: memory}"),
        ({"units": {1: {}}}, "unit 1 is {}, allowed: a holdfast.Memory"),
        ({"functions": 3}, "functions is 3, allowed: a list, as in [3, 16]"),
        ({"deny": "6"}, "deny is '6', allowed: a list, as in [3, 16]"),
        ({"sources": "10.0.0.0/8"}, "sources is '10.0.0.0/8', allowed: a list, as in ['10.0.0.0"),
        ({"identity": "x"}, "identity is 'x', allowed: holdfast.server.Identity(vendor_name=…)"),
        ({"keepalive": 2.5}, "keepalive is 2.5, allowed: an integer"),
        ({"max_connections": True}, "max_connections is True, allowed: an integer"),
        (
            {"max_connections_per_source": 2.0},
            "max_connections_per_source is 2.0, allowed: an integer, None",
        ),
        ({"idle_timeout": "1"}, "idle_timeout is '1', allowed: a number of seconds"),
        ({"request_timeout": None}, "request_timeout is None, allowed: a number of seconds"),
        ({"when_full": None}, "when_full is None, allowed: refuse, evict"),
        ({"event_log": 1}, "event_log is 1, allowed: True, False"),
        ({"bind": "tls://127.0.0.1:0", "tls": "a"}, "tls is 'a', allowed: holdfast.ServerTls(cert"),
    ],
    ids=str,
)
def test_an_argument_of_another_type_is_a_type_error(
    wrong: dict[str, Any], text: str, memory: holdfast.Memory
) -> None:
    valid: dict[str, Any] = {"units": {1: memory}, "bind": "127.0.0.1:0", "access": "read-only"}
    with pytest.raises(TypeError, match=re.escape(text)):
        holdfast.Server(**valid | wrong)


# Start and stop


def test_a_server_can_be_stopped_from_another_thread(
    server: holdfast.Server, client: wire.Connection
) -> None:
    assert is_open(client)
    thread = threading.Thread(target=server.stop)
    thread.start()
    thread.join(wire.DEADLINE)

    assert not thread.is_alive()
    assert client.rest() == b""


STARTS_AND_FORGETS = """
import gc
import holdfast

def start():
    memory = holdfast.Memory(holding_registers=1000)
    server = holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-write").start()
    return server.address

address = start()
gc.collect()
print(*address, flush=True)
input()
"""


def test_several_threads_may_stop_a_server_at_once(
    server: holdfast.Server, client: wire.Connection
) -> None:
    assert is_open(client)
    threads = [threading.Thread(target=server.stop) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(wire.DEADLINE)

    assert not any(thread.is_alive() for thread in threads)
    assert client.rest() == b""


@pytest.mark.parametrize("number", [1, 100, 1000])
def test_what_was_received_before_a_stop_is_answered(
    number: int, memory: holdfast.Memory, connect: Connect
) -> None:
    longest = bytes.fromhex("030000007d")
    for _ in range(10):
        with holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-write") as server:
            client = connect(server)
            assert is_open(client)
            client.send(wire.frames([longest] * number))
        whole, left = wire.split(client.rest())

        assert [reply.transaction for reply in whole] == list(range(number))
        assert left == b""


def test_a_stop_closes_idle_connections(memory: holdfast.Memory, connect: Connect) -> None:
    with holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-write") as server:
        clients = [connect(server) for _ in range(20)]
        assert all(is_open(client) for client in clients)

    assert all(client.rest() == b"" for client in clients)


def test_a_stop_does_not_wait_for_a_peer_that_does_not_read(
    memory: holdfast.Memory, connect: Connect
) -> None:
    longest = wire.frames([bytes.fromhex("030000007d")] * 20_000)
    with holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-write") as server:
        client = connect(server, receive_buffer=4096)
        client.socket.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while True:
                client.socket.send(longest)
        stopper = threading.Thread(target=server.stop)
        stopper.start()
        stopper.join(wire.DEADLINE)

        assert not stopper.is_alive()


def test_a_started_server_runs_without_a_reference_until_the_program_ends() -> None:
    with subprocess.Popen(
        [sys.executable, "-X", "dev", "-c", STARTS_AND_FORGETS],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as program:
        assert program.stdout is not None
        host, port = program.stdout.readline().split()
        with wire.Connection((host, int(port))) as client:
            assert is_open(client)
            told = program.communicate("\n", timeout=wire.DEADLINE)
            assert (program.returncode, told) == (0, ("", ""))
            assert client.rest() == b""


def test_a_stopped_server_without_a_reference_is_freed(memory: holdfast.Memory) -> None:
    server = holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-write").start()
    engine = weakref.ref(server._running())
    server.stop()
    del server
    gc.collect()
    assert engine() is None


def test_a_stopped_server_listens_no_more(memory: holdfast.Memory) -> None:
    with holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-write") as server:
        address = server.address

    with pytest.raises(ConnectionRefusedError):
        wire.Connection(address)


def test_a_stopped_server_can_be_started_again(memory: holdfast.Memory, connect: Connect) -> None:
    server = holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-write")
    for _ in range(3):
        with server:
            assert is_open(connect(server))


def test_a_stop_of_a_stopped_server_does_nothing(memory: holdfast.Memory) -> None:
    server = holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-write")
    server.stop()
    server.start()
    server.stop()
    server.stop()

    with pytest.raises(RuntimeError, match="run"):
        server.address  # noqa: B018


def test_a_server_that_runs_is_not_started_again(server: holdfast.Server) -> None:
    with pytest.raises(RuntimeError, match="already running"):
        server.start()


def test_the_memory_outlives_its_server(memory: holdfast.Memory, connect: Connect) -> None:
    write = bytes.fromhex("0600001234")
    with holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-write") as server:
        assert connect(server).ask(write) == write

    assert memory.read("holding_registers", 0, 1) == [0x1234]


@needs_proc
def test_starts_and_stops_leave_no_thread_and_no_file(memory: holdfast.Memory) -> None:
    def cycle() -> None:
        server = holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-write", workers=2)
        with server, wire.Connection(server.address) as client:
            assert is_open(client)

    cycle()
    before = held()
    for _ in range(50):
        cycle()

    assert held() == before


@needs_proc
def test_a_server_that_could_not_start_leaves_no_thread_and_no_file(
    server: holdfast.Server, memory: holdfast.Memory
) -> None:
    taken = f"127.0.0.1:{server.address[1]}"
    before = held()
    for _ in range(20):
        with pytest.raises(OSError, match=taken):
            holdfast.Server({1: memory}, bind=taken, access="read-only").start()

    assert held() == before


LIMITED = """
memories:
  plant: {holding_registers: 1000}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:0
    max_connections: 20
    rules: [{sources: [127.0.0.0/8], units: {1: plant}, access: read-only}]
"""


@needs_127_0_0_2
def test_silent_connections_of_one_source_leave_room_for_others_by_default(
    run: Run, connect: Connect
) -> None:
    address = endpoint(run(LIMITED), "scada")
    for _ in range(16):
        assert is_open(connect(address, source="127.0.0.1"))
    assert is_refused(address, source="127.0.0.1")
    assert is_open(connect(address, source="127.0.0.2"))

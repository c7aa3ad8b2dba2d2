"""Memories that several nodes share, from Python and over Modbus."""

from __future__ import annotations

import signal
import threading
import time
from contextlib import closing
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast._core import Log, LogError, LogReader
from support import wire
from support.brokers import free_port
from support.tcp_proxy import Proxy

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from holdfast.types import Area
    from journal.conftest import Node
    from support.brokers import NatsServer

    Start = Callable[..., Node]


def plant(registers: int = 100) -> holdfast.Memory:
    return holdfast.Memory(coils=64, holding_registers=registers)


def refusal(call: Callable[[], object]) -> int | None:
    """The exception code with which a request is refused."""
    try:
        call()
    except holdfast.ModbusException as error:
        return error.code
    return None


def test_clients_of_two_nodes_share_a_memory(node: Start) -> None:
    a, b = node("a"), node("b")
    a.client.write_register(3, 7)
    assert a.read(3) == 7
    wire.until(lambda: b.read(3) == 7, "the other node has it")
    b.client.write_registers(10, [1, 2, 3])
    b.client.mask_write(10, and_mask=0xFF00, or_mask=0x00AA)
    assert b.client.read_write(10, 3, 12, [9]) == [0xAA, 2, 9]
    b.client.write_coils(5, [True, False, True])
    wire.until(lambda: a.client.read_coils(5, 3) == [True, False, True], "the coils are there")
    assert a.client.read_holding_registers(10, 3) == [0xAA, 2, 9]
    b.memory.write("holding_registers", 50, [5])
    wire.until(lambda: a.read(50) == 5, "a write from Python is there")


def test_pipelined_writes_keep_their_order(node: Start) -> None:
    a = node("a")
    with wire.Connection(a.address) as connection:
        requests = [b"\x06" + bytes([0, 0]) + number.to_bytes(2) for number in range(100)]
        frames = b"".join(
            number.to_bytes(2) + b"\0\0" + (1 + len(pdu)).to_bytes(2) + b"\1" + pdu
            for number, pdu in enumerate(requests)
        )
        connection.socket.sendall(frames)
        received = b""
        while len(received) < len(frames):
            received += connection.socket.recv(65_536)
        assert received == frames
    assert a.read(0) == 99


def test_without_a_server_writes_are_refused_and_reads_are_not(
    node: Start, nats: NatsServer
) -> None:
    a = node("a", write_timeout=1.0)
    wire.until(lambda: refusal(lambda: a.client.write_register(0, 1)) is None, "it is written")
    nats.kill()
    wire.until(lambda: refusal(lambda: a.client.write_register(0, 2)) == 6, "writes are refused")
    assert a.read(0) == 1
    assert a.log.status()["unavailable"] > 0
    wire.until(lambda: not a.log.status()["connected"], "the status says so")
    nats.start()
    wire.until(lambda: refusal(lambda: a.client.write_register(0, 3)) is None, "writes are taken")
    assert a.read(0) == 3


def test_a_write_that_is_not_confirmed_in_time_gets_exception_4(
    node: Start, nats: NatsServer
) -> None:
    a = node("a", write_timeout=0.3)
    nats.freeze()
    assert refusal(lambda: a.client.write_register(0, 1)) == 4
    assert a.log.status()["not_confirmed"] == 1
    nats.thaw()


def test_a_write_that_the_network_delivers_late_does_not_replace_a_newer_one(
    node: Start, nats: NatsServer
) -> None:
    seconds = 0.1
    with closing(Proxy(nats.port, "nats")) as proxy:
        a, b = node("a", servers=[proxy.url], write_timeout=seconds), node("b")
        proxy.hold()
        # On a loaded machine, one may not be sent in time: 6.
        wire.until(lambda: refusal(lambda: a.client.write_register(0, 111)) == 4, "it is sent")
        # Until then, the log still takes it.
        end = time.monotonic() + 2 * seconds
        wire.until(lambda: time.monotonic() > end, "its time is over")
        b.client.write_register(0, 222)
        memory = plant()
        reader = LogReader("site", [nats.url], [("plant", memory)], follow=True)
        proxy.go_on()
        late: list[Any] = []
        while not late:
            record = reader.next(wire.DEADLINE)
            late += [] if record is None or record["node"] != "a" else record["steps"]
        writes = [("plant", "holding_registers", 0, [111])]
        assert [(step["writes"], step["refused"]) for step in late] == [(writes, "not_confirmed")]
        last = reader.sequence
        wire.until(lambda: min(each.log.status()["sequence"] for each in (a, b)) >= last, "all do")
        assert memory.read("holding_registers", 0, 1) == [222]
        assert (a.read(0), b.read(0)) == (222, 222)


def test_reads_are_refused_without_contact(node: Start, nats: NatsServer) -> None:
    a = node("a", when_behind="refuse", max_lag=1.0)
    wire.until(lambda: refusal(lambda: a.client.write_register(0, 1)) is None, "it is written")
    nats.freeze()
    wire.until(lambda: refusal(lambda: a.read(0)) == 6, "reads are refused")
    with pytest.raises(OSError, match="no contact with its log"):
        a.memory.read("holding_registers", 0, 1)
    nats.thaw()
    wire.until(lambda: refusal(lambda: a.read(0)) is None, "reads are served")


def test_the_status_shows_nodes_and_counts(node: Start) -> None:
    a, b = node("a", digest_steps=4), node("b", digest_steps=4)
    for number in range(10):
        a.client.write_register(0, number)
        b.client.write_register(1, number)
    wire.until(lambda: (a.log.status()["digest"] or (0, "", None))[2] is True, "digests agree")
    status = a.log.status()
    assert status["phase"] == "running"
    assert status["connected"]
    assert status["failure"] is None
    assert status["steps"] == 10
    assert status["sequence"] >= 20
    assert status["lag"] == status["last_sequence"] - status["sequence"]
    assert status["contact_age"] is not None
    assert [each["name"] for each in status["nodes"]] == ["a", "b"]
    names = [name for name, _ in a.log.events(0)]
    assert names[:2] == ["log_connected", "log_caught_up"]
    a.log.stop()
    assert a.log.status()["phase"] == "stopped"
    assert refusal(lambda: a.client.write_register(0, 1)) == 6


def test_another_layout_is_refused(node: Start, nats: NatsServer) -> None:
    node("a")
    other = Log("site", "b", [nats.url], [("plant", plant(101))])
    with pytest.raises(
        LogError, match=r"holding_registers 0\+100 in the log.*another name"
    ) as error:
        other.start(wire.DEADLINE)
    assert error.value.kind == "layout"


def test_without_a_server_the_start_ends_in_time() -> None:
    log = Log("site", "a", [f"nats://127.0.0.1:{free_port()}"], [("plant", plant())])
    told = r"not caught up with the log within 0\.3 s: connect"
    with pytest.raises(LogError, match=told) as error:
        log.start(0.3)
    assert error.value.kind == "no_connection"
    assert log.status()["phase"] == "stopped"


def test_a_start_does_not_count_the_time_for_which_it_waits_for_other_nodes(
    nats: NatsServer,
) -> None:
    def sealed() -> holdfast.Memory:
        return holdfast.Memory(coils=64, seal=("coils", 7, "once"))

    def log(node: str, memory: holdfast.Memory) -> Log:
        return Log("site", node, [nats.url], [("plant", memory)])

    memory = sealed()
    before = log("a", memory), log("b", sealed())
    for each in before:
        each.start(wire.DEADLINE)
    memory.write("coils", 7, [True])
    for each in before:
        each.stop()
    again = sealed()
    alone = log("a", again)
    # Nobody answers for 10 s.
    alone.start(5)
    assert (alone.status()["phase"], again.sealed) == ("running", True)
    alone.stop()


def test_a_signal_ends_the_start() -> None:
    log = Log("site", "a", [f"nats://127.0.0.1:{free_port()}"], [("plant", plant())])
    main = threading.main_thread().ident
    assert main is not None
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        threading.Timer(0.2, signal.pthread_kill, (main, signal.SIGINT)).start()
        with pytest.raises(KeyboardInterrupt):
            log.start(wire.DEADLINE)
    finally:
        signal.signal(signal.SIGINT, before)
    assert log.status()["phase"] == "stopped"


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"name": "a.b"}, "name is"),
        ({"node": ""}, "node is"),
        ({"servers": []}, "servers are empty"),
        ({"replicas": 2}, "replicas is 2, allowed: 1, 3, 5"),
        ({"replicas": 7}, "replicas is 7"),
        ({"write_timeout": 0.0}, "write_timeout is 0 s, at least 0.05 s"),
        ({"write_timeout": -1.0}, "write_timeout"),
        ({"max_lag": 0.0}, "max_lag is 0 s"),
        ({"when_behind": "wait"}, "when_behind is"),
        ({"digest_steps": 0}, "digest_steps is 0"),
        ({"memories": []}, "memories are empty"),
        ({"tls": (None, "cert.pem", None)}, "tls: give certificate and key, or neither"),
        ({"user": "a", "token_file": "b"}, "not several"),
    ],
)
def test_unusable_arguments_are_named(changed: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"name": "site", "node": "a", "servers": ["nats://127.0.0.1"]}
    arguments |= {"memories": [("plant", plant())]}
    with pytest.raises(ValueError, match=message):
        Log(**(arguments | changed))


def test_a_memory_has_one_log() -> None:
    memory = plant()
    servers = ["nats://127.0.0.1"]
    with pytest.raises(ValueError, match='"x" is named twice'):
        Log("site", "a", servers, [("x", memory), ("x", memory)])
    Log("site", "a", servers, [("plant", memory)])
    with pytest.raises(ValueError, match='"plant" is kept elsewhere already'):
        Log("other", "a", servers, [("plant", memory)])


def test_a_file_that_is_missing_is_named(tmp_path: Path, nats: NatsServer) -> None:
    for options in (
        {"token_file": tmp_path / "missing"},
        {"user": "a", "password_file": tmp_path / "missing"},
        {"credentials_file": tmp_path / "missing"},
        {"tls": (tmp_path / "missing", None, None)},
    ):
        log = Log("site", "a", [nats.url], [("plant", plant())], **options)
        with pytest.raises(ValueError, match=r"missing: .*No such file"):
            log.start(wire.DEADLINE)


def test_a_log_is_replayed_to_a_sequence_or_a_time(node: Start, nats: NatsServer) -> None:
    a = node("a")
    for number in (1, 2, 3):
        a.client.write_register(0, number)
    a.client.mask_write(1, and_mask=0, or_mask=0xFF)
    a.client.read_write(0, 2, 5, [6])
    a.memory.write("coils", 1, [1, 0, 1])

    def replay(**until: Any) -> tuple[LogReader, holdfast.Memory, list[Any]]:
        memory = plant()
        reader = LogReader("site", [nats.url], [("plant", memory)], **until)
        records = []
        while not reader.ended:
            record = reader.next(wire.DEADLINE)
            if record is not None and record["steps"]:
                records.append(record)
        return reader, memory, records

    reader, memory, records = replay()
    steps = [step for record in records for step in record["steps"]]
    register: Area = "holding_registers"
    assert steps == [
        *(
            {"access": "client", "action": "write", "writes": [("plant", register, 0, [number])]}
            for number in (1, 2, 3)
        ),
        {
            "access": "client",
            "action": "mask",
            "place": ("plant", register, 1),
            "masks": (0, 0xFF),
        },
        {
            "access": "client",
            "action": "write_then_read",
            "writes": [("plant", register, 5, [6])],
            "read": ("plant", register, 0, 2),
        },
        {"access": "ingest", "action": "write", "writes": [("plant", "coils", 1, [1, 0, 1])]},
    ]
    assert all(record["node"] == "a" and record["fresh"] for record in records)
    assert memory.read(register, 0, 6) == a.memory.read(register, 0, 6)

    second = records[1]
    reader, memory, _ = replay(sequence=second["sequence"])
    assert reader.sequence == second["sequence"]
    assert memory.read(register, 0, 1) == [2]
    same = replay(sequence=second["sequence"])[0]
    assert same.digest() == reader.digest() != replay()[0].digest()
    _, memory, _ = replay(time_ns=second["time_ns"])
    assert memory.read(register, 0, 1) == [2]


def test_a_log_is_followed(node: Start, nats: NatsServer) -> None:
    a = node("a")
    memory = plant()
    reader = LogReader("site", [nats.url], [("plant", memory)], follow=True)
    for number in (5, 6, 7):
        a.client.write_register(0, number)
        while not (record := reader.next(wire.DEADLINE)) or not record["steps"]:
            pass
        assert memory.read("holding_registers", 0, 1) == [number]
    assert not reader.ended


def test_a_log_that_does_not_exist_is_not_made_to_replay_it(nats: NatsServer) -> None:
    for _ in range(2):
        with pytest.raises(ValueError, match='the servers have no log "site"'):
            LogReader("site", [nats.url], [("plant", plant())])

"""Functions 20, 21 and 24: files and queues of memories, as clients see them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast import _core
from support import lines, wire
from support.audits import await_writes
from support.lines import RTU, Line
from support.running import endpoint
from support.transports import (
    TRANSPORTS,
    FramedConnection,
    Transport,
    address,
    configuration,
    rule,
)

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from holdfast.appliance import Appliance
    from support.running import Connect, Run

FILES = {3: 11, 4: 10_000}
PLANT = {"holding_registers": 2000, "files": FILES, "fifo": [1246, 1990]}
MEMORIES = {"plant": PLANT, "plain": {"holding_registers": 2000}}
READ = bytes.fromhex("140706000400070002")
WRITE = bytes.fromhex("150d0600040007000306af04be100d")
QUEUE = bytes.fromhex("1804de")


@pytest.fixture(params=list(TRANSPORTS.values()), ids=list(TRANSPORTS))
def transport(request: pytest.FixtureRequest) -> Transport:
    either: Transport = request.param
    return either


@pytest.fixture
def appliance(transport: Transport, run: Run) -> Appliance:
    rules = [{"sources": ["127.0.0.1"], "units": {1: "plant", 2: "plain"}, "access": "read-write"}]
    return run(configuration(transport.kind, memories=MEMORIES, rules=rules, **transport.patient))


@pytest.fixture
def client(transport: Transport, appliance: Appliance) -> Iterator[Any]:
    with transport.client(address(appliance)) as made:
        yield made


def test_records_are_read_as_in_the_example_of_the_standard(
    client: Any, appliance: Appliance
) -> None:
    plant = appliance.memories["plant"]
    plant.write_many([("file:4", 1, [0x0DFE, 0x0020]), ("file:3", 9, [0x33CD, 0x0040])])

    asked = bytes.fromhex("140e0600040001000206000300090002")
    assert client.ask(asked).hex() == "140c05060dfe0020050633cd0040"


def test_records_are_written_as_in_the_example_of_the_standard(
    client: Any, appliance: Appliance
) -> None:
    assert client.ask(WRITE) == WRITE

    assert appliance.memories["plant"].read("file:4", 6, 5) == [0, 0x06AF, 0x04BE, 0x100D, 0]


def test_a_queue_is_read_as_in_the_example_of_the_standard(
    client: Any, appliance: Appliance
) -> None:
    assert client.ask(QUEUE).hex() == "1800020000"
    appliance.memories["plant"].write("holding_registers", 1246, [2, 0x01B8, 0x1284, 7])

    for _ in range(2):
        assert client.ask(QUEUE).hex() == "180006000201b81284"


def test_a_queue_has_31_registers_at_most(client: Any, appliance: Appliance) -> None:
    plant = appliance.memories["plant"]
    plant.write("holding_registers", 1246, range(31, 63))
    assert client.ask(QUEUE).hex() == "180040001f" + "".join(
        f"{each:04x}" for each in range(32, 63)
    )
    plant.write("holding_registers", 1246, [32])
    assert client.ask(QUEUE) == b"\x98\x03"


def test_only_the_registers_that_are_listed_are_queues(client: Any, appliance: Appliance) -> None:
    assert client.ask(bytes.fromhex("1804df")) == b"\x98\x02"
    appliance.memories["plant"].write("holding_registers", 1990, [9])
    assert client.ask(bytes.fromhex("1807c6"))[:5].hex() == "1800140009"
    appliance.memories["plant"].write("holding_registers", 1990, [10])
    assert client.ask(bytes.fromhex("1807c6")) == b"\x98\x02"


def test_a_memory_without_files_and_queues_does_not_have_their_functions(client: Any) -> None:
    for asked in (READ, WRITE, QUEUE):
        assert client.ask(asked, 2) == bytes([asked[0] | 0x80, 1])


@pytest.mark.parametrize(
    ("asked", "code"),
    [
        ("1406060004000700", 3),
        ("140806000400070002", 3),
        ("14070600040007007a", 3),
        ("150706000400070000", 3),
        ("15ff0600040007", 3),
        ("140705000400070002", 2),
        ("140706000000070002", 2),
        ("140706000500070002", 2),
        ("1407060004270f0002", 2),
        ("140706000427100001", 2),
        ("15090500040007000106af", 2),
        ("1509060003000b000106af", 2),
    ],
)
def test_what_is_wrong_has_the_exception_of_the_diagrams(
    client: Any, appliance: Appliance, asked: str, code: int
) -> None:
    pdu = bytes.fromhex(asked)
    if isinstance(client, FramedConnection) and client.mode is RTU and pdu[1] != len(pdu) - 2:
        return  # The byte count says where a frame of RTU ends.

    assert client.ask(pdu) == bytes([pdu[0] | 0x80, code])
    assert appliance.memories["plant"].read("file:3", 0, 11) == [0] * 11


def test_all_records_of_a_request_are_written_or_none(client: Any, appliance: Appliance) -> None:
    both = bytes.fromhex("1512" + "06000400070001aaaa" + "06000300090001bbbb")
    beyond = both.replace(b"\x00\x09", b"\x00\x0b").replace(b"\xaa\xaa", b"\xcc\xcc")

    assert client.ask(both) == both
    assert client.ask(beyond) == b"\x95\x02"
    plant = appliance.memories["plant"]
    assert plant.read_many([("file:4", 7, 1), ("file:3", 9, 1)]) == [[0xAAAA], [0xBBBB]]


def test_our_client_reads_and_writes_them(transport: Transport, appliance: Appliance) -> None:
    host, port = address(appliance)
    values = list(range(300))
    with holdfast.SyncClient(f"{transport.scheme}://{host}:{port}") as client:
        for first in range(0, 300, 100):
            client.write_file_record(4, 9700 + first, values[first : first + 100])
        assert client.read_file_record(4, 9700, 300) == values
        assert client.read_file_records([(4, 9701, 2), (3, 0, 1)]) == [[1, 2], [0]]
        client.write_registers(1246, [3, 7, 8, 9])
        assert client.read_fifo_queue(1246) == [7, 8, 9]


def test_a_line_has_them_and_takes_a_broadcast(run: Run, tmp_path: Path) -> None:
    with Line(tmp_path / "line", RTU) as line:
        text = lines.configuration(line.mode, line.device, memories=MEMORIES)
        appliance = run(text)
        assert line.ask(WRITE) == WRITE
        broadcast = WRITE.replace(b"\x06\xaf", b"\x77\x77")
        line.send(RTU.frame(broadcast, 0))
        plant = appliance.memories["plant"]
        wire.until(lambda: plant.read("file:4", 7, 1) == [0x7777], "it is carried out")


# Rights, the seal, and what is recorded


def ask(appliance: Appliance, pdu: bytes) -> bytes:
    with wire.Connection(endpoint(appliance, "scada")) as connection:
        return connection.ask(pdu)


@pytest.mark.parametrize(
    ("unit", "codes"),
    [
        ({"access": "read-only"}, (0, 1, 0)),
        ({"functions": [3, 21]}, (1, 0, 1)),
        ({"deny": [24]}, (0, 0, 1)),
        ({"read": [{"area": "holding_registers", "start": 1246, "end": 1277}]}, (2, 0, 0)),
        ({"read": [{"area": "holding_registers", "start": 1246, "end": 1276}]}, (2, 0, 2)),
        ({"write": [{"area": "holding_registers", "start": 0, "end": 9}]}, (0, 2, 0)),
    ],
)
def test_rules_decide_as_for_other_functions(
    run: Run, unit: dict[str, Any], codes: tuple[int, int, int]
) -> None:
    rules = [rule(["127.0.0.1"]) | {"units": {1: {"memory": "plant", **unit}}}]
    appliance = run(configuration("tcp", memories=MEMORIES, rules=rules))

    for asked, code in zip((READ, WRITE, QUEUE), codes, strict=True):
        expected = asked[0] if code == 0 else asked[0] | 0x80
        answer = ask(appliance, asked)
        assert (answer[0], answer[1] if code else 0) == (expected, code)


def test_a_sealed_memory_is_busy(run: Run) -> None:
    seal = {"area": "coils", "address": 0, "mode": "level"}
    memories = {"plant": {**PLANT, "coils": 1, "seal": seal}}
    appliance = run(configuration("tcp", memories=memories))

    for asked in (READ, WRITE, QUEUE):
        assert ask(appliance, asked) == bytes([asked[0] | 0x80, 6])
    appliance.memories["plant"].write("coils", 0, [1])
    assert ask(appliance, WRITE) == WRITE


def test_a_write_of_records_is_one_line_of_the_audit_log(run: Run, tmp_path: Path) -> None:
    text = configuration("tcp", memories=MEMORIES, more={"audit": {"file": "audit.log"}})
    appliance = run(text)
    ask(appliance, READ)
    ask(appliance, bytes.fromhex("151406000400070001aaaa" + "060003000a0002bbbbcccc"))
    ask(appliance, bytes.fromhex("151206000400070001aaaa" + "060003000a0001bbbb"))

    refused, done = await_writes(tmp_path / "audit.log", 2)
    assert (refused["function"], refused["outcome"]) == (21, "illegal_data_address")
    assert (done["function"], done["outcome"], done["unit"]) == (21, "done", 1)
    assert done["records"] == [
        {"area": "file:4", "address": 7, "values": [0xAAAA]},
        {"area": "file:3", "address": 10, "values": [0xBBBB]},
    ]


def test_requests_are_counted(run: Run) -> None:
    appliance = run(configuration("tcp", memories=MEMORIES))
    for asked in (READ, WRITE, QUEUE, QUEUE):
        ask(appliance, asked)

    counted = appliance.diagnostics.stats()["listeners"]["scada"]["requests"]
    assert {code: counted[code] for code in (20, 21, 24)} == {20: 1, 21: 1, 24: 2}


# The library


def test_a_memory_of_a_script_has_files_and_queues(connect: Connect) -> None:
    memory = holdfast.Memory(holding_registers=10, files=FILES)
    seen: list[tuple[bool, int, list[int]]] = []

    # A type checker knows that it may be a file.
    calls = memory.on_write(
        lambda area, address, values: seen.append((area == "file:4", address, values)),
        clients_only=True,
    )
    rules = [holdfast.Rule({1: memory}, sources=["127.0.0.1"], access="read-write", fifo={1: [5]})]
    with holdfast.Server(bind="127.0.0.1:0", rules=rules) as server:
        client = connect(server.address)
        assert client.ask(WRITE) == WRITE
        assert client.ask(bytes.fromhex("180005")).hex() == "1800020000"
        wire.until(lambda: bool(seen), "the callback is called")
    calls.close()
    assert seen == [(True, 7, [0x06AF, 0x04BE, 0x100D])]
    assert memory.files == FILES
    assert list(memory.areas) == ["holding_registers"]
    assert "file:3=11" in repr(memory)


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({0: 1}, "file is 0, allowed: 1 to 65535"),
        ({65_536: 1}, "file is 65536"),
        ({1: 0}, "number of records is 0, allowed: 1 to 10000"),
        ({1: 10_001}, "number of records is 10001"),
    ],
)
def test_impossible_files_are_refused(files: dict[int, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        holdfast.Memory(coils=1, files=files)


def test_records_outside_a_file_are_out_of_range() -> None:
    memory = holdfast.Memory(coils=1, files={4: 10})
    for name, record, message in (
        ("file:4", 10, "file:4: 1 from address 10, allowed: addresses 0 to 9"),
        ("file:5", 0, "this memory has no file:5"),
    ):
        with pytest.raises(holdfast.OutOfRange, match=message):
            memory.read(name, record, 1)
    with pytest.raises(ValueError, match='unknown area "file:04"'):
        memory.read("file:04", 0, 1)
    with pytest.raises(ValueError, match='unknown area "file:4"'):
        _core.Request.read("file:4", 0, 1)  # type: ignore[arg-type]

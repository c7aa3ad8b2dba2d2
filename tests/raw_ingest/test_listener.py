"""Raw Ingest listeners from outside, over real sockets: packets go in, and one byte comes back."""

from __future__ import annotations

import contextlib
import itertools
import json
import logging
import struct
import threading
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from holdfast import raw_ingest
from holdfast.appliance import Appliance
from holdfast.config import load
from holdfast.types import AREAS
from support import wire
from support.cases import examples
from support.config_folder import written
from support.machine import needs_127_0_0_2
from support.paths import VECTORS
from support.wire import rounds

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from holdfast.types import Area

    Start = Callable[..., Appliance]

CASES = json.loads((VECTORS / "raw_ingest.json").read_text())
SIZES: dict[str, int] = CASES["memory"]
DONE, REFUSED = b"\x00", b"\x01"

# The names of the kinds of listeners, and what a configuration says for them.
KINDS: dict[str, dict[str, Any]] = {
    "v1": {"format": "v1"},
    "crc": {"format": "crc"},
    "none": {"format": "crc", "compat": {"crc": "none"}},
}


def listener(kind: str = "v1", **settings: Any) -> dict[str, Any]:
    """A listener for the memory plant, as unit 1 or by its memory id."""
    rule = {"sources": ["127.0.0.0/8", "::1"], "areas": list(AREAS)}
    target = {"units": {1: "plant"}} if kind == "v1" else {"memories": ["plant"]}
    return {
        "type": "raw-ingest",
        "bind": "127.0.0.1:0",
        "rules": [rule | target],
        # A packet that comes byte by byte takes long on a loaded machine.
        "request_timeout": wire.DEADLINE,
        **KINDS[kind],
        **settings,
    }


class Plant:
    """A running appliance with one Raw Ingest listener."""

    def __init__(self, appliance: Appliance) -> None:
        self.appliance = appliance
        self.memory = appliance.memories["plant"]
        self.address = self.at("raw")

    def at(self, name: str) -> tuple[str, int]:
        """Where a listener listens."""
        for endpoint in self.appliance.endpoints():
            if endpoint.name == name and endpoint.port is not None:
                return endpoint.host, endpoint.port
        raise AssertionError(f"no listener {name}")

    def connect(self, source: str | None = None) -> wire.Connection:
        return wire.Connection(self.address, source=source)

    def answer(self, *pieces: bytes, finish: bool = False, source: str | None = None) -> bytes:
        """All that comes back for a packet that arrives in these pieces."""
        with self.connect(source) as client:
            for number, piece in enumerate(pieces):
                if number:
                    self.until_taken(client)
                client.send(piece)
            if finish:
                client.finish()
            reply = client.rest()
            client.reset()  # Thousands of connections that linger would slow `until_taken` down.
            return reply

    def until_taken(self, client: wire.Connection) -> None:
        """Waits until the listener has read all that was sent, where the system tells."""
        wire.until_taken(client.socket)

    def content(self) -> dict[Area, list[int]]:
        ranges = [(area, where.start, len(where)) for area, where in self.memory.areas.items()]
        return dict(zip(self.memory.areas, self.memory.read_many(ranges), strict=True))

    def clear(self) -> None:
        for area, where in self.memory.areas.items():
            self.memory.write(area, where.start, [0] * len(where))

    def fill(self) -> dict[Area, list[int]]:
        """Puts a value other than zero everywhere, so that no write of zeros goes unseen."""
        for area, where in self.memory.areas.items():
            bits = area in AREAS[:2]
            values = [1 if bits else 1 + address for address in range(len(where))]
            self.memory.write(area, where.start, values)
        return self.content()

    def counted(self, of: str = "packets") -> dict[str, Any]:
        counters: dict[str, Any] = self.appliance.diagnostics.stats()["listeners"]["raw"][of]
        return counters

    def refusals(self) -> dict[str, int]:
        """How many packets were refused so far, by reason; only what is not zero."""
        refused: dict[str, int] = self.counted()["refused"]
        return {reason: count for reason, count in refused.items() if count}

    def is_well(self) -> bool:
        """Whether it still takes a packet."""
        packet = good(self.kind, "coils", 0, [1])
        return self.answer(packet) == DONE

    @property
    def kind(self) -> str:
        settings: Any = self.appliance.config.listeners["raw"]
        return "v1" if settings.format == "v1" else "crc" if settings.compat is None else "none"


def good(kind: str, area: Area, address: int, values: Any) -> bytes:
    """A packet for unit 1, or memory 1."""
    if kind == "v1":
        return raw_ingest.encode(area, address, values, unit=1)
    return raw_ingest.encode(
        area, address, values, memory_id=1, crc="none" if kind == "none" else None
    )


def sealed_with_crc(body: bytes) -> bytes:
    return body + struct.pack(">I", zlib.crc32(body))


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Starts an appliance with the memory plant, and the listener `raw`, and whatever is added."""
    with contextlib.ExitStack() as running:

        def started(
            raw_listener: dict[str, Any],
            *,
            memories: dict[str, Any] | None = None,
            listeners: dict[str, Any] | None = None,
            **more: Any,
        ) -> Appliance:
            plant: dict[str, Any] = {"id": 1, **SIZES}
            document = {
                "memories": {"plant": plant} | (memories or {}),
                "listeners": {"raw": raw_listener} | (listeners or {}),
                **more,
            }
            file = tmp_path / "appliance.yaml"
            file.write_text(written(document))
            return running.enter_context(Appliance(load(file)))

        yield started


@pytest.fixture(params=KINDS)
def kind(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    return name


@pytest.fixture
def plant(start: Start, kind: str) -> Plant:
    """A listener of each kind."""
    return Plant(start(listener(kind)))


# Vectors


def vector(case: dict[str, Any], kind: str) -> bytes | None:
    """The packet of a vector; where it ends with a CRC and none is expected, without it."""
    text = case["v1" if kind == "v1" else "crc"]
    if text is None:
        return None
    packet = bytes.fromhex(text)
    if kind == "none" and len(packet) >= 16:
        return packet[:-4]
    return packet


def after(case: dict[str, Any]) -> dict[str, list[int]]:
    """Memory after an accepted vector."""
    expected = {area: [0] * size for area, size in SIZES.items()}
    start = case["address"]
    expected[case["area"]][start : start + len(case["values"])] = case["values"]
    return expected


ACCEPTED = CASES["accepted"]

# Without a CRC there is nothing wrong with the first; the others, with four bytes less, are others.
NOT_WITHOUT_CRC = {"wrong CRC", "payload one byte short", "the other format"}

REASONS = {
    "magic": "magic",
    "version 2": "version",
    "area 0": "area",
    "area 5": "area",
    "count 0": "count",
    "unit or memory not mapped": "unit or memory",
    "unit id above 255": "unit or memory",
    "one past the end": "range",
    "start past the end": "range",
    "address plus count wraps at 65536": "range",
    "payload one byte short": "short",
    "header cut": "short",
    "nothing at all": None,
    "the other format": "area or flags",
    "wrong CRC": "crc",
    "flags not zero": "flags",
    "reserved not zero": "flags",
}


def refused_vectors(kind: str) -> list[tuple[dict[str, Any], bytes]]:
    cases = [case for case in CASES["refused"] if case["name"] not in NOT_WITHOUT_CRC]
    cases = cases if kind == "none" else CASES["refused"]
    found = [(case, vector(case, kind)) for case in cases]
    return [(case, packet) for case, packet in found if packet is not None]


def test_accepted_vectors_reach_memory(plant: Plant, kind: str) -> None:
    for case in ACCEPTED:
        for finish in (False, True):
            plant.clear()
            packet = vector(case, kind)
            assert packet is not None
            assert plant.answer(packet, finish=finish) == DONE, case["name"]
            assert plant.content() == after(case), case["name"]
    values = sum(5 if "stray" in case["name"] else len(case["values"]) for case in ACCEPTED)
    assert plant.counted() == {
        "accepted": 2 * len(ACCEPTED),
        "values": 2 * values,
        "surplus_bytes": 0,
        "dropped_bytes": 0,
        "held_bytes": 0,
        "refused": {},
    }


def test_refused_vectors_leave_memory_as_it_was(plant: Plant, kind: str) -> None:
    before, counted = plant.fill(), 0
    for case, packet in refused_vectors(kind):
        reply = plant.answer(packet, finish=True)
        assert (reply.hex(), plant.content()) == (case["reply"], before), case["name"]
        counted += reply == REFUSED
        assert sum(plant.refusals().values()) == counted, case["name"]
    assert plant.counted()["accepted"] == plant.counted()["values"] == 0


def test_refused_vectors_are_counted_by_reason(plant: Plant, kind: str) -> None:
    words = {
        "unit or memory": "unit" if kind == "v1" else "memory",
        "area or flags": "area" if kind == "v1" else "flags",
    }
    before: dict[str, int] = {}
    for case, packet in refused_vectors(kind):
        plant.answer(packet, finish=True)
        now = plant.refusals()
        risen = {reason for reason in now if now[reason] != before.get(reason)}
        reason = REASONS[case["name"]]
        expected = set() if reason is None else {words.get(reason, reason)}
        assert risen == expected, case["name"]
        before = now


def test_the_reason_of_a_refusal_is_logged(start: Start, caplog: pytest.LogCaptureFixture) -> None:
    plant = Plant(start(listener("v1")))
    assert plant.answer(b"ri") == REFUSED
    logged = threading.Event()
    with caplog.at_level(logging.WARNING, "holdfast"):
        for _ in rounds(logged):
            plant.appliance.log_events(0.1)
            if caplog.records:
                logged.set()
    [record] = caplog.records
    fields: dict[str, object] = vars(record)["fields"]
    assert record.getMessage() == "packet_refused"
    assert (fields["listener"], fields["reason"]) == ("raw", "magic")


# Pieces


def test_a_packet_may_be_cut_in_two_anywhere(plant: Plant, kind: str) -> None:
    for case in ACCEPTED:
        packet = vector(case, kind)
        assert packet is not None
        for cut in range(1, len(packet)):
            plant.clear()
            assert plant.answer(packet[:cut], packet[cut:]) == DONE, (case["name"], cut)
            assert plant.content() == after(case), (case["name"], cut)
    assert plant.refusals() == {}


def test_a_refused_packet_may_be_cut_in_two_anywhere(plant: Plant, kind: str) -> None:
    before = plant.fill()
    for case, packet in refused_vectors(kind):
        for cut in range(1, len(packet)):
            reply = plant.answer(packet[:cut], packet[cut:], finish=True)
            assert (reply, plant.content()) == (REFUSED, before), (case["name"], cut)
    assert plant.counted()["accepted"] == 0


def test_packets_may_come_byte_by_byte(plant: Plant, kind: str) -> None:
    for case in ACCEPTED:
        plant.clear()
        packet = vector(case, kind)
        assert packet is not None
        pieces = [packet[place : place + 1] for place in range(len(packet))]
        assert plant.answer(*pieces) == DONE, case["name"]
        assert plant.content() == after(case), case["name"]


def test_nothing_is_written_before_the_last_byte_is_there(plant: Plant, kind: str) -> None:
    before = plant.fill()
    packet = good(kind, "holding_registers", 0, [0] * 128)
    with plant.connect() as client:
        client.send(packet[:-1])
        plant.until_taken(client)
        assert plant.content() == before
        client.send(packet[-1:])
        assert client.rest() == DONE
    assert plant.content() == {**before, "holding_registers": [0] * 128}


# Damage


@pytest.mark.parametrize("area", ["coils", "holding_registers"])
def test_every_wrong_bit_is_found_by_the_crc(area: Area, start: Start) -> None:
    plant = Plant(start(listener("crc")))
    before = plant.fill()
    packet = good("crc", area, 3, [0, 0])
    for bit in range(len(packet) * 8):
        damaged = bytearray(packet)
        damaged[bit // 8] ^= 1 << bit % 8
        assert plant.answer(bytes(damaged), finish=True) == REFUSED, bit
        assert plant.content() == before, bit
    assert sum(plant.refusals().values()) == len(packet) * 8
    assert plant.answer(packet) == DONE


def test_a_packet_that_ends_early_is_refused(plant: Plant, kind: str) -> None:
    before = plant.fill()
    packet = good(kind, "coils", 0, [0] * 20)
    for length in range(1, len(packet)):
        assert plant.answer(packet[:length], finish=True) == REFUSED, length
    assert plant.content() == before
    assert plant.refusals() == {"short": len(packet) - 1}


def test_a_packet_that_is_reset_in_the_middle_leaves_memory_as_it_was(
    plant: Plant, kind: str
) -> None:
    before = plant.fill()
    packet = good(kind, "coils", 0, [0] * 20)
    for length in range(len(packet)):
        client = plant.connect()
        client.send(packet[:length])
        plant.until_taken(client)
        client.reset()
    wire.until(lambda: plant.counted("connections")["open"] == 0, "all connections have ended")
    assert plant.content() == before
    assert plant.counted()["accepted"] == 0
    assert plant.is_well()


def test_a_packet_is_written_though_nobody_waits_for_the_reply(plant: Plant, kind: str) -> None:
    for ending in (wire.Connection.close, wire.Connection.reset):
        plant.clear()
        accepted = plant.counted()["accepted"]
        client = plant.connect()
        client.send(good(kind, "coils", 0, [1]))
        plant.until_taken(client)
        ending(client)
        wire.until(lambda n=accepted: plant.counted()["accepted"] == n + 1, "it is written")  # type: ignore[misc]
        assert plant.content()["coils"][0] == 1


# Bytes behind a packet


def surplus(plant: Plant) -> int:
    """Bytes behind packets so far, once no connection is left."""
    wire.until(lambda: plant.counted("connections")["open"] == 0, "all connections have ended")
    counted: int = plant.counted()["surplus_bytes"]
    return counted


def logged(plant: Plant, caplog: pytest.LogCaptureFixture, event: str) -> list[dict[str, Any]]:
    """The fields of the events of a kind, once there is one."""

    def found() -> list[dict[str, Any]]:
        with caplog.at_level(logging.WARNING, "holdfast"):
            plant.appliance.log_events(0.0)
        return [vars(each)["fields"] for each in caplog.records if each.getMessage() == event]

    wire.until(found, event)
    return found()


def test_a_packet_is_written_whatever_follows_it_and_however_it_is_cut(
    plant: Plant, kind: str
) -> None:
    expected = 0
    for case in CASES["followed"]:
        text = case["v1" if kind == "v1" else "crc"]
        if text is None:
            continue
        sent = bytes.fromhex(text)
        # A sender that appends a CRC where none is expected has four more.
        more = case["surplus"] + 4 * (kind == "none")
        for cut in range(len(sent)):
            plant.clear()
            pieces = [sent[:cut], sent[cut:]] if cut else [sent]
            assert plant.answer(*pieces, finish=True) == DONE, (case["name"], cut)
            assert plant.content() == after(case), (case["name"], cut)
            expected += more
            assert surplus(plant) == expected, (case["name"], cut)
    assert plant.refusals() == {}


def test_any_number_of_bytes_behind_a_packet_is_read_and_counted(plant: Plant, kind: str) -> None:
    packet = good(kind, "coils", 0, [1] * 8)
    for count in (1, len(packet), 5000, 1 << 20):
        before = surplus(plant)
        with plant.connect() as client:
            client.send(packet + bytes(count))
            client.finish()
            assert client.rest() == DONE
        assert surplus(plant) - before == count
    assert plant.counted()["accepted"] == 4
    assert plant.content()["coils"][:9] == [1] * 8 + [0]


def test_bytes_behind_a_packet_that_arrive_after_the_reply_are_counted_and_reset_nothing(
    plant: Plant, kind: str
) -> None:
    with plant.connect() as client:
        client.send(good(kind, "coils", 0, [1]))
        assert client.rest() == DONE
        client.send(bytes(3))
        client.send(bytes(2))
    assert surplus(plant) == 5


def test_bytes_behind_a_packet_are_logged_once_for_each_connection(
    start: Start, caplog: pytest.LogCaptureFixture
) -> None:
    plant = Plant(start(listener("v1")))
    with plant.connect() as client:
        peer = "{}:{}".format(*client.socket.getsockname())
        client.send(good("v1", "coils", 0, [1]) + bytes(2))
        assert client.rest() == DONE
        client.send(bytes(5))
    assert surplus(plant) == 7
    assert logged(plant, caplog, "surplus_bytes") == [{"listener": "raw", "peer": peer, "bytes": 7}]
    assert [each.levelname for each in caplog.records] == ["WARNING"]


def test_bytes_behind_a_refused_packet_are_not_counted(plant: Plant, kind: str) -> None:
    packet = bytearray(good(kind, "coils", 0, [1]))
    packet[-1 if kind == "crc" else 0] ^= 1
    assert plant.answer(bytes(packet) + bytes(9), finish=True) == REFUSED
    assert surplus(plant) == 0


# Time


def test_a_packet_that_takes_too_long_is_refused(start: Start) -> None:
    plants = {kind: Plant(start(listener(kind, request_timeout=1))) for kind in KINDS}
    before = {kind: plant.fill() for kind, plant in plants.items()}
    clients = {}
    with contextlib.ExitStack() as opened:
        for kind, plant in plants.items():
            packet = good(kind, "coils", 0, [0] * 20)
            for length in (1, 9, 12, len(packet) - 1):
                clients[kind, length] = opened.enter_context(plant.connect())
                clients[kind, length].send(packet[:length])
        for case, client in clients.items():
            assert client.rest() == REFUSED, case
    for kind, plant in plants.items():
        assert plant.content() == before[kind]
        assert plant.refusals() == {"late": 4}


def test_no_byte_of_a_packet_extends_its_deadline(start: Start) -> None:
    """A byte every 20 ms would take 20 s for this packet."""
    plant = Plant(start(listener("v1", request_timeout=1)))
    packet = good("v1", "coils", 0, [1])[:10] + bytes(1000)
    packet = packet[:3] + b"\x03" + packet[4:8] + b"\x00\x64" + packet[10:]
    between = threading.Event()
    with plant.connect() as client:
        sent = 0
        client.socket.setblocking(False)
        for place in range(len(packet)):
            client.socket.send(packet[place : place + 1])
            between.wait(0.02)
            sent += 1
            with contextlib.suppress(BlockingIOError):
                assert client.socket.recv(1) == REFUSED
                break
        assert 1 < sent < len(packet)
    assert plant.refusals() == {"late": 1}


def test_a_peer_that_sends_nothing_gets_nothing(start: Start, kind: str) -> None:
    plant = Plant(start(listener(kind, request_timeout=0.2)))
    assert plant.answer() == b""
    assert plant.answer(finish=True) == b""
    plant.connect().close()
    plant.connect().reset()
    wire.until(lambda: plant.counted("connections")["open"] == 0, "all connections have ended")
    assert plant.counted() == {
        "accepted": 0,
        "values": 0,
        "surplus_bytes": 0,
        "dropped_bytes": 0,
        "held_bytes": 0,
        "refused": {},
    }


def test_stopping_ends_what_has_begun(start: Start) -> None:
    plant = Plant(start(listener("v1")))
    before = plant.content()
    packet = good("v1", "coils", 0, [1] * 20)
    with plant.connect() as silent, plant.connect() as begun, plant.connect() as refused:
        begun.send(packet[:-1])
        plant.until_taken(begun)
        refused.send(b"no")
        plant.until_taken(refused)
        plant.appliance.stop()
        assert [client.rest() for client in (silent, begun, refused)] == [b"", b"", REFUSED]
    assert plant.content() == before


# Replies


@pytest.mark.parametrize("why", ["magic", "unit", "range", None])
def test_the_reply_arrives_though_much_more_was_sent(why: str | None, start: Start) -> None:
    """A socket that is closed with unread bytes resets the connection, reply and all."""
    plant = Plant(start(listener("v1")))
    packet = bytearray(good("v1", "coils", 0, [1]))
    if why is not None:
        packet[{"magic": 0, "unit": 4, "range": 6}[why]] = 0xFF
    for _ in range(5):
        with plant.connect() as client:
            client.send(bytes(packet) + bytes(10_000_000))
            assert client.socket.recv(2) == (DONE if why is None else REFUSED)
            assert client.socket.recv(1) == b""
    assert plant.refusals() == ({} if why is None else {why: 5})


def test_a_reply_is_one_byte_and_the_connection_ends(plant: Plant, kind: str) -> None:
    for packet, reply in ((good(kind, "coils", 0, [1]), DONE), (b"no", REFUSED)):
        with plant.connect() as client:
            client.send(packet)
            assert client.rest() == reply


def test_a_refused_packet_is_answered_before_it_is_whole(plant: Plant, kind: str) -> None:
    too_far = bytearray(good(kind, "holding_registers", 0, [0] * 2)[:-2])
    too_far[8 if kind == "v1" else 10] = 0xFF
    with plant.connect() as client:
        client.send(bytes(too_far))
        assert client.socket.recv(1) == REFUSED
    assert plant.refusals() == {"range": 1}


# Rights


def test_a_source_that_no_rule_names_gets_no_byte(start: Start) -> None:
    rule = {"sources": ["10.0.0.0/8"], "units": {1: "plant"}, "areas": list(AREAS)}
    plant = Plant(start(listener("v1", rules=[rule])))
    before = plant.fill()
    with plant.connect() as client:
        with contextlib.suppress(ConnectionError):
            client.send(good("v1", "coils", 0, [0]))
        assert client.rest() == b""
    assert plant.content() == before
    assert plant.counted() == {
        "accepted": 0,
        "values": 0,
        "surplus_bytes": 0,
        "dropped_bytes": 0,
        "held_bytes": 0,
        "refused": {},
    }
    assert plant.counted("connections")["refused_source"] == 1


def test_an_area_that_is_not_granted_is_refused(start: Start, kind: str) -> None:
    plain = listener(kind)
    plain["rules"][0]["areas"] = ["discrete_inputs", "input_registers"]
    plant = Plant(start(plain))
    before = plant.fill()
    for area in AREAS:
        values = [1 if area in AREAS[:2] else 7]
        granted = area in ("discrete_inputs", "input_registers")
        expected = DONE if granted else REFUSED
        assert plant.answer(good(kind, area, 0, values)) == expected
    expected_after = {**before, "input_registers": [7, *before["input_registers"][1:]]}
    assert plant.content() == expected_after
    assert plant.refusals() == {"not_granted": 2}


@needs_127_0_0_2
@pytest.mark.parametrize("kind", ["v1", "crc"])
def test_the_first_rule_for_a_source_says_which_memories_it_writes(start: Start, kind: str) -> None:
    targets: list[dict[str, Any]] = [
        {"units": {1: "plant"}} if kind == "v1" else {"memories": ["plant"]},
        {"units": {1: "other"}} if kind == "v1" else {"memories": ["other"]},
    ]
    rules = [
        {"sources": [source], "areas": ["coils"], **target}
        for source, target in zip(("127.0.0.1", "127.0.0.0/8"), targets, strict=True)
    ]
    other = {"id": 1 if kind == "v1" else 2, "coils": 64}
    if kind == "v1":
        del other["id"]
    plant = Plant(start(listener(kind, rules=rules), memories={"other": other}))
    memories = plant.appliance.memories

    def packet(memory_id: int) -> bytes:
        if kind == "v1":
            return raw_ingest.encode("coils", 0, [1], unit=1)
        return raw_ingest.encode("coils", 0, [1], memory_id=memory_id)

    assert plant.answer(packet(2), source="127.0.0.2") == DONE
    assert [memories[name].read("coils", 0, 1) for name in ("plant", "other")] == [[0], [1]]
    assert plant.answer(packet(1), source="127.0.0.1") == DONE
    assert memories["plant"].read("coils", 0, 1) == [1]
    if kind == "crc":
        assert plant.answer(packet(1), source="127.0.0.2") == REFUSED
        assert plant.refusals() == {"memory": 1}


def test_unit_ids_and_memory_ids_have_16_bits(start: Start) -> None:
    rule = {"sources": ["127.0.0.1"], "units": {65535: "plant", 0: "plant"}, "areas": ["coils"]}
    plant = Plant(start(listener("v1", rules=[rule])))
    answers = [
        plant.answer(raw_ingest.encode("coils", 0, [1], unit=unit)) for unit in (0, 255, 65535)
    ]
    assert answers == [DONE, REFUSED, DONE]


def test_addresses_are_those_of_the_area(start: Start, kind: str) -> None:
    memory = {"id": 1, "input_registers": {"start": 1000, "size": 3}}
    plain = listener(kind)
    plant = Plant(start(plain, memories={"plant": memory}))
    for address, values, reply in (
        (1000, [1, 2, 3], DONE),
        (1002, [4], DONE),
        (999, [9], REFUSED),
        (999, [9, 9], REFUSED),
        (1001, [9, 9, 9], REFUSED),
        (1003, [9], REFUSED),
        (0, [9], REFUSED),
    ):
        assert plant.answer(good(kind, "input_registers", address, values)) == reply, address
    assert plant.answer(good(kind, "coils", 1000, [1])) == REFUSED
    assert plant.content() == {"input_registers": [1, 2, 4]}
    assert plant.refusals() == {"range": 6}


def test_the_last_address_is_65535(start: Start, kind: str) -> None:
    coils = {"start": 65530, "size": 6}
    memory: dict[str, Any] = {"id": 1, "coils": coils, "holding_registers": 65536}
    plant = Plant(start(listener(kind), memories={"plant": memory}))
    assert plant.answer(good(kind, "coils", 65530, [1] * 6)) == DONE
    assert plant.answer(good(kind, "holding_registers", 65535, [7])) == DONE
    assert plant.memory.read("holding_registers", 65534, 2) == [0, 7]


# The seal


@pytest.mark.parametrize("gate", ["discrete_inputs", "coils"])
def test_a_packet_that_sets_the_gate_bit_opens_a_sealed_memory(start: Start, gate: Area) -> None:
    memory = {"id": 1, **SIZES, "seal": {"area": gate, "address": 5, "mode": "level"}}
    modbus = {
        "type": "modbus-tcp",
        "bind": "127.0.0.1:0",
        "rules": [{"sources": ["127.0.0.1"], "units": {1: "plant"}, "access": "read-only"}],
    }
    appliance = start(listener("v1"), memories={"plant": memory}, listeners={"scada": modbus})
    plant = Plant(appliance)
    scada = plant.at("scada")
    read = bytes.fromhex("0300000001")
    with wire.Connection(scada) as client:
        assert plant.answer(good("v1", "holding_registers", 0, [7])) == DONE
        assert client.ask(read) == bytes.fromhex("8306")
        assert plant.answer(good("v1", gate, 0, [1, 1, 1, 1, 1, 0])) == DONE
        assert client.ask(read) == bytes.fromhex("8306")
        assert plant.answer(good("v1", gate, 5, [1])) == DONE
        assert client.ask(read) == bytes.fromhex("03020007")
        assert plant.answer(good("v1", gate, 0, [0] * 6)) == DONE
        assert client.ask(read) == bytes.fromhex("8306")
    assert plant.memory.seal_changes == (1, 1)


# Whole areas


class Whole(NamedTuple):
    """An area of 65535 values, and the two contents that packets write over and over."""

    area: Area
    contents: tuple[list[int], list[int]]


WHOLE = [
    Whole("holding_registers", ([0x0101] * 65535, [0xFEFE] * 65535)),
    Whole("discrete_inputs", ([1] * 65535, [0] * 65535)),
]


@pytest.mark.parametrize("whole", WHOLE, ids=lambda whole: whole.area)
def test_a_packet_over_a_whole_area_is_never_seen_in_part(
    whole: Whole, start: Start, kind: str
) -> None:
    area, contents = whole
    memory = {"id": 1, area: 65535}
    modbus = {
        "type": "modbus-tcp",
        "bind": "127.0.0.1:0",
        "rules": [{"sources": ["127.0.0.1"], "units": {1: "plant"}, "access": "read-only"}],
    }
    more = {"memories": {"plant": memory}, "listeners": {"scada": modbus}, "workers": 2}
    plant = Plant(start(listener(kind), **more))
    scada = plant.at("scada")
    packets = [good(kind, area, 0, values) for values in contents]
    assert plant.answer(packets[0]) == DONE
    assert plant.memory.read(area, 0, 65535) == contents[0]

    enough, over = threading.Event(), threading.Event()

    def write() -> int:
        written = 0
        try:
            for number in rounds(enough, least=4):
                assert plant.answer(packets[number % 2]) == DONE
                written += 1
        finally:
            over.set()
        return written

    def read() -> None:
        """Looks at the ends, at everything, and through Modbus, in turn."""
        ends, changes, last = [(area, place, 1) for place in (0, 7, 8, 32767, 65534)], 0, None
        count, same = (125, [0x0101, 0xFEFE]) if area in AREAS[2:] else (2000, [0xFF, 0])
        request = struct.pack(">BHH", 3 if area in AREAS[2:] else 2, 65535 - count, count)
        whole_replies = {value.to_bytes(2, "big")[-1:] * 250 for value in same}
        with wire.Connection(scada) as client:
            for number in itertools.count():
                if over.is_set():
                    return
                first, *others = plant.memory.read_many(ends)
                assert others == [first] * 4
                changes, last = changes + (first != last), first
                if changes == 20:
                    enough.set()
                if number % 10 == 0:
                    assert {reply[2:] for reply in client.ask_many([request] * 10)} <= whole_replies
                if number % 100 == 0:
                    assert plant.memory.read(area, 0, 65535) in contents

    with ThreadPoolExecutor(2) as threads:
        writing, reading = threads.submit(write), threads.submit(read)
        reading.result()
        packets_sent = 1 + writing.result()
    assert plant.counted() == {
        "accepted": packets_sent,
        "values": packets_sent * 65535,
        "surplus_bytes": 0,
        "dropped_bytes": 0,
        "held_bytes": 0,
        "refused": {},
    }


# Many


@pytest.mark.parametrize("workers", [1, 3])
def test_200_connections_at_once_all_get_their_byte(start: Start, workers: int) -> None:
    plant = Plant(start(listener("v1", max_connections_per_source=None), workers=workers))
    with contextlib.ExitStack() as opened:
        clients = [opened.enter_context(plant.connect()) for _ in range(200)]
        for number, client in enumerate(clients):
            packet = good("v1", "holding_registers", number % 128, [number])
            client.send(packet[: number % len(packet)])
        for number, client in enumerate(clients):
            packet = good("v1", "holding_registers", number % 128, [number])
            client.send(packet[number % len(packet) :])
        assert [client.rest() for client in clients] == [DONE] * 200
    assert plant.counted() == {
        "accepted": 200,
        "values": 200,
        "surplus_bytes": 0,
        "dropped_bytes": 0,
        "held_bytes": 0,
        "refused": {},
    }
    wire.until(lambda: plant.counted("connections")["open"] == 0, "all connections have ended")
    assert plant.counted("connections")["accepted"] == 200


def test_connections_too_many_get_no_byte(start: Start) -> None:
    plant = Plant(start(listener("v1", max_connections=2, max_connections_per_source=None)))
    packet = good("v1", "coils", 0, [1])
    with plant.connect() as first, plant.connect() as second:
        wire.until(lambda: plant.counted("connections")["open"] == 2, "both are accepted")
        with plant.connect() as third:
            with contextlib.suppress(ConnectionError):
                third.send(packet)
            assert third.rest() == b""
        assert plant.content()["coils"][0] == 0
        first.send(packet)
        assert first.rest() == DONE
        # It has its reply: it keeps no other one out, although its sender has not closed it.
        assert plant.answer(packet) == DONE
        assert plant.counted("connections")["evicted"] == 0
        second.send(packet)
        assert second.rest() == DONE
    assert plant.counted("connections")["refused_full"] == 1


@needs_127_0_0_2
def test_one_source_can_not_take_all_connections(start: Start) -> None:
    plant = Plant(start(listener("v1", max_connections_per_source=1)))
    packet = good("v1", "coils", 0, [1])
    with plant.connect() as first:
        wire.until(lambda: plant.counted("connections")["open"] == 1, "it is accepted")
        with plant.connect() as second:
            assert second.rest() == b""
        assert plant.answer(packet, source="127.0.0.2") == DONE
        first.send(packet)
        assert first.rest() == DONE


def test_a_refused_peer_that_stays_does_not_keep_its_place_for_ever(start: Start) -> None:
    plant = Plant(start(listener("v1", max_connections=1)))
    with plant.connect() as client:
        client.send(b"no")
        assert client.rest() == REFUSED
        wire.until(lambda: plant.counted("connections")["open"] == 0, "its place is free")


@pytest.mark.usefixtures("ipv6")
def test_listeners_have_ipv6_addresses_too(start: Start, kind: str) -> None:
    plant = Plant(start(listener(kind, bind="[::1]:0")))
    assert plant.address[0] == "::1"
    assert plant.answer(good(kind, "coils", 0, [1])) == DONE
    assert plant.answer(b"no") == REFUSED


# Our own sender


@pytest.mark.parametrize("whole", WHOLE, ids=lambda whole: whole.area)
def test_what_the_library_sends_arrives(whole: Whole, start: Start, kind: str) -> None:
    area, contents = whole
    plant = Plant(start(listener(kind), memories={"plant": {"id": 1, area: 65535}}))
    target: dict[str, Any] = {"unit": 1} if kind == "v1" else {"memory_id": 1}
    if kind == "none":
        target["crc"] = "none"
    raw_ingest.send_sync(*plant.address, area, 0, contents[0], **target)
    assert plant.memory.read(area, 0, 65535) == contents[0]
    with pytest.raises(raw_ingest.RawRefused):
        raw_ingest.send_sync(*plant.address, area, 1, contents[0], **target)
    with pytest.raises(raw_ingest.RawRefused):
        raw_ingest.send_packet_sync(*plant.address, b"RI\x02" + bytes(10_000_000))


# Any bytes at all


class Written(NamedTuple):
    """What a packet writes, and how many bytes follow it."""

    area: Area
    address: int
    values: list[int]
    surplus: int


def judged(kind: str, sent: bytes) -> Written | None:
    """What these bytes write, as docs/raw-ingest.md says, into a memory of `SIZES`; or nothing."""
    if kind == "v1":
        length, fields = 10, sent[3:10]
    else:
        length, fields = 12, sent[4:5] + sent[6:12]
    flags = b"" if kind == "v1" else sent[3:4] + sent[5:6]
    if len(sent) < length or sent[:3] != b"RI\x01" or any(flags):
        return None
    code, target, address, count = struct.unpack(">BHHH", fields)
    if not 1 <= code <= 4 or target != 1 or count == 0:
        return None
    area = AREAS[code - 1]
    if address + count > SIZES[area]:
        return None
    end = length + ((count + 7) // 8 if code <= 2 else 2 * count)
    whole = end + 4 * (kind == "crc")
    if len(sent) < whole or (kind == "crc" and sealed_with_crc(sent[:end]) != sent[:whole]):
        return None
    payload = sent[length:end]
    if code <= 2:
        values = [payload[place // 8] >> place % 8 & 1 for place in range(count)]
    else:
        values = list(struct.unpack(f">{count}H", payload))
    return Written(area, address, values, len(sent) - whole)


@st.composite
def packets(draw: st.DrawFn, kind: str) -> bytes:
    """Packets, most of them almost right."""
    rarely = draw(st.sampled_from([None, None, None, "head", "fields", "length", "bytes", "noise"]))
    if rarely == "noise":
        return draw(st.binary(max_size=40))
    code = draw(st.integers(1, 4))
    size = SIZES[AREAS[code - 1]]
    count = draw(st.integers(1, size))
    address = draw(st.integers(0, size - count))
    target = 1
    head = bytearray(b"RI\x01")
    flags, reserved = 0, 0
    if rarely == "head":
        head[draw(st.integers(0, 2))] = draw(st.integers(0, 255))
        flags, reserved = draw(st.sampled_from([(0, 0), (1, 0), (0, 1), (128, 0)]))
        code = draw(st.integers(0, 6))
    if rarely == "fields":
        target = draw(st.sampled_from([1, 0, 2, 256, 257]))
        count = draw(st.integers(0, size + 2) | st.just(65535))
        address = draw(st.integers(0, size + 2) | st.just(65535))
    length = (count + 7) // 8 if code <= 2 else 2 * count
    if rarely == "length":
        length = max(0, length + draw(st.integers(-3, 3)))
    payload = draw(st.binary(min_size=min(length, 300), max_size=min(length, 300)))
    fields = struct.pack(">HHH", target, address, count) + payload
    if kind == "v1":
        packet = bytes(head) + bytes([code]) + fields
    else:
        packet = bytes(head) + bytes([flags, code, reserved]) + fields
        packet = sealed_with_crc(packet) if kind == "crc" else packet
    if rarely == "bytes" and packet:
        damaged = bytearray(packet)
        damaged[draw(st.integers(0, len(packet) - 1))] = draw(st.integers(0, 255))
        return bytes(damaged)
    return packet


@settings(
    max_examples=examples(100),
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
@given(data=st.data())
def test_packets_are_taken_as_a_model_says(data: st.DataObject, plant: Plant, kind: str) -> None:
    packet = data.draw(packets(kind))
    cut = data.draw(st.none() | st.integers(0, len(packet)))
    expected = plant.fill()
    counted = plant.counted()
    written = judged(kind, packet)
    pieces = [packet] if cut is None else [packet[:cut], packet[cut:]]

    reply = plant.answer(*pieces, finish=True)
    surplus(plant)

    if written is not None:
        area, address, values, _ = written
        expected[area][address : address + len(values)] = values
        assert reply == DONE
    else:
        assert reply == (REFUSED if packet else b"")
    assert plant.content() == expected
    now = plant.counted()
    assert now["accepted"] - counted["accepted"] == (written is not None)
    assert now["values"] - counted["values"] == (len(written.values) if written else 0)
    behind = now["surplus_bytes"] - counted["surplus_bytes"]
    assert behind == (written.surplus if written else 0)
    refused = sum(now["refused"].values()) - sum(counted["refused"].values())
    assert refused == (written is None and packet != b"")


def test_noise_from_many_at_once_does_no_harm(start: Start) -> None:
    plant = Plant(start(listener("v1"), workers=2))
    before = plant.fill()

    def noise(seed: int) -> list[bytes]:
        replies = []
        for number in range(50):
            salt = (seed * 50 + number).to_bytes(2, "big")
            packet = b"RI\x01"[: number % 4] + b"\xff" + salt * (number * 37)
            replies.append(plant.answer(packet, finish=number % 2 == 0))
        return replies

    with ThreadPoolExecutor(8) as threads:
        replies = itertools.chain.from_iterable(threads.map(noise, range(8)))
        assert set(replies) == {REFUSED}
    assert plant.content() == before
    assert sum(plant.refusals().values()) == 400
    assert plant.is_well()

"""Rules: who may do what, the same over Modbus TCP, UDP and RTU over TCP.

A connection is judged once, when it is accepted; over UDP each datagram is.
"""

from __future__ import annotations

import contextlib
import logging
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, Protocol

import pytest

from holdfast.config import load
from support import wire
from support.config_folder import written
from support.machine import needs_127_0_0_2
from support.running import content, endpoint, log_events
from support.transports import (
    ALL,
    TRANSPORTS,
    TYPES,
    Client,
    address,
    client,
    configuration,
    counters,
    is_stranger,
    rule,
)

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from holdfast.appliance import Appliance
    from support.running import Run

READ = bytes.fromhex("0300000001")
ZERO = bytes.fromhex("03020000")
WRITE = bytes.fromhex("0600001234")

EVERY_FUNCTION = {
    code: bytes.fromhex(text)
    for code, text in {
        1: "0100000001",
        2: "0200000001",
        3: "0300000001",
        4: "0400000001",
        5: "050000ff00",
        6: "0600001234",
        8: "080000a537",
        11: "0b",
        15: "0f000000010101",
        16: "10000000010200ff",
        17: "11",
        22: "16000000f20025",
        23: "1700000001000000010200ff",
        43: "2b0e0100",
    }.items()
}
REFUSALS = ("refused_function", "refused_unit", "refused_address", "refused_sealed")
WRITES = {5, 6, 15, 16, 22, 23}


class Plant:
    """An appliance with one listener, and what its peers see."""

    def __init__(self, kind: str, appliance: Appliance, opened: ExitStack) -> None:
        self.kind = kind
        self.appliance = appliance
        self.port = address(appliance)[1]
        self._opened = opened

    def peer(self, source: str | None = None, host: str = "127.0.0.1") -> Client:
        """A client with a source address."""
        peer = client(self.kind, (host, self.port), source)
        self._opened.enter_context(contextlib.closing(peer))
        return peer

    def refuses(self, source: str | None = None, host: str = "127.0.0.1") -> bool:
        """Whether a peer with that address gets nothing, and is counted."""
        return is_stranger(self.kind, self.appliance, (host, self.port), source)


class Start(Protocol):
    def __call__(
        self, *rules: dict[str, Any], bind: str = "127.0.0.1:0", memories: tuple[str, ...] = ()
    ) -> Plant: ...


@pytest.fixture(params=TYPES)
def start(request: pytest.FixtureRequest, run: Run) -> Iterator[Start]:
    """Starts a listener of each kind with these rules."""
    with ExitStack() as opened:

        def started(
            *rules: dict[str, Any], bind: str = "127.0.0.1:0", memories: tuple[str, ...] = ()
        ) -> Plant:
            named = dict.fromkeys(("plant", *memories), ALL)
            text = configuration(request.param, bind=bind, rules=list(rules), memories=named)
            return Plant(request.param, run(text), opened)

        yield started


# Sources


@needs_127_0_0_2
@pytest.mark.parametrize("source", ["127.0.0.2", "127.0.0.2/32"])
def test_an_address_is_that_peer_and_no_other(source: str, start: Start) -> None:
    plant = start(rule([source]))

    assert plant.peer("127.0.0.2").ask(READ) == ZERO
    assert plant.refuses("127.0.0.1")
    assert plant.refuses("127.0.0.3")
    assert counters(plant.appliance)["requests"] == {3: 1}


@needs_127_0_0_2
def test_a_network_is_its_first_and_its_last_address_and_all_between(start: Start) -> None:
    plant = start(rule(["127.0.0.4/30", "127.0.1.0/24"]))

    for inside in ("127.0.0.4", "127.0.0.5", "127.0.0.7", "127.0.1.0", "127.0.1.255"):
        assert plant.peer(inside).ask(READ) == ZERO
    for outside in ("127.0.0.3", "127.0.0.8", "127.0.2.0", "127.0.0.1"):
        assert plant.refuses(outside)


def test_every_ipv4_address_is_in_the_network_of_all(start: Start) -> None:
    assert start(rule(["0.0.0.0/0"])).peer().ask(READ) == ZERO


@pytest.mark.usefixtures("ipv6")
def test_an_ipv6_source_is_matched(start: Start) -> None:
    plant = start(rule(["::1"]), bind="[::1]:0")

    assert plant.peer(host="::1").ask(READ) == ZERO


@pytest.mark.usefixtures("ipv6")
def test_an_ipv6_source_outside_the_network_is_a_stranger(start: Start) -> None:
    plant = start(rule(["fd00::/64", "::2/127", "127.0.0.0/8"]), bind="[::1]:0")

    assert plant.refuses(host="::1")


@pytest.mark.usefixtures("ipv6")
def test_ipv4_and_ipv6_peers_of_one_socket_have_their_own_rules(start: Start) -> None:
    plant = start(
        rule(["127.0.0.1"], memory="four"),
        rule(["::1"], memory="six"),
        bind="[::]:0",
        memories=("four", "six"),
    )
    plant.appliance.memories["four"].write("holding_registers", 0, [4])
    plant.appliance.memories["six"].write("holding_registers", 0, [6])

    assert plant.peer(host="127.0.0.1").ask(READ) == bytes.fromhex("03020004")
    assert plant.peer(host="::1").ask(READ) == bytes.fromhex("03020006")


@pytest.mark.usefixtures("ipv6")
@pytest.mark.parametrize("sources", [["::/0"], ["::/8"], ["fd00::/8", "::1"]])
def test_no_ipv6_network_holds_an_ipv4_peer(sources: list[str], start: Start) -> None:
    plant = start(rule(sources), bind="[::]:0")

    assert plant.refuses(host="127.0.0.1")


@pytest.mark.usefixtures("ipv6")
def test_no_ipv4_network_holds_an_ipv6_peer(start: Start) -> None:
    plant = start(rule(["0.0.0.0/0"]), bind="[::]:0")

    assert plant.peer(host="127.0.0.1").ask(READ) == ZERO
    assert plant.refuses(host="::1")


# The first rule that matches


@needs_127_0_0_2
def test_the_first_rule_that_matches_settles_it(start: Start) -> None:
    plant = start(
        rule(["127.0.0.2"], access="read-only"),
        rule(["127.0.0.0/30"], functions=[6]),
        rule(["127.0.0.0/8"]),
    )
    reader, writer, other = (plant.peer(f"127.0.0.{last}") for last in (2, 3, 4))

    assert (reader.ask(READ), reader.ask(WRITE)) == (ZERO, b"\x86\x01")
    assert (writer.ask(READ), writer.ask(WRITE)) == (b"\x83\x01", WRITE)
    assert (other.ask(READ), other.ask(WRITE)) == (bytes.fromhex("03021234"), WRITE)


@needs_127_0_0_2
def test_a_narrower_rule_behind_a_wider_one_has_no_say(start: Start) -> None:
    plant = start(rule(["127.0.0.0/8"], access="read-only"), rule(["127.0.0.2"]))

    assert plant.peer("127.0.0.2").ask(WRITE) == b"\x86\x01"


@needs_127_0_0_2
def test_for_each_unit_the_first_rule_that_names_peer_and_unit_decides(start: Start) -> None:
    plant = start(
        rule(["127.0.0.2"], 1, access="read-only"),
        {**rule(["127.0.0.0/8"]), "units": {"1-2": "plant"}},
    )
    first, second = plant.peer("127.0.0.2"), plant.peer("127.0.0.3")

    assert (first.ask(WRITE, 1), first.ask(WRITE, 2)) == (b"\x86\x01", WRITE)
    assert (second.ask(WRITE, 1), second.ask(WRITE, 2)) == (WRITE, WRITE)
    assert (first.ask(READ, 3), second.ask(READ, 3)) == (b"\x83\x0b", b"\x83\x0b")


def test_a_unit_can_have_fewer_rights_than_its_rule(start: Start) -> None:
    units = {
        1: "plant",
        2: {"memory": "plant", "access": "read-only"},
        3: {"memory": "plant", "functions": [6]},
        4: {"memory": "plant", "deny": [3]},
    }
    peer = start({**rule(["127.0.0.1"]), "units": units}).peer()

    replies = {unit: (peer.ask(WRITE, unit), peer.ask(READ, unit)) for unit in units}
    assert replies == {
        1: (WRITE, bytes.fromhex("03021234")),
        2: (b"\x86\x01", bytes.fromhex("03021234")),
        3: (WRITE, b"\x83\x01"),
        4: (WRITE, b"\x83\x01"),
    }


def test_ranges_of_a_unit_limit_whole_requests(start: Start) -> None:
    ranges = {
        "read": [{"area": "holding_registers", "start": 0, "end": 3}],
        "write": [{"area": "holding_registers", "start": 2, "end": 4}],
    }
    units = {1: {"memory": "plant", **ranges}}
    peer = start({**rule(["127.0.0.1"]), "units": units}).peer()

    assert peer.ask(bytes.fromhex("0300000004")) == bytes.fromhex("03080000000000000000")
    assert peer.ask(bytes.fromhex("0300000005")) == b"\x83\x02"
    assert peer.ask(bytes.fromhex("0100000001")) == b"\x81\x02"
    assert peer.ask(bytes.fromhex("0600040001")) == bytes.fromhex("0600040001")
    assert peer.ask(bytes.fromhex("0600010001")) == b"\x86\x02"
    assert peer.ask(bytes.fromhex("080000a537")) == bytes.fromhex("080000a537")


@needs_127_0_0_2
def test_one_unit_id_is_another_memory_for_another_peer(start: Start) -> None:
    plant = start(
        rule(["127.0.0.1"]),
        rule(["127.0.0.2"], memory="other"),
        rule(["127.0.0.3"], memory="other", access="read-only"),
        memories=("other",),
    )
    one, two, three = (plant.peer(f"127.0.0.{last}") for last in (1, 2, 3))

    assert one.ask(WRITE) == WRITE
    assert two.ask(READ) == three.ask(READ) == ZERO
    assert two.ask(bytes.fromhex("0600004321")) == bytes.fromhex("0600004321")
    assert one.ask(READ) == bytes.fromhex("03021234")
    assert three.ask(READ) == bytes.fromhex("03024321")
    assert three.ask(WRITE) == b"\x86\x01"


def test_two_unit_ids_of_one_rule_may_be_one_memory(start: Start) -> None:
    plant = start(
        {**rule(["127.0.0.1"]), "units": {0: "plant", 255: "plant", 9: "other"}},
        memories=("other",),
    )
    peer = plant.peer()

    assert peer.ask(WRITE, 0) == WRITE
    assert peer.ask(READ, 255) == bytes.fromhex("03021234")
    assert peer.ask(READ, 9) == ZERO


# Functions


def answered(peer: Client, unit: int = 1) -> set[int]:
    """The functions that are not answered with an illegal function."""
    replies = {code: peer.ask(pdu, unit) for code, pdu in EVERY_FUNCTION.items()}
    refused = {code for code, reply in replies.items() if reply == bytes([code | 0x80, 1])}
    return set(replies) - refused


@pytest.mark.parametrize(
    ("limits", "allowed"),
    [
        ({}, set(EVERY_FUNCTION)),
        ({"access": "read-only"}, set(EVERY_FUNCTION) - WRITES),
        ({"functions": [3]}, {3}),
        ({"functions": [3, 4, 16]}, {3, 4, 16}),
        ({"functions": [3, 4, 16], "access": "read-only"}, {3, 4}),
        ({"deny": [3]}, set(EVERY_FUNCTION) - {3}),
        ({"deny": [8, 11, 17, 43]}, set(EVERY_FUNCTION) - {8, 11, 17, 43}),
        ({"deny": [1, 2], "access": "read-only"}, set(EVERY_FUNCTION) - WRITES - {1, 2}),
        ({"functions": sorted(EVERY_FUNCTION)}, set(EVERY_FUNCTION)),
        ({"deny": sorted(EVERY_FUNCTION)}, set()),
    ],
    ids=str,
)
def test_a_rule_allows_these_functions_and_no_others(
    limits: dict[str, Any], allowed: set[int], start: Start
) -> None:
    plant = start(rule(["127.0.0.1"], **limits))

    assert answered(plant.peer()) == allowed
    if not allowed & WRITES:
        values = content(plant.appliance.memories["plant"])
        assert not any(any(of_area) for of_area in values.values())


def test_a_denied_function_does_not_tell_which_units_there_are(start: Start) -> None:
    peer = start(rule(["127.0.0.1"], access="read-only", deny=[17])).peer()

    for pdu in (WRITE, b"\x11", b"\x63"):
        assert peer.ask(pdu, 1) == peer.ask(pdu, 2) == bytes([pdu[0] | 0x80, 1])
    assert peer.ask(READ, 2) == b"\x83\x0b"


def test_a_denied_function_is_denied_whatever_its_form(start: Start) -> None:
    peer = start(rule(["127.0.0.1"], functions=[3])).peer()

    assert peer.ask(bytes.fromhex("0100000000")) == b"\x81\x01"
    assert peer.ask(bytes.fromhex("050000abcd")) == b"\x85\x01"
    assert peer.ask(bytes.fromhex("0300000000")) == b"\x83\x03"


@pytest.mark.parametrize("sub_function", [1, 3, 4, 10, 20])
def test_a_read_only_rule_denies_what_changes_the_state_of_the_listener(
    sub_function: int, start: Start
) -> None:
    peer = start(rule(["127.0.0.1"], access="read-only")).peer()

    assert peer.ask(bytes([8, 0, sub_function, 0, 0])) == b"\x88\x01"
    assert peer.ask(READ) == ZERO


def test_a_peer_cannot_silence_a_unit_for_others(
    start: Start, caplog: pytest.LogCaptureFixture
) -> None:
    plant = start(rule(["127.0.0.1"]))

    assert plant.peer().ask(bytes.fromhex("0800040000")) == b"\x88\x01"
    assert plant.peer().ask(READ) == ZERO
    assert counters(plant.appliance)["connections"]["refused_listen_only"] == 1
    plant.appliance.log_events(wire.DEADLINE)
    [refused] = [each for each in caplog.records if each.message == "refused_listen_only"]
    fields = refused.fields  # type: ignore[attr-defined]
    assert fields["listener"] == "scada"
    assert fields["peer"].startswith("127.0.0.1:")


@pytest.mark.parametrize("kind", TYPES)
def test_who_silences_a_unit_is_logged_and_a_reload_ends_it(
    kind: str, run: Run, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "holdfast")
    rules = [{**rule(["127.0.0.1"]), "units": {1: "plant", 2: "plant"}}]
    appliance = run(configuration(kind, rules=rules, listen_only=True))
    forbidden = tmp_path / "forbidden.yaml"
    forbidden.write_text(configuration(kind, rules=rules))
    silence, restart = bytes.fromhex("0800040000"), bytes.fromhex("0800010000")

    with client(kind, address(appliance)) as peer:
        # The second request to be silent is ignored, as is the write: they are no events.
        for pdu in (silence, silence, WRITE, restart, silence):
            peer.send(TRANSPORTS[kind].frame(pdu))
        assert peer.ask(READ, 2) == ZERO
        appliance.reload(load(forbidden))
        assert peer.ask(READ) == ZERO
        assert peer.ask(silence) == b"\x88\x01"

    log_events(appliance)
    fields = [(each.message, vars(each)["fields"]) for each in caplog.records]
    assert [
        (event, found["unit"], found["peer"].rpartition(":")[0])
        for event, found in fields
        if event in ("unit_silenced", "unit_back")
    ] == [
        ("unit_silenced", 1, "127.0.0.1"),
        ("unit_back", 1, "127.0.0.1"),
        ("unit_silenced", 1, "127.0.0.1"),
        ("unit_back", 1, ""),
    ]


def test_each_unit_that_a_peer_silences_is_logged(
    run: Run, caplog: pytest.LogCaptureFixture
) -> None:
    units = list(range(1, 101))
    rules = [{**rule(["127.0.0.1"]), "units": {"1-100": "plant"}}]
    appliance = run(configuration("tcp", rules=rules, listen_only=True))
    with client("tcp", address(appliance)) as peer:
        for unit in units:
            peer.send(TRANSPORTS["tcp"].frame(bytes.fromhex("0800040000"), unit))
        assert peer.ask(READ, 101) == b"\x83\x0b"

    log_events(appliance)
    found = [vars(each)["fields"] for each in caplog.records if each.message == "unit_silenced"]
    assert [fields["unit"] for fields in found] == units


# What the log has of refused requests


def logged(plant: Plant, caplog: pytest.LogCaptureFixture) -> list[tuple[str, int, int]]:
    """The refused requests in the log: event, unit and function. An event precedes its reply."""
    log_events(plant.appliance)
    return [
        (each.message, fields["unit"], fields["function"])
        for each in caplog.records
        if each.message in REFUSALS
        for fields in [vars(each)["fields"]]
    ]


@pytest.mark.parametrize(
    ("asked", "answered", "event"),
    [
        ("0600001234", "8601", "refused_function"),
        ("6300", "e301", "refused_function"),
        ("03ffff0001", "8302", "refused_address"),
    ],
)
def test_a_refused_request_is_logged_once_for_each_connection(
    asked: str, answered: str, event: str, start: Start, caplog: pytest.LogCaptureFixture
) -> None:
    plant = start(rule(["127.0.0.1"], access="read-only"))
    peer = plant.peer()
    for _ in range(2):
        assert peer.ask(bytes.fromhex(asked)) == bytes.fromhex(answered)
    assert peer.ask(READ) == ZERO

    times = 2 if "udp" in plant.kind else 1
    assert logged(plant, caplog) == [(event, 1, int(asked[:2], 16))] * times


def test_a_unit_that_a_peer_does_not_have_is_logged(
    start: Start, caplog: pytest.LogCaptureFixture
) -> None:
    plant = start(rule(["127.0.0.1"]))
    assert plant.peer().ask(READ, 9) == b"\x83\x0b"
    assert logged(plant, caplog) == [("refused_unit", 9, 3)]


@pytest.mark.parametrize("keep", [{}, {"keep": {"file": "plant.redb", "sync": 0}}])
def test_a_write_to_a_sealed_memory_is_logged_but_not_a_read(
    run: Run, caplog: pytest.LogCaptureFixture, keep: dict[str, Any]
) -> None:
    seal = {"area": "discrete_inputs", "address": 9, "mode": "level"}
    text = configuration(
        "tcp", rules=[rule(["127.0.0.1"])], memories={"plant": {**ALL, **keep, "seal": seal}}
    )
    with ExitStack() as opened:
        plant = Plant("tcp", run(text), opened)
        peer = plant.peer()
        assert peer.ask(READ) == b"\x83\x06"
        assert logged(plant, caplog) == []
        assert peer.ask(WRITE) == b"\x86\x06"
        assert logged(plant, caplog) == [("refused_sealed", 1, 6)]


# Several listeners


@needs_127_0_0_2
def test_each_listener_has_its_own_rules(run: Run) -> None:
    listeners = {
        kind: {
            "type": TYPES[kind],
            "bind": "127.0.0.1:0",
            "rules": [rule([f"127.0.0.{last}"], unit=last)],
        }
        for last, kind in enumerate(TYPES, 1)
    }
    appliance = run(written({"memories": {"plant": ALL}, "listeners": listeners}))

    for last, kind in enumerate(TYPES, 1):
        with client(kind, endpoint(appliance, kind), f"127.0.0.{last}") as peer:
            assert peer.ask(READ, last) == ZERO
            assert peer.ask(READ, last + 1) == b"\x83\x0b"
    counted = appliance.diagnostics.stats()["listeners"]
    assert {kind: counted[kind]["requests"] for kind in TYPES} == {kind: {3: 2} for kind in TYPES}

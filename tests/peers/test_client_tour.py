"""Clients of others on a tour of all functions, against our listeners on every transport.

The table has the peers: how their drivers run, what they can do, and where they differ.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import pytest

from support import peer_programs as programs
from support import peer_tour as tour
from support.peer_targets import LINES, WAYS
from support.peer_tour import Error, LeftOut, Refusal, Values

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

    from support.peer_programs import Driver
    from support.peer_targets import Target
    from support.peer_tour import Outcome


# The first test of a peer may have to download and compile its driver.
pytestmark = pytest.mark.timeout(900)


@dataclass(frozen=True)
class Client:
    """A client of others."""

    driver: Callable[[], Driver]
    calls: Mapping[str, frozenset[str]]
    """What it can do, on each transport that it has."""
    differences: Mapping[str, Outcome] = field(default_factory=dict)
    """The steps with another outcome than the tour has."""
    differences_on: Mapping[str, Mapping[str, Outcome]] = field(default_factory=dict)
    """The same for single transports."""

    def differs(self, scheme: str) -> dict[str, Outcome]:
        return {**self.differences, **self.differences_on.get(scheme, {})}


CHECKS_RANGES: dict[str, Outcome] = {
    "coils past 65535": Error("read after end of modbus address space"),
    "write coils past 65535": Error("write after end of modbus address space"),
    "write registers past 65535": Error("write after end of modbus address space"),
}

NO_COILS: dict[str, Outcome] = {
    # Over UDP its writes of several coils have no coils.
    "write 11 coils": Refusal(3),
    "read 11 coils": Values([0] * 13),
    "write 1968 coils": Refusal(3),
    "read 2000 coils": Values([0] * 2000),
    "write coils past 65535": Refusal(3),
}

NO_EXCEPTIONS: dict[str, Outcome] = {
    step.name: LeftOut("it takes the function code for the exception code, or does not notice")
    for step in [*tour.EXCEPTIONS, *tour.READ_ONLY, *tour.ELSEWHERE]
    if isinstance(step.expected, Refusal)
}

SHORT_REPLY: dict[str, Outcome] = {
    "0 holding registers": LeftOut("it ignores an exception that is as long as the reply")
}
BEYOND_LIMITS = ["0 holding registers", "126 holding registers", "2001 coils", "write 1969 coils"]

CLIENTS = {
    "pyModbusTCP": Client(
        lambda: programs.python("pymodbus_tcp"),
        {"tcp": tour.BASIC | {tour.BOTH, tour.IDENTIFY}},
        CHECKS_RANGES
        | {
            "0 holding registers": Error("reg_nb out of range"),
            "126 holding registers": Error("reg_nb out of range"),
            "2001 coils": Error("bit_nb out of range"),
            "write 1969 coils": Error("number of coils out of range"),
        },
    ),
    "tModbus": Client(
        lambda: programs.python("tmodbus_client", requires=(3, 12)),
        dict.fromkeys(["tcp", "udp", "rtu+tcp"], tour.EVERY),
        {
            "coils past 65535": Error("must not exceed 65536"),
            "write coils past 65535": Error("must not exceed 65536"),
            "write registers past 65535": Error("must not exceed 65536"),
            "0 holding registers": Error("must be between 1 and 125"),
            "126 holding registers": Error("must be between 1 and 125"),
            "2001 coils": Error("must be between 1 and 2000"),
            "write 1969 coils": Error("must be between 1 and 1968"),
        },
    ),
    "uModbus": Client(
        lambda: programs.python("umodbus_tcp"), dict.fromkeys(["tcp", "rtu"], tour.BASIC)
    ),
    "MinimalModbus": Client(
        lambda: programs.python("minimalmodbus_line"),
        dict.fromkeys(["rtu", "ascii"], tour.BASIC),
        {
            # It writes them, but takes their number in the reply for one of registers.
            "write 1968 coils": Error("number of registers is too large: 1968"),
            "0 holding registers": Error("number of registers is too small"),
            "126 holding registers": Error("number of registers is too large"),
            "2001 coils": Error("number of bits is too large"),
            "write 1969 coils": Error("length of input list is too large"),
        },
    ),
    "jsmodbus": Client(
        lambda: programs.node("jsmodbus"),
        dict.fromkeys(["tcp", "rtu"], tour.BASIC | {tour.IDENTIFY}),
        {"2001 coils": Error("InvalidQuantity")},
        # Over TCP it cuts the request off after 120 registers.
        {"tcp": {"write 123 registers": Refusal(3), "read 125 registers": Values([0] * 125)}},
    ),
    "modbus-serial": Client(
        lambda: programs.node("modbus-serial"),
        dict.fromkeys(["tcp", "udp"], tour.BASIC | {tour.MASK, tour.BOTH, tour.IDENTIFY})
        # On these it finds the ends of replies by tables that lack other functions.
        | {"rtu": tour.BASIC | {tour.IDENTIFY}, "rtu+tcp": tour.BASIC, "ascii": tour.BASIC},
        {},
        dict.fromkeys(("rtu", "rtu+tcp", "ascii"), SHORT_REPLY),
    ),
    "j2mod": Client(
        lambda: programs.java("J2mod"),
        dict.fromkeys(
            ["tcp", "udp", "rtu+tcp"],
            tour.BASIC | {tour.MASK, tour.BOTH, tour.IDENTIFY},
        ),
        {"2001 coils": Error("Maximum bitcount exceeded")},
        {"udp": NO_COILS},
    ),
    "digitalpetri/modbus": Client(
        lambda: programs.java("DigitalPetri"),
        dict.fromkeys(["tcp", "rtu+tcp"], tour.BASIC | {tour.MASK, tour.BOTH}),
        differences_on={"rtu+tcp": NO_EXCEPTIONS},
    ),
    "tokio-modbus": Client(
        programs.rust,
        dict.fromkeys(
            ["tcp", "rtu+tcp"],
            tour.BASIC | {tour.MASK, tour.BOTH, tour.IDENTIFY},
        ),
    ),
    "simonvetter/modbus": Client(
        programs.go,
        dict.fromkeys(["tcp", "udp", "rtu+tcp", "rtu+udp", "rtu"], tour.BASIC),
        # It checks quantities and ranges itself.
        dict.fromkeys([*CHECKS_RANGES, *BEYOND_LIMITS], Error("^unexpected parameters$")),
    ),
}
RUNS = [
    (name, scheme, way)
    for way, made in WAYS.items()
    for name, client in CLIENTS.items()
    for scheme in client.calls
    if scheme in made.schemes
]
ROUTED = [
    (name, scheme, way)
    for name, scheme, way in RUNS
    if scheme not in LINES
    and tour.steps_of(tour.ELSEWHERE, tour.EVERY, CLIENTS[name].differs(scheme))
]
"""Where a unit that is not there gets an exception; on a line there is silence."""


class Open(Protocol):
    """Opens a target: the way to a memory, the scheme of the URL, and the access."""

    def __call__(self, way: str, scheme: str, access: str = "read-write") -> Target: ...


@pytest.fixture
def target(tmp_path: Path) -> Iterator[Open]:
    with ExitStack() as stack:

        def opened(way: str, scheme: str, access: str = "read-write") -> Target:
            return stack.enter_context(WAYS[way].open(scheme, tmp_path, access))

        yield opened


@pytest.mark.parametrize(("name", "scheme", "way"), RUNS, ids=map("-".join, RUNS))
def test_a_client_calls_every_function(name: str, scheme: str, way: str, target: Open) -> None:
    client = CLIENTS[name]
    driver = client.driver()
    to = target(way, scheme)
    steps = tour.steps_of(tour.TOUR, client.calls[scheme], client.differs(scheme))

    results = driver.results(to.url, to.unit, [step.operation for step in steps])

    assert tour.judged(steps, results, client.differs(scheme)) == {}
    for area, expected in tour.written(client.calls[scheme], client.differs(scheme)).items():
        assert to.memory.read(area, 0, 65536) == expected


@pytest.mark.parametrize(("name", "scheme", "way"), RUNS, ids=map("-".join, RUNS))
def test_a_client_is_refused_writes_where_it_may_only_read(
    name: str, scheme: str, way: str, target: Open
) -> None:
    client = CLIENTS[name]
    driver = client.driver()
    to = target(way, scheme, access="read-only")
    steps = tour.steps_of(tour.READ_ONLY, client.calls[scheme], client.differs(scheme))

    results = driver.results(to.url, to.unit, [step.operation for step in steps])

    assert tour.judged(steps, results, client.differs(scheme)) == {}


@pytest.mark.parametrize(("name", "scheme", "way"), ROUTED, ids=map("-".join, ROUTED))
def test_a_client_is_told_that_a_unit_is_not_there(
    name: str, scheme: str, way: str, target: Open
) -> None:
    driver = CLIENTS[name].driver()
    to = target(way, scheme)

    results = driver.results(to.url, to.unit + 1, [step.operation for step in tour.ELSEWHERE])

    assert tour.judged(tour.ELSEWHERE, results, {}) == {}

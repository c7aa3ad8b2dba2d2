"""Our clients, blocking and asyncio, on a tour of all functions of every server of others.

The table has the servers: how their drivers run, what they lack, and where they differ.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import pytest

from support import peer_programs as programs
from support.faces import FACES, Dial, dialling
from support.lines import Cable
from support.peer_targets import LINES
from support.pymodbus_server import tour

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

    from support.peer_programs import Driver
    from support.pymodbus_server import PastEnd


# The first test of a peer may have to download and compile its driver.
pytestmark = pytest.mark.timeout(900)


@dataclass(frozen=True)
class Server:
    """A server of others."""

    driver: Callable[[], Driver]
    schemes: tuple[str, ...]
    lacks: Mapping[int, int | None] = field(default_factory=dict)
    """Functions that it lacks: the exception code of its reply, or nothing if it does not reply."""
    past_end: PastEnd = "exception"
    """What it answers where an area ends."""
    max_written: Mapping[str, int] = field(default_factory=dict)
    """How many registers it accepts in a write, if fewer than 123, by transport."""
    identity: bool = True
    """Whether it can be identified."""


SERVERS = {
    "pyModbusTCP": Server(lambda: programs.python("pymodbus_tcp"), ("tcp",), {22: 1}),
    "uModbus": Server(
        lambda: programs.python("umodbus_tcp"), ("tcp",), {22: 1, 23: 1}, identity=False
    ),
    # After a function that it lacks, it answers no further request of the connection.
    "jsmodbus": Server(
        lambda: programs.node("jsmodbus"),
        ("tcp", "rtu"),
        {22: None, 23: None},
        past_end="fewer values",
        max_written={"rtu": 120},
        identity=False,
    ),
    "modbus-serial": Server(lambda: programs.node("modbus-serial"), ("tcp", "rtu"), {22: 1, 23: 1}),
    "j2mod": Server(
        lambda: programs.java("J2mod"),
        ("tcp", "udp", "rtu+tcp"),
        max_written={"udp": 121},
        identity=False,
    ),
    "digitalpetri/modbus": Server(
        lambda: programs.java("DigitalPetri"),
        ("tcp", "rtu+tcp"),
        past_end="all addresses",
        max_written={"rtu+tcp": 63},
        identity=False,
    ),
    "tokio-modbus": Server(programs.rust, ("tcp", "rtu+tcp"), identity=False),
    "simonvetter/modbus": Server(programs.go, ("tcp",), {22: 1, 23: 1}, identity=False),
}
PAIRS = [(name, scheme) for name, server in SERVERS.items() for scheme in server.schemes]


@pytest.fixture(params=FACES)
def dial(request: pytest.FixtureRequest) -> Iterator[Dial]:
    yield from dialling(request.param)


@pytest.fixture(params=PAIRS, ids="-".join)
def running(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[Server, str]]:
    """A server that runs, and its URL."""
    name, scheme = request.param
    server = SERVERS[name]
    driver = server.driver()
    with ExitStack() as stack:
        if scheme in LINES:
            cable = stack.enter_context(Cable(tmp_path))
            stack.enter_context(driver.serving(f"{scheme}://{cable.devices[0]}"))
            yield server, f"{scheme}://{cable.devices[1]}?parity=none"
        else:
            port = stack.enter_context(driver.serving(f"{scheme}://127.0.0.1:0"))
            yield server, f"{scheme}://127.0.0.1:{port}"


def test_a_server_is_asked_everything(running: tuple[Server, str], dial: Dial) -> None:
    server, url = running
    client = dial(url)

    most = server.max_written.get(url.split(":")[0], 123)
    tour(client, server.lacks, past_end=server.past_end, max_written=most)

    if server.identity:
        who = client.identify()
        assert (who.vendor_name, who.product_code, who.revision) == ("Acme", "P1", "1.2")

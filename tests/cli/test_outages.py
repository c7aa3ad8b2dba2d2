"""Commands that are used in an outage: they name what they can't reach, and don't wait for long."""

from __future__ import annotations

import asyncio
import json
import socket
import tempfile
from multiprocessing.connection import Listener
from typing import TYPE_CHECKING

import pytest

from holdfast.appliance import control
from holdfast.net.nats.connection import Servers, connected_once
from holdfast.scanner.fleet.observer import FleetObserver, FleetUnavailable
from support import wire
from support.brokers import NatsServer, free_port
from support.cli import failure
from support.leases import make_settled

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

COMMANDS = {
    "fleet status": "fleet status plant --nats {url}",
    "fleet drain": "fleet drain plant scan-a --nats {url}",
    "log backup": "log backup {file} {folder}/backup",
    "log replicas": "log replicas {file}",
    "log replay": "log replay {file}",
    "log replay --follow": "log replay {file} --follow",
    "health": "health --url http://{address}",
}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("host", ["127.0.0.1", "no-such-name.invalid"])
def test_a_command_names_the_server_that_it_can_not_reach(
    command: str, host: str, tmp_path: Path
) -> None:
    address = f"{host}:{free_port()}"
    url, file = f"nats://{address}", tmp_path / "plant.yaml"
    parts = {
        "memories": {"plant": {"holding_registers": 100, "replicate": {"log": "site"}}},
        "logs": {"site": {"node": "scada-a", "servers": [url]}},
        "rest": {"bind": "127.0.0.1:0", "sources": ["127.0.0.0/8"], "tokens": "none"},
    }
    file.write_text(json.dumps(parts))
    words = COMMANDS[command].split()
    values = {"url": url, "address": address, "file": file, "folder": tmp_path}
    [line] = failure(*(word.format(**values) for word in words))
    assert address in line


@pytest.fixture(params=["silent", "full"])
def address(request: pytest.FixtureRequest) -> Iterator[str]:
    """A server that accepts and never answers, and one whose machine drops packets."""
    if request.param == "full":
        with wire.dead_address() as (host, port):
            yield f"{host}:{port}"
    else:
        with socket.create_server(("127.0.0.1", 0)) as server:
            host, port = server.getsockname()
            yield f"{host}:{port}"


async def _connect(servers: Servers, within_s: float) -> None:
    async with connected_once(servers, "test", within_s):
        pass


def test_a_server_that_does_not_answer_is_not_waited_for(address: str) -> None:
    urls = (f"nats://me:secret@{address}", f"nats://127.0.0.1:{free_port()}")
    with pytest.raises(ConnectionError) as error:
        asyncio.run(_connect(Servers(urls), 0.05))
    assert str(error.value).startswith(f"no connection to NATS at nats://{address}, {urls[1]}: ")


def test_a_server_that_answers_is_found_behind_one_that_does_not(tmp_path: Path) -> None:
    server = NatsServer(tmp_path)
    try:
        with wire.dead_address() as (host, port):
            asyncio.run(_connect(Servers((f"nats://{host}:{port}", server.url)), 2.0))
    finally:
        server.kill()


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[NatsServer]:
    """A server with the leases of a fleet that has ended."""
    server = NatsServer(tmp_path)
    make_settled(server.url, "holdfast_fleet_plant")
    yield server
    server.kill()


def test_a_look_at_a_fleet_ends_with_its_connection(fleet: NatsServer) -> None:
    async def look() -> None:
        async with FleetObserver("plant", Servers((fleet.url,))) as looker:
            assert not (await looker.look()).nodes
            fleet.kill()
            async with asyncio.timeout(wire.DEADLINE):
                while True:
                    await looker.look()
                    await asyncio.sleep(0.01)

    with pytest.raises(FleetUnavailable, match=f"the connection to NATS at {fleet.url} was lost"):
        asyncio.run(look())


def test_a_server_without_jetstream_is_named(tmp_path: Path) -> None:
    async def look() -> None:
        async with FleetObserver("plant", Servers((server.url,))):
            pass

    server = NatsServer(tmp_path, jetstream=False)
    try:
        with pytest.raises(FleetUnavailable, match=f"JetStream of NATS at {server.url}: "):
            asyncio.run(look())
    finally:
        server.kill()


@pytest.fixture
def hanging(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The configuration of an appliance that hangs: it does not even accept."""
    # The path of a socket is short, and those of tests can be long.
    with tempfile.TemporaryDirectory(prefix="hf") as runtime:
        monkeypatch.setenv("RUNTIME_DIRECTORY", runtime)
        file = tmp_path / "plant.yaml"
        listener = Listener(control._own_addresses(file)[0])
        yield file
        listener.close()


def test_an_appliance_that_hangs_is_not_waited_for(hanging: Path) -> None:
    """Three times: after that, the system does not accept for it either."""
    for _ in range(3):
        with pytest.raises(control.NotRunning, match=r"has not answered within 0\.05 s"):
            control.ask(hanging, "sessions", within_s=0.05)


def test_a_reload_waits_for_long_only_if_the_appliance_answers(hanging: Path) -> None:
    with pytest.raises(control.NotRunning, match=r"has not answered within 0\.05 s"):
        control.ask(hanging, "reload", within_s=control.RELOAD_TIMEOUT_S, ping_s=0.05)

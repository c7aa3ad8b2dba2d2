"""`holdfast log status` and `holdfast log replay --follow`, beside a running appliance."""

from __future__ import annotations

import signal
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.cli.appliance import log_status
from support import wire
from support.brokers import NatsServer, free_port
from support.cli import RunCommand, ServingCommand, answer, invoke

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

CONFIGURATION = """
memories: {{plant: {{holding_registers: 100, replicate: {{log: site}}}}}}
logs: {{site: {{servers: ["{url}"], node: scada-a, write_timeout: 10}}}}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:0
    rules: [{{sources: [127.0.0.0/8], units: {{1: plant}}, access: read-write}}]
"""


@pytest.fixture
def server(tmp_path: Path) -> Iterator[NatsServer]:
    (tmp_path / "server").mkdir()
    server = NatsServer(tmp_path / "server")
    yield server
    server.kill()


@pytest.fixture
def node(tmp_path: Path, server: NatsServer) -> Iterator[RunCommand]:
    file = tmp_path / "plant.yaml"
    file.write_text(CONFIGURATION.format(url=server.url))
    command = RunCommand(file)
    yield command
    command.process.kill()
    command.process.communicate()


def test_a_connected_log_without_contact_is_not_well(monkeypatch: pytest.MonkeyPatch) -> None:
    reason = "the log has confirmed nothing for 3.8 s"
    late = "last contact 68.9 s ago, allowed 5 s"
    counters = dict.fromkeys(("sequence", "lag", "steps", "unavailable", "not_confirmed"), 0)
    nodes = [{"name": name, "sequence": 8, "time_ns": 0, "digest": None} for name in ("a", "b")]
    status: dict[str, Any] = {
        **{"phase": "running", "failure": None, "connected": True, "server": "127.0.0.1:4222"},
        **{"contact_age": 68.9, "obstacle": late, "last_error": reason, "embedded": None},
        **{"replicas": 1, "node": "a", "nodes": nodes},
        **{"digest": [7, "0123456789abcdef", True], **counters},
        "devices": {},
    }
    monkeypatch.setattr(log_status, "ask", lambda *_: {"logs": {"site": status}})
    result = invoke("log", "status", __file__)
    assert result.exit_code == 3
    lines = result.stdout.splitlines()
    assert lines[3:5] == [f"  not caught up: {late}", f"  last error: {reason}"]
    assert [line.split()[0::3] for line in lines[6:]] == [["a", "7"], ["b"]]
    assert lines[6].split()[-1] == "0123456789ab"
    status |= {"obstacle": None, "devices": {"meter": {"node": "b", "reason": None}}}
    result = invoke("log", "status", __file__)
    assert (result.exit_code, result.stdout.splitlines()[-1].split()) == (0, ["meter", "b"])
    status["devices"]["meter"] = {"node": None, "reason": "no node takes its lease"}
    result = invoke("log", "status", __file__)
    assert result.exit_code == 3
    nobody, reason = result.stdout.splitlines()[-2:]
    assert nobody.split() == ["meter", "nobody"]
    assert reason.split(maxsplit=0) == ["no node takes its lease"]


def test_a_signal_ends_a_start_that_waits_for_the_log(tmp_path: Path) -> None:
    file = tmp_path / "a plant.yaml"
    file.write_text(CONFIGURATION.format(url=f"nats://127.0.0.1:{free_port()}"))
    command = RunCommand(file)
    try:
        log = command.process.stderr
        assert log is not None
        assert any("log_joining log=site" in line for line in iter(log.readline, ""))
        code, more = command.end(signal.SIGTERM)
    finally:
        command.process.kill()
    assert (code, more) == (0, "")


def test_the_nodes_of_a_log_are_shown(node: RunCommand, server: NatsServer, tmp_path: Path) -> None:
    file = str(tmp_path / "plant.yaml")
    with wire.Connection(node.wait_until_it_serves()) as connection:
        connection.ask(bytes.fromhex("060003002a"))
        status = answer("log", "status", file)["logs"]["site"]
        assert (status["phase"], status["connected"], status["steps"]) == ("running", True, 1)
        assert (status["node"], status["obstacle"]) == ("scada-a", None)
        lines = invoke("log", "status", file).stdout.splitlines()
        where = server.url.removeprefix("nats://")
        assert lines[0] == f"log site: running, connected to {where}, replicas 1"
        assert lines[2] == "  writes of this node: 1 done, 0 not sent, 0 not confirmed"
        assert lines[3].split()[:3] == ["node", "last", "message"]
        assert lines[4].split()[0] == "scada-a"
        server.kill()
        wire.until(lambda: invoke("log", "status", file).exit_code == 3, "the log is away")
        assert connection.ask(bytes.fromhex("060003002b")) == bytes.fromhex("8606")
    lines = invoke("log", "status", file).stdout.splitlines()
    assert lines[0] == "log site: running, not connected, replicas 1"
    assert lines[2] == "  writes of this node: 1 done, 1 not sent, 0 not confirmed"
    assert lines[3] == "  not caught up: not connected"
    assert lines[4].startswith("  last error: ")
    assert node.end(signal.SIGTERM)[0] == 0
    result = invoke("log", "status", file)
    assert (result.exit_code, result.stdout) == (1, "")


def test_a_log_is_followed_on_after_its_server_was_frozen(
    node: RunCommand, server: NatsServer, tmp_path: Path
) -> None:
    writes = [bytes.fromhex(f"06000300{value}") for value in ("2a", "2b")]
    with wire.Connection(node.wait_until_it_serves()) as connection:
        following = ServingCommand("log", "replay", str(tmp_path / "plant.yaml"), "--follow")
        printed, told = following.process.stdout, following.process.stderr
        assert printed is not None
        assert told is not None
        assert connection.ask(writes[0]) == writes[0]
        assert any("holding_registers 3: 42" in line for line in iter(printed.readline, ""))
        server.freeze()
        assert told.readline().startswith("holdfast: logs.site: no contact, retried: ")
        server.thaw()
        wire.until(lambda: connection.ask(writes[1]) == writes[1], "the log takes writes again")
        later = next(line for line in iter(printed.readline, "") if "holding_" in line)
        assert later.endswith("holding_registers 3: 43\n")
        assert following.end(signal.SIGTERM)[0] == 0

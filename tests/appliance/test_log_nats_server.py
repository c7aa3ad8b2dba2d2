"""Appliances with a NATS server of their own."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
import threading
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast.appliance import Appliance
from holdfast.config import load
from holdfast.net.nats_server import Access
from holdfast.net.nats_server import folder as nats_folder
from holdfast.net.nats_server import server as nats_server
from holdfast.net.nats_server.folder import Folder as NatsFolder
from holdfast.net.nats_server.log import ServerLog
from holdfast.net.nats_server.storage_limit import has_room, may_grow
from support import wire
from support.brokers import free_port
from support.cli import RunCommand, answer, done, invoke
from support.config_folder import Folder
from support.machine import full_disk, is_over, missing
from support.running import endpoint

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

WRITE = bytes.fromhex("060003002a")


@pytest.fixture(autouse=True)
def program() -> Path:
    found = Path(sys.executable).parent / "nats-server"
    if not found.exists():
        missing("the program nats-server")
    return found


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return configuration(tmp_path, free_port())


def configuration(folder: Path, port: int, more: str = "") -> Path:
    file = folder / "plant.yaml"
    file.write_text(
        f"""
memories: {{plant: {{holding_registers: 100, replicate: {{log: site}}}}}}
logs:
  site:
    {{embedded: log, node: scada-a, servers: ["nats://127.0.0.1:{port}"], write_timeout: 10{more}}}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:0
    rules: [{{sources: [127.0.0.0/8], units: {{1: plant}}, access: read-write}}]
"""
    )
    return file


@pytest.fixture
def start() -> Iterator[Callable[[Path], RunCommand]]:
    with ExitStack() as running:

        def begin(file: Path) -> RunCommand:
            command = RunCommand(file)
            running.callback(command.process.communicate)
            running.callback(command.process.kill)
            return command

        yield begin


def server(folder: Path) -> int:
    """The process id of the server in this folder."""
    return int((folder / "log" / "nats-server.lock").read_text())


def is_server(appliance: Appliance, status: dict[str, Any]) -> bool:
    return bool(appliance.replicas()["site"]["embedded"] == status)


def register(appliance: Appliance) -> int:
    return appliance.memories["plant"].read("holding_registers", 3, 1)[0]


def test_it_runs_from_the_start_to_the_end(file: Path, tmp_path: Path) -> None:
    with Appliance(load(file)) as appliance:
        appliance.memories["plant"].write("holding_registers", 3, [42])
        process = server(tmp_path)
        assert appliance.replicas()["site"]["embedded"] == {"running": True, "restarts": 0}
    wire.until(lambda: is_over(process), "the server has ended")
    with Appliance(load(file)) as appliance:
        assert register(appliance) == 42
        assert server(tmp_path) != process


def test_a_server_that_dies_is_started_again(
    file: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with Appliance(load(file)) as appliance, wire.Connection(endpoint(appliance, "scada")) as peer:
        assert peer.ask(WRITE) == WRITE
        for times in (1, 2):
            os.kill(server(tmp_path), signal.SIGKILL)
            expected = {"running": True, "restarts": times}
            wire.until(partial(is_server, appliance, expected), "it is back")
            wire.until(lambda: peer.ask(WRITE) == WRITE, "writes are taken again")
        assert register(appliance) == 42
    [first, second] = [each for each in caplog.records if each.message == "log_server_ended"]
    told = [getattr(each, "fields", {}) for each in (first, second)]
    assert [each["error"] for each in told] == ["killed by signal 9"] * 2
    assert told[1]["pause"] == 2 * told[0]["pause"]


def test_a_server_whose_disk_was_full_is_started_again_when_it_has_room(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = configuration(tmp_path, free_port(), more=", max_lag: 0.5")
    is_freed = threading.Event()
    monkeypatch.setattr(nats_server, "has_room", lambda _: is_freed.is_set())
    with Appliance(load(file)) as appliance, wire.Connection(endpoint(appliance, "scada")) as peer:
        resource.prlimit(server(tmp_path), resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))
        wire.until(lambda: len(failed_writes(caplog)) > 1, "writes fail")
        assert is_server(appliance, {"running": True, "restarts": 0})
        is_freed.set()
        again = {"running": True, "restarts": 1}
        wire.until(lambda: is_server(appliance, again), "it is started again")
        wire.until(lambda: peer.ask(WRITE) == WRITE, "writes are taken again")
        assert is_server(appliance, again)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("Filestore [s] Critical write error: no space left on device", ["failed"]),
        ("JetStream stream '$G > s' critical write error: no space left on device", ["failed"]),
        ("JetStream failed to store a msg on stream '$G > s': input/output error", ["failed"]),
        ("JetStream file resource limits exceeded for server", ["full"]),
        ("127.0.0.1:5000 - cid:5 - authentication error", []),
    ],
    ids=["disk", "stream", "message", "limit", "other"],
)
def test_lines_that_say_that_the_server_refuses_writes_are_found(
    text: str, expected: list[str]
) -> None:
    found: list[str] = []
    log = ServerLog(failed=lambda: found.append("failed"), full=lambda: found.append("full"))
    for line in (f"[ERR] {text}", "[INF] Server is ready", f"[ERR] {text}"):
        log.take(f"[9] 2026/11/27 14:05:11.538896 {line}")
    assert found == expected


def test_a_server_may_store_no_less_after_a_restart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = NatsFolder(tmp_path / "log")
    access = Access("127.0.0.1", 4222, token_file=tmp_path / "log" / "token")
    disk, stored = 400 << 20, tmp_path / "log" / "store" / "1.blk"
    stored.parent.mkdir()
    stored.touch()

    def free(_: Path) -> SimpleNamespace:
        return SimpleNamespace(free=disk - stored.stat().st_size)

    def limit() -> int:
        settings = json.loads(folder.configured(access).read_text())
        return int(settings["jetstream"]["max_file_store"]) >> 20

    def grows() -> bool:
        return may_grow(folder.store, folder.limit)

    monkeypatch.setattr(shutil, "disk_usage", free)
    assert limit() == 300
    assert not grows()
    os.truncate(stored, 300 << 20)
    assert grows()
    assert limit() == 375
    os.truncate(stored, 375 << 20)
    assert not grows(), "a server that is full is not restarted again and again"
    disk *= 2
    assert grows(), "there is room again"
    folder.close()


def failed_writes(caplog: pytest.LogCaptureFixture) -> list[str]:
    texts = [getattr(each, "fields", {}).get("text", "") for each in caplog.records]
    return [text for text in texts if "failed to store a msg" in text]


def test_a_folder_has_room_if_its_disk_takes_a_file(tmp_path: Path) -> None:
    assert has_room(tmp_path)
    with full_disk(1000):
        assert not has_room(tmp_path)
    assert not (tmp_path / "room").exists()


def test_it_serves_this_machine_and_who_knows_the_token(file: Path, tmp_path: Path) -> None:
    with Appliance(load(file)) as appliance:
        [address] = [appliance.replicas()["site"]["server"]]
        assert address.startswith("127.0.0.1:")
        for token, expected in (("x", b"-ERR"), ((tmp_path / "log/token").read_text(), b"PONG")):
            with socket.create_connection(("127.0.0.1", int(address.split(":")[1]))) as client:
                client.settimeout(wire.DEADLINE)
                options = json.dumps({"verbose": False, "auth_token": token.strip()})
                client.sendall(f"CONNECT {options}\r\nPING\r\n".encode())
                with client.makefile("rb") as lines:
                    assert json.loads(lines.readline().removeprefix(b"INFO "))["auth_required"]
                    assert lines.readline().startswith(expected)
    folder = tmp_path / "log"
    assert folder.stat().st_mode & 0o077 == 0
    for secret in ("token", "nats-server.conf"):
        assert (folder / secret).stat().st_mode & 0o077 == 0
    settings = json.loads((folder / "nats-server.conf").read_text())
    assert settings["jetstream"]["sync_interval"] == "always"


def test_its_clients_can_have_a_password(tmp_path: Path) -> None:
    (tmp_path / "password.txt").write_text('se"cr$e\\t\n')
    more = ", username: scada, password_file: password.txt"
    with Appliance(load(configuration(tmp_path, free_port(), more=more))) as appliance:
        appliance.memories["plant"].write("holding_registers", 3, [42])
        assert register(appliance) == 42
    assert not (tmp_path / "log" / "token").exists()


def test_a_password_that_the_server_takes_for_a_hash_is_refused(tmp_path: Path) -> None:
    (tmp_path / "password").write_text(f"$2a$10${53 * 'a'}\n")
    more = ", username: scada, password_file: password"
    told = refused(configuration(tmp_path, free_port(), more=more))
    assert f"{tmp_path / 'password'} can't be used: its secret begins like a bcrypt hash" in told


def test_nodes_and_the_past_can_be_shown(
    file: Path, start: Callable[[Path], RunCommand], tmp_path: Path
) -> None:
    command = start(file)
    with wire.Connection(command.wait_until_it_serves()) as peer:
        assert peer.ask(WRITE) == WRITE
    assert answer("log", "status", str(file))["logs"]["site"]["connected"]
    shown = done("log", "status", str(file))
    assert "  embedded server: running, started again 0 times" in shown
    assert done("log", "replay", str(file), "--values")[1:] == ["plant holding_registers 3: 42"]
    process = server(tmp_path)
    command.process.send_signal(signal.SIGTERM)
    command.process.communicate(timeout=wire.DEADLINE)
    assert command.process.returncode == 0
    assert is_over(process)
    # The past can also be rebuilt while the appliance does not run.
    assert done("log", "replay", str(file), "--values")[1:] == ["plant holding_registers 3: 42"]


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux ends it at once")
def test_it_ends_with_an_appliance_that_is_killed(
    file: Path, start: Callable[[Path], RunCommand], tmp_path: Path
) -> None:
    command = start(file)
    command.wait_until_it_serves()
    process = server(tmp_path)
    command.process.kill()
    wire.until(lambda: is_over(process), "the server has ended")


HOLD = """
import os, signal, sys
os.ftruncate(int(sys.argv[1]), 0)
os.write(int(sys.argv[1]), b"%d" % os.getpid())
print("ready", flush=True)
signal.pause()
"""


def test_a_server_that_was_left_over_is_ended(
    file: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "log").mkdir()
    descriptor = os.open(tmp_path / "log" / "nats-server.lock", os.O_RDWR | os.O_CREAT)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    left = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(descriptor)],
        pass_fds=[descriptor],
        stdout=subprocess.PIPE,
    )
    os.close(descriptor)
    with left:
        assert left.stdout is not None
        assert left.stdout.readline() == b"ready\n"
        try:
            with Appliance(load(file)):
                assert left.wait(wire.DEADLINE) == -signal.SIGTERM
        finally:
            left.kill()
    assert [each.message for each in caplog.records].count("log_server_left_over") == 1


def refused(file: Path, exit_code: int = 2) -> str:
    result = invoke("run", str(file))
    assert result.exit_code == exit_code
    [line] = [line for line in result.stderr.splitlines() if line.startswith("holdfast: ")]
    assert line.startswith("holdfast: logs.site.embedded: ")
    return line


def test_a_folder_has_one_user(file: Path, tmp_path: Path) -> None:
    with Appliance(load(file)):
        assert "log is in use by another process" in refused(file, 1)
        (tmp_path / "other").mkdir()
        (tmp_path / "other" / "log").symlink_to(tmp_path / "log")
        other = configuration(tmp_path / "other", free_port())
        assert "log is in use by another process" in refused(other, 1)


def test_a_port_that_is_taken_is_told(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        told = refused(configuration(tmp_path, port), 1)
        assert f"127.0.0.1:{port}" in told
        assert "in use" in told


def test_a_disk_that_is_full_may_have_room_at_the_next_start(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def replace(path: Path, *_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr(nats_folder, "replace", replace)
    assert "token can't be used: No space left" in refused(file, 1)


@pytest.mark.parametrize("name", ["log", "log/nats-server.conf"])
def test_a_folder_that_can_not_be_used_is_told(file: Path, tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    if name == "log":
        path.write_text("")
    else:
        path.mkdir()
    assert "can't be used: " in refused(file)


def test_a_missing_folder_around_it_is_told(file: Path) -> None:
    file.write_text(file.read_text().replace("embedded: log", "embedded: no/log"))
    assert "no/log can't be used: No such file or directory" in refused(file)


def test_a_program_that_is_missing_is_told(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda *_, **__: None)
    assert "nats-server is not installed; put it into the PATH, or pip install" in refused(file)


def test_a_damaged_configuration_of_the_server_is_told(tmp_path: Path) -> None:
    (tmp_path / "token.txt").write_bytes(b"\xff")
    more = ", token_file: token.txt"
    assert "token.txt is not UTF-8 text" in refused(configuration(tmp_path, 4222, more=more))


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        ({}, "logs.site.servers: missing, allowed: a list of nats://host:port"),
        ({"embedded": "a", "replicas": 3}, "replicas: found 3 with embedded, allowed: 1"),
        ({"embedded": "a", "tls": {}}, "logs.site.tls: found with embedded, allowed: username"),
        ({"embedded": "a", "username": "u"}, "found with embedded and without password_file"),
        ({"embedded": "a", "servers": ["nats://a"]}, "servers[0]: found 'nats://a:4222', allowed"),
        ({"embedded": "a", "servers": ["tls://127.0.0.1"]}, "allowed: nats:// with an IP address"),
        ({"embedded": "a", "servers": ["nats://10.0.0.1"]}, "allowed: a loopback address"),
        (
            {"embedded": "a", "servers": ["nats://127.0.0.1", "nats://127.0.0.2"]},
            "servers: found 2 entries with embedded, allowed: one, where it listens",
        ),
    ],
)
def test_settings_are_checked(tmp_path: Path, settings: dict[str, Any], problem: str) -> None:
    text = f"""
memories: {{plant: {{coils: 8, replicate: {{log: site}}}}}}
logs: {{site: {json.dumps({"node": "a", **settings})}}}
rest: {{bind: "127.0.0.1:0", sources: [127.0.0.0/8], tokens: none}}
"""
    found = Folder(tmp_path).problems(text)
    assert [each for each in found if problem in each]
    assert len(found) == 1


def test_two_embedded_servers_share_nothing(tmp_path: Path) -> None:
    text = """
memories:
  one: {coils: 8, replicate: {log: a}}
  two: {coils: 8, replicate: {log: b}}
logs:
  a: {embedded: same, node: a}
  b: {embedded: ./same, node: a}
rest: {bind: "127.0.0.1:0", sources: [127.0.0.0/8], tokens: none}
"""
    folder, address = Folder(tmp_path).problems(text)
    assert "logs.b.embedded: found './same', which is the folder of logs.a in line 6" in folder
    assert "found nats://127.0.0.1:4222, which is the address of logs.a in line 6" in address


def test_a_node_with_a_server_of_its_own_polls_devices(file: Path) -> None:
    source = holdfast.Memory(holding_registers=10)
    source.write("holding_registers", 3, [42])
    with holdfast.Server({1: source}, bind="127.0.0.1:0", access="read-write") as device:
        host, port = device.address
        read = {"area": "holding_registers", "address": 0, "count": 10}
        read["into"] = {"memory": "plant", "area": "holding_registers", "address": 0}
        meter = {"url": f"tcp://{host}:{port}", "interval": 0.1, "reads": [read]}
        with file.open("a") as more:
            more.write(f"devices: {json.dumps({'meter': meter})}\n")
        with Appliance(load(file)) as appliance:
            wire.until(lambda: register(appliance) == 42, "it is mirrored")
